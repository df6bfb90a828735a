"""Detection of contact or of another load, sample by sample, for `compensate`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.contact import detection
from drake_teleop.load.contact.noise_floor import limit_covariance_to_scales
from drake_teleop.load.identification import Identification
from drake_teleop.load.online import watched
from drake_teleop.load.online.change import change_detector_parameters
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causal import causal_low_pass, low_pass_coefficients
from drake_teleop.logs.processing import phi_with_inertia_replaced
from drake_teleop.robots.compensation_step import low_pass_into
from drake_teleop.robots.replay_log import ReplayLogSource
from drake_teleop.robots.streams import ReadingFlag

RELATIVE_LOAD_WRENCH_ERROR = 0.02
"""Relative error of the load's wrench due to errors of gains and clocks."""
MIN_WRENCH_NOISE_AT_1_KHZ = np.repeat([0.05, 0.0025], 3)
"""Minimum noise of a reading at 1 kHz [N, N m]."""
# Accuracy at which another load would replace the present one.
_MASS_STD_RATIO_TO_NEVER_REPLACE_LOAD = 1e-12
# Equivalent noise bandwidth of the zero-phase low-pass over its cut-off: integral of the gain^2.
_NOISE_BANDWIDTH_TO_CUTOFF = 3.0 * math.pi / (8.0 * math.sqrt(2.0))


def white_wrench_noise(load: Identification, dt: float, cutoff_hz: float | None) -> Array:
    """Return the white wrench noise (6,) [N, N m] before the low-pass of the identification."""
    bandwidth_hz = _NOISE_BANDWIDTH_TO_CUTOFF * (math.inf if cutoff_hz is None else cutoff_hz)
    noise = load.residual_rms / math.sqrt(min(1.0, 2.0 * bandwidth_hz * dt))
    return np.maximum(noise, MIN_WRENCH_NOISE_AT_1_KHZ * math.sqrt(1e-3 / dt))


class ContactAndLoadMonitor:
    """Detector of contact, and of another load than the identified one."""

    def __init__(self, load: Identification, dt: float, cutoff_hz: float | None) -> None:
        noise = white_wrench_noise(load, dt, cutoff_hz)
        # The identified load remains the reference, even if a new one is well known.
        errors = {"relative_wrench_error": RELATIVE_LOAD_WRENCH_ERROR}
        errors["mass_std_ratio"] = _MASS_STD_RATIO_TO_NEVER_REPLACE_LOAD
        self._parameters = change_detector_parameters(noise, np.zeros(9), dt, **errors)
        self._phi = phi_with_inertia_replaced(load)[0]
        self._covariance = limit_covariance_to_scales(self._phi, load.covariance)
        self._fallback, self._dt = np.zeros(10), dt
        self.restart(load.offsets)
        self.reading_flags(np.concatenate([load.offsets, np.zeros(9)]))  # loads compiled code
        self.restart(load.offsets)

    def restart(self, offsets: Array) -> None:
        self._out = np.concatenate([offsets, self._phi])
        self._memory = watched.initial_monitor_memory(self._out, self._covariance)

    def reading_flags(self, values: Array) -> int:
        """Return the `ReadingFlag` bits of a valid reading (15,): contact, another load, or 0."""
        watched.monitor_load(
            self._out, self._memory, values, self._fallback, self._dt, *self._parameters
        )
        state = self._memory[watched.STATE_INDEX]
        if state == watched.STATE_OTHER_LOAD:
            return int(ReadingFlag.OTHER_LOAD)
        return int(ReadingFlag.IN_CONTACT) if state == watched.STATE_DISTURBED else 0


MEAN_WRENCH_TIME_CONSTANT_S = 3.0
"""Time constant of the mean contact wrench outside of contact [s]."""
_GRAVITY_LOW_PASS_CUTOFF_HZ = 0.5
_CONTACT_STATISTIC_NAME = "level"
_RELATIVE_FREE_LOG_RATE_TOLERANCE = 0.05


