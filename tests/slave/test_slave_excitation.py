"""The bridge from the RX90 to the excitation's design."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.load.excitation import condition_numbers, design_excitation, limit_use
from drake_teleop.slave.arm import MOTION_SIZE, sensor_motion
from drake_teleop.slave.excitation import excitation_limits, sensor_motion_of
from drake_teleop.slave.plant import AddSlavePlant, home_position

START = [0.55, 0.0, 0.45]


@pytest.fixture(scope="module")
def arm():
    return AddSlavePlant(DiagramBuilder(), START, None).arm


def test_whole_trajectories_move_as_the_single_samples_do(arm):
    q, qd, qdd = np.random.default_rng(0).standard_normal((3, 5, 6))
    s, omega, alpha, p_WS, R_WS = sensor_motion_of(arm)(q, qd, qdd)
    for i in range(5):
        one = np.empty(MOTION_SIZE)
        sensor_motion(arm.table, q[i], qd[i], qdd[i], one)
        np.testing.assert_array_equal(
            np.concatenate([s[i], omega[i], alpha[i], p_WS[i], R_WS[i].ravel()]), one
        )


def test_the_home_posture_respects_the_limits_and_they_lie_inside_the_arms(arm):
    limits = excitation_limits(arm)
    home = home_position(arm, START)
    assert (home > limits.q_lower).all() and (home < limits.q_upper).all()
    assert (limits.q_lower > arm.lower).all() and (limits.q_upper < arm.upper).all()
    assert (limits.velocity < arm.velocity_limit).all()
    assert limits.phi[0] == pytest.approx(1.3 * 3.13)


def test_the_rx90_gets_a_checked_and_useful_trajectory(arm):
    limits, motion = excitation_limits(arm), sensor_motion_of(arm)
    trajectory = design_excitation(motion, limits, home=home_position(arm, START), seed=0)
    assert max(limit_use(trajectory, motion, limits).values()) <= 1
    samples = motion(*trajectory.evaluate(np.arange(0, trajectory.period, 1e-3)))
    assert condition_numbers(*samples[:3]).kappa_w10 < 8
