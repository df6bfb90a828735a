"""When was something touched? A threshold on the contact wrench, from its own noise floor.

The threshold of 5.5 noise floors is one for false alarms: noise that passed the low-pass crosses a
level u (in standard deviations) about nu exp(-u^2 / 2) times a second in each direction, nu being
two thirds of the cut-off (Rice, Bell System Technical Journal 24, 1945). Six channels at 30 Hz make
that 0.2 an hour. In eight simulated hours each of white noise and of noise with a memory of 20 ms,
0.2 s and 2 s there were 2, 0, 0 and 0; at 5 noise floors 2.5, 1.5, 0.6 and 0.3 an hour. Below one
an hour holds for normal noise only: errors of the motion or of the load that grow with the motion
are no such noise, and may be taken for contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ENTER, LEAVE = 5.5, 4.0
"""Noise floors in some channel from which on there is contact, and under which it may end."""

# A noise floor below this counts as this [N, N m]: residuals of a simulation without noise are
# rounding, and so are contacts of their size.
_RESOLUTION = np.repeat([1e-3, 1e-4], 3)
_QUIET = 4.0


@dataclass(frozen=True)
class Contact:
    """One touch.

    Args:
        start_s, stop_s: first and last instant above the thresholds, in the time of the log [s].
        peak_force: largest |F_c| in between [N].
        peak_torque: largest |tau_c| in between [N m].
    """

    start_s: float
    stop_s: float
    peak_force: float
    peak_torque: float


def noise_floor(contact: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of the contact wrench where nothing is touched.

    Starts from the width of the shortest interval that holds half of a channel's samples (for
    normal noise 1.349 standard deviations), so that contact in less than half of a record does
    not raise it, then takes the root mean square of the quiet samples, those within 4 of it in
    every channel, until that no longer changes.

    Args:
        contact: (N, 6) contact wrench with its offsets removed [N, N m].

    Returns:
        (6,) [N, N m].
    """
    ordered = np.sort(contact, axis=0)
    half = len(ordered) // 2
    floor = (ordered[half:] - ordered[: len(ordered) - half]).min(axis=0) / 1.349
    quiet = np.zeros(len(contact), bool)
    for _ in range(50):
        before = quiet
        quiet = (np.abs(contact) <= _QUIET * np.maximum(floor, _RESOLUTION)).all(axis=1)
        if np.array_equal(before, quiet) or not quiet.any():
            break
        floor = np.sqrt(np.mean(contact[quiet] ** 2, axis=0))
    return np.maximum(floor, _RESOLUTION)


def in_contact(
    contact: NDArray[np.float64], floor: NDArray[np.float64], hold: int
) -> NDArray[np.bool_]:
    """Threshold with hysteresis: contact starts where some channel exceeds `ENTER` noise floors.

    It ends at the last sample above `LEAVE` noise floors that is followed by more than `hold`
    samples below them; a contact force that changes its sign would otherwise end in between. What
    rises slowly has its start where it is noticed, not where it left the floor, as in a loop. The
    first and the last `hold` samples are not judged.

    Args:
        contact: (N, 6).
        floor: (6,) of `noise_floor`.
        hold: samples.

    Returns:
        (N,) whether there is contact.
    """
    level = (np.abs(contact) / floor).max(axis=1)
    # At its ends the zero-phase low-pass passes the noise as it is.
    level[:hold], level[len(level) - hold :] = 0.0, 0.0
    touched = np.zeros(len(level), bool)
    start, last = -1, -1
    for i in map(int, np.flatnonzero(level >= LEAVE)):
        if start >= 0 and i - last > hold + 1:
            touched[start : last + 1] = True
            start = -1
        if start < 0 and level[i] >= ENTER:
            start = i
        last = i
    if start >= 0:
        touched[start : last + 1] = True
    return touched


def contacts_of(
    t: NDArray[np.float64], contact: NDArray[np.float64], touched: NDArray[np.bool_]
) -> list[Contact]:
    """The touches in (N,) times, (N, 6) wrenches and the flags of `in_contact`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], touched, [False]])))
    return [
        Contact(
            float(t[a]),
            float(t[b - 1]),
            float(np.linalg.norm(contact[a:b, :3], axis=1).max()),
            float(np.linalg.norm(contact[a:b, 3:], axis=1).max()),
        )
        for a, b in edges.reshape(-1, 2)
    ]
