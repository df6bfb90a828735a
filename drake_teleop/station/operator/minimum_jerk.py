"""Minimum-jerk movements of the hand (Hoff and Arbib, J. Motor Behav. 25, 1993).

A plan (20,), part of the operator's memory, has start and duration [s], and for each axis six
coefficients of a quintic in normalised time.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.compiled import njit

PLAN_SLICE = slice(7, 27)  #: place of the plan in the operator's memory
STOP_DURATION_S = 0.15  # s, stopping time of the hand, estimate


@njit(cache=True)
def evaluate_plan(plan, time, axis):
    """Return position [m], speed and acceleration along `axis` of a plan (20,) at `time` [s]."""
    h = plan[1]
    u = min((time - plan[0]) / h, 1.0)
    c = plan[2 + 6 * axis : 8 + 6 * axis]
    x = c[0] + u * (c[1] + u * (c[2] + u * (c[3] + u * (c[4] + u * c[5]))))
    v = c[1] + u * (2 * c[2] + u * (3 * c[3] + u * (4 * c[4] + u * 5 * c[5])))
    a = 2 * c[2] + u * (6 * c[3] + u * (12 * c[4] + u * 20 * c[5]))
    late = time - plan[0] - h
    if late > 0.0:
        return x + v / h * late, v / h, 0.0
    return x, v / h, a / (h * h)


@njit(cache=True)
def add_planned_motion_into(memory, time, pose, twist):
    """Add the plan's motion at `time` [s] to the hand's pose (7,) and twist (6,) in B."""
    for i in range(3):
        x, v, _ = evaluate_plan(memory[PLAN_SLICE], time, i)
        pose[4 + i] += x
        twist[i] += v


@njit(cache=True)
def plan_move(memory, time, duration, displacement, end_velocity):
    """Plan a minimum-jerk motion by `displacement` (3,) [m] in `duration` [s].

    It begins with position, velocity and acceleration of the present plan at `time` [s], and ends
    with the velocity `end_velocity` (3,) [m/s] without acceleration.
    """
    plan, h = memory[PLAN_SLICE], duration
    for i in range(3):
        x, v, a = evaluate_plan(plan, time, i)
        v, a, w, d = v * h, a * h * h, end_velocity[i] * h, displacement[i]
        c = plan[2 + 6 * i : 8 + 6 * i]
        c[0], c[1], c[2] = x, v, 0.5 * a
        c[3] = 10 * d - 6 * v - 4 * w - 1.5 * a
        c[4] = -15 * d + 8 * v + 7 * w + 1.5 * a
        c[5] = 6 * d - 3 * v - 3 * w - 0.5 * a
    plan[0], plan[1] = time, h


@njit(cache=True)
def plan_stop(memory, time):
    """Plan a stop of the hand from `time` [s] within `STOP_DURATION_S`."""
    displacement = np.empty(3)
    for i in range(3):
        displacement[i] = 0.5 * STOP_DURATION_S * evaluate_plan(memory[PLAN_SLICE], time, i)[1]
    plan_move(memory, time, STOP_DURATION_S, displacement, np.zeros(3))
