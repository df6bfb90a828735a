"""Four channels against the equations of docs/theory.md (T39)."""

from __future__ import annotations

import numpy as np

from drake_teleop.station.passivity.four_channel import FourChannelConfig
from drake_teleop.station.passivity.memory import SERVO_D, SERVO_K, WRENCH_LIMIT
from drake_teleop.station.passivity.methods import (
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    slave_step,
    step_addresses,
)
from drake_teleop.station.passivity.packet import PACKET_SIZE, move_pose_into, pose_difference_into

T = 1e-3
START = np.array([1.0, 0.0, 0.0, 0.0, 0.1, -0.2, 0.3])


def test_motion_and_force_equal_the_equations_with_local_feedback():
    own = FourChannelConfig([70.0, 0.7], [4.0, 0.03], slave_feedback=0.3, hand_feedback=-0.4)
    p = method_parameters(
        PassivityConfig("four_channel", force_limit=1e4, torque_limit=1e3, four_channel=own)
    )
    rng, zero = np.random.default_rng(0), np.zeros(6)
    memory = [initial_method_memory("four_channel", p, START) for _ in range(2)]
    packets = np.zeros((2, PACKET_SIZE))
    moved, twist, (hand, contact) = (
        0.1 * rng.normal(size=6),
        rng.normal(size=(2, 6)),
        rng.normal(size=(2, 6)),
    )
    pose, wrench, command = START.copy(), np.zeros(6), np.zeros(13)
    move_pose_into(START, moved, pose)  # the hand's; the slave is at the start

    slave_step(
        step_addresses("four_channel"),
        np.zeros(PACKET_SIZE),
        False,
        START,
        twist[1],
        zero,
        contact,
        T,
        p,
        memory[1],
        command,
        packets[1],
    )
    master_step(
        step_addresses("four_channel"),
        packets[1],
        True,
        pose,
        twist[0],
        zero,
        hand,
        p[WRENCH_LIMIT],
        T,
        p,
        memory[0],
        wrench,
        packets[0],
    )
    K, D = (np.repeat(x, 3) for x in (own.stiffness, own.damping))
    behind = np.empty(6)
    pose_difference_into(START, pose, behind)
    expected = 0.6 * contact - 0.4 * hand + K * behind + D * (twist[1] - twist[0])
    np.testing.assert_allclose(wrench, expected, rtol=1e-12)

    slave_step(
        step_addresses("four_channel"), packets[0], True, START, twist[1], zero, contact, T, p,
        memory[1], command, packets[1],
    )  # fmt: skip
    K, D = (np.repeat(p[x], 3) for x in (SERVO_K, SERVO_D))
    shift = np.empty(6)
    pose_difference_into(command[:7], pose, shift)
    np.testing.assert_allclose(K * shift, 1.3 * hand + 0.3 * contact + D * twist[0], rtol=1e-9)
    np.testing.assert_array_equal(command[7:], twist[0])
