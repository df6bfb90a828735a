"""Readings that combine the wrench of one stream with the motion of another."""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import quaternions_from_matrices, rotation_matrices
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.logs.aligned_log import removed_weight_needs_orientation_error
from drake_teleop.logs.processing import phi_with_inertia_replaced
from drake_teleop.logs.read.alignment import (
    SMOOTHER_WINDOW_OVER_PERIOD,
    polynomial_fit_weights,
    vectors_of_skew_parts,
)
from drake_teleop.robots.compensator import (
    MAX_CLOCK_DRIFT,
    MAX_SENSOR_OFFSET_DRIFT,
    MIN_CLOCK_JUMP_S,
    STALE_AGE_S,
)
from drake_teleop.robots.streams import (
    IMU,
    JOINTS,
    NUM_READING_VALUES,
    POSE,
    WRENCH,
    Reading,
    ReadingFlag,
    Source,
)
from drake_teleop.robots.watch import RELATIVE_LOAD_WRENCH_ERROR, white_wrench_noise

DELAY_FORGETTING_TIME_S = 10.0
"""Time constant of the exponential weights of past samples [s]."""
MAX_DELAY_STD_S = 5e-4
"""Maximum standard deviation of an estimate that changes the delay [s]."""
MAX_DELAY_SLEW_RATE = 0.005
"""Maximum rate of change of the delay [s/s]."""
MAX_DELAY_S = 0.1
"""Maximum magnitude of the delay [s]."""
MAX_DELAY_ERROR_BEFORE_ESTIMATE_S = 0.03
"""Delay error that the residual of a sample may contain before the delay is known [s]."""
MAX_DELAY_ERROR_AFTER_ESTIMATE_S = 0.004
"""The same once the delay is known, in addition to the remaining correction [s]."""
DELAY_SAMPLE_PERIOD_S = 0.004
"""Period of the evaluated samples [s]."""
_MAX_INLIER_RESIDUAL_SIGMAS, _MIN_DELAY_SAMPLES = 5.0, 50  # samples before offsets are estimated

TimedMotion = tuple[float, Array]
"""Time [s], and s, omega, alpha (9,)."""


