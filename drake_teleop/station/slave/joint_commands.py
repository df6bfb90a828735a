"""Sources of joint commands, and the monitor of joint limits and inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, are_valid_port_values, weak_callback
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.registry import Registry
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.slave.arm import IS_PRISMATIC_COLUMN, ArmModel
from drake_teleop.station.slave.inverse_kinematics import (
    IkStatus,
    InverseKinematics,
    has_closed_form,
)
from drake_teleop.station.slave.numeric_inverse_kinematics import NumericInverseKinematics

AUTOMATIC_IK_METHOD = "automatic"
"""Name that selects the closed form where it exists, otherwise the numeric method."""

IK_METHODS: Registry[Callable[[ArmModel, Array, float], LeafSystem]] = Registry(
    "inverse kinematics",
    {
        "closed_form": lambda arm, q_start, period: InverseKinematics(arm.lower, arm.upper),
        "numeric": NumericInverseKinematics,
    },
)
"""Constructors of blocks by name, called with the arm, the start posture (n,) [rad] and the period
[s]; the blocks have the ports of `InverseKinematics`."""

# A joint commanded to its limit overshoots slightly; mechanical stops are farther out.
_JOINT_LIMIT_TOLERANCE_TO_RANGE_RATIO = 0.01


def pick_ik_method(name: str, arm: ArmModel) -> str:
    """Return the method for setting `name`; raise DrakeTeleopError for an unsupported arm."""
    if name == AUTOMATIC_IK_METHOD:
        return "closed_form" if has_closed_form(arm) else "numeric"
    if name == "closed_form" and not has_closed_form(arm):
        what = "the closed form requires the geometry of an RX90 with its base at the origin of W"
        remedy = f"set it to {AUTOMATIC_IK_METHOD} or numeric"
        raise DrakeTeleopError(what, where="slave.inverse_kinematics", remedy=remedy)
    return name


class LeaderJointFollower(LeafSystem):
    """Block that follows the leader's joints (n,) [rad] within limits of position and speed.

    Invalid input keeps the last command.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, arm: ArmModel, q_start: Array, period: float) -> None:
        super().__init__()
        self._lower, self._upper = arm.lower, arm.upper
        self._step = arm.velocity_limit * period
        n = arm.num_joints
        self._leader = self.DeclareVectorInputPort("leader_joints", n)
        self.DeclareDiscreteState(np.array(q_start, dtype=np.float64))
        self.DeclareVectorOutputPort("joint_command", n, weak_callback(self._calc_command))
        self.DeclareVectorOutputPort("ik_status", 1, weak_callback(self._calc_status))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store_next_command)

    def _next_command_and_status(self, context: Context) -> tuple[Array, IkStatus]:
        last, leader = context.get_discrete_state(0).value(), self._leader.Eval(context)
        if not are_valid_port_values(leader):
            return last, IkStatus.BAD_POSE
        within = np.clip(leader, self._lower, self._upper)
        status = IkStatus.OK if (within == leader).all() else IkStatus.JOINT_LIMIT
        return np.clip(within, last - self._step, last + self._step), status

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._next_command_and_status(context)[0])

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        output[0] = self._next_command_and_status(context)[1]

    def _store_next_command(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(0, self._next_command_and_status(context)[0])


class ExcitationCommand(LeafSystem):
    """Block that commands one period of a trajectory from `start` [s]; its ends hold outside."""

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, trajectory: FourierTrajectory, start: float) -> None:
        super().__init__()
        self._trajectory, self._start = trajectory, start
        calc_command, n = weak_callback(self._calc_command), len(trajectory.q0)
        self.DeclareVectorOutputPort("joint_command", n, calc_command)

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        time = np.clip(context.get_time() - self._start, 0.0, self._trajectory.period)
        output.SetFromVector(self._trajectory.evaluate(time)[0])


class JointRangeMonitor(LeafSystem):
    """Block that raises DrakeTeleopError if a joint exceeds its limit by over 1 % of its range.

    The output `ik_status` is the input `ik_status` at the last sample.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, arm: ArmModel, period: float) -> None:
        super().__init__()
        self._arm = arm
        tolerance = _JOINT_LIMIT_TOLERANCE_TO_RANGE_RATIO * (arm.upper - arm.lower)
        self._lower, self._upper = arm.lower - tolerance, arm.upper + tolerance
        self._state = self.DeclareVectorInputPort("slave_state", 2 * arm.num_joints)
        self._status = self.DeclareVectorInputPort("ik_status", 1)
        self.DeclareStateOutputPort("ik_status", self.DeclareDiscreteState(1))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store_status_and_check_q)

    def _store_status_and_check_q(self, context: Context, discrete_state: DiscreteValues) -> None:
        if self._status.HasValue(context):
            discrete_state.set_value(0, self._status.Eval(context))
        q = self._state.Eval(context)[: self._arm.num_joints]
        # A comparison with NaN is false, so NaN counts as outside.
        inside = (q >= self._lower) & (q <= self._upper) & np.isfinite(q)
        if inside.all():
            return
        joint = int(inside.argmin())
        unit = "m" if self._arm.table[joint, IS_PRISMATIC_COLUMN] else "rad"
        limits = f"{self._arm.lower[joint]:.3f} to {self._arm.upper[joint]:.3f} {unit}"
        what = f"joint {joint + 1} of the slave left its range at {context.get_time():.3f} s"
        remedy = "command a smaller or slower motion, start elsewhere (slave.position or home), or"
        remedy = f"{remedy} limit joint accelerations (joint_control.servo: position)"
        # Returning EventStatus.Failed crashes for systems written in Python.
        what = f"{what}: {q[joint]:.3f} {unit} is outside {limits}"
        raise DrakeTeleopError(what, where="simulation", remedy=remedy)
