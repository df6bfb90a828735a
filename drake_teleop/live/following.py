"""Inputs in simulated time: how fast keys and sticks move the hand, and how fast it may move.

At 1/10 of real time a hand that moves by 0.3 m/s moves the simulated stylus by 3 m/s. Without a
limit that saturates the wrist sensor, and forces are rendered where nothing is touched. A motion
within the limits passes unchanged and without delay.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from drake_teleop.live.hand import BEHIND
from drake_teleop.live.inputs import ANGLE, LENGTH, RANGES, Inputs

_REPEATED = 1.0  # s
# The target is ahead of what moves evenly: the hand neither hangs back nor goes on after it [s].
_LEAD = dict.fromkeys(("x", "y", "z"), BEHIND) | dict.fromkeys(("rx", "ry", "rz"), 0.0)
# Of the tool along each axis [m/s, m/s^2], and about it [rad/s, rad/s^2]. The stylus of a page has
# a smooth path to each target already; the position of a device is the path.
_PLACE, _TURN = (0.8, 20.0), (8.0, 250.0)


class Steering:
    """Moves the target at rates, of keys and sticks, per simulated second."""

    def __init__(self) -> None:
        self._rates: Mapping[str, float] = {}
        self._at: dict[str, float] = {}
        self._until = 0.0

    def begin(self, rates: Mapping[str, float], inputs: Inputs, now: float) -> Inputs:
        """Return the inputs at which other rates begin; they end 1 s after their last repetition.

        Args:
            rates: by input, per simulated second; others are 0.
            inputs: that hold.
            now: the clock [s].
        """
        if not self._rates:
            self._at = {name: float(getattr(inputs, name)) for name in _LEAD}
        self._rates = {name: rate for name, rate in rates.items() if rate and name in _LEAD}
        self._until = now + _REPEATED
        return inputs.changed(self._at)

    def step(self, inputs: Inputs, slice_s: float, now: float) -> Inputs:
        """Return the inputs of the next slice."""
        if not self._rates:
            return inputs
        if now > self._until:
            return self.begin({}, inputs, now)
        values = dict(self._at)
        for name, rate in self._rates.items():
            low, high = RANGES[name]
            self._at[name] = min(max(self._at[name] + slice_s * rate, low), high)
            values[name] = self._at[name] + _LEAD[name] * rate
        return inputs.changed(values)


class Follower:
    """Follows the target of the inputs, coordinate by coordinate.

    Args:
        slice_s: how often it steps [s].
        scales: slave over master, of translation and of rotation.
        device: whether accelerations are limited, too.
    """

    def __init__(self, slice_s: float, scales: tuple[float, float], *, device: bool) -> None:
        self._axes: dict[str, _Axis] = {}
        limits = (("x", "y", "z"), LENGTH, _PLACE), (("rx", "ry", "rz"), ANGLE, _TURN)
        for (names, unit, (speed, acceleration)), scale in zip(limits, scales, strict=True):
            units = slice_s / (unit * max(scale, 1e-3))
            change = slice_s * units * acceleration if device else math.inf
            self._axes |= {name: _Axis(units * speed, change, RANGES[name]) for name in names}

    def step(self, inputs: Inputs, *, free: bool) -> Inputs:
        """Return the inputs with the target of this slice.

        Args:
            inputs: that are requested.
            free: whether the target may jump, because it does not move the arm.
        """
        followed = {
            name: axis.step(getattr(inputs, name), free) for name, axis in self._axes.items()
        }
        return inputs.changed(followed)


class _Axis:
    """One coordinate: its largest speed per slice, change of that, and range."""

    def __init__(self, speed: float, change: float, ends: tuple[float, float]) -> None:
        self._speed, self._change, self._ends = speed, change, ends
        self._at = self._target = self._moved = 0.0

    def step(self, target: float, free: bool) -> float:
        last, self._target = self._target, target
        if free:
            self._at, self._moved = target, 0.0
            return target
        behind = last - self._at
        speed = target - last + math.copysign(self._braking(abs(behind)), behind)
        least, most = (self._braking(abs(end - self._at)) for end in self._ends)
        speed = min(max(speed, -min(least, self._speed)), min(most, self._speed))
        change = min(max(speed - self._moved, -self._change), self._change)
        self._moved += change
        self._at += self._moved
        return self._at

    def _braking(self, distance: float) -> float:
        """The speed v from which it stops there: v + (v - change) + (v - 2 change) + ..."""
        if self._change == math.inf:
            return distance
        root = math.sqrt(self._change**2 + 8.0 * self._change * distance)
        return min(distance, 0.5 * (root - self._change))
