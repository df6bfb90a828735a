"""Several objects, fixed and moving, against Drake's contact, reactions and statics."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.common.yaml import yaml_load
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    SpatialInertia,
)
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.lab.analysis.linearization import linearize
from drake_teleop.lab.identification import true_load
from drake_teleop.lab.run import ScenarioRun, summarise
from drake_teleop.station.environment.environment import SeveralObjects
from drake_teleop.station.environment.moving_bodies import (
    MakeJointTableAndRowBodies,
    interpolate_joint_state,
    poses_and_twists_into,
)
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.environment.solids import Block, Box, Wall
from drake_teleop.station.operator.operator import MinimumJerk
from drake_teleop.station.replay import ReplayScene
from drake_teleop.station.scenario import LoadScenario, Scenario, ScenarioFromData, replace
from drake_teleop.station.simulation import MakeSimulator, simulate
from drake_teleop.station.slave.plant import AddSlavePlant, hull_points_of
from drake_teleop.station.slave.plant_dynamics import (
    PROXIMITY_FAR,
    PROXIMITY_NEAR_MONITORED,
    PROXIMITY_TOUCHING,
    ContactPlantCopy,
    classify_tool_proximity,
    contact_and_plant_rates_into,
    contact_wrench_W,
    environment_wrench_about_Wo_into,
)
from drake_teleop.station.slave.posture_shapes import start_overlap_texts
from drake_teleop.station.slave.scene import Scene
from drake_teleop.station.slave.slave_config import Ball, Slave, Tool
from drake_teleop.station.slave.slave_config import Block as ToolBox
from drake_teleop.station.station import GetBlock, MakeTeleopStation

SOFT_PAD = """
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="pad"><link name="pad">
<collision name="pad"><geometry><cylinder><radius>0.05</radius><length>0.02</length></cylinder>
</geometry><drake:proximity_properties><drake:compliant_hydroelastic/>
<drake:hydroelastic_modulus>1e6</drake:hydroelastic_modulus>
<drake:mesh_resolution_hint>0.02</drake:mesh_resolution_hint>
<drake:hunt_crossley_dissipation>1.0</drake:hunt_crossley_dissipation>
<drake:mu_dynamic>0.3</drake:mu_dynamic></drake:proximity_properties></collision>
</link></model></sdf>
"""


def test_walls_and_boxes_follow_drakes_contact_law():
    """The ball is in a corner of a soft rough floor, a stiff smooth wall and a tilted box."""
    corner = SeveralObjects(
        [
            Wall(position=[0.55, 0.0, 0.2], stiffness=3e3, dissipation=4.0, friction=0.7),
            Wall(position=[0.567, 0.0, 0.2], normal=[-1.0, 0.0, 0.2], stiffness=7e5, friction=0.1),
            Box(position=[0.55, 0.07, 0.2], rotation=[0.3, 0.1, 0.0], size=[0.1, 0.1, 0.1]),
        ]
    )
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, Slave(position=[0.55, 0.0, 0.398]), corner)
    root = builder.Build().CreateDefaultContext()
    plant, context = slave.plant, slave.plant.GetMyMutableContextFromRoot(root)
    random, home = np.random.default_rng(0), plant.GetPositions(context, slave.instance)
    found, most = np.zeros(6), 0
    for _ in range(300):
        q = home + 0.02 * random.uniform(-1, 1, 6)
        v = random.normal(size=6) * 10.0 ** random.uniform(-5, 0)
        plant.SetPositions(context, slave.instance, q)
        plant.SetVelocities(context, slave.instance, v)
        results = plant.get_contact_results_output_port().Eval(context)
        most = max(most, results.num_point_pair_contacts())
        environment_wrench_about_Wo_into(
            slave.arm.table,
            slave.contact.compiled_pairs,
            slave.contact.joint_table,
            np.zeros(6),
            q,
            v,
            np.zeros(2),
            np.zeros(0),
            found,
        )
        expected = contact_wrench_W(results, slave.contact.tool_bodies, slave.contact.tool_shapes)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert slave.contact.drake_contact_reason == ""
    assert most == 3


CABINET = """
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="cabinet">
<link name="case"/><link name="door"><pose>0.1 0.02 0.03 0.1 0.2 0.3</pose></link>
<link name="drawer"><pose>0.2 0 0.1 0 0.4 0</pose>
<collision name="box"><pose>0.01 0 0 0 0 0.2</pose>
<geometry><box><size>0.1 0.1 0.06</size></box></geometry><drake:proximity_properties>
<drake:point_contact_stiffness>3e4</drake:point_contact_stiffness><drake:mu_dynamic>0.4
</drake:mu_dynamic><drake:hunt_crossley_dissipation>2.0</drake:hunt_crossley_dissipation>
</drake:proximity_properties></collision></link>
<joint name="slide" type="prismatic"><parent>door</parent><child>drawer</child>
<pose>0.01 0.02 0.03 0 0 0.1</pose><axis><xyz>0.6 0 0.8</xyz></axis></joint>
<joint name="hinge" type="revolute"><parent>case</parent><child>door</child>
<pose>0 0.02 0 0.3 0 0</pose><axis><xyz>0 0.6 0.8</xyz></axis></joint>
</model></sdf>
"""


def test_moving_bodies_follow_drakes_contact_law(tmp_path):
    """A block falls over, and a drawer slides in a rotating door."""
    (tmp_path / "cabinet.sdf").write_text(CABINET)
    cabinet = Scene(file=str(tmp_path / "cabinet.sdf"), position=[0.4, 0.0, 0.1])
    both = SeveralObjects([Block(position=[0.5, 0.0, 0.0], friction=0.6), cabinet])
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, Slave(position=[0.6, 0.0, 0.4]), both)
    root = builder.Build().CreateDefaultContext()
    plant, context = slave.plant, slave.plant.GetMyMutableContextFromRoot(root)
    block, random = plant.GetBodyByName("block"), np.random.default_rng(0)
    home, found, touched = plant.GetPositions(context, slave.instance), np.zeros(6), set()
    for k in range(300):
        plant.SetPositions(context, slave.instance, home + 0.01 * random.uniform(-1, 1, 6))
        turn = RollPitchYaw(random.uniform(-3, 3, 3))
        aside = RotationMatrix(turn) @ [0.05 if k % 2 else 0.5, 0.0, 0.0]
        plant.SetFreeBodyPose(context, block, RigidTransform(turn, slave.p_WTip_start + aside))
        plant.GetJointByName("hinge").set_angle(context, 0.3 * random.uniform(-1, 1))
        plant.GetJointByName("slide").set_translation(context, 0.1 * random.uniform(-1, 1))
        size = plant.num_velocities()
        plant.SetVelocities(context, random.normal(size=size) * 10.0 ** random.uniform(-4, 0))
        results = plant.get_contact_results_output_port().Eval(context)
        expected = contact_wrench_W(results, slave.contact.tool_bodies, slave.contact.tool_shapes)
        arm = [get(context, slave.instance) for get in (plant.GetPositions, plant.GetVelocities)]
        state = plant.GetPositionsAndVelocities(context)
        environment_wrench_about_Wo_into(
            *(
                slave.arm.table,
                slave.contact.compiled_pairs,
                slave.contact.joint_table,
                np.zeros(6),
            ),
            *arm,
            np.zeros(2),
            state,
            found,
        )
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
        touched.add((bool(k % 2), bool(expected.any())))
    assert slave.contact.drake_contact_reason == ""
    assert len(touched) == 4  # with contact of the block and without


@pytest.mark.parametrize("depth", [0.0, 0.01])
def test_a_drawer_is_not_a_leaf_for_the_states_between_steps(tmp_path, depth):
    """The states of a leaf, which does not exist, stay at zero in contact."""
    (tmp_path / "cabinet.sdf").write_text(CABINET)
    cabinet = Scene(file=str(tmp_path / "cabinet.sdf"))
    first = AddSlavePlant(DiagramBuilder(), Slave(), cabinet)
    drawer, context = first.plant.GetBodyByName("drawer"), first.plant.CreateDefaultContext()
    p_WDrawer = drawer.EvalPoseInWorld(context).translation()
    cabinet.position = np.add(first.p_WTip_start - p_WDrawer, depth).tolist()
    slave = AddSlavePlant(DiagramBuilder(), Slave(), cabinet)
    n, wrench_W = slave.arm.num_joints, np.zeros(6)
    state = slave.plant.GetPositionsAndVelocities(slave.plant.CreateDefaultContext())
    x = np.concatenate([slave.start, np.zeros(n + 2), state])
    xdot, none = np.zeros(2 * n + 2), np.zeros(6)
    contact_and_plant_rates_into(slave.compiled_constants, x, np.zeros(n), none, wrench_W, xdot)
    assert np.linalg.norm(wrench_W[:3]) > 1.0
    assert xdot[n] == xdot[-1] == 0.0


@pytest.mark.parametrize("depth", [0.001, 0.004])
@pytest.mark.parametrize("link", ["world", "floor"])
def test_shapes_on_the_world_follow_drakes_contact_law(tmp_path, depth, link):
    """A URDF may give shapes to the link `world`, beside other bodies."""
    surface = (
        '<drake:proximity_properties><drake:point_contact_stiffness value="3e4"/>'
        '<drake:mu_dynamic value="0.4"/><drake:hunt_crossley_dissipation value="1.0"/>'
        "</drake:proximity_properties>"
    )
    links = "".join(
        f'<link name="{name}"><collision><origin xyz="{place} 0.0 {0.15 + depth}"/><geometry>'
        f'<box size="0.3 0.3 0.2"/></geometry>{surface}</collision></link>'
        for name, place in ((link, 0.55), ("cup", 1.55))
    )
    joint = f'<joint name="j" type="fixed"><parent link="{link}"/><child link="cup"/></joint>'
    text = f'<robot name="s" xmlns:drake="d">{links}{joint}</robot>'
    (tmp_path / "scene.urdf").write_text(text)
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, Slave(), Scene(file=str(tmp_path / "scene.urdf")))
    root = builder.Build().CreateDefaultContext()
    context, contact, found = (
        slave.plant.GetMyContextFromRoot(root),
        slave.contact,
        np.zeros(6),
    )
    results = slave.plant.get_contact_results_output_port().Eval(context)
    expected = contact_wrench_W(results, contact.tool_bodies, contact.tool_shapes)
    tables = slave.arm.table, contact.compiled_pairs, contact.joint_table, np.zeros(6)
    states = slave.start, np.zeros(6), np.zeros(2), np.zeros(0)
    environment_wrench_about_Wo_into(*tables, *states, found)
    assert expected[2] > 10.0
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_bodies_move_smoothly_between_two_states():
    """A body that rotates about two axes, at a half and a third of a step."""
    plant = AddSlavePlant(DiagramBuilder(), Slave(), SeveralObjects([Block(), Scene()])).plant
    bodies = [plant.GetBodyByName(name).index() for name in ("block", "door")]
    (joints, order), h = MakeJointTableAndRowBodies(plant, bodies), 0.002
    assert order == [int(body) for body in bodies]

    def state(t: float) -> np.ndarray:
        context = plant.CreateDefaultContext()
        turn = RotationMatrix(AngleAxis(8 * t, [0.6, 0.0, 0.8]))
        place = [np.sin(9 * t), t, -(t**2)]
        block, hinge = plant.get_body(bodies[0]), plant.GetJointByName("hinge")
        plant.SetFreeBodyPose(context, block, RigidTransform(turn, place))
        speed = SpatialVelocity([4.8, 0.0, 6.4], [9 * np.cos(9 * t), 1.0, -2 * t])
        plant.SetFreeBodySpatialVelocity(context, block, speed)
        hinge.set_angle(context, np.sin(5 * t))
        hinge.set_angular_rate(context, 5 * np.cos(5 * t))
        return plant.GetPositionsAndVelocities(context)

    for u in (1 / 3, 0.5):
        start, end, found = state(0.1), state(0.1 + h), state(0.1)
        interpolate_joint_state(joints, h, u, start, end, found)
        poses, expected = np.empty((2, 2, 13))
        poses_and_twists_into(joints, found, poses)
        poses_and_twists_into(joints, state(0.1 + u * h), expected)
        np.testing.assert_allclose(poses[:, :7], expected[:, :7], atol=1e-9)
        np.testing.assert_allclose(poses[:, 7:], expected[:, 7:], atol=2e-6)


def test_chain_of_all_joints_moves_as_in_drake():
    """Floating, revolute and prismatic joint, all between rotated frames."""
    plant, rng = MultibodyPlant(0.0), np.random.default_rng(3)
    above, bodies = plant.world_frame(), []
    for name, joint in (
        ("floats", QuaternionFloatingJoint),
        ("turns", lambda *ends: RevoluteJoint(*ends, [0.6, 0.0, 0.8])),
        ("slides", lambda *ends: PrismaticJoint(*ends, [0.0, -0.8, 0.6])),
    ):
        body = plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        ends = []
        for frame in (above, body.body_frame()):
            offset = RigidTransform(RollPitchYaw(*rng.normal(size=3)), rng.normal(size=3))
            end = FixedOffsetFrame(f"{name}_{len(ends)}", frame, offset)
            ends.append(plant.AddFrame(end))
        plant.AddJoint(joint(f"{name}_joint", *ends))
        above = body.body_frame()
        bodies.append(body)
    plant.Finalize()
    context, state = plant.CreateDefaultContext(), rng.normal(size=17)
    state[:4] /= np.linalg.norm(state[:4])
    plant.SetPositionsAndVelocities(context, state)
    joints, _ = MakeJointTableAndRowBodies(plant, [body.index() for body in bodies])
    found = np.empty((3, 13))
    poses_and_twists_into(joints, state, found)
    for row, body in zip(found, bodies, strict=True):
        X = plant.EvalBodyPoseInWorld(context, body)
        V = plant.EvalBodySpatialVelocityInWorld(context, body)
        assert abs(row[:4] @ X.rotation().ToQuaternion().wxyz()) == pytest.approx(1.0)
        expected = [X.translation(), V.rotational(), V.translational()]
        np.testing.assert_allclose(row[4:], np.concatenate(expected), atol=1e-12)


@pytest.fixture(scope="module")
def pad(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("scene") / "pad.sdf"
    path.write_text(SOFT_PAD)
    return str(path)


@pytest.mark.parametrize("case", ["block", "pad", "leaf"])
def test_wrist_wrench_is_the_reaction_for_every_environment(case, pad):
    """A pushed block, a pressure field, a leaf beside a wall; at the sensor's 8 kHz."""
    things = {
        "block": [Block(position=[0.561, 0.0, 0.2])],  # the ball begins 1 mm deep in it
        "pad": [Scene(file=pad, position=[0.5, 0.0, 0.241], contact="hydroelastic")],
        "leaf": [SheetSpring(position=[0.5, 0.0, 0.251]), Wall(position=[0.4, 0.0, 0.252])],
    }
    scenario = replace(
        Scenario(),
        environment=things[case],
        slave__position=[0.5, 0.0, 0.45],
        wrist_sensor__ideal=True,
        simulation__settle=0.0,
        force_scaling__force_scale=0.0,
        operator__intent=[MinimumJerk(duration=0.1, translation=[0.03, 0.0, -0.005])],
    )
    simulator = MakeSimulator(MakeTeleopStation(scenario), scenario.simulation)
    simulator.Initialize()
    station, root = simulator.get_system(), simulator.get_mutable_context()
    plant, sensor = (GetBlock(station, name) for name in ("slave_plant", "wrist_sensor"))
    context, sensed = plant.GetMyContextFromRoot(root), sensor.GetMyContextFromRoot(root)
    place = list(plant.GetJointIndices()).index(plant.GetJointByName("sensor_weld").index())
    truth, peak, error = station.GetOutputPort("true_contact_wrench_W"), 0.0, 0.0
    # Sampling with the compiled law is inside steps, and now only where the torque changes.
    due = 4 if case == "block" else 1
    for k in range(due, 161, due):
        simulator.AdvanceTo(k * 0.000125)
        reaction = plant.get_reaction_forces_output_port().Eval(context)[place]
        expected = np.concatenate([reaction.translational(), reaction.rotational()])
        peak = max(peak, np.linalg.norm(truth.Eval(root)[:3]))
        simulator.AdvancePendingEvents()
        sample = sensed.get_discrete_state_vector().value()[:6]
        error = max(error, np.abs(sample - expected).max())
    assert peak > 1.0
    assert error < 1e-12
    if case != "leaf":
        return
    # Its log has the leaf, and no other body moves.
    assert station.HasOutputPort("sheet_state")
    assert "sheet spring is not the only object" in sensor.reason_beyond_contact_law


