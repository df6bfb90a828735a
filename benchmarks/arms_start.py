"""Figures of a station's start posture, from Drake's scene graph: overlaps, heights, margins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.plant import (
    NominalSlave,
    ParsedSlave,
    ParseSlave,
    finalize_without_limit_warnings,
)
from drake_teleop.station.slave.posture_shapes import random_posture_limits
from drake_teleop.station.slave.surroundings import AddEnvironment

#: Overlaps below this depth are rounding of hulls [m].
_MIN_DEPTH_M = 1e-3
_NUM_POSTURES, _DESIGN_SHARE = 200, 0.95  # postures in which a pair by design overlaps, see MoveIt
_ORIENTATION_SHARE = 0.2  # times the reach: weight of a rotation against a displacement


def start_figures(scenario: Scenario, assumed: Sequence[str]) -> dict[str, Any]:
    """Return overlaps, heights [m], relative singular value and limit margin at the start.

    `assumed` are the texts of the plan, which name the pairs that overlap by design.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    parsed = ParseSlave(plant, scenario.slave)
    if scenario.surroundings is not None:
        AddEnvironment(plant, scenario.surroundings)
    finalize_without_limit_warnings(plant)
    diagram = builder.Build()
    context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
    arm, q = parsed.arm()[0], NominalSlave(scenario.slave).start
    positions = plant.GetPositions(context)
    positions[arm.position_index] = q
    plant.SetPositions(context, positions)
    origins = _joint_origins(plant, context, parsed, arm)
    lowest, plane = _lowest_points(plant, context, scene_graph, parsed)
    return {
        "start": [round(float(x), 4) for x in q],
        "overlaps": _overlaps(plant, context, arm, assumed),
        **({"lowest_shape_m": lowest - plane} if np.isfinite(lowest) else {}),
        **_elbow(origins, plane),
        "sigma_over_L": _least_singular_value(plant, context, parsed, arm, origins),
        "limit_margin": _limit_margin(arm, q),
    }


def _overlaps(
    plant: MultibodyPlant, context: Any, arm: ArmModel, assumed: Sequence[str]
) -> list[str]:
    """Return texts of overlapping links that neither a joint nor a telescope connects.

    A pair that the package left out is accepted if it also overlaps in nearly all postures of this
    check.
    """
    inspector, texts = plant.get_geometry_query_input_port().Eval(context).inspector(), []
    groups = _weld_groups(plant)
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    joined = {
        frozenset(groups[body.index()] for body in (joint.parent_body(), joint.child_body()))
        for joint in joints
    }

    def depths() -> dict[frozenset[BodyIndex], float]:
        found = dict[frozenset[BodyIndex], float]()
        query = plant.get_geometry_query_input_port().Eval(context)
        for pair in query.ComputePointPairPenetration():
            frames = (inspector.GetFrameId(shape) for shape in (pair.id_A, pair.id_B))
            bodies = frozenset(plant.GetBodyFromFrameId(frame).index() for frame in frames)
            ends = frozenset(groups[index] for index in bodies)
            if pair.depth > _MIN_DEPTH_M and len(ends) == 2 and ends not in joined:
                found[bodies] = max(found.get(bodies, 0.0), pair.depth)
        return found

    at_start, positions = depths(), plant.GetPositions(context)
    random, counts = np.random.default_rng(5), Counter[frozenset[BodyIndex]]()
    motions = {pair: list[np.ndarray]() for pair in at_start}
    for q in random.uniform(*random_posture_limits(arm), (_NUM_POSTURES, arm.num_joints)):
        posture = positions.copy()
        posture[arm.position_index] = q
        plant.SetPositions(context, posture)
        counts.update(depths().keys())
        for pair, poses in motions.items():
            first, second = (plant.get_body(index) for index in pair)
            poses.append(first.EvalPoseInWorld(context).InvertAndCompose(
                second.EvalPoseInWorld(context)).GetAsMatrix34())  # fmt: skip
    plant.SetPositions(context, positions)
    left_out = " ".join(text for text in assumed if text.startswith("overlaps left out"))
    for pair, depth in at_start.items():
        names = [plant.get_body(index).name() for index in pair]
        by_design = counts[pair] >= _DESIGN_SHARE * _NUM_POSTURES and any(
            " and ".join(order) in left_out for order in (names, names[::-1])
        )
        if not by_design and not _slides_along_a_line(np.array(motions[pair])):
            texts.append(f"{' and '.join(sorted(names))} by {1e3 * depth:.1f} mm")
    return texts


