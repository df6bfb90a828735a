"""Compiled forward kinematics of moving bodies, for contact forces between plant steps.

From parent P (joint frame F) to child B (joint frame M): X_WB = X_WP X_PF X_FM(q) X_MB.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import cos, sin

import numpy as np
from pydrake.multibody import tree
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import (
    conjugate_quaternion,
    cross,
    normalized_quaternion,
    plus,
    quaternion_at,
    quaternion_product,
    rotate_vector,
    scale_vector,
    vector_at,
)

_FIXED_JOINT, _REVOLUTE_JOINT, _PRISMATIC_JOINT, _FREE_JOINT = range(4)
_PARENT_ROW_COLUMN, _JOINT_TYPE_COLUMN, _POSITION_INDEX_COLUMN, _VELOCITY_INDEX_COLUMN = range(4)
_AXIS_COLUMN, _X_PF_COLUMN, _X_MB_COLUMN = 4, 7, 14
NUM_JOINT_TABLE_COLUMNS = 21
#: Numbers of a body: q_WB (4), p_WB (3), omega_WB_W (3), v_WB_W (3).
BODY_STATE_SIZE = 13


def MakeJointTableAndRowBodies(
    plant: MultibodyPlant, bodies: Iterable[tree.BodyIndex]
) -> tuple[Array, list[int]]:
    """Return a table (m, 21) of m joints from world to `bodies`, and each row's child body."""
    # Parents first. Columns: 0 row of the parent, -1 if it is anchored; 1 type of joint; 2 and 3
    # first index of positions and velocities in the state [q; v]; 4-6 axis; 7-13 X_PF (X_WF for an
    # anchored parent) and 14-20 X_MB, a quaternion and a position each.
    # Indices instead of joints: a stored joint and its plant would keep each other alive.
    above, anchored, order = dict[int, tuple[int, int]](), set[int](), list[int]()
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        child, parent = int(joint.child_body().index()), int(joint.parent_body().index())
        above[child] = int(index), parent
        if plant.IsAnchored(joint.parent_body()):
            anchored.add(parent)
    for body in bodies:
        chain, number = [], int(body)
        while number not in order and number not in anchored:
            chain.append(number)
            number = above[number][1]
        order += reversed(chain)
    context, rows = plant.CreateDefaultContext(), []
    for number in order:
        index, parent = above[number]
        row = order.index(parent) if parent in order else -1
        rows.append(_table_row(plant, context, plant.get_joint(tree.JointIndex(index)), row))
    return np.array(rows).reshape(len(rows), NUM_JOINT_TABLE_COLUMNS), order


def _table_row(plant: MultibodyPlant, context: Context, joint: tree.Joint, parent: int) -> Array:
    F = joint.frame_on_parent()
    X_PF = F.CalcPoseInWorld(context) if parent < 0 else F.GetFixedPoseInBodyFrame()
    X_MB = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
    kind, axis = _FIXED_JOINT, np.zeros(3)
    if isinstance(joint, tree.RevoluteJoint):
        kind, axis = _REVOLUTE_JOINT, joint.revolute_axis()
    elif isinstance(joint, tree.PrismaticJoint):
        kind, axis = _PRISMATIC_JOINT, joint.translation_axis()
    elif isinstance(joint, tree.QuaternionFloatingJoint):
        kind = _FREE_JOINT
    places = joint.position_start(), plant.num_positions() + joint.velocity_start()
    poses = [[*X.rotation().ToQuaternion().wxyz(), *X.translation()] for X in (X_PF, X_MB)]
    return np.array([parent, kind, *places, *axis, *poses[0], *poses[1]])


