"""Passive set-position modulation: its ledger equals the energy of the actual port."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.station.passivity import pspm
from drake_teleop.station.passivity.memory import (
    COMMAND_POSE,
    DISSIPATED_ENERGY,
    LAST_PORT_WRENCH,
    RECEIVED_ENERGY,
    SENT_ENERGY,
    STORED_ENERGY,
    WRENCH_LIMIT,
)
from drake_teleop.station.passivity.methods import (
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    slave_step,
    step_addresses,
)
from drake_teleop.station.passivity.packet import (
    PACKET_SIZE,
    WRENCH,
    move_pose_into,
    pose_difference_into,
)

T, STEPS, START = 1e-3, 1500, np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
K, D = np.repeat([300.0, 5.0], 3), np.repeat([2.0, 0.02], 3)


def motion(rng):
    t = np.arange(STEPS) * T
    return 0.05 * sum(
        np.sin(np.outer(t, rng.uniform(2, 15, 6))) * rng.uniform(-1, 1, 6) for _ in range(3)
    )


def groups(values):
    return np.array([values[:3].sum(), values[3:].sum()])


@pytest.mark.parametrize("end", ["master", "slave"])
def test_stored_energy_is_input_minus_output(end):
    """E + spring = E_0 + received - sent - lost - work of the held wrench, at every step.

    Wrench and spring are computed from the outputs, not from the memory.
    """
    rng = np.random.default_rng(4)
    config = PassivityConfig(
        method="pspm",
        servo_stiffness=[300.0, 5.0],
        servo_damping=[2.0, 0.02],
        retreat=[1e3, 1e3],  # otherwise the wrench does not determine the spring
    )
    p, m = method_parameters(config), step_addresses("pspm")
    memory = initial_method_memory("pspm", p, START)
    first, work = memory[STORED_ENERGY].copy(), np.zeros(2)
    other = initial_method_memory("pspm", p, START)
    held, before, e = np.zeros(6), START.copy(), np.zeros(6)
    ours, theirs = motion(rng), motion(rng)
    dx, dx_other, pose, target = np.zeros(6), np.zeros(6), START.copy(), START.copy()
    packet, received, output = np.zeros(PACKET_SIZE), np.zeros(PACKET_SIZE), np.zeros(13)
    wrench, spare = np.zeros(6), np.zeros(PACKET_SIZE)
    K_h = np.repeat(config.pspm.stiffness, 3)
    B = np.repeat(config.pspm.damping, 3)
    largest = 0.0
    for k in range(STEPS):
        move_pose_into(START, ours[k], pose)
        pose_difference_into(pose, before, dx)
        before[:] = pose
        move_pose_into(START, theirs[k], target)
        dx_other[:] = theirs[k] - theirs[max(k - 1, 0)]
        f_e = np.repeat([4.0, 0.05], 3) * np.sin(k * T * np.arange(3, 9))
        twist = dx / T
        work += groups(held * dx)
        fresh = k % 3 == 0  # two packets of three are lost
        if end == "master":
            if fresh:
                slave_step(
                    m, spare, True, target, dx_other / T, dx_other, f_e, T, p, other, output,
                    received,
                )  # fmt: skip
            master_step(
                m, received, fresh, pose, twist, dx, np.zeros(6), p[WRENCH_LIMIT], T, p, memory,
                wrench, packet,
            )  # fmt: skip
            held = wrench.copy()
            e = (wrench + B * twist) / K_h
            spring = 0.5 * K_h * e**2
        else:
            if fresh:
                master_step(
                    m, spare, True, target, dx_other / T, dx_other, np.zeros(6), p[WRENCH_LIMIT],
                    T, p, other, wrench, received,
                )  # fmt: skip
            slave_step(m, received, fresh, pose, twist, dx, f_e, T, p, memory, output, packet)
            pose_difference_into(output[:7], pose, e)
            held = K * e - D * twist
            spring = 0.5 * K * e**2
        left = memory[STORED_ENERGY] + groups(spring)
        put_in = first + memory[RECEIVED_ENERGY] - work
        put_in -= memory[SENT_ENERGY] + memory[DISSIPATED_ENERGY]
        np.testing.assert_allclose(left, put_in, rtol=0, atol=1e-9)
        largest = max(largest, np.abs(work).max())
    assert largest > 0.01, "nothing happened"


def test_wrench_is_limited_before_the_spring_stores_energy():
    """The damper acts beyond the limit; a withheld wrench costs no energy."""
    p, m, rng = (
        method_parameters(PassivityConfig(method="pspm")),
        step_addresses("pspm"),
        np.random.default_rng(2),
    )
    memory, packet, wrench = (
        initial_method_memory("pspm", p, START),
        np.zeros(PACKET_SIZE),
        np.empty(6),
    )
    memory[STORED_ENERGY] = rich = np.array([10.0, 10.0])
    received, limits = np.zeros(PACKET_SIZE), np.array([3.0, 0.02])
    shown = rng.normal(size=6)
    shown /= np.sqrt(np.repeat(groups(shown**2) / limits**2, 3))
    received[WRENCH] = 7.0 * shown
    twist, still = 0.1 * shown, np.zeros(6)
    master_step(m, received, True, START, twist, still, still, limits, T, p, memory, wrench, packet)
    K_h, B = (
        np.repeat(x, 3) for x in (PassivityConfig().pspm.stiffness, PassivityConfig().pspm.damping)
    )
    np.testing.assert_allclose(wrench, shown - B * twist, rtol=1e-12)
    spent = rich - memory[STORED_ENERGY] - memory[SENT_ENERGY]
    np.testing.assert_allclose(spent, groups(0.5 * shown**2 / K_h), rtol=1e-9)


def test_servo_wrench_follows_the_command_after_the_safe_state(monkeypatch):
    """The ledger contains the additional energy of the spring, by group."""
    monkeypatch.setattr(pspm, "dot_of_group", pspm.dot_of_group.py_func)
    config = PassivityConfig(method="pspm", servo_stiffness=[300.0, 5.0], servo_damping=[2.0, 0.02])
    p, rng = method_parameters(config), np.random.default_rng(1)
    memory, before = (
        initial_method_memory("pspm", p, START),
        initial_method_memory("pspm", p, START)[STORED_ENERGY],
    )
    pose, wanted, command = np.empty(7), np.empty(7), np.empty(7)
    move_pose_into(START, 0.1 * rng.normal(size=6), pose)
    asked, left, twist = 0.2 * rng.normal(size=6), 0.1 * rng.normal(size=6), rng.normal(size=6)
    move_pose_into(pose, asked, wanted)
    move_pose_into(pose, left, command)
    pspm.record_command.py_func(wanted, command, pose, twist, p, memory)
    np.testing.assert_allclose(memory[LAST_PORT_WRENCH], K * left - D * twist, rtol=1e-9)
    np.testing.assert_array_equal(memory[COMMAND_POSE], command)
    more = groups(0.5 * K * (left**2 - asked**2))
    np.testing.assert_allclose(memory[STORED_ENERGY], before - more, rtol=1e-9)
