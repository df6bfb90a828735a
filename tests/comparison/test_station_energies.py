"""Energy balances of a station, from constructed logs and one run."""

from __future__ import annotations

from dataclasses import replace as replace_fields

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.comparison.one_dof import AT_HAND, AT_MOTOR, AT_SLAVE
from drake_teleop.lab.comparison.whole_station import (
    start_energy,
    station_energies,
    work_of_displayed_load_wrench,
)
from drake_teleop.lab.identification import slave_arm, true_load
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.operator.operator import MinimumJerk
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig
from drake_teleop.station.scaling.kinematic_scaling import KinematicScalingConfig
from drake_teleop.station.scenario import LoadScenario, Rates, Scenario, Simulation, replace
from drake_teleop.station.signals import SIGNALS
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import jacobian, pose_into, sensor_motion
from drake_teleop.station.station import MakeTeleopStation

SCENARIO = replace(
    Scenario(),
    rates=Rates(log_hz=1000.0),
    force_scaling=ForceScalingConfig(sigma=0.0, gamma=0.5, force_scale=0.1),
    kinematic_scaling=KinematicScalingConfig(2.0, 0.25),
)


def logged(wrench_at_S) -> tuple[SimulationResult, np.ndarray]:
    """Return a log of 21 rows with moving joints, and X_WS; the wrench is a function of p_WS."""
    t, arm = np.arange(21) * 1e-3, slave_arm(SCENARIO)
    q = np.array([0.1, -0.4, 0.9, 0.2, 0.7, -0.3]) + 4.0 * t[:, np.newaxis] * np.arange(1, 7)
    poses = np.empty((len(t), 7))
    for k in range(len(t)):
        pose_into(arm.table, q[k], poses[k])
    wrench = np.array([wrench_at_S(pose[4:]) for pose in poses])
    wrench[:, 3:] += np.cross(poses[:, 4:], wrench[:, :3])  # about the world's origin
    signals = {
        "slave_state": np.hstack([q, np.zeros_like(q)]),
        "joint_torque": np.zeros_like(q),
        "true_contact_wrench_W": wrench,
        "ports": np.outer(np.arange(21.0), np.arange(1, 9)),
    }
    return SimulationResult(t, signals, [SIGNALS[name] for name in signals]), poses


def test_spring_at_the_tool_returns_its_energy():
    middle, stiffness = np.array([0.1, 0.2, 0.3]), np.diag([1e3, 2e3, 4e3])
    result, poses = logged(lambda p: np.hstack([-stiffness @ (p - middle), np.zeros(3)]))
    offset = poses[:, 4:] - middle
    stored = 0.5 * np.einsum("ni,ij,nj->n", offset, stiffness, offset)
    actual = station_energies(result, SCENARIO)[:, AT_SLAVE]
    # Force scale times gamma over the scale of translation.
    np.testing.assert_allclose(actual[:, 0], 0.1 * 0.5 / 2.0 * (stored[0] - stored), atol=1e-12)
    assert np.ptp(actual[:, 0]) > 0.1
    np.testing.assert_allclose(actual[:, 1], 0.0, atol=1e-12)


def test_torque_at_the_tool_works_only_along_rotation():
    result, _ = logged(lambda p: np.array([0.0, 0.0, 0.0, 0.3, -0.2, 0.1]))
    energies = station_energies(result, SCENARIO)
    np.testing.assert_allclose(energies[:, AT_SLAVE, 0], 0.0, atol=1e-12)
    assert abs(energies[-1, AT_SLAVE, 1]) > 1e-3
    # The channel's sum of one period (0.5 ms) ago, relative to the first row.
    np.testing.assert_allclose(energies[:-1, AT_HAND, 1], 2.0 * np.arange(20.0), atol=1e-9)
    assert np.isnan(energies[:, AT_MOTOR]).all()


GRIPPER = np.array([1.2, 0.01, -0.02, 0.06, 0.008, 1e-4, -2e-4, 0.009, 3e-4, 0.005])


