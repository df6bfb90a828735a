"""Dry joint friction: in the plant and the compiled dynamics, but in no controller."""

import re

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.slave.arm import (
    ARM_FRICTION_TANH_SPEED_SI,
    forward_dynamics,
    inverse_dynamics,
)
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.slave.plant import AddSlavePlant, NominalSlave
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.slave_side import MakeSlaveSide
from drake_teleop.station.station import MakeTeleopStation

FRICTION = [11.1, 16.7, 7.0, 0.84, 0.9, 0.28]  # N m, about 30 N at the tool


class Arm:
    """Plant alone, with constant motor torques."""

    def __init__(self, friction):
        builder = DiagramBuilder()
        self.slave = AddSlavePlant(builder, Slave(friction=friction), None)
        self.plant = self.slave.plant
        self.simulator = Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        self.simulator.get_mutable_integrator().set_target_accuracy(1e-9)

    def put(self, q, v, torque):
        self.plant.get_actuation_input_port().FixValue(self.context, torque)
        self.plant.SetPositionsAndVelocities(self.context, np.concatenate([q, v]))

    def acceleration(self):
        port = self.plant.get_generalized_acceleration_output_port()
        return port.Eval(self.context).copy()

    def state(self):
        return np.split(self.plant.GetPositionsAndVelocities(self.context).copy(), 2)

    def energy(self):
        kinetic = self.plant.CalcKineticEnergy(self.context)
        return kinetic + self.plant.CalcPotentialEnergy(self.context)


@pytest.fixture(scope="module")
def arm():
    return Arm(FRICTION)


@pytest.mark.parametrize("speed", [0.3 * ARM_FRICTION_TANH_SPEED_SI, 0.4])
def test_friction_is_in_dynamics_but_not_in_computed_torque(arm, speed):
    """Computed torque does not compensate the friction."""
    random, table = np.random.default_rng(3), arm.slave.arm.table
    torque, compiled = np.empty(6), np.empty(6)
    for _ in range(10):
        q = arm.slave.start + 0.3 * random.normal(size=6)
        v, wanted = speed * random.normal(size=6), random.normal(size=6)
        inverse_dynamics(table, q, v, wanted, torque)
        arm.put(q, v, torque)
        forward_dynamics(arm.slave.compiled_constants[0], q, v, torque, np.zeros(6), compiled)
        found = arm.acceleration()
        np.testing.assert_allclose(compiled, found, atol=1e-11 * np.abs(found).max())
        missing = np.empty(6)
        inverse_dynamics(table, q, v, found, missing)
        slip = -np.array(FRICTION) * np.tanh(v / 2e-3)
        np.testing.assert_allclose(missing - torque, slip, atol=1e-10)


def test_motor_balances_friction_at_constant_speed(arm):
    q, v, torque = arm.slave.start, np.array([0.1, -0.1, 0.1, -0.1, 0.1, -0.1]), np.empty(6)
    inverse_dynamics(arm.slave.arm.table, q, v, np.zeros(6), torque)
    arm.put(q, v, torque + np.sign(v) * FRICTION)
    np.testing.assert_allclose(arm.acceleration(), 0.0, atol=1e-9)


def test_joint_creeps_below_friction_torque(arm):
    weight, share = np.empty(6), np.array([0.5, -0.5, 0.9, 0.2, 0.0, -0.7])
    still = np.zeros(6)
    inverse_dynamics(arm.slave.arm.table, arm.slave.start, still, still, weight)
    arm.put(arm.slave.start, still, weight + share * FRICTION)
    arm.simulator.get_mutable_context().SetTime(0.0)
    arm.simulator.Initialize()
    arm.simulator.AdvanceTo(0.1)
    q, v = arm.state()
    # Gravity's torque changes during the motion, by N m a rad.
    np.testing.assert_allclose(v, 2e-3 * np.arctanh(share), atol=3e-5)
    assert (np.abs(q - arm.slave.start) <= 0.1 * 2e-3 * np.arctanh(np.abs(share)) + 1e-5).all()


def test_friction_only_dissipates(arm):
    """An arm swings without torque; the lost energy equals the friction's work."""
    v = np.array([1.0, -0.8, 0.9, -2.0, 1.5, 3.0])
    arm.put(arm.slave.start, v, np.zeros(6))
    arm.simulator.get_mutable_context().SetTime(0.0)
    arm.simulator.Initialize()
    times = np.arange(1, 101) * 1e-3
    energies, powers = [arm.energy()], [-np.abs(v) @ FRICTION]
    for time in times:
        arm.simulator.AdvanceTo(time)
        powers.append(-np.array(FRICTION) * np.tanh(arm.state()[1] / 2e-3) @ arm.state()[1])
        energies.append(arm.energy())
    assert (np.diff(energies) < 0.0).all()
    lost = np.trapezoid(powers, dx=1e-3)
    assert lost < -3.0  # J
    assert energies[-1] - energies[0] == pytest.approx(lost, rel=1e-3)


def test_one_friction_value_applies_to_all_joints():
    for friction, expected in (([2.0], 6 * [2.0]), ([], 6 * [0.0])):
        builder = DiagramBuilder()
        slave = AddSlavePlant(builder, Slave(friction=friction), None)
        np.testing.assert_array_equal(slave.compiled_constants[0][:-1, 24], expected)
        assert len(builder.GetSystems()) == (2 if friction else 1)


@pytest.mark.parametrize(
    ("friction", "expected"),
    [
        ([1.0, 2.0], "slave.friction: has 2 numbers, but the arm has 6 joints"),
        ([-1.0], "slave.friction: -1 N m, N is outside 0 to 1e[+]06 N m, N"),
        ([float("nan")], "slave.friction: nan N m, N is outside 0 to 1e[+]06 N m, N"),
        ([4.0], "slave.friction: the friction stops a joint within 0.0.. ms, too fast for steps"),
    ],
)
def test_invalid_friction_raises_one_line(friction, expected):
    scenario = LoadScenario("free_motion_force")
    with pytest.raises(DrakeTeleopError, match=expected):
        MakeTeleopStation(replace(scenario, slave__friction=friction, force_scaling__sigma=1.0))


@pytest.mark.parametrize(
    ("rate", "max_step", "step"),
    [(2000.0, 1e-3, 5e-4), (500.0, 1e-3, 1e-3), (500.0, 2e-4, 2e-4)],
)
def test_friction_may_stop_a_joint_within_half_of_the_shorter_step(rate, max_step, step):
    """Steps end at a change of the torque and are at most `max_step` long."""
    nominal = NominalSlave(Slave())
    slope = np.linalg.inv(mass_matrix(nominal.arm, nominal.start))
    fastest = np.linalg.eigvals(slope).real.max() / ARM_FRICTION_TANH_SPEED_SI
    timing = {"rates__joint_control_hz": rate, "simulation__max_step": max_step}
    largest = 2.0 / (fastest * step)
    MakeSlaveSide(replace(Scenario(), **timing, slave__friction=[0.99 * largest]))
    with pytest.raises(DrakeTeleopError, match=re.escape(f"for steps of {1e3 * step:g} ms")):
        MakeSlaveSide(replace(Scenario(), **timing, slave__friction=[1.01 * largest]))
