"""Continuous loop with a delay: exact unstable poles, delay margin and windows of stable delays.

The loop L(s) = N(s) / D(s) e^(-s RTT) is cut at the displayed force (Walton and Marshall 1987; T58,
T59). Invalid signs, or N of higher order than D, raise DrakeTeleopError.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DelayedLoop:
    """Loop L(s) = N(s) / D(s) e^(-s delay), or a grid (...) of such loops."""

    numerator: Array  #: coefficients (..., n + 1), highest power first
    denominator: Array  #: coefficients, at least of the numerator's order
    delay: Array  #: (...) [s], not negative

    def __post_init__(self) -> None:
        numerator = np.atleast_1d(np.asarray(self.numerator, dtype=float))
        denominator = np.atleast_1d(np.asarray(self.denominator, dtype=float))
        delay = np.asarray(self.delay, dtype=float)
        if not np.all(delay >= 0):
            raise DrakeTeleopError("the delay of the loop is negative", remedy="give it in seconds")
        missing = denominator.shape[-1] - numerator.shape[-1]
        if missing < 0 or not np.all(denominator[..., 0]):
            raise DrakeTeleopError(
                "the loop's numerator is of higher order than its denominator",
                remedy="strip leading zeros, or add the lag that every real device has",
            )
        numerator = np.concatenate([np.zeros((*numerator.shape[:-1], missing)), numerator], axis=-1)
        grid = np.broadcast_shapes(numerator.shape[:-1], denominator.shape[:-1], delay.shape)
        order = denominator.shape[-1]
        object.__setattr__(self, "numerator", np.broadcast_to(numerator, (*grid, order)))
        object.__setattr__(self, "denominator", np.broadcast_to(denominator, (*grid, order)))
        object.__setattr__(self, "delay", np.broadcast_to(delay, grid))

    @classmethod
    def from_control(cls, system: Any, delay: ArrayLike = 0.0) -> DelayedLoop:
        """Return the loop of a continuous control.TransferFunction or StateSpace."""
        import control

        if system.ninputs != 1 or system.noutputs != 1 or not system.isctime():
            raise DrakeTeleopError(
                "the loop must be continuous and have one input and one output",
                remedy="pass frequency and response of a sampled loop to margins_of_response",
            )
        transfer = control.tf(system)
        return cls(
            np.trim_zeros(transfer.num[0][0], "f"),
            np.trim_zeros(transfer.den[0][0], "f"),
            np.asarray(delay),
        )

    def to_control(self, omega: ArrayLike) -> Any:
        """Return a single loop as `control.FRD` at omega (n,) [rad/s]."""
        import control

        omega = np.asarray(omega, dtype=float)
        return control.frd(self(1j * omega), omega)

    def __call__(self, s: ArrayLike) -> Complex:
        """Return the loop L(s) (n, *grid) at s (n,) [rad/s]."""
        s = np.asarray(s, dtype=complex)
        return self._at(s.reshape(s.shape + (1,) * self.delay.ndim))

    def __getitem__(self, cell: Any) -> DelayedLoop:
        return DelayedLoop(self.numerator[cell], self.denominator[cell], self.delay[cell])

    @property
    def high_frequency_gain(self) -> Array:
        """Limit rho of |L(jw)| for large w."""
        return np.abs(self.numerator[..., 0] / self.denominator[..., 0])

    def _at(self, s: Any) -> Complex:
        ratio = polynomial_value(self.numerator, s) / polynomial_value(self.denominator, s)
        return ratio * np.exp(-s * self.delay)


def held_device(axis: OneAxis) -> tuple[Array, Array, Array]:
    """Return mass [kg], damping [N s/m] and stiffness [N/m] of hand and device together."""
    mass = checked_positive(
        np.asarray(axis.hand_mass) + axis.device_mass, "mass of hand and device"
    )
    damping = checked_positive(
        np.asarray(axis.hand_damping) + axis.device_damping, "damping of hand and device"
    )
    stiffness = np.asarray(axis.hand_stiffness, dtype=float)
    if not np.all(stiffness >= 0):
        raise DrakeTeleopError("the stiffness of the hand is negative")
    return mass, damping, stiffness


def station_loop(axis: OneAxis, *, contact: bool = True) -> DelayedLoop:
    """Return the station's loop, cut at the displayed force; `contact=False` removes the wall.

    L = k_f l_p G (gamma (b_e s + k_e) + M s^2) / (m s^2 + b s + k) e^(-2 s T), with
    G = g / (s^2 + k_v s + g + (b_e s + k_e) / m_s), g = k_v k_p, or G = 1 for an ideal servo;
    m, b, k of hand and device together; M the displayed tool mass; other symbols as in `one_axis`.
    """
    if not contact:
        axis = replace(axis, wall_stiffness=0.0, wall_damping=0.0)
    scale = axis.force_scale * axis.position_scale
    numerator = stack_coefficients(
        scale * axis.displayed_tool_mass,
        scale * axis.gamma * axis.wall_damping,
        scale * axis.gamma * axis.wall_stiffness,
    )
    denominator = stack_coefficients(*held_device(axis))
    if not axis.ideal_servo:
        slave_mass = checked_positive(axis.slave_mass, "mass of the slave")
        gain = axis.velocity_gain * axis.position_gain
        servo = stack_coefficients(
            1.0,
            axis.velocity_gain + axis.wall_damping / slave_mass,
            gain + axis.wall_stiffness / slave_mass,
        )
        numerator = numerator * np.asarray(gain)[..., None]
        denominator = multiply_polynomials(servo, denominator)
    return DelayedLoop(numerator, denominator, np.asarray(2 * axis.delay))


def gain_crossings(loop: DelayedLoop) -> tuple[Array, Array]:
    """Return where |L(jw)| = 1, and the direction in which growing delay moves poles there.

    Returns:
        frequency (..., n) [rad/s], NaN if unused; direction (..., n): 1 into the right half plane
            (|L| falls), -1 out of it, 0 if unused.
    """
    excess = squared_magnitude(loop.denominator) - squared_magnitude(loop.numerator)
    slope = excess[..., :-1] * np.arange(excess.shape[-1] - 1, 0, -1)
    roots = polynomial_roots(excess)
    x = np.where((roots.imag == 0) & (roots.real > 0), roots.real, np.nan)
    for _ in range(2):  # refine the eigenvalues
        step = polynomial_value(excess[..., None, :], x) / polynomial_value(slope[..., None, :], x)
        x = np.where(np.abs(step) < 1e-3 * x, x - step, x)
    direction = np.nan_to_num(np.sign(polynomial_value(slope[..., None, :], x)))
    return np.sqrt(x), direction


def unstable_poles(loop: DelayedLoop) -> Array:
    """Return the number (...) of closed-loop poles in the right half plane; may be inf."""
    frequency, direction = gain_crossings(loop)
    excess_turns = (loop.delay[..., None] - _first_delay(loop, frequency)) * frequency / (2 * np.pi)
    crossed = np.ceil(np.clip(np.nan_to_num(excess_turns), 0, None))
    count = _unstable_without_delay(loop) + 2 * np.sum(direction * crossed, axis=-1)
    endless = (loop.delay > 0) & (loop.high_frequency_gain >= 1)
    return np.where(endless, np.inf, count)


def delay_margin(loop: DelayedLoop) -> Array:
    """Return the additional delay (...) [s] at which the loop becomes unstable.

    inf: stable with any delay; 0: already unstable.
    """
    return margin_of_delay(loop, unstable_poles(loop) == 0)[0]


def stable_delays(loop: DelayedLoop, longest: float) -> list[tuple[float, float]]:
    """Return the windows (start, end) of delay [s] in [0, longest] with a stable single loop."""
    if loop.delay.ndim:
        raise DrakeTeleopError("windows of stable delays are those of a single loop")
    if loop.high_frequency_gain >= 1:
        return []
    frequency, direction = gain_crossings(loop)
    changes = [(0.0, int(_unstable_without_delay(loop))), (longest, 0)]
    for w, sign, first in zip(frequency, direction, _first_delay(loop, frequency), strict=True):
        if sign:
            changes += [(float(t), 2 * int(sign)) for t in np.arange(first, longest, 2 * np.pi / w)]
    windows: list[tuple[float, float]] = []
    unstable = 0
    for (start, change), (end, _) in itertools.pairwise(sorted(changes)):
        unstable += change
        if unstable == 0 and end > start:
            if windows and windows[-1][1] == start:
                start = windows.pop()[0]
            windows.append((start, end))
    return windows


def margin_of_delay(loop: DelayedLoop, stable: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the delay margin (...) [s] and the frequency [rad/s] of the crossing pole."""
    frequency, _ = gain_crossings(loop)
    past = np.mod(phase_lag_to_minus_one(loop, frequency), 2 * np.pi)
    margin, at = min_without_nan(past / frequency, frequency)
    neutral = loop.high_frequency_gain >= 1
    return np.where(stable & ~neutral, margin, 0.0), at


