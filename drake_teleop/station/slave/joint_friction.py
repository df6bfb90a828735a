"""Dry friction in the arm's joints: Coulomb's, regularised.

    tau = -tau_C tanh(v / v_0),  v_0 = 2 mrad/s, or mm/s where a joint slides

Gears, seals and brushes have it, and Drake's joints have none, whatever a model says. Below v_0 a
joint creeps instead of sticking, as all friction of a continuous plant does; half a metre from a
joint that is the 1 mm/s at which friction of the surroundings is complete. It takes energy only. No
controller is told of it: as with a real arm, it is an error of the model that their computed torque
goes by.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.lifetime import ONE_DICT, weak_callback

Array = NDArray[np.float64]

FRICTION_SPEED = 2e-3
"""v_0 [rad/s or m/s] (E)."""


@njit(cache=True)
def dry_friction(coulomb: float, speed: float) -> float:
    """The torque on a joint [N m] of friction `coulomb` [N m] at a speed [rad/s]."""
    return -coulomb * np.tanh(speed / FRICTION_SPEED)


@njit(cache=True)
def _friction_into(coulomb, index, state, force):
    """Writes `dry_friction` of joints (n,) in `state` [q; v] to their places in `force`."""
    n = coulomb.shape[0]
    force[:] = 0.0
    for i in range(n):
        force[index[i]] = dry_friction(coulomb[i], state[n + i])


def friction_of_joints(values: list[float], joints: tuple[str, ...]) -> Array:
    """(n,) of a list with a number for each joint, or one for all, or none [N m].

    Raises:
        DrakeTeleopError: for another number of numbers.
    """
    n = len(joints)
    if len(values) not in (0, 1, n):
        raise DrakeTeleopError(
            f"has {len(values)} numbers, the arm has {n} joints",
            where="slave.friction",
            remedy=f"give one for all, or {n}, for {', '.join(joints)}",
        )
    return np.broadcast_to(np.array(values or 0.0, np.float64), (n,)).copy()


class JointFriction(LeafSystem):
    """`dry_friction` of the arm as a force on the plant.

    .. pydrake_system::

        name: JointFriction
        input_ports:
        - slave_state: [q; v] of the arm [rad, rad/s]
        output_ports:
        - generalized_force: of the whole plant [N m]

    Args:
        coulomb: (n,) [N m].
        index: (n,) where the joints stand in the plant's velocities.
        velocities: how many the plant has.
    """

    __slots__ = ONE_DICT

    def __init__(self, coulomb: Array, index: NDArray[np.intp], velocities: int) -> None:
        super().__init__()
        self._numbers = coulomb, index
        self._state = self.DeclareVectorInputPort("slave_state", 2 * len(coulomb))
        self.DeclareVectorOutputPort(
            "generalized_force", velocities, weak_callback(self._calc), {self._state.ticket()}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        _friction_into(*self._numbers, self._state.Eval(context), output.get_mutable_value())


def AddJointFriction(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    instance: ModelInstanceIndex,
    coulomb: Array,
    index: NDArray[np.intp],
) -> None:
    """Adds "joint_friction" and connects it to the plant, whose arm is `instance`."""
    friction = builder.AddNamedSystem(
        "joint_friction", JointFriction(coulomb, index, plant.num_velocities())
    )
    state = plant.get_state_output_port(instance)
    builder.Connect(state, friction.GetInputPort("slave_state"))
    force = plant.get_applied_generalized_force_input_port()
    builder.Connect(friction.GetOutputPort("generalized_force"), force)
