"""Readings that combine the wrench of one stream with the motion of another.

Motions are derivatives of poses (docs/robot.md, "Methods").
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.load.identification import Identification
from drake_teleop.logs.aligned_log import without_orientation
from drake_teleop.logs.read.alignment import SMOOTHER_WINDOW, smoother
from drake_teleop.logs.read.rotations import quaternions, rotation_matrices
from drake_teleop.robots.compensator import DRIFT, JUMP_S, STALE_S
from drake_teleop.robots.delay_following import DelayFollower
from drake_teleop.robots.export import turn
from drake_teleop.robots.parts import Parts
from drake_teleop.robots.streams import IMU, VALUES, WRENCH, Flag, Part, Reading

_GRAVITY = np.array([0.0, 0.0, -9.81])
NOWHERE = np.array([1.0, 0, 0, 0, 0, 0, 0])
"""Identity: the sensor's frame is the posed frame."""
_KEPT_S = 0.5  # buffer of motions and wrenches
_LEAST_DT, _LATEST, _LARGEST = 1e-4, 1e11, 1e5  # [s], [s], any unit
_SPACINGS = 20  # for the median period of the motion


class Window:
    """Motions of S from poses of a frame F, or from IMU samples, on a uniform grid.

    Args:
        cutoff_hz: None for the shortest window.
        X_FS: (7,) pose of the sensor in F.
        gravity_W: (3,) [m/s^2].
    """

    def __init__(self, cutoff_hz: float | None, X_FS: Array, gravity_W: Array = _GRAVITY) -> None:
        self._cutoff_hz, self._dt, self._gravity_W = cutoff_hz, 0.0, gravity_W
        self._weights, self._size = np.zeros((3, 1)), 1
        self._R_FS, self._p_FS = rotation_matrices(X_FS[None, :4], "quaternion_wxyz")[0], X_FS[4:]
        self._steps: list[float] = []
        self.forget()

    def forget(self) -> None:
        """Discard all samples."""
        self._last: tuple[float, Array] | None = None
        self._next, self._rows = 0.0, deque[Array](maxlen=self._size)
        self._came = -math.inf

    def _measure(self, step: float) -> None:
        self._steps.append(step)
        if len(self._steps) == _SPACINGS:
            self._dt = float(np.median(self._steps))
            self._weights = smoother(10**9, self._dt, self._cutoff_hz)[:3]
            self._size = self._weights.shape[1]
            self.forget()

    def take(self, part: Part, now: float) -> list[tuple[float, Array]]:
        """Return times and motions (9,) that are complete with a sample received at `now`."""
        row = self._row(part)
        if row is None:
            return []
        last = self._last
        step = math.inf if last is None else part.t - last[0]
        if step <= 0.0 and now - self._came <= STALE_S:
            return []  # out of order or repeated
        if not self._dt and _LEAST_DT <= step <= STALE_S:
            self._measure(step)
        if self._last is None or not 0.0 < step <= STALE_S:
            self.forget()
            self._next, last = part.t, (part.t, row)
        self._last, self._came = (part.t, row), now
        found: list[tuple[float, Array]] = []
        if not self._dt or last is None:
            return found
        while self._next <= part.t:
            share = (self._next - last[0]) / max(part.t - last[0], 1e-9)
            self._rows.append(last[1] + share * (row - last[1]))
            if len(self._rows) == self._size:
                found.append((self._next - self._size // 2 * self._dt, self._middle()))
            self._next += self._dt
        return found

    def _row(self, part: Part) -> Array | None:
        """Return R_WS and p_WS (12,), or IMU values (6,); None if invalid."""
        values = part.values
        if part.flags or not (abs(part.t) < _LATEST and (np.abs(values) < _LARGEST).all()):
            return None
        if part.stream == IMU:
            return values
        size = float(np.linalg.norm(values[:4]))
        if not abs(size - 1.0) < 0.01:
            return None
        R_WF = rotation_matrices(values[None, :4] / size, "quaternion_wxyz")[0]
        return np.concatenate([(R_WF @ self._R_FS).ravel(), values[4:] + R_WF @ self._p_FS])

    def _middle(self) -> Array:
        """Return s, omega, alpha (9,) in the middle of the window."""
        rows = np.array(self._rows)
        smooth, first, second = self._weights @ rows
        if rows.shape[1] == 6:
            return np.concatenate([smooth, first[3:]])
        R_WS = rows[self._size // 2, :9].reshape(3, 3)
        omega, alpha = R_WS.T @ first[:9].reshape(3, 3), R_WS.T @ (2.0 * second[:9]).reshape(3, 3)
        s = R_WS.T @ (2.0 * second[9:] - self._gravity_W)
        return np.concatenate([s, _axis(omega), _axis(alpha)])


def _axis(A: Array) -> Array:
    return 0.5 * np.array([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])


def pose_of(numbers: Sequence[float]) -> Array:
    """Return quaternion and position (7,) of x, y, z [m], roll, pitch, yaw [deg] (URDF)."""
    roll, pitch, yaw = np.radians(numbers[3:])
    R = turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)
    return np.concatenate([quaternions(R[None])[0], numbers[:3]])


class _Offset:
    def __init__(self) -> None:
        self.now_less_t, self._now = math.inf, 0.0

    def follow(self, t: float, now: float) -> None:
        if math.isfinite(t):
            ahead, faded = now - t, self.now_less_t + DRIFT * (now - self._now)
            known = abs(ahead - self.now_less_t) <= JUMP_S
            self.now_less_t, self._now = min(ahead, faded) if known else ahead, now


class Assembly:
    """Source of readings with the motion of another stream.

    Args:
        delay_s: delay of the motion's stamps behind the wrench's [s].
        follow: load for tracking this delay; None for a constant delay.
        X_FS: (7,) [w x y z, position] of the sensor in the posed frame.
        weight_removed: the robot has removed the weight from the wrench. Readings contain the
            acceleration instead of the specific force; an IMU raises DrakeTeleopError.

    Attributes:
        lag_s: delay of the readings [s].
    """

    live = True

    def __init__(
        self,
        parts: Parts,
        *,
        cutoff_hz: float | None = 30.0,
        delay_s: float = 0.0,
        follow: Identification | None = None,
        X_FS: Array = NOWHERE,
        weight_removed: bool = False,
    ) -> None:
        if weight_removed and parts.told == IMU:
            raise without_orientation("the source")
        self._parts, self._delay, self.dt = parts, delay_s, parts.dt
        self._follower = None
        if follow is not None:
            self._follower = DelayFollower(follow, self.dt, cutoff_hz, delay_s)
        self._window = Window(cutoff_hz, X_FS, np.zeros(3) if weight_removed else _GRAVITY)
        self.lag_s = max(0.0, delay_s)
        if cutoff_hz is not None:
            self.lag_s = max(0.0, 0.5 * SMOOTHER_WINDOW / cutoff_hz + delay_s)
        self._clocks = _Offset(), _Offset()
        self._motions: deque[tuple[float, Array]] = deque()
        self._waiting: deque[Part] = deque(maxlen=round(_KEPT_S / self.dt))

    @property
    def delay_s(self) -> float:
        """Present delay of the motion [s]."""
        return self._delay if self._follower is None else self._follower.delay_s

    def read(self, timeout_s: float) -> list[Reading] | None:
        """See `Source`."""
        came = self._parts.read(timeout_s)
        if came is None:
            return None
        return [reading for part, now in came for reading in self.take(part, now)]

    def take(self, part: Part, now: float) -> list[Reading]:
        """Return the readings that are complete with a part received at `now`."""
        if part.stream == WRENCH:
            self._clocks[0].follow(part.t, now)
            self._waiting.append(part)
        elif part.stream == self._parts.told:
            self._clocks[1].follow(part.t, now)
            shift = -self.delay_s
            if self._parts.two_clocks:
                shift += self._clocks[1].now_less_t - self._clocks[0].now_less_t
            for t, motion in self._window.take(part, now):
                self._keep(t + shift, motion)
        found = []
        while self._waiting and (reading := self._whole(self._waiting[0])) is not None:
            self._waiting.popleft()
            found.append(reading)
        return found

    def _keep(self, t: float, motion: Array) -> None:
        motions = self._motions
        if motions and not motions[-1][0] - STALE_S < t < motions[-1][0] + _KEPT_S:
            motions.clear()  # another clock: wrenches on the old one would wait forever
            waiting = [each for each in self._waiting if not abs(each.t - t) > _KEPT_S]
            self._waiting = deque(waiting, self._waiting.maxlen)
        if math.isfinite(t) and (not motions or t > motions[-1][0]):
            motions.append((t, motion))
            while t - motions[0][0] > _KEPT_S:
                motions.popleft()

    def _whole(self, part: Part) -> Reading | None:
        """Return the reading, stale if without motion; None while its motion is pending."""
        values, flags, motions = np.zeros(VALUES), part.flags, self._motions
        values[:6] = part.values
        if not math.isfinite(part.t):
            return Reading(part.number, part.t, values, flags)
        if not motions or part.t > motions[-1][0]:
            return None
        at = bisect_right(motions, part.t, key=lambda each: each[0])
        after, before = motions[min(at, len(motions) - 1)], motions[max(0, at - 1)]
        if part.t < before[0] or after[0] - before[0] > STALE_S:
            return Reading(part.number, part.t, values, flags | Flag.STALE)
        share = (part.t - before[0]) / max(after[0] - before[0], 1e-9)
        values[6:] = before[1] + share * (after[1] - before[1])
        if self._follower is not None and not flags and np.isfinite(part.values).all():
            self._follower.take((part.t, values[6:]), part.values, before, after)
        return Reading(part.number, part.t, values, flags)

    def close(self) -> None:
        """See `Source`."""
        self._parts.close()
