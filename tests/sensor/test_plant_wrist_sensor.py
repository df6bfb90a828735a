"""The wrist sensor on a user's own plant, against the plant's reaction forces and V phi."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import AddContactMaterial, Box, ProximityProperties, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    RotationalInertia,
    SpatialInertia,
    WeldJoint,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_teleop import AddWristSensor
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import LOST, non_contact_wrench
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import PARTS, WristSensorConfig, without

ARM = Path(__file__).parents[2] / "docs" / "gallery" / "arm.urdf"
TOOL = SpatialInertia.MakeFromCentralInertia(
    1.3, [0.01, -0.02, 0.07], RotationalInertia(0.004, 0.005, 0.003)
)
Q = [0.2, -0.6, 1.9, 0.3, 0.5, -0.2]
V = [0.5, -1.0, 0.8, 1.5, -1.2, 2.0]
TURNED = RigidTransform(RollPitchYaw(0.4, -0.7, 1.1), [0.01, 0.03, -0.02])
MOTION = ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")


def arm(builder, time_step, sampled=True, base=None, wall=False, X_FTool=None):
    """Return a plant with arm and tool: (plant, scene graph, weld). The arm is free or on rails."""
    plant, scene = AddMultibodyPlantSceneGraph(builder, time_step)
    plant.SetUseSampledOutputPorts(sampled) if time_step else None
    Parser(plant).AddModels(str(ARM))
    for joint in ("pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3"):
        plant.AddJointActuator(joint, plant.GetJointByName(joint))
    foot = plant.GetFrameByName("base")
    if base is None:
        plant.WeldFrames(plant.world_frame(), foot)
    elif base == "floating":
        chassis = plant.AddRigidBody("chassis", foot.model_instance(), TOOL)
        plant.WeldFrames(foot, chassis.body_frame())
    else:
        plant.AddJoint(PrismaticJoint("rails", plant.world_frame(), foot, [0.6, 0.0, 0.8]))
    instance = plant.AddModelInstance("gripper")
    tool = plant.AddRigidBody("gripper_body", instance, TOOL)
    X = RigidTransform([0, 0, 0.045]) if X_FTool is None else X_FTool
    weld = plant.AddJoint(WeldJoint("wrist", plant.GetFrameByName("sensor"), tool.body_frame(), X))
    if wall:
        touch = ProximityProperties()
        AddContactMaterial(5.0, 2e4, CoulombFriction(0.3, 0.3), touch)
        plant.RegisterCollisionGeometry(tool, RigidTransform(), Sphere(0.15), "ball", touch)
        wide, world = Box(4.0, 4.0, 1.0), plant.world_body()
        X_WWall = RigidTransform([0.0, 0.0, -0.5])
        plant.RegisterCollisionGeometry(world, X_WWall, wide, "wall", touch)
    return plant, weld


def moving(time_step=0.0, config=None, frame=None, **options):
    """Return a running Diagram with the sensor at the wrist; constant torques drive the arm."""
    sensor_options = {k: options.pop(k) for k in ("period", "model_instance") if k in options}
    builder = DiagramBuilder()
    plant, weld = arm(builder, time_step, **options)
    if frame is not None:
        sensor_frame = plant.GetFrameByName("sensor")
        frame = plant.AddFrame(FixedOffsetFrame("S", sensor_frame, frame))
    plant.Finalize()
    sensor = AddWristSensor(builder, plant, frame or weld, config, **sensor_options)
    torque = builder.AddSystem(ConstantVectorSource([5.0, -30.0, -12.0, 2.0, -1.0, 0.5]))
    builder.Connect(torque.get_output_port(), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    joints = plant.GetModelInstanceByName("arm")
    rest = [plant.GetPositions(own, joints), plant.GetVelocities(own, joints)]
    rest[0][-6:], rest[1][-6:] = Q, V
    plant.SetPositions(own, joints, rest[0])
    plant.SetVelocities(own, joints, rest[1])
    simulator.Initialize()
    return SimpleNamespace(
        plant=plant, weld=weld, S=frame or weld.frame_on_parent(), sensor=sensor,
        simulator=simulator, context=own,
    )  # fmt: skip


def reading(run, name):
    context = run.sensor.GetMyContextFromRoot(run.simulator.get_context())
    return run.sensor.GetOutputPort(name).Eval(context)


def phi(run):
    """Return the tool's inertial parameters about So in S, from Drake."""
    tool = run.plant.GetBodyByName("gripper_body").index()
    M = run.plant.CalcSpatialInertia(run.context, run.S, [tool])
    moments, products = M.CalcRotationalInertia().get_moments(), M.CalcRotationalInertia()
    products = products.get_products()
    m, c = M.get_mass(), M.get_mass() * M.get_com()
    return np.array(
        [m, *c, moments[0], products[0], products[1], moments[1], products[2], moments[2]]
    )


def reaction(run, X_WS, X_WJc):
    """Return the weld's reaction about So, in S."""
    F_Jc = run.plant.get_reaction_forces_output_port().Eval(run.context)[
        list(run.plant.GetJointIndices()).index(run.weld.index())
    ]
    R_SJc = X_WS.rotation().inverse() @ X_WJc.rotation()
    f, tau = R_SJc @ F_Jc.translational(), R_SJc @ F_Jc.rotational()
    p_SoJc_S = X_WS.inverse() @ X_WJc.translation()
    return np.concatenate([f, tau + np.cross(p_SoJc_S, f)])


def compare(run, tolerance, instants, period=1e-3):
    """Compare the samples of some instants with the weld's reaction; return the largest force."""
    largest = 0.0
    after = run.plant.time_step() > 0 and run.plant.has_sampled_output_ports()
    for k in instants:
        if k > 0:  # else Drake handles the events of the present instant already
            run.simulator.AdvanceTo(k * period)
        poses = [
            frame.CalcPoseInWorld(run.context) for frame in (run.S, run.weld.frame_on_child())
        ]
        positions = run.plant.GetPositions(run.context)
        before = None if after else reaction(run, *poses)
        run.simulator.AdvanceTo(k * period + 1e-7)
        expected = reaction(run, *poses) if after else before
        measured = reading(run, "measured_wrench_S")
        np.testing.assert_allclose(measured, expected, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(reading(run, "joint_position"), positions)
        assert reading(run, "sample_time")[0] == pytest.approx(k * period, abs=1e-12)
        assert reading(run, "status") == [0.0]
        largest = max(largest, np.abs(measured[:3]).max())
    return largest


def load_wrench(run):
    return non_contact_wrench(*(reading(run, name) for name in MOTION), phi(run))


PLANTS = {
    "continuous": ({}, 1e-12),
    "discrete": ({"time_step": 1e-3}, 1e-9),
    "unsampled": ({"time_step": 1e-3, "sampled": False}, 1e-9),
}


@pytest.mark.parametrize("kind", PLANTS)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"frame": TURNED, "X_FTool": RigidTransform(RollPitchYaw(1.0, 0.2, -2.0), [0.1, 0.0, 0.2])},
        {"base": "rails"},
        {"base": "floating"},
    ],
    ids=["arm", "turned", "rails", "floating"],
)
def test_wrench_equals_reaction_and_v_phi_in_free_motion(kind, options):
    plant, tolerance = PLANTS[kind]
    run = moving(**plant, **options)
    for k in (0, 1, 2, 57):
        assert compare(run, tolerance, [k]) > 1.0
        wrench = reading(run, "measured_wrench_S")
        np.testing.assert_allclose(load_wrench(run), wrench, rtol=0, atol=max(tolerance, 1e-11))
