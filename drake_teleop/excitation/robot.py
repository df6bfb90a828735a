"""The arm that is to be excited, its surroundings, and its limits.

Of the station's slave, or of any model that Drake can read (URDF, SDF, MJCF, model directives).
What a model lacks is assumed, and every assumption is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    ProximityProperties,
    SceneGraph,
    Shape,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Frame,
    ModelInstanceIndex,
    RigidBody,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.excitation.capsules import Capsule, bounding_capsule
from drake_teleop.excitation.criteria import Scales, characteristic_length
from drake_teleop.excitation.limits import Limits, capsule_distances, empty_motions, motions_of
from drake_teleop.excitation.models import ParseModel
from drake_teleop.excitation.prediction import SensorNoise, sensor_noise
from drake_teleop.load.inertia import inertia_about_origin, phi_from_mass_com_inertia
from drake_teleop.scenario import Scenario
from drake_teleop.sensor.motion_estimation import MotionEstimationConfig
from drake_teleop.sensor.sensor_chain import WristSensorConfig
from drake_teleop.slave.arm import ArmModel, ArmModelFromPlant
from drake_teleop.slave.payload import AddPayload
from drake_teleop.slave.plant import AddEnvironment, ParseSlave, finalize, home_position

Array = NDArray[np.float64]

# Of the joints' ranges, speeds and torques; the rest is for tracking errors and feedback.
_JOINT_SHARE = 0.8
# Of the weakest axis of the sensor; a grasped object lies farther out than the tool.
_FORCE_SHARE, _TORQUE_SHARE = 0.9, 10.0 / 12.0
# The heaviest load to expect is this much heavier than the known one (a grasped object of 0.8 kg).
_LOAD_FACTOR = 1.3
# What a payload of unknown shape looks like: centre of mass along z_S, radius of gyration [m].
_PAYLOAD_COM, _PAYLOAD_GYRATION = 0.08, 0.05
_PAYLOAD = 2.0
# What a model without limits gets: range [rad], speed [rad/s], time to full speed [s].
_RANGE, _SPEED, _TIME_TO_SPEED = np.pi, np.pi, 0.4

#: What the arm keeps between its links, and from everything else [m]. The flange of the RX90 passes
#: its forearm at 6 mm.
CLEARANCE = 0.005
# Pairs of shapes nearer than that in this share of random postures are neighbours by design, and so
# are those whose distance varies by less than this [m].
_NEIGHBOURS, _POSTURES, _STILL = 0.95, 1000, 1e-3
# Distances at which shapes are about to touch [m], the share of such postures in which capsules may
# be too small by what is allowed for, and the share of free postures that they may block.
_BAND, _LEAST, _BLOCKED = (-0.02, 0.05), 0.25, 0.1
# With fewer such postures nothing is allowed for.
_FEW = 5
# Capsules that are near in less than this share of the postures may be so; in more, only if their
# shapes are ever near.
_SELDOM = 0.05

_TABLE = "drake_teleop_table"
# A plane as a ball of 1 km: 2 m away it is 2 mm too low, and the check has the plane.
_TABLE_CAPSULE = Capsule(np.full((2, 3), (0.0, 0.0, -1e3)), 1e3)

# The station's wrist centre and ball tip, and where both may be: in front of the arm, above the
# table.
_POINTS_S = ((0.0, 0.0, -0.085), (0.0, 0.0, 0.2))
_BOX_W = ((0.25, -0.7, 0.1), (1.05, 0.7, 1.3))


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm with its surroundings, ready for a design and for a check.

    Attributes:
        name: of the scenario or the model.
        diagram: of plant and scene graph.
        plant: with the heaviest load on the arm.
        scene_graph: with everything that may collide.
        sensor_frame: S.
        arm: the same as arrays.
        limits: what an excitation must respect.
        scales: what criteria divide by; with the heaviest load.
        noise: of the sensor, for predictions.
        home: (n,) a posture to begin from [rad].
        assumptions: what was not in the model.
        folders: with converted meshes, which live as long as this.
    """

    name: str
    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    sensor_frame: Frame
    arm: ArmModel
    limits: Limits
    scales: Scales
    noise: SensorNoise
    home: Array
    assumptions: tuple[str, ...]
    folders: tuple[TemporaryDirectory[str], ...] = ()


