"""User-supplied arms in the station: seven joints, one of them prismatic, and invalid scenarios."""

from __future__ import annotations

import dataclasses
import re
from itertools import product

import numpy as np
import odd_arms
import pytest
from odd_arms import other_arm_urdf
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Role
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.lab.analysis.linearization import linearize, linearize_station
from drake_teleop.lab.identification import true_load
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.signals import SIGNALS
from drake_teleop.station.simulation import MakeSimulator, simulate
from drake_teleop.station.slave.arm import ROTOR_COLUMN
from drake_teleop.station.slave.chain_joints import AddSkeleton
from drake_teleop.station.slave.joint_commands import JointRangeMonitor, pick_ik_method
from drake_teleop.station.slave.models import ParseModel
from drake_teleop.station.slave.numeric_inverse_kinematics import NumericInverseKinematics
from drake_teleop.station.slave.plant import AddSlavePlant, NominalSlave, ParseSlave, start_pose
from drake_teleop.station.slave.slave_config import Ball, Block, Slave, Tool, p_STip_of_shapes
from drake_teleop.station.station import GetBlock, MakeTeleopStation

HOME = [0.3, 0.4, -0.2, 0.1, 0.5, -0.3, 0.2]
SCENARIO = """
simulation: {duration: 0.06, settle: 0.02}
operator:
  intent: [!Sine {duration: 10.0, ramp: 0.05, frequency: 3.0, translation: [0.01, 0.01, 0.02]}]
slave:
  model: arm.urdf
  sensor_frame: ft
  home: [0.3, 0.4, -0.2, 0.1, 0.5, -0.3, 0.2]
  tool: null
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with a scenario and an arm with a gripper and strong motors."""
    folder = tmp_path_factory.mktemp("station")
    text = other_arm_urdf(slides=4).replace('effort="40"', 'effort="400"')
    text = text.replace('ixy="0.001" ixz="-0.002" iyz="0.0015"', 'ixy="0" ixz="0" iyz="0"')
    # One joint has no statement that it has a motor.
    motor = text[text.index('<transmission type="SimpleTransmission"><joint name="j3"/>') :]
    text = text.replace(motor[: motor.index("</transmission>") + len("</transmission>")], "")
    (folder / "arm.urdf").write_text(text)
    (folder / "station.yaml").write_text(SCENARIO)
    return folder


@pytest.fixture(scope="module")
def scenario(folder):
    return LoadScenario(folder / "station.yaml")


@pytest.mark.slow
def test_wrench_is_reaction_of_sensor_weld(scenario):
    scenario = replace(scenario, wrist_sensor__ideal=True)
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    simulator = MakeSimulator(station, scenario.simulation)
    simulator.Initialize()
    plant, sensor = (GetBlock(station, name) for name in ("slave_plant", "wrist_sensor"))
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    sensed = sensor.GetMyContextFromRoot(simulator.get_mutable_context())
    weld = plant.GetJointByName("to_hand")
    place = list(plant.GetJointIndices()).index(weld.index())
    X_SJ = (
        plant.GetFrameByName("ft")
        .CalcPoseInWorld(context)
        .InvertAndCompose(weld.frame_on_child().CalcPoseInWorld(context))
    )
    for k in range(1, 60):
        simulator.AdvanceTo(1e-3 * k)
        at_J = plant.get_reaction_forces_output_port().Eval(context)[place]
        f, p = X_SJ.rotation() @ at_J.translational(), X_SJ.translation()
        tau = X_SJ.rotation() @ at_J.rotational() + np.cross(p, f)
        simulator.AdvancePendingEvents()
        sample = sensed.get_discrete_state_vector().value()[:6]
        np.testing.assert_allclose(sample, [*f, *tau], rtol=0, atol=1e-11)
    assert np.abs(sample).max() > 5.0


