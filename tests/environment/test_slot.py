"""The slot against plane geometry and statics, and in the station."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.yaml import yaml_load
from pydrake.geometry import AddCompliantHydroelasticProperties, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia, default_model_instance
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.environment.environment import ContactMaterial
from drake_teleop.station.environment.point_contact import (
    FindContactPairs,
    depth_of_sphere_in_box,
    point_contact_force_into,
)
from drake_teleop.station.environment.slot import (
    PEG_RADIUS_M,
    TIP_BALL_CENTRE_Z_S_M,
    UPPER_BALL_CENTRE_Z_S_M,
    Slot,
    _boxes_of_slot,
)
from drake_teleop.station.replay import ReplayScene
from drake_teleop.station.scenario import LoadScenario, Scenario, ScenarioFromData, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import forward_kinematics, jacobian
from drake_teleop.station.slave.home import R_WS_HOME
from drake_teleop.station.slave.inverse_kinematics import IkStatus, nearest_branch
from drake_teleop.station.slave.plant import AddSlavePlant, ParseSlave
from drake_teleop.station.slave.plant_dynamics import environment_wrench_about_Wo_into
from drake_teleop.station.slave.scene import Scene
from drake_teleop.station.slave.slave_config import Ball, Slave, Tool
from drake_teleop.station.slave.surroundings import AddEnvironment
from drake_teleop.station.station import MakeTeleopStation


def slave_at(slot: Slot):
    return AddSlavePlant(DiagramBuilder(), Slave(), slot)


def pairs_of_a_ball(slot: Slot) -> np.ndarray:
    """Return the contact pairs of a body with one ball about its origin, without an arm."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    tool = plant.AddRigidBody("tool", SpatialInertia.SolidSphereWithMass(1.0, PEG_RADIUS_M))
    friction = CoulombFriction(1.0, 1.0)
    ball = Sphere(PEG_RADIUS_M)
    plant.RegisterCollisionGeometry(tool, RigidTransform(), ball, "ball", friction)
    environment = AddEnvironment(plant, slot).instances
    plant.Finalize()
    slot.PrepareContact(plant, scene_graph, tool.index())
    shapes = dict.fromkeys(plant.GetCollisionGeometriesForBody(tool), RigidTransform())
    inspector = scene_graph.model_inspector()
    pairs = FindContactPairs(plant, inspector, shapes, environment, slot.slip_speed).compiled_pairs
    return pairs[np.all(pairs[:, :3] == 0.0, axis=1)]


def test_peg_is_two_balls_of_the_size_of_the_tool():
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    tool = ParseSlave(plant).tool
    mass = plant.get_body(tool).default_mass()
    AddEnvironment(plant, Slot())
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    balls = plant.GetCollisionGeometriesForBody(plant.get_body(tool))
    centres = [inspector.GetPoseInFrame(ball).translation() for ball in balls]
    np.testing.assert_array_equal(
        centres, [[0, 0, TIP_BALL_CENTRE_Z_S_M], [0, 0, UPPER_BALL_CENTRE_Z_S_M]]
    )
    for ball in balls:
        assert isinstance(inspector.GetShape(ball), Sphere)
        assert inspector.GetShape(ball).radius() == PEG_RADIUS_M
    assert plant.get_body(tool).default_mass() == mass


def test_stand_reaches_from_the_ground_to_the_lowest_box():
    slot = Slot(position=[0.5, -0.2, 0.4], depth=0.03, chamfer=0.004, yaw=0.3)
    corners = np.array(list(product([-0.5, 0.5], repeat=3)))
    lowest = min(
        (slot.X_WM @ pose @ (corners * box.size()).T)[2].min()
        for pose, box in _boxes_of_slot(slot).values()
    )
    assert slot.floor_bottom_height == pytest.approx(lowest, abs=1e-12)
    assert slot.floor_stand[2:] == (0.5, -0.2, slot.floor_bottom_height)


def test_materials_of_both_sides_combine_to_those_of_the_slot():
    slot = Slot(stiffness=3e3, dissipation=0.7, friction=0.45)
    pairs = slave_at(slot).contact.compiled_pairs
    assert len(pairs) == 2 * 7
    np.testing.assert_allclose(
        pairs[:, 22:26], np.tile([3e3, 0.7, 0.45, 0.45], (14, 1)), rtol=1e-12
    )


