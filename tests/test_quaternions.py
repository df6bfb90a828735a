"""Quaternions of rotation matrices, in each branch of Shepperd's method."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_teleop.common.vectors import quaternion_of_matrix


@pytest.mark.parametrize(
    "axis", [[0.3, 0.2, 0.1], [3.0, 0.2, 0.3], [0.3, 3.0, 0.2], [0.2, 0.3, 3.0]]
)
def test_quaternion_of_a_rotation_about_any_axis(axis):
    """A small rotation and nearly 180 deg about each axis cover all branches."""
    turn = Rotation.from_rotvec(axis)
    found = np.array(quaternion_of_matrix(turn.as_matrix()))
    wanted = np.roll(turn.as_quat(), 1)
    np.testing.assert_allclose(found * np.sign(found @ wanted), wanted, atol=1e-12)