@pytest.mark.slow
def test_log_has_one_component_per_joint(scenario):
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    result = simulate(station, scenario.simulation, progress=False)
    for name in ("joint_position", "joint_torque", "joint_command"):
        assert result[name].shape == (61, 7)
    assert result["slave_state"].shape == (61, 14)
    assert result.specs[result.signals.index("slave_state")].components[-1] == "v_7"
    assert result["slave_state.q_4"][0] == pytest.approx(HOME[3], abs=5e-3)
    assert np.all(result["ik_status"] == 0)
    assert np.ptp(result["pose_command"][:, 6]) > 2e-3
    assert len(SIGNALS["slave_state"].components) == 12


def test_sliding_joints_and_devices_in_task_space_have_units_m_and_n(scenario):
    changed = replace(scenario, master__model="omega_6", simulation__duration=0.002)
    station = MakeTeleopStation(changed, load_estimate=true_load(changed))
    units = simulate(station, changed.simulation, progress=False).units
    for name, unit, force in (("joint_3", "rad", "N m"), ("joint_4", "m", "N")):
        assert units["joint_position"][name] == units["joint_command"][name] == unit
        assert units["joint_torque"][name] == force
    state = units["slave_state"]
    assert [state[k] for k in ("q_3", "q_4", "v_3", "v_4")] == ["rad", "m", "rad/s", "m/s"]
    device = units["master_state"]
    assert [device[k] for k in ("q_3", "q_4", "v_3", "v_4")] == ["m", "rad", "m/s", "rad/s"]
    assert units["measured_wrench_S"]["tau_x"] == "N m"


def test_start_pose_and_assumptions(scenario):
    slave = NominalSlave(scenario.slave)
    assert NominalSlave(scenario.slave) is slave
    np.testing.assert_array_equal(slave.start, HOME)
    plant, context = slave.plant, slave.plant.CreateDefaultContext()
    X_WS = plant.GetFrameByName("ft").CalcPoseInWorld(context)
    expected = [*X_WS.rotation().ToQuaternion().wxyz(), *X_WS.translation()]
    np.testing.assert_allclose(start_pose(scenario.slave), expected, atol=1e-12)
    # Without shapes the tip is at the centre of mass, here of hand and finger.
    assert slave.arm.phi_load[0] == pytest.approx(0.9)
    np.testing.assert_allclose(slave.tip, slave.arm.phi_load[1:4] / 0.9)
    assert "held: to_finger" in slave.assumptions
    assert slave.arm.joint_names == tuple(f"j{k}" for k in range(1, 8))
    assert plant.num_actuators() == plant.num_positions() == 7
    np.testing.assert_array_equal(slave.arm.effort_limit, 400.0)


def test_arm_with_rx90_geometry_uses_closed_form():
    copy = Slave(model=str(models_dir() / "rx90.sdf"))
    arm = NominalSlave(copy).arm
    assert pick_ik_method("automatic", arm) == "closed_form"
    np.testing.assert_array_equal(NominalSlave(copy).start, NominalSlave(Slave()).start)
    np.testing.assert_array_equal(NominalSlave(copy).tip, [0.0, 0.0, 0.2])
    moved = Slave(base_pose=[0.1, -0.2, 0.3, 0.0, 0.0, 0.5])
    arm = NominalSlave(moved).arm
    assert pick_ik_method("automatic", arm) == "numeric"
    with pytest.raises(DrakeTeleopError, match="closed form requires the geometry of an RX90"):
        pick_ik_method("closed_form", arm)
    plant, context = NominalSlave(moved).plant, NominalSlave(moved).plant.CreateDefaultContext()
    found = plant.GetFrameByName("sensor").CalcPoseInWorld(context)
    np.testing.assert_allclose(found.translation(), [0.55, 0.0, 0.45], atol=1e-8)
    np.testing.assert_allclose(found.rotation().matrix(), np.diag([1, -1, -1]), atol=1e-8)
    base = plant.GetBodyByName("base").EvalPoseInWorld(context)
    np.testing.assert_allclose(base.translation(), [0.1, -0.2, 0.3], atol=1e-15)