class DelayTracker:
    """Estimator of `delay_s` [s], by which the motion's time stamps lag behind the wrench's."""

    def __init__(
        self, load: Identification, dt: float, cutoff_hz: float | None, delay_s: float
    ) -> None:
        self.load, self.delay_s = load, delay_s
        self._phi = tuple(phi_with_inertia_replaced(load)[0])
        self._noise = white_wrench_noise(load, dt, cutoff_hz)
        self._weights, self._offsets = self._noise**-2, load.offsets.copy()
        self._wrenches = np.zeros((3, 6))
        self._reset_delay_estimate(-math.inf)
        # Load compiled code before the first sample.
        self.update_delay((0.0, np.zeros(9)), self._offsets, (0.0, np.zeros(9)), (1.0, np.zeros(9)))
        self._reset_delay_estimate(-math.inf)

    def _reset_delay_estimate(self, t: float) -> None:
        self._t = self._fitted = t
        self._samples, self._count, self._sums = 0, 0.0, np.zeros((5, 6))
        self._delay_error = MAX_DELAY_ERROR_BEFORE_ESTIMATE_S

    def update_delay(
        self, at: TimedMotion, wrench: Array, before: TimedMotion, after: TimedMotion
    ) -> None:
        """Update the delay by a wrench (6,), the motion `at` its time, one before and one after."""
        t, step = at[0], after[0] - before[0]
        elapsed = t - self._t
        if 0.0 <= elapsed < DELAY_SAMPLE_PERIOD_S or step <= 0.0:
            return
        # Another clock, or no explained sample for long.
        if not 0.0 <= t - self._fitted < DELAY_FORGETTING_TIME_S:
            self._reset_delay_estimate(t)
            elapsed = 0.0
        self._t = t
        for row, (_, motion) in zip(self._wrenches, (at, before, after), strict=True):
            non_contact_wrench_into(motion[:3], motion[3:6], motion[6:], self._phi, row)
        slope = (self._wrenches[2] - self._wrenches[1]) / step
        residual = wrench - self._wrenches[0]
        if self._is_inlier(residual, slope):
            # The sums refer to zero delay; the motion is already shifted by the present one.
            residual = residual + slope * self.delay_s
            fade = math.exp(-(t - self._fitted) / DELAY_FORGETTING_TIME_S)
            self._fitted, self._samples = t, self._samples + 1
            self._count = fade * self._count + 1.0
            products = slope, residual, slope * slope, slope * residual, residual * residual
            self._sums = fade * self._sums + np.stack(products)
            self._change_delay_at_limited_rate(min(elapsed, DELAY_FORGETTING_TIME_S))

    def _is_inlier(self, residual: Array, wrench_rate: Array) -> bool:
        starting = self._samples < _MIN_DELAY_SAMPLES
        limit = _MAX_INLIER_RESIDUAL_SIGMAS * self._noise + self._delay_error * np.abs(wrench_rate)
        drift, offsets = starting * MAX_SENSOR_OFFSET_DRIFT, self._offsets
        limit += RELATIVE_LOAD_WRENCH_ERROR * np.abs(self._wrenches[0]) + drift
        if not starting:
            offsets = (self._sums[1] - self._sums[0] * self.delay_s) / self._count
        return bool((np.abs(residual - offsets) < limit).all())

    def _change_delay_at_limited_rate(self, elapsed_s: float) -> None:
        if self._samples < _MIN_DELAY_SAMPLES:
            return
        g, r, gg, gr, rr = self._sums / self._count
        information = float(self._weights @ (gg - g * g))
        if information <= 0.0:
            return
        estimate = float(self._weights @ (gr - g * r)) / information
        rest = rr - r * r - estimate * (gr - g * r)
        noise_ratio = max(1.0, float(self._weights @ rest) / 6.0)  # variance over the stated noise
        self._delay_error = MAX_DELAY_ERROR_BEFORE_ESTIMATE_S
        if math.sqrt(noise_ratio / (information * self._count)) < MAX_DELAY_STD_S:
            max_change = MAX_DELAY_SLEW_RATE * elapsed_s
            correction = min(MAX_DELAY_S, max(-MAX_DELAY_S, estimate)) - self.delay_s
            self.delay_s += min(max_change, max(-max_change, correction))
            tracked = MAX_DELAY_ERROR_AFTER_ESTIMATE_S + abs(correction)
            self._delay_error = min(MAX_DELAY_ERROR_BEFORE_ESTIMATE_S, tracked)


_GRAVITY_W = np.array([0.0, 0.0, -9.81])
IDENTITY_POSE = np.array([1.0, 0, 0, 0, 0, 0, 0])
"""Identity: the sensor's frame is the posed frame."""
_STREAM_BUFFER_S = 0.5  # buffer of motions and wrenches
_MIN_MOTION_PERIOD_S, _MAX_TIME_STAMP_S, _MAX_MOTION_VALUE = 1e-4, 1e11, 1e5  # [s], [s], any unit
_NUM_SAMPLES_FOR_MOTION_PERIOD = 20  # for the median period of the motion


class ArmKinematics(Protocol):
    """Interface of an arm's kinematics, such as `station.slave.arm.ArmModel`."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names from the base outwards."""

    def pose(self, q: Array) -> Array:
        """Return the sensor's pose X_WS (7,) at joint positions q (n,): [w x y z, position]."""


