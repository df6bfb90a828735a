"""Hand of a live session: simulated, or at a real device."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.systems import framework
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder

from drake_teleop.common import vectors
from drake_teleop.common.blocks import NO_EXTRA_SLOTS, Fault, are_valid_port_values, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.live.station_swap import build_master_side
from drake_teleop.station.master_side import CLUTCH_PERIOD_S, MakeMasterSide
from drake_teleop.station.operator import operator
from drake_teleop.station.passivity.packet import limit_group
from drake_teleop.station.scaling.kinematic_scaling import KinematicScaling
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.plant import start_pose
from drake_teleop.station.wiring import export_outputs

# Poles of the path to a target [rad/s]: three for translation, so that the force has no steps, two
# for rotation. After a target step of 10 mm a firm hand exerts at most 12 N, and the tool covers
# half the distance in 46 ms. After a change of the grip the path is slower.
_TRANSLATION_POLE_RAD_S = 2 * math.pi * 16.0
_GRIP_CHANGE_POLE_RAD_S = _ROTATION_POLE_RAD_S = 2 * math.pi * 5.0
#: Lead time of a target at constant speed that compensates the lag of the hand [s]. At start and
#: stop the error is at most the distance of 5 ms.
TARGET_LEAD_TIME_S = 2.5 / _TRANSLATION_POLE_RAD_S
# Path: held flag, start time [s], poles [rad/s], target X_BE (7,); at the start, relative to the
# target: position, velocity, acceleration (3,) each, rotation vector in B and its rate (3,) each.
_IS_HELD_INDEX, _START_TIME_INDEX, _POLE_INDEX, _TARGET_POSE_INDEX, _PATH_SIZE = 0, 1, 2, 3, 25
_OFFSET_INDEX, _VELOCITY_INDEX, _ACCELERATION_INDEX = 10, 13, 16
_ROTATION_INDEX, _RATE_INDEX = 19, 22
_NUM_INTENDED_MOTION_VALUES = 16  # X_BE (7,), [v; omega] (6,), and the acceleration of E (3,)
#: Period of the poses [s], and [ms].
POSE_PERIOD_S, POSE_PERIOD_MS = 2e-3, 2
# Displayed wrench, relative to its limit: duration of the fade [s], rate of its return [1/s],
# largest slew rate [1/s].
_WRENCH_LIMIT_FADE_S, _LIMIT_RETURN_PER_S, _RELATIVE_WRENCH_SLEW_PER_S = 0.05, 4.0, 150.0
# Path of a device: held flag, start time [s], start pose (7,), displacement, rotation vector (3,).
_START_POSE_INDEX, _DISPLACEMENT_INDEX, _ROTATION_VECTOR_INDEX = 2, 9, 12
# Displayed state: wrench (6,), a `Fault`, allowed share of the limit.
_FAULT_INDEX, _ALLOWED_SHARE_INDEX, _DISPLAY_STATE_SIZE = 6, 7, 8
_INVALID_WRENCH_FAULT_NUMBER = float(Fault.HAND_WRENCH)


@njit(cache=True)
def _intended_motion_into(path, time, pose, out):
    """Write intended X_BE (7,), twist (6,), acceleration (3,) to `out`; `pose` if not held."""
    if path[_IS_HELD_INDEX] < 0.5:
        out[:7] = pose
        out[7:] = 0.0
        return
    t = time - path[_START_TIME_INDEX]
    w = path[_POLE_INDEX]  # (d/dt + w)^3 x = 0, and (d/dt + _ROTATION_POLE_RAD_S)^2 r = 0
    decay, turning_decay = math.exp(-w * t), math.exp(-_ROTATION_POLE_RAD_S * t)
    r, rate = np.empty(3), np.empty(3)
    for k in range(3):
        # x = (a + b t + c t^2) e^(-w t), and its derivatives
        a, v = path[_OFFSET_INDEX + k], path[_VELOCITY_INDEX + k]
        b = v + w * a
        c = 0.5 * (path[_ACCELERATION_INDEX + k] + w * (b + v))
        x = a + t * (b + t * c)
        slope = b + 2.0 * c * t
        out[4 + k] = path[_TARGET_POSE_INDEX + 4 + k] + x * decay
        out[7 + k] = (slope - w * x) * decay
        out[13 + k] = (2.0 * c - w * (2.0 * slope - w * x)) * decay
        turn, turn_rate = path[_ROTATION_INDEX + k], path[_RATE_INDEX + k]
        turning = turn_rate + _ROTATION_POLE_RAD_S * turn
        r[k] = (turn + turning * t) * turning_decay
        rate[k] = (turn_rate - _ROTATION_POLE_RAD_S * turning * t) * turning_decay
    target = vectors.quaternion_at(path, _TARGET_POSE_INDEX)
    orientation = vectors.quaternion_product(
        vectors.quaternion_exponential(vectors.vector_at(r, 0)), target
    )
    for k in range(4):
        out[k] = orientation[k]
    # omega = rate + a r x rate + b r x (r x rate)
    square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    a, b = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    if square > 1e-4:
        angle = math.sqrt(square)
        a = (1.0 - math.cos(angle)) / square
        b = (angle - math.sin(angle)) / (square * angle)
    along = r[0] * rate[0] + r[1] * rate[1] + r[2] * rate[2]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        across = r[i] * rate[j] - r[j] * rate[i]
        out[10 + k] = rate[k] + a * across + b * (r[k] * along - square * rate[k])


@njit(cache=True)
def _rotation_vector_rate(r, omega):
    square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    c = 1.0 / 12.0 + square / 720.0
    if square > 1e-4:
        angle = math.sqrt(square)
        c = 1.0 / square - math.sin(angle) / (2.0 * angle * (1.0 - math.cos(angle)))
    across = vectors.cross(r, omega)
    return vectors.add_cross_product(
        vectors.plus(omega, vectors.scale_vector(-0.5, across)), vectors.scale_vector(c, r), across
    )


@njit(cache=True)
def _plan_hand_path_into(path, time, motion, target, pole_rad_s):
    path[_IS_HELD_INDEX], path[_START_TIME_INDEX], path[_POLE_INDEX] = 1.0, time, pole_rad_s
    vectors.copy_into(path, _TARGET_POSE_INDEX, target, 0, 7)
    rotation = vectors.quaternion_logarithm(
        vectors.quaternion_product(motion, vectors.conjugate_quaternion(target))
    )
    rate = _rotation_vector_rate(rotation, vectors.vector_at(motion, 10))
    vectors.copy_into(path, _VELOCITY_INDEX, motion, 7, 3)
    vectors.copy_into(path, _ACCELERATION_INDEX, motion, 13, 3)
    for k in range(3):
        path[_OFFSET_INDEX + k] = motion[4 + k] - target[4 + k]
        path[_ROTATION_INDEX + k], path[_RATE_INDEX + k] = rotation[k], rate[k]


@njit(cache=True, omits_reference_counting=True)
def _live_hand_wrench_into(path, time, impedance, mass, pose, twist, intended, out):
    _intended_motion_into(path, time, pose, intended)
    for k in range(3):
        intended[4 + k] += mass / impedance[0] * intended[13 + k]
    operator.hand_wrench_into(impedance, intended[:7], intended[7:13], pose, twist, out)


class LiveHand(operator.Operator):
    """Simulated hand of an operator, on smooth paths to the targets of `SetTarget`.

    .. pydrake_system::

        name: LiveHand
        input_ports:
        - pose_master: (7,) X_BE of the stylus
        - twist_master: (6,) [v; omega] of E in B
        output_ports:
        - hand_wrench_E: (6,) F_E_B, [f; tau] of the hand on the stylus at E, in B [N, N m]
        - intent: (7,) intended X_BE
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, config: operator.OperatorConfig, start: Array) -> None:
        super().__init__(dataclasses.replace(config, intent=[], task=None), start)
        self._scratch, self._mass = np.empty(_NUM_INTENDED_MOTION_VALUES), config.hand.mass

    def _declare_intended_motion_ports(self) -> set[framework.DependencyTicket]:
        path = np.zeros(_PATH_SIZE)
        path[_IS_HELD_INDEX], path[_POLE_INDEX] = 1.0, _TRANSLATION_POLE_RAD_S
        path[_TARGET_POSE_INDEX:_OFFSET_INDEX] = self._intent[1]
        self._path = self.DeclareNumericParameter(BasicVector(path))
        return {self.all_parameters_ticket(), self._pose.ticket()}

    def SetTarget(self, context: Context, target: Array | None) -> None:
        """Start a smooth path to the pose X_BE `target` (7,); None: the hand lets go."""
        path = np.zeros(_PATH_SIZE)
        if target is not None:
            motion = self._current_intended_motion(context)
            _plan_hand_path_into(path, context.get_time(), motion, target, _TRANSLATION_POLE_RAD_S)
        context.get_mutable_numeric_parameter(self._path).SetFromVector(path)

    def KeepWrench(
        self, context: Context, before: operator.HandImpedance, after: operator.HandImpedance
    ) -> None:
        """Shift the intended motion so that replacing `before` by `after` keeps the wrench."""
        path = context.get_mutable_numeric_parameter(self._path).CopyToVector()
        if path[_IS_HELD_INDEX] < 0.5:
            return
        pose, twist = self._pose.Eval(context), self._twist.Eval(context)
        intention = self._current_intended_motion(context)
        intended, now = tuple(intention[:4]), tuple(pose[:4])
        rotation = vectors.quaternion_logarithm(
            vectors.quaternion_product(intended, vectors.conjugate_quaternion(now))
        )
        share = before.rotational_stiffness / after.rotational_stiffness
        displacement = before.stiffness / after.stiffness * (intention[4:7] - pose[4:])
        translation_share = before.damping / after.damping
        rotation_share = before.rotational_damping / after.rotational_damping
        damping = np.repeat([translation_share, rotation_share], 3)
        turn = vectors.quaternion_exponential(vectors.scale_vector(share, rotation))
        intention[:4] = vectors.quaternion_product(turn, now)
        intention[4:7] = pose[4:] + displacement
        intention[7:13] = twist + damping * (intention[7:13] - twist)
        intention[13:] *= before.mass / after.mass
        target = path[_TARGET_POSE_INDEX:_OFFSET_INDEX].copy()
        _plan_hand_path_into(path, context.get_time(), intention, target, _GRIP_CHANGE_POLE_RAD_S)
        context.get_mutable_numeric_parameter(self._path).SetFromVector(path)

    def _current_intended_motion(self, context: Context) -> Array:
        path = context.get_numeric_parameter(self._path).value()
        _intended_motion_into(path, context.get_time(), self._pose.Eval(context), self._scratch)
        return self._scratch

    def _calc_wrench(self, context: Context, output: BasicVector) -> None:
        path, time = context.get_numeric_parameter(self._path).value(), context.get_time()
        hand = self._impedance, self._mass
        motion = self._pose.Eval(context), self._twist.Eval(context), self._scratch
        _live_hand_wrench_into(path, time, *hand, *motion, output.get_mutable_value())

    def _calc_intended_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._current_intended_motion(context)[:7])