def RobotFromScenario(scenario: Scenario) -> Robot:
    """The station's slave with its tool, what it has to touch, and a table at z = 0.

    Raises:
        DrakeTeleopError: if the arm cannot reach the scenario's start.
    """

    def parse(plant: MultibodyPlant) -> tuple[ModelInstanceIndex, Frame]:
        instance, tool = ParseSlave(plant)
        AddPayload(plant, tool, scenario.slave.payload)
        if scenario.environment is not None:
            AddEnvironment(plant, scenario.environment)
        return instance, plant.GetFrameByName("sensor", instance)

    load = _arm_of(parse).phi_load
    scene = _Scene(parse, (_LOAD_FACTOR - 1) * load, visuals_count=True)
    lower, upper = np.array(_BOX_W)
    return scene.robot(
        "the station's slave",
        scenario.wrist_sensor,
        scenario.motion_estimation,
        scenario.rates.sensor_hz,
        home=home_position(scene.arm, scenario.slave.position),
        points_S=np.array(_POINTS_S),
        box=((upper + lower) / 2, (upper - lower) / 2),
        assumptions=["a table at z = 0"],
    )


def RobotFromModel(
    path: Path,
    sensor_frame: str,
    sensor: WristSensorConfig,
    *,
    estimation: MotionEstimationConfig | None = None,
    sensor_hz: float = 8000.0,
    package_paths: tuple[Path, ...] = (),
    acceleration: tuple[float, ...] = (),
    payload: float | None = None,
) -> Robot:
    """Any serial arm of revolute joints.

    A base that hangs on nothing is welded to the world, joints beyond the sensor are held.

    Args:
        path: of the model.
        sensor_frame: name of the frame or link at which the sensor measures.
        sensor: what it can measure.
        estimation: from what the motion will be known; by default as in the station.
        sensor_hz: rate of the sensor [Hz].
        package_paths: folders in which `package://` addresses are looked up.
        acceleration: limits [rad/s^2], one for all joints or one for each, if the model has none.
        payload: mass of the heaviest load [kg], if it is not in the model.

    Raises:
        DrakeTeleopError: if the model cannot be read or is no such arm.
    """
    efforts: dict[str, float] = {}
    lost: dict[str, list[str]] = {}
    folders: list[TemporaryDirectory[str]] = []

    def parse(plant: MultibodyPlant) -> tuple[ModelInstanceIndex, Frame]:
        model = ParseModel(plant, path, sensor_frame, package_paths)
        efforts.update(model.efforts)
        lost.update(model.lost)
        folders.append(model.folder)
        return model.instance, model.sensor_frame

    assumptions = ["a table at z = 0"]
    load = _arm_of(parse).phi_load
    if payload is None and load[0] > 0:
        reserve = (_LOAD_FACTOR - 1) * load
    else:
        mass = _PAYLOAD if payload is None else payload
        if payload is None:
            assumptions.append(f"a load of {mass:g} kg (--payload)")
        if mass <= load[0]:
            raise DrakeTeleopError(
                f"the model holds {load[0]:.3g} kg beyond the sensor already",
                where="--payload",
                remedy="give the mass of all that may hang there",
            )
        reserve = _payload(mass - load[0])
    scene = _Scene(parse, reserve, visuals_count=False)
    assumptions += [
        f"shapes are missing of {', '.join(links)}: {what}" for what, links in lost.items()
    ]
    scene.arm, completed = _completed(scene.arm, efforts, acceleration, str(path))
    return scene.robot(
        path.name,
        sensor,
        estimation or MotionEstimationConfig(),
        sensor_hz,
        home=(scene.arm.lower + scene.arm.upper) / 2,
        points_S=np.zeros((1, 3)),
        box=(np.zeros(3), np.full(3, np.inf)),
        assumptions=assumptions + completed,
        folders=folders,
    )


_Pair = tuple[GeometryId, GeometryId]
_Parse = Callable[[MultibodyPlant], tuple[ModelInstanceIndex, Frame]]


def _arm_of(parse: _Parse) -> ArmModel:
    plant = MultibodyPlant(0.0)
    instance, frame = parse(plant)
    finalize(plant)
    return ArmModelFromPlant(plant, instance, frame.name())


