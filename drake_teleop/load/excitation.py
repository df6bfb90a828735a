"""Excitation of the load: Fourier trajectories (Eqs. 9-10), how well they condition the fit, and
a design that respects the limits of arm, sensor and room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench, regressor

Array: TypeAlias = NDArray[np.float64]
SensorMotion: TypeAlias = Callable[[Array, Array, Array], tuple[Array, Array, Array, Array, Array]]
"""(q, qd, qdd), each (T, n) -> (s, omega, alpha) in S and p_WS, each (T, 3), and R_WS (T, 3, 3)."""

_CHUNK = 2**14
# Samples of one period on which the optimiser looks, how far it stays inside the limits (its grid
# misses up to 0.9 % of a fifth harmonic's peak), and the sharpness of its smooth maximum.
_GRID, _MARGIN, _SHARPNESS = 120, 0.985, 150.0

# The descent's stages: (sharpness of the smooth condition number, weight of the penalty, number
# of iterations). At 1 all eigenvalues guide, from afar; at 12 nearly the extreme ones alone.
_STAGES = ((1.0, 10.0, 20), (12.0, 50.0, 40), (12.0, 1000.0, 20))


@dataclass(frozen=True)
class FourierTrajectory:
    """A periodic joint trajectory, Eqs. (9)-(10).

    q_i(t) = q0_i + sum_k rho_ik sin(2 pi k f t) + delta_ik cos(2 pi k f t), k = 1..N.

    Args:
        q0: (n,) constant part [rad].
        rho: (n, N) sine coefficients [rad].
        delta: (n, N) cosine coefficients [rad].
        frequency: base frequency f [Hz].
    """

    q0: Array
    rho: Array
    delta: Array
    frequency: float

    @classmethod
    def at_rest(
        cls, q0: ArrayLike, sine: ArrayLike, cosine: ArrayLike, frequency: float
    ) -> FourierTrajectory:
        """A trajectory whose velocity and acceleration vanish at both ends of the period.

        The paper's form starts with velocity 2 pi f sum(k rho) and acceleration
        -(2 pi f)^2 sum(k^2 delta). Both are eliminated: the free coefficients are coordinates in
        the subspace where they are zero, and the k-th harmonic is scaled by 1/k.

        Args:
            q0: (n,) constant part [rad]. The trajectory starts at q0 + sum(delta).
            sine, cosine: (n, N - 1) free coefficients [rad].
            frequency: base frequency [Hz].
        """
        sine, cosine = np.asarray(sine, float), np.asarray(cosine, float)
        rest_rho, rest_delta = _rest_bases(sine.shape[-1] + 1)
        return cls(np.asarray(q0, float), sine @ rest_rho, cosine @ rest_delta, frequency)

    @property
    def period(self) -> float:
        """Length of one period [s]."""
        return 1.0 / self.frequency

    def evaluate(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """Position, velocity, acceleration at times `t` (...) [s], each (..., n) in rad and s."""
        rate = 2 * np.pi * self.frequency * np.arange(1, self.rho.shape[1] + 1)
        phase = np.multiply.outer(np.asarray(t, float), rate)
        sine, cosine = np.sin(phase), np.cos(phase)
        rho, delta = self.rho.T, self.delta.T
        q = self.q0 + sine @ rho + cosine @ delta
        qd = (rate * cosine) @ rho - (rate * sine) @ delta
        qdd = -(rate**2 * sine) @ rho - (rate**2 * cosine) @ delta
        return q, qd, qdd

    def scaled(self, factor: float) -> FourierTrajectory:
        """The same motion with `factor` times the amplitude about q0."""
        return FourierTrajectory(self.q0, factor * self.rho, factor * self.delta, self.frequency)


class ConditionNumbers(NamedTuple):
    """How evenly a motion determines the ten parameters (1 would be perfect); see
    `condition_numbers` for what is divided by what."""

    kappa10: float
    kappa_w10: float


def condition_numbers(
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    noise: tuple[float, float] = (0.25, 0.012),
    length: float = 0.1,
) -> ConditionNumbers:
    """Largest over smallest singular value of the stacked V of Eq. (5), ten columns, no offsets.

    kappa10: V as it is, in SI units (an implicit length of 1 m); at least sqrt(8/3) = 1.633 for
    every motion, and not better for stronger excitation. kappa_w10: force rows divided by
    sigma_f, torque rows by sigma_tau, columns multiplied by diag(1, L, L, L, L^2 ... L^2), so
    that it measures parameters of like size in like noise.

    Args:
        s, omega, alpha: (T, 3) specific force, angular velocity and acceleration, in S.
        noise: (sigma_f [N], sigma_tau [N m]) of the wrench.
        length: L [m], about the load's radius of gyration, never larger.

    Returns:
        The numbers; infinite for a motion that leaves a parameter undetermined.
    """
    arrays = [np.asarray(values, float) for values in (s, omega, alpha)]
    force, torque = np.zeros((10, 10)), np.zeros((10, 10))
    for start in range(0, len(arrays[0]), _CHUNK):
        chunk = _grams(*(array[start : start + _CHUNK] for array in arrays))
        force, torque = force + chunk[0], torque + chunk[1]
    whitened = _whiten(force, torque, noise, length)
    return ConditionNumbers(_condition(force + torque), _condition(whitened))


@dataclass(frozen=True)
class ExcitationLimits:
    """What an excitation trajectory must respect. Collisions of the arm with itself are not in it.

    Args:
        q_lower, q_upper: (n,) joint positions [rad].
        velocity, acceleration: (n,) largest joint speeds [rad/s] and accelerations [rad/s^2].
        phi: (10,) the heaviest load to expect, about the origin of S: predicts the wrench.
        force, torque: largest |f| [N] and |tau| [N m] of that load at the sensor.
        points_S: (P, 3) points fixed to S that stay in the box [m]; the wrist centre, the tip.
        box_W: (2, 3) lower and upper corner of the box, in W [m].
    """

    q_lower: Array
    q_upper: Array
    velocity: Array
    acceleration: Array
    phi: Array
    force: float
    torque: float
    points_S: Array
    box_W: Array


def limit_use(
    trajectory: FourierTrajectory,
    sensor_motion: SensorMotion,
    limits: ExcitationLimits,
    *,
    rate: float = 1000.0,
) -> dict[str, float]:
    """How much of each limit one period uses, sampled at `rate` [Hz]: 1 is all, above 1 violates.

    Returns:
        The largest use by name: position, velocity, acceleration, force, torque, box.
    """
    t = np.arange(0.0, trajectory.period, 1.0 / rate)
    joints = trajectory.evaluate(t)
    uses = _uses(joints, sensor_motion(*joints), limits)
    return {name: float(np.max(use)) for name, use in uses}


def design_excitation(
    sensor_motion: SensorMotion,
    limits: ExcitationLimits,
    *,
    home: ArrayLike,
    seed: int,
    period: float = 6.0,
    harmonics: int = 5,
    noise: tuple[float, float] = (0.25, 0.012),
    length: float = 0.1,
) -> FourierTrajectory:
    """A trajectory at rest at both ends, inside all limits, with a low kappa_w10.

    Descends (L-BFGS, limits as penalties) from the best of 64 random candidates; then `limit_use`
    on its own 1 kHz grid decides. A local optimum, the same for the same arguments.

    Args:
        sensor_motion: the arm's kinematics.
        limits: what has to be respected.
        home: (n,) posture around which candidates are drawn [rad].
        seed: of the candidates.
        period: T = 1/f [s].
        harmonics: N of Eq. (9).
        noise, length: of kappa_w10, see `condition_numbers`.

    Raises:
        DrakeTeleopError: if nothing was found that respects the limits.
    """
    problem = _Problem(sensor_motion, limits, 1.0 / period, harmonics, noise, length)
    candidates = problem.candidates(np.asarray(home, float), np.random.default_rng(seed), 64)
    log_kappa, uses = problem.evaluate(candidates, sharpness=1.0)
    order = np.argsort(log_kappa + 10 * np.maximum(uses.max(axis=1) - 1, 0))
    worst = []
    for start in candidates[order[:3]]:
        trajectory = problem.trajectory(problem.minimise(start))
        for factor in (1.0, 0.995, 0.98):
            candidate = trajectory.scaled(factor)
            use = limit_use(candidate, sensor_motion, limits)
            if all(value <= 1 for value in use.values()):
                return candidate
        worst.append(max((value, name) for name, value in use.items()))
    value, name = min(worst)
    raise DrakeTeleopError(
        f"no excitation trajectory respects all limits: the best uses {value:.1%} of its {name}",
        where="excitation",
        remedy="widen the limits, lengthen the period or choose another home posture",
    )


@dataclass
class _Problem:
    """The optimiser's view: unknowns x = [q0, sine, cosine], all evaluated in batches."""

    sensor_motion: SensorMotion
    limits: ExcitationLimits
    frequency: float
    harmonics: int
    noise: tuple[float, float]
    length: float

    def trajectory(self, x: Array) -> FourierTrajectory:
        n = len(self.limits.velocity)
        sine, cosine = x[n:].reshape(2, n, self.harmonics - 1)
        return FourierTrajectory.at_rest(x[:n], sine, cosine, self.frequency)

    def candidates(self, home: Array, rng: np.random.Generator, count: int) -> Array:
        """(count, unknowns) random motions about `home` near the speed and acceleration limits."""
        rate = 2 * np.pi * self.frequency * np.sqrt(self.harmonics)
        size = 0.5 * np.minimum(self.limits.velocity / rate, self.limits.acceleration / rate**2)
        spread = np.tile(np.repeat(size, self.harmonics - 1), 2)
        motion = spread * rng.standard_normal((count, len(spread)))
        return np.hstack([home + 0.1 * rng.standard_normal((count, len(home))), motion])

    def evaluate(self, points: Array, sharpness: float) -> tuple[Array, Array]:
        """Smooth log kappa_w10 (B,) and smooth use of each limit (B, 6) at points (B, unknowns)."""
        joints = self._joints(points)
        motion = self.sensor_motion(*joints)
        kinematics = (values.reshape(len(points), _GRID, 3) for values in motion[:3])
        gram = _whiten(*_grams(*kinematics), self.noise, self.length)
        logs = 0.5 * np.log(np.maximum(np.linalg.eigvalsh(gram), 1e-12))
        log_kappa = _smooth_max(logs, sharpness) + _smooth_max(-logs, sharpness)
        uses = [use.reshape(len(points), -1) for _, use in _uses(joints, motion, self.limits)]
        return log_kappa, np.column_stack([_smooth_max(use, _SHARPNESS) for use in uses])

    def _joints(self, points: Array) -> tuple[Array, ...]:
        """(q, qd, qdd) of all points, one after the other, (B * _GRID, n) each.

        They are linear in the unknowns: the motions of unit coefficients, times the coefficients.
        """
        n, free = len(self.limits.velocity), self.harmonics - 1
        unit = np.eye(2 * free)
        basis = FourierTrajectory.at_rest(
            np.zeros(2 * free), unit[:, :free], unit[:, free:], self.frequency
        )
        coefficients = points[:, n:].reshape(-1, 2, n, free).swapaxes(1, 2).reshape(-1, n, 2 * free)
        moving = [
            np.swapaxes(coefficients @ values.T, 1, 2)
            for values in basis.evaluate(np.arange(_GRID) / (_GRID * self.frequency))
        ]
        moving[0] += points[:, np.newaxis, :n]
        return tuple(np.ascontiguousarray(values.reshape(-1, n)) for values in moving)

    def minimise(self, x: Array) -> Array:
        """Descends from x on log kappa plus a penalty for what exceeds the limits."""
        from scipy.optimize import minimize

        def penalised(x: Array, sharpness: float, weight: float) -> tuple[float, Array]:
            step = 1e-6
            log_kappa, uses = self.evaluate(np.vstack([x, x + step * np.eye(len(x))]), sharpness)
            excess = np.maximum(uses - _MARGIN, 0)
            values = log_kappa + weight * np.sum(excess**2, axis=1)
            return float(values[0]), (values[1:] - values[0]) / step

        for sharpness, weight, iterations in _STAGES:
            options = {"maxiter": iterations}
            x = minimize(penalised, x, (sharpness, weight), "L-BFGS-B", jac=True, options=options).x
        return x


