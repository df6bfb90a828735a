"""How an IMU sits on the sensor: its rotation, its place and its clock, from the data.

An accelerometer at Io, a point of the body of S, measures in its own axes I, up to a bias,

    R_SI s_I = s + alpha x p + omega x (omega x p) = s + K p,    p = p_SoIo_S

with the specific force s of So and the motion of S. A pose with position gives s, omega and alpha,
hence R_SI and p. A pose without position gives s only as far as So does not accelerate: R_SI is
found, and p would be the distance from the centre of the rotation, so it is not told. The wrench of
a rigid load gives p as well: force and torque, Eqs. (1)-(2), are linear in s, and while a shift of
the accelerometer looks like a shift of the centre of mass in the force alone, the torque knows the
centre of mass from the weight.

Standard deviations are those of a jackknife that leaves out one of 20 blocks of time after the
other, so that residuals may be coloured. They contain noise, but not what interpolation between the
samples of a pose does (about 0.1 % of p) nor the errors of scale of an accelerometer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read.alignment import low_pass, low_passed, measured, resample, undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.delay import estimate_delay
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.rotations import rotation_matrices

RIGHT_ANGLED_DEG = 5.0
"""A mounting within this angle of one that only exchanges axes counts as right-angled."""
ROTATION_KNOWN_DEG = 1.0
"""A rotation is determined if its standard deviation about every axis is below this."""
LEVER_KNOWN = 0.005
"""A coordinate of the accelerometer is determined if its standard deviation is below this [m]."""
BELIEVABLE, BELIEVABLE_GRAVITY = 0.05, 0.005
"""A fit that leaves more of the variance than this tells nothing; the second is for specific forces
that are compared with gravity alone, as accelerations may look like a rotation."""
CLOCK = 0.05
"""Clocks of IMU and pose that disagree by more are worth a note [s]."""
_REACH = 1.0
_CUTOFF = 8.0
_SAMPLES = 1500
_BLOCKS = 20
# A drift is believed from this likelihood ratio (twice its logarithm), and if it amounts to this.
_LIKELIHOOD, _DRIFTED = 50.0, 0.01
# Singular values of the scaled Jacobian below this share of the largest: nothing determines them.
_RANK = 1e-5
# Least ratio of a motion's power to that of its noise, for a lever arm 5 % too short at worst.
_SIGNAL = 20.0


@dataclass(frozen=True)
class LeverArm:
    """Where the accelerometer is.

    Args:
        p_SoIo_S: (3,) its position in S, on top of what the description says already [m].
        deviations: (3,) standard deviations [m]; inf along an axis that the motion says nothing of.
        source: "pose" or "wrench", which told it.
    """

    p_SoIo_S: NDArray[np.float64]
    deviations: NDArray[np.float64]
    source: str

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(3,) the verdict on each axis."""
        return self.deviations < LEVER_KNOWN


@dataclass(frozen=True)
class Mounting:
    """The IMU against the pose.

    Args:
        R_SI: (3, 3) rotation from the axes of the IMU's stream to S: `imu.frame` on top of what the
            description says already.
        lag_s: how far the IMU's clock is behind that of the pose: the best single shift [s].
        lag_middle_s: the same in the middle of the record, if the clocks drift; else `lag_s`.
        middle_s: that instant, on the clock of the pose [s].
        drift: growth of the lag [s/s]; 0 if the record does not show one.
        unexplained: share of the variance of the specific force that this leaves.
        unexplained_turning: the same of the angular velocity; None without a gyroscope.
        mirrored: a reflection fits decisively better, so R_SI means nothing.
        speed_ratio: rms angular speed of the gyroscope over that of the pose; None without one.
        deviations_deg: (3,) standard deviations of R_SI about the axes of S [deg]; inf about an
            axis that the motion says nothing of.
        lever: of the accelerometer; None if the pose has no position.
    """

    R_SI: NDArray[np.float64]
    lag_s: float
    lag_middle_s: float
    middle_s: float
    drift: float
    unexplained: float
    unexplained_turning: float | None
    mirrored: bool
    speed_ratio: float | None
    deviations_deg: NDArray[np.float64]
    lever: LeverArm | None

    @property
    def angle_deg(self) -> float:
        """Angle of R_SI [deg]."""
        return _angle_deg(self.R_SI)

    @property
    def right_angled(self) -> NDArray[np.float64]:
        """(3, 3) the nearest of the 24 rotations that only exchange and turn axes."""
        return max(right_angled_rotations(), key=lambda R: float(np.trace(R.T @ self.R_SI)))

    @property
    def oblique_deg(self) -> float:
        """Angle between R_SI and `right_angled` [deg]."""
        return _angle_deg(self.right_angled.T @ self.R_SI)

    @property
    def is_right_angled(self) -> bool:
        return self.oblique_deg < RIGHT_ANGLED_DEG

    @property
    def fits(self) -> bool:
        """Whether IMU and pose agree, so that the rest means something."""
        turning = self.unexplained_turning is None or self.unexplained_turning < BELIEVABLE
        if self.lever is not None:
            return not self.mirrored and turning and self.unexplained < BELIEVABLE
        # Without a position the pose knows the angular velocity, but not the acceleration.
        known = self.unexplained_turning is not None or self.unexplained < BELIEVABLE_GRAVITY
        return not self.mirrored and turning and known

    @property
    def determined(self) -> bool:
        """Whether the motion shows the rotation about every axis."""
        return self.fits and bool((self.deviations_deg < ROTATION_KNOWN_DEG).all())


