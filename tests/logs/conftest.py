"""Folders of real records, which the project does not ship."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"


@pytest.fixture(autouse=True)
def _pictures_in_outline(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are made but not painted, which takes longer than most tests; see `pictures`."""
    if request.node.get_closest_marker("pictures") is None:
        painted = Figure.savefig

        def outline(_: Figure, target: Any, **options: Any) -> None:
            painted(Figure(figsize=(0.1, 0.1)), target, **options)

        monkeypatch.setattr(Figure, "savefig", outline)


def _records(name: str) -> Path:
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"needs the records {name}, which the project does not ship")
    return folder.resolve()


@pytest.fixture
def ntnu() -> Path:
    """Static poses and one-axis motions of a force sensor with an IMU, a hammer tapping."""
    return _records("ntnu_fts_imu_contact")


@pytest.fixture
def ur5() -> Path:
    """Motions of a UR5 with an IMU and a force sensor with hardly any load."""
    return _records("ur5_imu_fts_contact")
