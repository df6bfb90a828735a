"""Decisions of the simulated operator during a task, from vision and perceived force.

The hand moves by planned displacements, and waits until their effect is visible (Ferrell 1965).
"""

from __future__ import annotations

import dataclasses
import math
from collections import namedtuple
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.noise import random_bits, random_normal
from drake_teleop.common.numeric import Array, as_compiled_arguments
from drake_teleop.common.vectors import apply_matrix, dot, matrix_as_tuple, transposed
from drake_teleop.station.operator import task as tasks
from drake_teleop.station.operator.minimum_jerk import (
    PLAN_SLICE,
    STOP_DURATION_S,
    evaluate_plan,
    plan_move,
    plan_stop,
)
from drake_teleop.station.operator.perception import (
    CONTACT_NOTICED_INDEX,
    DETECTION_THRESHOLD_INDEX,
    Perception,
)

DECISION_PERIOD_S = 0.005
"""Period of perception and decision [s]; a submovement takes at least 40 periods by default."""

_OPERATOR_RANDOM_STREAM_ID = 2  # random stream; the network's lines use others


@dataclass(frozen=True, eq=False)
class OperatorTraining:
    """Station properties that the operator learns in training, before a task.

    Args:
        R_WB: (3, 3) orientation of the master's base in the world.
        translation_scale: displacement of the tool over displacement of the hand.
        force_gain: rendered force over true contact force.
        forward_delay_s, backward_delay_s: mean one-way delays [s].
        seed: random seed of the operator's errors.
    """

    R_WB: Array
    translation_scale: float
    force_gain: float
    forward_delay_s: float
    backward_delay_s: float
    seed: int


#: Training, perception and movement for compiled code; delays are those of both directions.
OperatorParameters = namedtuple(
    "OperatorParameters",
    "R_WB translation_scale force_gain vision_delay force_delay random_key"
    " vision_noise depth_error aim_error weber_fraction"
    " acceleration shortest noise approach_speed gentle_force",
)
#: Task for compiled code: times, target in W relative to the tool's start, criteria.
TaskParameters = namedtuple(
    "TaskParameters",
    "kind start_time timeout target_W approach_axis radius dwell standoff force tolerance depth",
    defaults=(0.0, 0.0, 0.0, 0.0),
)


def pack_operator_parameters(
    training: OperatorTraining, perception: Perception, movement: tasks.Movement
) -> OperatorParameters:
    there_and_back = training.forward_delay_s + training.backward_delay_s + _STATION_REACTION_TIME_S
    delays = perception.vision_delay + there_and_back, perception.reaction_time + there_and_back
    # 53 bits of a key are exact in a float.
    key = random_bits(np.uint64(training.seed % 2**64), _OPERATOR_RANDOM_STREAM_ID)
    own = training.R_WB, training.translation_scale, training.force_gain, *delays, key
    errors = ("vision_noise", "depth_error", "aim_error", "weber_fraction")
    vision = [getattr(perception, name) for name in errors]
    return as_compiled_arguments(OperatorParameters(*own, *vision, **dataclasses.asdict(movement)))


def pack_task_parameters(task: tasks.Task) -> TaskParameters:
    start = tasks.TASK_CLASSES.index(type(task)), task.t_start, task.timeout, task.translation
    along: Any = np.array(task.translation) / task.target_distance
    criteria: tuple[float, ...]
    if isinstance(task, tasks.Reach):
        packed = TaskParameters(*start, along, task.width / 2, task.dwell)
    else:
        radius, standoff = max(0.25 * task.standoff, 1e-3), task.standoff
        if isinstance(task, tasks.Press):
            criteria = task.hold, standoff, task.force, task.tolerance
        elif isinstance(task, tasks.Insert):
            along, criteria = [0.0, 0.0, -1.0], (task.dwell, standoff, task.push, 0.0, task.depth)
        else:
            criteria = task.dwell, standoff
        packed = TaskParameters(*start, along, radius, *criteria)
    return as_compiled_arguments(packed)