def _slides_along_a_line(X: np.ndarray) -> bool:
    """Return whether poses (k, 3, 4) differ by displacements along one line, as in a telescope."""
    displacements = X[:, :, 3] - X[0, :, 3]
    sizes = np.linalg.svd(displacements, compute_uv=False)
    return bool(np.ptp(X[:, :, :3], axis=0).max() < 1e-9 and sizes[1] < 1e-9 < sizes[0])


def _weld_groups(plant: MultibodyPlant) -> dict[BodyIndex, int]:
    """Return for each body the smallest index of the bodies welded to it."""
    bodies = [plant.get_body(BodyIndex(k)) for k in range(plant.num_bodies())]
    return {
        body.index(): min(int(each.index()) for each in plant.GetBodiesWeldedTo(body))
        for body in bodies
    }


def _joint_origins(
    plant: MultibodyPlant, context: Any, parsed: ParsedSlave, arm: ArmModel
) -> np.ndarray:
    """Return (n+1, 3) origins of the joints and of the sensor frame in W [m]."""
    joints = [plant.GetJointByName(name, parsed.instance) for name in arm.joint_names]
    frames = [*(joint.frame_on_child() for joint in joints), parsed.sensor_frame]
    return np.array([frame.CalcPoseInWorld(context).translation() for frame in frames])


def _lowest_points(
    plant: MultibodyPlant, context: Any, scene_graph: Any, parsed: ParsedSlave
) -> tuple[float, float]:
    """Return the lowest z [m] of the arm's moving shapes and of its base."""
    inspector, signs = scene_graph.model_inspector(), np.array(list(product((-1.0, 1.0), repeat=3)))
    moving, fixed = [np.inf], [np.inf]
    anchored = {body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())}
    for index in plant.GetBodyIndices(parsed.instance):
        body = plant.get_body(index)
        X_WBody = body.EvalPoseInWorld(context)
        for shape in plant.GetCollisionGeometriesForBody(body):
            hull, box = inspector.GetConvexHull(shape), inspector.GetObbInGeometryFrame(shape)
            if hull is not None:
                corners = np.array([hull.vertex(k) for k in range(hull.num_vertices())]).T
            elif box is not None:
                corners = box.pose() @ (signs * box.half_width()).T
            else:
                continue
            points = X_WBody @ inspector.GetPoseInFrame(shape) @ corners
            (fixed if index in anchored else moving).append(float(points[2].min()))
    plane = min(fixed) if len(fixed) > 1 else 0.0
    return min(moving), plane


def _elbow(origins: np.ndarray, plane: float) -> dict[str, float]:
    """Return heights [m] above the base plane, and the upward share of the elbow's offset."""
    heights = {"lowest_joint_m": float(origins[:, 2].min() - plane)}
    if len(origins) < 5:
        return heights
    shoulder, wrist = origins[min(1, len(origins) - 4)], origins[-3]
    along = (wrist - shoulder) / max(float(np.linalg.norm(wrist - shoulder)), 1e-9)
    offsets = origins - shoulder
    offsets = offsets - np.outer(offsets @ along, along)
    between = range(1, len(origins) - 2)
    elbow = max(between, key=lambda k: float(np.linalg.norm(offsets[k])))
    length = float(np.linalg.norm(offsets[elbow]))
    heights["elbow_m"] = float(origins[elbow, 2] - plane)
    return heights | {"elbow_up": float(offsets[elbow, 2] / length) if length > 1e-3 else 0.0}


def _least_singular_value(
    plant: MultibodyPlant, context: Any, parsed: ParsedSlave, arm: ArmModel, origins: np.ndarray
) -> float:
    """Return the least singular value of the Jacobian, rotations times L, over L = reach / 5.

    Directions in which no joint moves the sensor do not count.
    """
    L = _ORIENTATION_SHARE * float(np.linalg.norm(np.diff(origins, axis=0), axis=1).sum())
    world = plant.world_frame()
    J = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, parsed.sensor_frame, np.zeros(3), world, world
    )[:, arm.velocity_index]
    J[:3] *= L
    values = np.linalg.svd(J, compute_uv=False)
    return float(values[values > 1e-9 * values[0]][-1]) / L


def _limit_margin(arm: ArmModel, q: np.ndarray) -> float:
    """Return the smallest distance to a limit over half the range; 1 without limits."""
    half, room = (arm.upper - arm.lower) / 2.0, np.minimum(q - arm.lower, arm.upper - q)
    finite = np.isfinite(half)
    return float((room[finite] / half[finite]).min(initial=1.0))
