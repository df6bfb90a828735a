"""Maps of stability and force distortion of the sampled one-axis loop over two parameters."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis import cut_loop, one_axis
from drake_teleop.lab.analysis.cut_loop import CutLoop
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis
from drake_teleop.lab.analysis.period_map import Sampling
from drake_teleop.lab.analysis.two_port import ideal_impedance

#: Name of a map's parameter: the hand's rate [Hz]; the other rates change in proportion.
RATE_NAME = "rate"
_PARAMETER_NAMES = {e.name for e in fields(OneAxis)} - {"ideal_servo"} | {RATE_NAME, "low_pass_hz"}
_NUM_STABILITY_LIMIT_BISECTIONS = 10
# Frequencies of deliberate movements.
_DISTORTION_FREQUENCIES_RAD_S = 2 * np.pi * np.array([0.5, 1.0, 2.0, 5.0])


@dataclass(frozen=True)
class StabilityMap:
    """Stability and force distortion at the hand on a grid of two parameters."""

    x_name: str
    y_name: str
    x: Array  #: (nx,) values of the first parameter
    y: Array  #: (ny,) values of the second parameter
    num_unstable_multipliers: NDArray[np.int64]  #: (ny, nx) multipliers outside the unit circle
    distortion: Array  #: (ny, nx) `force_distortion`, valid only where the loop is stable
    boundary: Array  #: (n, 2) points (x, y) of the stability limit, to 1/1000 of the grid's step

    @property
    def stable(self) -> NDArray[np.bool_]:
        return self.num_unstable_multipliers == 0


def stability_map(
    axis: OneAxis, sampling: Sampling, x_name: str, x: ArrayLike, y_name: str, y: ArrayLike
) -> StabilityMap:
    """Return the map over increasing values of the parameters `x_name` and `y_name`.

    Names: fields of `OneAxis`, "low_pass_hz", or "rate" (of the hand [Hz], others in proportion).
    """
    xs, ys = _check_parameter_values(x_name, x), _check_parameter_values(y_name, y)

    def cut_loop_and_num_unstable(x: Array, y: Array) -> tuple[OneAxis, CutLoop, NDArray[np.int64]]:
        changed_axis, loop = _apply_values_and_cut_loop(axis, sampling, {x_name: x, y_name: y})
        return changed_axis, loop, cut_loop.count_unstable_multipliers(loop, changed_axis.delay)

    points = np.stack(np.meshgrid(xs, ys), axis=-1)
    changed_axis, loop, unstable = cut_loop_and_num_unstable(xs, ys[:, None])
    unstable = np.broadcast_to(unstable, points.shape[:2])
    stable = unstable == 0
    # Neighbours in a row, then neighbours in a column.
    across, along = stable[:, 1:] != stable[:, :-1], stable[1:] != stable[:-1]
    low = np.concatenate([points[:, :-1][across], points[:-1][along]])
    high = np.concatenate([points[:, 1:][across], points[1:][along]])
    stable_at_low = np.concatenate([stable[:, :-1][across], stable[:-1][along]])
    for _ in range(_NUM_STABILITY_LIMIT_BISECTIONS if len(low) else 0):
        middle = 0.5 * (low + high)
        as_low = ((cut_loop_and_num_unstable(*middle.T)[2] == 0) == stable_at_low)[:, None]
        low, high = np.where(as_low, middle, low), np.where(as_low, high, middle)
    distortion = np.broadcast_to(force_distortion(changed_axis, loop), stable.shape)
    return StabilityMap(x_name, y_name, xs, ys, unstable, distortion, 0.5 * (low + high))


def force_distortion(
    axis: OneAxis, loop: CutLoop, frequency: ArrayLike = _DISTORTION_FREQUENCIES_RAD_S
) -> Array:
    """Return the largest relative error of the operator's force, compared with an ideal station.

    The maximum is over `frequency` (N,) [rad/s].
    """
    shape = np.broadcast_shapes(loop.period_s.shape, *map(np.shape, vars(axis).values()))
    w = np.atleast_1d(np.asarray(frequency, dtype=float))
    s: Complex = 1j * w.reshape(-1, *[1] * len(shape))
    hand = one_axis.hand_impedance(axis, s)
    ideal = hand + ideal_impedance(axis, s, one_axis.environment_impedance(axis, s))
    response = cut_loop.loop_response(loop, w, axis.delay)
    exerted = (hand + one_axis.device_impedance(axis, s)) * (1 - response)
    return np.abs(exerted / ideal - 1).max(axis=0)


def _check_parameter_values(name: str, values: ArrayLike) -> Array:
    if name not in _PARAMETER_NAMES:
        what = f"'{name}' is no parameter of a stability map"
        remedy = f"choose one of {', '.join(sorted(_PARAMETER_NAMES))}"
        raise DrakeTeleopError(what, where="stability_map", remedy=remedy)
    array = np.asarray(values, dtype=float)
    finite = array.ndim == 1 and array.size > 0 and np.isfinite(array).all()
    if not finite or (np.diff(array) <= 0).any():
        what = f"the values (shape {array.shape}) are no list of finite numbers, or do not increase"
        remedy = "give at least one number, each above the one before"
        raise DrakeTeleopError(what, where=f"stability_map:{name}", remedy=remedy)
    return array


def _apply_values_and_cut_loop(
    axis: OneAxis, sampling: Sampling, values: dict[str, Any]
) -> tuple[OneAxis, CutLoop]:
    for name, value in values.items():
        if name == RATE_NAME:
            factor, others = value / sampling.hand_hz, ("joint_control_hz", "sensor_hz")
            rates = {other: factor * getattr(sampling, other) for other in others}
            sampling = replace(sampling, hand_hz=value, **rates)
        elif name == "low_pass_hz":
            sampling = replace(sampling, low_pass_hz=value)
        else:
            axis = replace(axis, **{name: value})
    return axis, cut_loop.cut_loop(axis, sampling)