def phase_lag_to_minus_one(loop: DelayedLoop, frequency: Array) -> Array:
    """Return the phase lag [rad] that rotates L to the angle of -1, at frequencies (..., n)."""
    along = DelayedLoop(
        loop.numerator[..., None, :], loop.denominator[..., None, :], loop.delay[..., None]
    )
    with np.errstate(invalid="ignore"):  # NaN without a crossing
        return angle_of(-along._at(1j * frequency))


def _first_delay(loop: DelayedLoop, frequency: Array) -> Array:
    undelayed = replace(loop, delay=np.zeros_like(loop.delay))
    return np.mod(phase_lag_to_minus_one(undelayed, frequency), 2 * np.pi) / frequency


def _unstable_without_delay(loop: DelayedLoop) -> Array:
    roots = polynomial_roots(loop.numerator + loop.denominator)
    size = np.max(np.abs(roots), axis=-1, initial=0.0, keepdims=True)
    return np.sum(roots.real > 1e-9 * size, axis=-1).astype(float)


def min_without_nan(value: Array, at: Array, axis: int = -1) -> tuple[Array, Array]:
    """Return the minimum without NaN, or inf, and the entry of `at` there."""
    value = np.where(np.isnan(value), np.inf, value)
    if not value.shape[axis]:
        shape = np.delete(value.shape, axis)
        return np.full(shape, np.inf), np.full(shape, np.nan)
    index = np.expand_dims(np.argmin(value, axis=axis), axis)
    least = np.take_along_axis(value, index, axis).squeeze(axis)
    at = np.take_along_axis(np.broadcast_to(at, value.shape), index, axis).squeeze(axis)
    return least, np.where(np.isfinite(least), at, np.nan)


