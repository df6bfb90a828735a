"""Observers of energy: what flowed through a port, from recorded wrenches and poses.

A sampled product of power times T is not the energy of a port. Which pair is depends on the wrench:

- `held`: the wrench of sample k acts until the next one. Its work is f_(k-1) . (x_k - x_(k-1)),
  exactly, whatever the motion does between the samples: the hand's port, and a motor's.
- `backward`: f_k . (x_k - x_(k-1)). This is what a method at the port can know when it chooses f_k,
  so it is the pair in which TDPA and waves are exact.
- `mean`: the mean of both, of second order for a wrench that changes steadily: contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.passivity.memory import LEDGER, LOST, MEMORY, RECEIVED, SENT
from drake_teleop.station.passivity.packet import difference_into, dot

Array = NDArray[np.float64]

#: Pair -> share of f_k; the rest is f_(k-1).
PAIRS = {"held": 0.0, "backward": 1.0, "mean": 0.5}


def port_work(wrench: Array, pose: Array, pair: str = "held") -> Array:
    """Work of a wrench at a port up to each sample, translation and rotation apart.

    Args:
        wrench: (N, 6) [f; tau], in W [N, N m].
        pose: (N, 7) [qw qx qy qz px py pz] of the port, in W, at the same instants.
        pair: one of `PAIRS`.

    Returns:
        (N, 2) sum of f . dx, of tau . log(R_k R_(k-1)^T) [J]; zero at the first sample. At the
        master's port the hand puts in the negative of it, at the slave's port the environment puts
        in this.

    Raises:
        DrakeTeleopError: for a pair that does not exist, or arrays that do not fit.
    """
    if pair not in PAIRS:
        raise DrakeTeleopError(
            f"there is no pair '{pair}'", where="pair", remedy=f"choose one of {', '.join(PAIRS)}"
        )
    wrench, pose = np.ascontiguousarray(wrench, float), np.ascontiguousarray(pose, float)
    if wrench.ndim != 2 or wrench.shape[1] != 6 or pose.shape != (len(wrench), 7):
        raise DrakeTeleopError(
            f"wrench {wrench.shape} and pose {pose.shape} do not fit",
            where="wrench, pose",
            remedy="give (N, 6) and (N, 7)",
        )
    work = np.zeros((len(wrench), 2))
    _work_into(wrench, pose, PAIRS[pair], work)
    return work


@njit(cache=True)
def _work_into(wrench, pose, share, work):
    dx, f = np.zeros(6), np.zeros(6)
    for k in range(1, len(wrench)):
        difference_into(pose[k], pose[k - 1], dx)
        for i in range(6):
            f[i] = wrench[k - 1, i] + share * (wrench[k, i] - wrench[k - 1, i])
        for g in range(2):
            work[k, g] = work[k - 1, g] + dot(f, dx, g)


def created(energy: Array) -> Array:
    """What had been created up to each sample, at the least: max(0, -energy), never falling again.

    Args:
        energy: (N, ...) that was put into something passive with nothing stored at the start [J].
    """
    return np.maximum.accumulate(np.maximum(-np.asarray(energy), 0.0), axis=0)


@dataclass(frozen=True)
class Ledger:
    """What the method at one end of the channel has on its books, each (..., 2) [J].

    Attributes:
        stored: it may still give out.
        received: of the other end's counter.
        sent: its own counter, for the other end.
        lost: it took out of the loop. `tdpa`: work that was withheld, a measure of its activity.
            `two_layer`, `pspm`, `ledger`: what overflowed a store. `wave`: what the matching
            damper took.
    """

    stored: Array
    received: Array
    sent: Array
    lost: Array


def ledger(memory: Array) -> Ledger:
    """The ledger in the memory (..., MEMORY) of an end; zero for methods that keep none."""
    if memory.shape[-1] != MEMORY:
        raise DrakeTeleopError(
            f"memory {memory.shape} is not one", where="memory", remedy=f"give (..., {MEMORY})"
        )
    stored, received, sent, lost = (
        memory[..., places].copy() for places in (LEDGER, RECEIVED, SENT, LOST)
    )
    return Ledger(stored, received, sent, lost)


def in_flight(master: Ledger, slave: Ledger) -> Array:
    """Energy that was sent and has not arrived yet, both ways, (..., 2) [J]."""
    return (master.sent - slave.received) + (slave.sent - master.received)
