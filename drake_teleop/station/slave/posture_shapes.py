"""Shapes of arm, tool and surroundings at given joint positions: distances and overlaps.

Collision shapes count, or visual shapes of a body without them; meshes count as convex hulls. As in
MoveIt's setup assistant, overlaps are ignored if a joint or coaxial prismatic joints connect the
bodies, or by design: if nearly all random postures have them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from functools import lru_cache, partial

import numpy as np
from pydrake import geometry
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, PrismaticJoint, RigidBody
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.numeric import Array
from drake_teleop.station.environment.environment import Environment, SeveralObjects
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.chain_joints import AddSkeleton, bodies_carried_by
from drake_teleop.station.slave.model.model_references import list_model_files
from drake_teleop.station.slave.model.model_repair import join_names
from drake_teleop.station.slave.models import ParseScene
from drake_teleop.station.slave.plant import (
    HashableByValue,
    NominalSlave,
    ParseSlave,
    finalize_without_limit_warnings,
    hull_points_of,
)
from drake_teleop.station.slave.scene import Scene
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.slave.surroundings import AddEnvironment

MIN_OVERLAP_M = 1e-3  #: larger overlaps are reported; smaller ones are rounding of models
_MAX_CHECKED_SHAPE_HALF_WIDTH_M = 1e3  # m; at 1e4 Drake's distance query aborts or hangs
# Pairs that overlap in this share of random postures overlap by design.
_NUM_SAMPLED_POSTURES, _OVERLAP_BY_DESIGN_POSTURE_SHARE = 200, 0.95
_MIN_COSINE_OF_PARALLEL_AXES = 0.999  # cosine of the angle between the axes of a telescope


class PostureShapes:
    """Shapes of a slave and its surroundings in a plant, for overlaps at any joint positions.

    Args:
        sticks: whether sticks replace all missing shapes of an arm.

    Attributes:
        assumptions: texts about missing data of the models.
        tool_body, tool_bodies: indices of the body on the sensor, and of all bodies beyond it.
        surroundings: indices of the bodies of the environment.
        has_sticks: whether sticks replace the shapes of the arm.
    """

    def __init__(
        self, slave: Slave, environment: Environment | None = None, *, sticks: bool = False
    ) -> None:
        builder = DiagramBuilder()
        self.plant, self._scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        self._parsed = ParseSlave(self.plant, slave)
        self.tool_body, of_slave = self._parsed.tool, self.plant.num_bodies()
        if environment is not None:
            AddEnvironment(self.plant, environment)
        self.surroundings = set(map(BodyIndex, range(of_slave, self.plant.num_bodies())))
        beyond = bodies_carried_by(self.plant, self._parsed.sensor_frame.body())
        self.tool_bodies = {body.index() for body in beyond}
        links = [self.plant.get_body(k) for k in self.moving_slave_bodies() - self.tool_bodies]
        shapes = self.plant.GetCollisionGeometriesForBody, self.plant.GetVisualGeometriesForBody
        self.has_sticks = sticks and not any(find(link) for find in shapes for link in links)
        if self.has_sticks:
            AddSkeleton(self.plant, self._parsed.sensor_frame)
        _prepare_shapes_for_distances(self.plant, self._scene_graph)
        finalize_without_limit_warnings(self.plant)
        self.arm, assumed = self._parsed.arm()
        self.assumptions = [*self._parsed.assumptions, *assumed]
        self._exclude_contact_of_joined_bodies()
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self.context = self.plant.GetMyMutableContextFromRoot(self._root)
        bodies, shapes_of = map(BodyIndex, range(self.plant.num_bodies())), self.contact_shapes_of
        points = partial(hull_points_of, self._scene_graph.model_inspector())
        self._points = {index: list(map(points, shapes_of(index))) for index in bodies}
        self._by_design = self._body_pairs_overlapping_by_design()
        names = [" and ".join(self.plant.get_body(k).name() for k in p) for p in self._by_design]
        if names:
            what = "overlaps left out, as they are in nearly all postures:"
            self.assumptions.append(f"{what} {join_names(sorted(names))}")

    def contact_shapes_of(self, body: BodyIndex) -> list[geometry.GeometryId]:
        inspector = self._scene_graph.model_inspector()
        shapes = self.plant.GetCollisionGeometriesForBody(self.plant.get_body(body))
        return [each for each in shapes if inspector.GetProximityProperties(each) is not None]

    def move_to(self, q: Array) -> None:
        positions = self.plant.GetPositions(self.context)
        positions[self.arm.position_index] = q
        self.plant.SetPositions(self.context, positions)

    @property
    def X_WS(self) -> RigidTransform:
        return self._parsed.sensor_frame.CalcPoseInWorld(self.context)

    def bodies_welded_to_sensor(self) -> set[BodyIndex]:
        body = self._parsed.sensor_frame.body()
        return {each.index() for each in self.plant.GetBodiesWeldedTo(body)}

    def overlaps(self) -> list[tuple[RigidBody, RigidBody, float]]:
        """Return pairs that overlap, not by design, and minus the depth of overlap [m]."""
        body, found = self.plant.get_body, self._overlap_distances()
        pairs = [pair for pair in found if pair not in self._by_design]
        return [(body(first), body(second), found[first, second]) for first, second in pairs]

    def points_on_bodies_W(self, bodies: Collection[BodyIndex]) -> Array:
        hulls = [hull for body in bodies for hull in self.hull_points_W(body)]
        return np.vstack([np.zeros((0, 3)), *hulls])

    def hull_points_W(self, index: BodyIndex, *, visual: bool = False) -> list[Array]:
        """Return hull points (k, 3) in W [m] by collision shape, or by `visual` shape if any."""
        body, hulls = self.plant.get_body(index), self._points[index]
        if visual and (shapes := self.plant.GetVisualGeometriesForBody(body)):
            hulls = [hull_points_of(self._scene_graph.model_inspector(), each) for each in shapes]
        X_WB = self.plant.EvalBodyPoseInWorld(self.context, body)
        return [(X_WB @ points.T).T for points in hulls]

    def anchored_slave_bodies(self) -> set[BodyIndex]:
        fixed = self.plant.GetBodiesWeldedTo(self.plant.world_body())
        return {body.index() for body in fixed} - self.surroundings

    def moving_slave_bodies(self) -> set[BodyIndex]:
        every = set(map(BodyIndex, range(self.plant.num_bodies())))
        return every - self.surroundings - self.anchored_slave_bodies()

    def _overlap_distances(self) -> dict[tuple[BodyIndex, BodyIndex], float]:
        scene = self._scene_graph.GetMyContextFromRoot(self._root)
        query = self._scene_graph.get_query_output_port().Eval(scene)
        found: dict[tuple[BodyIndex, BodyIndex], float] = {}
        for each in query.ComputeSignedDistancePairwiseClosestPoints(0.0):
            frames = [query.inspector().GetFrameId(shape) for shape in (each.id_A, each.id_B)]
            bodies = [self.plant.GetBodyFromFrameId(frame).index() for frame in frames]
            first, second = sorted(bodies, key=int)
            found[first, second] = min(each.distance, found.get((first, second), np.inf))
        return found

    def _exclude_contact_of_joined_bodies(self) -> None:
        plant, manager = self.plant, self._scene_graph.collision_filter_manager()

        def bodies_of_link(body: RigidBody) -> set[BodyIndex]:
            return {each.index() for each in plant.GetBodiesWeldedTo(body)} - self.surroundings

        context, together = plant.CreateDefaultContext(), [self.surroundings]
        telescopes = list[tuple[Array, set[BodyIndex]]]()
        for joint in map(plant.get_joint, plant.GetJointIndices()):
            if joint.child_body().index() in self.surroundings:
                continue
            joined = bodies_of_link(joint.parent_body()) | bodies_of_link(joint.child_body())
            if isinstance(joint, PrismaticJoint):
                R_WF = joint.frame_on_parent().CalcPoseInWorld(context).rotation()
                axis = R_WF @ joint.translation_axis()
                for other, bodies in telescopes:
                    if bodies & joined and abs(axis @ other) > _MIN_COSINE_OF_PARALLEL_AXES:
                        joined |= bodies
                telescopes.append((axis, joined))
            together.append(joined)
        for bodies in together:
            shapes = [shape for each in bodies for shape in self.contact_shapes_of(each)]
            within = geometry.GeometrySet(shapes)
            manager.Apply(geometry.CollisionFilterDeclaration().ExcludeWithin(within))

    def _body_pairs_overlapping_by_design(self) -> set[tuple[BodyIndex, BodyIndex]]:
        random, counts = np.random.default_rng(0), Counter[tuple[BodyIndex, BodyIndex]]()
        least = int(np.ceil(_OVERLAP_BY_DESIGN_POSTURE_SHARE * _NUM_SAMPLED_POSTURES))
        limits = random_posture_limits(self.arm)
        for left in range(_NUM_SAMPLED_POSTURES, 0, -1):
            self.move_to(random.uniform(*limits))
            counts.update(p for p in self._overlap_distances() if not self.surroundings & set(p))
            if max(counts.values(), default=0) + left <= least:
                return set()
        return {pair for pair, count in counts.items() if count >= least}


def random_posture_limits(arm: ArmModel) -> tuple[Array, Array]:
    """Return finite joint limits (n,): +-pi for infinite ones, or ranges beyond -pi to pi."""
    wide = arm.upper - arm.lower > 2.0 * np.pi + 1e-9
    around_zero = wide & (arm.lower <= -np.pi) & (arm.upper >= np.pi)
    finite_lower = np.where(np.isfinite(arm.lower), arm.lower, -np.pi)
    finite_upper = np.where(np.isfinite(arm.upper), arm.upper, np.pi)
    return np.where(around_zero, -np.pi, finite_lower), np.where(around_zero, np.pi, finite_upper)


def start_overlap_texts(
    slave: Slave, environment: Environment | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return warnings about bodies that overlap at the start, and assumptions about shapes."""
    parts = [] if environment is None else list(environment.parts)
    scenes = [part.path for part in parts if isinstance(part, Scene)]
    files = [file for path in scenes for file in list_model_files(path, ())]
    return _cached_overlap_texts(HashableByValue((slave, parts), slave.model_files() + files))


