"""Z-width of a sampled device: the stiffest virtual wall that it can render.

The device with damping b [N s/m] moves continuously; its position x is sampled every Ts [s]. The
wall of stiffness K [N/m] and damping B [N s/m] responds d samples later with a held force:

    H(z) = z^-d (K + B (z - 1) / (Ts z)),    force of the wall at t_k: f_k = (H x)_k.

The wall is passive if and only if b exceeds the right side of (T62); a passive wall is stable.
Invalid signs, and delays that are no whole number, raise DrakeTeleopError.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.delayed_loop import checked_positive
from drake_teleop.lab.analysis.one_axis import Complex

Array = NDArray[np.float64]


def required_damping(response: ArrayLike, angle: ArrayLike, period: float) -> Array:
    """Return the device damping [N s/m] that a sampled wall H(z) requires for passivity (T62).

    `response`: H(e^(j theta)) at angles theta in (0, pi]; their maximum counts. `period`: sample
    time [s].
    """
    checked_positive(period, "period")
    H = np.asarray(response, dtype=complex)
    # Re[(1 - e^(-j theta)) H] / (1 - cos theta), without cancellation
    return period / 2 * (H.real - H.imag / np.tan(np.asarray(angle, dtype=float) / 2))


def passive_damping_of(wall: Callable[[Complex], Complex], period: float) -> float:
    """Return the smallest device damping [N s/m] that makes a sampled wall H(z) passive.

    `wall` returns H at z (n,): a function or a sampled control.TransferFunction.
    """
    from scipy.optimize import minimize_scalar

    def damping(angle: Any) -> Any:
        return required_damping(wall(np.exp(1j * angle)), angle, period)

    angles = np.linspace(0, np.pi, 4097)[1:]
    step = angles[0]
    at_rest = (4 * damping(angles[:1]) - damping(angles[1:2])) / 3  # even in theta
    values = damping(angles)
    peak = angles[np.argmax(values)]
    refined = minimize_scalar(
        lambda angle: -damping(np.array([angle]))[0],
        bounds=(max(peak - step, step / 2), min(peak + step, np.pi)),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return float(max(at_rest[0], values.max(), -refined.fun))


def passive_damping(
    stiffness: ArrayLike, wall_damping: ArrayLike, period: float, delay: int = 0
) -> Array:
    """Return the smallest device damping [N s/m] that makes a spring-damper wall passive.

    `period`: sample time [s]; `delay`: of the wall, in samples.
    """
    K, B = np.asarray(stiffness, dtype=float), np.asarray(wall_damping, dtype=float)
    return _maximum(_cosine_coefficients(K, B, period, delay))[0]


def passive_stiffness(
    device_damping: ArrayLike, wall_damping: ArrayLike, period: float, delay: int = 0
) -> Array:
    """Return the largest stiffness [N/m] of a passive wall; 0 if there is none.

    Dampings in N s/m; `period`: sample time [s]; `delay`: of the wall, in samples.
    """
    b, B = np.broadcast_arrays(
        checked_positive(device_damping, "damping of the device"), wall_damping
    )
    checked_positive(period, "period")
    K = np.maximum((b + B) / (period * (delay + 0.5)), 0.0)  # upper bound, from theta = 0
    share = _cosine_coefficients(np.ones_like(K), np.zeros_like(K), period, delay)
    # The required damping is convex in K: Newton's method from above finds the largest root.
    for _ in range(50):
        required, angle = _maximum(_cosine_coefficients(K, B, period, delay))
        slope = _cosine_sum(share, angle)
        slope = np.maximum(slope, 1e-300)  # if stiffness reduces the damping, K becomes 0
        step = np.minimum(np.maximum(required - b, 0.0) / slope, K)
        K = K - step
        if np.all(step <= 1e-12 * K):
            break
    return K


def passive_friction(
    stiffness: ArrayLike, wall_damping: ArrayLike, period: float, resolution: float
) -> Array:
    """Return the Coulomb friction [N] that compensates an encoder's resolution Delta [m].

    It is the largest force error, Delta / 2 (|K + B / Ts| + |B / Ts|). The device's damping must
    also make the wall itself passive.
    """
    checked_positive(period, "period")
    checked_positive(resolution, "resolution of the encoder")
    rate = np.asarray(wall_damping, dtype=float) / period
    return resolution / 2 * (np.abs(np.asarray(stiffness, dtype=float) + rate) + np.abs(rate))


def friction_stiffness(
    device_damping: ArrayLike, friction: ArrayLike, period: float, resolution: float
) -> Array:
    """Return the largest stiffness [N/m] of a passive undamped wall: min(2 b / Ts, 2 f_c / Delta).

    b is the device's damping, f_c its Coulomb friction, Delta the encoder's resolution [m]; the
    wall has no delay. Diolaiti, Niemeyer, Barbagli and Salisbury (2006).
    """
    b = checked_positive(device_damping, "damping of the device")
    checked_positive(period, "period")
    checked_positive(resolution, "resolution of the encoder")
    if np.any(np.asarray(friction) < 0):
        raise DrakeTeleopError("the friction of the device is negative")
    return np.minimum(2 * b / period, 2 * np.asarray(friction) / resolution)


def stable_stiffness(
    mass: ArrayLike,
    damping: ArrayLike,
    wall_damping: ArrayLike,
    period: float,
    delay: int = 0,
    *,
    hand_stiffness: ArrayLike = 0.0,
) -> Array:
    """Return the wall stiffness [N/m] at which the loop becomes unstable; 0: unstable with any.

    `mass` [kg], `damping` [N s/m] and `hand_stiffness` [N/m]: device and hand together; `period`:
    sample time [s]; `delay`: of the wall, in samples.
    """
    mass, damping, B, hand = np.broadcast_arrays(mass, damping, wall_damping, hand_stiffness)
    state, held = _sampled_device(mass, damping, hand, period)
    _require_whole_samples(delay)
    angles = np.geomspace(1e-4, np.pi, 1000 * (1 + delay // 5)).reshape(-1, *(1,) * mass.ndim)
    critical = _critical_stiffness(state, held, B, period, delay, angles)
    crossed = (critical.imag[1:] < 0) != (critical.imag[:-1] < 0)
    low = np.broadcast_to(angles[:-1], crossed.shape)[crossed]
    high = np.broadcast_to(angles[1:], crossed.shape)[crossed]
    below = critical.imag[:-1][crossed] < 0
    cell = np.nonzero(crossed)[1:]
    part = (state[cell], held[cell], B[cell], period, delay)
    for _ in range(50):
        middle = (low + high) / 2
        same = (_critical_stiffness(*part, middle).imag < 0) == below
        low, high = np.where(same, middle, low), np.where(same, high, middle)

    real = np.full((len(angles), *mass.shape), np.inf)
    real[:-1][crossed] = _critical_stiffness(*part, high).real
    real[-1] = critical.real[-1]  # always real at z = -1
    limit = np.min(np.where(real > 0, real, np.inf), axis=0)
    poles = sampled_poles(mass, damping, limit / 2, B, period, delay, hand_stiffness=hand)
    return np.where(np.max(np.abs(poles), axis=-1) < 1, limit, 0.0)


def sampled_poles(
    mass: ArrayLike,
    damping: ArrayLike,
    stiffness: ArrayLike,
    wall_damping: ArrayLike,
    period: float,
    delay: int = 0,
    *,
    hand_stiffness: ArrayLike = 0.0,
) -> Complex:
    """Return the closed loop's multipliers (..., 3 + delay) over a sample.

    `stiffness` is the wall's [N/m]; for the other arguments see `stable_stiffness`.
    """
    mass, damping, K, B, hand = np.broadcast_arrays(
        mass, damping, stiffness, wall_damping, hand_stiffness
    )
    state, held = _sampled_device(mass, damping, hand, period)
    _require_whole_samples(delay)
    rate = B / period
    # States: position, velocity, positions of the last d + 1 samples
    force = np.zeros((*mass.shape, 3 + delay))
    now = 0 if delay == 0 else 1 + delay
    force[..., now], force[..., 2 + delay] = K + rate, -rate
    step = np.zeros((*mass.shape, 3 + delay, 3 + delay))
    step[..., :2, :2] = state
    step[..., :2, :] -= held[..., :, None] * force[..., None, :]
    step[..., 2, 0] = 1
    for i in range(delay):
        step[..., 3 + i, 2 + i] = 1
    return np.linalg.eigvals(step).astype(complex)


def _cosine_coefficients(K: Array, B: Array, period: float, delay: int) -> Array:
    checked_positive(period, "period")
    _require_whole_samples(delay)
    K, B = np.broadcast_arrays(K, B)
    coefficients = np.zeros((*K.shape, delay + 2))
    coefficients[..., 0] = K * period / 2
    coefficients[..., 1 : delay + 1] = (K * period)[..., None]
    coefficients[..., delay + 1] = -B
    return coefficients


def _cosine_sum(coefficients: Array, angle: Array) -> Array:
    order = np.arange(coefficients.shape[-1])
    return np.sum(coefficients * np.cos(order * angle[..., None]), axis=-1)


def _maximum(coefficients: Array) -> tuple[Array, Array]:
    order = np.arange(coefficients.shape[-1])
    angles = np.linspace(0, np.pi, 64 * len(order) + 1)
    step = angles[1]
    values = coefficients @ np.cos(np.outer(order, angles))
    # A parabola through three values finds the higher of two nearly equal peaks.
    before = np.concatenate([values[..., 1:2], values[..., :-1]], axis=-1)
    after = np.concatenate([values[..., 1:], values[..., -2:-1]], axis=-1)
    bend = 2 * values - before - after
    peaked = (values >= before) & (values >= after) & (bend > 0)
    rise = np.where(peaked, (after - before) ** 2 / np.where(peaked, 8 * bend, 1.0), 0.0)
    start = angles[np.argmax(values + rise, axis=-1)]
    angle = start
    for _ in range(5):
        slope = -np.sum(coefficients * order * np.sin(order * angle[..., None]), axis=-1)
        curve = -np.sum(coefficients * order**2 * np.cos(order * angle[..., None]), axis=-1)
        move = np.where(curve < 0, -slope / np.where(curve < 0, curve, 1.0), 0.0)
        angle = np.clip(angle + move, np.maximum(start - step, 0), np.minimum(start + step, np.pi))
    better = _cosine_sum(coefficients, angle) >= _cosine_sum(coefficients, start)
    angle = np.where(better, angle, start)
    return _cosine_sum(coefficients, angle), angle


def _sampled_device(
    mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike, period: float
) -> tuple[Array, Array]:
    """Return the matrices Phi (..., 2, 2), Gamma (..., 2) of the device under held force."""
    from scipy.linalg import expm

    m, b = (
        checked_positive(mass, "mass of the device"),
        checked_positive(damping, "damping of the device"),
    )
    k = np.asarray(stiffness, dtype=float)
    if not np.all(k >= 0):
        raise DrakeTeleopError("the stiffness of the hand is negative")
    checked_positive(period, "period")
    rates = np.zeros((*m.shape, 3, 3))
    rates[..., 0, 1] = 1
    rates[..., 1, 0], rates[..., 1, 1], rates[..., 1, 2] = -k / m, -b / m, 1 / m
    motion = expm(rates * period)
    return motion[..., :2, :2], motion[..., :2, 2]


def _critical_stiffness(
    state: Array, held: Array, B: Array, period: float, delay: int, angle: Array
) -> Complex:
    """Return the stiffness K that puts a pole on e^(j theta), if it is real."""
    z = np.exp(1j * angle)
    trace = state[..., 0, 0] + state[..., 1, 1]
    det = state[..., 0, 0] * state[..., 1, 1] - state[..., 0, 1] * state[..., 1, 0]
    answer = held[..., 0] * (z - state[..., 1, 1]) + state[..., 0, 1] * held[..., 1]
    return -(z**delay) * (z * (z - trace) + det) / answer - B / period * (1 - 1 / z)


def _require_whole_samples(delay: int) -> None:
    if delay < 0 or delay != int(delay):
        raise DrakeTeleopError("the delay is not a whole number of samples from 0 on")