class WrenchAndMotionStreams(Source):
    """Source of wrenches and motions, from one or two sources; `where` is its name in errors.

    The kinematics `arm` convert joint positions to poses of the sensor frame S.
    """

    def __init__(
        self,
        wrench: Source,
        motion: Source | None = None,
        *,
        where: str = "the source",
        arm: ArmKinematics | None = None,
    ) -> None:
        self._wrench, self._motion, self._arm = wrench, motion, arm
        self.dt, self.two_clocks, self.where = wrench.dt, motion is not None, where
        streams = (wrench if motion is None else motion).streams
        if arm is not None:
            if JOINTS not in streams:
                what = "delivers no joint positions for --model"
                remedy = "give a source such as zenoh://HOST/TOPIC?joints=/joint_states"
                raise DrakeTeleopError(what, where=where, remedy=remedy)
            streams = (POSE,)
        self.motion_stream = next((stream for stream in (POSE, IMU) if stream in streams), "")
        if not self.motion_stream:
            remedy = "give --motion, such as rtde://HOST, or for ROS 2 pose=, tf= or imu= in the"
            raise DrakeTeleopError("delivers no motion", where=where, remedy=f"{remedy} address")
        self.streams = WRENCH, self.motion_stream

    def read(self, timeout_s: float) -> list[Reading] | None:
        motions = self._motion.read(0.0) or [] if self._motion is not None else []
        moved = time.monotonic()
        readings = self._wrench.read(timeout_s)
        if readings is None:
            return None
        now = time.monotonic()
        if self._motion is not None:
            readings = [each for each in readings if each.stream == WRENCH]
        found = [each._replace(arrival=moved) for each in motions if each.stream != WRENCH]
        found += [each._replace(arrival=now) for each in readings]
        arm = self._arm
        if arm is None:
            return found
        return [_convert_joints_to_pose(each, arm) for each in found if each.stream != POSE]

    def close(self) -> None:
        self._wrench.close()
        if self._motion is not None:
            self._motion.close()


def _convert_joints_to_pose(reading: Reading, arm: ArmKinematics) -> Reading:
    if reading.stream != JOINTS:
        return reading
    values = np.full(7, np.nan)  # an invalid pose, rejected later
    if reading.values.shape == (len(arm.joint_names),):
        values = arm.pose(reading.values)
    return reading._replace(stream=POSE, values=values)