# Indices of `state` in `update_decision`.
PHASE_INDEX, OUTCOME_INDEX, CONTACT_PERCEIVED_INDEX = range(3)
FORCE_THRESHOLD_INDEX, CONTACT_TRUST_INDEX, STATE_SIZE = range(3, 6)
"""Indices of the signal task_state, and its size."""
PHASE_WAITING, PHASE_MOVING, PHASE_APPROACHING, PHASE_STOPPING = range(4)
PHASE_PRESSING, PHASE_SEARCHING_SLOT, PHASE_OVER = range(4, 7)
"""Phases: before the start; move by vision; careful approach until contact; stop; force control;
search for the slot; finished or given up."""
# Memory: number of steps; earliest time of the next submovement; time at which the aim was met,
# else -1; estimated contact stiffness; force and displacement of the last press; number of
# searches; plan.
_STEP_COUNT, _NEXT_MOVE_TIME, _CRITERION_MET_SINCE, _ASSUMED_CONTACT_STIFFNESS = range(4)
_LAST_PRESS_FORCE, _LAST_PRESS_MOTION, _NUM_SLOT_SEARCHES = range(4, 7)
MEMORY_SIZE = PLAN_SLICE.stop

_STEPS_PER_EYE_FIXATION = 50  # steps of a fixation, 0.25 s
_STATION_REACTION_TIME_S = 0.05  # end of a move to its effect, without network, estimate
_APPROACH_SPEED_UPDATE_PERIOD_S = 0.3  # s, update interval of the careful approach, estimate
# Largest perceived depth without contact; beyond, the operator gives up; estimate.
_MAX_MISSED_DEPTH_M = 0.03
_MIN_CONTACT_DETECTION_TRUST = 0.1  # trust with vision only, estimate
# Contact stiffness that the operator assumes [N/m], estimate.
_INITIAL_ASSUMED_STIFFNESS, _MIN_ASSUMED_STIFFNESS, _MAX_ASSUMED_STIFFNESS = 2000.0, 200.0, 50000.0
_MAX_PRESS_CORRECTION_M = 0.003  # m, longest correction of the force, at the tool, estimate
_MIN_STUCK_TO_PUSH_FORCE_RATIO = 0.5  # above it the peg is stuck, estimate
# Compliance to lateral force [N/m], largest yield [m], estimates.
_LATERAL_YIELD_STIFFNESS, _MAX_LATERAL_YIELD_M = 5000.0, 0.0015
# Spiral of the search: radius [m] over sqrt(number of searches), estimate; golden angle [rad].
_SEARCH_SPIRAL_SCALE_M, _GOLDEN_ANGLE_RAD = 0.5e-3, 2.399963
_FLOOR_DEPTH_RATIO = 0.8  # share of the depth beyond which contact counts as the floor, estimate


def initial_memory() -> Array:
    memory = np.zeros(MEMORY_SIZE)
    memory[_CRITERION_MET_SINCE] = -1.0
    memory[_ASSUMED_CONTACT_STIFFNESS] = _INITIAL_ASSUMED_STIFFNESS
    memory[PLAN_SLICE.start + 1] = 1.0
    return memory


@njit(cache=True)
def _tool_to_hand_motion(person, tool_motion_W):
    motion = np.zeros(3)
    for i in range(3):
        for k in range(3):
            motion[i] += person.R_WB[k, i] * tool_motion_W[k] / person.translation_scale
    return motion


@njit(cache=True)
def _normal_random_number(person, step, draw):
    return random_normal(np.uint64(person.random_key), 16 * step + draw)