def test_drake_computes_unmodelled_contacts_between_the_steps(monkeypatch):
    """A box inside the ball, out of reach, makes Drake compute the same samples."""
    asked, wrench_W = [], ContactPlantCopy.wrench_W

    def record_call(twin, x, state):
        asked.append((x.copy(), state.copy()))
        return wrench_W(twin, x, state)

    monkeypatch.setattr(ContactPlantCopy, "wrench_W", record_call)
    ball, box = Ball(0.012, [0.0, 0.0, 0.188]), ToolBox([0.004] * 3, [0.0, 0.0, 0.188])
    logs, watched = [], []
    for shapes in ([ball], [ball, box]):
        scenario = replace(
            Scenario(),
            environment=[Block(position=[0.561, 0.0, 0.2])],
            slave=Slave(position=[0.5, 0.0, 0.45], tool=Tool(mass=1.0, shapes=shapes)),
            wrist_sensor__ideal=True,
            simulation__settle=0.0,
            simulation__duration=0.006,
            rates__log_hz=2000.0,  # sample before the present one, inside a step
        )
        station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
        logs.append(simulate(station, scenario.simulation))
        slave = AddSlavePlant(DiagramBuilder(), scenario.slave, scenario.surroundings)
        watched.append(len(slave.contact.monitored_pairs))
    assert watched == [0, 2]  # its table, too
    # All numbers of the state differ; it contains that of the arm twice.
    start = slave.arm.num_joints
    assert len(asked) > 10
    for x, state in asked:
        np.testing.assert_allclose(state[:start], x[:start], atol=1e-4)
    law, drake = (log["measured_wrench_S"] for log in logs)
    assert np.abs(law[:, 0]).max() > 1.0
    np.testing.assert_allclose(drake, law, atol=1e-9)