def find_mounting(imu: Log, pose: Log, *, position: bool = False) -> Mounting | None:
    """Rotation, place and clock of an IMU, from two readings of the same log.

    First the clock, to about 10 ms within +-1 s: at every shift, free linear maps of specific force
    and, with a gyroscope, angular velocity are fitted, which do not depend on the axes; a drift of
    the clocks is fitted on top, see `_drift`. Then
    R s_imu + b = s_pose + K p, and R omega_imu + b = omega_pose, by nonlinear least squares over
    the rotation R, constants b, the lever arm p and the clock, from the rotation of Kabsch (1976);
    the two sensors are weighted by their own residuals. All signals are low-passed at 8 Hz.

    Args:
        imu: specific force and angular velocity from the IMU.
        pose: the same from the pose alone.
        position: whether the pose has positions. If not, its specific force is minus gravity, p is
            the place of the accelerometer from the centre of the rotation, and it is not told.

    Returns:
        None if the specific force changes by less than 0.5 m/s^2 (rms), or gaps leave less than a
        tenth of the record, so that nothing can be said.
    """
    start, stop = max(imu.t[0], pose.t[0]), min(imu.t[-1], pose.t[-1])
    reach = min(_REACH, 0.2 * float(stop - start))
    cutoff = min(_CUTOFF, 0.2 / imu.dt)
    sensed, smooth = low_passed(imu, cutoff), low_passed(pose, cutoff)
    t = _times(start + reach, stop - reach, (imu, pose), cutoff)
    if len(t) < _SAMPLES // 10:
        return None
    # Without a gyroscope both readings have the angular velocity of the pose.
    omega_imu, omega = (resample(t, log.t, log.angular_velocity) for log in (imu, pose))
    gyroscope = not np.allclose(omega_imu, omega, atol=1e-9)
    pairs = _pairs(t, sensed, smooth, gyroscope)
    expected = pairs[0][0]
    if expected.var(axis=0).sum() < 0.25:
        return None
    # A gyroscope tells the clock. Without one, a long lever arm must not be taken for a late clock.
    arm = np.zeros((len(t), 1))
    if not gyroscope:
        omega, alpha = (resample(t, pose.t, x) for x in smooth.motion[1:])
        arm = _lever_matrix(omega, alpha).reshape(-1, 9)
    lag = _best_shift(t, pairs, imu.t, reach, arm)
    centre = float(t.mean())
    middle, drift = _drift(t, pairs, imu.t, lag, 2 * cutoff * float(t[-1] - t[0]))
    R, mirrored = _kabsch(resample(t + middle + drift * (t - centre), imu.t, pairs[0][1]), expected)

    # With the clock known, more of the record can be used.
    margin = min(reach, abs(middle) + 0.5 * abs(drift) * float(stop - start) + 0.1)
    t = _times(start + margin, stop - margin, (imu, pose), cutoff)
    pairs = _pairs(t, sensed, smooth, gyroscope)
    turned = resample(t, pose.t, smooth.angular_velocity)
    K = _lever_matrix(turned, resample(t, pose.t, smooth.angular_acceleration))

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
        turning, at = _turned(R, x[:3]), t + x[3] + drift * (t - centre)
        signals = [resample(at, imu.t, signal) @ turning.T - y for y, signal in pairs]
        signals[0] -= K @ x[4:7]
        return np.hstack(signals) + x[7:]

    first = np.zeros(7 + 3 * len(pairs))
    first[3] = middle
    first[7:] = -residual(first).mean(axis=0)
    x, deviations = _solved(residual, first)
    lever = None
    if position:
        lever = LeverArm(x[4:7], np.where(_shown(K, pose, cutoff), deviations[4:7], np.inf), "pose")
    left = residual(x).reshape(len(t), -1, 3).var(axis=0).sum(axis=1)
    shares = [float(part / y.var(axis=0).sum()) for part, (y, _) in zip(left, pairs, strict=True)]
    speeds = [float(np.linalg.norm(log.angular_velocity, axis=1).std()) for log in (imu, pose)]
    return Mounting(
        R_SI=_turned(R, x[:3]),
        lag_s=lag if drift else float(x[3]),
        lag_middle_s=float(x[3]),
        middle_s=centre,
        drift=drift,
        unexplained=shares[0],
        unexplained_turning=shares[1] if len(shares) > 1 else None,
        mirrored=mirrored,
        speed_ratio=speeds[0] / speeds[1] if speeds[1] > 0.05 else None,
        deviations_deg=np.degrees(deviations[:3]),
        lever=lever,
    )


