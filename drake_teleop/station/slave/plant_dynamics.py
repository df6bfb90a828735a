"""Dynamics of arm, leaf and contact in a time step: compiled, or with Drake's contact results.

The state x is [q, leaf deflection, v, leaf speed], then the plant's [q; v] if other bodies move.
The compiled contact law covers spheres on boxes; Drake's law covers all shapes and contact models.
"""

from __future__ import annotations

from collections.abc import Container

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import (
    add_vector_into,
    copy_into,
    cross,
    minus,
    plus,
    rotate_vector,
    vector_at,
)
from drake_teleop.station.environment.environment import Environment
from drake_teleop.station.environment.moving_bodies import BODY_STATE_SIZE, poses_and_twists_into
from drake_teleop.station.environment.point_contact import (
    BOX_BODY_ROW_COLUMN,
    NUM_PAIR_COLUMNS,
    depth_of_sphere_in_box,
    lower_bound_of_box_distance,
    point_contact_force_into,
)
from drake_teleop.station.slave.arm import ArmModel, forward_dynamics, forward_kinematics, jacobian
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.slave.surroundings import ToolContactModel

#: Proximity of the tool: no contact, contact by the compiled law, other contact possible.
PROXIMITY_FAR, PROXIMITY_TOUCHING, PROXIMITY_NEAR_MONITORED = range(3)
_MAX_DISTANCE_OF_NEAR_PAIRS_M = 0.02  # m, larger than any motion between two checks
_MAX_TOUCHING_GAP_M = 1e-9  # m


@njit(cache=True)
def environment_wrench_about_Wo_into(arm, pairs, joints, applied_W, q, v, sheet, state, wrench_W):
    """Write the environment's wrench (6,) on the tool, about the world's origin, in W [N, N m].

    Args:
        arm: `ArmModel.table`.
        pairs: (k, 28) pairs of shapes, `ShapePairs.compiled_pairs`.
        joints: (m, 21) joints of moving bodies, from `MakeJointTableAndRowBodies`.
        applied_W: (6,) further wrench [f; tau], about So, in W [N, N m].
        sheet: (2,) deflection of the sheet spring's leaf, and its rate [m, m/s].
        state: the plant's [q; v], unused without joints.
    """
    has_wrench = pairs.shape[0] > 0
    for i in range(6):
        wrench_W[i] = applied_W[i]
        has_wrench = has_wrench or applied_W[i] != 0.0
    if not has_wrench:
        return
    R_WS, p_WS, normal, force = np.empty((3, 3)), np.empty(3), np.empty(6), np.empty(3)
    twist, velocity, has_twist = np.empty(6), np.empty(3), False
    bodies, placed = np.empty((joints.shape[0], BODY_STATE_SIZE)), np.empty(NUM_PAIR_COLUMNS)
    poses_and_twists_into(joints, state, bodies)
    forward_kinematics(arm, q, R_WS, p_WS)
    add_vector_into(wrench_W, 3, cross(p_WS, applied_W))
    for pair in pairs:
        box = _move_box_with_body(pair, bodies, placed)
        depth = depth_of_sphere_in_box(box, p_WS, R_WS, sheet[0], normal)
        if depth <= 0.0:
            continue
        if not has_twist:
            J = np.empty((6, q.shape[0]))
            jacobian(arm, q, J)
            copy_into(twist, 0, J @ v, 0, 6)
            has_twist = True
        lever = minus(vector_at(normal, 3), p_WS)
        point_velocity = plus(vector_at(twist, 0), cross(vector_at(twist, 3), lever))
        for i in range(3):
            velocity[i] = point_velocity[i] - pair[19 + i] * sheet[1]
        if pair[BOX_BODY_ROW_COLUMN] >= 0.0:
            body = bodies[int(pair[BOX_BODY_ROW_COLUMN])]
            lever = minus(vector_at(normal, 3), vector_at(body, 4))
            point_velocity = plus(vector_at(body, 10), cross(vector_at(body, 7), lever))
            for i in range(3):
                velocity[i] -= point_velocity[i]
        point_contact_force_into(pair, depth, normal[:3], velocity, force)
        add_force_to_wrench(wrench_W, normal[3:], force)


@njit(cache=True)
def _move_box_with_body(pair, bodies, placed):
    """Return the pair (28,) with its box at the present pose in W; `placed` is scratch memory."""
    if pair[BOX_BODY_ROW_COLUMN] < 0.0:
        return pair
    body = bodies[int(pair[BOX_BODY_ROW_COLUMN])]
    copy_into(placed, 0, pair, 0, NUM_PAIR_COLUMNS)
    turn = (body[0], body[1], body[2], body[3])
    for i in range(3):
        column = rotate_vector(turn, (pair[4 + i], pair[7 + i], pair[10 + i]))
        placed[4 + i], placed[7 + i], placed[10 + i] = column
    centre = rotate_vector(turn, vector_at(pair, 13))
    placed[13], placed[14], placed[15] = plus(vector_at(body, 4), centre)
    return placed