def test_separation_of_tool_and_unmodelled_shapes():
    """A box that only Drake supports counts from 2 cm on; the ball counts from contact on."""
    shapes = [Ball(0.012, [0.0, 0.0, 0.188]), ToolBox([0.004] * 3, [0.0, 0.0, 0.1])]
    slave = Slave(position=[0.5, 0.0, 0.45], tool=Tool(mass=1.0, shapes=shapes))
    wall = Wall(position=[0.5, 0.0, 0.0])
    built, found = AddSlavePlant(DiagramBuilder(), slave, wall), []
    pairs, joints = built.contact.compiled_pairs, built.contact.joint_table
    for height in (0.2499, 0.2501, 0.3279, 0.3281):
        rows = [pairs.copy(), built.contact.monitored_pairs.copy()]
        for row in rows:
            row[:, 15] += height
        nothing = np.zeros(2)
        found.append(
            classify_tool_proximity(built.arm.table, *rows, joints, built.start, nothing, nothing)
        )
    assert found == [
        PROXIMITY_FAR,
        PROXIMITY_TOUCHING,
        PROXIMITY_TOUCHING,
        PROXIMITY_NEAR_MONITORED,
    ]  # from 0.45 - 0.1 - 0.002 - 0.02


@pytest.mark.parametrize("size", [[0.2, 0.1, 0.05], [0.06, 0.08, 0.3]])
def test_block_of_any_edges_starts_on_its_table(size):
    """Tables may be smaller than the height of the block."""
    block = Block(position=[0.6, 0.1, 0.2], yaw=0.4, size=size, table=[0.25, 0.26])
    block.check("environment")
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.0)
    block.AddTo(plant)
    plant.Finalize()
    context, inspector = plant.CreateDefaultContext(), scene_graph.model_inspector()
    middle = np.add(block.position, [0.0, 0.0, size[2] / 2])
    below = np.add(block.position, [0.0, 0.0, -0.025])
    for name, yaw, centre, edges in (
        ("block", 0.4, middle, size),
        ("table", 0.0, below, [0.25, 0.26, 0.05]),
    ):
        body = plant.GetBodyByName(name)
        found = plant.EvalBodyPoseInWorld(context, body)
        assert found.IsNearlyEqualTo(RigidTransform(RollPitchYaw(0.0, 0.0, yaw), centre), 1e-12)
        shapes = plant.GetCollisionGeometriesForBody(body)
        points = [hull_points_of(inspector, shape) for shape in shapes]
        for part in (points[0], np.concatenate(points)):
            np.testing.assert_allclose(part.max(axis=0), np.divide(edges, 2), atol=1e-12)
            np.testing.assert_allclose(part.min(axis=0), np.divide(edges, -2), atol=1e-12)


