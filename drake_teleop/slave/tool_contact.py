"""What the environment exerts on the tool: contacts of balls with boxes, and what is applied."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop._compiled import njit
from drake_teleop.environment.point_contact import contact_force, indentation
from drake_teleop.lifetime import ONE_DICT, weak_callback
from drake_teleop.slave.arm import ArmModel, forward_kinematics, jacobian
from drake_teleop.vectors import add_into, cross, minus, plus, put, three


@njit(cache=True)
def environment_wrench(arm, pairs, applied_W, q, v, sheet, wrench_W):
    """What acts on the tool besides the sensor and gravity, about the world's origin, in W.

    Args:
        arm: `ArmModel.table`.
        pairs: (k, 27) of `ContactPairs`.
        applied_W: (6,) [f; tau] about So, in W, on top of the contacts [N, N m].
        q, v: (n,) of the arm.
        sheet: (2,) deflection and its rate [m, m/s], of what moves.
        wrench_W: (6,) filled [N, N m].
    """
    acts = pairs.shape[0] > 0
    for i in range(6):
        wrench_W[i] = applied_W[i]
        acts = acts or applied_W[i] != 0.0
    if not acts:
        return
    R_WS, p_WS, normal, force = np.empty((3, 3)), np.empty(3), np.empty(6), np.empty(3)
    twist, velocity, has_twist = np.empty(6), np.empty(3), False
    forward_kinematics(arm, q, R_WS, p_WS)
    add_into(wrench_W, 3, cross(p_WS, applied_W))
    for pair in pairs:
        depth = indentation(pair, p_WS, R_WS, sheet[0], normal)
        if depth <= 0.0:
            continue
        if not has_twist:
            J = np.empty((6, q.shape[0]))
            jacobian(arm, q, J)
            put(twist, 0, J @ v, 0, 6)
            has_twist = True
        lever = minus(three(normal, 3), p_WS)
        moving = plus(three(twist, 0), cross(three(twist, 3), lever))
        for i in range(3):
            velocity[i] = moving[i] - pair[19 + i] * sheet[1]
        contact_force(pair, depth, normal[:3], velocity, force)
        add_force(wrench_W, normal[3:], force)


@njit(cache=True)
def add_force(wrench_W, p_WC, force_W):
    """Adds a force (3,) at C [N] to a wrench (6,) about the world's origin, all in W."""
    add_into(wrench_W, 0, force_W)
    add_into(wrench_W, 3, cross(p_WC, force_W))


class ToolContact(LeafSystem):
    """The true contact wrench for the log; no controller sees it.

    .. pydrake_system::

        name: ToolContact
        input_ports:
        - slave_state: [q; v] of the arm
        - sheet_state: [z; v_z] of the sheet spring (only if there is one)
        output_ports:
        - true_contact_wrench_W: on the tool, [f; tau] about the world's origin, in W

    Args:
        arm: kinematics up to the tool.
        pairs: (k, 27) what may touch, see `ContactPairs`.
        moves: whether that is a sheet spring.
    """

    __slots__ = ONE_DICT

    def __init__(self, arm: ArmModel, pairs: NDArray[np.float64], *, moves: bool) -> None:
        super().__init__()
        self._n = arm.num_joints
        self._contact, self._at_rest = (arm.table, pairs, np.zeros(6)), np.zeros(2)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * arm.num_joints)
        self._sheet = self.DeclareVectorInputPort("sheet_state", 2) if moves else None
        self.DeclareVectorOutputPort("true_contact_wrench_W", 6, weak_callback(self._calc))

    def _calc(self, context: Context, output: BasicVector) -> None:
        state = self._state.Eval(context)
        environment_wrench(
            *self._contact,
            state[: self._n],
            state[self._n :],
            self._at_rest if self._sheet is None else self._sheet.Eval(context),
            output.get_mutable_value(),
        )
