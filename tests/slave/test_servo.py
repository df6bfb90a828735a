"""The arm as one servo at the tool: kinetic energy, and the methods that use it."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.station.channel import channel
from drake_teleop.station.channel_side import MakeChannel
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.slave.arm import inverse_dynamics, jacobian
from drake_teleop.station.slave.home import home_posture
from drake_teleop.station.slave.joint_control import operational_inertia, servo_impedance
from drake_teleop.station.slave.plant import NominalSlave

SCENARIO = Scenario()


@pytest.fixture(scope="module")
def arm():
    return NominalSlave(SCENARIO.slave).arm


@pytest.fixture(scope="module")
def home(arm):
    return home_posture(arm, SCENARIO.slave.position)


def test_operational_inertia_gives_kinetic_energy(arm, home):
    """Compare with the mass matrix from the inverse dynamics, column by column."""
    still, weight, J = np.zeros(6), np.empty(6), np.empty((6, 6))
    inverse_dynamics(arm.table, home, still, still, weight)
    mass = np.empty((6, 6))
    for i, column in enumerate(np.eye(6)):
        inverse_dynamics(arm.table, home, still, column, mass[i])
    jacobian(arm.table, home, J)
    found = J.T @ operational_inertia(arm, home) @ J
    np.testing.assert_allclose(found, mass - weight, rtol=1e-9, atol=1e-9)


def test_mass_bounds_kinetic_energy(arm, home):
    """One motion reaches the bound."""
    config = SCENARIO.joint_control
    stiffness, damping, mass = servo_impedance(arm, home, config)
    bound = np.diag(np.repeat(mass, 3))
    spare = np.linalg.eigvalsh(bound - operational_inertia(arm, home))
    assert spare[0] == pytest.approx(0.0, abs=1e-9) and mass[0] < 1e2
    kp, kv = 2 * np.pi * config.position_bandwidth_hz, 2 * np.pi * config.velocity_bandwidth_hz
    np.testing.assert_allclose(np.divide(stiffness, mass), kp * kv)
    np.testing.assert_allclose(np.divide(damping, mass), kv)


def test_ledger_uses_arm_mass_by_default(arm, home, monkeypatch):
    told, parameters = [], channel.methods.method_parameters
    monkeypatch.setattr(
        channel.methods,
        "method_parameters",
        lambda config, *more: told.append(config) or parameters(config, *more),
    )
    for passivity in (
        PassivityConfig(method="ledger"),
        PassivityConfig(method="ledger", slave_mass=[20.0, 0.5]),
        PassivityConfig(method="pspm"),
    ):
        MakeChannel(replace(SCENARIO, passivity=passivity))
    expected = servo_impedance(arm, home, SCENARIO.joint_control)
    assert (told[0].servo_stiffness, told[0].servo_damping, told[0].slave_mass) == expected
    assert told[1].slave_mass == [20.0, 0.5] and told[2].slave_mass is None
    assert told[1].servo_stiffness == told[2].servo_stiffness == PassivityConfig().servo_stiffness
