"""Folders of models and shipped scenarios."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def models_dir() -> Path:
    """Return the folder of the models; the wheel contains it inside the package."""
    packaged = _PACKAGE / "models"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "models"


def scenarios_dir() -> Path:
    """Return the folder of the shipped scenarios."""
    return _PACKAGE / "station" / "scenarios"


def studies_dir() -> Path:
    """Return the folder of the shipped studies."""
    return _PACKAGE / "lab" / "studies"
