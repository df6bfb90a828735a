"""Folders of real records, which the project does not ship."""

from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"


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
