"""Master side of a station with a real haptic device."""

from __future__ import annotations

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from drake_teleop.common import vectors
from drake_teleop.common.blocks import ONE_DICT, Fault, are_finite_and_in_range, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.live.station_swap import finish_master_side
from drake_teleop.station.master_side import CLUTCH_PERIOD_S
from drake_teleop.station.operator.operator import HandImpedance
from drake_teleop.station.passivity.packet import limit_group
from drake_teleop.station.scaling.kinematic_scaling import KinematicScaling
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.plant import start_pose
from drake_teleop.station.wiring import export_outputs

#: Period of the poses [s], and [ms].
POSE_PERIOD_S, POSE_PERIOD_MS = 2e-3, 2
# Displayed wrench, relative to its limit: duration of the fade [s], rate of its return [1/s],
# largest slew rate [1/s].
_WRENCH_LIMIT_FADE_S, _LIMIT_RETURN_PER_S, _RELATIVE_WRENCH_SLEW_PER_S = 0.05, 4.0, 150.0
# Path: held flag, start time [s], start pose (7,), displacement (3,), rotation vector (3,).
_HELD_INDEX, _START_TIME_INDEX, _START_POSE_INDEX = 0, 1, 2
_DISPLACEMENT_INDEX, _ROTATION_INDEX = 9, 12
# Displayed state: wrench (6,), a `Fault`, allowed share of the limit.
_FAULT_INDEX, _ALLOWED_SHARE_INDEX, _DISPLAY_STATE_SIZE = 6, 7, 8
_WRENCH_FAULT_NUMBER = float(Fault.WRENCH)


@njit(cache=True)
def _pose_and_twist_on_path_into(path, time, out):
    share = min(max((time - path[_START_TIME_INDEX]) / POSE_PERIOD_S, 0.0), 1.0)
    r = vectors.scale_vector(share, vectors.vector_at(path, _ROTATION_INDEX))
    rotation = vectors.quaternion_product(
        vectors.quaternion_exponential(r), vectors.quaternion_at(path, _START_POSE_INDEX)
    )
    moves = 1.0 / POSE_PERIOD_S if share < 1.0 else 0.0
    for k in range(4):
        out[k] = rotation[k]
    for k in range(3):
        out[4 + k] = path[_START_POSE_INDEX + 4 + k] + share * path[_DISPLACEMENT_INDEX + k]
        out[7 + k] = moves * path[_DISPLACEMENT_INDEX + k]
        out[10 + k] = moves * path[_ROTATION_INDEX + k]


@njit(cache=True)
def _update_displayed_wrench(wrench, held, period, limits, last, now):
    fault = 0.0
    if not are_finite_and_in_range(wrench):
        fault = _WRENCH_FAULT_NUMBER
    enabled = held and fault == 0.0
    change = _LIMIT_RETURN_PER_S if enabled else -1.0 / _WRENCH_LIMIT_FADE_S
    allowed = min(max(last[_ALLOWED_SHARE_INDEX] + period * change, 0.0), 1.0)
    target, step = np.zeros(6), np.empty(6)
    if enabled:
        target[:] = wrench
    for g in range(2):
        limit_group(target, g, allowed * limits[g])
    for i in range(6):
        step[i] = target[i] - last[i]
    for g in range(2):
        limit_group(step, g, _RELATIVE_WRENCH_SLEW_PER_S * period * limits[g])
    for i in range(6):
        now[i] = last[i] + step[i]
    now[_FAULT_INDEX], now[_ALLOWED_SHARE_INDEX] = fault, allowed


