"""The complete teleoperation system of the paper's Fig. 4 as one Drake Diagram.

Read `MakeTeleopStation` beside the figure: every block of it is one line here, and one file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RollPitchYaw
from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import LogVectorOutput, Multiplexer, PassThrough

from drake_teleop.channel.channel import TeleopChannel
from drake_teleop.channel.network import NetworkConfig, mean_delay
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.estimation.contact_detection import ContactDetection
from drake_teleop.estimation.load_estimator import LoadEstimator
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.sample import sample_parts, sample_size
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.master import phantom
from drake_teleop.master.device import MasterDevice
from drake_teleop.master.force_display import ForceDisplay
from drake_teleop.operator.decision import Training
from drake_teleop.operator.operator import Operator
from drake_teleop.scaling.force_scaling import ForceScaling
from drake_teleop.scaling.kinematic_scaling import KinematicScaling
from drake_teleop.scenario import Scenario
from drake_teleop.sensor.motion_estimation import estimated_motion_std
from drake_teleop.sensor.wrist_sensor import AddWristSensor
from drake_teleop.signals import LOG
from drake_teleop.slave.inverse_kinematics import InverseKinematics
from drake_teleop.slave.joint_control import JointControl
from drake_teleop.slave.joint_trajectory import JointTrajectory
from drake_teleop.slave.monitor import SlaveMonitor
from drake_teleop.slave.plant import R_WS_HOME, AddSlavePlant, SlavePlant
from drake_teleop.slave.tool_contact import ToolContact

_SLAVE_WIRES = (
    ("joint_control.joint_torque", "slave_plant.rx90_actuation"),
    ("slave_plant.rx90_state", "joint_control.slave_state"),
    ("slave_plant.rx90_state", "monitor.slave_state"),
    ("slave_plant.rx90_state", "wrist_sensor.slave_state"),
    ("slave_plant.rx90_generalized_acceleration", "wrist_sensor.slave_acceleration"),
    ("joint_control.joint_torque", "wrist_sensor.joint_torque"),
)
# Only when it learns or watches: at 8 kHz even a wire that nobody reads costs time.
_LEARNING_WIRES = (("wrist_sample.sample", "load_estimator.sample"),)
_CONTACT_WIRES = (("slave_plant.rx90_state", "tool_contact.slave_state"),)
_SHEET_WIRES = (("slave_plant.sheet_spring_state", "tool_contact.sheet_state"),)
_TELEOP_WIRES = (
    # The operator holds the master.
    ("operator.hand_wrench_E", "master_device.hand_wrench_E"),
    ("master_device.pose_master", "operator.pose_master"),
    ("master_device.twist_master", "operator.twist_master"),
    # Motion, master to slave.
    ("master_device.pose_master", "kinematic_scaling.pose_master"),
    ("sample_parts.joint_position", "inverse_kinematics.joint_position"),
    ("inverse_kinematics.joint_command", "joint_control.joint_command"),
    ("inverse_kinematics.ik_status", "monitor.ik_status"),
    # Force, slave to master.
    ("wrist_sample.sample", "force_scaling.sample"),
    ("load_estimator.load_estimate", "force_scaling.load_estimate"),
    ("master_device.state", "force_display.master_state"),
    ("force_display.motor_torque", "master_device.motor_torque"),
)
# An ideal network without a method is nothing but wires.
_DIRECT_WIRES = (
    ("kinematic_scaling.pose_command", "inverse_kinematics.pose_command"),
    ("force_scaling.wrench_B", "force_display.wrench_command"),
)
_CHANNEL_WIRES = (
    ("kinematic_scaling.pose_command", "channel.pose_command"),
    ("channel.pose_received", "inverse_kinematics.pose_command"),
    ("force_scaling.wrench_B", "channel.wrench_B"),
    ("operator.hand_wrench_E", "channel.hand_wrench_E"),
    ("wrist_sample.sample", "channel.sample"),
    ("channel.wrench_received", "force_display.wrench_command"),
)
_DETECTION_WIRES = (
    ("wrist_sample.sample", "contact_detection.sample"),
    ("load_estimator.load_estimate", "contact_detection.load_estimate"),
)
_DIRECT_FLAG = (("contact_detection.contact", "contact_at_hand.u"),)
_CHANNEL_FLAG = (
    ("contact_detection.contact", "channel.contact"),
    ("channel.contact_at_hand", "contact_at_hand.u"),
)

#: Signal -> port; `drake_teleop.signals` says what each one is.
_SLAVE_SIGNALS = {
    "measured_wrench_S": "sample_parts.measured_wrench_S",
    "specific_force_S": "sample_parts.specific_force_S",
    "angular_velocity_S": "sample_parts.angular_velocity_S",
    "angular_acceleration_S": "sample_parts.angular_acceleration_S",
    "saturated": "sample_parts.saturated",
    "joint_position": "sample_parts.joint_position",
    "sample_time": "wrist_sample.sample_time",
    "load_estimate": "load_estimator.load_estimate",
    "slave_state": "slave_plant.rx90_state",
    "joint_torque": "joint_control.joint_torque",
}
_WATCHING_SIGNALS = {"load_state": "load_estimator.load_state"}
_CONTACT_SIGNALS = {"true_contact_wrench_W": "tool_contact.true_contact_wrench_W"}
_SHEET_SIGNALS = {"sheet_state": "slave_plant.sheet_spring_state"}
_TELEOP_SIGNALS = {
    "intent": "operator.intent",
    "hand_wrench_E": "operator.hand_wrench_E",
    "master_state": "master_device.state",
    "pose_master": "master_device.pose_master",
    "twist_master": "master_device.twist_master",
    "pose_command": "kinematic_scaling.pose_command",
    "joint_command": "inverse_kinematics.joint_command",
    "ik_status": "monitor.ik_status",
    "scaled_wrench_S": "force_scaling.scaled_wrench_S",
    "contact_wrench_S": "force_scaling.contact_wrench_S",
    "force_to_master": "force_display.force_to_master",
}
_DETECTION_SIGNALS = {
    "contact": "contact_detection.contact",
    "contact_at_hand": "contact_at_hand.y",
}
_TASK_WIRES = (("slave_plant.rx90_state", "operator.slave_state"),)
_TASK_SIGNALS = {"task_state": "operator.task_state"}
_CHANNEL_SIGNALS = {"pose_received": "channel.pose_received", "ports": "channel.ports"}


_TOGETHER = dict.fromkeys(
    ("force_scaling.scaled_wrench_S", "force_scaling.contact_wrench_S"),
    "force_scaling.scaled_and_contact_S",
)

#: How often the clutch and the monitor are looked at [s]; an event at 2 kHz would cost time.
_HUMAN_PERIOD = 0.01
#: Drake numbers these ports.
_DIVIDED = {"sample_parts": list(sample_parts(6)), "wrist_sample": ["sample", "sample_time"]}
_SAMPLE_SIZE = sample_size(6)


def MakeTeleopStation(
    scenario: Scenario,
    *,
    load_estimate: NDArray[np.float64] | None = None,
    load_covariance: NDArray[np.float64] | None = None,
    noise_floor: NoiseFloor | None = None,
) -> Diagram:
    """Builds the bilateral station: operator, master, channel, slave, sensor, elimination.

    Every output port is a signal of `drake_teleop.signals`, exported and recorded.

    .. pydrake_system::

        name: teleop_station
        input_ports:
        - clutch: (1,) engaged if above 0.5; unconnected it is always engaged
        output_ports:
        - measured_wrench_S
        - specific_force_S
        - angular_velocity_S
        - angular_acceleration_S
        - saturated
        - joint_position
        - sample_time
        - load_estimate
        - load_state (if the load is watched)
        - slave_state
        - joint_torque
        - true_contact_wrench_W (with something to touch)
        - sheet_state (with a sheet spring)
        - intent
        - task_state (with a task)
        - hand_wrench_E
        - master_state
        - pose_master
        - twist_master
        - pose_command
        - joint_command
        - ik_status
        - scaled_wrench_S
        - contact_wrench_S
        - force_to_master
        - pose_received (with a channel)
        - ports (with a channel)
        - contact (with contact detection)
        - contact_at_hand (with contact detection)

    Args:
        scenario: what the station is made of.
        load_estimate: (16,) Eq. (7), [offsets [N, N m]; phi] about So in S, as an identification
            found it. It may be left out if sigma = gamma, which needs no estimate, and if the
            estimator learns in the loop.
        load_covariance: (16, 16) of the estimate, with which a load that is to be watched
            (`load_estimator.watch`) need not be learnt first. Of a method that allows for noise in
            the motion ("total"): that of plain least squares is too small.
        noise_floor: of the wrench that is left in free motion, which detection of contact needs:
            `LoadIdentification.noise_floor`, at the rate of the estimator.

    Raises:
        DrakeTeleopError: for a value that cannot be right, a start out of reach, scales that mean
            something only if the load is known while it is not, or detection without its floor.
    """
    scenario.check()
    _check_load_is_known(scenario, load_estimate)
    period = 1 / scenario.rates.hand_hz
    hand, scaling = scenario.operator.hand, scenario.kinematic_scaling
    start_B = np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position])
    start_W = np.array([*R_WS_HOME.ToQuaternion().wxyz(), *scenario.slave.position])
    R_WB = RollPitchYaw(scaling.alignment).ToRotationMatrix()

    builder = DiagramBuilder()
    slave, slave_signals = AddSlave(builder, scenario, load_estimate, load_covariance)
    blocks = {
        "operator": _operator(scenario, start_B, slave, R_WB.matrix()),
        "master_device": MasterDevice(
            period,
            hand_mass=hand.mass,
            hand_inertia=hand.inertia,
            q_initial=phantom.inverse_kinematics(start_B),
            friction=scenario.master.friction,
        ),
        "kinematic_scaling": KinematicScaling(scaling, _HUMAN_PERIOD, start_W),
        "inverse_kinematics": InverseKinematics(slave.arm.lower, slave.arm.upper),
        "force_scaling": ForceScaling(scenario.force_scaling, slave.arm, R_WB.matrix()),
        "force_display": ForceDisplay(),
    }
    for name, block in blocks.items():
        builder.AddNamedSystem(name, block)
    _connect(builder, _TELEOP_WIRES)
    signals = slave_signals | _TELEOP_SIGNALS
    if scenario.operator.task is not None:
        _connect(builder, _TASK_WIRES)
        signals |= _TASK_SIGNALS
    if _is_direct(scenario):
        _connect(builder, _DIRECT_WIRES)
    else:
        channel = TeleopChannel(
            scenario.channel,
            scenario.passivity,
            slave.arm,
            R_WB.matrix(),
            np.array([scaling.translation_scale, scaling.rotation_scale]),
            scenario.force_scaling.force_scale,
            start_W,
            period,
            scenario.simulation.seed,
        )
        builder.AddNamedSystem("channel", channel)
        _connect(builder, _CHANNEL_WIRES)
        signals |= _CHANNEL_SIGNALS
    if scenario.contact_detection is not None:
        if noise_floor is None:
            raise DrakeTeleopError(
                "nobody knows how large the contact wrench is in free motion",
                where="contact_detection",
                remedy="pass the noise_floor of identify_load, as load_estimate",
            )
        detection = ContactDetection(
            scenario.contact_detection, noise_floor, slave.arm, 1 / scenario.rates.estimator_hz
        )
        builder.AddNamedSystem("contact_detection", detection)
        builder.AddNamedSystem("contact_at_hand", PassThrough(1))
        _connect(builder, _DETECTION_WIRES)
        _connect(builder, _DIRECT_FLAG if _is_direct(scenario) else _CHANNEL_FLAG)
        signals |= _DETECTION_SIGNALS
    builder.ExportInput(_input(builder, "kinematic_scaling.clutch"), "clutch")
    return _finish(builder, "teleop_station", signals, scenario)


def _operator(
    scenario: Scenario, start_B: NDArray[np.float64], slave: SlavePlant, R_WB: NDArray[np.float64]
) -> Operator:
    """The operator; for a task it sees the tool, and has been trained on this station."""
    if scenario.operator.task is None:
        return Operator(scenario.operator, start_B)
    forward, backward = (mean_delay(line) for line in scenario.channel.lines())
    training = Training(
        R_WB,
        scenario.kinematic_scaling.translation_scale,
        scenario.force_scaling.scales()[2] * scenario.force_scaling.force_scale,
        forward,
        backward,
        scenario.simulation.seed,
    )
    tip_W = np.array(scenario.slave.position) + R_WS_HOME.matrix() @ slave.tip
    tip = np.concatenate([slave.tip, tip_W])
    return Operator(scenario.operator, start_B, training, slave.arm, tip)


def _is_direct(scenario: Scenario) -> bool:
    lines = scenario.channel.lines()
    return scenario.passivity.method == "none" and lines == (NetworkConfig(), NetworkConfig())


def _check_load_is_known(scenario: Scenario, estimate: NDArray[np.float64] | None) -> None:
    sigma_gripper, sigma_object, gamma = scenario.force_scaling.scales()
    needed = not sigma_gripper == sigma_object == gamma
    if needed and estimate is None and not scenario.load_estimator.enabled:
        raise DrakeTeleopError(
            "sigma and gamma differ, but the load is not known",
            where="load_estimate",
            remedy="pass the estimate of identify_load, or set load_estimator.enabled",
        )


def MakeIdentificationStation(scenario: Scenario, trajectory: FourierTrajectory) -> Diagram:
    """Builds the slave alone, driven through an excitation trajectory (section IV).

    The slave starts at the trajectory's start; `trajectory` runs once, after the settling time,
    and the load estimator learns from every sample if the scenario enables it.
    """
    scenario.check()
    builder = DiagramBuilder()
    start, _, _ = trajectory.evaluate(0.0)
    _, signals = AddSlave(builder, scenario, q_start=start)
    builder.AddNamedSystem(
        "joint_trajectory", JointTrajectory(trajectory, scenario.simulation.settle)
    )
    _connect(builder, [("joint_trajectory.joint_command", "joint_control.joint_command")])
    command = {"joint_command": "joint_trajectory.joint_command"}
    return _finish(builder, "identification_station", signals | command, scenario)


def AddSlave(
    builder: DiagramBuilder,
    scenario: Scenario,
    load_estimate: NDArray[np.float64] | None = None,
    load_covariance: NDArray[np.float64] | None = None,
    q_start: NDArray[np.float64] | None = None,
) -> tuple[SlavePlant, dict[str, str]]:
    """Adds the slave: plant, joint control, wrist sensor, load estimator, monitor.

    What remains open is the input `joint_control.joint_command`.

    Returns:
        The plant, and the signals that can be recorded: name -> "system.port".
    """
    rates, sensor = scenario.rates, scenario.wrist_sensor
    held = scenario.slave.payload
    slave = AddSlavePlant(builder, scenario.slave.position, scenario.environment, q_start, held)
    start = slave.plant.GetDefaultPositions(slave.instance)
    blocks = {
        "joint_control": JointControl(
            slave.arm, scenario.joint_control, 1 / rates.joint_control_hz, start
        ),
        "monitor": SlaveMonitor(slave.arm, _HUMAN_PERIOD),
        "load_estimator": LoadEstimator(
            scenario.load_estimator,
            sensor.wrench_std(),
            estimated_motion_std(
                scenario.motion_estimation, sensor, slave.arm.num_joints, 1 / rates.sensor_hz
            ),
            1 / rates.estimator_hz,
            _SAMPLE_SIZE,
            np.zeros(16) if load_estimate is None else load_estimate,
            load_covariance,
            scenario.force_scaling.gripper_phi,
        ),
    }
    for name, block in blocks.items():
        builder.AddNamedSystem(name, block)
    AddWristSensor(
        builder,
        slave,
        sensor,
        scenario.motion_estimation,
        1 / rates.sensor_hz,
        1 / rates.joint_control_hz,
        start,
    )
    _connect(builder, _SLAVE_WIRES)
    signals = _SLAVE_SIGNALS
    if scenario.load_estimator.enabled or scenario.load_estimator.watch:
        _connect(builder, _LEARNING_WIRES)
    if scenario.load_estimator.watch:
        signals = signals | _WATCHING_SIGNALS
    if slave.can_touch:
        moves = slave.sheet is not None
        contact = ToolContact(slave.arm, slave.contact_pairs, moves=moves)
        builder.AddNamedSystem("tool_contact", contact)
        _connect(builder, _CONTACT_WIRES + (_SHEET_WIRES if moves else ()))
        signals = signals | _CONTACT_SIGNALS | (_SHEET_SIGNALS if moves else {})
    return slave, signals


def _connect(builder: DiagramBuilder, wires: Iterable[tuple[str, ...]]) -> None:
    for source, *targets in wires:
        for target in targets:
            builder.Connect(_output(builder, source), _input(builder, target))


def _output(builder: DiagramBuilder, name: str) -> OutputPort:
    system, _, port = name.partition(".")
    if system in _DIVIDED:
        return builder.GetSubsystemByName(system).get_output_port(_DIVIDED[system].index(port))
    return builder.GetSubsystemByName(system).GetOutputPort(port)


def _input(builder: DiagramBuilder, name: str) -> InputPort:
    system, _, port = name.partition(".")
    return builder.GetSubsystemByName(system).GetInputPort(port)


def _finish(
    builder: DiagramBuilder, name: str, signals: Mapping[str, str], scenario: Scenario
) -> Diagram:
    """Exports the signals, records them in that order, and builds."""
    for signal, port in signals.items():
        builder.ExportOutput(_output(builder, port), signal)
    # What lies side by side in one port is read at once: a port in Python takes time.
    recorded = dict.fromkeys(
        "wrist_sample.sample" if port.startswith("sample_parts.") else _TOGETHER.get(port, port)
        for port in signals.values()
    )
    ports = [_output(builder, port) for port in recorded]
    # One wide log: at 8 kHz each further system with events of its own costs time at every step.
    wide = builder.AddNamedSystem("log_input", Multiplexer([port.size() for port in ports]))
    for index, port in enumerate(ports):
        builder.Connect(port, wide.get_input_port(index))
    log = LogVectorOutput(wide.get_output_port(), builder, 1 / scenario.rates.log_hz)
    log.set_name(LOG)
    diagram = builder.Build()
    diagram.set_name(name)
    return diagram