def MakeLiveMasterSide(scenario: Scenario, *, cross_fade: bool = False) -> Diagram:
    """Return a master side with simulated hand; `cross_fade`: with a block `CrossFade`."""
    builder = DiagramBuilder()
    start = np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position])
    hand = LiveHand(scenario.operator, start)
    side = builder.AddNamedSystem("inner_side", MakeMasterSide(scenario, hand))
    return build_master_side(builder, side, side, 1 / scenario.rates.hand_hz, cross_fade)


@njit(cache=True)
def _pose_and_twist_on_path_into(path, time, out):
    share = min(max((time - path[_START_TIME_INDEX]) / POSE_PERIOD_S, 0.0), 1.0)
    r = vectors.scale_vector(share, vectors.vector_at(path, _ROTATION_VECTOR_INDEX))
    rotation = vectors.quaternion_product(
        vectors.quaternion_exponential(r), vectors.quaternion_at(path, _START_POSE_INDEX)
    )
    moves = 1.0 / POSE_PERIOD_S if share < 1.0 else 0.0
    for k in range(4):
        out[k] = rotation[k]
    for k in range(3):
        out[4 + k] = path[_START_POSE_INDEX + 4 + k] + share * path[_DISPLACEMENT_INDEX + k]
        out[7 + k] = moves * path[_DISPLACEMENT_INDEX + k]
        out[10 + k] = moves * path[_ROTATION_VECTOR_INDEX + k]