class ExternalMaster(LeafSystem):
    """Real haptic device as a system; `SetTarget` receives its poses.

    The force fades within 50 ms while the hand does not hold the device or after a non-finite
    command, and returns within 0.25 s.

    .. pydrake_system::

        name: ExternalMaster
        input_ports:
        - wrench_command: (6,) F_E_B [N, N m]
        output_ports:
        - pose_master: (7,) X_BE of the end effector in the master's base
        - twist_master: (6,) [v; omega] of E in B [m/s, rad/s]
        - master_state: (12,) position [m], yaw, pitch, roll [rad]; zero speeds
        - force_to_master: (6,) wrench for the device [N, N m]
        - fault_at_hand: number of a `Fault`; 0: none
        - displayed_and_fault: (7,) force_to_master and fault_at_hand
        - hand_wrench_E: (6,) minus the displayed wrench
    """

    __slots__ = ONE_DICT

    def __init__(self, start: Array, period: float, limits: Array) -> None:
        super().__init__()
        path = np.array([1.0, -POSE_PERIOD_S, *start, *np.zeros(6)])
        self._path = self.DeclareNumericParameter(BasicVector(path))
        self._period, self._limits, self._pose_and_twist = period, limits, np.zeros(13)
        self._command = self.DeclareVectorInputPort("wrench_command", 6)
        self.DeclareDiscreteState(np.zeros(_DISPLAY_STATE_SIZE))
        moves = {self.all_parameters_ticket(), self.time_ticket()}
        for name, size, calc, needed in (
            ("pose_master", 7, self._calc_pose, moves),
            ("twist_master", 6, self._calc_twist, moves),
            ("master_state", 12, self._calc_master_state, moves),
            ("force_to_master", 6, self._calc_force, {self.xd_ticket()}),
            ("fault_at_hand", 1, self._calc_fault, {self.xd_ticket()}),
            ("displayed_and_fault", 7, self._calc_wrench_and_fault, {self.xd_ticket()}),
            ("hand_wrench_E", 6, self._calc_hand_wrench, {self.xd_ticket()}),
        ):
            self.DeclareVectorOutputPort(name, size, weak_callback(calc), needed)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_display)

    def SetTarget(self, context: Context, target: Array | None) -> None:
        """Interpolate the device's X_BE to `target` (7,) over 2 ms; None: the hand lets go."""
        now, held, motion = self._current_pose_and_twist(context)[:7], 0.0, np.zeros(6)
        if target is not None:
            turn = vectors.quaternion_product(
                tuple(target[:4]), vectors.conjugate_quaternion(tuple(now[:4]))
            )
            held, motion = 1.0, np.append(target[4:] - now[4:], vectors.quaternion_logarithm(turn))
        path = [held, context.get_time(), *now, *motion]
        context.get_mutable_numeric_parameter(self._path).SetFromVector(path)

    def KeepWrench(self, context: Context, before: HandImpedance, after: HandImpedance) -> None:
        """Do nothing: a real hand has its own impedance."""

    def _current_pose_and_twist(self, context: Context) -> Array:
        path = context.get_numeric_parameter(self._path).value()
        _pose_and_twist_on_path_into(path, context.get_time(), self._pose_and_twist)
        return self._pose_and_twist

    def _calc_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._current_pose_and_twist(context)[:7])

    def _calc_twist(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._current_pose_and_twist(context)[7:])

    def _calc_master_state(self, context: Context, output: BasicVector) -> None:
        pose = self._current_pose_and_twist(context)
        rotation = RollPitchYaw(RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))))
        angles = (rotation.yaw_angle(), rotation.pitch_angle(), rotation.roll_angle())
        output.SetFromVector([*pose[4:7], *angles, *([0.0] * 6)])

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value()[:_FAULT_INDEX])

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_discrete_state_vector().value()[_FAULT_INDEX]

    def _calc_wrench_and_fault(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value()[:_ALLOWED_SHARE_INDEX])

    def _calc_hand_wrench(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(-context.get_discrete_state_vector().value()[:_FAULT_INDEX])

    def _update_display(self, context: Context, discrete_state: DiscreteValues) -> None:
        held = context.get_numeric_parameter(self._path).value()[_HELD_INDEX] > 0.5
        last, now = context.get_discrete_state_vector().value(), discrete_state.get_mutable_value(0)
        wrench = self._command.Eval(context)
        _update_displayed_wrench(wrench, held, self._period, self._limits, last, now)


def MakeExternalMasterSide(scenario: Scenario, *, cross_fade: bool = False) -> Diagram:
    """Return the master side of a real device, with the ports of `MakeLiveMasterSide`."""
    parameters = scenario.master.device(0.0, 0.0).parameters
    start = np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position])
    limits = np.array([parameters.peak_force, parameters.peak_torque.max()])
    builder, inner = DiagramBuilder(), DiagramBuilder()
    scaling = inner.AddNamedSystem(
        "kinematic_scaling",
        KinematicScaling(scenario.kinematic_scaling, CLUTCH_PERIOD_S, start_pose(scenario.slave)),
    )
    for name in ("pose_master", "clutch"):
        inner.ExportInput(scaling.GetInputPort(name), name)
    export_outputs(inner, scaling, "pose_command")
    inner_side = builder.AddNamedSystem("inner_side", inner.Build())
    master = builder.AddNamedSystem(
        "live_hand", ExternalMaster(start, 1 / scenario.rates.hand_hz, limits)
    )
    builder.Connect(master.GetOutputPort("pose_master"), inner_side.GetInputPort("pose_master"))
    export_outputs(builder, inner_side, "pose_command")
    return finish_master_side(builder, master, inner_side, 1 / scenario.rates.hand_hz, cross_fade)
