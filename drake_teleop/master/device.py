"""The haptic device as a block: the dynamics of `phantom`, one step a period."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_teleop._compiled import njit
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.fault import sound
from drake_teleop.fields import settings
from drake_teleop.lifetime import ONE_DICT
from drake_teleop.master.force_display import initial_display
from drake_teleop.master.phantom import (
    FRICTION_SPEED,
    HOME,
    check_limits,
    forward_kinematics,
    mass_matrix,
    pose_into,
    step,
    twist_into,
)
from drake_teleop.quantities import quantity
from drake_teleop.vectors import put

_LARGEST_PERIOD = 1e-3  # s, slower than any haptic device
# The Runge-Kutta step is stable up to 2.8 for (friction's slope / inertia) * period.
_LARGEST_FRICTION_STEP = 2.0


@settings
@dataclass
class JointFriction:
    """Friction of the six joints: coulomb * tanh(velocity / 0.01 rad/s) + viscous * velocity."""

    coulomb: list[float] = quantity(
        [0.01, 0.01, 0.01, 0.001, 0.001, 0.001], "N m", 0.0, 1.0, "main axes P, wrist E"
    )
    viscous: list[float] = quantity(
        [5e-4, 5e-4, 5e-4, 5e-5, 5e-5, 5e-5], "N m s/rad", 0.0, 10.0, "main axes P, wrist E"
    )


@njit(cache=True)
def _advance(state, pose, twist, display, hand_wrench, drive, parameters, period, work, stages):
    """`step`, and the pose and twist that follow: one call of compiled code instead of three.

    What the display remembers (`display`, `drive[6:]`) is kept for it, beside the angles. A device
    that is pushed by what is no force stays where it is.
    """
    put(display, 6, drive, 6, drive.shape[0] - 6)
    if sound(hand_wrench) and sound(drive[:6]):
        step(state, hand_wrench, drive[:6], parameters, period, work, stages)
        pose_into(state[:6], pose)
        twist_into(state[:6], state[6:], work[0], twist)
    put(display, 0, state, 0, 6)


def _check_friction(friction: JointFriction, M: NDArray[np.float64], period: float) -> None:
    slope = np.array(friction.coulomb) / FRICTION_SPEED + np.array(friction.viscous)
    rate = float(np.max(np.linalg.eigvals(np.linalg.solve(M, np.diag(slope))).real))
    if rate * period > _LARGEST_FRICTION_STEP:
        raise DrakeTeleopError(
            f"the joints' friction stops the device within {1e3 / rate:.2g} ms, too fast for a "
            f"period of {1e3 * period:g} ms",
            where="master.friction",
            remedy="choose less friction (N m, N m s/rad) or a higher hand rate",
        )


class MasterDevice(LeafSystem):
    """The device and the passive mass of the hand on it, advanced once a period.

    The full nonlinear dynamics (gravity, Coriolis, friction, end stops) take one classical
    Runge-Kutta step a period while the inputs are held. A joint at its limit runs into a stiff,
    damped end stop.

    .. pydrake_system::

        name: MasterDevice
        input_ports:
        - hand_wrench_E: (6,) F_E_B, [f; tau] of the hand on the stylus at E, in B [N, N m]
        - drive: from the force display: torque at the joints (6) [N m], what it remembers
        output_ports:
        - state: (12,) [q; qdot] [rad, rad/s]
        - pose_master: (7,) X_BE
        - twist_master: (6,) [v; omega] of E in B [m/s, rad/s]
        - for_display: the angles (6) [rad], and what the force display remembers

    Args:
        period: [s], at most 1 ms.
        hand_mass: mass of the hand that moves with the stylus [kg]; its weight is carried by the
            operator.
        hand_inertia: its rotational inertia about every axis through E [kg m^2].
        q_initial: (6,) joint angles at the start [rad], at rest.
        friction: joint friction.

    Raises:
        DrakeTeleopError: if the period is too long, for the device or for its friction, or the
            start is beyond a joint's limit.
    """

    __slots__ = ONE_DICT

    def __init__(
        self,
        period: float,
        *,
        hand_mass: float,
        hand_inertia: float,
        q_initial: NDArray[np.float64] = HOME,
        friction: JointFriction | None = None,
    ) -> None:
        super().__init__()
        if not 0 < period <= _LARGEST_PERIOD:
            raise DrakeTeleopError(
                f"a period of {period:g} s is too long for the haptic device",
                where="master.period",
                remedy=f"choose at most {_LARGEST_PERIOD:g} s (1 kHz); the paper uses above 2 kHz",
            )
        check_limits(q_initial)
        friction = friction or JointFriction()
        _check_friction(friction, mass_matrix(q_initial, hand_mass, hand_inertia), period)
        self._period = period
        self._parameters = np.array(
            [hand_mass, hand_inertia, *friction.coulomb, *friction.viscous], dtype=float
        )
        self._work = np.zeros((2, 6, 6))
        self._stages = np.zeros((3, 12))
        self._hand_wrench = self.DeclareVectorInputPort("hand_wrench_E", 6)
        # A port of its own for what the display remembers would be a call of its own.
        display = initial_display(q_initial)
        self._drive = self.DeclareVectorInputPort("drive", len(display))
        # Pose and twist are kept beside the state: they are read more often than they change.
        state = np.concatenate([q_initial, np.zeros(6)])
        for name, start in (
            ("state", state),
            ("pose_master", forward_kinematics(q_initial)),
            ("twist_master", np.zeros(6)),
            ("for_display", display),
        ):
            self.DeclareStateOutputPort(name, self.DeclareDiscreteState(start))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        _advance(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            discrete_state.get_mutable_value(2),
            discrete_state.get_mutable_value(3),
            self._hand_wrench.Eval(context),
            self._drive.Eval(context),
            self._parameters,
            self._period,
            self._work,
            self._stages,
        )
