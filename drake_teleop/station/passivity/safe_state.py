"""Safe state of both ends of the channel for silence and faulty data; docs/delay.md.

A sender is *healthy* while its inputs are finite and at most 1e6 in SI units. An end is *silent* if
no new packet of a healthy sender came for `timeout` seconds, and at once if either is not healthy.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.packet import dot_of_group, length_of_group, move_pose_into

STOP_TIME_S = 0.05  #: time in which a silent end comes to rest [s]
RESUME_TIME_S = 0.5  #: time of the transition to normal operation [s]

_HAND_VELOCITY_FILTER_S = 4e-3  # of the velocity: encoders have steps
MASTER_MONITOR_SIZE, SLAVE_MONITOR_SIZE = 6, 30  #: lengths of the monitor states
# Monitor state of the master.
_master_monitor_slots = slots.SlotAllocator(MASTER_MONITOR_SIZE)
SILENCE_TIME_INDEX = _master_monitor_slots.number()  #: time without packets [s], also at the slave
_WRENCH_LIMITS_SLICE = _master_monitor_slots.vector(2)  # present limits
_LIMIT_FALL_RATES_SLICE = _master_monitor_slots.vector(2)  # their decrease per second
_CONNECTED_TIME = _master_monitor_slots.number()  # time since the last silence
# Monitor state of the slave.
_slave_monitor_slots = slots.SlotAllocator(SLAVE_MONITOR_SIZE, SILENCE_TIME_INDEX + 1)
_STOPPING_TIME_INDEX = _slave_monitor_slots.number()  # time since it began to stop
_RESUMING_TIME_INDEX = _slave_monitor_slots.number()  # time since it began to resume
_STOP_POSE_SLICE = _slave_monitor_slots.vector(7)  # command when it began to stop
_STOP_VELOCITY_SLICE = _slave_monitor_slots.vector(6)  # its velocity
_LAST_COMMAND_SLICE, _EARLIER_COMMAND_SLICE = map(_slave_monitor_slots.vector, (7, 7))


def initial_master_monitor(device_limits: Array | None = None) -> Array:
    """Return the silence monitor's state (6,) of a master that has received no packet.

    With `device_limits` (2,), the largest force and torque [N, N m]: state in normal operation.
    """
    state = np.zeros(MASTER_MONITOR_SIZE)
    if device_limits is None:
        state[SILENCE_TIME_INDEX] = np.inf
    else:
        state[_WRENCH_LIMITS_SLICE] = device_limits
        state[_CONNECTED_TIME] = RESUME_TIME_S
    return state


def initial_slave_monitor(pose: Array) -> Array:
    """Return the silence monitor's state (30,) of a slave at rest at `pose`."""
    state = np.zeros(SLAVE_MONITOR_SIZE)
    state[SILENCE_TIME_INDEX] = np.inf
    state[_STOP_POSE_SLICE] = state[_LAST_COMMAND_SLICE] = state[_EARLIER_COMMAND_SLICE] = pose
    return state


@njit(cache=True)
def _update_silence_time(healthy, fault, T, state):
    if fault:
        state[SILENCE_TIME_INDEX] = np.inf
    else:
        state[SILENCE_TIME_INDEX] = 0.0 if healthy else state[SILENCE_TIME_INDEX] + T


@njit(cache=True)
def master_wrench_limits_into(healthy, fault, T, timeout, device_limits, displayed, state, limits):
    """Write `limits` (2,) of rendered force and torque; during silence they fall to zero.

    `healthy`: a new packet of a healthy sender came. `fault`: an end is not healthy. `timeout` [s]:
    longest time without packets. `displayed` (6,): last displayed wrench. `state` is updated.
    """
    _update_silence_time(healthy, fault, T, state)
    connected = state[SILENCE_TIME_INDEX] <= timeout
    state[_CONNECTED_TIME] = min(state[_CONNECTED_TIME] + T, RESUME_TIME_S) if connected else 0.0
    present, fall = state[_WRENCH_LIMITS_SLICE], state[_LIMIT_FALL_RATES_SLICE]
    for g in range(2):
        size, limit = length_of_group(displayed, g), present[g]
        if connected:
            fall[g] = 0.0
            start = size if state[_CONNECTED_TIME] < RESUME_TIME_S else limit
            limit = min(device_limits[g], start + device_limits[g] * T / RESUME_TIME_S)
        else:
            if fall[g] == 0.0:
                limit = min(limit, size)
                fall[g] = limit / STOP_TIME_S
            limit = max(0.0, limit - fall[g] * T)
        present[g] = limits[g] = limit


