"""Compiled plant dynamics inside one step, for sensor and servo.

Covers arm, tool, balls on boxes and one leaf (otherwise see `Contact.beyond`). The state is x = [q,
leaf deflection, v, its rate], then the plant's [q; v] if other bodies move.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import put
from drake_teleop.station.slave.arm import forward_dynamics
from drake_teleop.station.slave.tool_contact import environment_wrench


@njit(cache=True)
def assemble_state(state, around, x):
    """Write x from [q; v] and [deflection, rate, the plant's state]."""
    n = state.shape[0] // 2
    put(x, 0, state, 0, n)
    put(x, n + 1, state, n, n)
    x[n], x[2 * n + 1] = around[0], around[1]
    put(x, 2 * n + 2, around, 2, around.shape[0] - 2)


@njit(cache=True)
def plant_rates(physics, x, tau, applied_W, wrench_W, xdot):
    """Write the time derivative xdot (2 n + 2,) and the environment's wrench.

    `physics` is `SlavePlant.physics`, `tau` (n,) the motor torques [N m]; `applied_W` and
    `wrench_W` are those of `environment_wrench`.
    """
    arm, _, pairs, _, joints, told = physics
    half = tau.shape[0] + 1
    q, v, sheet, plant = (
        x[: half - 1],
        x[half : 2 * half - 1],
        x[half - 1 : 2 * half : half],
        x[2 * half :],
    )
    if not _take_given_wrench(told, x, wrench_W):
        environment_wrench(arm, pairs, joints, applied_W, q, v, sheet, plant, wrench_W)
    else:
        applied = np.empty(6)
        environment_wrench(arm, pairs[:0], joints, applied_W, q, v, sheet, plant, applied)
        wrench_W += applied
    rates_under(physics, x, tau, applied_W, wrench_W, xdot)


@njit(cache=True)
def _take_given_wrench(told, x, wrench_W):
    """Copy the next given contact wrench to `wrench_W` and return True; if missing, request it.

    `told` has rows of wrenches (6) after row 0 [number given, number used, x of the request]; it is
    empty if no wrenches are given.
    """
    if told.shape[0] == 0:
        return False
    number = int(told[0, 1])
    told[0, 1] += 1.0
    if number < told[0, 0]:
        put(wrench_W, 0, told[1 + number], 0, 6)
        return True
    if number == told[0, 0]:
        put(told[0], 2, x, 0, x.shape[0])
    return False


@njit(cache=True)
def rates_under(physics, x, tau, applied_W, wrench_W, xdot):
    """Write the time derivative of x under a given environment wrench."""
    arm, _, pairs, leaf, _, _ = physics
    half = tau.shape[0] + 1
    q, v = x[: half - 1], x[half : 2 * half - 1]
    forward_dynamics(arm, q, v, tau, wrench_W, xdot[half:-1])
    put(xdot, 0, x, half, half)
    push = 0.0
    if pairs.shape[0] > 0:  # all belong to the leaf, or none does
        for i in range(3):
            push -= pairs[0, 19 + i] * (wrench_W[i] - applied_W[i])
    xdot[-1] = (push - leaf[1] * x[half - 1] - leaf[2] * x[2 * half - 1]) / leaf[0] + leaf[3]
