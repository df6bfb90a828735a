"""Which shapes of an arm and its surroundings may collide, as shapes and as capsules."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    HalfSpace,
    ProximityProperties,
    Role,
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
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.arrays import Array
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.excitation.capsules import Capsule, bounding_capsule
from drake_teleop.lab.excitation.limits import capsule_distances, empty_motions, motions_of
from drake_teleop.load.inertia import inertia_about_origin
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.plant import finalize

#: What the arm keeps between its links, and from everything else [m]. The flange of the RX90 passes
#: its forearm at 6 mm.
CLEARANCE = 0.005
# Pairs of shapes nearer than that in this share of random postures are neighbours by design, and so
# are those whose distance varies by less than this [m].
_NEIGHBOURS, _STILL = 0.95, 1e-3
# Distances at which shapes are about to touch [m], the share of such postures in which capsules may
# be too small by what is allowed for, and the share of free postures that they may block.
_BAND, _LEAST, _BLOCKED = (-0.02, 0.05), 0.25, 0.1
# With fewer such postures nothing is allowed for.
_FEW = 5
# Capsules that are near in less than this share of the postures may be so; in more, only if their
# shapes are ever near.
_SELDOM = 0.05

_TABLE = "drake_teleop_table"
# Stands for a plane, to which Drake gives no distances, and where below it; wider than any arm.
_PLATE, _X_PLANE_PLATE = Box(10, 10, 1), RigidTransform([0, 0, -0.5])
_LARGEST = 1e3  # of shapes [m]; with 1e4 Drake's distances abort, or never end
# A plane as a ball of 1 km: 2 m away it is 2 mm too low, and the check has the plane.
_TABLE_CAPSULE = Capsule(np.full((2, 3), (0.0, 0.0, -1e3)), 1e3)

_Pair = tuple[GeometryId, GeometryId]
Parse = Callable[[MultibodyPlant], tuple[ModelInstanceIndex, Frame]]


class Scene:
    """Plant and scene graph of the arm with its heaviest load, and which shapes may collide.

    Args:
        parse: adds the arm and its surroundings to a plant.
        reserve: (10,) phi of what may hang on the sensor besides.
        visuals_count: whether links are as large as they are seen, too.
        where: all this is from, for messages.

    Raises:
        DrakeTeleopError: for a shape that is too large to be one of an arm.
    """

    def __init__(
        self, parse: Parse, reserve: Array, *, visuals_count: bool, where: str = ""
    ) -> None:
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        instance, self.sensor_frame = parse(self.plant)
        _add_load(self.plant, instance, self.sensor_frame, reserve)
        _make_solid(self.plant, self.scene_graph, visuals_count)
        _check_sizes(self.plant, self.scene_graph, where)
        _add_shape(
            self.plant,
            self.plant.world_body(),
            RigidTransform(),
            HalfSpace(),
            _TABLE,
        )
        finalize(self.plant)
        self.arm = ArmModelFromPlant(self.plant, instance, self.sensor_frame.name())
        self.diagram = builder.Build()

    def rows(self) -> dict[BodyIndex, int]:
        """Of every body, the link of the arm that carries it, as a row of `link_motions`; or -1."""
        rows = {BodyIndex(k): -1 for k in range(self.plant.num_bodies())}
        for row, name in enumerate(self.arm.joint_names):
            joint = self.plant.GetJointByName(name, self.sensor_frame.model_instance())
            for body in self.plant.GetBodiesKinematicallyAffectedBy([joint.index()]):
                rows[body] = row
        return rows

    def without_neighbours(
        self, rows: dict[BodyIndex, int], postures: Array, start: Array | None
    ) -> tuple[dict[_Pair, Array], list[str]]:
        """Pairs of shapes that may collide, with their distance in each posture (inf: far).

        Those on one link, those that are always near, and those whose distance does not vary no
        longer count; nor do those that touch where the arm starts, because there it stands: they
        are larger than what they stand for, as the convex hull of a mesh is.

        Args:
            rows: of `rows`.
            postures: (T, n) random ones.
            start: (n,) where the arm starts, if that is known.

        Returns:
            the pairs; and the names of those that touch at the start.
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
        context = self.diagram.CreateDefaultContext()
        of_plant = self.plant.GetMyMutableContextFromRoot(context)
        of_scene = self.scene_graph.GetMyContextFromRoot(context)
        q = self.plant.GetPositions(of_plant)
        looked_at = postures if start is None else np.vstack([postures, start])
        distances = {pair: np.full(len(looked_at), np.inf) for pair in candidates}
        for k, posture in enumerate(looked_at):
            q[self.arm.position_index] = posture
            self.plant.SetPositions(of_plant, q)
            query = self.scene_graph.get_query_output_port().Eval(of_scene)
            for found in query.ComputeSignedDistancePairwiseClosestPoints(_BAND[1]):
                distances[found.id_A, found.id_B][k] = found.distance
        # Another one: what a manager from before the context declares, no context gets to know.
        manager = self.scene_graph.collision_filter_manager()
        touching = list[str]()
        for (a, b), of_all in list(distances.items()):
            of_pair = distances[a, b] = of_all[: len(postures)]
            still = of_pair.max() < of_pair.min() + _STILL
            neighbours = still or np.mean(of_pair < CLEARANCE) >= _NEIGHBOURS
            touch = start is not None and of_all[-1] < CLEARANCE
            if touch and not neighbours:
                touching.append(" and ".join(self._body_names(a, b)))
            if touch or neighbours:
                exclude = CollisionFilterDeclaration().ExcludeBetween
                manager.Apply(exclude(GeometrySet(a), GeometrySet(b)))
                del distances[a, b]
        return distances, sorted(set(touching))

    def _body_names(self, *shapes: GeometryId) -> list[str]:
        inspector = self.scene_graph.model_inspector()
        frames = map(inspector.GetFrameId, shapes)
        return sorted(self.plant.GetBodyFromFrameId(frame).name() for frame in frames)

    def capsules(
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


def _make_solid(plant: MultibodyPlant, scene_graph: SceneGraph, visuals_count: bool) -> None:
    """Gives links the shapes they are seen with, if `visuals_count` or they have no other.

    Plates take the place of planes.
    """
    inspector = scene_graph.model_inspector()
    for index in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(index))
        for k, solid in enumerate(plant.GetCollisionGeometriesForBody(body)):
            if isinstance(shape := inspector.GetShape(solid), HalfSpace):
                X_BG = inspector.GetPoseInFrame(solid)
                scene_graph.RemoveRole(plant.get_source_id(), solid, Role.kProximity)
                _add_shape(plant, body, X_BG, shape, f"drake_teleop_plane_{k}")
        if plant.GetCollisionGeometriesForBody(body) and not visuals_count:
            continue
        for k, seen in enumerate(plant.GetVisualGeometriesForBody(body)):
            X_BG, shape = inspector.GetPoseInFrame(seen), inspector.GetShape(seen)
            _add_shape(plant, body, X_BG, shape, f"drake_teleop_solid_{k}")


def _check_sizes(plant: MultibodyPlant, scene_graph: SceneGraph, where: str) -> None:
    inspector = scene_graph.model_inspector()
    for index in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(index))
        for solid in plant.GetCollisionGeometriesForBody(body):
            shape = inspector.GetShape(solid)
            if isinstance(shape, HalfSpace):  # a plate stands for it
                continue
            capsule = bounding_capsule(shape)
            size = np.ptp(capsule.ends, axis=0).max() + 2 * capsule.radius
            if not size <= _LARGEST:
                raise DrakeTeleopError(
                    f"a shape of {body.name()} is {size:.3g} m large, more than {_LARGEST:g} m",
                    where=where,
                    remedy="give all lengths in metres",
                )


def _add_shape(
    plant: MultibodyPlant, body: RigidBody, X_BG: RigidTransform, shape: Shape, name: str
) -> None:
    if isinstance(shape, HalfSpace):
        X_BG, shape = X_BG @ _X_PLANE_PLATE, _PLATE
    plant.RegisterCollisionGeometry(body, X_BG, shape, name, ProximityProperties())