@pytest.mark.parametrize("names", [("grip",), ("slot", "finger"), ("tool", "finger"), ("tool",)])
def test_tool_of_a_slot_has_a_body_named_tool(tmp_path, names):
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><mass value="1"/>{inertia}</inertial>'
    links = "".join(f'<link name="{name}">{inertial}</link>' for name in names)
    for first, second in pairwise(names):
        ends = f'<parent link="{first}"/><child link="{second}"/>'
        links += f'<joint name="j" type="fixed">{ends}</joint>'
    (tmp_path / "tool.urdf").write_text(f'<robot name="slot">{links}</robot>')
    slave = Slave(tool=Tool(model=str(tmp_path / "tool.urdf")))
    if "tool" in names:
        assert len(AddSlavePlant(DiagramBuilder(), slave, Slot()).contact.compiled_pairs) == 7
        return
    with pytest.raises(DrakeTeleopError, match=r"tool: a slot .* named tool, found 0; give"):
        AddSlavePlant(DiagramBuilder(), slave, Slot())


@pytest.mark.parametrize("offset", [0.0, 0.1, -0.05])
def test_peg_of_a_tool_of_several_links_has_the_slots_balls(tmp_path, offset):
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    flange = f'<link name="flange"><inertial><mass value="1"/>{inertia}</inertial></link>'
    ball = f'<geometry><sphere radius="{PEG_RADIUS_M}"/></geometry>'
    place = f'<origin xyz="0 0 {TIP_BALL_CENTRE_Z_S_M - offset}"/>'
    end = f'<link name="tool"><collision>{place}{ball}</collision></link>'
    ends = f'<origin xyz="0 0 {offset}"/><parent link="flange"/><child link="tool"/>'
    links = f'{flange}{end}<joint name="j" type="fixed">{ends}</joint>'
    (tmp_path / "tool.urdf").write_text(f'<robot name="peg">{links}</robot>')
    slave = Slave(tool=Tool(model=str(tmp_path / "tool.urdf")))
    slot = Slot(stiffness=3e3, dissipation=0.7, friction=0.45)
    contact = AddSlavePlant(DiagramBuilder(), slave, slot).contact
    assert not len(contact.monitored_pairs)
    (heights, counts) = np.unique(contact.compiled_pairs[:, 2].round(12), return_counts=True)
    np.testing.assert_allclose(heights, [UPPER_BALL_CENTRE_Z_S_M, TIP_BALL_CENTRE_Z_S_M])
    assert counts.tolist() == [7, 7]
    law = np.tile([3e3, 0.7, 0.45, 0.45], (14, 1))
    np.testing.assert_allclose(contact.compiled_pairs[:, 22:26], law, rtol=1e-12)


@pytest.mark.parametrize("slot_first", [True, False])
def test_tool_in_a_slot_keeps_its_hydroelastic_properties(slot_first):
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    tool, slot, scene = ParseSlave(plant).tool, Slot(friction=0.45), Scene(contact="hydroelastic")
    AddEnvironment(plant, slot)
    inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
    pad = plant.AddRigidBody("pad", default_model_instance(), inertia)
    soft = ContactMaterial(1e4, 1.0, 0.3)
    AddCompliantHydroelasticProperties(0.05, 1e6, soft)
    plant.RegisterCollisionGeometry(pad, RigidTransform(), Sphere(0.1), "pad", soft)
    plant.Finalize()
    for part in (slot, scene) if slot_first else (scene, slot):
        part.PrepareContact(plant, scene_graph, tool)
    for shape in plant.GetCollisionGeometriesForBody(plant.get_body(tool)):
        found = scene_graph.model_inspector().GetProximityProperties(shape)
        assert found.HasProperty("hydroelastic", "compliance_type")
        assert found.GetProperty("material", "coulomb_friction").static_friction() == 0.45


def test_tool_without_a_file_needs_the_ball_of_the_peg():
    for shapes in ([], [Ball()], [Ball(0.01, [0.0, 0.0, TIP_BALL_CENTRE_Z_S_M])]):
        scenario = Scenario(slot=Slot(), slave=Slave(tool=Tool(mass=0.5, shapes=shapes)))
        with pytest.raises(
            DrakeTeleopError, match=r"tool.shapes: a slot .* add (!Ball .*)"
        ) as error:
            scenario.check()
        (ball,) = yaml_load(data=f"[{str(error.value).split(' add ')[1]}]")
        tool = {"mass": 0.5, "shapes": [ball]}
        ScenarioFromData({"slot": {}, "slave": {"tool": tool}}, "scenario.yaml")