@pytest.mark.slow
def test_pushed_block_resists_by_friction():
    """mu m g in steady sliding; the summary has the distance."""
    scenario = replace(LoadScenario("push_block"), wrist_sensor__ideal=True)
    estimate = true_load(scenario)
    result = simulate(MakeTeleopStation(scenario, load_estimate=estimate), scenario.simulation)
    (block,) = scenario.environment
    (sliding,) = np.nonzero((result.t > 0.6) & (result.t < 1.1))
    f = result["true_contact_wrench_W"][sliding, :3].mean(axis=0)
    # The ball also rubs on the block, and presses it down by the upward force on the ball.
    weight = block.mass * 9.81 + f[2]
    speed = np.gradient(result["pose_of_block"][:, 4], result.t)[sliding]
    push = -f[0] - block.mass * (speed[-1] - speed[0]) / np.ptp(result.t[sliding])
    assert speed.min() > 0.01
    assert push == pytest.approx(block.friction * weight, rel=0.005)
    contact = result["contact_wrench_S"][sliding, 0].mean()  # x_S is x_W
    assert contact == pytest.approx(-f[0], rel=0.02)
    summary = summarise(ScenarioRun(scenario, result, None, "", 1.0))
    assert 40.0 < summary["moved_mm"]["block"] < 60.0
    assert summary["turned_deg"]["block"] < 2.0
    assert "contact_by" not in summary


