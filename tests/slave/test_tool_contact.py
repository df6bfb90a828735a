"""The compiled contact law equals Drake's for ball and leaf."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.station.environment.point_contact import (
    FindContactPairs,
    lower_bound_of_box_distance,
)
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.environment.slot import Slot
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.plant_dynamics import environment_wrench_about_Wo_into
from drake_teleop.station.slave.slave_config import Slave


def drake_wrench(plant, context, tool) -> np.ndarray:
    """Return [f; tau] on the tool about the world's origin, from the plant's contact results."""
    results, wrench = plant.get_contact_results_output_port().Eval(context), np.zeros(6)
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        sign = 1.0 if info.bodyB_index() == tool else -1.0
        force = sign * info.contact_force()
        wrench += np.concatenate([force, np.cross(info.contact_point(), force)])
    return wrench


@pytest.mark.parametrize(
    ("leaf", "most"),
    [
        (SheetSpring(position=[0.55, 0.0, 0.158]), 0.02),
        (SheetSpring(position=[0.575, 0.028, 0.155], slip_speed=2e-3), 0.04),
    ],
    ids=["face", "edge"],
)
def test_wrench_equals_drakes(leaf, most):
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, Slave(position=[0.55, 0.0, 0.36]), leaf)
    root = builder.Build().CreateDefaultContext()
    plant, context = slave.plant, slave.plant.GetMyMutableContextFromRoot(root)
    random, home = np.random.default_rng(0), slave.plant.GetPositions(context, slave.instance)
    found, touching = np.zeros(6), 0
    for _ in range(400):
        q = home + most * random.uniform(-1, 1, 6)
        # From sticking to sliding: the friction has three pieces.
        v = random.normal(size=6) * 10.0 ** random.uniform(-5, 0)
        sheet = np.array([0.01 * random.uniform(-1, 1), 0.1 * random.normal()])
        plant.SetPositions(context, slave.instance, q)
        plant.SetVelocities(context, slave.instance, v)
        plant.SetPositions(context, slave.contact.leaf_instance, sheet[:1])
        plant.SetVelocities(context, slave.contact.leaf_instance, sheet[1:])
        expected = drake_wrench(plant, context, slave.tool)
        environment_wrench_about_Wo_into(
            slave.arm.table,
            slave.contact.compiled_pairs,
            slave.contact.joint_table,
            np.zeros(6),
            q,
            v,
            sheet,
            np.zeros(0),
            found,
        )
        # A stiffness of 2e5 N/m makes 1e-10 N of the rounding of a position.
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
        touching += expected.any()
    assert touching > 40


def test_peg_in_slot_equals_drakes_with_many_pairs():
    """Tilted near the floor: both balls touch floor, walls and chamfers."""
    builder = DiagramBuilder()
    slot = Slot(position=[0.55, 0.0, 0.2], yaw=0.4, clearance=5e-4, friction=0.3)
    slave = AddSlavePlant(builder, Slave(position=[0.55, 0.0, 0.362]), slot)
    root = builder.Build().CreateDefaultContext()
    plant, context = slave.plant, slave.plant.GetMyMutableContextFromRoot(root)
    random, home = np.random.default_rng(0), slave.plant.GetPositions(context, slave.instance)
    found, most = np.zeros(6), 0
    for _ in range(400):
        q = home + 0.006 * random.uniform(-1, 1, 6)
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
        np.testing.assert_allclose(
            found, drake_wrench(plant, context, slave.tool), rtol=1e-9, atol=1e-9
        )
    assert most >= 4


def test_applied_wrench_is_shifted_to_world_origin():
    slave = AddSlavePlant(DiagramBuilder(), Slave(position=[0.55, 0.0, 0.36]), None)
    push, found = np.array([1.0, -2.0, 3.0, 0.1, 0.2, 0.3]), np.zeros(6)
    q = slave.plant.GetPositions(slave.plant.CreateDefaultContext(), slave.instance)
    environment_wrench_about_Wo_into(
        slave.arm.table,
        slave.contact.compiled_pairs,
        slave.contact.joint_table,
        push,
        q,
        0 * q,
        np.zeros(2),
        np.zeros(0),
        found,
    )
    np.testing.assert_array_equal(found[:3], push[:3])
    expected = push[3:] + np.cross([0.55, 0.0, 0.36], push[:3])
    np.testing.assert_allclose(found[3:], expected, atol=1e-12)


def test_other_shapes_are_monitored_by_bounding_boxes():
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    tool = plant.AddRigidBody("tool", SpatialInertia.SolidSphereWithMass(1.0, 0.01))
    table = plant.AddModelInstance("table")
    body = plant.AddRigidBody("body", table, SpatialInertia.SolidSphereWithMass(1.0, 0.01))
    friction, aside = CoulombFriction(0.2, 0.2), RigidTransform([0.0, 0.3, 0.0])
    cube = plant.RegisterCollisionGeometry(tool, aside, Box(1, 2, 4), "cube", friction)
    plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(0.1), "ball", friction)
    plant.Finalize()
    inspector, from_S = scene_graph.model_inspector(), RigidTransform([0.0, 0.0, 0.2])
    pairs = FindContactPairs(plant, inspector, {cube: from_S}, [table], 1e-4)
    assert len(pairs.compiled_pairs) == 0
    assert "spheres on boxes only, not a Box on a Sphere" in pairs.monitoring_reason
    np.testing.assert_allclose(pairs.monitored_pairs[0, :3], [0.0, 0.3, 0.2])
    np.testing.assert_allclose(pairs.monitored_pairs[0, 16:19], 0.1)
    np.testing.assert_allclose(np.sort(pairs.monitored_pairs[0, 37:]), [0.5, 1.0, 2.0])


def test_distance_of_separate_boxes():
    """The distance never exceeds Drake's, and equals it if a face is nearest."""
    random, half = np.random.default_rng(3), np.array([[0.02, 0.05, 0.1], [0.08, 0.03, 0.04]])
    plant, _ = AddMultibodyPlantSceneGraph(builder := DiagramBuilder(), 0.0)
    bodies = [
        plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1)) for name in "ab"
    ]
    friction = CoulombFriction(0.2, 0.2)
    X_SOwn = RigidTransform(RollPitchYaw(0.3, -0.5, 0.2), [0.03, -0.02, 0.1])
    shapes = [
        plant.RegisterCollisionGeometry(body, X, Box(*(2 * edges)), "box", friction)
        for body, X, edges in zip(bodies, (X_SOwn, RigidTransform()), half, strict=True)
    ]
    plant.Finalize()
    root = builder.Build().CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    query = plant.get_geometry_query_input_port()
    facing = 0
    for _ in range(200):
        X_WS, X_WBox = (
            RigidTransform(RollPitchYaw(*random.uniform(-3, 3, 3)), random.uniform(-0.2, 0.2, 3))
            for _ in bodies
        )
        leaf, deflection = random.normal(size=3), 0.02
        for body, X in zip(bodies, (X_WS, X_WBox), strict=True):
            plant.SetFreeBodyPose(context, body, X)
        moved = RigidTransform(X_WBox.rotation(), X_WBox.translation() - deflection * leaf)
        rest = [moved.rotation().matrix().ravel(), moved.translation(), half[1], leaf, np.zeros(6)]
        own = [X_SOwn.rotation().matrix().ravel(), half[0]]
        pair = np.concatenate([X_SOwn.translation(), [0.0], *rest, *own])
        found = lower_bound_of_box_distance(
            pair, pair[:28], X_WS.translation(), X_WS.rotation().matrix(), deflection
        )
        told = query.Eval(context).ComputeSignedDistancePairClosestPoints(*shapes).distance
        assert found <= max(told, 0.0) + 1e-6
        facing += found > 0.0 and found > told - 1e-6
    assert facing > 20
