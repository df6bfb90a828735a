"""The plant's motion in compiled code, for who looks into one of its steps: sensor and servo.

Of arm, tool, balls on boxes and one leaf; `Contact.beyond` says if there is more to touch. A state
is x = [q, the leaf's deflection, v, its rate].
"""

from __future__ import annotations

from drake_teleop._compiled import njit
from drake_teleop.slave.arm import forward_dynamics
from drake_teleop.slave.tool_contact import environment_wrench
from drake_teleop.vectors import put


@njit(cache=True)
def joined(state, sheet, x):
    """x = [q, sheet's deflection, v, its rate] of [q; v] and [deflection, rate]."""
    n = state.shape[0] // 2
    put(x, 0, state, 0, n)
    put(x, n + 1, state, n, n)
    x[n], x[2 * n + 1] = sheet[0], sheet[1]


@njit(cache=True)
def plant_rates(physics, x, tau, applied_W, wrench_W, xdot):
    """Time derivative of x (2 n + 2,), and the environment's wrench.

    Args:
        physics: `SlavePlant.physics`.
        x: see the module.
        tau: (n,) of the motors [N m].
        applied_W, wrench_W: as for `environment_wrench`.
        xdot: (2 n + 2,) filled.
    """
    half = tau.shape[0] + 1
    q, v = x[: half - 1], x[half:-1]
    environment_wrench(physics[0], physics[2], applied_W, q, v, x[half - 1 :: half], wrench_W)
    rates_under(physics, x, tau, applied_W, wrench_W, xdot)


@njit(cache=True)
def rates_under(physics, x, tau, applied_W, wrench_W, xdot):
    """Time derivative of x, see `plant_rates`, under the environment's wrench."""
    arm, _, pairs, leaf = physics
    half = tau.shape[0] + 1
    forward_dynamics(arm, x[: half - 1], x[half:-1], tau, wrench_W, xdot[half:-1])
    put(xdot, 0, x, half, half)
    push = 0.0
    if pairs.shape[0] > 0:  # which all are of one body, the leaf, or of what does not move
        for i in range(3):
            push -= pairs[0, 19 + i] * (wrench_W[i] - applied_W[i])
    xdot[-1] = (push - leaf[1] * x[half - 1] - leaf[2] * x[-1]) / leaf[0] + leaf[3]