def _rest_bases(harmonics: int) -> tuple[Array, Array]:
    """(N - 1, N) each: from free coefficients to rho and to delta, with rest at the ends."""
    k = np.arange(1.0, harmonics + 1)
    bases = [np.linalg.qr(row[:, np.newaxis], mode="complete")[0][:, 1:] for row in (k**0, k)]
    return (bases[0] / k[:, np.newaxis]).T, (bases[1] / k[:, np.newaxis]).T


def _grams(s: Array, omega: Array, alpha: Array) -> tuple[Array, Array]:
    """V^T V of (..., T, 3) motions: of the force rows and of the torque rows, (..., 10, 10)."""
    v = regressor(s, omega, alpha)
    rows = (v[..., :3, :], v[..., 3:, :])
    stacked = [part.reshape(*part.shape[:-3], -1, 10) for part in rows]
    force, torque = (np.swapaxes(part, -1, -2) @ part for part in stacked)
    return force, torque


def _whiten(force: Array, torque: Array, noise: tuple[float, float], length: float) -> Array:
    scale = np.array([1.0] + 3 * [length] + 6 * [length**2])
    return (force / noise[0] ** 2 + torque / noise[1] ** 2) * np.multiply.outer(scale, scale)


def _condition(gram: Array) -> float:
    eigenvalues = np.linalg.eigvalsh(gram)
    if eigenvalues[0] <= 1e-13 * eigenvalues[-1]:
        return float("inf")
    return float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))


