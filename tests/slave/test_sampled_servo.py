"""Joint control sampled inside the step, against one event per sample."""

import numpy as np
import pytest
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.joint_control import (
    JointControl,
    JointControlConfig,
    computed_torque_into,
    servo_gains_and_limits,
)
from drake_teleop.station.slave.plant import AddSlavePlant, start_pose
from drake_teleop.station.slave.sampled_servo import (
    SampledServo,
    predict_torque_ramp,
    servo_samples_per_event,
)
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.station import MakeTeleopStation

CONFIG = JointControlConfig()


def positions_after_step(samples, hz, wall=None):
    """Return the joint positions 20 ms after a command step, with one event per `samples`."""
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, Slave(), wall)
    if samples > 1:
        control = SampledServo(slave, CONFIG, 1 / hz, samples)
    else:
        control = JointControl(slave.arm, CONFIG, 1 / hz, slave.start)
    builder.AddSystem(control)
    command = builder.AddSystem(
        ConstantVectorSource(slave.start + np.array([3, 20, -10, 20, 10, -20]) / 1e3)
    )
    builder.Connect(command.get_output_port(), control.GetInputPort("joint_command"))
    state = slave.plant.get_state_output_port(slave.instance)
    builder.Connect(state, control.GetInputPort("slave_state"))
    torque = control.GetOutputPort("joint_torque")
    builder.Connect(torque, slave.plant.get_actuation_input_port(slave.instance))
    simulator = Simulator(builder.Build())
    ResetIntegratorFromFlags(simulator, "runge_kutta3", 1e-3)
    simulator.get_mutable_integrator().set_target_accuracy(1e-6)
    simulator.AdvanceTo(0.02)
    context = slave.plant.GetMyContextFromRoot(simulator.get_context())
    return slave.plant.GetPositions(context, slave.instance)


@pytest.mark.slow
@pytest.mark.parametrize(
    # The second pushes the tool, which is 3 mm in it, with 60 N.
    ("wall", "share"),
    [(None, 0.018), (Wall(position=[0.55, 0.0, 0.253], stiffness=2e4), 0.045)],
)
def test_inner_samples_move_arm_like_events(wall, share):
    honest = positions_after_step(1, 1e4, wall)
    rate = np.abs(positions_after_step(1, 2e3, wall) - honest).max()
    assert rate > 5e-5  # rad, of five times the rate
    assert np.abs(positions_after_step(5, 1e4, wall) - honest).max() < share * rate


class DisplacedMaster(LeafSystem):
    """A master that commands the tool 2 mm to the side."""

    def __init__(self, start):
        super().__init__()
        self.DeclareVectorInputPort("wrench_command", 6)
        pose = start + np.array([0, 0, 0, 0, 0, 0.002, 0])
        self.DeclareVectorOutputPort(
            "pose_command", 7, lambda context, output: output.SetFromVector(pose)
        )


@pytest.mark.slow
def test_sensor_uses_torque_line_inside_step():
    scenario = replace(
        LoadScenario("free_motion_force"),
        rates__joint_control_hz=1e4,
        rates__log_hz=2e3,
        rates__sensor_hz=7e3,  # so that the sample of a row was taken within a step
        wrist_sensor__ideal=True,
        force_scaling__sigma=1.0,
        simulation__settle=0.0,
        simulation__duration=0.01,
    )
    logs = []
    for step in (1e-3, 1.25e-4):
        simulation = replace(scenario, simulation__max_step=step, simulation__accuracy=1e-8)
        master = DisplacedMaster(start_pose(scenario.slave))
        station = MakeTeleopStation(simulation, master=master)
        logs.append(simulate(station, simulation.simulation, progress=False))
    measured = [log["measured_wrench_S"][:, :3] for log in logs]
    assert np.abs(np.diff(measured[1], axis=0)).max() > 0.5  # N, from row to row
    np.testing.assert_allclose(*measured, rtol=0.0, atol=1e-5)


def test_one_sample_equals_joint_control_exactly():
    slave = AddSlavePlant(DiagramBuilder(), Slave(), None)
    n, random = slave.arm.num_joints, np.random.default_rng(0)
    servo, torque = servo_gains_and_limits(slave.arm, CONFIG), np.zeros(6)
    for _ in range(20):
        command = slave.start + random.normal(0.0, 0.05, n)
        state = np.concatenate([slave.start, np.zeros(n)]) + random.normal(0.0, 0.3, 2 * n)
        scratch, line = np.zeros(3 * n), np.zeros(3 * n)
        computed_torque_into(slave.arm.table, command, state, *servo, scratch, torque)
        predict_torque_ramp(
            slave.arm.table, command, state, np.zeros(2), servo, slave.compiled_constants, 1, 5e-4,
            scratch, line,
        )  # fmt: skip
        assert line.tobytes() == np.concatenate([torque, np.zeros(n), torque]).tobytes()


def test_line_stays_within_torque_limits_and_survives_invalid_command():
    slave = AddSlavePlant(DiagramBuilder(), Slave(), None)
    arm, n = slave.arm, slave.arm.num_joints
    servo, rest = servo_gains_and_limits(arm, CONFIG), np.concatenate([slave.start, np.zeros(n)])
    line = np.zeros(3 * n)

    def torques(command):
        predict_torque_ramp(
            arm.table, command, rest, np.zeros(2), servo, slave.compiled_constants, 5, 1e-4,
            np.zeros(3 * n), line,
        )  # fmt: skip
        return line[:n], line[:n] + 5e-4 * line[n : 2 * n], line[2 * n :].copy()

    clipped = 0
    for far in np.linspace(0.001, 0.1, 40):
        start, end, last = torques(slave.start + far)
        largest = np.maximum(np.abs(start), np.abs(end)) / arm.effort_limit
        assert (largest <= 1 + 1e-12).all()
        clipped += ((largest > 1 - 1e-12) & (line[n : 2 * n] != 0.0)).sum()
    assert clipped > 0
    start, end, _ = torques(np.full(n, np.nan))
    np.testing.assert_allclose(start, last, rtol=1e-14)
    np.testing.assert_allclose(end, last, rtol=1e-14)


@pytest.mark.parametrize(
    ("control", "hand", "samples"),
    [(2e3, 2e3, 1), (1e4, 2e3, 5), (1e4, 1e3, 5), (4e3, 500.0, 2), (2e3, 1e3, 1), (1e4, 3e3, 1)],
)
def test_events_at_2_khz_or_more_include_each_hand_sample(control, hand, samples):
    assert servo_samples_per_event(control, hand) == samples