@njit(cache=True)
def classify_tool_proximity(arm, pairs, monitored_pairs, joints, q, sheet, state):
    """Return PROXIMITY_NEAR_MONITORED if a pair of `monitored_pairs` may be closer than 2 cm.

    Otherwise return PROXIMITY_TOUCHING if one of `pairs` touches, else PROXIMITY_FAR.
    """
    R_WS, p_WS, normal = np.empty((3, 3)), np.empty(3), np.empty(6)
    bodies, placed = np.empty((joints.shape[0], BODY_STATE_SIZE)), np.empty(NUM_PAIR_COLUMNS)
    poses_and_twists_into(joints, state, bodies)
    forward_kinematics(arm, q, R_WS, p_WS)
    for pair in monitored_pairs:
        box = _move_box_with_body(pair, bodies, placed)
        distance = lower_bound_of_box_distance(pair, box, p_WS, R_WS, sheet[0])
        if distance < _MAX_DISTANCE_OF_NEAR_PAIRS_M:
            return PROXIMITY_NEAR_MONITORED
    for pair in pairs:
        box = _move_box_with_body(pair, bodies, placed)
        if depth_of_sphere_in_box(box, p_WS, R_WS, sheet[0], normal) > -_MAX_TOUCHING_GAP_M:
            return PROXIMITY_TOUCHING
    return PROXIMITY_FAR


@njit(cache=True)
def add_force_to_wrench(wrench_W, p_WC, force_W):
    """Add a force (3,) at the point C to a wrench (6,) about the world's origin, in W."""
    add_vector_into(wrench_W, 0, force_W)
    add_vector_into(wrench_W, 3, cross(p_WC, force_W))


