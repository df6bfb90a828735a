"""Whether something is touched, or another load hangs there, sample by sample: `--watch`.

`load.online.watched` beside the loop: it sees every reading that can be trusted and says what of
the wrench the known load does not explain. What comes out of `compensate` stays as it is; two flags
say what it is:

* IN_CONTACT: something is touched, or it is the moment of a grasp;
* OTHER_LOAD: another load than the known one, shown by a motion; what comes out is then not the
  contact alone, until `calibrate` has found the new one. A push that lasts while the tool turns
  looks likewise only if it turns with it.

The noise of a reading is not known, but what the identification left behind its low-pass is: it is
taken for white, and for no less than `LEAST`. Gains, and clocks that are not quite aligned, make
`MODEL_ERROR` of the load's wrench.
"""

from __future__ import annotations

import math

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.load.contact.noise_floor import finite_covariance
from drake_teleop.load.identification import Identification
from drake_teleop.load.online.change import change_parameters
from drake_teleop.load.online.watched import (
    DISTURBED,
    OTHER_LOAD,
    watched_memory,
    watched_state,
    watched_update,
)
from drake_teleop.logs.processing import usable_phi
from drake_teleop.robots.streams import Flag

MODEL_ERROR = 0.02
"""Share of the load's wrench that may be wrong by gains and times."""
LEAST = np.repeat([0.05, 0.0025], 3)
"""Noise of a reading at 1 kHz is at least that [N, N m]."""
_NEVER = 1e-12  # accuracy at which another load would count as the known one
# Equivalent noise bandwidth of the zero-phase low-pass over its cut-off: integral of the gain^2.
_BANDWIDTH = 3.0 * math.pi / (8.0 * math.sqrt(2.0))


def raw_noise(load: Identification, dt: float, cutoff_hz: float | None) -> Array:
    """(6,) noise of a reading [N, N m], from what was left behind a low-pass, taken for white.

    Args:
        load: tells what was left.
        dt: between readings [s].
        cutoff_hz: of the low-pass; None for none.
    """
    share = 1.0 if cutoff_hz is None else min(1.0, 2.0 * _BANDWIDTH * cutoff_hz * dt)
    return np.maximum(load.residual_rms / math.sqrt(share), LEAST * math.sqrt(1e-3 / dt))


class Watch:
    """What `Compensator` asks of each good reading.

    Args:
        load: that hangs there at the start.
        dt: between readings [s].
        cutoff_hz: of the low-pass that its residual was seen behind.
    """

    def __init__(self, load: Identification, dt: float, cutoff_hz: float | None) -> None:
        noise = raw_noise(load, dt, cutoff_hz)
        # The known load stays what is eliminated, however well a new one is known.
        self._parameters = change_parameters(
            noise, np.zeros(9), dt, model_error=MODEL_ERROR, bound=_NEVER
        )
        self._phi = usable_phi(load)[0]
        self._covariance = finite_covariance(self._phi, load.covariance)
        self._fallback, self._dt = np.zeros(10), dt
        self.restart(load.offsets)
        self.flags(np.concatenate([load.offsets, np.zeros(9)]))  # what is compiled is loaded now
        self.restart(load.offsets)

    def restart(self, offsets: Array) -> None:
        """Forgets all but the known load, with these offsets (6,)."""
        self._out = np.concatenate([offsets, self._phi])
        self._memory = watched_memory(self._out, self._covariance)

    def flags(self, values: Array) -> int:
        """Takes a good reading (15,)."""
        watched_update(self._out, self._memory, values, self._fallback, self._dt, *self._parameters)
        state = watched_state(self._memory)
        if state == OTHER_LOAD:
            return int(Flag.OTHER_LOAD)
        return int(Flag.IN_CONTACT) if state == DISTURBED else 0
