"""Wrench to render at the hand from the slave's wrench."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from rendered_wrench import wrench_to_master

from drake_teleop.common.vectors import quaternion_exponential
from drake_teleop.station.scaling.force_scaling import wrench_to_master_into
from drake_teleop.station.scaling.kinematic_scaling import scale_pose_into

TOOL_DOWN = np.diag([1.0, -1.0, -1.0])
angles = st.floats(-3, 3)
rotations = st.tuples(angles, angles, angles).map(
    lambda rpy: RollPitchYaw(np.array(rpy)).ToRotationMatrix().matrix()
)


def test_weight_pulls_the_hand_down():
    """The wrench at rest is f = -m g, here up along -z_S; the hand is pulled down by m g / 17.5."""
    wrench_S = np.array([0, 0, -3.13 * 9.81, 0, 0, 0])
    felt = wrench_to_master(wrench_S, TOOL_DOWN, np.eye(3), 1 / 17.5, 1 / 17.5)
    np.testing.assert_allclose(felt, [0, 0, -3.13 * 9.81 / 17.5, 0, 0, 0], atol=1e-12)


def test_reaction_of_a_torque_has_its_own_scale():
    wrench_S = np.array([1.0, 0, 0, 0, 2.0, 0])
    felt = wrench_to_master(wrench_S, TOOL_DOWN, np.eye(3), 0.1, 0.5)
    np.testing.assert_allclose(felt, [-0.1, 0, 0, 0, 1.0, 0], atol=1e-15)


@given(rotations, rotations, st.integers(0, 2**31))
def test_compiled_sample_equals_the_vectorised_form(R_WS, R_WB, seed):
    wrenches = np.random.default_rng(seed).normal(size=(4, 6))
    vectorised = wrench_to_master(wrenches, R_WS, R_WB, 0.3, 0.7)
    for wrench, expected in zip(wrenches, vectorised, strict=True):
        out = np.empty(6)
        wrench_to_master_into(
            wrench, np.ascontiguousarray(R_WS), np.ascontiguousarray(R_WB), 0.3, 0.7, out
        )
        np.testing.assert_allclose(out, expected, atol=1e-14)


@given(rotations, rotations, st.integers(0, 2**31), st.floats(0.1, 5))
def test_equal_scales_of_motion_and_force_keep_the_power(R_WS, R_WB, seed, scale):
    """The power of the hand equals that of the slave's motion from the kinematic scaling."""
    rng = np.random.default_rng(seed)
    velocity_B, omega_B, wrench_S = rng.normal(size=3), rng.normal(size=3), rng.normal(size=6)
    alignment = RotationMatrix(R_WB).ToQuaternion().wxyz()
    start_W = np.array([*RotationMatrix(R_WS).ToQuaternion().wxyz(), 0.1, 0.2, 0.3])
    step, moved = 1e-6, []
    for sign in (1, -1):
        pose = np.array(
            [*quaternion_exponential(tuple(sign * step * omega_B)), *(sign * step * velocity_B)]
        )
        out = np.empty(7)
        scale_pose_into(
            pose, np.array([1.0, 0, 0, 0, 0, 0, 0]), start_W, alignment, scale, 1.0, out
        )
        moved.append(out)
    velocity_W = (moved[0][4:] - moved[1][4:]) / (2 * step)
    ahead, behind = (RotationMatrix(Quaternion(m[:4])).matrix() for m in moved)
    spin = (ahead @ behind.T - behind @ ahead.T) / (4 * step)
    omega_W = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
    slave = (R_WS @ wrench_S[:3]) @ velocity_W + (R_WS @ wrench_S[3:]) @ omega_W
    felt = wrench_to_master(wrench_S, R_WS, R_WB, scale, 1.0)
    assert -(felt[:3] @ velocity_B + felt[3:] @ omega_B) == pytest.approx(slave, abs=1e-7)
