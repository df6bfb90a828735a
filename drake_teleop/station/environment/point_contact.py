"""Compiled copy of Drake's compliant point contact, for spheres of the tool on boxes.

Depth x, stiffness k, dissipation d, slip velocity v_t; the friction coefficient mu is a function of
s = |v_t| / v_s with the speed v_s of full friction::

    f_n = k x (1 + d dx/dt) >= 0;   f_t = -mu(s) f_n v_t / |v_t|
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydrake.geometry import Box, GeometryId, Obb, SceneGraphInspector, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CalcContactFrictionFromSurfaceProperties, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PrismaticJoint, RigidBody
from pydrake.systems.framework import Context

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import (
    apply_matrix,
    dot,
    matrix_as_tuple,
    matrix_at,
    minus,
    plus,
    scale_vector,
    transposed,
    vector_at,
)

#: Columns of `ShapePairs.compiled_pairs`: stiffness; both frictions; row of the box's body.
PAIR_STIFFNESS_COLUMN, PAIR_FRICTION_COLUMNS, BOX_BODY_ROW_COLUMN = 22, slice(24, 26), 27
#: Number of columns of `ShapePairs.compiled_pairs` and `ShapePairs.monitored_pairs`.
NUM_PAIR_COLUMNS, NUM_MONITORED_COLUMNS = 28, 40
_SLIP_SPEED_REGULARIZATION_M_S = 1e-14  # as in Drake: a point at rest has a direction


class ShapePairs(NamedTuple):
    """Pairs of a shape of the tool and a shape of the environment that may touch.

    Attributes:
        compiled_pairs: (k, 28), pairs of a tool sphere and a box: shapes, poses, contact law.
        monitored_pairs: (l, 40), bounding boxes of other pairs, whose contact Drake computes.
        monitoring_reason: why the first pair of `monitored_pairs` is not in `compiled_pairs`.
    """

    # Columns: 0-2 centre of the sphere in S [m], 3 its radius, 4-12 R_WBox by rows and 13-15 p_WBox
    # at rest (in the body instead of W if it is in the joint table), 16-18 half the box's edges,
    # 19-21 direction of the body's prismatic joint in W (zero without), 22 stiffness [N/m], 23
    # dissipation [s/m], 24 and 25 static and dynamic friction, 26 slip speed [m/s], 27 row in the
    # joint table, or -1. Monitored pairs: 0-2 centre, 28-36 R_SBox by rows and 37-39 half the edges
    # of the tool's box; 3 and 22-25 are zero.

    compiled_pairs: Array
    monitored_pairs: Array
    monitoring_reason: str


def FindContactPairs(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    tool: Mapping[GeometryId, RigidTransform],
    environment: Iterable[ModelInstanceIndex],
    slip_speed: float,
    row_bodies: Sequence[int] = (),
) -> ShapePairs:
    """Return the pairs of tool and environment shapes that no collision filter excludes.

    Args:
        tool: pose in S of the body that carries the shape, by shape of the tool.
        environment: model instances of the objects to touch.
        slip_speed: sliding speed above which friction is full [m/s].
        row_bodies: body index of each row of a joint table (`MakeJointTableAndRowBodies`).

    Raises:
        DrakeTeleopError: for an unbounded shape.
    """
    context = plant.CreateDefaultContext()
    compiled_pairs, monitored_pairs, monitoring_reason = list[Array](), list[Array](), ""
    touched = (body for instance in environment for body in plant.GetBodyIndices(instance))
    for body in map(plant.get_body, touched):
        row = row_bodies.index(int(body.index())) if int(body.index()) in row_bodies else -1
        X_Body = plant.EvalBodyPoseInWorld(context, body) if row < 0 else RigidTransform()
        # Only the leaf is not in the joint table.
        direction = _prismatic_joint_direction_W(plant, context, body) if row < 0 else np.zeros(3)
        for other in plant.GetCollisionGeometriesForBody(body):
            for own, X_SOwn in tool.items():
                has_contact = inspector.GetProximityProperties(other) is not None
                if not has_contact or inspector.CollisionFiltered(own, other):
                    continue
                X_Other = X_Body @ inspector.GetPoseInFrame(other)
                X_SShape = X_SOwn @ inspector.GetPoseInFrame(own)
                try:
                    sphere, edges = _require_sphere_and_box(inspector, own, other)
                    law = _stiffness_damping_and_frictions(inspector, own, other)
                    last = [direction, law, [slip_speed, row]]
                    place, half = [X_SShape.translation(), [sphere.radius()]], edges.size() / 2
                    compiled_pairs.append(_make_pair_row(place, X_Other, half, last))
                except DrakeTeleopError as beyond:
                    monitoring_reason = monitoring_reason or str(beyond)
                    own_box, box = _bounding_box(inspector, own), _bounding_box(inspector, other)
                    X_SBox, X_Other = X_SShape @ own_box.pose(), X_Other @ box.pose()
                    place = [X_SBox.translation(), [0.0]]
                    turned = [X_SBox.rotation().matrix().ravel(), own_box.half_width()]
                    last = [direction, [0.0] * 4, [slip_speed, row], *turned]
                    monitored_pairs.append(_make_pair_row(place, X_Other, box.half_width(), last))
    compiled = np.reshape(compiled_pairs, (len(compiled_pairs), NUM_PAIR_COLUMNS))
    monitored = np.reshape(monitored_pairs, (len(monitored_pairs), NUM_MONITORED_COLUMNS))
    return ShapePairs(compiled, monitored, monitoring_reason)


def _make_pair_row(
    tool_columns: list[Any], X_Box: RigidTransform, half_edges: Array, law_columns: list[Any]
) -> Array:
    pose = X_Box.rotation().matrix().ravel(), X_Box.translation()
    return np.concatenate([*tool_columns, *pose, half_edges, *law_columns])


def _bounding_box(inspector: SceneGraphInspector, shape: GeometryId) -> Obb:
    box = inspector.GetObbInGeometryFrame(shape)
    if box is None:
        kind = type(inspector.GetShape(shape)).__name__
        what = f"a {kind} is unbounded, so contact with it cannot be checked"
        remedy = "use a shape of finite size, such as a box"
        raise DrakeTeleopError(what, where=inspector.GetName(shape), remedy=remedy)
    return box


def _require_sphere_and_box(
    inspector: SceneGraphInspector, ball: GeometryId, box: GeometryId
) -> tuple[Sphere, Box]:
    sphere, edges = inspector.GetShape(ball), inspector.GetShape(box)
    if isinstance(sphere, Sphere) and isinstance(edges, Box):
        return sphere, edges
    pair = f"{type(sphere).__name__} on a {type(edges).__name__}"
    what = f"the compiled contact law supports spheres on boxes only, not a {pair}"
    remedy = "build the tool's tip of spheres and the environment of boxes"
    raise DrakeTeleopError(what, where=inspector.GetName(box), remedy=remedy)


def _prismatic_joint_direction_W(plant: MultibodyPlant, context: Context, body: RigidBody) -> Array:
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        if joint.child_body().index() == body.index() and isinstance(joint, PrismaticJoint):
            R_WF = joint.frame_on_parent().CalcPoseInWorld(context).rotation()
            return np.asarray(R_WF @ joint.translation_axis())
    return np.zeros(3)


def _stiffness_damping_and_frictions(
    inspector: SceneGraphInspector, ball: GeometryId, box: GeometryId
) -> list[float]:
    names = "point_contact_stiffness", "hunt_crossley_dissipation", "coulomb_friction"
    materials = [inspector.GetProximityProperties(shape) for shape in (ball, box)]
    for shape, material in zip((ball, box), materials, strict=True):
        if missing := [n for n in names[:2] if not material.HasProperty("material", n)]:
            what, remedy = f"has no drake:{missing[0]}", "add it to its drake:proximity_properties"
            raise DrakeTeleopError(what, where=inspector.GetName(shape), remedy=remedy)
    values = [[x.GetProperty("material", n) for x in materials] for n in names]
    (k_1, k_2), (d_1, d_2), frictions = values
    both = CalcContactFrictionFromSurfaceProperties(*frictions)
    d = (k_2 * d_1 + k_1 * d_2) / (k_1 + k_2)
    return [k_1 * k_2 / (k_1 + k_2), d, both.static_friction(), both.dynamic_friction()]


@njit(cache=True)
def depth_of_sphere_in_box(
    pair: Array, p_WS: Array, R_WS: Array, deflection: float, normal_and_point: Array
) -> float:
    """Return the depth of a sphere in a box [m], or any negative number if they do not touch.

    Args:
        pair: (28,) row of `ShapePairs.compiled_pairs`.
        p_WS, R_WS: pose of the sensor frame, to which the sphere is fixed.
        deflection: deflection of the sheet spring [m].
        normal_and_point: (6,) output for touching shapes, in W: outward normal, contact point [m].
    """
    radius = pair[3]
    # Centre of the sphere relative to the box, in W.
    w0 = p_WS[0] + R_WS[0, 0] * pair[0] + R_WS[0, 1] * pair[1] + R_WS[0, 2] * pair[2]
    w1 = p_WS[1] + R_WS[1, 0] * pair[0] + R_WS[1, 1] * pair[1] + R_WS[1, 2] * pair[2]
    w2 = p_WS[2] + R_WS[2, 0] * pair[0] + R_WS[2, 1] * pair[1] + R_WS[2, 2] * pair[2]
    w0 -= pair[13] + deflection * pair[19]
    w1 -= pair[14] + deflection * pair[20]
    w2 -= pair[15] + deflection * pair[21]
    R_WBox, w = matrix_at(pair, 4), (w0, w1, w2)
    d = apply_matrix(transposed(R_WBox), w)
    outside, deepest, face = 0.0, -np.inf, 0
    for i in range(3):
        beyond = abs(d[i]) - pair[16 + i]
        if beyond > radius:
            return -1.0
        if beyond > 0.0:
            outside += beyond * beyond
        if beyond > deepest:
            deepest, face = beyond, i
    distance = np.sqrt(outside) if outside > 0.0 else deepest
    if distance >= radius:
        return radius - distance
    # The normal in the box: from its nearest point, or through its nearest face.
    for i in range(3):
        normal_and_point[3 + i] = 0.0
        beyond = abs(d[i]) - pair[16 + i]
        if (outside > 0.0 and beyond > 0.0) or (outside == 0.0 and i == face):
            normal_and_point[3 + i] = np.copysign(beyond / distance if outside > 0.0 else 1.0, d[i])
    n_W = apply_matrix(R_WBox, vector_at(normal_and_point, 3))
    # Halfway between the sphere's deepest point and the box's surface.
    inwards = (radius + distance) / 2
    for i in range(3):
        normal_and_point[i] = n_W[i]
        origin = pair[13 + i] + deflection * pair[19 + i] + w[i]
        normal_and_point[3 + i] = origin - inwards * normal_and_point[i]
    return radius - distance


@njit(cache=True)
def lower_bound_of_box_distance(
    pair: Array, box: Array, p_WS: Array, R_WS: Array, deflection: float
) -> float:
    """Return a lower bound of the distance between two boxes [m], below 0 if they may touch.

    `pair` (40,) is a row of `ShapePairs.monitored_pairs`; `box` (28,) are its first columns with
    the environment's box at its present pose. p_WS, R_WS are the sensor's pose, `deflection` [m]
    that of the leaf. The bound is the largest gap of projections on edge directions.
    """
    R, between = matrix_as_tuple(R_WS), minus(vector_at(p_WS, 0), vector_at(box, 13))
    between = plus(between, apply_matrix(R, vector_at(pair, 0)))
    between = minus(between, scale_vector(deflection, vector_at(box, 19)))
    edges, halves, largest = np.empty((6, 3)), np.empty(6), -np.inf
    for i in range(3):
        k = NUM_PAIR_COLUMNS + i  # columns of R_SBox: directions of the edges
        edge = apply_matrix(R, (pair[k], pair[k + 3], pair[k + 6]))
        edges[i, 0], edges[i, 1], edges[i, 2] = edge
        edges[3 + i, 0], edges[3 + i, 1], edges[3 + i, 2] = box[4 + i], box[7 + i], box[10 + i]
        halves[i], halves[3 + i] = pair[NUM_PAIR_COLUMNS + 9 + i], box[16 + i]
    for i in range(6):
        axis = vector_at(edges[i], 0)
        gap = abs(dot(between, axis))
        for j in range(6):
            gap -= halves[j] * abs(dot(vector_at(edges[j], 0), axis))
        largest = max(largest, gap)
    return largest


@njit(cache=True)
def _stribeck_friction_coefficient(static: float, dynamic: float, slip_ratio: float) -> float:
    if slip_ratio < 1.0:
        return static * slip_ratio**3 * (10.0 + slip_ratio * (6.0 * slip_ratio - 15.0))
    if slip_ratio < 3.0:
        u = (slip_ratio - 1.0) / 2.0
        return static - (static - dynamic) * u**3 * (10.0 + u * (6.0 * u - 15.0))
    return dynamic


@njit(cache=True)
def point_contact_force_into(
    pair: Array, depth: float, normal: Array, velocity: Array, force: Array
) -> None:
    """Write the contact force on a sphere in a box into `force` (3,) [N], in W.

    `pair` is a row of `ShapePairs.compiled_pairs`, `depth` [m] the penetration; `normal` points out
    of the box. `velocity` [m/s] is that of the sphere at the contact, relative to the box.
    """
    out = dot(velocity, normal)
    f_n = max(pair[22] * depth * (1.0 - pair[23] * out), 0.0)
    speed = 0.0
    for i in range(3):
        force[i] = velocity[i] - out * normal[i]
        speed += force[i] * force[i]
    speed = np.sqrt(speed + _SLIP_SPEED_REGULARIZATION_M_S * _SLIP_SPEED_REGULARIZATION_M_S)
    mu = _stribeck_friction_coefficient(pair[24], pair[25], speed / pair[26])
    for i in range(3):
        force[i] = f_n * (normal[i] - mu * force[i] / speed)
