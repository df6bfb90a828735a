"""Force display: J_M^T, limits of the device, safe state."""

from __future__ import annotations

import numpy as np
import phantom_arrays as arrays
import pytest

from drake_teleop.common.blocks import Fault
from drake_teleop.station.master import phantom
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.master.force_display import (
    ForceDisplay,
    initial_display_state,
    step_display,
)
from drake_teleop.station.passivity.safe_state import RESUME_TIME_S, STOP_TIME_S

DEVICE = Master().device(0.1, 1e-4)
PERIOD = 5e-4
POSTURES = [
    np.zeros(6),
    np.array([0.4, 0.3, 0.5, -0.6, 0.7, 0.8]),
    np.array([-0.7, -0.2, 0.1, 1.2, -1.1, -2.0]),
]


def display(wrench, q) -> tuple[np.ndarray, np.ndarray]:
    """Return the block's outputs: motor torque, displayed wrench."""
    block = ForceDisplay(PERIOD, DEVICE)
    context = block.CreateDefaultContext()
    block.GetInputPort("wrench_command").FixValue(context, np.asarray(wrench, dtype=float))
    start = initial_display_state(np.array(q, dtype=float), DEVICE.parameters)
    block.GetInputPort("for_display").FixValue(context, start)
    return (
        block.GetOutputPort("drive").Eval(context)[:6].copy(),
        block.GetOutputPort("force_to_master").Eval(context).copy(),
    )


@pytest.mark.parametrize("q", POSTURES)
def test_torque_has_the_virtual_work_of_the_wrench(q):
    """delta W = F . delta x for small displacements from the forward kinematics."""
    wrench = np.array([3.0, -2.0, 5.0, 0.05, -0.02, 0.03])
    torque, displayed = display(wrench, q)
    np.testing.assert_array_equal(displayed, wrench)
    step = 1e-6
    for k in range(6):
        ahead = arrays.forward_kinematics(q + step * np.eye(6)[k])
        behind = arrays.forward_kinematics(q - step * np.eye(6)[k])
        translation = (ahead[4:] - behind[4:]) / (2 * step)
        # Small rotation in B from the quaternions: 2 dq q*.
        w, x = ahead[0], ahead[1:4]
        w0, x0 = behind[0], -behind[1:4]
        rotation = 2 * (w * x0 + w0 * x + np.cross(x, x0)) / (2 * step)
        work = wrench[:3] @ translation + wrench[3:] @ rotation
        assert torque[k] - arrays.gravity_torque(q)[k] == pytest.approx(work, abs=1e-8)


@pytest.mark.parametrize("q", POSTURES)
def test_zero_command_gives_gravity_compensation(q):
    torque, displayed = display(np.zeros(6), q)
    np.testing.assert_allclose(torque, arrays.gravity_torque(q), atol=1e-15)
    np.testing.assert_array_equal(displayed, 0)


@pytest.mark.parametrize("q", POSTURES)
def test_limited_wrench_keeps_its_direction(q):
    wrench = np.array([300.0, -200.0, 500.0, 5.0, -2.0, 3.0])
    torque, displayed = display(wrench, q)
    assert np.linalg.norm(displayed[:3]) == pytest.approx(37.5, rel=1e-12)
    np.testing.assert_allclose(np.cross(displayed[:3], wrench[:3]), 0, atol=1e-10)
    np.testing.assert_allclose(np.cross(displayed[3:], wrench[3:]), 0, atol=1e-14)
    assert displayed[:3] @ wrench[:3] > 0
    assert displayed[3:] @ wrench[3:] > 0
    share = np.abs(torque[3:]) / [0.515, 0.515, 0.170]
    assert share.max() == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(
        torque, arrays.jacobian(q).T @ displayed + arrays.gravity_torque(q), atol=1e-12
    )
    np.testing.assert_array_equal(display(-wrench, q)[1], -displayed)