def test_replay_shows_moving_bodies_at_their_poses(tmp_path, meshcat):
    """A rotated block and an open door, from their poses alone."""
    hinge = '<joint name="hinge" type="revolute">'
    text = (models_dir() / "door.sdf").read_text()
    aside = f"{hinge}<pose>0.01 0.02 0.03 0 0 0.4</pose>"  # its frames are not those of its bodies
    (tmp_path / "door.sdf").write_text(text.replace(hinge, aside))
    file = str(tmp_path / "door.sdf")
    door = Scene(file=file, position=[0.4, 0.3, 0.1], rotation=[0.0, 0.0, 0.7])
    scenario = replace(Scenario(), environment=[Block(), door])
    turned = RollPitchYaw(0.1, -0.2, 0.5).ToQuaternion().wxyz()
    opened = RollPitchYaw(0.0, 0.0, 0.7 + 0.6).ToQuaternion().wxyz()
    # The hinge does not move.
    p_DoorHinge = np.array([0.01, 0.02, 0.03])
    closed, open_ = (RotationMatrix(RollPitchYaw(0.0, 0.0, yaw)) for yaw in (0.7, 1.3))
    place = np.array([0.4, 0.3, 0.1]) + closed @ p_DoorHinge - open_ @ p_DoorHinge
    poses = {
        "pose_of_block": np.array([[*turned, 0.7, 0.1, 0.3]]),
        "pose_of_door": np.array([[*opened, *place]]),
    }
    still = {
        "slave_state": np.zeros((1, 12)),
        "measured_wrench_S": np.zeros((1, 6)),
        "load_estimate": np.zeros((1, 16)),
    }
    scene = ReplayScene(meshcat, scenario, still | poses)
    scene.show_sample(0.0, still | poses, 0)
    for name, pose in poses.items():
        body = scene.plant.GetBodyByName(name.removeprefix("pose_of_"))
        X_WBody = body.EvalPoseInWorld(scene.context)
        np.testing.assert_allclose(X_WBody.rotation().ToQuaternion().wxyz(), pose[0, :4], atol=1e-9)
        np.testing.assert_allclose(X_WBody.translation(), pose[0, 4:], atol=1e-12)
    hinge = scene.plant.GetJointByName("hinge")
    assert hinge.get_angle(scene.context) == pytest.approx(0.6, abs=1e-9)


