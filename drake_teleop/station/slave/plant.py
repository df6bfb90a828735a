"""Plant of the slave: MultibodyPlant with arm, tool and environment."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake import geometry
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ContactModel, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.environment.environment import Environment
from drake_teleop.station.slave import arm_from_plant, home
from drake_teleop.station.slave.arm import DRY_FRICTION_COLUMN, ArmModel, JointFriction
from drake_teleop.station.slave.chain_joints import bodies_carried_by, set_torque_limits
from drake_teleop.station.slave.models import ParseModel, translate_drake_errors
from drake_teleop.station.slave.slave_config import AddPayload, AddTool, Slave, p_STip_of_shapes
from drake_teleop.station.slave.surroundings import (
    AddEnvironment,
    MakeToolContactModel,
    ToolContactModel,
)

# Shapes that end within this distance of the farthest end share the contact, as two fingers do [m].
_SHARED_TIP_TOLERANCE_M = 1e-3
_NUM_CIRCLE_POINTS = 24  # points on a circumference of a round shape
ARM_INSTANCE_NAME = "arm"  #: name of the arm's model instance in every plant


@dataclass(frozen=True)
class SlavePlant:
    """Plant of the slave, with the data that other blocks need.

    Attributes:
        plant: continuous MultibodyPlant, finalized.
        instance: model instance of the arm's joints.
        tool: index of the tool's body that is welded to the sensor.
        arm: arm up to S, with all bodies beyond S as its load.
        start: (n,) joint positions at the start [rad].
        X_WS_start: (7,) pose at the start [qw qx qy qz px py pz].
        tip: (3,) p_STip, contact point of the tool [m].
        assumptions: texts about missing data of the models.
    """

    plant: MultibodyPlant
    instance: ModelInstanceIndex
    sensor_frame: Frame
    tool: BodyIndex
    arm: ArmModel
    start: Array
    X_WS_start: Array
    tip: Array
    contact: ToolContactModel
    assumptions: tuple[str, ...]
    config: Slave
    environment: Environment | None

    @cached_property
    def compiled_constants(self) -> tuple[Array, ...]:
        """Arrays for compiled steps of the plant (`contact_and_plant_rates_into`).

        They are: `ArmModel.table` with dry friction; a view of the load in it; compiled pairs of
        shapes; parameters of the leaf; joints of moving bodies; no recorded wrenches.
        """
        carried = self.arm.with_load(self.arm.phi_load)
        carried.table[:-1, DRY_FRICTION_COLUMN] = self.joint_friction
        contact, no_wrenches = self.contact, np.zeros((0, 0))
        laws = contact.compiled_pairs, contact.leaf_parameters, contact.joint_table
        return carried.table, carried.phi_load_view, *laws, no_wrenches

    @property
    def ports(self) -> dict[str, OutputPort]:
        """Output ports of the plant by name of the input port that they supply."""
        plant, leaf = self.plant, self.contact.leaf_instance
        ports = {
            "slave_state": plant.get_state_output_port(self.instance),
            "slave_acceleration": plant.get_generalized_acceleration_output_port(self.instance),
            "plant_state": plant.get_state_output_port(),
            "contact_results": plant.get_contact_results_output_port(),
        }
        return ports if leaf is None else ports | {"sheet_state": plant.get_state_output_port(leaf)}

    @property
    def joint_friction(self) -> Array:
        friction = self.config.friction
        return arm_from_plant.values_per_joint(self.arm, friction, "slave.friction", 0.0)

    @property
    def can_tool_touch(self) -> bool:
        return len(self.contact.compiled_pairs) > 0 or bool(self.contact.drake_contact_reason)

    @property
    def leaf_instance_in_compiled_law(self) -> ModelInstanceIndex | None:
        """Model instance of the leaf if the compiled law computes its contact, else None."""
        return None if self.contact.drake_contact_reason else self.contact.leaf_instance

    @property
    def p_WTip_start(self) -> Array:
        start = self.X_WS_start
        X_WS = RigidTransform(Quaternion(start[:4] / np.linalg.norm(start[:4])), start[4:])
        return X_WS @ self.tip


def start_pose(slave: Slave) -> Array:
    """Return X_WS [qw qx qy qz px py pz] at the start, from `slave.home` or `slave.position`."""
    if slave.home:
        return NominalSlave(slave).X_WS_start
    return np.array([*home.R_WS_HOME.ToQuaternion().wxyz(), *slave.position])


def NominalSlave(slave: Slave) -> SlavePlant:
    """Return the slave's plant without environment, from a cache for equal settings."""
    return _cached_nominal_slave(HashableByValue(slave, slave.model_files()))


