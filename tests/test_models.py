"""Models of the slave: their numbers, and that they parse alone and together."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.files import models_dir
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.model.model_repair import ModelPurpose
from drake_teleop.station.slave.models import repair_and_parse_model


def parse(name: str):
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    parser = Parser(plant)
    parser.SetStrictParsing()
    parser.package_map().AddPackageXml(str(models_dir() / "package.xml"))
    parser.AddModelsFromUrl(f"package://drake_teleop/{name}")
    return plant, scene_graph.model_inspector()


@pytest.fixture(scope="module")
def slave():
    plant, inspector = parse("slave.dmd.yaml")
    plant.Finalize()
    return plant, inspector


def arm_of(plant: MultibodyPlant):
    return ArmModelFromPlant(plant, plant.GetModelInstanceByName("rx90"))


def test_at_zero_the_arm_points_straight_up():
    plant, _ = parse("rx90.sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    X_WS = plant.GetFrameByName("sensor").CalcPoseInWorld(context)
    np.testing.assert_allclose(X_WS.rotation().matrix(), np.eye(3), atol=1e-15)
    np.testing.assert_allclose(
        X_WS.translation(), [0, 0, 0.420 + 0.450 + 0.450 + 0.085], atol=1e-15
    )


def test_the_kinematics_are_the_modified_dh_table(slave):
    plant, _ = slave
    context = plant.CreateDefaultContext()
    q = np.array([0.3, -0.7, 1.1, -2.0, 0.5, 1.7])
    plant.SetPositions(context, plant.GetModelInstanceByName("rx90"), q)
    theta = q + np.deg2rad([0, 90, -90, 0, 0, 0])
    alpha = np.deg2rad([0, 90, 0, -90, 90, -90])
    X = np.eye(4)
    for j, (d, r) in enumerate([(0, 0.42), (0, 0), (0.45, 0), (0, 0.45), (0, 0), (0, 0)]):
        ca, sa, ct, st = np.cos(alpha[j]), np.sin(alpha[j]), np.cos(theta[j]), np.sin(theta[j])
        # Rx(alpha) Tx(d) Rz(theta) Tz(r), Khalil and Kleinfinger 1986.
        X = X @ [
            [ct, -st, 0, d],
            [ca * st, ca * ct, -sa, -r * sa],
            [sa * st, sa * ct, ca, r * ca],
            [0, 0, 0, 1],
        ]
        link = plant.GetBodyByName(f"link_{j + 1}").EvalPoseInWorld(context)
        np.testing.assert_allclose(link.GetAsMatrix4(), X, atol=1e-14)


def test_the_limits_are_the_robots(slave):
    arm = arm_of(slave[0])
    assert arm.joint_names == tuple(f"joint_{j}" for j in range(1, 7))
    degrees = np.rad2deg
    np.testing.assert_allclose(degrees(arm.lower), [-160, -137.5, -142.5, -270, -105, -270])
    np.testing.assert_allclose(degrees(arm.upper), [160, 137.5, 142.5, 270, 120, 270])
    np.testing.assert_allclose(degrees(arm.velocity_limit), [236, 200, 286, 401, 320, 580])
    np.testing.assert_array_equal(arm.acceleration_limit, [8, 10, 12, 20, 25, 30])


def test_the_motors_hold_the_arm_stretched_out_with_much_in_hand(slave):
    plant, _ = slave
    arm = arm_of(plant)
    context = plant.CreateDefaultContext()
    rx90 = plant.GetModelInstanceByName("rx90")
    plant.SetPositions(context, rx90, [0, -np.pi / 2, 0, 0, 0, 0])
    gravity = plant.CalcGravityGeneralizedForces(context)[arm.velocity_index]
    assert np.all(arm.effort_limit > 2 * np.abs(gravity))


def test_masses_and_rotors(slave):
    plant, _ = slave
    masses = [plant.GetBodyByName(f"link_{j}").default_mass() for j in range(1, 7)]
    assert masses == [25, 20, 13, 7, 3, 1]
    rx90 = plant.GetModelInstanceByName("rx90")
    assert plant.GetBodyByName("base", rx90).default_mass() == 42
    assert sum(masses) + 42 == 111  # from the manufacturer
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    assert [a.default_reflected_inertia() for a in actuators] == [3, 3, 1, 0.2, 0.1, 0.05]


def test_every_parameter_of_the_tool_can_be_found(slave):
    phi = arm_of(slave[0]).phi_load
    assert phi[0] == 3.13
    np.testing.assert_allclose(phi[1:4] / phi[0], [0.004, -0.003, 0.085])
    # No value is so small that an estimate of zero would pass.
    assert np.all(np.abs(phi) > 1e-4)
    inertia = np.empty((3, 3))
    inertia[np.triu_indices(3)] = phi[4:]
    inertia.T[np.triu_indices(3)] = phi[4:]
    pseudo_inertia = np.empty((4, 4))
    pseudo_inertia[:3, :3] = np.trace(inertia) / 2 * np.eye(3) - inertia
    pseudo_inertia[:3, 3] = pseudo_inertia[3, :3] = phi[1:4]
    pseudo_inertia[3, 3] = phi[0]
    assert np.linalg.eigvalsh(pseudo_inertia).min() > 1e-4


def test_only_ball_and_leaf_can_touch(slave):
    _, inspector = slave
    ids = inspector.GetAllGeometryIds(Role.kProximity)
    assert {inspector.GetName(g) for g in ids} == {"tool::ball", "sheet_spring::leaf"}
    for geometry in ids:
        properties = inspector.GetProximityProperties(geometry)
        assert properties.GetProperty("material", "point_contact_stiffness") >= 1e5
        assert properties.GetProperty("material", "hunt_crossley_dissipation") > 0


def test_the_tip_is_where_the_ball_ends_and_hangs_above_the_leaf(slave):
    plant, inspector = slave
    context = plant.CreateDefaultContext()
    p_WTip = plant.GetFrameByName("tip").CalcPoseInWorld(context).translation()
    p_WLeaf = plant.GetBodyByName("leaf").EvalPoseInWorld(context).translation()
    np.testing.assert_allclose(p_WTip - p_WLeaf, [0, 0, 0.1], atol=1e-9)
    ball = plant.GetCollisionGeometriesForBody(plant.GetBodyByName("tool"))[0]
    radius = inspector.GetShape(ball).radius()
    z_ball = inspector.GetPoseInFrame(ball).translation()[2]
    assert z_ball + radius == pytest.approx(0.200)


def test_the_leaf_moves_up_and_down_and_brings_no_spring_of_its_own(slave):
    plant, _ = slave
    bending = plant.GetJointByName("bending")
    assert bending.num_positions() == 1
    np.testing.assert_array_equal(bending.translation_axis(), [0, 0, 1])
    # Gravity is the only force element; the scenario chooses the spring.
    assert plant.num_force_elements() == 1
    leaf = 33 / 140 * 7850 * 0.17 * 0.06 * 0.002
    assert plant.GetBodyByName("leaf").default_mass() == pytest.approx(leaf, rel=1e-3)


@pytest.mark.parametrize("name", ["leader_arm.urdf", "rx90.sdf"])
def test_a_model_without_converted_files_leaves_no_temporary_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    plant = MultibodyPlant(0.0)
    repair_and_parse_model(plant, models_dir() / name, (), ModelPurpose(is_scene=True))
    assert plant.num_bodies() > 1
    assert list(tmp_path.iterdir()) == []