def test_example_of_the_docs_runs():
    text = (Path(__file__).parents[2] / "docs" / "station.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```yaml\n(environment:.*?)^```$", text, re.M | re.S)
    scenario = ScenarioFromData(yaml_load(data=example), "station.md")
    slave = AddSlavePlant(DiagramBuilder(), Slave(), scenario.surroundings)
    assert set(slave.contact.moving_bodies) == {"block", "door"}
    assert slave.contact.drake_contact_reason == ""


def test_unmodelled_contact_is_not_linearised():
    scenario = replace(Scenario(), environment=[Block()])
    with pytest.raises(DrakeTeleopError, match="cannot be linearised: block can move"):
        linearize(scenario)


MODEL = '<model name="{0}"><pose>{1}</pose><link name="{0}"/></model>'


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_bodies_of_a_scene_keep_their_poses_in_the_file(tmp_path, fixed, yaw):
    poses = {"cup": [0.1, 0.2, 0.3, 0.0, 0.0, 0.5], "pan": [-0.4, 0.0, 0.1, 0.2, 0.0, 0.0]}
    models = [MODEL.format(name, " ".join(map(str, pose))) for name, pose in poses.items()]
    text = f'<sdf version="1.9"><world name="w">{"".join(models)}</world></sdf>'
    (tmp_path / "table.sdf").write_text(text)
    place = [0.5, -0.1, 0.2]
    file, plant = str(tmp_path / "table.sdf"), MultibodyPlant(0.0)
    Scene(file=file, position=place, rotation=[0.0, 0.0, yaw], fixed=fixed).AddTo(plant)
    plant.Finalize()
    context, X_WFile = plant.CreateDefaultContext(), RigidTransform(RollPitchYaw(0, 0, yaw), place)
    for name, (*p, roll, pitch, turn) in poses.items():
        X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(name))
        expected = X_WFile @ RigidTransform(RollPitchYaw(roll, pitch, turn), p)
        np.testing.assert_allclose(X_WB.GetAsMatrix34(), expected.GetAsMatrix34(), atol=1e-12)


PLATE = '<link name="plate"/>'
ON_WORLD = '<joint name="j" type="{}"><parent>world</parent><child>plate</child>{}</joint>'
DIRECTIVES = """directives:
- add_model: {name: m, file: "file://FOLDER/plate.sdf"}
- add_weld: {parent: world, child: "m::plate", X_PC: {translation: [0.1, 0.2, 0.3]}}
"""


