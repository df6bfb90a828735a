"""Where the files that are not Python live: models and shipped scenarios.

In the repository `models/` stands at the top; the wheel carries it inside the package.
"""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def models_dir() -> Path:
    """The folder with `package.xml` and the SDF models (Drake package name `drake_teleop`)."""
    packaged = _PACKAGE / "models"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "models"


def scenarios_dir() -> Path:
    """The folder of the scenarios that are shipped by name."""
    return _PACKAGE / "station" / "scenarios"


def studies_dir() -> Path:
    """The folder of the studies that are shipped by name."""
    return _PACKAGE / "lab" / "studies"