def lever_arm_from_wrench(log: Log) -> LeverArm | None:
    """The lever arm of an accelerometer from the wrench of a rigid load that touches nothing.

    Least squares of the wrench over offsets, load, delay and lever arm together: the wrench of
    Eqs. (1)-(2) with s = s_measured - K p. Forces and torques are weighted by their own residuals.
    All signals are low-passed at 8 Hz.

    Args:
        log: its specific force is that of the accelerometer, in the axes of S.

    Returns:
        None if the load leaves more than 5 % of the wrench's variance: then something is touched;
        or if gaps leave less than a tenth of the record.
    """
    cutoff = min(_CUTOFF, 0.2 / log.dt)
    delay = estimate_delay(log, None) or 0.0
    smooth = low_passed(undelayed(log, delay), cutoff)
    margin = min(0.1, 0.1 * float(smooth.t[-1] - smooth.t[0]))
    t = _times(smooth.t[0] + margin, smooth.t[-1] - margin, (smooth,), cutoff)
    if len(t) < _SAMPLES // 10:
        return None
    wrench = resample(t, smooth.t, smooth.wrench)

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
        s, omega, alpha = (resample(t + x[3], smooth.t, signal) for signal in smooth.motion)
        s = s - _lever_matrix(omega, alpha) @ x[:3]
        return contact_wrench(wrench, x[4:10], s, omega, alpha, x[10:])

    motion = [resample(t, smooth.t, signal) for signal in smooth.motion]
    V = regressor(*motion)
    size = np.linalg.norm(V - V.mean(axis=0), axis=(0, 1)) + 1e-12
    centred = ((V - V.mean(axis=0)) / size).reshape(-1, 10)
    phi = np.linalg.lstsq(centred, (wrench - wrench.mean(axis=0)).ravel(), rcond=_RANK)[0] / size
    offsets = (wrench - V @ phi).mean(axis=0)
    x, deviations = _solved(residual, np.concatenate([np.zeros(4), offsets, phi]))
    left, whole = (y.var(axis=0).reshape(2, 3).sum(axis=1) for y in (residual(x), wrench))
    if (left > BELIEVABLE * whole).any():
        return None
    shown = _shown(_lever_matrix(*motion[1:]), smooth, cutoff)
    return LeverArm(x[:3], np.where(shown, deviations[:3], np.inf), "wrench")