class MotionWindow:
    """Motions of the sensor frame S on a uniform time grid, from poses of a frame F or an IMU.

    Args:
        cutoff_hz: cut-off of the smoothing; None for the shortest window.
        X_FS: (7,) pose of S in F.
        gravity_W: (3,) gravity in the world frame [m/s^2].
    """

    def __init__(self, cutoff_hz: float | None, X_FS: Array, gravity_W: Array = _GRAVITY_W) -> None:
        self._cutoff_hz, self._dt, self._gravity_W = cutoff_hz, 0.0, gravity_W
        self.half_window_s = 0.5 * SMOOTHER_WINDOW_OVER_PERIOD / (cutoff_hz or math.inf)
        self._weights, self._size = np.zeros((3, 1)), 1
        self._R_FS, self._p_FS = rotation_matrices(X_FS[None, :4], "quaternion_wxyz")[0], X_FS[4:]
        self._steps: list[float] = []
        self.reset()

    def reset(self) -> None:
        self._last: tuple[float, Array] | None = None
        self._next_t, self._rows = 0.0, deque[Array](maxlen=self._size)
        self._arrival = -math.inf

    def _update_motion_period(self, step_s: float) -> None:
        self._steps.append(step_s)
        if len(self._steps) == _NUM_SAMPLES_FOR_MOTION_PERIOD:
            self._dt = float(np.median(self._steps))
            self._weights = polynomial_fit_weights(10**9, self._dt, self._cutoff_hz)[:3]
            self._size = self._weights.shape[1]
            self.half_window_s = self._size // 2 * self._dt
            self.reset()

    def motions_completed_by(self, sample: Reading) -> list[tuple[float, Array]]:
        """Add a sample; return pairs: time [s], motion (s, omega, alpha, gravity with poses)."""
        row = self._motion_row_if_valid(sample)
        if row is None:
            return []
        last = self._last
        step = math.inf if last is None else sample.t - last[0]
        if step <= 0.0 and sample.arrival - self._arrival <= STALE_AGE_S:
            return []  # out of order or repeated
        if not self._dt and _MIN_MOTION_PERIOD_S <= step <= STALE_AGE_S:
            self._update_motion_period(step)
        if self._last is None or not 0.0 < step <= STALE_AGE_S:
            self.reset()
            self._next_t, last = sample.t, (sample.t, row)
        self._last, self._arrival = (sample.t, row), sample.arrival
        found: list[tuple[float, Array]] = []
        if not self._dt or last is None:
            return found
        while self._next_t <= sample.t:
            share = (self._next_t - last[0]) / max(sample.t - last[0], 1e-9)
            self._rows.append(last[1] + share * (row - last[1]))
            if len(self._rows) == self._size:
                found.append((self._next_t - self._size // 2 * self._dt, self._smoothed_motion()))
            self._next_t += self._dt
        return found

    def _motion_row_if_valid(self, sample: Reading) -> Array | None:
        values = sample.values
        plausible = abs(sample.t) < _MAX_TIME_STAMP_S and (np.abs(values) < _MAX_MOTION_VALUE).all()
        if sample.flags or not plausible:
            return None
        if sample.stream == IMU:
            return values
        size = float(np.linalg.norm(values[:4]))
        if not abs(size - 1.0) < 0.01:
            return None
        R_WF = rotation_matrices(values[None, :4] / size, "quaternion_wxyz")[0]
        return np.concatenate([(R_WF @ self._R_FS).ravel(), values[4:] + R_WF @ self._p_FS])

    def _smoothed_motion(self) -> Array:
        rows = np.array(self._rows)
        smooth, first, second = self._weights @ rows
        if rows.shape[1] == 6:
            return np.concatenate([smooth, first[3:]])
        R_WS = rows[self._size // 2, :9].reshape(3, 3)
        omega, alpha = R_WS.T @ first[:9].reshape(3, 3), R_WS.T @ (2.0 * second[:9]).reshape(3, 3)
        s, gravity = R_WS.T @ (2.0 * second[9:] - self._gravity_W), R_WS.T @ self._gravity_W
        return np.concatenate([s, *vectors_of_skew_parts(np.stack([omega, alpha])), gravity])


def pose_from_rpy(numbers: Sequence[float]) -> Array:
    """Return [w x y z, position] for x, y, z [m], roll, pitch, yaw about fixed axes [deg]."""
    R = rotation_matrices(np.radians([numbers[3:]]), "euler", "xyz")
    return np.concatenate([quaternions_from_matrices(R)[0], numbers[:3]])


class _ClockOffsetEstimator:
    def __init__(self) -> None:
        self.offset, self._now = math.inf, 0.0

    def update_offset(self, t: float, now: float) -> None:
        if math.isfinite(t):
            ahead, faded = now - t, self.offset + MAX_CLOCK_DRIFT * (now - self._now)
            known = abs(ahead - self.offset) <= MIN_CLOCK_JUMP_S
            self.offset, self._now = min(ahead, faded) if known else ahead, now


class ReadingAssembler(Source):
    """Source of readings: wrenches with the motion of another stream at the same time.

    Args:
        delay_s: delay of the motion's time stamps behind the wrench's [s].
        track: load for online estimation of the delay; None: constant delay.
        X_FS: (7,) pose of the sensor in the frame F of the poses, [w x y z, position].
        weight_removed: True if the robot has removed the load's weight from the wrench.
    """

    def __init__(
        self,
        streams: WrenchAndMotionStreams,
        *,
        cutoff_hz: float | None = 30.0,
        delay_s: float = 0.0,
        track: Identification | None = None,
        X_FS: Array = IDENTITY_POSE,
        weight_removed: bool = False,
    ) -> None:
        if weight_removed and streams.motion_stream == IMU:
            raise removed_weight_needs_orientation_error(streams.where)
        self._streams, self._delay, self.dt = streams, delay_s, streams.dt
        self._tracker = None if track is None else DelayTracker(track, self.dt, cutoff_hz, delay_s)
        self._cutoff_hz = cutoff_hz
        self._window = MotionWindow(cutoff_hz, X_FS, np.zeros(3) if weight_removed else _GRAVITY_W)
        self._clocks = _ClockOffsetEstimator(), _ClockOffsetEstimator()
        self._motions: deque[tuple[float, Array]] = deque()
        self._pending = deque[Reading](maxlen=max(1, round(_STREAM_BUFFER_S / self.dt)))

    @property
    def delay_s(self) -> float:
        return self._delay if self._tracker is None else self._tracker.delay_s

    def track_delay_with(self, load: Identification) -> None:
        """Estimate the delay with this load from now on, if the delay is estimated."""
        if self._tracker is not None and self._tracker.load is not load:
            self._tracker = DelayTracker(load, self.dt, self._cutoff_hz, self.delay_s)

    @property
    def lag_s(self) -> float:
        """Delay [s] of readings behind their wrenches: half the smoothing window plus `delay_s`."""
        return max(0.0, self._window.half_window_s + self.delay_s)

    def read(self, timeout_s: float) -> list[Reading] | None:
        arrived = self._streams.read(timeout_s)
        if arrived is None:
            return None
        return [each for sample in arrived for each in self.readings_completed_by(sample)]

    def readings_completed_by(self, sample: Reading) -> list[Reading]:
        """Add a wrench or motion; return readings of the wrenches whose motion is complete."""
        if sample.stream == WRENCH:
            self._clocks[0].update_offset(sample.t, sample.arrival)
            self._pending.append(sample)
        elif sample.stream == self._streams.motion_stream:
            self._clocks[1].update_offset(sample.t, sample.arrival)
            shift = -self.delay_s
            if self._streams.two_clocks:
                shift += self._clocks[1].offset - self._clocks[0].offset
            for t, motion in self._window.motions_completed_by(sample):
                self._store_motion(t + shift, motion)
        found = []
        while self._pending and (reading := self._assemble_reading(self._pending[0])) is not None:
            self._pending.popleft()
            found.append(reading)
        return found

    def _store_motion(self, t: float, motion: Array) -> None:
        motions = self._motions
        if motions and not motions[-1][0] - STALE_AGE_S < t < motions[-1][0] + _STREAM_BUFFER_S:
            motions.clear()  # another clock: wrenches on the old one would wait forever
            waiting = [each for each in self._pending if not abs(each.t - t) > _STREAM_BUFFER_S]
            self._pending = deque(waiting, self._pending.maxlen)
        if math.isfinite(t) and (not motions or t > motions[-1][0]):
            motions.append((t, motion))
            while t - motions[0][0] > _STREAM_BUFFER_S:
                motions.popleft()

    def _assemble_reading(self, sample: Reading) -> Reading | None:
        values, flags, motions = np.zeros(NUM_READING_VALUES), sample.flags, self._motions
        values[:6] = sample.values
        if not math.isfinite(sample.t):
            return Reading(sample.number, sample.t, values, flags)
        if not motions or sample.t > motions[-1][0]:
            return None
        at = bisect_right(motions, sample.t, key=lambda each: each[0])
        after, before = motions[min(at, len(motions) - 1)], motions[max(0, at - 1)]
        if sample.t < before[0] or after[0] - before[0] > STALE_AGE_S:
            return Reading(sample.number, sample.t, values, flags | ReadingFlag.STALE)
        share = (sample.t - before[0]) / max(after[0] - before[0], 1e-9)
        motion = before[1] + share * (after[1] - before[1])
        values[6:] = motion[:9]
        if self._tracker is not None and not flags and np.isfinite(sample.values).all():
            self._tracker.update_delay((sample.t, values[6:]), sample.values, before, after)
        gravity = motion[9:] if len(motion) > 9 else None
        return Reading(sample.number, sample.t, values, flags, gravity)

    def close(self) -> None:
        self._streams.close()