def test_force_and_torque_are_limited_separately():
    _, displayed = display([0, 0, 100.0, 0.01, 0, 0], phantom.HOME_POSTURE_RAD)
    np.testing.assert_allclose(displayed, [0, 0, 37.5, 0.01, 0, 0], rtol=1e-12)
    _, displayed = display([0, 0, 10.0, 0.34, 0.1, 0], phantom.HOME_POSTURE_RAD)
    np.testing.assert_allclose(displayed, [0, 0, 10.0, 0.17, 0.05, 0], rtol=1e-12)
    _, displayed = display([0, 0, 0, 0.34, 0, 5.15], phantom.HOME_POSTURE_RAD)
    np.testing.assert_allclose(displayed, [0, 0, 0, 0.034, 0, 0.515], rtol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("index", range(6))
def test_command_that_is_not_finite_displays_zero(bad, index):
    wrench = np.ones(6)
    wrench[index] = bad
    torque, displayed = display(wrench, POSTURES[1])
    np.testing.assert_array_equal(displayed, 0)
    np.testing.assert_allclose(torque, arrays.gravity_torque(POSTURES[1]), atol=1e-15)


def test_fault_has_its_own_port_and_a_combined_one():
    block = ForceDisplay(PERIOD, DEVICE)
    context = block.CreateDefaultContext()
    start = initial_display_state(POSTURES[1], DEVICE.parameters)
    block.GetInputPort("for_display").FixValue(context, start)
    for wrench, fault in ((np.ones(6), Fault.NONE), (np.full(6, np.nan), Fault.HAND_WRENCH)):
        block.GetInputPort("wrench_command").FixValue(context, wrench)
        assert block.GetOutputPort("fault_at_hand").Eval(context) == [fault]
        both = block.GetOutputPort("displayed_and_fault").Eval(context)
        force = block.GetOutputPort("force_to_master").Eval(context)
        np.testing.assert_array_equal(both, [*force, fault])


def test_huge_command_is_limited_and_invalid_command_is_zero():
    _, displayed = display([1e6, 1e6, 0, 0, 0, 1e6], phantom.HOME_POSTURE_RAD)
    assert np.linalg.norm(displayed[:3]) == pytest.approx(37.5)
    assert displayed[5] == pytest.approx(0.515)
    np.testing.assert_array_equal(display([1e9, 0, 0, 0, 0, 0], phantom.HOME_POSTURE_RAD)[1], 0)


WRENCH = np.array([3.0, -2.0, 5.0, 0.05, -0.02, 0.03])


def displayed_over(commands, angles) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 7) displayed wrench and fault, and (N, 6) torque, per period."""
    device, J, drive = (
        initial_display_state(POSTURES[1], DEVICE.parameters),
        np.empty((6, 6)),
        np.empty(27),
    )
    shown, torque = np.empty((len(commands), 7)), np.empty((len(commands), 6))
    for k, (command, q) in enumerate(zip(commands, angles, strict=True)):
        device[:6] = q
        step_display(command, device, DEVICE.packed_parameters, PERIOD, J, drive)
        torque[k], shown[k] = drive[:6], drive[12:19]
        device[6:] = drive[6:]
    return shown, torque


@pytest.mark.parametrize("part", ["wrench", "angles"])
def test_wrench_fades_and_returns_without_a_step(part):
    """One value is NaN from 20 to 80 ms; the command is 6 N."""
    n, bad = 2600, slice(40, 160)
    commands, angles = np.tile(WRENCH, (n, 1)), np.tile(POSTURES[1], (n, 1))
    {"wrench": commands, "angles": angles}[part][bad, 2] = np.nan
    shown, torque = displayed_over(commands, angles)
    force, fault = np.linalg.norm(shown[:, :3], axis=1), shown[:, 6]
    np.testing.assert_array_equal(shown[:40, :6], commands[:40])
    np.testing.assert_allclose(np.diff(force[39:140]), -force[0] * PERIOD / STOP_TIME_S, rtol=1e-9)
    np.testing.assert_allclose(shown[140:160, :6], 0.0, atol=1e-12)
    held = arrays.gravity_torque(POSTURES[1])
    np.testing.assert_allclose(torque[140:160], np.tile(held, (20, 1)), atol=1e-12)
    growth = np.diff(force[159:])
    assert 0.0 < growth.max() <= 37.5 * PERIOD / RESUME_TIME_S * (1 + 1e-9)
    np.testing.assert_array_equal(shown[2400:, :6], commands[2400:])
    expected = Fault.HAND_WRENCH if part == "wrench" else Fault.HAND_JOINTS
    assert (fault[bad] == expected).all() and not fault[:40].any() and not fault[2400:].any()
    assert (fault[160:1160] == Fault.RESUMING).all()


def test_torque_returns_to_the_limit_of_the_strongest_motor():
    """Only the first wrist motor can display 0.3 N m: no step when the last is at its limit."""
    motors = np.array([0.3, 0.0, 0.0])
    torque = np.linalg.solve(arrays.jacobian(POSTURES[1])[3:, 3:].T, motors)
    commands = np.tile(np.r_[np.zeros(3), torque], (2600, 1))
    commands[40:160, 3] = np.nan
    shown, _ = displayed_over(commands, np.tile(POSTURES[1], (2600, 1)))
    growth = np.diff(np.linalg.norm(shown[159:, 3:6], axis=1))
    assert (
        0.0
        < growth.max()
        <= phantom.PEAK_WRIST_TORQUES_N_M.max() * PERIOD / RESUME_TIME_S * (1 + 1e-9)
    )
    np.testing.assert_array_equal(shown[2400:, :6], commands[2400:])