@lru_cache(maxsize=4)
def _cached_overlap_texts(key: HashableByValue) -> tuple[tuple[str, ...], tuple[str, ...]]:
    slave, parts = key.value
    shapes = PostureShapes(slave, SeveralObjects(parts) if parts else None)
    shapes.move_to(NominalSlave(slave).start)
    scenes = [part.path for part in parts if isinstance(part, Scene)]
    texts = [f"{path.name}: {x}" for path in scenes for x in ParseScene(MultibodyPlant(0.0), path)]
    return tuple(overlap_warnings(shapes)), (*shapes.assumptions, *texts)


def overlap_warnings(shapes: PostureShapes, *, slave_only: bool = False) -> list[str]:
    """Return a warning per pair of overlapping bodies; `slave_only` omits the surroundings."""
    found = []
    for first, second, distance in shapes.overlaps():
        with_surroundings = bool(shapes.surroundings & {first.index(), second.index()})
        if distance > -MIN_OVERLAP_M or (slave_only and with_surroundings):
            continue
        remedy = "give another start in slave.home, or correct the shapes of the model"
        if with_surroundings:
            remedy = "move the object in environment, or give another start in slave.home"
        what, depth = f"{first.name()} and {second.name()}", f"{-1e3 * distance:.1f} mm"
        found.append(f"{what} overlap by {depth} at the start (convex hulls of meshes); {remedy}")
    return found