def _drift(
    t: NDArray[np.float64],
    pairs: _Pairs,
    t_imu: NDArray[np.float64],
    lag: float,
    independent: float,
) -> tuple[float, float]:
    """Lag in the middle and its growth, by Gauss-Newton steps from a constant lag.

    Args:
        t: (N,) times on the clock of the pose.
        pairs: of signals at `t` and signals of the IMU at `t_imu`, each mapped freely.
        t_imu: times on the clock of the IMU.
        lag: the best constant lag [s].
        independent: how many samples of such signals say something new.

    Returns:
        the lag in the middle [s] and its growth [s/s]; `lag` and 0 if the likelihood of a constant
        lag is not exceeded decisively, or the lag changes by less than 10 ms.
    """
    tau = t - t.mean()
    found = np.array([lag, 0.0])
    start = cost = np.inf
    for step in range(10):
        rows, left, cost = [], [], 0.0
        for y, x in pairs:
            at = t + found[0] + found[1] * tau
            moved, h = resample(at, t_imu, x), 0.01
            rate = (resample(at + h, t_imu, x) - resample(at - h, t_imu, x)) / (2 * h)
            basis = np.column_stack([np.ones(len(t)), moved])
            Q = np.linalg.qr(basis)[0]
            mapped = np.linalg.lstsq(basis, y, rcond=1e-6)[0][1:]
            # What a small shift does, beyond what another map could do as well.
            effects = [rate @ mapped, tau[:, None] * (rate @ mapped)]
            size = np.sqrt(y.var(axis=0).sum() + 1e-12)
            rows.append(np.stack([(e - Q @ (Q.T @ e)).ravel() / size for e in effects], axis=1))
            left.append(((y - y.mean(axis=0)) - (moved - moved.mean(axis=0)) @ mapped) / size)
            cost += float(left[-1].var(axis=0).sum())
        if step == 0:
            start = cost
        residual = np.concatenate([r.ravel() for r in left])
        found = found + np.linalg.lstsq(np.vstack(rows), residual, rcond=1e-6)[0]
    gain = independent * np.log(start / (cost + 1e-300))
    moved_s = abs(found[1]) * float(t[-1] - t[0])
    if gain < _LIKELIHOOD or moved_s < _DRIFTED:
        return lag, 0.0
    return float(found[0]), float(found[1])


def describe_mounting(
    description: Description, source: str, read: Callable[[Description], Log]
) -> tuple[Description, tuple[str, ...]]:
    """The description with what `imu.frame: auto` and `imu.position: auto` leave to the data.

    Args:
        description: with an IMU that has `auto`.
        source: its file, for messages.
        read: reads a log as it is described.

    Returns:
        the description, and notes that say what was found and how to write it down.

    Raises:
        DrakeTeleopError: if the data do not determine it.
    """
    imu = description.imu
    assert imu is not None

    def described(**changes: Any) -> Description:
        return description.model_copy(update={"imu": imu.model_copy(update=changes)})

    frame: Any = imu.frame
    position: Any = imu.position
    notes: list[str] = []
    start = "sensor" if frame == "auto" else frame
    mounting = None
    if description.pose is not None:
        alone = read(description.model_copy(update={"imu": None}))
        at_Io = read(described(frame=start, position=(0.0, 0.0, 0.0)))
        mounting = find_mounting(at_Io, alone, position=description.pose.position is not None)
    if frame == "auto":
        found = _believed(mounting, f"{source}:imu.frame")
        frame = tuple(map(tuple, found.R_SI.tolist()))
        notes += _rotation_notes(found)
    if position == "auto":
        at_Io = read(described(frame=frame, position=(0.0, 0.0, 0.0)))
        lever = _lever(mounting, at_Io, f"{source}:imu.position")
        position = tuple(lever.p_SoIo_S.tolist())
        notes.append(
            f"imu.position found: {_millimetres(lever)} mm, from the {lever.source}; write it into"
            f" the description as imu.position: {_written(lever.p_SoIo_S)}"
        )
    return described(frame=frame, position=position), tuple(notes)


def _believed(mounting: Mounting | None, where: str) -> Mounting:
    """The mounting, if the data determine its rotation."""
    if mounting is None:
        what = "the specific force hardly changes, or gaps leave too little of it"
        remedy = "turn the sensor about two axes"
    elif mounting.mirrored:
        what = "the axes of the IMU are those of the pose mirrored"
        remedy = "exchange two of its columns, or change imu.sign"
    elif not mounting.fits:
        what = f"no rotation brings IMU and pose together ({_left(mounting)})"
        remedy = "find wrong units, signs or clocks by `drake-teleop inspect` with `frame: sensor`"
    elif not mounting.determined:
        worst = float(mounting.deviations_deg.max())
        what = f"one direction is known to {worst:.2g} deg only (standard deviation)"
        remedy = "turn the sensor about two axes, by more than 30 deg"
    else:
        return mounting
    raise DrakeTeleopError(
        f"the data do not determine the rotation of the IMU: {what}",
        where=where,
        remedy=f"{remedy}, or give a rotation matrix",
    )


def _left(found: Mounting) -> str:
    shares = {"specific force": found.unexplained, "angular velocity": found.unexplained_turning}
    return ", ".join(f"{v:.2g} of the {k}'s variance" for k, v in shares.items() if v is not None)