@pytest.mark.slow
@pytest.mark.parametrize(
    "scales",
    [
        {"sigma": 0.5},
        {"sigma_weight": 0.7, "sigma_inertia": 0.3},
        {"sigma": 0.0, "gamma": 1.0, "eta": 0.4, "gripper_phi": GRIPPER.tolist()},
    ],
)
def test_load_work_equals_potential_and_kinetic_energy(scales):
    """A share of T and U by mass, m c and inertia about So is displayed, of all or an object."""
    t, config = np.arange(400) * 1e-3, replace_fields(SCENARIO.force_scaling, **scales)
    scenario = replace(SCENARIO, force_scaling=config)
    scenario = replace(scenario, kinematic_scaling=KinematicScalingConfig(2.0, 2.0))
    arm, rates = slave_arm(scenario), np.arange(1, 7)
    q = np.array([0.1, -0.4, 0.9, 0.2, 0.7, -0.3]) + 0.1 * np.sin(np.outer(t, 2 * rates))
    v = 0.2 * rates * np.cos(np.outer(t, 2 * rates))
    result = SimulationResult(t, {"slave_state": np.hstack([q, v])}, [SIGNALS["slave_state"]])
    phi = arm.phi_load - (GRIPPER if config.eta else 0.0)
    m, mc, (xx, xy, xz, yy, yz, zz) = phi[0], phi[1:4], phi[4:]
    inertia, energy, x = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), [], np.empty(21)
    kept, carried = config.scales().load_scales[1::2]
    J = np.empty((6, 6))
    for k in range(len(t)):
        sensor_motion(arm.table, q[k], v[k], np.zeros(6), x)
        jacobian(arm.table, q[k], J)
        R_WS, omega, at_So = x[12:].reshape(3, 3), x[3:6], J[:3] @ v[k]
        moving = 0.5 * m * at_So @ at_So + 0.5 * omega @ inertia @ omega
        moving += (R_WS.T @ at_So) @ np.cross(omega, mc)
        energy.append(kept * moving + carried * 9.81 * (m * x[11] + (R_WS @ mc)[2]))
    given = work_of_displayed_load_wrench(result, scenario)
    expected = -0.1 / 2.0 * (np.array(energy) - energy[0])
    np.testing.assert_allclose(given.sum(axis=1), expected, atol=3e-5)
    assert np.ptp(expected) > 0.01 and np.ptp(given[:, 1]) > 1e-3


def test_start_energy_is_the_sum_of_both_ends():
    scenario = replace(SCENARIO, passivity=PassivityConfig(method="two_layer"))
    np.testing.assert_allclose(
        start_energy(scenario), 2 * np.array(scenario.passivity.two_layer.initial)
    )
    np.testing.assert_array_equal(start_energy(SCENARIO), 0.0)


def test_station_without_channel_raises():
    result, _ = logged(lambda p: np.zeros(6))
    kept = [name for name in result if name != "ports"]
    less = SimulationResult(result.t, {n: result[n] for n in kept}, [SIGNALS[n] for n in kept])
    with pytest.raises(
        DrakeTeleopError, match=r"result: .*lacks the signals .*ports, which .*; run a station with"
    ):
        station_energies(less, SCENARIO)


@pytest.mark.parametrize("sigma", [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_station_with_ledger_creates_no_energy(sigma):
    """A hand hits a leaf over a lossy network with 50 ms of delay.

    `none` creates 0.45 J at hand and leaf and, by rotation, 0.30 J. The energy of the displayed
    load is part of the balance.
    """
    strike = MinimumJerk(t_start=0.3, duration=0.25, translation=[0.0, 0.0, -0.08])
    scenario = replace(
        LoadScenario("contact_transition"),
        simulation=Simulation(duration=0.9, settle=0.0),
        rates=Rates(sensor_hz=2000.0, hand_hz=1000.0, joint_control_hz=1000.0, log_hz=1000.0),
        channel=Channel(network="internet"),
        passivity=PassivityConfig(method="ledger"),
        sheet_spring__position=[0.55, 0.0, 0.235],
        operator__intent=[strike],
        force_scaling__sigma=sigma,
    )
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    result = simulate(station, scenario.simulation, progress=False)
    assert np.abs(result["true_contact_wrench_W"][:, 2]).max() > 30.0, "it should have struck"
    energies = (
        station_energies(result, scenario)
        + sigma * work_of_displayed_load_wrench(result, scenario)[:, None]
    )
    for place in (AT_SLAVE, AT_MOTOR) if sigma == 0.0 else (AT_SLAVE,):
        created = energies[:, AT_HAND] + energies[:, place] + start_energy(scenario)
        assert (created.min(axis=0) >= -1e-6).all()