def test_contact_does_not_pull_a_fast_ball():
    """Hunt and Crossley: k x (1 + d times the speed inwards), never negative."""
    pair = slave_at(Slot(stiffness=3e3, dissipation=0.7, friction=0.0)).contact.compiled_pairs[0]
    up, force = np.array([0.0, 0.6, 0.8]), np.zeros(3)
    for outwards, share in ((-1.0, 1.7), (0.0, 1.0), (1.0, 0.3), (2.0, 0.0)):
        point_contact_force_into(pair, 1e-3, up, outwards * up, force)
        np.testing.assert_allclose(force, 3.0 * share * up, atol=1e-12)


def profile(slot: Slot) -> np.ndarray:
    """Return corners of the right half of the section [m]: (y, z) in M from the floor outwards."""
    edge, c = slot.width / 2, slot.chamfer
    corners = [[0.0, -slot.depth], [edge, -slot.depth], [edge, -c], [edge + c, 0.0]]
    return np.array([*corners, [edge + c + 0.03, 0.0]])


def distance_to(corners: np.ndarray, point: np.ndarray) -> float:
    """Return the distance from a point to a line through corners."""
    start, along = corners[:-1], np.diff(corners, axis=0)
    share = np.sum((point - start) * along, axis=1) / np.sum(along**2, axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[:, np.newaxis] * along
    return float(np.linalg.norm(point - nearest, axis=1).min())


@pytest.mark.slow
@given(
    yaw=st.floats(-3.1, 3.1),
    chamfer=st.floats(5e-4, 0.015),
    clearance=st.floats(1e-6, 0.01),
    depth=st.floats(0.02, 0.05),
    x=st.floats(-0.04, 0.04),
    y=st.floats(-1.0, 1.0),
    z=st.floats(-1.0, 1.0),
)
def test_boxes_fill_the_section(yaw, chamfer, clearance, depth, x, y, z):
    """The depth of a ball in its deepest box is the distance of its centre to the section."""
    slot = Slot(yaw=yaw, chamfer=chamfer, clearance=clearance, depth=depth)
    corners = profile(slot)
    # Points above the outline, because a ball cannot be inside the material.
    across = y * (slot.width / 2 + chamfer + 0.01)
    floor = np.interp(abs(across), corners[:, 0], corners[:, 1])
    height = floor + 1e-4 + (z + 1.0) * 0.02
    centre_W = slot.X_WM @ np.array([x, across, height])
    expected = PEG_RADIUS_M - distance_to(corners, np.array([abs(across), height]))
    normal = np.empty(6)
    deepest = max(
        depth_of_sphere_in_box(pair, centre_W, np.eye(3), 0.0, normal)
        for pair in pairs_of_a_ball(slot)
    )
    if expected > 0.0:
        assert deepest == pytest.approx(expected, abs=1e-9)
    else:
        assert deepest <= 1e-9


def test_walls_tops_and_floor_end_flush():
    """Blocks have no contact beyond their ends."""
    pairs = pairs_of_a_ball(Slot(position=[0.0, 0.0, 0.0]))
    level = np.all(pairs[:, 4:13].round(12) == np.eye(3).ravel(), axis=1)  # all but the chamfers
    assert np.count_nonzero(level) == 5
    ends = np.abs(pairs[level, 14]) + pairs[level, 17]
    np.testing.assert_allclose(ends, ends[0], rtol=1e-12)


#: Both balls are between the walls, and neither is on the floor or at the chamfers' edges.
DEEP = Slot(position=[0.55, 0.0, 0.2], clearance=1e-3, stiffness=1e4, depth=0.05, chamfer=1e-3)


def wrench_at(slave, angle: float, shift: float) -> np.ndarray:
    """Return the wrench on the peg at rest about the world's origin.

    Args:
        slave: with the slot DEEP.
        angle: of the tool about the middle between its balls [rad].
        shift: of that middle from the middle of the slot along y_W [m]; it is 20 mm below the
            mouth.
    """
    tilt = RotationMatrix.MakeXRotation(angle)
    R_WS = tilt @ R_WS_HOME
    middle_S = [0.0, 0.0, (TIP_BALL_CENTRE_Z_S_M + UPPER_BALL_CENTRE_Z_S_M) / 2]
    p_WS = np.array([0.55, shift, 0.2 - 0.02]) - R_WS.matrix() @ middle_S
    arm, wrench = slave.arm, np.empty(6)
    near = slave.plant.GetDefaultPositions(slave.instance)
    q, status = nearest_branch(R_WS.matrix(), p_WS, near, arm.lower, arm.upper)
    assert status == IkStatus.OK
    environment_wrench_about_Wo_into(
        arm.table,
        slave.contact.compiled_pairs,
        slave.contact.joint_table,
        np.zeros(6),
        q,
        0 * q,
        np.zeros(2),
        np.zeros(0),
        wrench,
    )
    return wrench


def test_both_balls_of_an_upright_peg_touch_beyond_the_clearance():
    slave = slave_at(DEEP)
    assert not wrench_at(slave, 0.0, 0.499e-3).any()
    assert not wrench_at(slave, 0.0, -0.499e-3).any()
    force = wrench_at(slave, 0.0, 0.7e-3)[:3]
    np.testing.assert_allclose(force, [0.0, -2 * 1e4 * 0.2e-3, 0.0], atol=1e-6)


def test_peg_tilted_beyond_its_clearance_jams():
    """The walls act on the balls as a couple against the tilt, without a force."""
    slave, apart = slave_at(DEEP), TIP_BALL_CENTRE_Z_S_M - UPPER_BALL_CENTRE_Z_S_M
    play = np.arcsin(DEEP.clearance / apart)
    assert not wrench_at(slave, 0.99 * play, 0.0).any()
    for angle in (1.5 * play, -1.5 * play):
        push = 1e4 * (apart / 2 * np.sin(abs(angle)) - DEEP.clearance / 2)
        wrench = wrench_at(slave, angle, 0.0)
        np.testing.assert_allclose(wrench[:3], 0.0, atol=1e-6)
        couple = -np.sign(angle) * push * apart * np.cos(angle)
        np.testing.assert_allclose(wrench[3:], [couple, 0.0, 0.0], atol=1e-6)
        assert push > 1.0


@pytest.fixture(scope="module")
def inserted():
    scenario = replace(LoadScenario("peg_in_slot"), wrist_sensor__ideal=True)
    station = MakeTeleopStation(
        scenario, load_estimate=np.concatenate([np.zeros(6), slave_at(scenario.slot).arm.phi_load])
    )
    return scenario, simulate(station, scenario.simulation)


@pytest.mark.slow
def test_peg_enters_the_slot_and_rests_on_the_floor(inserted):
    _, result = inserted
    force = result["true_contact_wrench_W"][:, :3]
    # The peg starts free; the chamfer on the side of the offset pushes it back and up.
    first = np.flatnonzero(force.any(axis=1))[0]
    assert 0.3 < result.t[first] < 1.0
    assert force[first + 5, 1] < 0.0 < force[first + 5, 2]
    at_the_end = force[result.t > 1.6]
    assert np.all(at_the_end[:, 2] > 10.0)
    assert np.ptp(at_the_end[:, 1]) < 1.0
    assert np.linalg.norm(force, axis=1).max() < 40.0
    assert "sheet_state" not in result


@pytest.mark.slow
def test_contact_only_takes_energy_from_the_tool(inserted):
    """Contact springs return at most their energy; friction dissipates."""
    scenario, result = inserted
    arm, n = slave_at(scenario.slot).arm, 6
    J, R, p, power = np.empty((6, n)), np.empty((3, 3)), np.empty(3), []
    for state, wrench in zip(result["slave_state"], result["true_contact_wrench_W"], strict=True):
        jacobian(arm.table, state[:n], J)
        forward_kinematics(arm.table, state[:n], R, p)
        twist = J @ state[n:]
        about_So = wrench[3:] - np.cross(p, wrench[:3])
        power.append(wrench[:3] @ twist[:3] + about_So @ twist[3:])
    work = np.cumsum(power) * 1e-3
    assert work.max() < 1e-4
    assert work[-1] < -0.02


def test_replay_contains_slot_and_peg_at_their_poses(inserted, meshcat):
    scenario, result = inserted
    scene = ReplayScene(meshcat, scenario, result)
    scene.show_sample(0.0, result, len(result.t) - 1)
    slot = scene.plant.GetBodyByName("slot").EvalPoseInWorld(scene.context)
    np.testing.assert_allclose(slot.translation(), scenario.slot.position)
    assert len(scene.plant.GetVisualGeometriesForBody(scene.plant.GetBodyByName("slot"))) == 7
    tip = scene.plant.GetFrameByName("tip").CalcPoseInWorld(scene.context).translation()
    depth = scenario.slot.position[2] - tip[2]
    assert depth == pytest.approx(scenario.slot.depth, abs=4e-3)
    assert abs(tip[1]) < scenario.slot.clearance / 2 + 2e-3