class HashableByValue:
    """Hashable copy of settings; equal for equal values and modification times of `files`."""

    def __init__(self, value: Any, files: list[Path]) -> None:
        written = [path.stat().st_mtime_ns for path in files]
        self.value, self._values = copy.deepcopy(value), repr((value, written))

    def __hash__(self) -> int:
        return hash(self._values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HashableByValue) and self._values == other._values


@lru_cache(maxsize=4)  # parsing takes longer than building a station
def _cached_nominal_slave(key: HashableByValue) -> SlavePlant:
    return AddSlavePlant(DiagramBuilder(), key.value, None)


def AddSlavePlant(
    builder: DiagramBuilder,
    slave: Slave,
    environment: Environment | None,
    q_start: Array | None = None,
) -> SlavePlant:
    """Add the slave's plant, at rest at `q_start` (n,) [rad], by default the start of `slave`.

    A DrakeTeleopError is raised if the arm cannot reach that default start or hold its load there.
    """
    if environment is None:
        plant = builder.AddNamedSystem("slave_plant", MultibodyPlant(time_step=0.0))
    else:
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        plant.set_name("slave_plant")
        areas = ContactModel.kHydroelasticWithFallback
        plant.set_contact_model(areas if environment.hydroelastic else ContactModel.kPoint)
        plant.set_stiction_tolerance(environment.slip_speed)
    parsed = ParseSlave(plant, slave)
    instance, tool = parsed.instance, parsed.tool
    load = {int(body.index()) for body in bodies_carried_by(plant, parsed.sensor_frame.body())}
    links = map(plant.get_body, map(BodyIndex, set(range(plant.num_bodies())) - load))
    arm_shapes = [shape for link in links for shape in plant.GetCollisionGeometriesForBody(link)]
    surroundings = None if environment is None else AddEnvironment(plant, environment)
    with translate_drake_errors(slave.path):
        finalize_without_limit_warnings(plant)
    contact = ToolContactModel()
    if environment is not None and surroundings is not None:
        _remove_visual_and_arm_shapes(plant, scene_graph, arm_shapes)
        frame = parsed.sensor_frame
        contact = MakeToolContactModel(plant, scene_graph, frame, tool, environment, surroundings)
    arm, assumptions = parsed.arm()
    start = home.find_start_posture(slave, arm) if q_start is None else q_start
    if q_start is None:
        home.check_inertia_and_holding_torque(arm, start)
    friction = arm_from_plant.values_per_joint(arm, slave.friction, "slave.friction", 0.0)
    if friction.any():
        law = JointFriction(friction, arm.velocity_index, plant.num_velocities())
        block = builder.AddNamedSystem("joint_friction", law)
        state = plant.get_state_output_port(instance)
        builder.Connect(state, block.GetInputPort("slave_state"))
        force = plant.get_applied_generalized_force_input_port()
        builder.Connect(block.GetOutputPort("generalized_force"), force)
    plant.SetDefaultPositions(instance, start)
    X_WS_start = arm.pose(start) if slave.home else start_pose(slave)
    tip, texts = _tip_in_S(plant, slave, parsed, arm), (*parsed.assumptions, *assumptions)
    parts = plant, instance, parsed.sensor_frame, tool, arm, start, X_WS_start, tip, contact
    return SlavePlant(*parts, texts, slave, environment)