class _Scene:
    """Plant and scene graph of the arm with its heaviest load, and which shapes may collide."""

    def __init__(self, parse: _Parse, reserve: Array, *, visuals_count: bool) -> None:
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        instance, self.sensor_frame = parse(self.plant)
        _add_load(self.plant, instance, self.sensor_frame, reserve)
        _make_solid(self.plant, self.scene_graph, visuals_count)
        _add_shape(
            self.plant,
            self.plant.world_body(),
            RigidTransform([0, 0, -0.5]),
            Box(10, 10, 1),
            _TABLE,
        )
        finalize(self.plant)
        self.arm = ArmModelFromPlant(self.plant, instance, self.sensor_frame.name())
        self.diagram = builder.Build()

    def robot(
        self,
        name: str,
        sensor: WristSensorConfig,
        estimation: MotionEstimationConfig,
        sensor_hz: float,
        *,
        home: Array,
        points_S: Array,
        box: tuple[Array, Array],
        assumptions: list[str],
        folders: Sequence[TemporaryDirectory[str]] = (),
    ) -> Robot:
        """Limits and all else, see `Robot`; `box` is its middle and half size in W [m]."""
        arm = self.arm
        middle, half = (arm.lower + arm.upper) / 2, (arm.upper - arm.lower) / 2
        postures = middle + half * np.random.default_rng(0).uniform(-1, 1, (_POSTURES, len(half)))
        bodies = self._rows()
        candidates = self._without_neighbours(bodies, postures)
        rows, capsules, pairs, distances = self._capsules(bodies, candidates, postures)
        phi = arm.phi_load
        limits = Limits(
            q_middle=middle,
            q_half=_JOINT_SHARE * half,
            velocity=_JOINT_SHARE * arm.velocity_limit,
            acceleration=arm.acceleration_limit,
            effort=_JOINT_SHARE * arm.effort_limit,
            phi=phi,
            sensor=np.array(
                [
                    _FORCE_SHARE * min(sensor.force_range),
                    _TORQUE_SHARE * min(sensor.torque_range),
                    sensor.acceleration_range,
                    sensor.angular_acceleration_range,
                ]
            ),
            points_S=points_S,
            box_middle=box[0],
            box_half=box[1],
            capsule_row=rows,
            capsule_ends=np.array([capsule.ends for capsule in capsules]).reshape(-1, 2, 3),
            capsule_radius=np.array([capsule.radius for capsule in capsules]),
            pairs=pairs,
            distances=distances,
            clearance=CLEARANCE,
        )
        std = sensor.wrench_std()
        return Robot(
            name=name,
            diagram=self.diagram,
            plant=self.plant,
            scene_graph=self.scene_graph,
            sensor_frame=self.sensor_frame,
            arm=arm,
            limits=limits,
            scales=Scales((float(std[0]), float(std[3])), characteristic_length(phi), phi),
            noise=sensor_noise(sensor, estimation, arm.num_joints, 1 / sensor_hz),
            home=home,
            assumptions=tuple(assumptions),
            folders=tuple(folders),
        )

    def _rows(self) -> dict[BodyIndex, int]:
        """Of every body, the link of the arm that carries it, as a row of `link_motions`; or -1."""
        rows = {BodyIndex(k): -1 for k in range(self.plant.num_bodies())}
        for row, name in enumerate(self.arm.joint_names):
            joint = self.plant.GetJointByName(name, self.sensor_frame.model_instance())
            for body in self.plant.GetBodiesKinematicallyAffectedBy([joint.index()]):
                rows[body] = row
        return rows

    def _without_neighbours(
        self, rows: dict[BodyIndex, int], postures: Array
    ) -> dict[_Pair, Array]:
        """Pairs of shapes that may collide, with their distance in each posture (inf: far).

        Those on one link, those that are always near, and those whose distance does not vary no
        longer count.
        """
        manager = self.scene_graph.collision_filter_manager()
        for link in set(rows.values()):
            together = [
                shape
                for body, row in rows.items()
                if row == link
                for shape in self.plant.GetCollisionGeometriesForBody(self.plant.get_body(body))
            ]
            manager.Apply(CollisionFilterDeclaration().ExcludeWithin(GeometrySet(together)))
        candidates = self.scene_graph.model_inspector().GetCollisionCandidates()
        distances = {pair: np.full(len(postures), np.inf) for pair in candidates}
        context = self.diagram.CreateDefaultContext()
        of_plant = self.plant.GetMyMutableContextFromRoot(context)
        of_scene = self.scene_graph.GetMyContextFromRoot(context)
        q = self.plant.GetPositions(of_plant)
        for k, posture in enumerate(postures):
            q[self.arm.position_index] = posture
            self.plant.SetPositions(of_plant, q)
            query = self.scene_graph.get_query_output_port().Eval(of_scene)
            for found in query.ComputeSignedDistancePairwiseClosestPoints(_BAND[1]):
                distances[found.id_A, found.id_B][k] = found.distance
        # Another one: what a manager from before the context declares, no context gets to know.
        manager = self.scene_graph.collision_filter_manager()
        for (a, b), of_pair in list(distances.items()):
            still = of_pair.max() < of_pair.min() + _STILL
            if still or np.mean(of_pair < CLEARANCE) >= _NEIGHBOURS:
                exclude = CollisionFilterDeclaration().ExcludeBetween
                manager.Apply(exclude(GeometrySet(a), GeometrySet(b)))
                del distances[a, b]
        return distances

    def _capsules(
        self,
        rows: dict[BodyIndex, int],
        candidates: dict[_Pair, Array],
        postures: Array,
    ) -> tuple[NDArray[np.int64], list[Capsule], NDArray[np.int64], Array]:
        """Rows, capsules, pairs of them, and which distance each pair keeps.

        Left out are pairs that others stand for, those whose capsules are often near though their
        shapes never are, and those whose capsules are near more often when their shapes are not.
        The check looks at the shapes.
        """
        inspector = self.scene_graph.model_inspector()
        motions = empty_motions(1, self.arm.num_joints)
        context = self.diagram.CreateDefaultContext()
        of_plant = self.plant.GetMyContextFromRoot(context)
        q = self.plant.GetPositions(of_plant)[self.arm.position_index][np.newaxis]
        motions_of(self.arm.table, q, 0 * q, 0 * q, motions)
        capsules: dict[GeometryId, tuple[int, Capsule]] = {}
        for shape in sorted({shape for pair in candidates for shape in pair}, key=_number):
            body = self.plant.GetBodyFromFrameId(inspector.GetFrameId(shape))
            row = rows[body.index()]
            X_WB = self.plant.EvalBodyPoseInWorld(of_plant, body)
            X_LB = X_WB if row < 0 else _pose(motions[0, row]).InvertAndCompose(X_WB)
            capsule = bounding_capsule(inspector.GetShape(shape))
            capsules[shape] = row, capsule.moved(X_LB @ inspector.GetPoseInFrame(shape))
            if inspector.GetName(shape).endswith(_TABLE):
                capsules[shape] = row, _TABLE_CAPSULE
        outer = {shape: _outermost(shape, capsules) for shape in capsules}
        kept = sorted({outer[shape] for shape in outer}, key=_number)
        true: dict[tuple[int, int], Array] = {}
        for (a, b), of_pair in candidates.items():
            first, second = sorted((kept.index(outer[a]), kept.index(outer[b])))
            true[first, second] = np.minimum(of_pair, true.get((first, second), np.inf))
        pairs = np.array(sorted(true), dtype=np.int64).reshape(-1, 2)
        of_rows = np.array([capsules[shape][0] for shape in kept], dtype=np.int64)
        shapes = [capsules[shape][1] for shape in kept]
        motions = empty_motions(len(postures), self.arm.num_joints)
        motions_of(self.arm.table, postures, 0 * postures, 0 * postures, motions)
        ends = np.array([capsule.ends for capsule in shapes]).reshape(-1, 2, 3)
        radii = np.array([capsule.radius for capsule in shapes])
        of_capsules = capsule_distances(motions, of_rows, ends, radii, pairs)
        used, distances = [], []
        for k, (a, b) in enumerate(pairs):
            distance = _kept_distance(true[a, b], of_capsules[:, k])
            near, seem_near = true[a, b] < CLEARANCE, of_capsules[:, k] < distance
            if near.sum() >= _FEW:
                useful = np.mean(seem_near[near]) > np.mean(seem_near[~near])
            else:
                useful = near.any() or 0 < np.mean(of_capsules[:, k] < CLEARANCE) < _SELDOM
            if useful:
                used.append(k)
                distances.append(distance)
        return of_rows, shapes, pairs[used], np.array(distances)