@pytest.mark.parametrize("yaw", [0.0, 0.7])
@pytest.mark.parametrize("kind", ["static", "joint", "urdf", "dmd.yaml"])
def test_links_that_the_file_fixes_to_the_world_move_with_it(tmp_path, kind, yaw):
    own, joint = "<pose>0.1 0.2 0.3 0 0 0</pose>", ON_WORLD.format("fixed", "")
    inside = {"static": "<static>1</static>", "joint": joint}.get(kind, "")
    model = f'<model name="m">{own if inside else ""}{PLATE}{inside}</model>'
    (tmp_path / "plate.sdf").write_text(f'<sdf version="1.9">{model}</sdf>')
    end = '<origin xyz="0.1 0.2 0.3"/><parent link="world"/><child link="plate"/>'
    text = f'<robot name="r"><link name="world"/>{PLATE}<joint name="j" type="fixed">{end}</joint>'
    (tmp_path / "plate.urdf").write_text(f"{text}</robot>")
    (tmp_path / "plate.dmd.yaml").write_text(DIRECTIVES.replace("FOLDER", str(tmp_path)))
    file, plant = f"plate.{kind if '.' in kind or kind == 'urdf' else 'sdf'}", MultibodyPlant(0.0)
    place = [0.5, -0.1, 0.2]
    Scene(file=str(tmp_path / file), position=place, rotation=[0.0, 0.0, yaw]).AddTo(plant)
    plant.Finalize()
    X_WB = plant.EvalBodyPoseInWorld(plant.CreateDefaultContext(), plant.GetBodyByName("plate"))
    expected = RigidTransform(RollPitchYaw(0, 0, yaw), place) @ np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(X_WB.translation(), expected, atol=1e-12)
    turned = RotationMatrix.MakeZRotation(yaw).matrix()
    np.testing.assert_allclose(X_WB.rotation().matrix(), turned, atol=1e-12)


def test_moving_joints_and_shapes_on_the_world_refuse_a_pose_of_the_file(tmp_path):
    hinge = ON_WORLD.format("revolute", "<axis><xyz>0 0 1</xyz></axis>")
    sdf = f'<sdf version="1.9"><model name="m">{PLATE}{hinge}</model></sdf>'
    mjcf = '<mujoco model="m"><worldbody><geom size="0.1"{}/></worldbody></mujoco>'
    seen = '<visual><geometry><sphere radius="0.1"/></geometry></visual>'
    for name, text, what in (
        ("a.sdf", sdf, "the joint j"),
        ("a.xml", mjcf.format(""), "a shape"),
        ("b.xml", mjcf.format(' contype="0" conaffinity="0"'), "a shape"),
        ("a.urdf", f'<robot name="r"><link name="world">{seen}</link></robot>', "a shape"),
    ):
        (tmp_path / name).write_text(text)
        for place, refused in (([0.5, 0.0, 0.0], True), ([0.0, 0.0, 0.0], False)):
            scene = Scene(file=str(tmp_path / name), position=place)
            plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
            if not refused:
                scene.AddTo(plant)
                continue
            with pytest.raises(DrakeTeleopError, match=f"cannot move {what} on the world; attach"):
                scene.AddTo(plant)


@pytest.mark.parametrize(("limit", "friction"), [(1.9, 0.0), (1e16, 0.3), (0.5, 0.2), (1e16, 0.0)])
def test_limits_and_friction_of_a_scene_without_effect_are_stated(tmp_path, limit, friction):
    text = (models_dir() / "door.sdf").read_text().replace(">1.9<", f">{limit}<")
    text = text.replace(">-1.9<", f">{-limit}<").replace(
        "<damping>", f"<friction>{friction}</friction><damping>"
    )
    (tmp_path / "mine.sdf").write_text(text)
    _, texts = start_overlap_texts(Slave(), Scene(file=str(tmp_path / "mine.sdf")))
    stated = [each for each in texts if each.startswith("mine.sdf: no ")]
    expected = ["dry friction"] * (friction > 0.0) + ["position limits"] * (limit < 1e4)
    assert stated == [f"mine.sdf: no effect of the {x} in the file on hinge" for x in expected]


def test_moving_bodies_with_similar_names_have_different_names(tmp_path):
    inertia = "<inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia>"
    names = ["left door", "left_door", "left-door", "lid"]
    links = "".join(
        f'<model name="m {k}"><link name="{name}"><inertial><mass>1</mass>{inertia}</inertial>'
        "</link></model>"
        for k, name in enumerate(names)
    )
    (tmp_path / "a.sdf").write_text(f'<sdf version="1.9"><world name="w">{links}</world></sdf>')
    scene = Scene(file=str(tmp_path / "a.sdf"), fixed=False)
    moving = AddSlavePlant(DiagramBuilder(), Slave(), scene).contact.moving_bodies
    assert len(set(moving.values())) == len(names)
    assert set(moving) == {"m_0_left_door", "m_1_left_door", "m_2_left_door", "lid"}


@pytest.mark.parametrize(
    ("normal", "second", "first"),
    [([0, 0, 1], 0, 1), ([0, 0, -1], 0, 1), ([1, 0, 0], 1, 2), ([0, -1, 0], 0, 2)],
)
def test_edges_of_a_wall_are_in_the_documented_order(normal, second, first):
    wall = Wall(position=[0.0, 0.0, 0.0], normal=list(map(float, normal)), size=[1.0, 0.2])
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    wall.AddTo(plant)
    plant.Finalize()
    (shape,) = plant.GetCollisionGeometriesForBody(plant.GetBodyByName("wall"))
    X_WBox = plant.GetBodyByName("wall").EvalPoseInWorld(plant.CreateDefaultContext())
    edges = (
        np.abs(X_WBox.rotation().matrix()) @ scene_graph.model_inspector().GetShape(shape).size()
    )
    np.testing.assert_allclose(edges[[first, second]], [1.0, 0.2], atol=1e-12)


