"""Motion of the hand by keys and sticks, and its limits, in simulated time."""

from __future__ import annotations

import math
from collections.abc import Mapping

from drake_teleop.live.hand import TARGET_LEAD_TIME_S
from drake_teleop.live.inputs import INPUT_RANGES, INPUT_UNIT_M, INPUT_UNIT_RAD, Inputs

_RATE_INPUT_TIMEOUT_S = 1.0  # s
# Lead time of the target, which compensates the lag of the hand at constant speed [s].
_LEAD_TIMES_S = dict.fromkeys("xyz", TARGET_LEAD_TIME_S) | dict.fromkeys(("rx", "ry", "rz"), 0.0)
# Limits of the tool along each axis [m/s, m/s^2], and about it [rad/s, rad/s^2]. Accelerations are
# limited only for a device; the path of a page's hand is smooth.
_TOOL_TRANSLATION_LIMITS, _TOOL_ROTATION_LIMITS = (0.8, 20.0), (8.0, 250.0)


class InputRateIntegrator:
    """Integrator of the rates of inputs (from keys, sticks) in simulated time."""

    def __init__(self) -> None:
        self._rates: Mapping[str, float] = {}
        self._at: dict[str, float] = {}
        self._end_time = 0.0

    def set_rates(self, rates: Mapping[str, float], inputs: Inputs, now: float) -> Inputs:
        """Set rates by input name [input units/s], 0 after 1 s; return the present inputs."""
        if not self._rates:
            self._at = {name: float(getattr(inputs, name)) for name in _LEAD_TIMES_S}
        self._rates = {name: rate for name, rate in rates.items() if rate and name in _LEAD_TIMES_S}
        self._end_time = now + _RATE_INPUT_TIMEOUT_S
        return inputs.with_changes(self._at)

    def advance_inputs(self, inputs: Inputs, slice_s: float, now: float) -> Inputs:
        if not self._rates:
            return inputs
        if now > self._end_time:
            return self.set_rates({}, inputs, now)
        values = dict(self._at)
        for name, rate in self._rates.items():
            low, high = INPUT_RANGES[name]
            self._at[name] = min(max(self._at[name] + slice_s * rate, low), high)
            values[name] = self._at[name] + _LEAD_TIMES_S[name] * rate
        return inputs.with_changes(values)


class MotionLimiter:
    """Limiter of the target's speed, and for a device also of its acceleration.

    `scales` are the ratios of tool to hand motion, for translation and rotation.
    """

    def __init__(self, slice_s: float, scales: tuple[float, float], *, device: bool) -> None:
        self._axes: dict[str, _AxisMotionLimiter] = {}
        limits = (
            (("x", "y", "z"), INPUT_UNIT_M, _TOOL_TRANSLATION_LIMITS),
            (("rx", "ry", "rz"), INPUT_UNIT_RAD, _TOOL_ROTATION_LIMITS),
        )
        for (names, unit, (speed, acceleration)), scale in zip(limits, scales, strict=True):
            units = slice_s / (unit * max(scale, 1e-3))
            change = slice_s * units * acceleration if device else math.inf
            for name in names:
                self._axes[name] = _AxisMotionLimiter(units * speed, change, INPUT_RANGES[name])

    def limit_inputs(self, inputs: Inputs, *, may_jump: bool) -> Inputs:
        """Return the inputs of the next slice, limited unless the target `may_jump`."""
        axes = self._axes.items()
        return inputs.with_changes(
            {name: axis.limit_target(getattr(inputs, name), may_jump) for name, axis in axes}
        )


class _AxisMotionLimiter:
    def __init__(self, speed: float, change: float, ends: tuple[float, float]) -> None:
        self._speed, self._change, self._ends = speed, change, ends
        self._at = self._target = self._last_change = 0.0

    def limit_target(self, target: float, may_jump: bool) -> float:
        last, self._target = self._target, target
        if may_jump:
            self._at, self._last_change = target, 0.0
            return target
        behind = last - self._at
        speed = target - last + math.copysign(self._max_speed_to_stop_within(abs(behind)), behind)
        least, most = (self._max_speed_to_stop_within(abs(end - self._at)) for end in self._ends)
        speed = min(max(speed, -min(least, self._speed)), min(most, self._speed))
        change = min(max(speed - self._last_change, -self._change), self._change)
        self._last_change += change
        self._at += self._last_change
        return self._at

    def _max_speed_to_stop_within(self, distance: float) -> float:
        if self._change == math.inf:
            return distance
        root = math.sqrt(self._change**2 + 8.0 * self._change * distance)
        return min(distance, 0.5 * (root - self._change))
