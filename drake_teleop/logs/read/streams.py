"""Signals and orientations of one stream: resampling and transformation to S."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common import rotations
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, find_runs_of_true
from drake_teleop.logs.pose_motion.poses import ImuData, Poses
from drake_teleop.logs.read.alignment import low_pass, mean_time_step, resample, uniform_times
from drake_teleop.logs.read.description import Description, Orientation
from drake_teleop.logs.read.description_fields import ROTATION_TOLERANCE
from drake_teleop.logs.read.tables import Table

MIN_STREAM_SAMPLES = 16
# Least share of lost rows, least jump to their zeros over usual steps and over the mean size.
_MIN_LOST_ROW_SHARE, _MIN_JUMP_OVER_STEP, _MIN_JUMP_OVER_SIZE = 0.001, 5.0, 0.3
_MAX_SUCCESSIVE_LOST_ROWS = 20
MAX_PLAUSIBLE_VALUES = {
    "force": (1e6, "N"), "torque": (1e6, "N m"), "position": (1e9, "m"),
    "specific_force": (1e6, "m/s^2"), "gravity": (1e6, "m/s^2"),
    "angular_velocity": (1e6, "rad/s"), "angular_acceleration": (1e9, "rad/s^2"),
}  # fmt: skip
"""Largest plausible value of each signal and its unit, also for wrong units."""


@dataclass(frozen=True)
class Stream:
    """Signals (N, ...) of one stream in S, at its times `t` [s]; None for absent signals.

    `recorded_poses` are poses of S.
    """

    name: str
    t: Array
    specific_force: Array | None = None
    angular_velocity: Array | None = None
    angular_acceleration: Array | None = None
    R_WS: Array | None = None
    recorded_poses: Poses | None = None
    imu_data: ImuData | None = None

    @property
    def dt(self) -> float:
        return mean_time_step(self.t)


def check_for_lost_readings(values: Array, table: Table, where: str) -> None:
    # Drivers write zeros for lost readings.
    sizes = np.linalg.norm(values, axis=1)
    runs, padded = find_runs_of_true(sizes == 0.0), np.append(sizes, 0.0)
    beside = np.minimum(padded[runs[:, 0] - 1], padded[runs[:, 1]])
    steps = np.linalg.norm(np.diff(values[sizes > 0.0], axis=0), axis=1)
    steps = steps[steps > 0.0]  # equal rows of a coarse sensor are no small steps
    if not (beside.any() and len(steps)):
        return
    least = max(_MIN_JUMP_OVER_STEP * np.quantile(steps, 0.99), _MIN_JUMP_OVER_SIZE * sizes.mean())
    lost = runs[(beside > least) & (np.ptp(runs, axis=1) <= _MAX_SUCCESSIVE_LOST_ROWS)]
    usual = 0.5 * np.ptp(runs[beside > 0.0], axis=1).sum()  # zeros are usual in a dead band
    if (count := int(np.ptp(lost, axis=1).sum())) > max(_MIN_LOST_ROW_SHARE * len(sizes), usual):
        row = table.line_in_file(int(lost[0, 0]))
        what = f"{count} rows of zeros between other values, the first is row {row}: lost readings"
        remedy = "delete these rows, or empty their cells if time.rate is given"
        raise DrakeTeleopError(what, where=where, remedy=remedy)


def resample_to_clock(t: Array, stream: Stream, values: Array) -> Array:
    """Return `values` of a stream at times `t` [s], low-passed if the stream is faster."""
    rate = 1 / mean_time_step(t)
    faster = stream.dt * rate < 0.9
    return resample(t, stream.t, low_pass(values, stream.dt, 0.4 * rate if faster else None))


def rotate_world_to_S(R_WS: Array, vectors_W: Array) -> Array:
    return np.einsum("nji,nj->ni", R_WS, np.broadcast_to(vectors_W, (len(R_WS), 3)))


def rotate_wrench_world_to_S(R_SW: Array, wrench_W: Array) -> Array:
    """Rotate wrenches (N, 6) from axes of W to S; the reference point is unchanged."""
    return np.einsum("nij,nkj->nki", R_SW, wrench_W.reshape(-1, 2, 3)).reshape(-1, 6)


class OrientationColumns:
    """Columns of a table with orientations of S, or of the posed frame P, in any form."""

    def __init__(
        self, description: Description, described: Orientation, table: Table, rows: int, where: str
    ) -> None:
        self._orientation, self._table, self._where = described, table, where
        width = rotations.NUM_COLUMNS_BY_ROTATION_FORM[described.form]
        self._columns = table.finite_numbers(described.columns, width, f"{where}.columns", rows)
        if described.form in ("rotation_vector", "euler"):
            self._columns *= description.unit_in_si(described.unit)

    def allocate_quaternions(self, count: int) -> Array:
        """Return an array (count, 4) for quaternions that may share memory with the columns.

        Write row k only after reading row k of the columns.
        """
        return self._columns[:count] if self._columns.shape[1] == 4 else np.empty((count, 4))

    def rotations(self, rows: NDArray[np.intp]) -> Array:
        """Return R_WS or R_WP (n, 3, 3) of n rows; raise an error if these are no rotations."""
        orientation = self._orientation
        R = rotations.rotation_matrices(self._columns[rows], orientation.form, orientation.axes)
        self._check_orthogonality_errors(rotations.orthogonality_error(R), rows)
        return rotations.nearest_rotation(np.swapaxes(R, 1, 2) if orientation.inverse else R)

    def quaternions(self, rows: NDArray[np.intp]) -> Array:
        """Return R_WS or R_WP of n rows as quaternions (n, 4) [w, x, y, z]."""
        if not self._orientation.form.startswith("quaternion"):
            return rotations.quaternions_from_matrices(self.rotations(rows))
        q = self._columns[rows]
        if self._orientation.form == "quaternion_xyzw":
            q = np.roll(q, 1, axis=1)
        squared = np.einsum("ij,ij->i", q, q)  # the matrix of q is this, times a rotation
        self._check_orthogonality_errors(np.abs(squared**2 - 1.0), rows)
        q /= np.sqrt(squared)[:, None]
        if self._orientation.inverse:
            q[:, 1:] *= -1.0
        return q

    def _check_orthogonality_errors(self, errors: Array, rows: NDArray[np.intp]) -> None:
        worst = int(np.argmax(errors))
        if errors[worst] > ROTATION_TOLERANCE:
            row = self._table.line_in_file(rows[worst])
            what = f"row {row} of {self._table.path.name} is not a rotation or unit quaternion"
            remedy = f"check the columns and their order; form is {self._orientation.form}"
            raise DrakeTeleopError(what, where=self._where, remedy=remedy)


def uniform_times_of_streams(wrench_t: Array, streams: Sequence[Stream], source: str) -> Array:
    """Return uniform times at the wrench's rate, within the time spans of all streams."""
    named = [("wrench", wrench_t), *((stream.name, stream.t) for stream in streams)]
    start, stop = max(t[0] for _, t in named), min(t[-1] for _, t in named)
    spans = "; ".join(f"{name} {t[0]:.6g} to {t[-1]:.6g} s" for name, t in named)
    if stop <= start:
        what = f"the streams do not overlap in time ({spans})"
        remedy = "check time.unit of each stream, or shift its clock by time.offset"
        raise DrakeTeleopError(what, where=source, remedy=remedy)
    uniform = uniform_times(wrench_t)
    dt = mean_time_step(uniform)
    # Rounding of the clocks must not exclude the first and last sample.
    inside = (uniform >= start - 1e-6 * dt) & (uniform <= stop + 1e-6 * dt)
    t = uniform[inside]
    if len(t) < MIN_STREAM_SAMPLES:
        what = f"the streams have only {len(t)} samples in common ({spans})"
        remedy = f"record at least {MIN_STREAM_SAMPLES}, or check time.offset"
        raise DrakeTeleopError(what, where=source, remedy=remedy)
    return t