NAMED_TOOL = """<robot name="block"><link name="{0}"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius="0.02"/></geometry></collision></link></robot>"""


@pytest.mark.parametrize("name", ["leaf", "block", "wall", "table"])
def test_contacts_do_not_depend_on_the_names_of_the_tools_links(tmp_path, name):
    def touchable(link):
        (tmp_path / "tool.urdf").write_text(NAMED_TOOL.format(link))
        builder, slave = DiagramBuilder(), Slave(tool=Tool(model=str(tmp_path / "tool.urdf")))
        both = SeveralObjects([Block(), Wall(), Block(position=[0.0, 0.5, 0.0]), SheetSpring()])
        AddSlavePlant(builder, slave, both)
        (scene_graph,) = (x for x in builder.GetSystems() if x.get_name() == "scene_graph")
        return len(scene_graph.model_inspector().GetCollisionCandidates())

    assert touchable(name) == touchable("grip")


@pytest.mark.parametrize(
    ("thing", "what"),
    [
        (
            {"_tag": "!Wall", "normal": [0.0, 0.0, 0.0]},
            r"environment\[0\].normal: the normal \[0.*\] has no direction",
        ),
        ({"_tag": "!Wall", "stiffness": 0.0}, r"environment\[0\].stiffness: 0 N/m is outside"),
        ({"_tag": "!Wal"}, r"environment\[0\]: '!Wal' is not known; did you mean 'Wall'"),
        ({"_tag": "!Block", "table": [0.05, 0.05]}, "smaller than the block"),
    ],
)
def test_invalid_environment_is_one_error(thing, what):
    with pytest.raises(DrakeTeleopError, match=what):
        ScenarioFromData({"environment": [thing]}, "scenario.yaml")


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("<drake:compliant_hydroelastic/>", "", "hydroelastic, but no shape in the file is"),
        ("</link>", '</link><joint name="j" type="fixed"><child>gone</child></joint>',
         "pad.sdf: joint j has no parent link"),
        ('link name="pad"', 'link name="tool"', "the body name tool is reserved"),
        ("<cylinder><radius>0.05</radius><length>0.02</length></cylinder>",
         "<mesh><uri>lost.obj</uri></mesh>", "shapes are missing of pad"),
    ],
)  # fmt: skip
def test_scene_that_cannot_be_touched_is_one_error(old, new, what, tmp_path):
    (tmp_path / "pad.sdf").write_text(SOFT_PAD.replace(old, new))
    scene = Scene(file=str(tmp_path / "pad.sdf"), contact="hydroelastic")
    with pytest.raises(DrakeTeleopError, match=what):
        AddSlavePlant(DiagramBuilder(), Slave(), scene)


def test_moving_body_without_mass_is_one_error(tmp_path):
    (tmp_path / "ghost.urdf").write_text('<robot name="ghost"><link name="ghost"/></robot>')
    scene = Scene(file=str(tmp_path / "ghost.urdf"), fixed=False)
    with pytest.raises(DrakeTeleopError, match="ghost can move, but has no mass"):
        AddSlavePlant(DiagramBuilder(), Slave(), scene)


def test_a_scene_is_found_from_the_scenarios_folder(tmp_path):
    (tmp_path / "mine.yaml").write_text("environment: [!Scene {file: pad.sdf}, !Scene {}]")
    absent = LoadScenario(tmp_path / "mine.yaml").surroundings
    with pytest.raises(DrakeTeleopError, match=r"pad\.sdf: file does not exist"):
        AddSlavePlant(DiagramBuilder(), Slave(), absent)
    (tmp_path / "pad.sdf").write_text(SOFT_PAD)
    (found, shipped) = LoadScenario(tmp_path / "mine.yaml").environment
    assert found.path == tmp_path / "pad.sdf"
    assert shipped.path.parent.name == "models"


def test_shape_without_contact_stiffness_is_named(tmp_path):
    shape = (
        '<collision name="c"><geometry><box><size>0.1 0.1 0.1</size></box></geometry></collision>'
    )
    link = f'<link name="plate">{shape}</link>'
    text = f'<sdf version="1.9"><model name="m"><static>1</static>{link}</model></sdf>'
    (tmp_path / "plate.sdf").write_text(text)
    scene = Scene(file=str(tmp_path / "plate.sdf"), position=[0.6, 0.0, 0.2])
    slave = AddSlavePlant(DiagramBuilder(), Slave(), scene)
    reason = slave.contact.drake_contact_reason
    assert reason.startswith("m::c: has no drake:point_contact_stiffness; add it to its")