@njit(cache=True)
def poses_and_twists_into(joints, state, out):
    """Write pose and twist of m bodies at the plant's state [q; v] into `out` (m, 13).

    A row is [q_WB (4), p_WB (3), omega_WB_W (3), v_WB_W (3)]; `joints` (m, 21) is the table of
    `MakeJointTableAndRowBodies`.
    """
    still = (0.0, 0.0, 0.0)
    for k, row in enumerate(joints):
        turn, place, spin, speed = (1.0, 0.0, 0.0, 0.0), still, still, still
        if row[_PARENT_ROW_COLUMN] >= 0.0:
            above = out[int(row[_PARENT_ROW_COLUMN])]
            turn, place = quaternion_at(above, 0), vector_at(above, 4)
            spin, speed = vector_at(above, 7), vector_at(above, 10)
        # From parent to F.
        lever = rotate_vector(turn, vector_at(row, _X_PF_COLUMN + 4))
        place, speed = plus(place, lever), plus(speed, cross(spin, lever))
        turn = quaternion_product(turn, quaternion_at(row, _X_PF_COLUMN))
        # From F to M.
        q, v = int(row[_POSITION_INDEX_COLUMN]), int(row[_VELOCITY_INDEX_COLUMN])
        kind, axis = row[_JOINT_TYPE_COLUMN], vector_at(row, _AXIS_COLUMN)
        if kind == _REVOLUTE_JOINT:
            spin = plus(spin, scale_vector(state[v], rotate_vector(turn, axis)))
            half = 0.5 * state[q]
            x, y, z = scale_vector(sin(half), axis)
            turn = quaternion_product(turn, (cos(half), x, y, z))
        elif kind == _PRISMATIC_JOINT:
            axis = rotate_vector(turn, axis)
            lever = scale_vector(state[q], axis)
            place = plus(place, lever)
            speed = plus(plus(speed, cross(spin, lever)), scale_vector(state[v], axis))
        elif kind == _FREE_JOINT:
            lever = rotate_vector(turn, vector_at(state, q + 4))
            place, speed = plus(place, lever), plus(speed, cross(spin, lever))
            speed = plus(speed, rotate_vector(turn, vector_at(state, v + 3)))
            spin = plus(spin, rotate_vector(turn, vector_at(state, v)))
            turn = quaternion_product(turn, normalized_quaternion(quaternion_at(state, q)))
        # From M to B.
        lever = rotate_vector(turn, vector_at(row, _X_MB_COLUMN + 4))
        place, speed = plus(place, lever), plus(speed, cross(spin, lever))
        turn = quaternion_product(turn, quaternion_at(row, _X_MB_COLUMN))
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = turn
        out[k, 4], out[k, 5], out[k, 6] = place
        out[k, 7], out[k, 8], out[k, 9] = spin
        out[k, 10], out[k, 11], out[k, 12] = speed


@njit(cache=True)
def _hermite_value_and_rate(h, u, a, a_dot, b, b_dot):
    d = b - a
    c2, c3 = 3.0 * d - h * (2.0 * a_dot + b_dot), h * (a_dot + b_dot) - 2.0 * d
    value = a + u * (h * a_dot + u * (c2 + u * c3))
    return value, a_dot + u * (2.0 * c2 + 3.0 * u * c3) / h


@njit(cache=True)
def _quaternion_derivative(omega, q):
    return quaternion_product((0.0, 0.5 * omega[0], 0.5 * omega[1], 0.5 * omega[2]), q)


@njit(cache=True)
def interpolate_joint_state(joints, h, u, start, end, out):
    """Write the state [q; v] at the fraction u (0 to 1) of a step of h [s] into `out`.

    Hermite cubics connect the plant's states `start` and `end` of the step; `joints` (m, 21) is
    the table of `MakeJointTableAndRowBodies`.
    """
    for row in joints:
        q, v = int(row[_POSITION_INDEX_COLUMN]), int(row[_VELOCITY_INDEX_COLUMN])
        kind = row[_JOINT_TYPE_COLUMN]
        if kind in (_REVOLUTE_JOINT, _PRISMATIC_JOINT):
            out[q], out[v] = _hermite_value_and_rate(h, u, start[q], start[v], end[q], end[v])
        elif kind == _FREE_JOINT:
            for i, j in ((q + 4, v + 3), (q + 5, v + 4), (q + 6, v + 5)):
                out[i], out[j] = _hermite_value_and_rate(h, u, start[i], start[j], end[i], end[j])
            a, b = quaternion_at(start, q), quaternion_at(end, q)
            a_dot = _quaternion_derivative(vector_at(start, v), a)
            b_dot = _quaternion_derivative(vector_at(end, v), b)
            w, w_dot = _hermite_value_and_rate(h, u, a[0], a_dot[0], b[0], b_dot[0])
            x, x_dot = _hermite_value_and_rate(h, u, a[1], a_dot[1], b[1], b_dot[1])
            y, y_dot = _hermite_value_and_rate(h, u, a[2], a_dot[2], b[2], b_dot[2])
            z, z_dot = _hermite_value_and_rate(h, u, a[3], a_dot[3], b[3], b_dot[3])
            out[q], out[q + 1], out[q + 2], out[q + 3] = w, x, y, z
            inverse = conjugate_quaternion((w, x, y, z))
            spin = quaternion_product((w_dot, x_dot, y_dot, z_dot), inverse)
            scale = 2.0 / (w * w + x * x + y * y + z * z)
            out[v], out[v + 1], out[v + 2] = scale * spin[1], scale * spin[2], scale * spin[3]
