"""Collision candidates of an arm and its surroundings, as shapes and as bounding capsules."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake import geometry
from pydrake.geometry import Capsule as CapsuleShape
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody import tree
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.excitation import limits
from drake_teleop.load.inertia import inertia_about_origin
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.plant import finalize_without_limit_warnings

_NUM_CYLINDER_RIM_POINTS = 24  # of the circumscribed polygon of a cylinder


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` [m] of a segment with `ends` (2, 3) [m]."""

    ends: Array
    radius: float

    def transformed(self, X: RigidTransform) -> Capsule:
        return Capsule(X.multiply(self.ends.T).T, self.radius)

    def contains(self, other: Capsule) -> bool:
        distances = _distances_to_segment(self.ends, other.ends)
        return bool(np.all(distances + other.radius <= self.radius + 1e-9))


def bounding_capsule(shape: geometry.Shape) -> Capsule:
    if isinstance(shape, geometry.Sphere):
        return Capsule(np.zeros((2, 3)), shape.radius())
    if isinstance(shape, CapsuleShape):
        end = np.array([0.0, 0.0, shape.length() / 2])
        return Capsule(np.array([-end, end]), shape.radius())
    points = _convex_hull_points(shape)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (high + low) / 2, (high - low) / 2
    candidates = []
    for axis in np.eye(3):
        for share in (0.0, 0.4, 0.6, 0.8, 0.9, 1.0):
            end = share * axis * half
            ends = np.array([middle - end, middle + end])
            radius = float(_distances_to_segment(ends, points).max())
            length = 2 * share * float(axis @ half)
            candidates.append((np.pi * radius**2 * (length + 4 / 3 * radius), ends, radius))
    _, ends, radius = min(candidates, key=lambda candidate: candidate[0])
    return Capsule(ends, radius)


def _convex_hull_points(shape: geometry.Shape) -> Array:
    corners = np.array(np.meshgrid(*3 * [[-1.0, 1.0]])).reshape(3, 8).T
    if isinstance(shape, geometry.Box):
        return corners * (shape.size() / 2)
    if isinstance(shape, geometry.Ellipsoid):
        return corners * [shape.a(), shape.b(), shape.c()]
    if isinstance(shape, geometry.Cylinder):
        angle = 2 * np.pi * np.arange(_NUM_CYLINDER_RIM_POINTS) / _NUM_CYLINDER_RIM_POINTS
        radius, half = shape.radius() / np.cos(np.pi / len(angle)), shape.length() / 2
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        return np.vstack([np.column_stack([x, y, np.full(len(x), z)]) for z in (-half, half)])
    hull = shape.GetConvexHull()
    return np.array([hull.vertex(i) for i in range(hull.num_vertices())])


def _distances_to_segment(ends: Array, points: Array) -> Array:
    along = ends[1] - ends[0]
    length = float(along @ along)
    share = np.clip((points - ends[0]) @ along / length, 0, 1) if length > 0 else 0 * points[:, 0]
    return np.linalg.norm(points - ends[0] - np.multiply.outer(share, along), axis=1)


#: Minimum distance between links, and to other bodies [m] (RX90: flange to forearm 6 mm).
MIN_CLEARANCE_M = 0.005
# Neighbours by design: pairs that are closer than the clearance in this share of random postures,
# or whose distance varies by less than this [m].
_NEIGHBOUR_TOUCHING_SHARE, _MIN_PAIR_DISTANCE_VARIATION_M = 0.95, 1e-3
# Number of postures that show which shapes remain at a constant distance.
_NUM_COAXIALITY_POSTURES = 20
# Distances of shapes near contact [m]; quantile of the capsules' excess there; share of free
# postures that capsules may block.
_NEAR_CONTACT_GAPS_M, _CAPSULE_EXCESS_QUANTILE, _BLOCKABLE_POSTURE_SHARE = (-0.02, 0.05), 0.25, 0.1
_MIN_NUM_POSTURES_NEAR_CONTACT = 5  # for a correction
# Pairs whose capsules are near in fewer postures count although their shapes were never near.
_RARE_CONTACT_POSTURE_SHARE = 0.05