def _rotation_notes(found: Mounting) -> list[str]:
    nearest = found.right_angled.astype(int).tolist()
    away = f"{found.oblique_deg:.1f} deg from the right-angled mounting {nearest}"
    sure = f"{float(found.deviations_deg.max()):.2g} deg"
    notes = [
        f"imu.frame found: {away}, standard deviation {sure}; write it into the description as"
        f" imu.frame: {_written(found.R_SI)}"
    ]
    if not found.is_right_angled:
        notes.append(f"warning: the IMU is mounted obliquely, {away}: check that it is meant so")
    if abs(found.lag_s) > CLOCK:
        notes.append(
            f"warning: the clock of the IMU lags that of the pose by {found.lag_s:.3f} s, which"
            f" stays so unless you add {-found.lag_s:.3f} to imu.time.offset"
        )
    return notes


def _lever(mounting: Mounting | None, at_Io: Log, where: str) -> LeverArm:
    """The lever arm from the pose, or else from the wrench."""
    lever = None
    if mounting is not None and mounting.fits:
        lever = mounting.lever
    if lever is None or not lever.determined.all():
        other = lever_arm_from_wrench(at_Io)
        if lever is None or (other and other.determined.sum() > lever.determined.sum()):
            lever = other
    if lever is None:
        raise DrakeTeleopError(
            "nothing tells the place of the accelerometer: the pose has no fitting position, and"
            " the wrench is not that of a load alone",
            where=where,
            remedy="give imu.position in metres, or pose.position",
        )
    if not lever.determined.all():
        axes = ", ".join(a for a, known in zip("xyz", lever.determined, strict=True) if not known)
        raise DrakeTeleopError(
            f"the motion does not determine {axes} of the accelerometer's place"
            f" ({_millimetres(lever)} mm, from the {lever.source})",
            where=where,
            remedy="turn faster, about more axes, or give imu.position in metres",
        )
    return lever


def _written(x: NDArray[np.float64]) -> list:
    """To four digits, without -0.0."""
    return list((np.round(x, 4) + 0.0).tolist())


def _millimetres(lever: LeverArm) -> str:
    return ", ".join(
        f"{axis} {1e3 * value:.1f} +- {1e3 * deviation:.1f}" if deviation < 1 else f"{axis} unknown"
        for axis, value, deviation in zip("xyz", lever.p_SoIo_S, lever.deviations, strict=True)
    )