@njit(cache=True)
def _limit_device_wrench_into(wrench, is_device_held, period, limits, last_state, state):
    fault = 0.0
    if not are_valid_port_values(wrench):
        fault = _INVALID_WRENCH_FAULT_NUMBER
    enabled = is_device_held and fault == 0.0
    change = _LIMIT_RETURN_PER_S if enabled else -1.0 / _WRENCH_LIMIT_FADE_S
    allowed = min(max(last_state[_ALLOWED_SHARE_INDEX] + period * change, 0.0), 1.0)
    target, step = np.zeros(6), np.empty(6)
    if enabled:
        target[:] = wrench
    for g in range(2):
        limit_group(target, g, allowed * limits[g])
    for i in range(6):
        step[i] = target[i] - last_state[i]
    for g in range(2):
        limit_group(step, g, _RELATIVE_WRENCH_SLEW_PER_S * period * limits[g])
    for i in range(6):
        state[i] = last_state[i] + step[i]
    state[_FAULT_INDEX], state[_ALLOWED_SHARE_INDEX] = fault, allowed


def _copy_state(state_slice: slice, factor: float = 1.0) -> Callable[[Context, BasicVector], None]:
    def copy(context: Context, output: BasicVector) -> None:
        output.SetFromVector(factor * context.get_discrete_state_vector().value()[state_slice])

    return copy


