"""Haptic devices in task space, by data sheet."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.master import dynamics
from drake_teleop.station.master.data_sheets import FIGURES, Master, PhantomJointFriction
from drake_teleop.station.master.device import MasterDevice
from drake_teleop.station.master.electronics import encoder_pose_into
from drake_teleop.station.master.force_display import initial_display_state, step_display
from drake_teleop.station.operator.operator import Sine
from drake_teleop.station.scenario import LoadScenario, ScenarioFromData, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

HAND = (0.2, 3e-4)
PERIOD = 5e-4
Q = np.array([0.25, 0.02, 0.05, 0.5, -0.7, 0.9])
V = np.array([0.3, -0.2, 0.1, 2.0, -1.0, 3.0])


def device(model="omega_6", **figures) -> dynamics.HapticDevice:
    return Master(model=model, figures=dataclasses.replace(FIGURES[model], **figures)).device(*HAND)


def smooth(model="omega_6", **figures) -> dynamics.HapticDevice:
    none = {"friction": 0.0, "friction_torque": 0.0, "damping": 0.0, "turning_damping": 0.0}
    return device(model, **none | figures)


def advance(device, state, wrench, motor, steps, period=PERIOD) -> np.ndarray:
    state, work, stages = state.copy(), np.empty((2, 6, 6)), np.empty((3, 12))
    for _ in range(steps):
        dynamics.step_device(state, wrench, motor, device.parameters, period, work, stages)
    return state


def rotation(pose) -> np.ndarray:
    return RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))).matrix()


def test_the_jacobian_is_the_derivative_of_the_pose():
    omega, step = device(), 1e-6
    R = rotation(omega.forward_kinematics(Q))
    for k, column in enumerate(omega.jacobian(Q).T):
        ahead = omega.forward_kinematics(Q + step * np.eye(6)[k])
        behind = omega.forward_kinematics(Q - step * np.eye(6)[k])
        spin = (rotation(ahead) - rotation(behind)) @ R.T / (2 * step)
        numeric = [*(ahead[4:] - behind[4:]) / (2 * step), spin[2, 1], spin[0, 2], spin[1, 0]]
        np.testing.assert_allclose(column, numeric, atol=1e-9)
    np.testing.assert_allclose(omega.inverse_kinematics(omega.forward_kinematics(Q)), Q, atol=1e-12)


def test_free_device_keeps_velocity_and_angular_velocity():
    """The inertia is isotropic, for any joint angles."""
    omega = smooth()
    start = np.concatenate([Q, 0.1 * V])
    after = advance(omega, start, np.zeros(6), np.zeros(6), 200)
    twist = omega.jacobian(Q) @ start[6:]
    np.testing.assert_allclose(omega.jacobian(after[:6]) @ after[6:], twist, rtol=1e-9)
    np.testing.assert_allclose(after[:3] - Q[:3], 0.1 * twist[:3], rtol=1e-9)


def test_hand_and_motors_accelerate_the_mass_on_the_data_sheet():
    """F = m a and tau = I alpha at E in B, for the hand and for J^T F of the motors."""
    omega = smooth(apparent_mass=0.3, inertia=2e-4)
    wrench = np.array([0.3, -0.2, 0.1, 1e-3, -2e-3, 3e-3])
    start = np.concatenate([Q, np.zeros(6)])
    expected = np.concatenate([wrench[:3] / 0.5, wrench[3:] / 5e-4]) * PERIOD
    of_motors = omega.jacobian(Q).T @ wrench
    for by in ((wrench, np.zeros(6)), (np.zeros(6), of_motors)):
        after = advance(omega, start, *by, 1)
        np.testing.assert_allclose(omega.jacobian(Q) @ after[6:], expected, rtol=1e-5)
    M = omega.jacobian(Q).T @ np.diag(np.repeat([0.5, 5e-4], 3)) @ omega.jacobian(Q)
    np.testing.assert_allclose(omega.mass_matrix(Q), M, atol=1e-15)


def test_friction_is_isotropic_and_opposes_motion():
    omega = device(friction=0.3, damping=2.0, friction_torque=1e-3, turning_damping=1e-4)
    rate = np.linalg.solve(omega.jacobian(Q), V)  # twist V
    after = advance(omega, np.concatenate([Q, rate]), np.zeros(6), np.zeros(6), 1, period=1e-5)
    change = (omega.jacobian(after[:6]) @ after[6:] - V) / 1e-5
    speed, turning = np.linalg.norm(V[:3]), np.linalg.norm(V[3:])
    mass, inertia = 0.3 + HAND[0], 1e-4 + HAND[1]
    np.testing.assert_allclose(change[:3], -(0.3 / speed + 2.0) * V[:3] / mass, rtol=1e-3)
    drag = 1e-3 / turning + 1e-4
    np.testing.assert_allclose(change[3:], -drag * V[3:] / inertia, rtol=1e-3)
    slope = omega.damping_matrix(Q)
    np.testing.assert_allclose(rate @ slope @ rate, 2.0 * speed**2 + 1e-4 * turning**2, rtol=1e-12)


@pytest.mark.parametrize("axis", range(6))
def test_end_stops_are_at_the_workspace_limits(axis):
    touch = device("geomagic_touch")
    figures, side = FIGURES["geomagic_touch"], (-1.0) ** axis
    end = np.append(0.5 * np.array(figures.size), figures.turn)[axis]
    centre = np.append(figures.centre, np.zeros(3))
    push = side * np.array([2.0, 2.0, 2.0, 0.05, 0.05, 0.05]) * np.eye(6)[axis]
    start = np.concatenate([centre, np.zeros(6)])
    after = advance(touch, start, np.zeros(6), push, 3000)
    assert 0.0 < side * (after[axis] - centre[axis]) - end < 0.02
    assert np.abs(after[6:]).max() < 0.05
    back = after.copy()
    back[6 + axis] = -side * 10.0  # out of the stop: the stop exerts no force
    slower = advance(touch, back, np.zeros(6), np.zeros(6), 1, period=1e-6)
    assert side * (slower[6 + axis] - back[6 + axis]) > 0.0 or axis > 2
    with pytest.raises(DrakeTeleopError, match=r"workspace is 0\.235 to 0\.305"):
        MasterDevice(PERIOD, touch, centre + 1.01 * side * end * np.eye(6)[axis])


def test_end_of_workspace_is_reported_and_start_beyond_rejected():
    fixed, omega = device("omega_3"), device("omega_6")
    inside = np.array([0.27, 0.0, 0.03, 0.0, 0.0, 0.0])
    turned, aside = inside + 2.9 * np.eye(6)[5], inside + 0.06 * np.eye(6)[1]
    # An axis without rotation is always at its end, which is not reported.
    wobbling = inside + 1e-3 * np.eye(6)[5]
    for model, ends in ((fixed, [False, False, True]), (omega, [False, False, True])):
        np.testing.assert_array_equal(
            model.flag_samples_at_end_stop(np.array([inside, wobbling, aside])), ends
        )
    np.testing.assert_array_equal(omega.flag_samples_at_end_stop(np.array([turned])), [True])
    for pose in (aside, turned):
        with pytest.raises(DrakeTeleopError, match="the device's workspace is"):
            omega.inverse_kinematics(omega.forward_kinematics(pose))


def test_unactuated_axes_display_zero():
    for model, force, torque in (("geomagic_touch", 3.3, 0.0), ("virtuose_6d", 35.0, 3.1)):
        numbers, q = device(model).packed_parameters, np.array([0.27, 0.0, 0.03, 0.0, 0.0, 0.0])
        start, drive = initial_display_state(q, numbers[0]), np.empty(27)
        step_display(np.full(6, 100.0), start, numbers, PERIOD, np.empty((6, 6)), drive)
        assert np.linalg.norm(drive[12:15]) == pytest.approx(force, rel=1e-12)
        np.testing.assert_allclose(drive[15:18], torque, rtol=1e-12)
        np.testing.assert_allclose(drive[:6], drive[12:18], atol=1e-12)  # no weight to hold


def test_file_selects_device_and_overrides_figures():
    scenario = ScenarioFromData(
        {"master": {"model": "omega_3", "figures": {"friction": 0.1}}}, "mine.yaml"
    )
    expected = dataclasses.replace(FIGURES["omega_3"], friction=0.1)
    assert scenario.master.figures == expected
    named = ScenarioFromData({"master": {"model": "falcon"}}, "mine.yaml")
    other = replace(named, master__model="omega_7")  # its data sheet, not the falcon's
    for scenario, model in ((named, "falcon"), (other, "omega_7")):
        devices = scenario.master.device(*HAND), Master(model=model).device(*HAND)
        np.testing.assert_array_equal(*(each.packed_parameters for each in devices))
    for block, where in (
        ({"figures": {"friction": 0.1}}, "figures"),
        ({"model": "falcon", "friction": {"coulomb": [0.1] * 6}}, "friction"),
        ({"model": "custom", "figures": {"turn": [0.1, 1.55, 0.1]}}, "figures.turn"),
        ({"model": "omega_5"}, "model"),
        ({"model": "omega_6", "figures": {"apparent_mass": 0.0}}, "figures.apparent_mass"),
    ):
        with pytest.raises(DrakeTeleopError, match=rf"mine\.yaml:master\.{where}"):
            ScenarioFromData({"master": block}, "mine.yaml")
    with pytest.raises(
        DrakeTeleopError, match=r"master\.figures.*friction stops the haptic device"
    ):
        MasterDevice(PERIOD, device(friction=50.0), np.array([0.27, 0.0, 0.03, 0.0, 0.0, 0.0]))
    assert PhantomJointFriction() == Master().friction


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("model", ["geomagic_touch", "omega_6"])
def test_station_force_is_within_the_device_limits(model):
    """The paper's contact scenario with another device."""
    paper = LoadScenario("contact_transition")
    scenario = replace(
        paper, master=Master(model=model), simulation__duration=0.6, force_scaling__sigma=1.0
    )
    result = simulate(MakeTeleopStation(scenario), scenario.simulation, progress=False)
    force = np.linalg.norm(result["force_to_master"][:, :3], axis=1)
    peak = FIGURES[model].peak_force
    assert np.isfinite(result["pose_master"]).all()
    assert force.max() <= peak * (1 + 1e-12)
    np.testing.assert_array_equal(result["force_to_master"][:, 3:], 0.0)
    moved = result["pose_master"][:, 4:] - result["pose_master"][0, 4:]
    assert np.abs(moved).max() > 0.01


