"""The simulated operator: intended path of the hand, followed through the hand's impedance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DependencyTicket,
    DiscreteValues,
    LeafSystem,
)

from drake_teleop.common import vectors
from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.operator import decision
from drake_teleop.station.operator import perception as feeling
from drake_teleop.station.operator.decision import OperatorTraining
from drake_teleop.station.operator.minimum_jerk import add_planned_motion_into
from drake_teleop.station.operator.perception import Perception, update_perception_into
from drake_teleop.station.operator.task import Insert, Movement, Press, Reach, Touch
from drake_teleop.station.passivity.packet import are_vectors_finite, limit_group
from drake_teleop.station.slave.arm import ArmModel, forward_kinematics

_MAX_HAND_FORCE_N = 60.0  # N, largest controlled force of a hand on a stylus, estimate
_MAX_HAND_TORQUE_NM = 2.0  # N m, estimate


@dataclass(frozen=True)
class HandImpedance:
    """Impedance between intended and actual pose of the hand; all values are estimates."""

    mass: float  # kg, passive mass that moves with the stylus
    damping: float  # N s/m
    stiffness: float  # N/m
    inertia: float  # kg m^2, about every axis through E, moves with the stylus
    rotational_damping: float  # N m s/rad
    rotational_stiffness: float  # N m/rad


#: Hand impedance by grip.
GRIP_IMPEDANCES = {
    "light": HandImpedance(0.10, 2.0, 50.0, 0.9e-4, 0.015, 0.5),
    "medium": HandImpedance(0.25, 8.0, 250.0, 2.25e-4, 0.035, 1.5),
    "firm": HandImpedance(0.50, 20.0, 700.0, 4.5e-4, 0.060, 3.0),
}


@settings
@dataclass
class MinimumJerk:
    """Minimum-jerk move: share 10 u^3 - 15 u^4 + 6 u^5 done at u = (t - t_start) / duration."""

    t_start: float = quantity(0.0, "s", 0.0, 1e6, "start of the move")
    duration: float = quantity(1.0, "s", 1e-3, 1e6, "duration of the move")
    translation: list[float] = quantity([0.0, 0.0, 0.0], "m", -1.0, 1.0, "displacement in B")
    rotation: list[float] = quantity(
        [0.0, 0.0, 0.0], "rad", -3.14, 3.14, "rotation vector, about axes of the master's base B"
    )


@settings
@dataclass
class Sine:
    """Oscillation with minimum-jerk ramps at both ends.

    Between the ramps the offset is amplitude * sin(2 pi frequency (t - t_start) + phase).
    """

    t_start: float = quantity(0.0, "s", 0.0, 1e6, "start of the first ramp")
    duration: float = quantity(1.0, "s", 1e-3, 1e6, "duration, both ramps included")
    ramp: float = quantity(0.1, "s", 1e-3, 1e6, "time of each ramp, at most half of duration")
    frequency: float = quantity(1.0, "Hz", 0.0, 100.0, "frequency")
    phase: float = quantity(0.0, "rad", -7.0, 7.0, "phase at t_start")
    translation: list[float] = quantity([0.0, 0.0, 0.0], "m", -1.0, 1.0, "amplitude in B")
    rotation: list[float] = quantity(
        [0.0, 0.0, 0.0], "rad", -3.14, 3.14, "amplitude as rotation vector, about axes of base B"
    )


@settings
@dataclass
class OperatorConfig:
    """Settings of the operator: grip, intended motion and task."""

    grip: str = choice("medium", tuple(GRIP_IMPEDANCES), "grip: preset of the hand's impedance")
    intent: list[MinimumJerk | Sine] = plain([], "hand movements from the start pose, summed")
    task: Reach | Touch | Press | Insert | None = plain(
        None, "task by vision and force perception; its motion adds to `intent`"
    )
    perception: Perception = field(default_factory=Perception)
    movement: Movement = field(default_factory=Movement)

    def check(self, where: str) -> None:
        for index, segment in enumerate(self.intent):
            if isinstance(segment, Sine) and segment.ramp > 0.5 * segment.duration:
                what = f"two ramps of {segment.ramp:g} s are longer than the duration,"
                what, place = f"{what} {segment.duration:g} s", f"{where}.intent[{index}].ramp"
                remedy = f"set it to {0.5 * segment.duration:g} or less, or increase duration"
                raise DrakeTeleopError(what, where=place, remedy=remedy)

    @property
    def hand(self) -> HandImpedance:
        return GRIP_IMPEDANCES[self.grip]


def pack_intent(segments: Sequence[MinimumJerk | Sine]) -> Array:
    """Return the segments of the intended motion as an array (n, 12) for compiled functions."""
    # Columns: start, length of ramp in and ramp out, 2 pi frequency, phase, translation, rotation.
    packed = np.zeros((len(segments), 12))
    for row, segment in zip(packed, segments, strict=True):
        if isinstance(segment, MinimumJerk):
            row[:6] = segment.t_start, segment.duration, np.inf, 1.0, 0.0, 0.5 * np.pi
        else:
            stop = segment.t_start + segment.duration - segment.ramp
            speed = 2 * np.pi * segment.frequency
            row[:6] = segment.t_start, segment.ramp, stop, segment.ramp, speed, segment.phase
        row[6:9] = segment.translation
        row[9:12] = segment.rotation
    return packed


@njit(cache=True)
def _minimum_jerk_ramp_and_rate(time, duration):
    u = time / duration
    if u <= 0.0:
        return 0.0, 0.0
    if u >= 1.0:
        return 1.0, 0.0
    return u * u * u * (10.0 + u * (6.0 * u - 15.0)), 30.0 * (u * (1.0 - u)) ** 2 / duration


@njit(cache=True)
def intended_motion_into(packed, start, t, pose, twist):
    """Write the intended pose X_BE (7,) and twist [v; omega] (6,) of the hand at time t [s].

    `packed` is from `pack_intent`, `start` (7,) is X_BE before the first segment. Translations
    add; rotations apply in the order of the list, each about axes of B.
    """
    orientation = vectors.quaternion_at(start, 0)
    omega = (0.0, 0.0, 0.0)
    vectors.copy_into(pose, 4, start, 4, 3)
    twist[:3] = 0.0
    for n in range(packed.shape[0]):
        row = packed[n]
        fade_in, fade_in_rate = _minimum_jerk_ramp_and_rate(t - row[0], row[1])
        fade_out, fade_out_rate = _minimum_jerk_ramp_and_rate(t - row[2], row[3])
        angle = row[4] * (t - row[0]) + row[5]
        level = (fade_in - fade_out) * math.sin(angle)
        rate = (fade_in_rate - fade_out_rate) * math.sin(angle)
        rate += (fade_in - fade_out) * row[4] * math.cos(angle)
        for k in range(3):
            pose[4 + k] += level * row[6 + k]
            twist[k] += rate * row[6 + k]
        rotation = vectors.vector_at(row, 9)
        turn = vectors.quaternion_exponential(vectors.scale_vector(level, rotation))
        orientation = vectors.quaternion_product(turn, orientation)
        omega = vectors.rotate_vector(turn, omega)
        omega = vectors.plus(omega, vectors.scale_vector(rate, rotation))
    vectors.copy_into(pose, 0, orientation, 0, 4)
    vectors.copy_into(twist, 3, omega, 0, 3)


@njit(cache=True)
def check_motion_and_normalize_pose_into(pose, twist, out):
    """Write the pose (7,) with unit quaternion into `out`; return False for invalid inputs."""
    square = 0.0
    for k in range(4):
        square += pose[k] * pose[k]
    if not (are_vectors_finite((pose, twist)) and 0.0 < square < math.inf):
        return False
    size = math.sqrt(square)
    for k in range(7):
        out[k] = pose[k] / size if k < 4 else pose[k]
    return True


@njit(cache=True)
def hand_wrench_into(impedance, intent_pose, intent_twist, pose, twist, wrench):
    """Write the wrench [f; tau] (6,) of the hand on the stylus at E, in B, at most 60 N and 2 N m.

    f = K (x_intent - x) + D (v_intent - v); tau likewise. `impedance` (4,) is [K, D, rotational K,
    rotational D].
    """
    intended = vectors.quaternion_at(intent_pose, 0)
    inverse = vectors.conjugate_quaternion(vectors.quaternion_at(pose, 0))
    error = vectors.quaternion_logarithm(vectors.quaternion_product(intended, inverse))
    for k in range(3):
        wrench[k] = impedance[0] * (intent_pose[4 + k] - pose[4 + k])
        wrench[k] += impedance[1] * (intent_twist[k] - twist[k])
        wrench[3 + k] = impedance[2] * error[k]
        wrench[3 + k] += impedance[3] * (intent_twist[3 + k] - twist[3 + k])
    limit_group(wrench, 0, _MAX_HAND_FORCE_N)
    limit_group(wrench, 1, _MAX_HAND_TORQUE_NM)


@njit(cache=True)
def _intended_plus_planned_motion_into(intent, time, pose, twist):
    packed, start, start_twist, memory = intent
    intended_motion_into(packed, start, time, pose, twist)
    for k in range(6):
        twist[k] += start_twist[k]
    if memory.shape[0] > 0:
        add_planned_motion_into(memory, time, pose, twist)


@njit(cache=True, omits_reference_counting=True)
def _hand_wrench_at_time(intent, time, impedance, intent_pose, intent_twist, pose, twist, wrench):
    _intended_plus_planned_motion_into(intent, time, intent_pose, intent_twist)
    hand_wrench_into(impedance, intent_pose, intent_twist, pose, twist, wrench)


@njit(cache=True)
def _update_operator_perception_and_decision(
    task, person, senses, hand_mass, arm, tip, time, hand_wrench, twist, slave_q, task_state,
    decision_memory, force_memory, seen_displacements, perceived_forces,
):  # fmt: skip
    step = int(decision_memory[0])
    R_WS, p_WS, displacement = np.empty((3, 3)), np.empty(3), np.empty(3)
    forward_kinematics(arm, slave_q, R_WS, p_WS)
    for i in range(3):
        displacement[i] = p_WS[i] - tip[3 + i]
        for k in range(3):
            displacement[i] += R_WS[i, k] * tip[k]
    decision.observe_tool_into(
        person, step, displacement, seen_displacements[step % seen_displacements.shape[0]]
    )
    # Before contact is expected, only the expectation is updated.
    attentive = task_state[decision.PHASE_INDEX] > decision.PHASE_MOVING
    sensed = perceived_forces[step % perceived_forces.shape[0]]
    period, force, v = decision.DECISION_PERIOD_S, hand_wrench[:3], twist[:3]
    update_perception_into(force_memory, senses, period, hand_mass, force, v, attentive, sensed)
    # The next entry to be overwritten is the oldest.
    seen = seen_displacements[(step + 1) % seen_displacements.shape[0]]
    sensed = perceived_forces[(step + 1) % perceived_forces.shape[0]]
    decision.update_decision(task, person, time, seen, sensed, task_state, decision_memory)


def _make_delay_buffer(delay_s: float, initial_value: Array) -> Array:
    return np.tile(initial_value, (round(delay_s / decision.DECISION_PERIOD_S) + 1, 1))


class Operator(LeafSystem):
    """Simulated operator: moves the stylus towards the intended pose and perceives contact.

    .. pydrake_system::

        name: Operator
        input_ports:
        - pose_master: (7,) X_BE
        - twist_master: (6,) [v; omega] of E in B
        - intended_pose: (7,) X_BE that replaces the config's intent; may be left unconnected
        - intended_twist: (6,) [v; omega] of intended_pose, at E in B; zero if unconnected
        - slave_state: [q; v] of the slave, for the view of the tool (with a task)
        output_ports:
        - hand_wrench_E: (6,) F_E_B, [f; tau] of the hand on the stylus at E, in B [N, N m]
        - intent: (7,) the intended X_BE
        - task_state: (5,) phase, 1 done or -1 given up, 1 while contact is detected, threshold of
          the rendered force [N], trust in detecting contact, 0.1 to 1 (with a task)

    The intended motion is relative to the pose X_BE `start` (7,). A task requires training, the
    slave's arm, and `tip` (6,): position of the tool's tip in S, and at the start in W [m].
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self,
        config: OperatorConfig,
        start: Array,
        training: OperatorTraining | None = None,
        arm: ArmModel | None = None,
        tip: Array | None = None,
    ) -> None:
        super().__init__()
        hand = config.hand
        self._impedance = np.array(
            [hand.stiffness, hand.damping, hand.rotational_stiffness, hand.rotational_damping]
        )
        self._intent = (pack_intent(config.intent), np.array(start, dtype=float), np.zeros(6))
        self._intent_pose, self._intent_twist = np.empty(7), np.empty(6)
        self._commanded_pose = np.empty(7)
        self._no_memory, self._no_segments = np.empty(0), self._intent[0][:0]
        self._has_task = config.task is not None
        self._pose = self.DeclareVectorInputPort("pose_master", 7)
        self._twist = self.DeclareVectorInputPort("twist_master", 6)
        moving = self._declare_intended_motion_ports() | {self.time_ticket()}
        if config.task is not None:
            if training is None or arm is None or tip is None:
                raise ValueError("Operator: a task requires the arguments training, arm and tip")
            senses, period = config.perception, decision.DECISION_PERIOD_S
            nothing_felt = np.array([0.0, 0.0, 0.0, senses.absolute_threshold, 0.0])
            view_delay = senses.vision_delay + training.backward_delay_s
            self._seen_displacements = _make_delay_buffer(view_delay, np.zeros(3))
            self._perceived_forces = _make_delay_buffer(senses.reaction_time, nothing_felt)
            person = decision.pack_operator_parameters(training, senses, config.movement)
            task_and_person = decision.pack_task_parameters(config.task), person
            hand_and_arm = senses.packed_for_compiled_code(period), hand.mass, arm.table
            self._task_parameters = (*task_and_person, *hand_and_arm, np.array(tip, dtype=float))
            self._joints = arm.num_joints
            self._slave = self.DeclareVectorInputPort("slave_state", 2 * arm.num_joints)
            memories = decision.initial_memory(), feeling.initial_memory()
            buffers = self._seen_displacements.ravel(), self._perceived_forces.ravel()
            state = (np.zeros(decision.STATE_SIZE), *memories, *buffers)
            self._groups = [self.DeclareDiscreteState(part) for part in state]
            self.DeclareStateOutputPort("task_state", self._groups[0])
            update = self._update_perception_and_decision
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, update)
            moving.add(self.discrete_state_ticket(self._groups[1]))
        calc, held = weak_callback(self._calc_wrench), {self._pose.ticket(), self._twist.ticket()}
        self._wrench = self.DeclareVectorOutputPort("hand_wrench_E", 6, calc, held | moving)
        self.DeclareVectorOutputPort("intent", 7, weak_callback(self._calc_intended_pose), moving)

    def _declare_intended_motion_ports(self) -> set[DependencyTicket]:
        # `LiveHand` replaces these ports by a path to external targets.
        pose = self._intended_pose = self.DeclareVectorInputPort("intended_pose", 7)
        twist = self._intended_twist = self.DeclareVectorInputPort("intended_twist", 6)
        return {pose.ticket(), twist.ticket()}

    def _update_perception_and_decision(self, context: Context, states: DiscreteValues) -> None:
        state = [states.get_mutable_value(group) for group in self._groups]
        state[3] = state[3].reshape(self._seen_displacements.shape)
        state[4] = state[4].reshape(self._perceived_forces.shape)
        inputs = context.get_time(), self._wrench.Eval(context), self._twist.Eval(context)
        slave_q = self._slave.Eval(context)[: self._joints]
        _update_operator_perception_and_decision(*self._task_parameters, *inputs, slave_q, *state)

    def _evaluate_intent(self, context: Context) -> tuple[Array, ...]:
        """Return packed motion segments, their reference pose and twist, and decision memory."""
        memory = self._no_memory
        if self._has_task:
            memory = context.get_discrete_state(self._groups[1]).value()
        if not self._intended_pose.HasValue(context):
            return *self._intent, memory
        pose = self._intended_pose.Eval(context)
        known = self._intended_twist.HasValue(context)
        twist = self._intended_twist.Eval(context) if known else self._intent[2]
        if not check_motion_and_normalize_pose_into(pose, twist, self._commanded_pose):
            what = f"the intended motion at {context.get_time():g} s is not a finite pose and twist"
            remedy = "give X_BE [qw qx qy qz px py pz] in m, and [v; omega] in m/s, rad/s"
            raise DrakeTeleopError(what, where="intended_pose", remedy=remedy)
        return self._no_segments, self._commanded_pose, twist, memory

    def _calc_wrench(self, context: Context, output: BasicVector) -> None:
        intent, time = self._evaluate_intent(context), context.get_time()
        own = self._impedance, self._intent_pose, self._intent_twist
        stylus = self._pose.Eval(context), self._twist.Eval(context)
        _hand_wrench_at_time(intent, time, *own, *stylus, output.get_mutable_value())

    def _calc_intended_pose(self, context: Context, output: BasicVector) -> None:
        intent, pose = self._evaluate_intent(context), output.get_mutable_value()
        _intended_plus_planned_motion_into(intent, context.get_time(), pose, self._intent_twist)