def _prepare_shapes_for_distances(plant: MultibodyPlant, scene_graph: geometry.SceneGraph) -> None:
    """Make visual shapes the collision shapes where missing; remove unbounded shapes."""
    # Polyhedra replace curved shapes, because Drake's distance query may hang for capsules.
    inspector, source = scene_graph.model_inspector(), plant.get_source_id()
    added = []  # afterwards, because Drake's lists move when shapes are added
    for body in map(plant.get_body, map(BodyIndex, range(plant.num_bodies()))):
        solids = plant.GetCollisionGeometriesForBody(body)
        for k, identifier in enumerate(solids or plant.GetVisualGeometriesForBody(body)):
            shape, box = inspector.GetShape(identifier), inspector.GetObbInGeometryFrame(identifier)
            is_curved = isinstance(shape, (geometry.Capsule, geometry.Cylinder, geometry.Ellipsoid))
            is_limited = box is not None and max(box.half_width()) < _MAX_CHECKED_SHAPE_HALF_WIDTH_M
            here, name = RigidTransform(inspector.GetPoseInFrame(identifier)), f"solid_{k}"
            if is_curved:
                points = hull_points_of(inspector, identifier).T
                shape = geometry.Convex(here.inverse() @ points, name)
            if is_limited and (is_curved or not solids):
                added.append((body, here, shape.Clone(), f"{body.name()}_{name}"))
            if solids and (is_curved or not is_limited):
                scene_graph.RemoveRole(source, identifier, geometry.Role.kProximity)
    for each in added:
        plant.RegisterCollisionGeometry(*each, geometry.ProximityProperties())
