"""Nyquist's criterion for a loop that is known by its frequency response."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.delayed_loop import DelayedLoop, angle_of, gain_crossings
from drake_teleop.lab.analysis.polynomials import Array, roots_of


def encirclements(
    response: ArrayLike,
    *,
    open_loop_poles: int = 0,
    poles_at_origin: int = 0,
    sampled: bool = False,
) -> Array:
    """Return the unstable closed-loop poles (...), from the turns of 1 + L about the origin.

    A continuous response must extend to where |L| < 1 remains, a sampled one to half the sampling
    rate.

    Args:
        response: L at increasing frequencies from near zero, (n, ...).
        open_loop_poles: unstable poles of L.
        poles_at_origin: of L, at s = 0 or z = 1; the contour passes them on the unstable side.

    Raises:
        DrakeTeleopError: the frequencies are too coarse, or end too early.
    """
    difference = 1 + np.asarray(response, dtype=complex)
    steps = np.angle(difference[1:] / difference[:-1])
    if not np.all(np.abs(steps) < np.pi / 2):
        raise DrakeTeleopError(
            "1 + L turns by more than a right angle between two frequencies",
            remedy="take more frequencies there; a loop at its limit cannot be counted",
        )
    if not sampled and not np.all(np.abs(difference[-1] - 1) < 1):
        raise DrakeTeleopError("|L| is not below 1 at the last frequency", remedy="go further up")
    start, end = np.angle(difference[0]), np.angle(difference[-1])
    # At s = 0, or right of poles there, 1 + L is real.
    start_turn = start + poles_at_origin * np.pi / 2
    turn = np.sum(steps, axis=0) + start_turn - np.pi * np.round(start_turn / np.pi)
    turn = turn - poles_at_origin * np.pi / 2
    if not sampled:
        turn = turn - end
    return open_loop_poles - np.round(turn / np.pi)


def nyquist_frequencies(loop: DelayedLoop) -> Array:
    """Return frequencies [rad/s] of a single loop between which 1 + L turns by less than 30 deg."""
    slow, fast = break_frequencies(loop)
    crossing, _ = gain_crossings(loop)
    omega = frequency_grid(loop, slow, float(np.nanmax(1.5 * crossing, initial=fast)))
    for _ in range(40):
        difference = 1 + loop(1j * omega)
        wide = np.abs(angle_of(difference[1:] / difference[:-1])) > np.pi / 6
        if not wide.any():
            return omega
        omega = np.sort(np.concatenate([omega, (omega[1:][wide] + omega[:-1][wide]) / 2]))
    raise DrakeTeleopError("the loop is at its limit: L passes through -1")


def break_frequencies(loop: DelayedLoop) -> tuple[float, float]:
    """Return least and largest magnitude of the poles without delay, except 0."""
    breaks = np.abs(roots_of(loop.denominator))
    breaks = breaks[breaks > 0]
    return float(np.min(breaks, initial=1.0)), float(np.max(breaks, initial=1.0))


def frequency_grid(loop: DelayedLoop, slow: float, top: float) -> Array:
    """Return frequencies up to the top between which L and its delay turn little."""
    step = np.pi / 8 / max(float(loop.delay), 1 / top)
    return np.union1d(np.geomspace(1e-3 * slow, top, 1000), np.arange(step, top, step))
