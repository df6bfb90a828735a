"""The safe state of both ends: what happens in silence and with faulty data, and when it is over.

An end is *silent* when no new packet of a healthy sender has come for the time `timeout`. It is so
at once when its own data are not finite, or when the newest packet says so of the sender's; what is
beyond 1e6 in SI units counts as not finite. Without a channel the force display alone keeps the
watch of the master.

* Master. The wrench that the hand feels fades to zero, in 50 ms from where it was. When packets
  come again, for 0.5 s the wrench grows at most at the rate that would take it to the device's
  limit in 0.5 s, so that nothing steps even if packets are missing again; from then on its limit
  rises at that rate, whatever the wrench does.
* Slave. The command comes to rest within 50 ms, and stays. When packets come again, it goes over
  from there to what the newest packet asks for within 0.5 s; what was asked for in between is not
  made up for.

Both begin as if the other end had been silent before.

==============================  ==============================  ==============================
cause                           master                          slave
==============================  ==============================  ==============================
nothing comes from the slave    fades after `timeout`           goes on
nothing comes from the master   goes on                         stops after `timeout`
pose or wrench of the hand      fades at once; the hand is      stops as soon as it is told
not finite                      taken to rest where it was
pose or wrench of the slave     fades as soon as it is told     stops at once; the last good
not finite                                                      pose and wrench are kept
wrist sensor saturated          goes on                         goes on; the last good wrench
                                                                is kept
a tank is empty                 the wrench is shortened to      the servo's spring is
                                what can be paid for            shortened likewise
wrench beyond the device        shortened to its limit          goes on
==============================  ==============================  ==============================

A saturated sensor stops nothing, because only the hand can lead the slave out of it, and what the
hand feels meanwhile pushes it that way. A wrench that was kept goes over to the measured one within
50 ms. While a pose is unknown no work is counted at its port.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import put
from drake_teleop.station.passivity.memory import Slots
from drake_teleop.station.passivity.packet import difference_into, length, moved_into

STOP = 0.05  #: s, in which a silent end comes to rest
RESUME = 0.5  #: s, in which it goes over to normal again

MASTER_WATCH, SLAVE_WATCH = 6, 30  #: their lengths
# Watch of the master.
_places = Slots(MASTER_WATCH)
SILENT = _places.number()  #: time without packets [s], of the slave's watch too
_LIMIT = _places.vector(2)  # present limits
_FALL = _places.vector(2)  # what they fall by per second
_HEARD = _places.number()  # time since the last silence
# Watch of the slave.
_places = Slots(SLAVE_WATCH, SILENT + 1)
_STOPPING = _places.number()  # time since it began to stop
_RESUMING = _places.number()  # time since it began to resume
_FROM = _places.vector(7)  # command when it began to stop
_VELOCITY = _places.vector(6)  # velocity there
_LAST, _BEFORE = _places.vector(7), _places.vector(7)  # the last command, the one before


def initial_master_watch(full: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """(MASTER_WATCH,) before the first packet; or, with the limits `full` (2,), in normal state."""
    watch = np.zeros(MASTER_WATCH)
    if full is None:
        watch[SILENT] = np.inf
    else:
        watch[_LIMIT], watch[_HEARD] = full, RESUME
    return watch


def initial_slave_watch(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """(SLAVE_WATCH,) before the first packet: the command rests at `pose` (7,), X_WS."""
    watch = np.zeros(SLAVE_WATCH)
    watch[SILENT] = np.inf
    for part in (_FROM, _LAST, _BEFORE):
        watch[part] = pose
    return watch


@njit(cache=True)
def _listen(alive, fault, T, watch):
    """Counts for how long nothing was heard."""
    if fault:
        watch[SILENT] = np.inf
    else:
        watch[SILENT] = 0.0 if alive else watch[SILENT] + T


@njit(cache=True)
def master_limits_into(alive, fault, T, timeout, full, held, watch, limits):
    """What the wrench at the hand has to keep at this step.

    Args:
        alive: whether a new packet of a healthy slave came at this step.
        fault: whether the hand's data are not finite, or a new packet says so of the slave's.
        T: time between steps [s].
        timeout: [s].
        full: (2,) the device's limits [N, N m].
        held: (6,) the wrench displayed since the last step [N, N m].
        watch: (MASTER_WATCH,) updated.
        limits: (2,) written [N, N m].
    """
    _listen(alive, fault, T, watch)
    heard = watch[SILENT] <= timeout
    watch[_HEARD] = min(watch[_HEARD] + T, RESUME) if heard else 0.0
    present, fall = watch[_LIMIT], watch[_FALL]
    for g in range(2):
        size, limit = length(held, g), present[g]
        if heard:
            fall[g] = 0.0
            start = size if watch[_HEARD] < RESUME else limit
            limit = min(full[g], start + full[g] * T / RESUME)
        else:
            if fall[g] == 0.0:
                limit = min(limit, size)
                fall[g] = limit / STOP
            limit = max(0.0, limit - fall[g] * T)
        present[g] = limits[g] = limit


@njit(cache=True)
def slave_command_into(alive, fault, T, timeout, wanted, watch, command):
    """The command that leaves for the slave at this step.

    Args:
        alive: whether a new packet of a healthy master came at this step.
        fault: whether the slave's data are not finite, or a new packet says so of the hand's.
        T, timeout: [s].
        wanted: (7,) X_WS that the method asks for.
        watch: (SLAVE_WATCH,) updated.
        command: (7,) written, X_WS.
    """
    _listen(alive, fault, T, watch)
    last, before = watch[_LAST], watch[_BEFORE]
    start, velocity = watch[_FROM], watch[_VELOCITY]
    step = np.empty(6)
    if watch[SILENT] <= timeout:
        watch[_RESUMING] = min(watch[_RESUMING] + T, RESUME)
    elif watch[_RESUMING] > 0.0:
        difference_into(last, before, velocity)
        for i in range(6):
            velocity[i] /= T
        put(start, 0, last, 0, 7)
        watch[_STOPPING] = watch[_RESUMING] = 0.0
    if watch[_RESUMING] == RESUME:
        put(command, 0, wanted, 0, 7)
    else:
        # Where it stops or has stopped; and from there, with a share that rises smoothly from 0 to
        # 1, to what is wanted. So velocity is continuous even if it resumes before it has stopped.
        watch[_STOPPING] += T
        u = min(watch[_STOPPING] / STOP, 1.0)
        for i in range(6):  # velocity falls as 1 - 3 u^2 + 2 u^3
            step[i] = velocity[i] * STOP * u * (1.0 - u * u * (1.0 - 0.5 * u))
        moved_into(start, step, command)
        u = watch[_RESUMING] / RESUME
        if u > 0.0:
            difference_into(wanted, command, step)
            for i in range(6):
                step[i] *= u * u * u * (10.0 + u * (6.0 * u - 15.0))
            moved_into(command, step, command)
    put(before, 0, last, 0, 7)
    put(last, 0, command, 0, 7)
