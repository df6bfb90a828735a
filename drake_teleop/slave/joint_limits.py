"""The monitor of joint limits: continuous plants do not enforce them, so somebody must watch."""

from __future__ import annotations

from pydrake.systems.framework import Context, EventStatus, LeafSystem

from drake_teleop.slave.arm import ArmModel


class JointLimitMonitor(LeafSystem):
    """Ends the simulation with a clear message when a joint of the slave leaves its range.

    .. pydrake_system::

        name: JointLimitMonitor
        input_ports:
        - slave_state: [q; v] of the arm [rad, rad/s]
    """

    def __init__(self, arm: ArmModel, period: float) -> None:
        super().__init__()
        self._arm = arm
        self._state = self.DeclareVectorInputPort("slave_state", 2 * arm.num_joints)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._watch)

    def _watch(self, context: Context) -> EventStatus:
        q = self._state.Eval(context)[: self._arm.num_joints]
        # A comparison with NaN is false, so a lost joint is outside too.
        inside = (q >= self._arm.lower) & (q <= self._arm.upper)
        if inside.all():
            return EventStatus.DidNothing()
        joint = int(inside.argmin())
        return EventStatus.Failed(
            self,
            f"joint {joint + 1} of the slave left its range at {context.get_time():.3f} s: "
            f"{q[joint]:.3f} rad is outside {self._arm.lower[joint]:.3f} to "
            f"{self._arm.upper[joint]:.3f} rad",
        )