def right_angled_rotations() -> list[NDArray[np.float64]]:
    """The 24 rotations (3, 3) that exchange and turn axes, the identity first."""
    matrices = [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return [R for R in matrices if np.linalg.det(R) > 0]


_Pairs = list[tuple[NDArray[np.float64], NDArray[np.float64]]]


def _times(start: float, stop: float, logs: Sequence[Log], cutoff: float) -> NDArray[np.float64]:
    """Evenly spaced times at which all logs have samples, and not bridges over gaps."""
    t = np.linspace(start, stop, _SAMPLES)
    known = [np.interp(t, log.t, measured(log, cutoff).astype(float)) > 0.99 for log in logs]
    return t[np.all(known, axis=0)]


def _pairs(t: NDArray[np.float64], imu: Log, pose: Log, gyroscope: bool) -> _Pairs:
    """Of each sensor, the signal (N, 3) of the pose at `t`, and that of the IMU on its clock."""
    pairs = [(resample(t, pose.t, pose.specific_force), imu.specific_force)]
    if gyroscope:
        pairs.append((resample(t, pose.t, pose.angular_velocity), imu.angular_velocity))
    return pairs


def _best_shift(
    t: NDArray[np.float64],
    pairs: _Pairs,
    t_imu: NDArray[np.float64],
    reach: float,
    arm: NDArray[np.float64],
) -> float:
    """The shift at which free maps leave least, beyond what is linear in `arm` (N, k)."""
    U, singular, _ = np.linalg.svd(arm - arm.mean(axis=0), full_matrices=False)
    U = U[:, singular > 1e-3 * singular[0]]

    def beyond(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return x - U @ (U.T @ x)

    def cost(shift: float) -> float:
        return sum(_unmapped(beyond(y), beyond(resample(t + shift, t_imu, x))) for y, x in pairs)

    step = 0.01
    shifts = step * np.arange(-round(reach / step), round(reach / step) + 1)
    costs = np.array([cost(shift) for shift in shifts])
    best = int(np.argmin(costs))
    lag = float(shifts[best])
    if 0 < best < len(shifts) - 1:
        below, least, above = costs[best - 1 : best + 2]
        lag += 0.5 * step * float((below - above) / (below - 2 * least + above + 1e-300))
    return lag


def _kabsch(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """The rotation R of the smallest |y - R x - b|, and whether a reflection fits far better."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    U, _, Vt = np.linalg.svd(y.T @ x)
    side = np.linalg.det(U @ Vt)
    R, mirror = U @ np.diag([1.0, 1.0, side]) @ Vt, U @ np.diag([1.0, 1.0, -side]) @ Vt
    direct, reflected = (((y - x @ M.T) ** 2).sum() / (y**2).sum() for M in (R, mirror))
    return R, bool(reflected < 0.25 * direct and reflected < 0.05)


def _turned(R: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """R turned by a rotation vector (3,) in S [rad]."""
    return rotation_matrices(vector[None], "rotation_vector")[0] @ R


def _lever_matrix(omega: NDArray[np.float64], alpha: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3, 3) K = [alpha x] + [omega x]^2: K p is what p adds to the specific force."""
    W = _cross(omega)
    return _cross(alpha) + W @ W


def _cross(v: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.zeros((len(v), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[:, k, j], matrix[:, j, k] = v[:, i], -v[:, i]
    return matrix


def _shown(K: NDArray[np.float64], log: Log, cutoff: float) -> NDArray[np.bool_]:
    """(3,) lever arms that the motion shows, and not only its noise.

    Noise in K is not seen in residuals: it draws the lever arm to zero, with confidence. The power
    per Hz of white noise that was differentiated grows with the square of the frequency at least,
    so below the cut-off there is at most a seventh of what is in the octave above it.
    """
    alpha = log.angular_acceleration
    above = low_pass(alpha, log.dt, 2 * cutoff) - low_pass(alpha, log.dt, cutoff)
    noise = above.var(axis=0) / 7
    K = K - K.mean(axis=0)
    information = np.einsum("nij,nik->jk", K, K) / len(K)
    alone = 1 / np.diag(np.linalg.pinv(information, rcond=1e-12, hermitian=True))
    return alone > _SIGNAL * (noise.sum() - noise)


def _solved(
    residual: Callable[[NDArray[np.float64]], NDArray[np.float64]], x: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least squares of (N, 3 k) residuals, every three channels weighted by their own.

    Returns:
        the solution (n,), and its standard deviations (n,), inf for what is not determined.
    """
    from scipy.optimize import least_squares

    for _ in range(2):
        errors = residual(x)
        power = errors.reshape(len(errors), -1, 3).var(axis=(0, 2))
        sigma = np.repeat(np.sqrt(power + 1e-12 * power.max() + 1e-30), 3)
        found = least_squares(lambda z, s=sigma: (residual(z) / s).ravel(), x, x_scale="jac")
        x = found.x
    width = len(sigma) * (len(errors) // _BLOCKS)
    return x, _jackknife(found.jac, found.fun, width)


def _jackknife(
    jacobian: NDArray[np.float64], residual: NDArray[np.float64], width: int
) -> NDArray[np.float64]:
    """(n,) standard deviations of a least-squares solution, leaving out blocks of `width` rows."""
    size = np.linalg.norm(jacobian, axis=0) + 1e-300
    _, singular, Vt = np.linalg.svd(jacobian / size, full_matrices=False)
    known = singular > _RANK * singular[0]
    basis = Vt[known].T
    J = (jacobian / size) @ basis
    gram, steps = J.T @ J, []
    for start in range(0, len(J) - width + 1, width):
        part, error = J[start : start + width], residual[start : start + width]
        steps.append(np.linalg.lstsq(gram - part.T @ part, part.T @ error, rcond=1e-12)[0])
    spread = (np.array(steps) - np.mean(steps, axis=0)) @ basis.T / size
    deviations = np.sqrt((len(steps) - 1) / len(steps) * np.sum(spread**2, axis=0))
    unknown = np.linalg.norm(Vt[~known], axis=0) > 1e-3
    return np.where(unknown, np.inf, deviations)


def _unmapped(y: NDArray[np.float64], x: NDArray[np.float64]) -> float:
    """Share of the variance of y (N, 3) that no affine map of x (N, 3) explains."""
    y, x = y - y.mean(axis=0), x - x.mean(axis=0)
    both, total = x.T @ y, float((y * y).sum()) + 1e-12 * len(y)
    explained = (both * (np.linalg.pinv(x.T @ x, rcond=1e-12, hermitian=True) @ both)).sum()
    return float((y * y).sum() - explained) / total


def _angle_deg(R: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))
