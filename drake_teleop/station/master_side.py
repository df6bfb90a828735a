"""Master side of the station: operator, haptic device, scaling and force display."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_teleop.common.numeric import Array
from drake_teleop.station.channel.network import mean_delay
from drake_teleop.station.master.device import AddDeviceAndForceDisplay
from drake_teleop.station.master.dynamics import HapticDevice
from drake_teleop.station.master.electronics import Encoders, SampleHold
from drake_teleop.station.master.leader import LeaderDevice
from drake_teleop.station.operator.decision import OperatorTraining
from drake_teleop.station.operator.operator import Operator
from drake_teleop.station.scaling.kinematic_scaling import JointCoupling, KinematicScaling
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.slave.plant import NominalSlave, start_pose
from drake_teleop.station.wiring import export_outputs

#: Sampling period of the clutch [s]; 2 kHz events would cost time.
CLUTCH_PERIOD_S = 0.01


def MakeMasterSide(scenario: Scenario, operator: Operator | None = None) -> Diagram:
    """Build the master side: operator, haptic device, kinematic scaling and force display.

    .. pydrake_system::

        name: master_side
        input_ports:
        - wrench_command: (6,) F_E_B, wrench to render [N, N m]
        - clutch: (1,) engaged if above 0.5; engaged if unconnected
        - intended_pose: (7,) X_BE that replaces the scenario's intent; may stay unconnected
        - intended_twist: (6,) twist [v; omega] of intended_pose, in B; zero if unconnected
        - slave_state: [q; v] of the slave, for the operator of a task
        output_ports:
        - pose_command: (7,) X_WS, setpoint of the slave
        - leader_joints: (n,) setpoint of the slave's joints (leader arm in joint mode) [rad]
        - hand_wrench_E: (6,) wrench of the hand on the stylus, in B [N, N m]
        - intent, master_state, pose_master, twist_master, force_to_master, fault_at_hand: for logs
        - displayed_and_fault: force_to_master and fault_at_hand in one port, for the log
        - task_state: for the log (with a task)

    Args:
        operator: custom operator, added as "live_hand"; None for the scenario's operator.
    """
    check_scenario(scenario)
    hand, scaling = scenario.operator.hand, scenario.kinematic_scaling
    X_BE_start = np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position])
    X_WS_start = start_pose(scenario.slave)
    builder = DiagramBuilder()

    name = "operator" if operator is None else "live_hand"
    operator = builder.AddNamedSystem(name, operator or _make_operator(scenario, X_BE_start))
    period, model = 1 / scenario.rates.hand_hz, scenario.master.device(hand.mass, hand.inertia)
    q_start = model.inverse_kinematics(X_BE_start)
    device, display = AddDeviceAndForceDisplay(builder, period, model, q_start)
    builder.Connect(operator.GetOutputPort("hand_wrench_E"), device.GetInputPort("hand_wrench_E"))
    builder.Connect(device.GetOutputPort("pose_master"), operator.GetInputPort("pose_master"))
    builder.Connect(device.GetOutputPort("twist_master"), operator.GetInputPort("twist_master"))
    for name in ("intended_pose", "intended_twist"):
        if operator.HasInputPort(name):
            builder.ExportInput(operator.GetInputPort(name), name)
    if scenario.operator.task is not None:
        builder.ExportInput(operator.GetInputPort("slave_state"), "slave_state")
        export_outputs(builder, operator, "task_state")
    export_outputs(builder, operator, "intent", "hand_wrench_E")
    export_outputs(builder, device, "pose_master", "twist_master", master_state="state")

    coupling: JointCoupling | KinematicScaling
    if isinstance(model, LeaderDevice) and scenario.master.is_joint_leader:
        slave = NominalSlave(scenario.slave)
        coupling = JointCoupling(slave.arm, slave.start, model.home, CLUTCH_PERIOD_S)
    else:
        coupling = KinematicScaling(scaling, CLUTCH_PERIOD_S, X_WS_start)
    kinematic_scaling = builder.AddNamedSystem("kinematic_scaling", coupling)
    read, command = device.GetOutputPort("pose_master"), display.GetInputPort("wrench_command")
    if scenario.master.encoder_steps().any() and isinstance(model, HapticDevice):
        encoders = Encoders(model, q_start, scenario.master.encoder_steps())
        builder.AddNamedSystem("encoders", encoders)
        builder.Connect(device.GetOutputPort("state"), encoders.get_input_port())
        read = encoders.get_output_port()
    own_period = scenario.master.sampling_period_if_slower_than_hand(scenario.rates.hand_hz)
    if own_period is not None:
        held_pose = builder.AddNamedSystem("held_pose", SampleHold(own_period, X_BE_start))
        held_wrench = builder.AddNamedSystem("held_wrench", SampleHold(own_period, np.zeros(6)))
        builder.Connect(read, held_pose.get_input_port())
        builder.Connect(held_wrench.get_output_port(), command)
        read, command = held_pose.get_output_port(), held_wrench.get_input_port()
    if scenario.master.is_joint_leader:
        state = device.GetOutputPort("state")
        builder.Connect(state, kinematic_scaling.GetInputPort("master_state"))
        export_outputs(builder, kinematic_scaling, "leader_joints")
    else:
        builder.Connect(read, kinematic_scaling.GetInputPort("pose_master"))
    builder.ExportInput(kinematic_scaling.GetInputPort("clutch"), "clutch")
    export_outputs(builder, kinematic_scaling, "pose_command")

    builder.ExportInput(command, "wrench_command")
    export_outputs(builder, display, "force_to_master", "fault_at_hand", "displayed_and_fault")
    return builder.Build()


def _make_operator(scenario: Scenario, X_BE_start: Array) -> Operator:
    if scenario.operator.task is None:
        return Operator(scenario.operator, X_BE_start)
    scaling, forces = scenario.kinematic_scaling, scenario.force_scaling
    forward, backward = (mean_delay(line) for line in scenario.channel.networks_of_directions())
    gains = scaling.translation_scale, forces.scales().gamma * forces.force_scale
    training = OperatorTraining(scaling.R_WB, *gains, forward, backward, scenario.simulation.seed)
    slave = NominalSlave(scenario.slave)
    tip = np.concatenate([slave.tip, slave.p_WTip_start])
    return Operator(scenario.operator, X_BE_start, training, slave.arm, tip)