class StreamContactDetector:
    """Contact detector for wrenches extrapolated by `ahead_s` [s]; `free`: log of free motion."""

    def __init__(
        self,
        load: Identification,
        free: Path,
        dt: float,
        cutoff_hz: float | None,
        delay: str | float = "auto",
        ahead_s: float = 0.0,
    ) -> None:
        if cutoff_hz is None or cutoff_hz >= 0.5 / dt:
            what = f"needs a low-pass below half the stream's rate, {0.5 / dt:g} Hz"
            raise DrakeTeleopError(what, where="--free", remedy="give --cutoff HZ")
        source = ReplayLogSource(free, load, cutoff_hz=cutoff_hz, delay=delay, chunk=10**9)
        self.files = source.files
        if abs(source.dt / dt - 1.0) > _RELATIVE_FREE_LOG_RATE_TOLERANCE:
            what = f"has readings at {1.0 / source.dt:.4g} Hz, but the stream at {1.0 / dt:.4g} Hz"
            remedy = "use the log that `calibrate` wrote from this stream"
            raise DrakeTeleopError(what, where=str(free), remedy=remedy)
        self._fast = low_pass_coefficients(dt, cutoff_hz)
        self._slow = low_pass_coefficients(dt, _GRAVITY_LOW_PASS_CUTOFF_HZ)
        readings = [each for each in source.read(0.0) or () if not each.flags]
        values = np.array([each.values for each in readings]).reshape(-1, 15)
        transient = round(0.5 / (_GRAVITY_LOW_PASS_CUTOFF_HZ * dt))  # of the low-passes
        if len(values) < (required := transient + detection.MIN_NOISE_FLOOR_SAMPLES):
            what = f"has {len(values)} valid readings, too few for a noise floor"
            remedy = f"give a log of free motion with at least {required}"
            raise DrakeTeleopError(what, where=str(free), remedy=remedy)
        phi = phi_with_inertia_replaced(load)[0]
        s, omega, alpha = np.split(values[:, 6:], 3, axis=1)
        contact = values[:, :6] - non_contact_wrench(s, omega, alpha, phi)
        contact -= contact[: round(0.5 / dt)].mean(axis=0)  # as a tare
        contact = causal_low_pass(contact, dt, cutoff_hz, ahead_s)
        fast = causal_low_pass(values[:, 6:], dt, cutoff_hz)
        slow_s = causal_low_pass(values[:, 6:9], dt, _GRAVITY_LOW_PASS_CUTOFF_HZ)
        settled = np.hstack([contact, fast, fast[:, :3] - slow_s])[transient:]
        hold = round(1.0 / (cutoff_hz * dt))
        fade = float(np.exp(-1.0 / hold))
        covariance = limit_covariance_to_scales(phi, load.covariance, tared=True)
        contact, s, omega, alpha, a = np.split(settled, [6, 9, 12, 15], axis=1)
        floor = detection.fit_noise_floor(contact, s, omega, alpha, a, covariance, fade=fade)
        threshold = max(
            detection.NOISE_LEVEL_ONCE_PER_MILLION_SAMPLES, floor.threshold(_CONTACT_STATISTIC_NAME)
        )
        following = dt / MEAN_WRENCH_TIME_CONSTANT_S
        self._settings = detection.ContactDetector(
            floor, threshold, statistic=_CONTACT_STATISTIC_NAME, hold=hold, following=following
        ).settings
        self.restart()
        self.contact_flag(np.zeros(15), np.zeros(6))  # loads compiled code before the first reading
        self.restart()

    def restart(self) -> None:
        self._memory = detection.ContactDetector.initial_memory()
        self._filters = np.full((2, 12), np.nan)

    def contact_flag(self, values: Array, contact_wrench: Array) -> int:
        """Return `ReadingFlag.IN_CONTACT` or 0 for a reading (15,) and its contact wrench (6,)."""
        settings = self._fast, self._slow, self._filters, self._settings
        touched = _filter_and_detect_contact(self._memory, values, contact_wrench, *settings)
        return int(ReadingFlag.IN_CONTACT) if touched else 0


@njit(cache=True)
def _filter_and_detect_contact(memory, values, contact_wrench, fast, slow, filter_states, settings):
    filtered = np.empty(12)
    filtered[:9], filtered[9:] = values[6:], values[6:9]
    low_pass_into(filtered[:9], fast, filter_states[:, :9])
    low_pass_into(filtered[9:], slow, filter_states[:, 9:])
    for i in range(3):
        filtered[9 + i] = filtered[i] - filtered[9 + i]
    motion = filtered[:3], filtered[3:6], filtered[6:9], filtered[9:]
    return detection.update_contact_flag(memory, contact_wrench, *motion, *settings)