def _smooth_max(values: Array, sharpness: float) -> Array:
    """Log-sum-exp over the last axis: at least the maximum, and differentiable."""
    top = values.max(axis=-1)
    spread = np.exp(sharpness * (values - top[..., np.newaxis])).sum(axis=-1)
    return top + np.log(spread) / sharpness


def _uses(
    joints: tuple[Array, ...], motion: tuple[Array, ...], limits: ExcitationLimits
) -> list[tuple[str, Array]]:
    """The use of each limit at (T, n) joint samples, (T, ...) each."""
    q, qd, qdd = joints
    s, omega, alpha, p_WS, R_WS = motion
    wrench = non_contact_wrench(s, omega, alpha, limits.phi)
    points = p_WS[:, np.newaxis] + np.swapaxes(R_WS @ np.asarray(limits.points_S).T, 1, 2)
    return [
        ("position", _use_of_range(q, limits.q_lower, limits.q_upper)),
        ("velocity", np.abs(qd) / limits.velocity),
        ("acceleration", np.abs(qdd) / limits.acceleration),
        ("force", np.linalg.norm(wrench[:, :3], axis=1) / limits.force),
        ("torque", np.linalg.norm(wrench[:, 3:], axis=1) / limits.torque),
        ("box", _use_of_range(points, *np.asarray(limits.box_W))),
    ]


def _use_of_range(values: Array, lower: Array, upper: Array) -> Array:
    """0 in the middle of the range, 1 at its ends."""
    return np.abs(2 * values - (upper + lower)) / (upper - lower)