def angle_of(value: Complex) -> Array:
    """Return the angle of complex numbers [rad]."""
    return np.arctan2(value.imag, value.real)


def checked_positive(value: ArrayLike, what: str) -> Array:
    """Return the value as an array; raise DrakeTeleopError unless it is positive."""
    value = np.asarray(value, dtype=float)
    if not np.all(value > 0):
        raise DrakeTeleopError(f"the {what} is not positive")
    return value


def stack_coefficients(*coefficients: Any) -> Array:
    """Return broadcast polynomial coefficients, stacked along the last axis."""
    return np.stack(np.broadcast_arrays(*(np.asarray(c, float) for c in coefficients)), axis=-1)


def multiply_polynomials(p: Array, q: Array) -> Array:
    """Return the product of polynomials (..., n), highest power first."""
    n = q.shape[-1]
    grid = np.broadcast_shapes(p.shape[:-1], q.shape[:-1])
    product = np.zeros((*grid, p.shape[-1] + n - 1))
    for i in range(p.shape[-1]):
        product[..., i : i + n] += p[..., i : i + 1] * q
    return product


def squared_magnitude(p: Array) -> Array:
    """Return |p(jw)|^2 as a polynomial in x = w^2."""
    powers = np.arange(p.shape[-1] - 1, -1, -1)
    return multiply_polynomials(p, p * (-1.0) ** powers)[..., ::2] * (-1.0) ** powers


def polynomial_value(p: Array, x: Any) -> Any:
    """Return p(x); coefficients (..., n), highest power first."""
    value = p[..., 0] + 0 * x
    for i in range(1, p.shape[-1]):
        value = value * x + p[..., i]
    return value


def polynomial_roots(p: Array) -> Complex:
    """Return the roots (..., n) of polynomials; a leading zero gives a very large root."""
    order = p.shape[-1] - 1
    if order == 0:
        return np.zeros((*p.shape[:-1], 0), dtype=complex)
    far = 1e-30 * np.max(np.abs(p), axis=-1)
    lead = np.where(p[..., 0] == 0, np.where(far == 0, 1.0, far), p[..., 0])
    companion = np.zeros((*p.shape[:-1], order, order))
    companion[..., np.arange(1, order), np.arange(order - 1)] = 1
    companion[..., 0, :] = -p[..., 1:] / lead[..., None]
    return np.linalg.eigvals(companion).astype(complex)