@njit(cache=True)
def observe_tool_into(person, step, displacement_W, seen_W):
    """Write the seen displacement of the tool from its start (3,), in W [m], into `seen_W`.

    It is the true `displacement_W` plus an error that is constant for 50 steps (an eye fixation).
    """
    for i in range(3):
        draw = _normal_random_number(person, step // _STEPS_PER_EYE_FIXATION, 4 + i)
        seen_W[i] = displacement_W[i] + person.vision_noise * draw


@njit(cache=True)
def _plan_submovement(person, memory, step, time, error_W):
    change = _tool_to_hand_motion(person, error_W)
    length = math.sqrt(dot(change, change))
    # The peak acceleration of a minimum-jerk movement determines its shortest duration.
    duration = math.sqrt(10.0 / math.sqrt(3.0) * length / person.acceleration)
    duration = max(duration, person.shortest)
    for i in range(3):
        change[i] += person.noise * length * _normal_random_number(person, step, i)
    plan_move(memory, time, duration, change, np.zeros(3))
    return duration


@njit(cache=True)
def _contact_force_at_tool_along_approach(task, person, sensed):
    axis_B = apply_matrix(transposed(matrix_as_tuple(person.R_WB)), task.approach_axis)
    return -dot(sensed, axis_B) / person.force_gain if person.force_gain > 0.0 else 0.0


@njit(cache=True)
def _update_dwell_and_check_criterion(memory, time, is_met, is_nearly_met):
    if memory[_CRITERION_MET_SINCE] < 0.0 and is_met:
        memory[_CRITERION_MET_SINCE] = time
    elif not is_nearly_met:
        memory[_CRITERION_MET_SINCE] = -1.0
    return memory[_CRITERION_MET_SINCE] >= 0.0


@njit(cache=True)
def _finish_task(state, memory, time, outcome):
    state[PHASE_INDEX], state[OUTCOME_INDEX] = PHASE_OVER, outcome
    plan_stop(memory, time)


@njit(cache=True)
def _enter_phase(state, memory, phase, next_move_time):
    state[PHASE_INDEX], memory[_NEXT_MOVE_TIME] = phase, next_move_time
    memory[_CRITERION_MET_SINCE] = -1.0


@njit(cache=True)
def update_decision(task, person, time, seen_W, sensed, state, memory):
    """Update the operator's decisions by one step of `DECISION_PERIOD_S`.

    Args:
        task, person: results of `pack_task_parameters` and `pack_operator_parameters`.
        seen_W: (3,) perceived displacement of the tool from its start, in W [m].
        sensed: (5,) output of `update_perception_into`, delayed by the reaction time.
        state: (5,) updated: phase, as `PHASE_MOVING`; outcome: 1 done, -1 given up; 1 while contact
            is detected; detection threshold [N]; trust (0.1 to 1) in detecting contact.
        memory: (MEMORY_SIZE,) from `initial_memory`, updated.
    """
    step = int(memory[_STEP_COUNT])
    memory[_STEP_COUNT] += 1.0
    state[CONTACT_PERCEIVED_INDEX] = sensed[CONTACT_NOTICED_INDEX]
    state[FORCE_THRESHOLD_INDEX] = sensed[DETECTION_THRESHOLD_INDEX]
    # Ratio of the smallest detectable to the largest harmless contact force at the tool.
    unnoticed = math.inf
    if person.force_gain > 0.0:
        unnoticed = sensed[DETECTION_THRESHOLD_INDEX] / (person.force_gain * person.gentle_force)
    state[CONTACT_TRUST_INDEX] = max(1.0 / (1.0 + unnoticed), _MIN_CONTACT_DETECTION_TRUST)
    if state[PHASE_INDEX] == PHASE_WAITING and time >= task.start_time:
        _enter_phase(state, memory, PHASE_MOVING, time)
    if state[PHASE_INDEX] in (PHASE_WAITING, PHASE_OVER):
        return
    if time - task.start_time > task.timeout:
        _finish_task(state, memory, time, -1.0)
    elif state[PHASE_INDEX] == PHASE_MOVING:
        _move_to_target_by_vision(task, person, step, time, seen_W, state, memory)
    elif state[PHASE_INDEX] == PHASE_APPROACHING:
        _approach_contact(task, person, time, seen_W, sensed, state, memory)
    elif state[PHASE_INDEX] == PHASE_STOPPING and time >= memory[_NEXT_MOVE_TIME]:
        if task.kind == tasks.KIND_PRESS:
            _enter_phase(state, memory, PHASE_PRESSING, time)
        elif (
            _update_dwell_and_check_criterion(memory, time, True, True)
            and time - memory[_CRITERION_MET_SINCE] >= task.dwell
        ):
            _finish_task(state, memory, time, 1.0)
    elif state[PHASE_INDEX] == PHASE_PRESSING:
        _control_press_force(task, person, step, time, sensed, state, memory)
    elif state[PHASE_INDEX] == PHASE_SEARCHING_SLOT and time >= memory[_NEXT_MOVE_TIME]:
        _search_slot(task, person, step, time, seen_W, sensed, state, memory)


@njit(cache=True)
def _perceived_standoff_target_W(task, person):
    depth = 0.0
    if task.kind != tasks.KIND_REACH:
        depth = person.depth_error * _normal_random_number(person, 0, 15)
    target = task.target_W + (depth - task.standoff) * task.approach_axis
    if task.kind == tasks.KIND_INSERT:
        for i in range(2):
            target[i] += person.aim_error * _normal_random_number(person, 0, 13 + i)
    return target


@njit(cache=True)
def _perceived_tool_depth_m(task, person, seen_W):
    target, beyond = _perceived_standoff_target_W(task, person), -task.standoff
    for i in range(3):
        beyond += (seen_W[i] - target[i]) * task.approach_axis[i]
    return beyond


@njit(cache=True)
def _move_to_target_by_vision(task, person, step, time, seen_W, state, memory):
    error = _perceived_standoff_target_W(task, person) - seen_W
    off = math.sqrt(dot(error, error))
    inside, still_inside = off <= 0.8 * task.radius, off <= task.radius
    met = _update_dwell_and_check_criterion(memory, time, inside, still_inside)
    if task.kind == tasks.KIND_REACH:
        if met and time - memory[_CRITERION_MET_SINCE] >= task.dwell:
            _finish_task(state, memory, time, 1.0)
            return
    elif met and time >= memory[_NEXT_MOVE_TIME]:
        _enter_phase(state, memory, PHASE_APPROACHING, time)
        return
    if not met and time >= memory[_NEXT_MOVE_TIME]:
        duration = _plan_submovement(person, memory, step, time, error)
        memory[_NEXT_MOVE_TIME] = time + duration + person.vision_delay


@njit(cache=True)
def _approach_contact(task, person, time, seen_W, sensed, state, memory):
    inserts = task.kind == tasks.KIND_INSERT
    touches = state[CONTACT_PERCEIVED_INDEX] > 0.0
    if touches and (not inserts or _is_tool_stuck(task, person, sensed)):
        plan_stop(memory, time)
        phase = PHASE_SEARCHING_SLOT if inserts else PHASE_STOPPING
        _enter_phase(state, memory, phase, time + STOP_DURATION_S + person.force_delay)
        return
    if _perceived_tool_depth_m(task, person, seen_W) > task.depth + _MAX_MISSED_DEPTH_M:
        _finish_task(state, memory, time, -1.0)
    elif time >= memory[_NEXT_MOVE_TIME]:
        speed_W = state[CONTACT_TRUST_INDEX] * person.approach_speed
        speed, change = _tool_to_hand_motion(person, speed_W * task.approach_axis), np.empty(3)
        for i in range(3):
            now = evaluate_plan(memory[PLAN_SLICE], time, i)[1]
            change[i] = 0.5 * _APPROACH_SPEED_UPDATE_PERIOD_S * (now + speed[i])
        plan_move(memory, time, _APPROACH_SPEED_UPDATE_PERIOD_S, change, speed)
        memory[_NEXT_MOVE_TIME] = time + _APPROACH_SPEED_UPDATE_PERIOD_S


@njit(cache=True)
def _perceived_contact_force(task, person, sensed, memory):
    draw = _normal_random_number(person, int(memory[_NEXT_MOVE_TIME] / DECISION_PERIOD_S), 3)
    error = person.weber_fraction * draw
    return (1.0 + error) * _contact_force_at_tool_along_approach(task, person, sensed)


@njit(cache=True)
def _calc_hand_displacement_for_press_m(task, memory, force):
    effect = force - memory[_LAST_PRESS_FORCE]
    if effect * memory[_LAST_PRESS_MOTION] > 0.0:
        stiffness = 0.5 * (memory[_ASSUMED_CONTACT_STIFFNESS] + effect / memory[_LAST_PRESS_MOTION])
        memory[_ASSUMED_CONTACT_STIFFNESS] = min(
            max(stiffness, _MIN_ASSUMED_STIFFNESS), _MAX_ASSUMED_STIFFNESS
        )
    move = (task.force - force) / memory[_ASSUMED_CONTACT_STIFFNESS]
    move = min(max(move, -_MAX_PRESS_CORRECTION_M), _MAX_PRESS_CORRECTION_M)
    memory[_LAST_PRESS_FORCE], memory[_LAST_PRESS_MOTION] = force, move
    return move


@njit(cache=True)
def _control_press_force(task, person, step, time, sensed, state, memory):
    force = _perceived_contact_force(task, person, sensed, memory)
    error = abs(task.force - force)
    is_met, is_nearly_met = error <= 0.5 * task.tolerance, error <= task.tolerance
    met = _update_dwell_and_check_criterion(memory, time, is_met, is_nearly_met)
    if met and time - memory[_CRITERION_MET_SINCE] >= task.dwell:
        _finish_task(state, memory, time, 1.0)
    elif not met and time >= memory[_NEXT_MOVE_TIME]:
        move = _calc_hand_displacement_for_press_m(task, memory, force)
        duration = _plan_submovement(person, memory, step, time, move * task.approach_axis)
        memory[_NEXT_MOVE_TIME] = time + duration + person.force_delay


@njit(cache=True)
def _lateral_contact_force_W_and_norm(task, person, sensed):
    lateral = _contact_force_at_tool_along_approach(task, person, sensed) * task.approach_axis
    if person.force_gain > 0.0:
        for i in range(3):
            for k in range(3):
                lateral[i] += person.R_WB[i, k] * sensed[k] / person.force_gain
    return lateral, math.sqrt(dot(lateral, lateral))


@njit(cache=True)
def _is_tool_stuck(task, person, sensed):
    limit = _MIN_STUCK_TO_PUSH_FORCE_RATIO * task.force
    _, sideways = _lateral_contact_force_W_and_norm(task, person, sensed)
    return _contact_force_at_tool_along_approach(task, person, sensed) >= limit or sideways >= limit


@njit(cache=True)
def _search_spiral_coordinate_m(num_searches, axis):
    radius = _SEARCH_SPIRAL_SCALE_M * math.sqrt(num_searches)
    return radius * math.cos(_GOLDEN_ANGLE_RAD * num_searches - 0.5 * math.pi * axis)


@njit(cache=True)
def _search_slot(task, person, step, time, seen_W, sensed, state, memory):
    force = _perceived_contact_force(task, person, sensed, memory)
    if not (state[CONTACT_PERCEIVED_INDEX] > 0.0 and _is_tool_stuck(task, person, sensed)):
        _enter_phase(state, memory, PHASE_APPROACHING, time)
        return
    deep = _perceived_tool_depth_m(task, person, seen_W) >= _FLOOR_DEPTH_RATIO * task.depth
    if deep and abs(force - task.force) <= _MIN_STUCK_TO_PUSH_FORCE_RATIO * task.force:
        _enter_phase(state, memory, PHASE_STOPPING, time)
        return
    push = _calc_hand_displacement_for_press_m(task, memory, force)
    move, sideways = _lateral_contact_force_W_and_norm(task, person, sensed)
    if sideways >= state[FORCE_THRESHOLD_INDEX] / person.force_gain:
        move *= min(1.0 / _LATERAL_YIELD_STIFFNESS, _MAX_LATERAL_YIELD_M / sideways)
    else:
        n = memory[_NUM_SLOT_SEARCHES]
        memory[_NUM_SLOT_SEARCHES] += 1.0
        for k in range(2):
            move[k] = _search_spiral_coordinate_m(n + 1, k) - _search_spiral_coordinate_m(n, k)
        move[2] = 0.0
    move += push * task.approach_axis
    duration = _plan_submovement(person, memory, step, time, move)
    memory[_NEXT_MOVE_TIME] = time + duration + person.force_delay
