"""Construction of the paper's teleoperation system (Fig. 4) as one Drake Diagram.

operator, haptic device --- network, passivity --- arm, wrist sensor, elimination
      master side        <->      channel       <->          slave side"""

from __future__ import annotations

from pydrake.systems.framework import Diagram, DiagramBuilder, System

from drake_teleop.common.errors import DrakeTeleopError, expect_type, suggest_name
from drake_teleop.common.numeric import Array
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.channel_side import MakeChannel
from drake_teleop.station.master_side import MakeMasterSide
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.signals import SLIDING_JOINTS_ATTRIBUTE
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave_side import MakeSlaveOnTrajectory, MakeSlaveSide
from drake_teleop.station.wiring import build_with_log, connect_ports


def MakeTeleopStation(
    scenario: Scenario,
    *,
    load_estimate: Array | None = None,
    load_covariance: Array | None = None,
    noise_floor: NoiseFloor | None = None,
    master: System | None = None,
    channel: System | None = None,
    slave: System | None = None,
) -> Diagram:
    """Build the teleoperation station: master side, channel and slave side.

    The output ports are the sides' signals (`station.signals`), which are recorded. The input ports
    clutch, intended_pose and intended_twist of the master side may stay unconnected.

    Args:
        load_estimate: (16,) Eq. (7), [offsets [N, N m]; phi] about So in S, from an identification.
            Optional if the estimator runs online, or if load and contact have equal scales; then
            there is no signal `contact_wrench_S` without an estimate.
        load_covariance: (16, 16) covariance of the estimate, for a monitored load
            (`load_estimator.watch`). Use a method for noisy motion ("total"); the covariance of
            least squares is too small.
        noise_floor: `LoadIdentification.noise_floor` at the estimator's rate, to detect contact.
        master: custom system with the ports of `MakeMasterSide(scenario)`.
        channel: custom system with the ports of `MakeChannel(scenario)`; the scenario's channel and
            passivity are unused.
        slave: custom system with the ports of `MakeSlaveSide(scenario, ...)`; load_estimate,
            load_covariance and noise_floor are unused.

    Raises:
        DrakeTeleopError: for an invalid value, or a custom side without a required port.
    """
    check_scenario(scenario)
    for name, side in (("master", master), ("channel", channel), ("slave", slave)):
        if side is not None:
            expect_type(System, side, name, "docs/station.md lists the ports of each side")
    builder = DiagramBuilder()
    if slave is None:
        slave = MakeSlaveSide(
            scenario,
            load_estimate=load_estimate,
            load_covariance=load_covariance,
            noise_floor=noise_floor,
        )
    slave = builder.AddNamedSystem("slave_side", slave)
    master = builder.AddNamedSystem("master_side", master or MakeMasterSide(scenario))

    sides = [master, slave]
    is_direct = scenario.has_no_network_or_passivity and scenario.contact_detection is None
    if channel is None and is_direct:
        # A Diagram of two wires would cost 3 % of the time.
        setpoint = "leader_joints" if scenario.master.is_joint_leader else "pose_command"
        connect_ports(builder, master, setpoint, slave, setpoint)
        connect_ports(builder, slave, "wrench_B", master, "wrench_command")
    else:
        channel = builder.AddNamedSystem("channel", channel or MakeChannel(scenario))
        sides.append(channel)
        connect_ports(builder, master, "pose_command", channel, "pose_command")
        connect_ports(builder, channel, "pose_to_slave", slave, "pose_command")
        connect_ports(builder, slave, "wrench_B", channel, "wrench_B")
        connect_ports(builder, channel, "wrench_to_master", master, "wrench_command")
        # Inputs of network methods and of contact detection.
        for name in ("hand_wrench_E", "pose_slave", "saturated", "contact"):
            if channel.HasInputPort(name):
                source = master if name == "hand_wrench_E" else slave
                connect_ports(builder, source, name, channel, name)
        # Optional for a custom slave: without this port the whole wrench counts as contact.
        if channel.HasInputPort("load_wrench_B") and slave.HasOutputPort("load_wrench_B"):
            connect_ports(builder, slave, "load_wrench_B", channel, "load_wrench_B")
    if master.HasInputPort("slave_state"):  # for the view of the tool by an operator with a task
        connect_ports(builder, slave, "slave_state", master, "slave_state")
    for name in ("clutch", "intended_pose", "intended_twist"):
        if master.HasInputPort(name):
            builder.ExportInput(master.GetInputPort(name), name)
    station = build_with_log(builder, "teleop_station", sides, scenario.rates.log_hz)
    return _store_sliding_joints(station, scenario)


def MakeIdentificationStation(scenario: Scenario, trajectory: FourierTrajectory) -> Diagram:
    """Build a station with only the slave, whose joints follow an excitation trajectory."""
    check_scenario(scenario)
    expect_type(FourierTrajectory, trajectory, "trajectory")
    builder = DiagramBuilder()
    slave = builder.AddNamedSystem("slave_side", MakeSlaveOnTrajectory(scenario, trajectory))
    station = build_with_log(builder, "identification_station", (slave,), scenario.rates.log_hz)
    return _store_sliding_joints(station, scenario)


def _store_sliding_joints(station: Diagram, scenario: Scenario) -> Diagram:
    slave = NominalSlave(scenario.slave).arm.sliding_joints
    sliding = {False: slave, True: scenario.master.device(0.0, 0.0).sliding_joints}
    setattr(station, SLIDING_JOINTS_ATTRIBUTE, sliding)
    return station


def GetBlock(station: Diagram, name: str) -> System:
    """Return the block `name` ("force_scaling", "slave_plant", ...) of the station."""
    sides = [side for side in station.GetSystems() if isinstance(side, Diagram)]
    blocks = {block.get_name(): block for side in sides for block in side.GetSystems()}
    if name in blocks:
        return blocks[name]
    remedy = suggest_name(name, list(blocks), f"choose one of {', '.join(blocks)}")
    raise DrakeTeleopError(f"the station has no block '{name}'", where="name", remedy=remedy)
