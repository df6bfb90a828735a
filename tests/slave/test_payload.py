"""Payload: carried by the plant, measured by the sensor, identified as load."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.lab.identification import (
    identification_scenario,
    identify_load,
    slave_arm,
)
from drake_teleop.load.inertia import mass_com_inertia, phi_from_mass_com_inertia
from drake_teleop.station.operator.operator import OperatorConfig, Sine
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import MakeSimulator, advance_without_garbage_collection
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Payload, Slave, Tool
from drake_teleop.station.station import GetBlock, MakeTeleopStation

HELD = Payload(mass=2.0, com=[0.02, -0.03, 0.16])


def test_payload_adds_to_tool_parameters():
    bare = AddSlavePlant(DiagramBuilder(), Slave(), None).arm.phi_load
    phi = slave_arm(replace(Scenario(), slave__payload=HELD)).phi_load
    # A steel ball of 2 kg has a radius of 39.3 mm.
    ball = phi_from_mass_com_inertia(2.0, np.array(HELD.com), 0.4 * 2.0 * 0.03933**2 * np.eye(3))
    np.testing.assert_allclose(phi - bare, ball, rtol=1e-4, atol=1e-15)
    nothing = slave_arm(replace(Scenario(), slave__payload=Payload(mass=0.0)))
    np.testing.assert_array_equal(nothing.phi_load, bare)


@pytest.mark.parametrize("name", ["payload", "tool"])
def test_bodies_of_a_tool_file_may_have_any_name(tmp_path, name):
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="{name}"><inertial><mass value="0.7"/>{inertia}</inertial></link>'
    (tmp_path / "tool.urdf").write_text(f'<robot name="{name}">{link}</robot>')
    slave = Slave(tool=Tool(model=str(tmp_path / "tool.urdf")), payload=HELD)
    phi = AddSlavePlant(DiagramBuilder(), slave, None).arm.phi_load
    np.testing.assert_allclose(phi[:4], [2.7, *np.multiply(2.0, HELD.com)])


def test_sensor_wrench_includes_payload():
    swing = Sine(duration=10.0, ramp=0.1, frequency=3.0, translation=[0.01, 0.01, 0.03])
    scenario = replace(
        Scenario(), operator=OperatorConfig("firm", [swing]), wrist_sensor__ideal=True,
        slave__payload=HELD,
    )  # fmt: skip
    station = MakeTeleopStation(scenario)
    simulator = MakeSimulator(station, scenario.simulation)
    simulator.Initialize()
    context = simulator.get_context()
    plant, sensor = (GetBlock(station, name) for name in ("slave_plant", "wrist_sensor"))
    joints = list(plant.GetJointIndices())
    weld = joints.index(plant.GetJointByName("sensor_weld").index())
    sizes = []
    for time in (0.001, 0.1, 0.22, 0.31):
        advance_without_garbage_collection(simulator, time)
        port = plant.get_reaction_forces_output_port().Eval(plant.GetMyContextFromRoot(context))
        wrench = np.concatenate([port[weld].translational(), port[weld].rotational()])
        simulator.AdvancePendingEvents()
        sample = sensor.GetMyContextFromRoot(context).get_discrete_state_vector().value()[:6]
        np.testing.assert_allclose(sample, wrench, atol=1e-11)
        sizes.append(np.linalg.norm(sample[:3]))
    assert np.ptp(sizes) > 5.0  # it moves
    assert sizes[0] == pytest.approx(5.13 * 9.81, rel=0.01)  # not yet


@pytest.mark.slow
def test_identification_includes_payload():
    scenario = identification_scenario(replace(Scenario(), slave__payload=HELD), 1)
    mass, com, _ = mass_com_inertia(identify_load(scenario).estimate[6:])
    true_mass, true_com, _ = mass_com_inertia(slave_arm(scenario).phi_load)
    assert mass == pytest.approx(true_mass, rel=0.005)
    np.testing.assert_allclose(com, true_com, atol=1e-3)