def _kept_distance(of_shapes: Array, of_capsules: Array) -> float:
    """The distance that two capsules keep, of (T,) distances in random postures [m].

    Capsules are larger than their shapes. Where the shapes are about to touch, the least by which
    most are is allowed for; but so much that the capsules are free in most postures in which the
    shapes are.
    """
    touching = (of_shapes > _BAND[0]) & (of_shapes < _BAND[1])
    excess = (of_shapes - of_capsules)[touching] if touching.sum() >= _FEW else np.zeros(1)
    free = of_capsules[of_shapes > CLEARANCE]
    return float(min(CLEARANCE - np.quantile(excess, _LEAST), np.quantile(free, _BLOCKED)))


def _number(shape: GeometryId) -> int:
    return int(shape.get_value())


def _outermost(shape: GeometryId, capsules: dict[GeometryId, tuple[int, Capsule]]) -> GeometryId:
    """The largest capsule on the same link that holds that of `shape`."""
    row, capsule = capsules[shape]
    holding = [
        (other.radius, -_number(name), name)
        for name, (other_row, other) in capsules.items()
        if other_row == row and other.holds(capsule)
    ]
    return max(holding, key=lambda entry: entry[:2])[2]


def _pose(motion: Array) -> RigidTransform:
    """X_WL of a link's motion (21,)."""
    return RigidTransform(RotationMatrix(motion[12:].reshape(3, 3)), motion[9:12])