class ParsedSlave(NamedTuple):
    """Arm and tool in a plant that is not finalized, with attributes of `SlavePlant`."""

    slave: Slave
    plant: MultibodyPlant
    instance: ModelInstanceIndex
    sensor_frame: Frame
    tool: BodyIndex
    assumptions: tuple[str, ...]

    def arm(self) -> tuple[ArmModel, list[str]]:
        """Return the arm of the finalized plant, with default limits, and texts about these."""
        frame = self.sensor_frame
        arm = arm_from_plant.ArmModelFromPlant(self.plant, frame.model_instance(), frame.name())
        if not arm.phi_load[0] > 0.0:
            what = f"no body with a mass is attached to {frame.name()}"
            remedy = "set slave.tool, or a sensor_frame between the arm and the model's own tool"
            raise DrakeTeleopError(what, where="slave.tool", remedy=remedy)
        arm_from_plant.check_arm_lengths(arm, str(self.slave.path))
        arm, assumed = arm_from_plant.fill_missing_joint_limits(arm, str(self.slave.path))
        if arm.num_joints < 6:
            assumed.append(f"with {arm.num_joints} joints the tool follows only part of the pose")
        return arm, assumed


def ParseSlave(plant: MultibodyPlant, slave: Slave | None = None) -> ParsedSlave:
    """Parse arm, tool and payload into a plant; rename the arm's model instance to "arm"."""
    slave = Slave() if slave is None else slave
    packages, X_WBase = slave.package_folders, slave.X_WBase
    model = ParseModel(plant, slave.path, slave.sensor_frame, packages, X_WBase, slave.hold)
    if plant.HasModelInstanceNamed(ARM_INSTANCE_NAME):
        other = plant.GetModelInstanceByName(ARM_INSTANCE_NAME)
        plant.RenameModelInstance(other, f"{ARM_INSTANCE_NAME}_of_model")
    plant.RenameModelInstance(model.instance, ARM_INSTANCE_NAME)
    set_torque_limits(plant, model.instance, slave.torque_limits)
    frame, model_bodies = model.sensor_frame, bodies_carried_by(plant, model.sensor_frame.body())
    assumptions = [*model.assumptions]
    if slave.tool is not None:
        on_sensor, assumed = AddTool(plant, slave.tool, frame, packages)
        assumptions += assumed
        if model_bodies:
            names = ", ".join(body.name() for body in model_bodies)
            assumptions.append(f"bodies of the model on the sensor are part of the load: {names}")
        holder = on_sensor.body_frame()
    else:
        on_sensor, holder = model_bodies[0] if model_bodies else frame.body(), frame
    AddPayload(plant, holder, slave.payload)
    return ParsedSlave(slave, plant, model.instance, frame, on_sensor.index(), tuple(assumptions))


def finalize_without_limit_warnings(plant: MultibodyPlant) -> None:
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    limits = [(joint.position_lower_limits(), joint.position_upper_limits()) for joint in joints]
    for joint, (lower, upper) in zip(joints, limits, strict=True):
        joint.set_position_limits(np.full_like(lower, -np.inf), np.full_like(upper, np.inf))
    plant.Finalize()
    for joint, (lower, upper) in zip(joints, limits, strict=True):
        joint.set_position_limits(lower, upper)


def _remove_visual_and_arm_shapes(
    plant: MultibodyPlant, scene: geometry.SceneGraph, arm_shapes: list[geometry.GeometryId]
) -> None:
    source = plant.get_source_id()
    for body in map(plant.get_body, map(BodyIndex, range(plant.num_bodies()))):
        for shape in plant.GetVisualGeometriesForBody(body):
            scene.RemoveGeometry(source, shape)
    for shape in arm_shapes:
        scene.RemoveRole(source, shape, geometry.Role.kProximity)


def _hull_points_beyond_sensor_S(slave: Slave) -> list[Array]:
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.0)
    parsed = ParseSlave(plant, slave)
    finalize_without_limit_warnings(plant)
    context, inspector, hulls = plant.CreateDefaultContext(), scene_graph.model_inspector(), []
    for body in bodies_carried_by(plant, parsed.sensor_frame.body()):
        X_SBody = plant.CalcRelativeTransform(context, parsed.sensor_frame, body.body_frame())
        for shape in plant.GetCollisionGeometriesForBody(body):
            points = hull_points_of(inspector, shape)
            if len(points):
                hulls.append((X_SBody @ points.T).T)
    return hulls


