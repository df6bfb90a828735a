"""The display of force on the master: J_M^T, gravity compensation, the device's limits."""

from __future__ import annotations

import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop._compiled import njit
from drake_teleop.lifetime import ONE_DICT, weak_callback
from drake_teleop.master.phantom import (
    FORCE_LIMIT,
    WRIST_TORQUE_LIMIT,
    gravity_torque_into,
    jacobian_into,
)


@njit(cache=True)
def limit_wrench_into(wrench, J, displayed):
    """Writes what the device can display of `wrench` (6,) [f; tau] at E, in B.

    The force is shortened to the peak force and the torque until no wrist motor is beyond its
    peak torque; both keep their directions. A wrench that is not finite gives zero.
    """
    for k in range(6):
        if not math.isfinite(wrench[k]):
            displayed[:] = 0.0
            return
    # hypot does not overflow, however large the command.
    force = math.hypot(math.hypot(wrench[0], wrench[1]), wrench[2])
    scale = 1.0 if force <= FORCE_LIMIT else FORCE_LIMIT / force
    for k in range(3):
        displayed[k] = scale * wrench[k]
    scale = 1.0
    for i in range(3):
        motor = abs(J[3, 3 + i] * wrench[3] + J[4, 3 + i] * wrench[4] + J[5, 3 + i] * wrench[5])
        if motor * scale > WRIST_TORQUE_LIMIT[i]:
            scale = WRIST_TORQUE_LIMIT[i] / motor
    for k in range(3, 6):
        displayed[k] = scale * wrench[k]


@njit(cache=True)
def motor_torque_into(wrench, state, J, displayed, torque):
    """Writes J_M^T F + gravity compensation (6,); `displayed` (6,) becomes F after the limits.

    `state` is [q; qdot]; if q is not finite everything is zero. `J` (6, 6) is scratch.
    """
    for k in range(6):
        if not math.isfinite(state[k]):
            displayed[:] = 0.0
            torque[:] = 0.0
            return
    jacobian_into(state, J)
    limit_wrench_into(wrench, J, displayed)
    gravity_torque_into(state, torque)
    for i in range(6):
        for k in range(6):
            torque[i] += J[k, i] * displayed[k]


class ForceDisplay(LeafSystem):
    """Turns the wrench that the hand shall feel into motor torques of the master.

    Safe state: a command that is not finite is displayed as zero force while the gravity
    compensation goes on; a state that is not finite switches the motors off.

    .. pydrake_system::

        name: ForceDisplay
        input_ports:
        - wrench_command: (6,) F_E_B, [f; tau] that the hand shall feel at E, in B [N, N m]
        - master_state: (12,) [q; qdot] of the device
        output_ports:
        - motor_torque: (6,) J_M^T F + gravity compensation [N m]
        - force_to_master: (6,) F, what is displayed within the device's limits [N, N m]
    """

    __slots__ = ONE_DICT

    def __init__(self) -> None:
        super().__init__()
        self._jacobian = np.zeros((6, 6))
        self._unused = np.zeros(6)
        self._command = self.DeclareVectorInputPort("wrench_command", 6)
        self._state = self.DeclareVectorInputPort("master_state", 12)
        inputs = {self.all_input_ports_ticket()}
        self.DeclareVectorOutputPort("motor_torque", 6, weak_callback(self._calc_torque), inputs)
        self.DeclareVectorOutputPort("force_to_master", 6, weak_callback(self._calc_force), inputs)

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        self._calc(context, self._unused, output.get_mutable_value())

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        self._calc(context, output.get_mutable_value(), self._unused)

    def _calc(self, context: Context, displayed: np.ndarray, torque: np.ndarray) -> None:
        command, state = self._command.Eval(context), self._state.Eval(context)
        motor_torque_into(command, state, self._jacobian, displayed, torque)