MJCF_ARM = """<mujoco model="m"><worldbody><body name="base" pos="0.1 0 0.5" euler="0 20 0">{}
<geom size="0.1"/><body name="link" pos="0 0 0.2"><joint axis="0 1 0"/><geom size="0.1"/>
<body name="ft" pos="0 0 0.3"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    "text",
    [
        *map(other_arm_urdf, ("fixed", "fixed"), ("world", "floor")),
        *map(MJCF_ARM.format, ("", "<freejoint/>")),
    ],
)
def test_base_pose_moves_an_arm_with_its_pose_in_the_file(tmp_path, text):
    path = tmp_path / ("arm.xml" if text.startswith("<mujoco") else "arm.urdf")
    path.write_text(text.replace('effort="40"', 'effort="400"'))
    q = np.full(1 if path.suffix == ".xml" else 7, 0.2)

    def pose(*base_pose):
        slave = Slave(model=str(path), sensor_frame="ft", home=list(q), base_pose=list(base_pose))
        qw, qx, qy, qz, *p = NominalSlave(slave).arm.pose(q)
        return RigidTransform(Quaternion(qw, qx, qy, qz), p)

    moved, at_rest = pose(0.3, -0.2, 0.7, 0.4, -0.3, 1.1), pose(*np.zeros(6))
    X_WBase = RigidTransform(RollPitchYaw(0.4, -0.3, 1.1), [0.3, -0.2, 0.7])
    assert moved.IsNearlyEqualTo(X_WBase @ at_rest, 1e-12)


BESIDE = """<link name="table"/><joint name="on_floor" type="{}"><origin xyz="0.9 0.2 0.1"/>
<parent link="world"/><child link="table"/><axis xyz="0 0 1"/></joint></robot>"""


@pytest.mark.parametrize("kind", ["fixed", "continuous"])
@pytest.mark.parametrize("yaw", [0.0, 1.1])
def test_base_pose_moves_all_links_that_the_file_attaches_to_the_world(tmp_path, kind, yaw):
    path, plant = tmp_path / "arm.urdf", MultibodyPlant(0.0)
    path.write_text(other_arm_urdf("fixed", "world").replace("</robot>", BESIDE.format(kind)))
    X_WBase = RigidTransform(RollPitchYaw(0.4, -0.3, yaw), [0.3, -0.2, 0.7])
    ParseModel(plant, path, "ft", X_WBase=X_WBase)
    plant.Finalize()
    found = plant.GetBodyByName("table").EvalPoseInWorld(plant.CreateDefaultContext())
    assert found.IsNearlyEqualTo(X_WBase @ RigidTransform([0.9, 0.2, 0.1]), 1e-12)


def test_base_pose_of_a_joint_on_the_world_is_one_error(tmp_path):
    text = MJCF_ARM.format('<joint axis="0 0 1" name="turn"/>')
    slave = Slave(model=str(tmp_path / "arm.xml"), sensor_frame="ft", base_pose=[0.1, *[0.0] * 5])
    (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(
        DrakeTeleopError, match=r"cannot move turn, which moves on the world; .*fix"
    ):
        NominalSlave(slave)
    attached = text.replace("<worldbody>", '<worldbody><body name="floor">')
    (tmp_path / "arm.xml").write_text(attached.replace("</worldbody>", "</body></worldbody>"))
    slave.home = [0.0, 0.2]
    assert NominalSlave(slave).X_WS_start[4] > 0.2


def test_tool_from_mass_and_shapes():
    inertia = [0.02, 1e-3, -2e-3, 0.03, 1.5e-3, 0.025]
    shapes = [Ball(0.02, [0, 0, 0.1]), Block([0.02, 0.06, 0.1], [0, 0.01, 0.1], [np.pi / 2, 0, 0])]
    tool = Tool(mass=2.0, com=[0.01, -0.02, 0.06], inertia=inertia, shapes=shapes)
    slave = NominalSlave(Slave(tool=tool))
    m, c = 2.0, np.array(tool.com)
    about_S = np.zeros((3, 3))
    about_S[np.triu_indices(3)] = inertia
    about_S = about_S + np.triu(about_S, 1).T + m * (c @ c * np.eye(3) - np.outer(c, c))
    expected = [m, *(m * c), *about_S[np.triu_indices(3)]]
    np.testing.assert_allclose(slave.arm.phi_load, expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(slave.tip, [0.0, 0.01, 0.13], atol=1e-15)  # half of 0.06, rotated
    touching = AddSlavePlant(
        DiagramBuilder(), Slave(tool=Tool(mass=2.0, shapes=shapes[:1])), SheetSpring()
    )
    np.testing.assert_allclose(
        touching.contact.compiled_pairs[0, :4], [0, 0, 0.1, 0.02], atol=1e-15
    )


def test_only_load_makes_contact(folder, tmp_path):
    ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    path, tool = tmp_path / "arm.urdf", Tool(mass=1.0, shapes=[Ball()])
    text = (folder / "arm.urdf").read_text()
    slave = Slave(model=str(path), sensor_frame="ft", home=HOME, tool=tool)
    for link, watched in (("l7", 0), ("hand", 1)):  # a ball without stiffness
        path.write_text(text.replace(f'<link name="{link}">', f'<link name="{link}">{ball}'))
        contact = AddSlavePlant(DiagramBuilder(), slave, SheetSpring()).contact
        assert (len(contact.monitored_pairs), len(contact.tool_shapes)) == (watched, 1 + watched)
        assert (len(contact.compiled_pairs), contact.drake_contact_reason) == (1, "")


@pytest.mark.parametrize("shape", ['<box size="3 3 0.1"/>', '<sphere radius="0.2"/>'])
def test_pedestals_of_model_directives_make_no_contact(folder, tmp_path, shape):
    collision = f"<collision><geometry>{shape}</geometry></collision>"
    text = f'<robot name="p"><link name="pedestal">{collision}</link></robot>'
    for name, content in (("pedestal", text), ("mine", (folder / "arm.urdf").read_text())):
        (tmp_path / f"{name}.urdf").write_text(content)
    urls = {name: (tmp_path / f"{name}.urdf").as_uri() for name in ("mine", "pedestal")}
    models = [f"- add_model: {{name: {name}, file: {url}}}" for name, url in urls.items()]
    (tmp_path / "arm.dmd.yaml").write_text("\n".join(["directives:", *models]))
    tool = Tool(mass=1.0, shapes=[Ball()])
    slave = Slave(model=str(tmp_path / "arm.dmd.yaml"), sensor_frame="ft", home=HOME, tool=tool)
    builder = DiagramBuilder()
    contact = AddSlavePlant(builder, slave, Wall()).contact
    (scene_graph,) = (each for each in builder.GetSystems() if each.get_name() == "scene_graph")
    inspector = scene_graph.model_inspector()
    touching = inspector.GetAllGeometryIds(Role.kProximity)
    assert {inspector.GetName(each) for each in touching} == {"tool::tool_0", "wall::wall"}
    assert (len(contact.compiled_pairs), contact.drake_contact_reason) == (1, "")


def test_model_directives_find_files_and_packages(folder, tmp_path):
    (tmp_path / "packages" / "parts").mkdir(parents=True)
    (tmp_path / "packages" / "parts" / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    shape = '<visual><geometry><mesh filename="package://parts/a.obj"/></geometry></visual>'
    text = (folder / "arm.urdf").read_text()
    (tmp_path / "arm.urdf").write_text(text.replace('<link name="l2">', f'<link name="l2">{shape}'))
    path = tmp_path / "arm.dmd.yaml"
    path.write_text(f"directives: [add_model: {{name: mine, file: {tmp_path.as_uri()}/arm.urdf}}]")
    slave = Slave(model=str(path), sensor_frame="ft", home=HOME, tool=None)
    missing = "shapes are missing of l2: meshes were not found"
    nominal = AddSlavePlant(DiagramBuilder(), slave, SheetSpring())
    assert any(text.startswith(missing) for text in nominal.assumptions)
    slave.package_paths = [str(tmp_path / "packages")]
    found = AddSlavePlant(DiagramBuilder(), slave, SheetSpring())
    assert not any("shapes" in text for text in found.assumptions)
    assert found.arm.phi_load[0] == pytest.approx(0.9)
    assert found.plant.HasModelInstanceNamed("arm")


def test_arm_without_visuals_is_shown_as_sticks(scenario):
    slave, builder = NominalSlave(scenario.slave), DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    parsed = ParseSlave(plant, scenario.slave)
    AddSkeleton(plant, parsed.sensor_frame)
    inspector = scene_graph.model_inspector()
    for k, joint in enumerate(slave.arm.joint_names[1:], start=1):
        (stick,) = plant.GetVisualGeometriesForBody(plant.GetBodyByName(f"l{k}"))
        half = inspector.GetShape(stick).length() / 2
        frame = plant.GetJointByName(joint).frame_on_parent()
        end = inspector.GetPoseInFrame(stick) @ np.array([0, 0, half])
        np.testing.assert_allclose(end, frame.GetFixedPoseInBodyFrame().translation(), atol=1e-12)
    assert len(inspector.GetAllGeometryIds(Role.kIllustration)) == 8  # base and seven links


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"sensor_frame": "nose"}, "no frames are named 'nose'"),
        ({"home": HOME[:6]}, "has 6 numbers, but the arm has 7 joints; give 7, for"),
        ({"home": [9.0, *HOME[1:]]}, "joint j1 at 9 is outside its limits, -2 to 2.5"),
        ({"home": [], "position": [4.0, 0.0, 0.4]}, "cannot reach.*slave.home"),
        ({"inverse_kinematics": "closed_form"}, "closed form requires the geometry of an RX90"),
        ({"tool": Tool(mass=90.0)}, "hold its 90.9 kg at the start: j4 needs 566 N, but its"),
        ({"torque_limits": {"j4": 5.0}}, "j4 .* its limit is 5 N;.*set slave.torque_limits"),
        ({"torque_limits": {"knee": 5.0}}, "the arm has no joint 'knee'; name one of j1, j2"),
        ({"torque_limits": {"j4": 0.0}}, "torque_limits.j4: 0 N m, N is outside 1e-06 to inf"),
        ({"sensor_frame": "finger"}, "no body with a mass is attached to finger"),
        ({"model": "absent.urdf"}, "absent.urdf: file does not exist"),
        ({"tool": Tool(model="a.sdf", mass=1.0)}, "tool.mass: a model file and a mass both define"),
        ({"tool": Tool(shapes=[Ball()])}, "require a mass"),
        ({"tool": Tool(mass=1.0, inertia=[1, 0, 0, 1, 0, 3])}, "the inertia is impossible"),
        ({"tip": [0.0, 0.1]}, "slave.tip: has 2 numbers; give 3 numbers, or none"),
    ],
)  # fmt: skip
def test_invalid_slave_raises_one_error(scenario, change, expected):
    changes = {f"slave__{name}": value for name, value in change.items()}
    with pytest.raises(DrakeTeleopError, match=expected):
        MakeTeleopStation(replace(scenario, **changes), load_estimate=np.ones(16))


def test_torque_limits_of_the_scenario_replace_those_of_the_model(scenario):
    own = NominalSlave(scenario.slave)
    limits = {"j2": 30.0, "j4": np.inf}
    slave = replace(scenario, slave__torque_limits=limits).slave
    nominal = NominalSlave(slave)
    assert own.arm.effort_limit[3] == 400.0 and nominal.arm.effort_limit[3] == np.inf
    assert nominal.arm.effort_limit[1] == 30.0 != own.arm.effort_limit[1]
    np.testing.assert_array_equal(nominal.arm.effort_limit[4:], own.arm.effort_limit[4:])
    assert any(text == "no force limit for j4" for text in nominal.assumptions)


def test_arm_without_inertia_gets_stated_rotor_inertias(folder, tmp_path):
    """Rotor inertias of 0.14 kg L^2, L the length of the arm; a slide moves 5 kg."""
    path, text = tmp_path / "arm.urdf", (folder / "arm.urdf").read_text()
    path.write_text(re.sub("<inertial>.*?</inertial>|<transmission.*?</transmission>", "", text))
    slave = Slave(model=str(path), sensor_frame="ft", home=HOME, tool=Tool(mass=1.0))
    nominal = NominalSlave(slave)
    length = sum(np.hypot(0.01 * k, np.hypot(0.1, 0.2)) for k in range(2, 8))
    length += np.linalg.norm([0.01, 0.02, 0.1])
    expected = np.full(7, 0.14 * length**2)
    expected[3] = 5.0
    np.testing.assert_allclose(nominal.arm.table[:-1, ROTOR_COLUMN], expected, rtol=1e-12)
    said = "; ".join(nominal.assumptions)
    assert f"a rotor inertia of {expected[0]:.3g} kg m^2, as the model has no inertia" in said
    assert "a moved mass of 5 kg, as the model has no inertia there, for j4" in said
    context = nominal.plant.CreateDefaultContext()
    mass_matrix = nominal.plant.CalcMassMatrix(context)
    assert np.linalg.cond(mass_matrix) < 100.0


def test_ledger_rejects_arm_with_five_joints(folder, scenario):
    five = replace(scenario, slave__sensor_frame="l5", slave__home=HOME[:5])
    assert NominalSlave(five.slave).arm.num_joints == 5
    assert "held: j6, j7, to_finger" in NominalSlave(five.slave).assumptions
    MakeTeleopStation(five, load_estimate=true_load(five))
    over = replace(five, channel=Channel(network="lan"), passivity__method="ledger")
    with pytest.raises(DrakeTeleopError, match="requires 6 or more joints, not 5"):
        MakeTeleopStation(over, load_estimate=true_load(five))


def test_spring_is_rejected(tmp_path):
    path, text = tmp_path / "arm.sdf", (models_dir() / "rx90.sdf").read_text()
    sprung = "<dynamics><spring_stiffness>5</spring_stiffness></dynamics></axis>"
    path.write_text(text.replace("</axis>", sprung, 1))
    with pytest.raises(DrakeTeleopError, match="the model has springs"):
        NominalSlave(Slave(model=str(path)))


def test_kinematic_loop_is_rejected(folder, tmp_path):
    text = (folder / "arm.urdf").read_text()
    loop = (
        '<drake:ball_constraint><drake:ball_constraint_body_A name="l3"/></drake:ball_constraint>'
    )
    path = tmp_path / "looped.urdf"
    path.write_text(text.replace("</robot>", f"{loop}</robot>"))
    with pytest.raises(DrakeTeleopError, match="drake:ball_constraint closes a loop"):
        NominalSlave(Slave(model=str(path), sensor_frame="ft", home=HOME))


def test_edited_model_is_read_again(folder, tmp_path):
    path, text = tmp_path / "arm.urdf", (folder / "arm.urdf").read_text()
    path.write_text(text)
    slave = Slave(model=str(path), sensor_frame="ft", home=HOME, tool=None)
    before = NominalSlave(slave).arm.phi_load[0]
    path.write_text(text.replace('mass value="0.8"', 'mass value="1.8"'))
    assert NominalSlave(slave).arm.phi_load[0] == pytest.approx(before + 1.0)


def test_default_arm_is_rx90():
    assert Scenario().slave.path == models_dir() / "rx90.sdf"
    assert NominalSlave(Slave()).assumptions == ()


def test_tip_is_between_fingers_of_gripper(folder, scenario):
    """The tip is between two rotated boxes, not at the centre of mass."""
    text = (folder / "arm.urdf").read_text()
    box = '<collision><geometry><box size="0.06 0.01 0.02"/></geometry></collision></link>'
    for side in (-1, 1):
        finger = odd_arms.link(f"f{side}").replace("</link>", box)
        at = odd_arms.joint(f"to_f{side}", "fixed", "ft", f"f{side}", f"{0.03 * side} 0.02 0.1")
        turned = at.replace('rpy="0 0 0"', 'rpy="0 1.5707963267948966 0"')
        text = text.replace("</robot>", f"{finger}{turned}</robot>")
    (folder / "gripper.urdf").write_text(text)
    slave = dataclasses.replace(scenario.slave, model=str(folder / "gripper.urdf"))
    np.testing.assert_allclose(NominalSlave(slave).tip, [0.0, 0.02, 0.13], atol=1e-12)
    # The size of a mesh is that of its points: this one between the fingers, with an edge on top.
    points = [(-0.01, -0.01, 0.0), (0.01, 0.01, 0.0), (-0.01, 0.01, 0.03), (0.01, -0.01, 0.05)]
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in points)
    (folder / "wedge.obj").write_text(corners + "f 1 2 3\nf 1 4 2\nf 2 4 3\nf 1 3 4\n")
    mesh = '<collision><geometry><mesh filename="wedge.obj"/></geometry></collision></link>'
    wedge = odd_arms.link("wedge").replace("</link>", mesh)
    at = odd_arms.joint("to_wedge", "fixed", "ft", "wedge", "0.006 0.02 0.1")
    (folder / "gripper.urdf").write_text(text.replace("</robot>", f"{wedge}{at}</robot>"))
    np.testing.assert_allclose(NominalSlave(slave).tip, [0.006, 0.02, 0.15], atol=1e-9)


def test_tip_is_on_a_tilted_ball(folder, scenario):
    ball = '<origin xyz="0 0 0.2" rpy="0.7853981633974483 0 0"/><geometry><sphere radius="0.02"/>'
    tool = odd_arms.link("ball").replace(
        "</link>", f"<collision>{ball}</geometry></collision></link>"
    )
    text = (folder / "arm.urdf").read_text()
    text = text.replace(
        "</robot>", tool + odd_arms.joint("to_ball", "fixed", "ft", "ball", "0 0 0")
    )
    (folder / "ball.urdf").write_text(text + "</robot>")
    slave = dataclasses.replace(scenario.slave, model=str(folder / "ball.urdf"))
    np.testing.assert_allclose(NominalSlave(slave).tip, [0.0, 0.0, 0.22], atol=2e-4)


@pytest.mark.parametrize(
    ("shape", "end"),
    [
        ('<sphere radius="0.01"/>', [0.03, -0.02, 0.21]),
        ('<box size="0.06 0.04 0.1"/>', [0.03, -0.02, 0.25]),
        ("", [0.02, -0.03, 0.08]),  # the centre of mass
    ],
)
def test_tip_of_a_tool_file_is_at_the_end_of_its_shapes(tmp_path, shape, end):
    at = f'<collision><origin xyz="0.03 -0.02 0.2"/><geometry>{shape}</geometry></collision>'
    inertial = (
        odd_arms.link("t").replace("0.001", "0").replace("-0.002", "0").replace("0.0015", "0")
    )
    link = inertial.replace("</link>", f"{at if shape else ''}</link>")
    (tmp_path / "tool.urdf").write_text(f'<robot name="tool">{link}</robot>')
    slave = Slave(tool=Tool(model=str(tmp_path / "tool.urdf")))
    np.testing.assert_allclose(NominalSlave(slave).tip, end, atol=1e-12)


@pytest.mark.parametrize("rpy", [[0.0, 0.0, 0.7], [0.3, -0.8, 1.9], [1.1, 0.4, -2.5]])
def test_tip_of_a_rotated_box_is_at_the_height_of_its_farthest_corner(rpy):
    box = Block(edges=[0.02, 0.06, 0.1], position=[0.01, -0.02, 0.1], rpy=rpy)
    corners = [box.pose @ (0.5 * np.array(x) * box.edges) for x in product((-1, 1), repeat=3)]
    tool = Tool(mass=1.0, shapes=[Ball(position=[0.0, 0.0, 0.1]), box])
    expected = [*box.position[:2], max(corner[2] for corner in corners)]
    np.testing.assert_allclose(p_STip_of_shapes(tool), expected, atol=1e-12)


@pytest.mark.parametrize(("beyond", "stops"), [(0.005, False), (0.02, True), (np.nan, True)])
@pytest.mark.parametrize("side", [-1, 1])
def test_joint_may_overshoot_limit_by_1_percent(scenario, beyond, stops, side):
    """An arm that is commanded to its limit overshoots before its mechanical stop."""
    arm = NominalSlave(scenario.slave).arm
    monitor = JointRangeMonitor(arm, 1e-3)
    context, q = monitor.CreateDefaultContext(), np.array(HOME)
    limit = arm.upper[3] if side > 0 else arm.lower[3]
    q[3] = limit + side * beyond * (arm.upper[3] - arm.lower[3])
    state = monitor.GetInputPort("slave_state")
    state.FixValue(context, np.append(q, np.zeros(arm.num_joints)))
    simulator = Simulator(monitor, context)
    if stops:
        with pytest.raises(DrakeTeleopError, match="joint 4 of the slave left its range"):
            simulator.AdvanceTo(2e-3)
    else:
        simulator.AdvanceTo(2e-3)


def slowest_multipliers(scenario):
    """Return the multipliers of the slowest modes of the linearized station."""
    system = linearize_station(scenario, load_estimate=true_load(scenario))
    return np.abs(system.multipliers[:20])


@pytest.fixture(scope="module")
def free(scenario):
    return slowest_multipliers(scenario)


@pytest.mark.slow
def test_redundant_arm_approaches_posture_at_pull_rate(scenario, free):
    period = 1.0 / scenario.rates.hand_hz
    assert free[0] == pytest.approx(
        np.exp(-NumericInverseKinematics.POSTURE_RATE_PER_S * period), abs=1e-5
    )
    assert free[1] < 0.9990


@pytest.mark.slow
def test_untouched_surroundings_change_no_multiplier(scenario, free):
    """The command displacement exceeds the tolerance of the kinematics in both cases."""
    beside = replace(scenario, environment=[Wall(position=[0.0, 0.0, -2.0])])
    beside = replace(beside, slave__tool=Tool(mass=1.0, shapes=[Ball(0.01, [0.0, 0.0, 0.1])]))
    alone = slowest_multipliers(replace(beside, environment=[]))
    np.testing.assert_allclose(slowest_multipliers(beside), alone, atol=1e-6)
    with_wall, without = (
        linearize(station, load_estimate=true_load(station))
        for station in (beside, replace(beside, environment=[]))
    )
    np.testing.assert_allclose(with_wall.B, without.B, rtol=0, atol=1e-6 * np.abs(without.B).max())


@pytest.mark.slow
def test_joint_speed_limit_changes_no_multiplier(folder, scenario, free):
    """Speed limits do not affect small motions."""
    text = (folder / "arm.urdf").read_text()
    j4 = text.index('<joint name="j4"')
    slow = text[:j4] + text[j4:].replace('velocity="3"', 'velocity="0.02"', 1)
    (folder / "slow.urdf").write_text(slow)
    slower = replace(scenario, slave__model=str(folder / "slow.urdf"))
    np.testing.assert_allclose(slowest_multipliers(slower), free, atol=1e-6)
