"""Contact wrench of each reading; a flagged zero wrench for each invalid reading.

Results are bit-equal to `eliminate --causal`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load.compensation import unknown_gravity_error
from drake_teleop.load.identification import Identification
from drake_teleop.logs import processing
from drake_teleop.logs.causal import low_pass_coefficients, low_pass_delay_s
from drake_teleop.robots import compensation_step as kernel
from drake_teleop.robots.streams import (
    NONZERO_WRENCH_FLAGS,
    NUM_READING_VALUES,
    CompensatedWrench,
    Reading,
    ReadingFlag,
)
from drake_teleop.robots.watch import ContactAndLoadMonitor, StreamContactDetector

STALE_AGE_S, _STALE_PERIODS = 0.05, 1.5
"""Age of a stale reading, whose output wrench is zero: minimum [s], and in periods."""
MIN_CLOCK_JUMP_S = 1.0
"""Larger steps between two clocks indicate a clock that was set [s]."""
MAX_CLOCK_DRIFT = 1e-3
"""Maximum relative drift of two clocks [s/s]."""
RELATIVE_RATE_TOLERANCE = 0.05
"""Tolerated relative error of the rate, over `_RATE_CHECK_READINGS` and `_RATE_CHECK_S`."""
TARE_AVERAGING_S = 0.5
"""Time at rest that a tare averages [s]."""
SCALE_NAMES = ("sigma", "gamma", "sigma_weight", "sigma_inertia")
"""Arguments of `Compensator.set_scales`."""
_MAX_FORCE_TORQUE_OFFSET_DRIFT = kernel.MAX_FORCE_OFFSET_DRIFT_N, kernel.MAX_TORQUE_OFFSET_DRIFT_NM
MAX_SENSOR_OFFSET_DRIFT = np.repeat(_MAX_FORCE_TORQUE_OFFSET_DRIFT, 3)
"""Maximum drift of the offsets [N, N m]."""
_RATE_CHECK_READINGS, _RATE_CHECK_S = 200, 0.4  # readings, and [s]; longer than a burst of packets
_MAX_TIME_STAMP_S = 1e12  # [s]
_ZERO_GRAVITY = np.zeros(3)
_MAX_ABS_READING_VALUES_SI = np.repeat([1e5, 1e4, 1e4, 1e3, 1e6], 3)
# Integers, because each operation on a `ReadingFlag` takes a microsecond.
_DAMAGED_FLAG = int(ReadingFlag.DAMAGED)
_STALE_FLAG = int(ReadingFlag.STALE)
_CLIPPED_FLAG = int(ReadingFlag.CLIPPED)
_FLAGS_WITH_NONZERO_OUTPUT_WRENCH = int(NONZERO_WRENCH_FLAGS)
_INTERPOLATED_GAP_FLAG = int(ReadingFlag.GAP)
_WRONG_RATE_FLAG = int(ReadingFlag.WRONG_RATE)
_IN_CONTACT_FLAG = int(ReadingFlag.IN_CONTACT)
_FLAG_OF_READING_PROBLEM = {
    kernel.VALUE_NOT_FINITE: ReadingFlag.NOT_FINITE,
    kernel.VALUE_TOO_LARGE: ReadingFlag.OUT_OF_RANGE,
    kernel.VALUE_AT_RANGE: ReadingFlag.SATURATED,
}
# Maximum rms of the wrench at rest, as a multiple of the residual of the identification, and at
# least [N, N m].
_MAX_REST_WRENCH_RMS_OVER_RESIDUAL, _MIN_REST_WRENCH_RMS_LIMIT = 4.0, np.repeat([0.1, 0.005], 3)


class _ReadingRateCheck:
    def __init__(self, dt: float) -> None:
        self._dt, self._readings = dt, max(_RATE_CHECK_READINGS, round(_RATE_CHECK_S / dt))
        self._start_t, self._start_number = 0.0, 0
        self.reset()

    def reset(self) -> None:
        self._count, self._flag = 0, 0

    def wrong_rate_flag(self, reading: Reading) -> int:
        if self._count == 0:
            self._start_t, self._start_number = reading.t, reading.number
        self._count += 1
        if self._count > self._readings:
            spacing = (reading.t - self._start_t) / max(1, reading.number - self._start_number)
            wrong = abs(spacing / self._dt - 1.0) > RELATIVE_RATE_TOLERANCE
            self._flag, self._count = _WRONG_RATE_FLAG if wrong else 0, 0
        return self._flag


class Compensator:
    """Converter of readings to contact wrenches and scaled wrenches.

    Args:
        delay_readings: delay of the motion, removed by the source; delays outputs [readings].
        predicted: extrapolate over `delay_readings` and the delay of the low-pass.
        sensor_range: (6,) range of the sensor [N, N m].
        scales: arguments of `set_scales`.
    """

    def __init__(
        self,
        load: Identification,
        dt: float,
        *,
        cutoff_hz: float | None = 30.0,
        delay_readings: int = 0,
        predicted: bool = False,
        sensor_range: Array | None = None,
        watch: ContactAndLoadMonitor | None = None,
        detector: StreamContactDetector | None = None,
        **scales: Any,
    ) -> None:
        self.load = load
        self._phi, self._zero_phi = processing.phi_with_inertia_replaced(load)[0], np.zeros(10)
        self._weight_removed, self._dt = load.weight_removed, dt
        self.stale_age_s = max(STALE_AGE_S, _STALE_PERIODS * dt)
        self._scales, self._is_gravity_known = np.empty(4), True
        self.set_scales(**scales)
        self.offsets = load.offsets.copy()
        self.lag_s = delay_readings * dt + low_pass_delay_s(dt, cutoff_hz)
        self._watch, self._detector = watch, detector
        ahead = self.lag_s if predicted else 0.0
        self._low_pass = low_pass_coefficients(dt, cutoff_hz, ahead)
        self._range = np.full(6, np.inf) if sensor_range is None else np.array(sensor_range, float)
        self._largest = _MAX_ABS_READING_VALUES_SI.copy()
        self._largest[:6] = np.minimum(self._largest[:6], 2.0 * self._range)
        noise_limit = _MAX_REST_WRENCH_RMS_OVER_RESIDUAL * load.residual_rms
        self._noise_limit = np.maximum(noise_limit, _MIN_REST_WRENCH_RMS_LIMIT)
        self._memory = np.full((2, 12), np.nan)
        self._delay_line: deque[Array] = deque(maxlen=delay_readings + 1)
        self._number, self._t, self._now = -1, 0.0, -math.inf
        self._min_offset = math.inf  # least (now - t)
        self._last_in_time = -math.inf  # arrival of the last reading in time
        self._rate = _ReadingRateCheck(dt)
        self._tare_rows = np.zeros((max(2, round(TARE_AVERAGING_S / dt)), NUM_READING_VALUES + 6))
        self.good_readings_in_row = 0
        # Load compiled code now; otherwise the first readings would be stale.
        values = np.zeros(NUM_READING_VALUES)
        kernel.reading_problem(values, self._largest, self._range)
        kernel.clip_wrenches(self._contact_and_scaled_wrench(values, _ZERO_GRAVITY), self._range)
        self._check_tare_and_calc_new_offsets()
        self._reset_filters()
        self.good_readings_in_row = 0

    @property
    def c_settings(self) -> dict[str, Any]:
        """Values of `wrench_compensator_settings` of the exported C code, by name."""
        low_pass = self._low_pass if len(self._low_pass) else np.zeros(7)
        return {
            "phi": self._phi,
            "offsets": self.offsets,
            "low_pass": low_pass,
            "low_pass_count": len(self._low_pass),
            "range": np.minimum(self._range, np.finfo(float).max),
            "largest": self._largest,
            "noise_limits": self._noise_limit,
            # Readings after which more than `stale_age_s` has passed, by the tolerance of rounding.
            "stale_steps": math.floor(self.stale_age_s / self._dt + 1e-9) - 1,
            "tare_steps": len(self._tare_rows),
        }

    def set_scales(
        self,
        sigma: float = 0.0,
        gamma: float = 1.0,
        sigma_weight: float | None = None,
        sigma_inertia: float | None = None,
    ) -> None:
        """Set the scales of load (`sigma`) and contact wrench (`gamma`) in the scaled wrench.

        `sigma_weight` and `sigma_inertia` replace sigma for the load's weight and inertia.
        """
        weight = sigma if sigma_weight is None else sigma_weight
        inertia = sigma if sigma_inertia is None else sigma_inertia
        if weight != inertia:
            self._require_known_weight_and_gravity()
        kernel.set_scale_factors_into(float(weight), float(inertia), float(gamma), self._scales)

    def _require_known_weight_and_gravity(self) -> None:
        if self._weight_removed:
            raise processing.useless_weight_scale_error("load")
        if not self._is_gravity_known:
            remedy = "use a source with poses or joint positions, or sigma alone"
            raise unknown_gravity_error("gravity in the sensor frame", remedy)

    def step(self, reading: Reading, now: float) -> CompensatedWrench:
        """Return the output for a reading received at `now` [s] of a monotonic clock."""
        flags = self._check_reading_and_update_clock(reading, now)
        invalid = flags & ~_FLAGS_WITH_NONZERO_OUTPUT_WRENCH
        if invalid & ~_INTERPOLATED_GAP_FLAG:
            return self._make_zero_wrench(flags)
        if now - self._now > self.stale_age_s:
            self._reset_filters()
        self._now, self._number, self._t = now, reading.number, reading.t
        self._delay_line.append(self._contact_and_scaled_wrench(reading.values, reading.gravity))
        if invalid:
            return self._make_zero_wrench(flags)
        if self._watch is not None:
            flags |= self._watch.reading_flags(reading.values)
        if self._detector is not None:
            flags &= ~_IN_CONTACT_FLAG
            flags |= self._detector.contact_flag(reading.values, self._delay_line[-1][:6])
        wrench = self._delay_line[0].copy()
        if kernel.clip_wrenches(wrench, self._range):
            flags |= _CLIPPED_FLAG
        number = max(0, reading.number)
        return CompensatedWrench(number, reading.t, wrench[:6], wrench[6:], flags)

    def stale_output(self, now: float) -> CompensatedWrench | None:
        """Return a zero wrench, flagged as stale, after `stale_age_s` of silence; else None."""
        stale = now - self._now > self.stale_age_s
        return self._make_zero_wrench(_STALE_FLAG) if stale else None

    def time_to_stale(self, now: float) -> float:
        return max(0.0, self._now + self.stale_age_s - now)

    def tare(self) -> str:
        """Add the mean contact wrench to the offsets, or refuse; return the result as text."""
        if self.good_readings_in_row < len(self._tare_rows):
            return f"refused: fewer than {TARE_AVERAGING_S:g} s of valid readings so far"
        problem, step, offsets = self._check_tare_and_calc_new_offsets()
        if problem == kernel.TARE_IN_MOTION:
            return "refused: the sensor moves"
        if problem == kernel.TARE_WRENCH_VARIES:
            return "refused: the wrench varies, as in contact"
        if problem == kernel.TARE_EXCEEDS_DRIFT:
            force, torque = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
            return (
                f"refused: {force:.3g} N and {torque:.3g} N m exceed the permitted drift:"
                " contact, or another load"
            )
        self.offsets = offsets
        if self._watch is not None:
            self._watch.restart(self.offsets)
        if self._detector is not None:
            self._detector.restart()
        self.good_readings_in_row = 0
        return "done: offsets moved by " + " ".join(f"{x:+.3g}" for x in step)

    def _check_tare_and_calc_new_offsets(self) -> tuple[int, Array, Array]:
        (mean, squares), offsets = np.zeros((2, NUM_READING_VALUES + 6)), self.offsets.copy()
        for number, row in enumerate(self._tare_rows, 1):
            kernel.add_to_statistics(row, float(number), mean, squares)
        count = float(len(self._tare_rows))
        problem = kernel.update_tare_offsets(count, mean, squares, self._noise_limit, offsets)
        return problem, mean[NUM_READING_VALUES:], offsets

    def _check_reading_and_update_clock(self, reading: Reading, now: float) -> int:
        flags = reading.flags
        if flags & _DAMAGED_FLAG:
            return _DAMAGED_FLAG
        problem = kernel.reading_problem(reading.values, self._largest, self._range)
        if not math.isfinite(reading.t):
            problem = kernel.VALUE_NOT_FINITE
        elif abs(reading.t) > _MAX_TIME_STAMP_S and problem != kernel.VALUE_NOT_FINITE:
            problem = kernel.VALUE_TOO_LARGE
        if problem:
            flags |= int(_FLAG_OF_READING_PROBLEM[problem])
        if problem in (kernel.VALUE_NOT_FINITE, kernel.VALUE_TOO_LARGE):
            return flags
        ahead = now - reading.t
        started = not math.isinf(self._min_offset)
        step = reading.t - self._t
        # Out-of-order readings are mixed with ordered ones; only such readings mean a restart.
        lost = now - self._now > self.stale_age_s
        if started and reading.number <= self._number and (abs(step) > MIN_CLOCK_JUMP_S or lost):
            return self._reset_clock_to_reading(reading, ahead, flags | int(ReadingFlag.RESTART))
        if started and (abs(ahead - self._min_offset) > MIN_CLOCK_JUMP_S or (step <= 0.0 and lost)):
            return self._reset_clock_to_reading(reading, ahead, flags | int(ReadingFlag.CLOCK_JUMP))
        if started and step <= 0.0:
            return flags | int(ReadingFlag.REORDERED)
        if started and reading.number <= self._number:
            return self._reset_clock_to_reading(reading, ahead, flags | int(ReadingFlag.RESTART))
        drift = MAX_CLOCK_DRIFT * self._dt if started else 0.0
        self._min_offset = min(ahead, self._min_offset + drift)
        if ahead - self._min_offset <= STALE_AGE_S:
            self._last_in_time = now
        elif now - self._last_in_time > MIN_CLOCK_JUMP_S:
            return self._reset_clock_to_reading(reading, ahead, flags | int(ReadingFlag.CLOCK_JUMP))
        else:
            flags |= _STALE_FLAG
        return flags | self._rate.wrong_rate_flag(reading)

    def _reset_clock_to_reading(self, reading: Reading, offset_s: float, flags: int) -> int:
        self._min_offset, self._number, self._t = offset_s, reading.number, reading.t
        self._rate.reset()
        self.good_readings_in_row = 0
        self._now = self._last_in_time = reading.t + offset_s
        self._reset_filters()
        return flags

    def _reset_filters(self) -> None:
        self._memory[:] = np.nan
        if self._detector is not None:
            self._detector.restart()
        self._delay_line.clear()

    def _contact_and_scaled_wrench(self, values: Array, gravity: Array | None) -> Array:
        self._is_gravity_known = gravity is not None
        if self._scales[3] != 0.0:
            self._require_known_weight_and_gravity()
        gravity = _ZERO_GRAVITY if gravity is None else gravity
        out = np.empty(12)
        at = self.good_readings_in_row % len(self._tare_rows)
        load = self.offsets, self._phi, self._zero_phi, self._scales
        filters = self._low_pass, self._memory, self._tare_rows
        kernel.contact_and_scaled_wrench_into(values, gravity, *load, *filters, at, out)
        self.good_readings_in_row += 1
        return out

    def _make_zero_wrench(self, flags: int) -> CompensatedWrench:
        self.good_readings_in_row, number = 0, max(0, self._number)
        return CompensatedWrench(number, self._t, np.zeros(6), np.zeros(6), int(flags))
