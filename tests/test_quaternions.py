"""Quaternions of rotation matrices, in each of the branches of Shepperd's method."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_teleop.common.quaternions import quaternion_of


@pytest.mark.parametrize(
    "axis", [[0.3, 0.2, 0.1], [3.0, 0.2, 0.3], [0.3, 3.0, 0.2], [0.2, 0.3, 3.0]]
)
def test_a_turn_about_any_axis_is_found(axis):
    """Small, and by nearly half a turn about each axis: another number is the largest each time."""
    turn = Rotation.from_rotvec(axis)
    found = np.array(quaternion_of(turn.as_matrix()))
    wanted = np.roll(turn.as_quat(), 1)
    np.testing.assert_allclose(found * np.sign(found @ wanted), wanted, atol=1e-12)
