"""Model of the wrench: rigid load with extensions for causes of a misfit, Eq. (T25)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.load.normal_equations import centripetal_matrix, regressor_coefficients
from drake_teleop.logs.causes import instants
from drake_teleop.logs.causes.instants import (
    ROTATION_POSITION_PRODUCTS,
    ROTATION_SIGNALS,
    STEP_CHANGE_SIGNAL_INDICES,
    TIME_POLYNOMIALS,
)

OFFSETS_AND_LOAD, DELAY_INDEX = slice(0, 16), 16  # positions in the parameter vector
_PARAMETER_COUNT_BY_EXTENSION = {
    "gravity": 3, "weight": 4, "torque factor": 1, "frame": 3, "rotation": 3,
    "linear drift": 6, "drift": 18, "cable": 12,
    "clock rate of poses": 1, "clock rate of orientations": 1, "clock rate of gyroscope": 1,
}  # fmt: skip
CLOCK_RATE_EXPONENTS = {
    "clock rate of poses": 2, "clock rate of orientations": 2, "clock rate of gyroscope": 1,
}  # fmt: skip
"""Power p: for time steps r times the true ones, accelerations have the factor 1 + x = r**p."""
_MAX_CHANGE_BY_PARAMETER = {"frame": 0.3, "rotation": 0.6, "torque factor": 0.3, "gain": 0.5}
"""Largest change of a parameter in an iteration [m, rad, 1]."""
_ROTATION_SLICE_IN_STEP_COLUMNS = slice(16, 25)
_MAX_DELAY_CHANGE_PER_ITERATION_S = 0.03
_FINITE_DIFFERENCE_ROTATION_RAD = 1e-4  # of the numerical derivative
# (6, 10, 12) V of s, alpha and the products of omega.
_LOAD_REGRESSOR = regressor_coefficients()[:, 6:, 7:19]
SYMMETRIC_MATRIX_INDICES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Index (3, 3) in [xx, xy, xz, yy, yz, zz] of each entry of a symmetric matrix."""


@dataclass(frozen=True)
class StepChange:
    """Change of offsets (`kind` "offsets", 6 parameters) or load ("load", 10) at `time` [s]."""

    kind: str
    time: float