_TABLE_SHAPE_NAME = "drake_teleop_table"
# Replaces a half space, for which Drake has no distances; wider than any arm.
_BOX_FOR_HALF_SPACE = geometry.Box(10, 10, 1)
_POSE_OF_BOX_FOR_HALF_SPACE = RigidTransform([0, 0, -0.5])
_MAX_SHAPE_SIZE_M = 1e3  # at 1e4 Drake's distance query aborts or hangs
# The table as a ball of 1 km radius: 2 mm too low at 2 m distance.
_TABLE_CAPSULE = Capsule(np.full((2, 3), (0.0, 0.0, -1e3)), 1e3)

_ShapePair = tuple[geometry.GeometryId, geometry.GeometryId]
ArmParser = Callable[[MultibodyPlant], tuple[tree.ModelInstanceIndex, tree.Frame]]


class CollisionScene:
    """Drake plant and scene graph of an arm with its heaviest load and a table at z = 0.

    Args:
        extra_phi: (10,) parameters phi of an additional load at the sensor, about So.
        visuals_collide: whether visual shapes also collide.
    """

    def __init__(
        self, parse: ArmParser, extra_phi: Array, *, visuals_collide: bool, where: str = ""
    ) -> None:
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        instance, self.sensor_frame = parse(self.plant)
        _add_load_body(self.plant, instance, self.sensor_frame, extra_phi)
        _add_collision_shapes_and_check_sizes(self.plant, self.scene_graph, visuals_collide, where)
        world, table = self.plant.world_body(), geometry.HalfSpace()
        _add_collision_shape(self.plant, world, RigidTransform(), table, _TABLE_SHAPE_NAME)
        finalize_without_limit_warnings(self.plant)
        self.arm = ArmModelFromPlant(self.plant, instance, self.sensor_frame.name())
        self.diagram = builder.Build()
        self._rows = {tree.BodyIndex(k): -1 for k in range(self.plant.num_bodies())}
        for row, name in enumerate(self.arm.joint_names):
            joint = self.plant.GetJointByName(name, self.sensor_frame.model_instance())
            for body in self.plant.GetBodiesKinematicallyAffectedBy([joint.index()]):
                self._rows[body] = row

    def find_collision_candidates_and_touching(
        self, postures: Array, start: Array | None
    ) -> tuple[dict[_ShapePair, Array], list[str]]:
        """Return distances (T,) [m] by pair that may collide, and names of body pairs in contact.

        Excluded: pairs on one link, almost always near, at constant distance, touching at `start`.
        """
        manager = self.scene_graph.collision_filter_manager()
        for link in set(self._rows.values()):
            bodies = [self.plant.get_body(body) for body, row in self._rows.items() if row == link]
            together = itertools.chain(*map(self.plant.GetCollisionGeometriesForBody, bodies))
            shapes = geometry.GeometrySet(list(together))
            manager.Apply(geometry.CollisionFilterDeclaration().ExcludeWithin(shapes))
        candidates = self.scene_graph.model_inspector().GetCollisionCandidates()
        context = self.diagram.CreateDefaultContext()
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        scene_context = self.scene_graph.GetMyContextFromRoot(context)
        q = self.plant.GetPositions(plant_context)
        all_postures = postures if start is None else np.vstack([postures, start])
        distances = {pair: np.full(len(all_postures), np.inf) for pair in candidates}
        for k, posture in enumerate(all_postures):
            q[self.arm.position_index] = posture
            self.plant.SetPositions(plant_context, q)
            query = self.scene_graph.get_query_output_port().Eval(scene_context)
            for found in query.ComputeSignedDistancePairwiseClosestPoints(_NEAR_CONTACT_GAPS_M[1]):
                distances[found.id_A, found.id_B][k] = found.distance
            if k + 1 == _NUM_COAXIALITY_POSTURES:
                in_context = self.scene_graph.collision_filter_manager(scene_context)
                _exclude_coaxial_pairs(in_context, distances)
        # A new manager: declarations of a manager older than the context have no effect there.
        manager = self.scene_graph.collision_filter_manager()
        touching = list[str]()
        for (a, b), of_all in list(distances.items()):
            of_pair = distances[a, b] = of_all[: len(postures)]
            constant = of_pair.max() < of_pair.min() + _MIN_PAIR_DISTANCE_VARIATION_M
            neighbours = constant or np.mean(of_pair < MIN_CLEARANCE_M) >= _NEIGHBOUR_TOUCHING_SHARE
            touch = start is not None and of_all[-1] < MIN_CLEARANCE_M
            if touch and not neighbours:
                frames = map(self.scene_graph.model_inspector().GetFrameId, (a, b))
                names = sorted(self.plant.GetBodyFromFrameId(frame).name() for frame in frames)
                touching.append(" and ".join(names))
            if touch or neighbours:
                _exclude_collision_pair(manager, a, b)
                del distances[a, b]
        return distances, sorted(set(touching))

    def bounding_capsules_and_pairs(
        self, candidates: dict[_ShapePair, Array], postures: Array
    ) -> dict[str, NDArray[Any]]:
        """Return `Limits` fields `capsule_*` of shapes, and of their pairs that may collide."""
        inspector = self.scene_graph.model_inspector()
        context = self.diagram.CreateDefaultContext()
        plant_context = self.plant.GetMyContextFromRoot(context)
        q = self.plant.GetPositions(plant_context)[self.arm.position_index][np.newaxis]
        motions = limits.link_motion_series(self.arm.table, q, 0 * q, 0 * q)
        capsules: dict[geometry.GeometryId, tuple[int, Capsule]] = {}
        shapes = {shape for pair in candidates for shape in pair}
        for shape in sorted(shapes, key=geometry.GeometryId.get_value):
            body = self.plant.GetBodyFromFrameId(inspector.GetFrameId(shape))
            row = self._rows[body.index()]
            X_WB = self.plant.EvalBodyPoseInWorld(plant_context, body)
            X_WL = RigidTransform()
            if row >= 0:
                *_, p_WL, R_WL = np.split(motions[0, row], [9, 12])
                X_WL = RigidTransform(RotationMatrix(R_WL.reshape(3, 3)), p_WL)
            X_LG = X_WL.InvertAndCompose(X_WB) @ inspector.GetPoseInFrame(shape)
            capsules[shape] = row, bounding_capsule(inspector.GetShape(shape)).transformed(X_LG)
            if inspector.GetName(shape).endswith(_TABLE_SHAPE_NAME):
                capsules[shape] = row, _TABLE_CAPSULE
        outer = {shape: _find_largest_enclosing_shape(shape, capsules) for shape in capsules}
        outer_shapes = sorted(set(outer.values()), key=geometry.GeometryId.get_value)
        shape_distances: dict[tuple[int, int], Array] = {}
        for (a, b), of_pair in candidates.items():
            first, second = sorted((outer_shapes.index(outer[a]), outer_shapes.index(outer[b])))
            known = shape_distances.get((first, second), np.inf)
            shape_distances[first, second] = np.minimum(of_pair, known)
        pairs = np.array(sorted(shape_distances), dtype=np.int64).reshape(-1, 2)
        outer_capsules = [capsules[shape][1] for shape in outer_shapes]
        motions = limits.link_motion_series(self.arm.table, postures, 0 * postures, 0 * postures)
        fields: dict[str, NDArray[Any]] = {
            "capsule_links": np.array([capsules[shape][0] for shape in outer_shapes], np.int64),
            "capsule_ends": np.array([each.ends for each in outer_capsules]).reshape(-1, 2, 3),
            "capsule_radius": np.array([each.radius for each in outer_capsules]),
        }
        capsule_distances = limits.capsule_distances(motions, *fields.values(), pairs)
        used, distances = [], []
        for k, (a, b) in enumerate(pairs):
            distance = _min_capsule_pair_distance(shape_distances[a, b], capsule_distances[:, k])
            near = shape_distances[a, b] < MIN_CLEARANCE_M
            capsules_near = capsule_distances[:, k] < distance
            if near.sum() >= _MIN_NUM_POSTURES_NEAR_CONTACT:
                useful = np.mean(capsules_near[near]) > np.mean(capsules_near[~near])
            else:
                near_share = np.mean(capsule_distances[:, k] < MIN_CLEARANCE_M)
                useful = near.any() or 0 < near_share < _RARE_CONTACT_POSTURE_SHARE
            if useful:
                used.append(k)
                distances.append(distance)
        return fields | {"capsule_pairs": pairs[used], "min_pair_distances": np.array(distances)}


