"""The watchdogs of both ends: what happens when the other end falls silent, and when it is back.

An end is *silent* when no new packet of a healthy sender has come for the time `timeout`.

* Master. The wrench that the hand feels fades to zero, in 50 ms from where it was. When packets
  come again, the limit of the wrench rises from zero to the device's limit within 0.5 s, so that
  nothing steps.
* Slave. The command comes to rest within 50 ms, and stays. When packets come again, it goes over
  from there to what the newest packet asks for within 0.5 s; what was asked for in between is not
  made up for.

Both begin as if the other end had been silent before.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_teleop.passivity.packet import difference_into, length, moved_into

STOP = 0.05  #: s, in which a silent end comes to rest
RESUME = 0.5  #: s, in which it goes over to normal again

# Watch of the master: time without packets, present limits (2,), what they fall by per second (2,).
_SILENT, _LIMIT, _FALL = 0, 1, 3
MASTER_WATCH = 5
# Watch of the slave: likewise; phase; time in it; command (7,) at its start; velocity (6,) there;
# the last command (7,), the one before (7,).
_PHASE, _TIME, _FROM, _VELOCITY, _LAST, _BEFORE = 1, 2, 3, 10, 16, 23
_FOLLOWING, _STOPPING, _RESUMING = 0.0, 1.0, 2.0
SLAVE_WATCH = 30


def initial_master_watch() -> NDArray[np.float64]:
    """(MASTER_WATCH,) before the first packet."""
    watch = np.zeros(MASTER_WATCH)
    watch[_SILENT] = np.inf
    return watch


def initial_slave_watch(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """(SLAVE_WATCH,) before the first packet: the command rests at `pose` (7,), X_WS."""
    watch = np.zeros(SLAVE_WATCH)
    watch[_SILENT], watch[_PHASE] = np.inf, _STOPPING
    for part in (_FROM, _LAST, _BEFORE):
        watch[part : part + 7] = pose
    return watch


@njit(cache=True)
def master_limits_into(alive, T, timeout, full, held, watch, limits):
    """What the wrench at the hand has to keep at this step.

    Args:
        alive: whether a new packet of a healthy slave came at this step.
        T: time between steps [s].
        timeout: [s].
        full: (2,) the device's limits [N, N m].
        held: (6,) the wrench displayed since the last step [N, N m].
        watch: (MASTER_WATCH,) updated.
        limits: (2,) written [N, N m].
    """
    watch[_SILENT] = 0.0 if alive else watch[_SILENT] + T
    for g in range(2):
        if watch[_SILENT] <= timeout:
            watch[_FALL + g] = 0.0
            watch[_LIMIT + g] = min(full[g], watch[_LIMIT + g] + full[g] * T / RESUME)
        else:
            if watch[_FALL + g] == 0.0:
                watch[_LIMIT + g] = min(watch[_LIMIT + g], length(held, g))
                watch[_FALL + g] = watch[_LIMIT + g] / STOP
            watch[_LIMIT + g] = max(0.0, watch[_LIMIT + g] - watch[_FALL + g] * T)
        limits[g] = watch[_LIMIT + g]


@njit(cache=True)
def slave_command_into(alive, T, timeout, wanted, watch, command):
    """The command that leaves for the slave at this step.

    Args:
        alive: whether a new packet of a healthy master came at this step.
        T, timeout: [s].
        wanted: (7,) X_WS that the method asks for.
        watch: (SLAVE_WATCH,) updated.
        command: (7,) written, X_WS.
    """
    watch[_SILENT] = 0.0 if alive else watch[_SILENT] + T
    last, before = watch[_LAST : _LAST + 7], watch[_BEFORE : _BEFORE + 7]
    start, velocity = watch[_FROM : _FROM + 7], watch[_VELOCITY : _VELOCITY + 6]
    step = np.empty(6)
    silent = watch[_SILENT] > timeout
    if silent != (watch[_PHASE] == _STOPPING):
        watch[_PHASE] = _STOPPING if silent else _RESUMING
        watch[_TIME] = 0.0
        difference_into(last, before, step)
        start[:] = last
        velocity[:] = step / T
    watch[_TIME] += T
    if watch[_PHASE] == _STOPPING:
        u = min(watch[_TIME] / STOP, 1.0)
        for i in range(6):  # velocity falls as 1 - 3 u^2 + 2 u^3
            step[i] = velocity[i] * STOP * u * (1.0 - u * u * (1.0 - 0.5 * u))
        moved_into(start, step, command)
    elif watch[_PHASE] == _RESUMING:
        u = min(watch[_TIME] / RESUME, 1.0)
        share = u * u * u * (10.0 + u * (6.0 * u - 15.0))
        difference_into(wanted, start, step)
        for i in range(6):
            step[i] *= share
        moved_into(start, step, command)
        if u == 1.0:
            watch[_PHASE] = _FOLLOWING
    else:
        command[:] = wanted
    before[:] = last
    last[:] = command
