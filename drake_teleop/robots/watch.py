"""Detection of contact or of another load, sample by sample: `--watch`.

A lasting push looks like another load only if it turns with the tool.
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
"""Relative error of the load's wrench by gains and clocks."""
MIN_NOISE = np.repeat([0.05, 0.0025], 3)
"""Minimum noise of a reading at 1 kHz [N, N m]."""
_NEVER_REPLACED = 1e-12  # accuracy at which another load would replace the present one
# Equivalent noise bandwidth of the zero-phase low-pass over its cut-off: integral of the gain^2.
_NOISE_BANDWIDTH = 3.0 * math.pi / (8.0 * math.sqrt(2.0))


def raw_noise(load: Identification, dt: float, cutoff_hz: float | None) -> Array:
    """Return the noise (6,) of a reading [N, N m] from the low-passed residual, assumed white."""
    share = 1.0 if cutoff_hz is None else min(1.0, 2.0 * _NOISE_BANDWIDTH * cutoff_hz * dt)
    return np.maximum(load.residual_rms / math.sqrt(share), MIN_NOISE * math.sqrt(1e-3 / dt))


class Watch:
    """Detection for `Compensator`; the residual of `load` was low-passed at `cutoff_hz`."""

    def __init__(self, load: Identification, dt: float, cutoff_hz: float | None) -> None:
        noise = raw_noise(load, dt, cutoff_hz)
        # The identified load remains the reference, even if a new one is well known.
        self._parameters = change_parameters(
            noise, np.zeros(9), dt, model_error=MODEL_ERROR, bound=_NEVER_REPLACED
        )
        self._phi = usable_phi(load)[0]
        self._covariance = finite_covariance(self._phi, load.covariance)
        self._fallback, self._dt = np.zeros(10), dt
        self.restart(load.offsets)
        self.flags(np.concatenate([load.offsets, np.zeros(9)]))  # loads compiled code
        self.restart(load.offsets)

    def restart(self, offsets: Array) -> None:
        """Reset all but the identified load."""
        self._out = np.concatenate([offsets, self._phi])
        self._memory = watched_memory(self._out, self._covariance)

    def flags(self, values: Array) -> int:
        """Return the flags of a good reading (15,)."""
        watched_update(self._out, self._memory, values, self._fallback, self._dt, *self._parameters)
        state = watched_state(self._memory)
        if state == OTHER_LOAD:
            return int(Flag.OTHER_LOAD)
        return int(Flag.IN_CONTACT) if state == DISTURBED else 0