def _min_capsule_pair_distance(shape_distances: Array, capsule_distances: Array) -> float:
    # Capsules are larger than their shapes, so the lower quartile of their excess is subtracted.
    low, high = _NEAR_CONTACT_GAPS_M
    touching = (shape_distances > low) & (shape_distances < high)
    excess = np.zeros(1)
    if touching.sum() >= _MIN_NUM_POSTURES_NEAR_CONTACT:
        excess = (shape_distances - capsule_distances)[touching]
    required = MIN_CLEARANCE_M - np.quantile(excess, _CAPSULE_EXCESS_QUANTILE)
    free = capsule_distances[shape_distances > MIN_CLEARANCE_M]
    return float(min(required, np.quantile(free, _BLOCKABLE_POSTURE_SHARE)))


def _exclude_coaxial_pairs(
    manager: geometry.CollisionFilterManager, distances: dict[_ShapePair, Array]
) -> None:
    # Drake's query is slow for pairs of shapes that are near at a constant distance.
    for (a, b), of_pair in distances.items():
        first = of_pair[:_NUM_COAXIALITY_POSTURES]
        if first.max() < min(MIN_CLEARANCE_M, first.min() + _MIN_PAIR_DISTANCE_VARIATION_M):
            of_pair[:] = first[0]
            _exclude_collision_pair(manager, a, b)