def test_encoders_count_whole_steps_from_the_start():
    """Motion below half a step is not visible."""
    omega, steps = device(), np.repeat([1e-3, 0.01], 3)
    pose = np.empty(7)
    for away, counts in ((0.4, 0.0), (0.6, 1.0), (-2.3, -2.0)):
        encoder_pose_into(Q + away * steps, Q, steps, omega.packed_parameters, pose)
        np.testing.assert_allclose(pose, omega.forward_kinematics(Q + counts * steps), atol=1e-12)
    encoder_pose_into(Q + V, Q, np.zeros(6), omega.packed_parameters, pose)
    np.testing.assert_allclose(pose, omega.forward_kinematics(Q + V), atol=1e-12)


@pytest.mark.parametrize("model", FIGURES)
def test_device_without_dry_friction_has_no_encoder_steps(model):
    master = Master(model=model).without_coulomb_friction_and_encoder_steps()
    assert not master.encoder_steps().any()
    assert not master.device(0.0, 0.0).parameters.dry_friction.any()
    assert master.device(0.0, 0.0).parameters.damping.all()


def test_slow_device_holds_reading_and_force_at_its_rate():
    """Command and force are held for 2 ms, but not the pose of the hand."""
    slow = dataclasses.replace(FIGURES["falcon"], rate_hz=500.0)
    move = Sine(duration=10.0, ramp=0.05, frequency=3.0, translation=[0.01, 0.01, 0.02])
    scenario = replace(
        LoadScenario("free_motion_force"),
        master=Master(model="falcon", figures=slow),
        operator__intent=[move],
        rates__log_hz=2000.0,
        simulation__settle=0.1,
        simulation__duration=0.04,
        force_scaling__sigma=1.0,
    )
    assert scenario.master.sampling_period_if_slower_than_hand(2000.0) == 2e-3
    assert scenario.master.sampling_period_if_slower_than_hand(500.0) is None
    result = simulate(MakeTeleopStation(scenario), scenario.simulation, progress=False)
    for values in (result["pose_command"][:, 4:], result["force_to_master"][:, :3]):
        changes = np.flatnonzero(np.diff(values, axis=0).any(axis=1))
        assert len(changes) > 10
        assert len(np.unique(changes % 4)) == 1
    assert np.diff(result["pose_master"][:, 4:], axis=0).any(axis=1).all()
    moved = result["pose_command"][:, 4:] - scenario.slave.position
    counts = moved / scenario.kinematic_scaling.translation_scale / slow.resolution
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
