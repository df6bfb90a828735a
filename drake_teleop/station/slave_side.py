"""Slave side of the station: arm, inverse kinematics, wrist sensor, compensation of the load."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem, OutputPort, System

from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.numeric import Array, check_load_not_all_zero, finite_array
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.estimation.contact_detection import ContactDetection
from drake_teleop.station.estimation.load_estimator import LoadEstimator
from drake_teleop.station.scaling.force_scaling import MAX_SAMPLE_AGE_S, ForceScaling
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.sensor.motion_estimation import estimated_motion_std
from drake_teleop.station.sensor.wrist_sensor import AddCompiledWristSensor
from drake_teleop.station.signals import MOVING_BODY_POSE_PREFIX
from drake_teleop.station.slave import joint_commands
from drake_teleop.station.slave.arm import ARM_FRICTION_TANH_SPEED_SI, ForwardKinematics
from drake_teleop.station.slave.joint_control import HeldTorque, JointControl, mass_matrix
from drake_teleop.station.slave.plant import AddSlavePlant, SlavePlant
from drake_teleop.station.slave.plant_dynamics import DrakeContact, ToolContact
from drake_teleop.station.slave.sampled_servo import SampledServo, servo_samples_per_event
from drake_teleop.station.slave.surroundings import MovingBodyPose
from drake_teleop.station.wiring import connect_matching_inputs, connect_ports, export_outputs

#: Sampling period of the monitor [s]; 2 kHz events would cost time.
RANGE_MONITOR_PERIOD_S = 0.01
# Stability limit of explicit steps for a decay, such as of speed by friction: rate times step.
_MAX_DECAY_RATE_TIMES_STEP = 2.0


def MakeSlaveSide(
    scenario: Scenario,
    *,
    load_estimate: Array | None = None,
    load_covariance: Array | None = None,
    noise_floor: NoiseFloor | None = None,
    controller: System | None = None,
) -> Diagram:
    """Build the slave side: joint control, arm, wrist sensor, load estimator, force scaling.

    .. pydrake_system::

        name: slave_side
        input_ports:
        - pose_command: (7,) X_WS, setpoint; or leader_joints: (n,) [rad] (leader arm in joint mode)
        output_ports:
        - wrench_B: (6,) F_E_B, wrench to render, in the master's base [N, N m]; NaN during a fault
        - load_wrench_B: (6,) part of wrench_B from weight and inertia of the load
        - pose_slave: (7,) actual X_WS of the present joint angles (over a network)
        - saturated: (1,) above 0.5 while the wrench is invalid; also a signal
        - contact: (1,) 1 in contact; also a signal (with contact detection)
        - the sensor's signals such as measured_wrench_S, slave_state, joint_torque,
          joint_command, ik_status, scaled_wrench_S, fault: signals
        - load_estimate, contact_wrench_S (if the load is identified or estimated online): signals
        - load_state (if the load is monitored), true_contact_wrench_W (with surroundings),
          sheet_state (with a sheet spring), pose_of_NAME (of each moving body of the
          surroundings): signals
        - sample, scaled_contact_and_fault: several of these signals in one port, for the log

    Args:
        load_estimate: (16,) Eq. (7), [offsets; phi], and `load_covariance` (16, 16) of it.
        noise_floor: of `identify_load`, for contact detection.
        controller: custom control law of the arm (docs/station.md, "A controller of your own").
            Its output `joint_torque` (n) [N m] replaces inverse kinematics and joint control, or
            its output `pose_command` (7) is their setpoint. It requires the input `pose_command`
            (7); inputs `slave_state` (2 n), `pose_slave` (7), `contact_wrench_S` (6) and of the
            sensor's signals are optional.

    Raises:
        DrakeTeleopError: for an unreachable start, or if load estimate or noise floor is required.
    """
    check_scenario(scenario)
    torques = _is_torque_controller(controller, scenario)
    uses_contact = controller is not None and controller.HasInputPort("contact_wrench_S")
    _check_load_estimate(scenario, load_estimate, uses_contact)
    if load_covariance is not None:
        finite_array("load_covariance", load_covariance, 16, 16)
        expect_type((list, tuple, np.ndarray), load_estimate, "load_estimate", "pass both")
    builder = DiagramBuilder()
    slave, sample, held = _add_slave_blocks(
        builder, scenario, load_estimate, load_covariance, custom_torque=torques
    )
    arm, joint_control = slave.arm, builder.GetSubsystemByName("joint_control")
    if controller is not None:
        builder.AddNamedSystem("controller", controller)
        builder.ExportInput(controller.GetInputPort("pose_command"), "pose_command")
    if torques:
        connect_ports(builder, controller, "joint_torque", joint_control, "requested_torque")
    else:
        follows_leader = scenario.master.is_joint_leader
        name = joint_commands.pick_ik_method(scenario.slave.inverse_kinematics, arm)
        make_ik = joint_commands.IK_METHODS[name]
        if follows_leader:
            make_ik = joint_commands.LeaderJointFollower
        ik = builder.AddNamedSystem("inverse_kinematics", make_ik(arm, slave.start, held))
        connect_matching_inputs(builder, ik, {"joint_position": sample["joint_position"]})
        connect_ports(builder, ik, "joint_command", joint_control, "joint_command")
        monitor = builder.GetSubsystemByName("monitor")
        connect_ports(builder, ik, "ik_status", monitor, "ik_status")
        export_outputs(builder, ik, "joint_command")
        export_outputs(builder, monitor, "ik_status")
        setpoint = "leader_joints" if follows_leader else "pose_command"
        if controller is None:
            builder.ExportInput(ik.GetInputPort(setpoint), setpoint)
        else:
            connect_ports(builder, controller, "pose_command", ik, "pose_command")

    R_WB = scenario.kinematic_scaling.R_WB
    largest = scenario.wrist_sensor.largest_plausible_wrench()
    max_age_s = max(MAX_SAMPLE_AGE_S, 2 / scenario.rates.sensor_hz)
    scaling = ForceScaling(scenario.force_scaling, arm, R_WB, largest, max_age_s)
    force_scaling = builder.AddNamedSystem("force_scaling", scaling)
    load_estimator = builder.GetSubsystemByName("load_estimator")
    sources = sample | {"load_estimate": load_estimator.GetOutputPort("load_estimate")}
    connect_matching_inputs(builder, force_scaling, sources)
    export_outputs(builder, force_scaling, "wrench_B", "load_wrench_B", "scaled_wrench_S", "fault")
    if _has_load_estimate(scenario, load_estimate):
        export_outputs(builder, force_scaling, "contact_wrench_S", "scaled_contact_and_fault")

    kinematics = builder.AddNamedSystem("forward_kinematics", ForwardKinematics(arm))
    connect_matching_inputs(builder, kinematics, slave.ports)
    export_outputs(builder, kinematics, "pose_slave")
    if controller is not None:
        inputs = sample | {
            "slave_state": slave.ports["slave_state"],
            "pose_slave": kinematics.GetOutputPort("pose_slave"),
            "contact_wrench_S": force_scaling.GetOutputPort("contact_wrench_S"),
        }
        connect_matching_inputs(builder, controller, inputs)

    if scenario.contact_detection is not None:
        if noise_floor is None:
            remedy = "pass noise_floor=identify_load(...).noise_floor"
            what = "contact detection requires a noise floor"
            raise DrakeTeleopError(what, where="contact_detection", remedy=remedy)
        expect_type(NoiseFloor, noise_floor, "noise_floor", "pass that of identify_load")
        period = 1 / scenario.rates.estimator_hz
        detection = ContactDetection(scenario.contact_detection, noise_floor, arm, period)
        builder.AddNamedSystem("contact_detection", detection)
        connect_matching_inputs(builder, detection, sources)
        export_outputs(builder, detection, "contact")
    return builder.Build()


def _is_torque_controller(controller: System | None, scenario: Scenario) -> bool:
    if controller is None:
        return False
    expect_type(System, controller, "controller", "make a Drake system: docs/station.md")
    torques: bool = controller.HasOutputPort("joint_torque")
    what = ""
    if not controller.HasInputPort("pose_command"):
        what = "the custom controller has no input port 'pose_command'"
    elif not (torques or controller.HasOutputPort("pose_command")):
        what = "the custom controller has no output port 'joint_torque' or 'pose_command'"
    if what:
        remedy = "docs/station.md lists its ports"
        raise DrakeTeleopError(what, where="controller", remedy=remedy)
    scenario.master.check_pose_mode("a custom controller")
    return torques


def MakeSlaveOnTrajectory(scenario: Scenario, trajectory: FourierTrajectory) -> Diagram:
    """Build the slave side without master: its joints follow an excitation trajectory.

    `trajectory` runs once after the settling time. Output ports are those of `MakeSlaveSide` that
    need neither a pose command nor force scaling.
    """
    builder = DiagramBuilder()
    start, _, _ = trajectory.evaluate(0.0)
    _add_slave_blocks(builder, scenario, q_start=start)
    command = joint_commands.ExcitationCommand(trajectory, scenario.simulation.settle)
    builder.AddNamedSystem("joint_trajectory", command)
    joint_control = builder.GetSubsystemByName("joint_control")
    connect_ports(builder, command, "joint_command", joint_control, "joint_command")
    export_outputs(builder, command, "joint_command")
    return builder.Build()


def _add_slave_blocks(
    builder: DiagramBuilder,
    scenario: Scenario,
    load_estimate: Array | None = None,
    load_covariance: Array | None = None,
    q_start: Array | None = None,
    *,
    custom_torque: bool = False,
) -> tuple[SlavePlant, dict[str, OutputPort], float]:
    """Add the blocks; return plant, sensor ports by signal, and hold time of the torque [s]."""
    rates, sensor = scenario.rates, scenario.wrist_sensor
    slave = AddSlavePlant(builder, scenario.slave, scenario.surroundings, q_start)
    arm, plant, start, ports = slave.arm, slave.plant, slave.start, slave.ports
    builder.ExportOutput(ports["slave_state"], "slave_state")

    own_servo = q_start is None and not custom_torque
    samples = _servo_samples_per_event(scenario, slave) if own_servo else 1
    period = 1 / rates.joint_control_hz
    if custom_torque:
        servo: LeafSystem = HeldTorque(arm, period, start)
    elif samples > 1:
        servo = SampledServo(slave, scenario.joint_control, period, samples)
    else:
        servo = JointControl(arm, scenario.joint_control, period, start)
    control = builder.AddNamedSystem("joint_control", servo)
    held = samples / rates.joint_control_hz
    _check_friction_time_step(slave, min(held, scenario.simulation.max_step))
    connect_matching_inputs(builder, control, ports)
    names = [name for name in ("joint_torque", "torque_rate") if control.HasOutputPort(name)]
    torque = {name: control.GetOutputPort(name) for name in names}
    builder.Connect(torque["joint_torque"], plant.get_actuation_input_port(slave.instance))
    export_outputs(builder, control, "joint_torque")

    range_monitor = joint_commands.JointRangeMonitor(arm, RANGE_MONITOR_PERIOD_S)
    monitor = builder.AddNamedSystem("monitor", range_monitor)
    connect_matching_inputs(builder, monitor, ports)

    motion, sensor_period = scenario.motion_estimation, 1 / rates.sensor_hz
    sample = AddCompiledWristSensor(builder, slave, sensor, motion, sensor_period, held, torque)
    for name, port in sample.items():
        builder.ExportOutput(port, name)

    motion_std = estimated_motion_std(motion, sensor, arm.num_joints, sensor_period)
    sampling = 1 / rates.estimator_hz, sample["sample"].size()
    initial = np.zeros(16) if load_estimate is None else load_estimate, load_covariance
    config, gripper = scenario.load_estimator, scenario.force_scaling.gripper_phi
    noise = sensor.wrench_std(), motion_std
    estimator = LoadEstimator(config, *noise, *sampling, *initial, gripper)
    builder.AddNamedSystem("load_estimator", estimator)
    # At 8 kHz even an unused connection costs time.
    if scenario.load_estimator.enabled or scenario.load_estimator.watch:
        builder.Connect(sample["sample"], estimator.GetInputPort("sample"))
    if _has_load_estimate(scenario, load_estimate):
        export_outputs(builder, estimator, "load_estimate")
    if scenario.load_estimator.watch:
        export_outputs(builder, estimator, "load_state")

    if slave.can_tool_touch:
        _add_contact_and_moving_body_poses(builder, slave)
    return slave, sample, held


def _servo_samples_per_event(scenario: Scenario, slave: SlavePlant) -> int:
    contact, interface = slave.contact, scenario.joint_control.position_interface
    if contact.drake_contact_reason or contact.plant_state_size or interface is not None:
        return 1
    return servo_samples_per_event(scenario.rates.joint_control_hz, scenario.rates.hand_hz)


def _check_friction_time_step(slave: SlavePlant, step: float) -> None:
    if not slave.joint_friction.any():
        return
    mass = mass_matrix(slave.arm, slave.start)
    slope = np.diag(slave.joint_friction / ARM_FRICTION_TANH_SPEED_SI)
    rate = float(np.linalg.eigvals(np.linalg.solve(mass, slope)).real.max())
    if rate * step > _MAX_DECAY_RATE_TIMES_STEP:
        shorter = 0.9 * _MAX_DECAY_RATE_TIMES_STEP / rate
        steps = f"too fast for steps of {1e3 * step:g} ms"
        what = f"the friction stops a joint within {1e3 / rate:.2g} ms, {steps}"
        remedy = f"reduce the friction, or set simulation.max_step: {shorter:.2g}"
        raise DrakeTeleopError(what, where="slave.friction", remedy=remedy)


def _add_contact_and_moving_body_poses(builder: DiagramBuilder, slave: SlavePlant) -> None:
    plant, ports = slave.plant, slave.ports
    block: LeafSystem = ToolContact(slave.arm, slave.contact)
    if slave.contact.drake_contact_reason:
        block = DrakeContact(slave.contact.tool_bodies, slave.contact.tool_shapes)
    contact = builder.AddNamedSystem("tool_contact", block)
    connect_matching_inputs(builder, contact, ports)
    export_outputs(builder, contact, "true_contact_wrench_W")
    if "sheet_state" in ports:
        builder.ExportOutput(ports["sheet_state"], "sheet_state")
    for name, body in slave.contact.moving_bodies.items():
        pose = builder.AddNamedSystem(MOVING_BODY_POSE_PREFIX + name, MovingBodyPose(plant, body))
        connect_matching_inputs(builder, pose, ports)
        export_outputs(builder, pose, **{MOVING_BODY_POSE_PREFIX + name: "pose"})


def _check_load_estimate(scenario: Scenario, estimate: Array | None, uses_contact: bool) -> None:
    if hasattr(estimate, "estimate"):
        what = f"expected 16 numbers, found {type(estimate).__name__}"
        remedy = "pass the attribute .estimate of this object"
        raise DrakeTeleopError(what, where="load_estimate", remedy=remedy)
    if estimate is not None:
        estimate = finite_array("load_estimate", estimate, 16)
        if not scenario.load_estimator.enabled:
            check_load_not_all_zero("load_estimate", estimate[6:])
    for name, is_used in (
        ("a sigma that differs from gamma", len(set(scenario.force_scaling.scales())) > 1),
        ("contact detection", scenario.contact_detection is not None),
        ("contact_wrench_S of the controller", uses_contact),
    ):
        if is_used and not _has_load_estimate(scenario, estimate):
            what = f"{name} requires a load estimate, but there is none"
            remedy = "pass the estimate of identify_load, or set load_estimator.enabled"
            raise DrakeTeleopError(what, where="load_estimate", remedy=remedy)


def _has_load_estimate(scenario: Scenario, estimate: Array | None) -> bool:
    return estimate is not None or scenario.load_estimator.enabled