@njit(cache=True)
def slave_command_into(healthy, fault, T, timeout, requested, state, command):
    """Write the slave's command X_WS (7,): `requested`, or during silence a braking motion.

    `requested` (7,) is the method's command; for others see `master_wrench_limits_into`.
    """
    _update_silence_time(healthy, fault, T, state)
    last, before = state[_LAST_COMMAND_SLICE], state[_EARLIER_COMMAND_SLICE]
    start, velocity = state[_STOP_POSE_SLICE], state[_STOP_VELOCITY_SLICE]
    step = np.empty(6)
    if state[SILENCE_TIME_INDEX] <= timeout:
        state[_RESUMING_TIME_INDEX] = min(state[_RESUMING_TIME_INDEX] + T, RESUME_TIME_S)
    elif state[_RESUMING_TIME_INDEX] > 0.0:
        fields.pose_difference_into(last, before, velocity)
        for i in range(6):
            velocity[i] /= T
        copy_into(start, 0, last, 0, 7)
        state[_STOPPING_TIME_INDEX] = state[_RESUMING_TIME_INDEX] = 0.0
    if state[_RESUMING_TIME_INDEX] == RESUME_TIME_S:
        copy_into(command, 0, requested, 0, 7)
    else:
        # A blend from the stopping motion to the requested command keeps the velocity continuous
        # even if the end resumes before it has stopped.
        state[_STOPPING_TIME_INDEX] += T
        u = min(state[_STOPPING_TIME_INDEX] / STOP_TIME_S, 1.0)
        for i in range(6):  # velocity falls as 1 - 3 u^2 + 2 u^3
            step[i] = velocity[i] * STOP_TIME_S * u * (1.0 - u * u * (1.0 - 0.5 * u))
        move_pose_into(start, step, command)
        u = state[_RESUMING_TIME_INDEX] / RESUME_TIME_S
        if u > 0.0:
            fields.pose_difference_into(requested, command, step)
            for i in range(6):
                step[i] *= u * u * u * (10.0 + u * (6.0 * u - 15.0))
            move_pose_into(command, step, command)
    copy_into(before, 0, last, 0, 7)
    copy_into(last, 0, command, 0, 7)


@njit(cache=True)
def fade_retreat_wrench(twist, T, p, memory, wrench):
    """Reduce a wrench (6,) that pushes the hand, so that a released stylus stays slow.

    Force and torque fall to 0 at twice the permitted hand speed (parameter `retreat`), but not
    below the slave's mass times the hand's deceleration. `memory` stores the new wrench.
    """
    velocity, rate = memory[slots.FILTERED_HAND_VELOCITY], min(T / _HAND_VELOCITY_FILTER_S, 1.0)
    for i in range(6):
        velocity[i] += rate * (twist[i] - velocity[i])
    for g in range(2):
        size = length_of_group(wrench, g)
        if size > 0.0:
            along = dot_of_group(wrench, velocity, g) / size
            slowing = (along - dot_of_group(wrench, twist, g) / size) / _HAND_VELOCITY_FILTER_S
            fading = 2.0 - along / p[slots.FORCE_FADE_HAND_SPEED][g]
            share = max(fading, p[slots.SLAVE_MASS][g] * slowing / size, 0.0)
            fields.scale_group(wrench, g, min(share, 1.0))
    copy_into(memory, slots.LAST_PORT_WRENCH.start, wrench, 0, 6)