def _add_load(
    plant: MultibodyPlant, instance: ModelInstanceIndex, frame: Frame, phi: Array
) -> None:
    """Welds a body without shape to the sensor."""
    mass = float(phi[0])
    unit = inertia_about_origin(phi) / mass
    moments, products = np.diag(unit), unit[np.triu_indices(3, 1)]
    inertia = SpatialInertia(mass, phi[1:4] / mass, UnitInertia(*moments, *products))
    body = plant.AddRigidBody("drake_teleop_reserve", instance, inertia)
    plant.AddJoint(
        WeldJoint("drake_teleop_reserve", frame, body.body_frame(), RigidTransform.Identity())
    )


def _payload(mass: float) -> Array:
    """(10,) phi of a compact load."""
    com = np.array([0.0, 0.0, _PAYLOAD_COM])
    return phi_from_mass_com_inertia(mass, com, mass * _PAYLOAD_GYRATION**2 * np.eye(3) * 2 / 3)


def _make_solid(plant: MultibodyPlant, scene_graph: SceneGraph, visuals_count: bool) -> None:
    """Gives links the shapes they are seen with, if `visuals_count` or they have no other."""
    inspector = scene_graph.model_inspector()
    for index in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(index))
        if plant.GetCollisionGeometriesForBody(body) and not visuals_count:
            continue
        for k, seen in enumerate(plant.GetVisualGeometriesForBody(body)):
            X_BG, shape = inspector.GetPoseInFrame(seen), inspector.GetShape(seen)
            _add_shape(plant, body, X_BG, shape, f"drake_teleop_solid_{k}")


def _add_shape(
    plant: MultibodyPlant, body: RigidBody, X_BG: RigidTransform, shape: Shape, name: str
) -> None:
    plant.RegisterCollisionGeometry(body, X_BG, shape, name, ProximityProperties())


def _completed(
    arm: ArmModel, efforts: dict[str, float], acceleration: tuple[float, ...], where: str
) -> tuple[ArmModel, list[str]]:
    """The arm with a limit for everything, and what was assumed for it."""
    n, assumptions = arm.num_joints, []
    endless = ~(np.isfinite(arm.lower) & np.isfinite(arm.upper))
    lower, upper = np.where(endless, -_RANGE, arm.lower), np.where(endless, _RANGE, arm.upper)
    velocity = np.where(_given(arm.velocity_limit), arm.velocity_limit, _SPEED)
    effort = np.array([efforts.get(name, np.inf) for name in arm.joint_names])
    effort = np.where(_given(arm.effort_limit), arm.effort_limit, effort)
    effort = np.where(_given(effort), effort, np.inf)
    own = arm.acceleration_limit
    if acceleration:
        if len(acceleration) not in (1, n):
            raise DrakeTeleopError(
                f"{len(acceleration)} acceleration limits for {n} joints",
                where=where,
                remedy="give one for all joints or one for each",
            )
        own = np.broadcast_to(np.array(acceleration), n).copy()
    chosen = np.where(_given(own), own, velocity / _TIME_TO_SPEED)
    for missing, words in (
        (endless, f"a range of +-{_RANGE:.4g} rad"),
        (~_given(arm.velocity_limit), f"a speed limit of {_SPEED:.4g} rad/s"),
        (
            ~_given(own),
            f"acceleration limits that reach full speed in {_TIME_TO_SPEED:g} s (--acceleration)",
        ),
        (~np.isfinite(effort), "no torque limit"),
    ):
        if missing.any():
            names = ", ".join(np.array(arm.joint_names)[missing])
            assumptions.append(f"{words} for {'all joints' if missing.all() else names}")
    completed = replace(
        arm,
        lower=lower,
        upper=upper,
        velocity_limit=velocity,
        acceleration_limit=chosen,
        effort_limit=effort,
    )
    return completed, assumptions


def _given(limits: Array) -> NDArray[np.bool_]:
    """Which limits are limits; a zero is what exporters write when they do not know."""
    return np.isfinite(limits) & (limits > 0)