def _exclude_collision_pair(
    manager: geometry.CollisionFilterManager, a: geometry.GeometryId, b: geometry.GeometryId
) -> None:
    exclude = geometry.CollisionFilterDeclaration().ExcludeBetween
    manager.Apply(exclude(geometry.GeometrySet(a), geometry.GeometrySet(b)))


def _find_largest_enclosing_shape(
    shape: geometry.GeometryId, capsules: dict[geometry.GeometryId, tuple[int, Capsule]]
) -> geometry.GeometryId:
    row, capsule = capsules[shape]
    holding = [
        (other.radius, -name.get_value(), name)
        for name, (other_row, other) in capsules.items()
        if other_row == row and other.contains(capsule)
    ]
    return max(holding, key=lambda entry: entry[:2])[2]


def _add_load_body(
    plant: MultibodyPlant, instance: tree.ModelInstanceIndex, frame: tree.Frame, phi: Array
) -> None:
    mass, unit = float(phi[0]), inertia_about_origin(phi) / phi[0]
    moments, products = np.diag(unit), unit[np.triu_indices(3, 1)]
    inertia = tree.SpatialInertia(mass, phi[1:4] / mass, tree.UnitInertia(*moments, *products))
    body = plant.AddRigidBody("drake_teleop_reserve", instance, inertia)
    weld = tree.WeldJoint("drake_teleop_reserve", frame, body.body_frame(), RigidTransform())
    plant.AddJoint(weld)


def _add_collision_shapes_and_check_sizes(
    plant: MultibodyPlant, scene_graph: geometry.SceneGraph, visuals_collide: bool, where: str
) -> None:
    inspector = scene_graph.model_inspector()
    for index in range(plant.num_bodies()):
        body = plant.get_body(tree.BodyIndex(index))
        solids = plant.GetCollisionGeometriesForBody(body)
        for k, solid in enumerate(solids):
            if isinstance(shape := inspector.GetShape(solid), geometry.HalfSpace):
                X_BG = inspector.GetPoseInFrame(solid)
                scene_graph.RemoveRole(plant.get_source_id(), solid, geometry.Role.kProximity)
                _add_collision_shape(plant, body, X_BG, shape, f"drake_teleop_plane_{k}")
        visuals = plant.GetVisualGeometriesForBody(body) if visuals_collide or not solids else ()
        for k, visual in enumerate(visuals):
            X_BG, shape = inspector.GetPoseInFrame(visual), inspector.GetShape(visual)
            _add_collision_shape(plant, body, X_BG, shape, f"drake_teleop_solid_{k}")
        for shape in map(inspector.GetShape, plant.GetCollisionGeometriesForBody(body)):
            if isinstance(shape, geometry.HalfSpace):  # replaced by a plate
                continue
            capsule = bounding_capsule(shape)
            size = np.ptp(capsule.ends, axis=0).max() + 2 * capsule.radius
            if not size <= _MAX_SHAPE_SIZE_M:
                limit = f"(at most {_MAX_SHAPE_SIZE_M:g} m)"
                what = f"body '{body.name()}' has a shape of {size:.3g} m {limit}"
                raise DrakeTeleopError(what, where=where, remedy="give all lengths in metres")


def _add_collision_shape(
    plant: MultibodyPlant,
    body: tree.RigidBody,
    X_BG: RigidTransform,
    shape: geometry.Shape,
    name: str,
) -> None:
    if isinstance(shape, geometry.HalfSpace):
        X_BG, shape = X_BG @ _POSE_OF_BOX_FOR_HALF_SPACE, _BOX_FOR_HALF_SPACE
    plant.RegisterCollisionGeometry(body, X_BG, shape, name, geometry.ProximityProperties())
