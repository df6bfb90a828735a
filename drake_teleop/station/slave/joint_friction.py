"""Regularized Coulomb friction of the arm's joints, which Drake's joints do not have.

tau = -tau_C tanh(v / v_0),  v_0 = 2 mrad/s (2 mm/s for a prismatic joint)"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.blocks import ONE_DICT, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array

ARM_FRICTION_TANH_SPEED_RAD_OR_M_S = 2e-3
"""Speed v_0 of the friction law [rad/s, m/s], estimate."""


@njit(cache=True)
def dry_friction(coulomb: float, speed: float) -> float:
    """Return the friction torque [N m] at a speed [rad/s]; `coulomb` is its limit [N m]."""
    return -coulomb * np.tanh(speed / ARM_FRICTION_TANH_SPEED_RAD_OR_M_S)


@njit(cache=True)
def _friction_into(coulomb, index, state, force):
    n = coulomb.shape[0]
    force[:] = 0.0
    for i in range(n):
        force[index[i]] = dry_friction(coulomb[i], state[n + i])


class JointFriction(LeafSystem):
    """Block that applies the arm's dry friction as generalized force [N m] to the whole plant.

    `index` contains the joints' indices in the plant's velocities.
    """

    __slots__ = ONE_DICT

    def __init__(self, coulomb: Array, index: NDArray[np.intp], velocities: int) -> None:
        super().__init__()
        self._constants = coulomb, index
        self._state = self.DeclareVectorInputPort("slave_state", 2 * len(coulomb))
        calc, inputs = weak_callback(self._calc_friction_force), {self._state.ticket()}
        self.DeclareVectorOutputPort("generalized_force", velocities, calc, inputs)

    def _calc_friction_force(self, context: Context, output: BasicVector) -> None:
        _friction_into(*self._constants, self._state.Eval(context), output.get_mutable_value())
