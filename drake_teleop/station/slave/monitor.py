"""Monitor of joint limits and inverse kinematics."""

from __future__ import annotations

from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.lifetime import ONE_DICT
from drake_teleop.station.slave.arm import SLIDES, ArmModel

# Tolerance as a share of the range: a joint commanded to its limit overshoots slightly, and the
# mechanical stops of commercial arms are farther out.
_RANGE_TOLERANCE = 0.01


class SlaveMonitor(LeafSystem):
    """Periodic check that joints stay within their range plus 1 % of it.

    .. pydrake_system::

        name: SlaveMonitor
        input_ports:
        - slave_state: [q; v] of the arm [rad, rad/s]
        - ik_status: of the inverse kinematics (optional)
        output_ports:
        - ik_status: last value, for the log

    Raises:
        DrakeTeleopError: from the simulation, when a joint is outside or not finite.
    """

    __slots__ = ONE_DICT

    def __init__(self, arm: ArmModel, period: float) -> None:
        super().__init__()
        self._arm = arm
        tolerance = _RANGE_TOLERANCE * (arm.upper - arm.lower)
        self._lower, self._upper = arm.lower - tolerance, arm.upper + tolerance
        self._state = self.DeclareVectorInputPort("slave_state", 2 * arm.num_joints)
        self._status = self.DeclareVectorInputPort("ik_status", 1)
        self.DeclareStateOutputPort("ik_status", self.DeclareDiscreteState(1))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._check)

    def _check(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self._status.HasValue(context):
            discrete_state.set_value(0, self._status.Eval(context))
        q = self._state.Eval(context)[: self._arm.num_joints]
        # A comparison with NaN is false, so NaN counts as outside.
        inside = (q >= self._lower) & (q <= self._upper)
        if inside.all():
            return
        joint = int(inside.argmin())
        unit = "m" if self._arm.table[joint, SLIDES] else "rad"
        # Returning EventStatus.Failed crashes for systems written in Python.
        raise DrakeTeleopError(
            f"joint {joint + 1} of the slave left its range at {context.get_time():.3f} s: "
            f"{q[joint]:.3f} {unit} is outside {self._arm.lower[joint]:.3f} to "
            f"{self._arm.upper[joint]:.3f} {unit}",
            where="simulation",
            remedy="ask for a smaller or slower motion, start elsewhere (slave.position or home)"
            ", or speed joints up no faster than they can (joint_control.servo: position)",
        )