class ToolContact(LeafSystem):
    """Block that outputs the environment's wrench (6,) on the tool about the world's origin.

    Ports sheet_state [z; v_z] and plant_state [q; v] exist with a leaf or other moving bodies.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, arm: ArmModel, contact: ToolContactModel) -> None:
        super().__init__()
        n = self._n = arm.num_joints
        self._contact = arm.table, contact.compiled_pairs, contact.joint_table, np.zeros(6)
        self._nothing = np.zeros(2)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        self._sheet = self._plant = None
        if contact.leaf_instance is not None:
            self._sheet = self.DeclareVectorInputPort("sheet_state", 2)
        if contact.plant_state_size:
            self._plant = self.DeclareVectorInputPort("plant_state", contact.plant_state_size)
        self.DeclareVectorOutputPort("true_contact_wrench_W", 6, weak_callback(self._calc_wrench))

    def _calc_wrench(self, context: Context, output: BasicVector) -> None:
        state = self._state.Eval(context)
        q, v = state[: self._n], state[self._n :]
        sheet = self._nothing if self._sheet is None else self._sheet.Eval(context)
        plant = self._nothing if self._plant is None else self._plant.Eval(context)
        wrench_W = output.get_mutable_value()
        environment_wrench_about_Wo_into(*self._contact, q, v, sheet, plant, wrench_W)


@njit(cache=True)
def assemble_plant_state_into(state, surroundings, x):
    """Write x from `state` [q; v] and `surroundings` [leaf deflection, its rate, plant's q; v]."""
    n = state.shape[0] // 2
    copy_into(x, 0, state, 0, n)
    copy_into(x, n + 1, state, n, n)
    x[n], x[2 * n + 1] = surroundings[0], surroundings[1]
    copy_into(x, 2 * n + 2, surroundings, 2, surroundings.shape[0] - 2)


@njit(cache=True)
def contact_and_plant_rates_into(physics, x, tau, applied_W, wrench_W, xdot):
    """Write xdot (2 n + 2,), the state derivative of arm and leaf, and the contact wrench about Wo.

    `physics` is `SlavePlant.compiled_constants`, `tau` (n,) the motor torques [N m], `applied_W`
    (6,) a further wrench about So.
    """
    arm, _, pairs, _, joints, recorded = physics
    half = tau.shape[0] + 1
    q, v = x[: half - 1], x[half : 2 * half - 1]
    sheet, rest = x[half - 1 : 2 * half : half], x[2 * half :]
    if not _replay_or_request_wrench(recorded, x, wrench_W):
        environment_wrench_about_Wo_into(arm, pairs, joints, applied_W, q, v, sheet, rest, wrench_W)
    else:
        added, none = np.empty(6), pairs[:0]
        environment_wrench_about_Wo_into(arm, none, joints, applied_W, q, v, sheet, rest, added)
        wrench_W += added
    plant_rates_under_wrench_into(physics, x, tau, applied_W, wrench_W, xdot)


@njit(cache=True)
def _replay_or_request_wrench(recorded, x, wrench_W):
    """Copy the next recorded wrench to `wrench_W`; return False if it is not recorded.

    The caller appends a wrench and repeats its step until none is missing. Row 0 of `recorded`:
    numbers of wrenches and calls, x of the first call without wrench; other rows: wrenches (6,).
    """
    if recorded.shape[0] == 0:
        return False
    number = int(recorded[0, 1])
    recorded[0, 1] += 1.0
    if number < recorded[0, 0]:
        copy_into(wrench_W, 0, recorded[1 + number], 0, 6)
        return True
    if number == recorded[0, 0]:
        copy_into(recorded[0], 2, x, 0, x.shape[0])
    return False


@njit(cache=True)
def plant_rates_under_wrench_into(physics, x, tau, applied_W, wrench_W, xdot):
    """Write xdot of `contact_and_plant_rates_into` for the contact wrench `wrench_W` (6,)."""
    arm, _, pairs, leaf, _, _ = physics
    half = tau.shape[0] + 1
    q, v = x[: half - 1], x[half : 2 * half - 1]
    forward_dynamics(arm, q, v, tau, wrench_W, xdot[half:-1])
    copy_into(xdot, 0, x, half, half)
    push = 0.0
    if pairs.shape[0] > 0:  # all belong to the leaf, or none does
        for i in range(3):
            push -= pairs[0, 19 + i] * (wrench_W[i] - applied_W[i])
    xdot[-1] = (push - leaf[1] * x[half - 1] - leaf[2] * x[2 * half - 1]) / leaf[0] + leaf[3]


def contact_wrench_W(
    results: ContactResults, bodies: Container[int], shapes: Container[int]
) -> Array:
    """Return the wrench (6,) of all contacts on the tool, about the world's origin, in W [N, N m].

    `bodies`: indices of the tool's bodies; `shapes`: identifiers of its collision shapes.
    """
    wrench_W = np.zeros(6)
    for k in range(results.num_point_pair_contacts()):
        contact = results.point_pair_contact_info(k)
        if int(contact.bodyB_index()) in bodies:  # the contact force acts on B
            add_force_to_wrench(wrench_W, contact.contact_point(), contact.contact_force())
        elif int(contact.bodyA_index()) in bodies:
            add_force_to_wrench(wrench_W, contact.contact_point(), -contact.contact_force())
    for k in range(results.num_hydroelastic_contacts()):
        area = results.hydroelastic_contact_info(k)
        surface, F_Ac_W = area.contact_surface(), area.F_Ac_W()  # acts on the body of M
        first, second = surface.id_M().get_value(), surface.id_N().get_value()
        sign = float(first in shapes) - float(second in shapes)
        if sign != 0.0:
            add_force_to_wrench(wrench_W, surface.centroid(), sign * F_Ac_W.translational())
            wrench_W[3:] += sign * F_Ac_W.rotational()
    return wrench_W


class DrakeContact(LeafSystem):
    """Block that outputs `contact_wrench_W` (6,) on the tool from the plant's contact results."""

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, bodies: Container[int], shapes: Container[int]) -> None:
        super().__init__()
        self._tool_ids = bodies, shapes
        results = Value[ContactResults]()
        self._contacts = self.DeclareAbstractInputPort("contact_results", results)
        self.DeclareVectorOutputPort("true_contact_wrench_W", 6, weak_callback(self._calc_wrench))

    def _calc_wrench(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(contact_wrench_W(self._contacts.Eval(context), *self._tool_ids))


class ContactPlantCopy:
    """Copy of the slave's plant that computes contact at any state."""

    def __init__(self, config: Slave, environment: Environment | None, q_start: Array) -> None:
        builder = DiagramBuilder()
        self._slave = AddSlavePlant(builder, config, environment, q_start)
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = self._slave.plant.GetMyMutableContextFromRoot(self._root)

    def wrench_W(self, x: Array, state: Array) -> Array:
        """Return the contact wrench (6,) on the tool, about the world's origin, in W.

        x is [q, leaf deflection, v, deflection rate]; `state` is the plant's [q; v], empty without
        other moving bodies.
        """
        plant, context, contact = self._slave.plant, self._context, self._slave.contact
        half = len(x) // 2
        if len(state):
            plant.SetPositionsAndVelocities(context, state)
        leaf = contact.leaf_instance, slice(half - 1, half)
        for instance, own in ((self._slave.instance, slice(half - 1)), leaf):
            if instance is not None:
                plant.SetPositions(context, instance, x[:half][own])
                plant.SetVelocities(context, instance, x[half:][own])
        results = plant.get_contact_results_output_port().Eval(context)
        return contact_wrench_W(results, contact.tool_bodies, contact.tool_shapes)
