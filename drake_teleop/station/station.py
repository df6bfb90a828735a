"""The complete teleoperation system of the paper's Fig. 4 as one Drake Diagram.

    operator, haptic device --- network, passivity --- arm, wrist sensor, elimination
          master side        <->      channel       <->          slave side

Read `MakeTeleopStation` beside the figure; each side is one function in `drake_teleop.station`, and
each of its blocks one file. Either side may be somebody's own: docs/station.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram, DiagramBuilder, System

from drake_teleop.common.errors import expect
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.channel_side import MakeChannel
from drake_teleop.station.master_side import MakeMasterSide
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.slave_side import MakeSlaveOnTrajectory, MakeSlaveSide
from drake_teleop.station.wiring import record, wire


def MakeTeleopStation(
    scenario: Scenario,
    *,
    load_estimate: NDArray[np.float64] | None = None,
    load_covariance: NDArray[np.float64] | None = None,
    noise_floor: NoiseFloor | None = None,
    master: System | None = None,
    slave: System | None = None,
) -> Diagram:
    """Builds the bilateral station: master side, channel, slave side.

    A channel that would be two wires and nothing else is left out. The station's output ports are
    those signals of `drake_teleop.station.signals` that its sides have, and are recorded. Its input
    ports are those of the master side that the operator's world may drive: clutch, intended_pose,
    intended_twist; all may be left unconnected.

    Args:
        scenario: what the station is made of.
        load_estimate: (16,) Eq. (7), [offsets [N, N m]; phi] about So in S, as an identification
            found it. It may be left out if the estimator learns in the loop, and if sigma = gamma,
            which needs no estimate; then the station has no `contact_wrench_S`.
        load_covariance: (16, 16) of the estimate, with which a load that is to be watched
            (`load_estimator.watch`) need not be learnt first. Of a method that allows for noise in
            the motion ("total"): that of plain least squares is too small.
        noise_floor: of the wrench that is left in free motion, which detection of contact needs:
            `LoadIdentification.noise_floor`, at the rate of the estimator.
        master: instead of `MakeMasterSide(scenario)`: any system with its ports.
        slave: instead of `MakeSlaveSide(scenario, ...)`, which alone uses the three above.

    Raises:
        DrakeTeleopError: for a value that cannot be right, as for the sides, or for a side of
            one's own without a port that is needed.
    """
    check_scenario(scenario)
    for name, side in (("master", master), ("slave", slave)):
        if side is not None:
            expect(System, side, name, "docs/station.md lists the ports that each side has")
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
    if scenario.is_direct and scenario.contact_detection is None:
        # A channel of two wires, which as a Diagram would cost 3 % of the time.
        setpoint = "leader_joints" if scenario.master.leads_joints else "pose_command"
        wire(builder, master, setpoint, slave, setpoint)
        wire(builder, slave, "wrench_B", master, "wrench_command")
    else:
        channel = builder.AddNamedSystem("channel", MakeChannel(scenario))
        sides.append(channel)
        wire(builder, master, "pose_command", channel, "pose_command")
        wire(builder, channel, "pose_to_slave", slave, "pose_command")
        wire(builder, slave, "wrench_B", channel, "wrench_B")
        wire(builder, channel, "wrench_to_master", master, "wrench_command")
        # What a method over a network goes by, and what a detector tells.
        for source, name in (
            (master, "hand_wrench_E"),
            (slave, "pose_slave"),
            (slave, "saturated"),
            (slave, "contact"),
        ):
            if channel.HasInputPort(name):
                wire(builder, source, name, channel, name)
        # A slave of one's own may leave it out: then all of its wrench is a contact's.
        if channel.HasInputPort("load_wrench_B") and slave.HasOutputPort("load_wrench_B"):
            wire(builder, slave, "load_wrench_B", channel, "load_wrench_B")
    if master.HasInputPort("slave_state"):  # an operator with a task sees the tool
        wire(builder, slave, "slave_state", master, "slave_state")
    for name in ("clutch", "intended_pose", "intended_twist"):
        if master.HasInputPort(name):
            builder.ExportInput(master.GetInputPort(name), name)
    return record(builder, "teleop_station", sides, scenario.rates.log_hz)


def MakeIdentificationStation(scenario: Scenario, trajectory: FourierTrajectory) -> Diagram:
    """Builds the slave alone, on an excitation trajectory: see `MakeSlaveOnTrajectory`."""
    check_scenario(scenario)
    expect(FourierTrajectory, trajectory, "trajectory")
    builder = DiagramBuilder()
    slave = builder.AddNamedSystem("slave_side", MakeSlaveOnTrajectory(scenario, trajectory))
    return record(builder, "identification_station", (slave,), scenario.rates.log_hz)


def GetBlock(station: Diagram, name: str) -> System:
    """The block of that name ("force_scaling", "slave_plant", ...), in whichever side it is."""
    sides = [side for side in station.GetSystems() if isinstance(side, Diagram)]
    (side,) = (side for side in sides if side.HasSubsystemNamed(name))
    return side.GetSubsystemByName(name)