def hull_points_of(inspector: geometry.SceneGraphInspector, solid: geometry.GeometryId) -> Array:
    """Return points (k, 3) [m] whose convex hull approximates a shape, in its body's frame.

    Points of a round shape are the vertices of an inscribed polyhedron; a half space has none.
    """
    shape = inspector.GetShape(solid)
    if isinstance(shape, (geometry.Mesh, geometry.Convex)):
        hull = shape.GetConvexHull()
        points = np.array([hull.vertex(k) for k in range(hull.num_vertices())])
    elif isinstance(shape, (geometry.Sphere, geometry.Capsule)):
        points = shape.radius() * _unit_sphere_points()
    elif isinstance(shape, geometry.Ellipsoid):
        points = _unit_sphere_points() * [shape.a(), shape.b(), shape.c()]
    elif isinstance(shape, geometry.Cylinder):
        rim = _unit_sphere_points()[_NUM_CIRCLE_POINTS : 2 * _NUM_CIRCLE_POINTS] * [1.0, 1.0, 0.0]
        points = rim * (shape.radius() / np.linalg.norm(rim, axis=1, keepdims=True))
    elif isinstance(shape, geometry.HalfSpace):
        return np.zeros((0, 3))
    else:
        box = inspector.GetObbInGeometryFrame(solid)
        corners = np.array(list(product((-1.0, 1.0), repeat=3)))
        points = (box.pose() @ (corners * box.half_width()).T).T
    if isinstance(shape, (geometry.Capsule, geometry.Cylinder)):
        end = [0.0, 0.0, shape.length() / 2]
        points = np.vstack([points - end, points + end])
    return (inspector.GetPoseInFrame(solid) @ points.T).T


def _unit_sphere_points() -> Array:
    latitude = np.linspace(-np.pi / 2, np.pi / 2, _NUM_CIRCLE_POINTS // 2 + 1)
    longitude = 2 * np.pi * np.arange(_NUM_CIRCLE_POINTS) / _NUM_CIRCLE_POINTS
    latitudes, longitudes = np.meshgrid(latitude, longitude, indexing="ij")
    x, y = np.cos(latitudes) * np.cos(longitudes), np.cos(latitudes) * np.sin(longitudes)
    return np.stack([x, y, np.sin(latitudes)], axis=-1).reshape(-1, 3)


def _tip_in_S(plant: MultibodyPlant, slave: Slave, parsed: ParsedSlave, arm: ArmModel) -> Array:
    if slave.tip:
        return np.array(slave.tip, dtype=np.float64)
    instance = plant.get_body(parsed.tool).model_instance()
    if plant.HasFrameNamed("tip", instance):
        tip = plant.GetFrameByName("tip", instance)
        if slave.tool is not None and tip.body().index() == parsed.tool:  # the body frame is S
            return tip.GetFixedPoseInBodyFrame().translation()
        return tip.CalcPose(plant.CreateDefaultContext(), parsed.sensor_frame).translation()
    if slave.tool is not None and slave.tool.mass > 0.0:
        end = p_STip_of_shapes(slave.tool)
        return arm.phi_load[1:4] / arm.phi_load[0] if end is None else np.array(end)
    hulls = _hull_points_beyond_sensor_S(slave)
    if not hulls:
        return arm.phi_load[1:4] / arm.phi_load[0]
    reach = max(hull[:, 2].max() for hull in hulls)
    farthest = [hull[:, :2] for hull in hulls if hull[:, 2].max() > reach - _SHARED_TIP_TOLERANCE_M]
    middles = [(hull.min(axis=0) + hull.max(axis=0)) / 2.0 for hull in farthest]
    return np.array([*np.mean(middles, axis=0), reach])


def read_arm_without_default_limits(
    model: Path, sensor_frame: str, package_paths: tuple[Path, ...] = ()
) -> ArmModel:
    """Return the arm in a model file, with infinite limits where the file has none."""
    plant = MultibodyPlant(0.0)
    with translate_drake_errors(model):
        parsed = ParseModel(plant, model, sensor_frame, package_paths)
        finalize_without_limit_warnings(plant)
        arm = arm_from_plant.ArmModelFromPlant(plant, parsed.instance, parsed.sensor_frame.name())
    arm.pose(np.zeros(arm.num_joints))  # Load the compiled function before the first reading.
    return arm