@dataclass(frozen=True, eq=False)
class LoadModel:
    """Model of the wrench: rigid load with selected extensions, such as drift or a rotated sensor.

    Attributes:
        extensions: names of extensions, such as "gravity" or "drift".
        gain_channels: indices 0 to 5 of the wrench channels whose gain is estimated.
        steps: changes of offsets or load.
        axes: (3, 3) signed permutation, from the motion's axes to the wrench's.
        torque_factor: fixed factor on the torque; the extension "torque factor" corrects it.
    """

    extensions: tuple[str, ...] = ()
    gain_channels: tuple[int, ...] = ()
    steps: tuple[StepChange, ...] = ()
    axes: Array = field(default_factory=lambda: np.eye(3))
    torque_factor: float = 1.0

    def with_extension(self, name: str) -> LoadModel:
        known = name in self.extensions
        return self if known else replace(self, extensions=(*self.extensions, name))

    @cached_property
    def parameter_slices(self) -> dict[str, slice]:
        """Slices of the parameter vector for each extension, "gain c" (channel c) and "step i"."""
        out, at = {}, DELAY_INDEX + 1
        sizes = [(name, _PARAMETER_COUNT_BY_EXTENSION[name]) for name in self.extensions]
        sizes += [(f"gain {c}", 1) for c in self.gain_channels]
        steps = enumerate(self.steps)
        sizes += [(f"step {i}", 6 if step.kind == "offsets" else 10) for i, step in steps]
        for name, size in sizes:
            out[name] = slice(at, at + size)
            at += size
        return out

    @property
    def size(self) -> int:
        return max([DELAY_INDEX + 1, *(x.stop for x in self.parameter_slices.values())])

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Indices (k,) of the used columns: 67 signals, then 25 for each step."""
        kept = np.ones(_step_change_columns(len(self.steps)).start, bool)
        if not {"gravity", "cable"} & set(self.extensions):
            kept[ROTATION_SIGNALS], kept[ROTATION_POSITION_PRODUCTS] = False, False
            for i in range(len(self.steps)):
                kept[_step_change_columns(i)][_ROTATION_SLICE_IN_STEP_COLUMNS] = False
        return np.flatnonzero(kept)

    @cached_property
    def max_parameter_changes(self) -> Array:
        """Largest allowed change (size,) of each parameter in one iteration."""
        out = np.full(self.size, np.inf)
        out[DELAY_INDEX] = _MAX_DELAY_CHANGE_PER_ITERATION_S
        for name, where in self.parameter_slices.items():
            kind = "gain" if name.startswith("gain") else name
            out[where] = _MAX_CHANGE_BY_PARAMETER.get(kind, np.inf)
        return out

    @property
    def step_times(self) -> tuple[float, ...]:
        return tuple(step.time for step in self.steps)

    def start_parameters(self, x: Array, other_model: LoadModel) -> Array:
        """Return parameters (size,): from x of `other_model` for shared terms, else 0."""
        out = np.zeros(self.size)
        out[: DELAY_INDEX + 1] = x[: DELAY_INDEX + 1]
        for name, where in self.parameter_slices.items():
            if name in other_model.parameter_slices:
                out[where] = x[other_model.parameter_slices[name]]
        return out

    def wrench_coefficients(self, x: Array) -> Array:
        """Return C (B, 6, W) for B parameter vectors (B, size): C times W signals is the wrench."""
        parts, motion = self.parameter_slices, self._motion_from_signals_matrix(x)
        out = np.zeros((len(x), 6, _step_change_columns(len(self.steps)).start))
        out[..., : instants.NUM_SIGNALS] = _wrench_coefficients_of_load(x[:, 6:16]) @ motion
        for i, step in enumerate(self.steps):
            if step.kind == "load":
                load = _wrench_coefficients_of_load(x[:, parts[f"step {i}"]])
                out[..., _step_change_columns(i)] = load @ motion[..., STEP_CHANGE_SIGNAL_INDICES]
        if "weight" in parts:
            removed = np.einsum("bj,cjk->bck", x[:, parts["weight"]], _LOAD_REGRESSOR[:, :4, :3])
            out[..., instants.GRAVITY_SIGNALS] += removed  # - V(-g) w
        if "cable" in parts:
            out[..., : instants.NUM_SIGNALS] += _wrench_coefficients_of_cable(x[:, parts["cable"]])
        turned = self.axes[None]
        if "rotation" in parts:
            turned = Rotation.from_rotvec(x[:, parts["rotation"]]).as_matrix() @ self.axes
        out[:, :3], out[:, 3:] = turned @ out[:, :3], turned @ out[:, 3:]
        factor = np.full(len(x), self.torque_factor)
        if "torque factor" in parts:
            factor = factor * (1.0 + x[:, parts["torque factor"].start])
        out[:, 3:] *= factor[:, None, None]
        for c in self.gain_channels:
            out[:, c] *= 1.0 + x[:, parts[f"gain {c}"]]
        channels = np.arange(6)
        out[:, :, instants.CONSTANT_COLUMN] += x[:, :6]
        out[:, channels, instants.WRENCH_RATE_SIGNALS.start + channels] += x[:, DELAY_INDEX, None]
        for i, step in enumerate(self.steps):
            if step.kind == "offsets":
                out[:, :, _step_change_columns(i).start] += x[:, parts[f"step {i}"]]
        for name, degree in (("linear drift", 1), ("drift", 3)):
            if name in parts:
                rows = x[:, parts[name]].reshape(-1, 6, degree)
                out[:, :, TIME_POLYNOMIALS.start : TIME_POLYNOMIALS.start + degree] += rows
        return out

    def _motion_from_signals_matrix(self, x: Array) -> Array:
        parts = self.parameter_slices
        varied = {"gravity", "frame", *CLOCK_RATE_EXPONENTS} & parts.keys()
        M = np.zeros((len(x) if varied else 1, 12, instants.NUM_SIGNALS))
        M[:, 0:3, instants.SPECIFIC_FORCE_SIGNALS] = M[:, 3:6, instants.ALPHA_SIGNALS] = np.eye(3)
        M[:, 6:12, instants.OMEGA_PRODUCTS] = np.eye(6)
        if "gravity" in parts:
            d = x[:, parts["gravity"]]
            for i in range(3):
                M[:, i, ROTATION_SIGNALS.start + 3 * i : ROTATION_SIGNALS.start + 3 * i + 3] += d
        if "frame" in parts:
            r = x[:, parts["frame"]]
            M[:, :3, instants.ALPHA_SIGNALS] -= cross_matrix(r)
            M[:, :3, instants.OMEGA_PRODUCTS] += centripetal_matrix(r)
        for name in CLOCK_RATE_EXPONENTS.keys() & parts.keys():
            factor = 1.0 + x[:, parts[name].start, None, None]
            M[:, :, instants.ALPHA_SIGNALS] *= factor
            if name != "clock rate of gyroscope":
                M[:, :, instants.OMEGA_PRODUCTS] *= factor
            if name == "clock rate of poses":
                M[:, 0:3, instants.SPECIFIC_FORCE_SIGNALS] *= factor
                M[:, 0:3, instants.GRAVITY_SIGNALS] += (factor - 1.0) * np.eye(3)
        return M

    def wrench_jacobian(self, x: Array) -> Array:
        """Return derivatives (size, 6, k) of the wrench's coefficients of k used signals by x."""
        steps = np.ones(self.size)
        if "rotation" in self.parameter_slices:
            steps[self.parameter_slices["rotation"]] = _FINITE_DIFFERENCE_ROTATION_RAD
        moves = np.diag(steps)
        both = self.wrench_coefficients(np.vstack([x + moves, x - moves]))
        change = both[: self.size] - both[self.size :]
        return np.asarray(change[..., self.columns] / (2.0 * steps[:, None, None]))

    def residual_coefficients(self, x: Array) -> Array:
        """Return C (6, k): C times k used signals is the measured minus the model's wrench."""
        out = -self.wrench_coefficients(x[None])[0]
        out[np.arange(6), instants.WRENCH_SIGNALS.start + np.arange(6)] += 1.0
        return np.asarray(out[:, self.columns])


def _step_change_columns(i: int) -> slice:
    start = instants.NUM_SIGNALS + len(STEP_CHANGE_SIGNAL_INDICES) * i
    return slice(start, start + len(STEP_CHANGE_SIGNAL_INDICES))


def _wrench_coefficients_of_load(phi: Array) -> Array:
    return np.einsum("bj,cjk->bck", phi, _LOAD_REGRESSOR)


def _wrench_coefficients_of_cable(x: Array) -> Array:
    out = np.zeros((len(x), 6, instants.NUM_SIGNALS))
    K = x[:, 3:9][:, SYMMETRIC_MATRIX_INDICES].reshape(-1, 9)
    for i in range(3):
        row, products = ROTATION_SIGNALS.start + 3 * i, ROTATION_POSITION_PRODUCTS.start + 9 * i
        out[:, i, row : row + 3], out[:, i, products : products + 9] = x[:, :3], K
    out[:, 3:] = cross_matrix(x[:, 9:]) @ out[:, :3]
    return out