class ExternalMaster(framework.LeafSystem):
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

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, start: Array, period: float, limits: Array) -> None:
        super().__init__()
        path = np.array([1.0, -POSE_PERIOD_S, *start, *np.zeros(6)])
        self._path = self.DeclareNumericParameter(BasicVector(path))
        self._period, self._limits, self._pose_and_twist = period, limits, np.zeros(13)
        self._command = self.DeclareVectorInputPort("wrench_command", 6)
        self.DeclareDiscreteState(np.zeros(_DISPLAY_STATE_SIZE))
        moves, displayed = {self.all_parameters_ticket(), self.time_ticket()}, {self.xd_ticket()}
        for name, size, calc, needed in (
            ("pose_master", 7, weak_callback(self._calc_master_pose), moves),
            ("twist_master", 6, weak_callback(self._calc_master_twist), moves),
            ("master_state", 12, weak_callback(self._calc_master_state), moves),
            ("force_to_master", 6, _copy_state(slice(_FAULT_INDEX)), displayed),
            ("fault_at_hand", 1, _copy_state(slice(_FAULT_INDEX, _ALLOWED_SHARE_INDEX)), displayed),
            ("displayed_and_fault", 7, _copy_state(slice(_ALLOWED_SHARE_INDEX)), displayed),
            ("hand_wrench_E", 6, _copy_state(slice(_FAULT_INDEX), factor=-1.0), displayed),
        ):
            self.DeclareVectorOutputPort(name, size, calc, needed)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_display)

    def SetTarget(self, context: Context, target: Array | None) -> None:
        """Interpolate the device's X_BE to `target` (7,) over 2 ms; None: the hand lets go."""
        now, held, motion = self._current_master_pose_and_twist(context)[:7], 0.0, np.zeros(6)
        if target is not None:
            turn = vectors.quaternion_product(
                tuple(target[:4]), vectors.conjugate_quaternion(tuple(now[:4]))
            )
            held, motion = 1.0, np.append(target[4:] - now[4:], vectors.quaternion_logarithm(turn))
        path = [held, context.get_time(), *now, *motion]
        context.get_mutable_numeric_parameter(self._path).SetFromVector(path)

    def KeepWrench(
        self, context: Context, before: operator.HandImpedance, after: operator.HandImpedance
    ) -> None:
        """Do nothing: a real hand has its own impedance."""

    def _current_master_pose_and_twist(self, context: Context) -> Array:
        path = context.get_numeric_parameter(self._path).value()
        _pose_and_twist_on_path_into(path, context.get_time(), self._pose_and_twist)
        return self._pose_and_twist

    def _calc_master_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._current_master_pose_and_twist(context)[:7])

    def _calc_master_twist(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._current_master_pose_and_twist(context)[7:])

    def _calc_master_state(self, context: Context, output: BasicVector) -> None:
        pose = self._current_master_pose_and_twist(context)
        rotation = RollPitchYaw(RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))))
        angles = (rotation.yaw_angle(), rotation.pitch_angle(), rotation.roll_angle())
        output.SetFromVector([*pose[4:7], *angles, *([0.0] * 6)])

    def _update_display(self, context: Context, discrete_state: framework.DiscreteValues) -> None:
        held = context.get_numeric_parameter(self._path).value()[_IS_HELD_INDEX] > 0.5
        last, new = context.get_discrete_state_vector().value(), discrete_state.get_mutable_value(0)
        wrench = self._command.Eval(context)
        _limit_device_wrench_into(wrench, held, self._period, self._limits, last, new)


def MakeExternalMasterSide(scenario: Scenario, *, cross_fade: bool = False) -> Diagram:
    """Return the master side of a real device; `cross_fade`: with a block `CrossFade`."""
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
    return build_master_side(builder, master, inner_side, 1 / scenario.rates.hand_hz, cross_fade)
