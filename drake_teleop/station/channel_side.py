"""Channel between master and slave: direct wires, or a network with a passivity method."""

from __future__ import annotations

import dataclasses

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import PassThrough

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.channel.channel import TeleopChannel
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.slave.joint_control import servo_impedance
from drake_teleop.station.slave.plant import NominalSlave, start_pose
from drake_teleop.station.wiring import export_outputs


def MakeChannel(scenario: Scenario) -> Diagram:
    """Build the channel of a scenario: direct wires for an ideal network without passivity method.

    .. pydrake_system::

        name: channel
        input_ports:
        - pose_command: (7,) X_WS, from the master side
        - wrench_B: (6,) F_E_B, wrench to render, from the slave side [N, N m]
        - contact: (1,) flag of the slave's detector (with contact detection)
        - hand_wrench_E: (6,) wrench of the hand on the stylus, in B [N, N m] (not for wires)
        - pose_slave: (7,) actual X_WS of the slave (not for wires)
        - saturated: (1,) above 0.5 while the wrench is invalid (not for wires)
        - load_wrench_B: (6,) part of wrench_B from weight and inertia of the load; may stay
          unconnected (not for wires)
        output_ports:
        - pose_to_slave: (7,) X_WS, setpoint of the slave
        - wrench_to_master: (6,) F_E_B, wrench to render [N, N m]
        - contact_at_hand: signal for the log (with contact detection)
        - pose_received, ports: signals for the log (not for wires)
    """
    check_scenario(scenario)
    builder = DiagramBuilder()
    if scenario.has_no_network_or_passivity:
        wires = [("pose_command", "pose_to_slave", 7), ("wrench_B", "wrench_to_master", 6)]
        if scenario.contact_detection is not None:
            wires.append(("contact", "contact_at_hand", 1))
        for entry, exit_, size in wires:
            wire = builder.AddNamedSystem(f"wire_of_{entry}", PassThrough(size))
            builder.ExportInput(wire.get_input_port(), entry)
            builder.ExportOutput(wire.get_output_port(), exit_)
        return builder.Build()
    scaling = scenario.kinematic_scaling
    R_WB, scales = scaling.R_WB, scaling.scales
    passivity, start = _passivity_with_mass_and_encoder_step(scenario), start_pose(scenario.slave)
    gain, period = _rendered_force_per_contact_force(scenario), 1 / scenario.rates.hand_hz
    seed = scenario.simulation.seed
    block = TeleopChannel(scenario.channel, passivity, R_WB, scales, gain, start, period, seed)
    channel = builder.AddNamedSystem("channel", block)
    own = ("pose_command", "wrench_B", "hand_wrench_E", "pose_slave", "saturated", "load_wrench_B")
    for name in own:
        builder.ExportInput(channel.GetInputPort(name), name)
    if scenario.contact_detection is not None:
        builder.ExportInput(channel.GetInputPort("contact"), "contact")
        export_outputs(builder, channel, "contact_at_hand")
    export_outputs(builder, channel, "pose_received", "ports", pose_to_slave="pose_received")
    export_outputs(builder, channel, wrench_to_master="wrench_received")
    return builder.Build()


def _passivity_with_mass_and_encoder_step(scenario: Scenario) -> PassivityConfig:
    passivity, device = passivity_config_with_arm_mass(scenario), scenario.master.device(0.0, 0.0)
    ledger = passivity.ledger
    if ledger.encoder_step is None:
        steps = scenario.master.encoder_steps()
        ledger = dataclasses.replace(ledger, encoder_step=[float(steps[0]), float(steps[3])])
    return dataclasses.replace(
        passivity,
        ledger=ledger,
        force_limit=min(passivity.force_limit, device.parameters.peak_force),
        torque_limit=min(passivity.torque_limit, float(device.parameters.peak_torque.min())),
    )


def passivity_config_with_arm_mass(scenario: Scenario) -> PassivityConfig:
    """Return passivity settings, with the arm's mass and servo if `ledger` has no `slave_mass`.

    Then an arm with fewer than six joints raises a DrakeTeleopError.
    """
    passivity = scenario.passivity
    if not METHODS[passivity.method].needs_arm_mass or passivity.slave_mass is not None:
        return passivity
    slave = NominalSlave(scenario.slave)
    if slave.arm.num_joints < 6:
        what = f"'{passivity.method}' requires 6 or more joints, not {slave.arm.num_joints}: the"
        what = f"{what} mass of the arm is unbounded in directions in which it cannot move"
        remedy = "choose another method, or set passivity.slave_mass and the servo explicitly"
        raise DrakeTeleopError(what, where="passivity.method", remedy=remedy)
    stiffness, damping, mass = servo_impedance(slave.arm, slave.start, scenario.joint_control)
    return dataclasses.replace(
        passivity, servo_stiffness=stiffness, servo_damping=damping, slave_mass=mass
    )


def slave_to_master_power_unit_scale(scenario: Scenario) -> Array:
    """Return factors (2,) for force and torque that equate work at slave and hand (T29)."""
    scales = scenario.kinematic_scaling.scales
    return _rendered_force_per_contact_force(scenario) / np.where(scales > 0.0, scales, 1.0)


def _rendered_force_per_contact_force(scenario: Scenario) -> float:
    """Return rendered over measured contact force; scales of 0 count as 1."""
    scaling = scenario.force_scaling
    return (scaling.force_scale or 1.0) * (scaling.scales().gamma or 1.0)
