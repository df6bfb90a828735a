"""How far a loop with a delay is from its limit: gain, phase and delay margins, unstable poles.

The loop is broken at the force that the operator feels. Hand and device, Z_h + Z_m, move under it;
what comes back is the felt impedance:

    L(s) = Z_felt / (Z_h + Z_m) = N(s) / D(s) e^(-s RTT),    Z_felt = Z_to - Z_m,

so that the closed loop's poles are the roots of D(s) + N(s) e^(-s RTT). The delay is exact. Such a
loop needs no search: |N(jw)| = |D(jw)| is a polynomial in w^2, and only at its roots can a pole
cross the imaginary axis, at delays 2 pi / w apart and always in the same direction (Walton and
Marshall 1987). That gives the number of unstable poles, the delay margin and the windows of stable
delays for whole grids of parameters. `encirclements` counts the same poles from Nyquist's curve,
for loops that are known by their frequency response only.

Where the felt force contains the load's acceleration in free motion and the slave follows ideally,
|L| tends to a constant rho at high frequency (a neutral equation). With rho >= 1 any delay however
small leaves infinitely many unstable poles; with rho < 1 the count is finite, as for other loops.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.analysis.one_axis import Complex, OneAxis
from drake_teleop.errors import DrakeTeleopError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DelayedLoop:
    """L(s) = N(s) / D(s) e^(-s delay), or a grid of such loops.

    Args:
        numerator, denominator: coefficients (..., n + 1), highest power first; leading dimensions
            are those of the grid and broadcast.
        delay: (...) [s].

    Raises:
        DrakeTeleopError: the delay is negative, or N is of higher order than D.
    """

    numerator: Array
    denominator: Array
    delay: Array

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
        """The loop of a continuous control.TransferFunction or StateSpace, one input, one output.

        Raises:
            DrakeTeleopError: more inputs or outputs, or sampled (take its frequency response to
                `margins_of_response` instead).
        """
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
        """A single loop with its delay as control.FrequencyResponseData at omega (n,) [rad/s]."""
        import control

        omega = np.asarray(omega, dtype=float)
        return control.frd(self(1j * omega), omega)

    def __call__(self, s: ArrayLike) -> Complex:
        """L at s [rad/s], (n,): (n, *grid)."""
        s = np.asarray(s, dtype=complex)
        return self._at(s.reshape(s.shape + (1,) * self.delay.ndim))

    def __getitem__(self, cell: Any) -> DelayedLoop:
        """Part of the grid."""
        return DelayedLoop(self.numerator[cell], self.denominator[cell], self.delay[cell])

    @property
    def high_frequency_gain(self) -> Array:
        """rho = lim |L(jw)| as w grows."""
        return np.abs(self.numerator[..., 0] / self.denominator[..., 0])

    def _at(self, s: Any) -> Complex:
        """L at s that broadcasts with the grid."""
        ratio = _value(self.numerator, s) / _value(self.denominator, s)
        return ratio * np.exp(-s * self.delay)


def held_device(axis: OneAxis) -> tuple[Array, Array, Array]:
    """Mass, damping and stiffness [kg, N s/m, N/m] of hand and device together.

    Raises:
        DrakeTeleopError: the mass or the damping is not positive, or the stiffness negative.
    """
    return _held(
        np.asarray(axis.hand_mass) + axis.device_mass,
        np.asarray(axis.hand_damping) + axis.device_damping,
        axis.hand_stiffness,
    )


def station_loop(axis: OneAxis, *, contact: bool = True) -> DelayedLoop:
    """The loop of a station at the felt force, in contact with its wall or in free motion.

    L = k_f l_p G (gamma (b_e s + k_e) + M s^2) / (m s^2 + b s + k) e^(-2 s T), with
    G = g / (s^2 + k_v s + g + (b_e s + k_e) / m_s), g = k_v k_p, or 1 for an ideal servo;
    m, b, k of hand and device. Fields of the axis may be arrays that broadcast: that is the grid.

    Raises:
        DrakeTeleopError: no mass or damping of hand and device together, or no slave mass.
    """
    if not contact:
        axis = replace(axis, wall_stiffness=0.0, wall_damping=0.0)
    scale = axis.force_scale * axis.position_scale
    numerator = _stack(
        scale * axis.felt_tool_mass,
        scale * axis.gamma * axis.wall_damping,
        scale * axis.gamma * axis.wall_stiffness,
    )
    denominator = _stack(*held_device(axis))
    if not axis.ideal_servo:
        slave_mass = _positive(axis.slave_mass, "mass of the slave")
        gain = axis.velocity_gain * axis.position_gain
        servo = _stack(
            1.0,
            axis.velocity_gain + axis.wall_damping / slave_mass,
            gain + axis.wall_stiffness / slave_mass,
        )
        numerator = numerator * np.asarray(gain)[..., None]
        denominator = _multiply(servo, denominator)
    return DelayedLoop(numerator, denominator, np.asarray(2 * axis.delay))


def gain_crossings(loop: DelayedLoop) -> tuple[Array, Array]:
    """Where |L(jw)| = 1, and which way closed-loop poles cross there as the delay grows.

    Returns:
        frequency (..., n) [rad/s], NaN where there are fewer than n; direction (..., n): 1 into
        the right half plane (|L| falls), -1 out of it (|L| rises), 0 where there is none.
    """
    excess = _squared_magnitude(loop.denominator) - _squared_magnitude(loop.numerator)
    slope = excess[..., :-1] * np.arange(excess.shape[-1] - 1, 0, -1)
    roots = _roots(excess)
    x = np.where((roots.imag == 0) & (roots.real > 0), roots.real, np.nan)
    for _ in range(2):  # the eigenvalues' last digits
        step = _value(excess[..., None, :], x) / _value(slope[..., None, :], x)
        x = np.where(np.abs(step) < 1e-3 * x, x - step, x)
    direction = np.nan_to_num(np.sign(_value(slope[..., None, :], x)))
    return np.sqrt(x), direction


def unstable_poles(loop: DelayedLoop) -> Array:
    """Closed-loop poles in the right half plane (...), exact; inf if there is no end of them."""
    frequency, direction = gain_crossings(loop)
    late = (loop.delay[..., None] - _first_delay(loop, frequency)) * frequency / (2 * np.pi)
    crossed = np.ceil(np.clip(np.nan_to_num(late), 0, None))
    count = _undelayed_count(loop) + 2 * np.sum(direction * crossed, axis=-1)
    endless = (loop.delay > 0) & (loop.high_frequency_gain >= 1)
    return np.where(endless, np.inf, count)


def delay_margin(loop: DelayedLoop) -> Array:
    """What may be added to the delay before a pole reaches the imaginary axis (...) [s].

    inf if any delay may be added, 0 if the loop is unstable as it is.
    """
    return _delay_margin(loop, unstable_poles(loop) == 0)[0]


def stable_delays(loop: DelayedLoop, longest: float) -> list[tuple[float, float]]:
    """Windows of delay in [0, longest] where a single loop is stable; its own delay is not used.

    Raises:
        DrakeTeleopError: a grid of loops.
    """
    if loop.delay.ndim:
        raise DrakeTeleopError("windows of stable delays are those of a single loop")
    if loop.high_frequency_gain >= 1:
        return []
    frequency, direction = gain_crossings(loop)
    changes = [(0.0, int(_undelayed_count(loop)))]
    for w, sign, first in zip(frequency, direction, _first_delay(loop, frequency), strict=True):
        if sign:
            changes += [(float(t), 2 * int(sign)) for t in np.arange(first, longest, 2 * np.pi / w)]
    return _windows(changes, longest, inside=lambda count: count == 0)


@dataclass(frozen=True)
class Margins:
    """Margins of a loop or of each loop of a grid (...); those of an unstable loop are 1, 0 and 0.

    Args:
        unstable_poles: of the closed loop.
        gain, gain_frequency: factor by which L may grow, and where it then meets -1 [rad/s].
        phase, phase_frequency: by which L may turn either way [rad], and where [rad/s].
        delay, delay_frequency: that may be added [s], and where [rad/s].

    Where there is no limit the margin is inf and its frequency NaN.
    """

    unstable_poles: Array
    gain: Array
    gain_frequency: Array
    phase: Array
    phase_frequency: Array
    delay: Array
    delay_frequency: Array


def margins(loop: DelayedLoop) -> Margins:
    """Gain, phase and delay margins with the delay exact.

    Phase and delay margins follow from the exact gain crossings. The phase crossings of the gain
    margin are bracketed on a grid of frequencies and bisected, for one loop at a time: for large
    grids of parameters take `delay_margin` and `unstable_poles`.
    """
    unstable = unstable_poles(loop)
    stable = unstable == 0
    frequency, _ = gain_crossings(loop)
    phase, phase_frequency = _least(np.abs(_angle_past_minus_one(loop, frequency)), frequency)
    delay, delay_frequency = _delay_margin(loop, stable)
    limits = [_gain_margin(loop[cell]) for cell in np.ndindex(loop.delay.shape)]
    gain, gain_frequency = np.moveaxis(np.reshape(limits, (*loop.delay.shape, 2)), -1, 0)
    return Margins(
        unstable,
        np.where(stable, gain, 1.0),
        gain_frequency,
        np.where(stable, phase, 0.0),
        phase_frequency,
        delay,
        delay_frequency,
    )


def margins_of_response(
    omega: ArrayLike,
    response: ArrayLike,
    *,
    delay: ArrayLike = 0.0,
    open_loop_poles: int = 0,
    poles_at_origin: int = 0,
    sampled: bool = False,
) -> Margins:
    """The margins of loops that are known by their frequency response, measured or sampled.

    Between frequencies, log |L| and the phase are taken as linear in log w: an error of the second
    order in the spacing. The response of a control.FrequencyResponseData is its `frdata[0, 0]`.

    Args:
        omega: (n,) [rad/s], rising, positive.
        response: L(jw) or L(e^(jw Ts)), (n, ...).
        delay: (...) [s], to be added to the response, exactly.
        open_loop_poles, poles_at_origin, sampled: as in `encirclements`.

    Raises:
        DrakeTeleopError: frequencies that do not rise from above zero; else as in `encirclements`.
    """
    omega = np.asarray(omega, dtype=float)
    if omega.ndim != 1 or not np.all(np.diff(omega, prepend=0.0) > 0):
        raise DrakeTeleopError("the frequencies of a response must rise, from above zero")
    measured, added = np.asarray(response, dtype=complex), np.asarray(delay, dtype=float)
    dimensions = max(measured.ndim - 1, added.ndim)
    w = omega.reshape(-1, *(1,) * dimensions)
    L = measured.reshape(*measured.shape, *(1,) * (dimensions + 1 - measured.ndim))
    L = L * np.exp(-1j * w * added)
    unstable = encirclements(
        L, open_loop_poles=open_loop_poles, poles_at_origin=poles_at_origin, sampled=sampled
    )
    stable = unstable == 0
    log_w, log_gain, angle = np.log(w), np.log(np.abs(L)), _angle(-L)
    turn = np.unwrap(angle, axis=0)

    at_one = _zero_between(log_gain)
    w_c = np.exp(_between(log_w, at_one))
    past = np.mod(_between(turn, at_one), 2 * np.pi)
    phase, phase_frequency = _least(np.minimum(past, 2 * np.pi - past), w_c, axis=0)
    more, more_frequency = _least(past / w_c, w_c, axis=0)

    at_minus = np.where(np.abs(np.diff(angle, axis=0)) < np.pi, _zero_between(angle), np.nan)
    factor = np.exp(-_between(log_gain, at_minus))
    w_p = np.exp(_between(log_w, at_minus))
    factor, factor_frequency = _least(np.where(factor > 1, factor, np.nan), w_p, axis=0)
    return Margins(
        unstable,
        np.where(stable, factor, 1.0),
        factor_frequency,
        np.where(stable, phase, 0.0),
        phase_frequency,
        np.where(stable, more, 0.0),
        more_frequency,
    )


def encirclements(
    response: ArrayLike,
    *,
    open_loop_poles: int = 0,
    poles_at_origin: int = 0,
    sampled: bool = False,
) -> Array:
    """Unstable closed-loop poles (...), from the turns of 1 + L about the origin.

    A continuous response must reach so far that |L| < 1 from there on: 1 + L then stays in the
    right half plane and turns no more. A sampled one must reach half the sampling rate.

    Args:
        response: L at rising frequencies from near zero on, (n, ...).
        open_loop_poles: of L, in the right half plane or outside the unit circle.
        poles_at_origin: of L, at s = 0 or z = 1; the contour passes them on the unstable side.
        sampled: the response is that of a sampled loop.

    Raises:
        DrakeTeleopError: the frequencies are too coarse to follow 1 + L, or end too early.
    """
    difference = 1 + np.asarray(response, dtype=complex)
    steps = np.angle(difference[1:] / difference[:-1])
    if not np.all(np.abs(steps) < np.pi / 2):
        raise DrakeTeleopError(
            "1 + L turns by more than a right angle between two frequencies",
            remedy="take more frequencies there; a loop at its limit cannot be counted",
        )
    if not sampled and not np.all(np.abs(difference[-1] - 1) < 1):
        raise DrakeTeleopError("|L| is not below 1 at the last frequency", remedy="go further up")
    start, end = np.angle(difference[0]), np.angle(difference[-1])
    # At s = 0 itself, or right of the poles there, 1 + L is real.
    start_turn = start + poles_at_origin * np.pi / 2
    turn = np.sum(steps, axis=0) + start_turn - np.pi * np.round(start_turn / np.pi)
    turn = turn - poles_at_origin * np.pi / 2
    if not sampled:
        turn = turn - end
    return open_loop_poles - np.round(turn / np.pi)


def nyquist_frequencies(loop: DelayedLoop) -> Array:
    """Frequencies [rad/s] that suffice to draw or count: 1 + L turns by less than 30 deg a step.

    They reach beyond the last gain crossing of the loop, which is a single one.

    Raises:
        DrakeTeleopError: 1 + L passes so close to the origin that no grid resolves it.
    """
    slow, fast = _breaks(loop)
    crossing, _ = gain_crossings(loop)
    omega = _grid(loop, slow, float(np.nanmax(1.5 * crossing, initial=fast)))
    for _ in range(40):
        difference = 1 + loop(1j * omega)
        wide = np.abs(_angle(difference[1:] / difference[:-1])) > np.pi / 6
        if not wide.any():
            return omega
        omega = np.sort(np.concatenate([omega, (omega[1:][wide] + omega[:-1][wide]) / 2]))
    raise DrakeTeleopError("the loop is at its limit: L passes through -1")


def contact_delay_margin(
    mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike, felt_stiffness: ArrayLike
) -> Array:
    """Largest round trip time [s] of a held device on a wall: m s^2 + b s + k + K e^(-s RTT).

    atan2(b w, m w^2 - k) / w at the highest w with |k - m w^2 + j b w| = K; inf without such a w.

    Raises:
        DrakeTeleopError: mass, damping or the felt stiffness K is not positive, or k negative.
    """
    m, b, k = _held(mass, damping, stiffness)
    K = _positive(felt_stiffness, "felt stiffness of the wall")
    middle = (2 * m * k - b**2) / (2 * m**2)
    root = middle**2 - (k**2 - K**2) / m**2
    with np.errstate(invalid="ignore", divide="ignore"):
        w = np.sqrt(middle + np.sqrt(root))
        return np.where(w > 0, np.arctan2(b * w, m * w**2 - k) / w, np.inf)


def delay_independent_stiffness(mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike) -> Array:
    """Felt stiffness K [N/m] below which contact is stable for every delay.

    b sqrt(k / m - b^2 / 4 m^2) if b^2 < 2 k m, else k.

    Raises:
        DrakeTeleopError: mass or damping is not positive, or the stiffness negative.
    """
    m, b, k = _held(mass, damping, stiffness)
    resonant = b**2 < 2 * k * m
    return np.where(resonant, b * np.sqrt(np.where(resonant, k / m - b**2 / (4 * m**2), 0)), k)


def delay_independent_mass(mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike) -> Array:
    """Felt tool mass mu [kg] below which free motion is stable for every delay.

    m s^2 + b s + k + mu s^2 e^(-s RTT): b sqrt(m / k - b^2 / 4 k^2) if b^2 < 2 k m, else m.

    Raises:
        DrakeTeleopError: mass or damping is not positive, or the stiffness negative.
    """
    m, b, k = _held(mass, damping, stiffness)
    resonant = b**2 < 2 * k * m
    spring = np.where(resonant, k, 1.0)
    return np.where(resonant, b * np.sqrt(np.abs(m / spring - b**2 / (4 * spring**2))), m)


def unstable_delays_of_mass(
    mass: float, damping: float, stiffness: float, felt_mass: float, longest: float
) -> list[tuple[float, float]]:
    """Windows of the round trip time in [0, longest] [s] where free motion with mu < m is unstable.

    At the two frequencies with |k - m w^2 + j b w| = mu w^2 the delays (2 pi (n + 1) -
    atan2(b w, k - m w^2)) / w take a pole into the right half plane (the higher one) and back.

    Raises:
        DrakeTeleopError: mass, damping, stiffness or mu is not positive, or mu is not below m.
    """
    m, b, k = _held(mass, damping, stiffness)
    mu = _positive(felt_mass, "felt mass of the tool")
    _positive(k, "stiffness of the hand")
    _positive(m - mu, "mass of hand and device less that of the tool")
    middle = (2 * m * k - b**2) / (2 * (m**2 - mu**2))
    root = middle**2 - k**2 / (m**2 - mu**2)
    if middle <= 0 or root <= 0:
        return []
    changes: list[tuple[float, int]] = []
    for sign in (1, -1):
        w = np.sqrt(middle + sign * np.sqrt(root))
        first = (2 * np.pi - np.arctan2(b * w, k - m * w**2)) / w
        changes += [(float(t), sign) for t in np.arange(first, longest, 2 * np.pi / w)]
    return _windows(changes, longest, inside=lambda count: count > 0)


def tolerated_mass_error(
    mass: ArrayLike, force_scale: ArrayLike, position_scale: ArrayLike
) -> Array:
    """Bound m / (k_f l_p) [kg] on |dm|: without contact force and at sigma = 0 an error of the
    estimated mass is felt as -k_f l_p dm, and more than hand and device weigh cannot be stable.

    Necessary for any delay above zero; `delay_independent_mass` over the scales is sufficient.

    Raises:
        DrakeTeleopError: mass or a scale is not positive.
    """
    scale = _positive(force_scale, "force scale") * _positive(position_scale, "position scale")
    return _positive(mass, "mass of hand and device") / scale


def _delay_margin(loop: DelayedLoop, stable: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Margin and its frequency: the first pole to arrive does so from the left, wherever it is."""
    frequency, _ = gain_crossings(loop)
    past = np.mod(_angle_past_minus_one(loop, frequency), 2 * np.pi)
    margin, at = _least(past / frequency, frequency)
    neutral = loop.high_frequency_gain >= 1
    return np.where(stable & ~neutral, margin, 0.0), at


def _gain_margin(loop: DelayedLoop) -> tuple[float, float]:
    """The least factor above 1 that puts a single L on -1 and its frequency, inf for the tail."""
    slow, fast = _breaks(loop)
    # Past the last pole |L| falls, and with a delay its phase passes -pi within one turn of that.
    turn = 2 * np.pi / max(float(loop.delay), 1e-3 / fast)
    omega = _grid(loop, slow, 3 * fast + 2 * turn)
    angle = _angle(-loop(1j * omega))
    crossed = ((angle[1:] < 0) != (angle[:-1] < 0)) & (np.abs(np.diff(angle)) < np.pi)
    low, high, below = omega[:-1][crossed], omega[1:][crossed], angle[:-1][crossed] < 0
    for _ in range(52):
        middle = (low + high) / 2
        same = (_angle(-loop(1j * middle)) < 0) == below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    size = np.abs(loop(1j * high))
    found = list(zip(1 / size[size > 0], high[size > 0], strict=True))

    N, D = loop.numerator, loop.denominator
    if N[-1] * D[-1] < 0:
        found.append((-D[-1] / N[-1], 0.0))
    if loop.high_frequency_gain > 0 and (loop.delay > 0 or N[0] * D[0] < 0):
        found.append((1 / loop.high_frequency_gain, np.inf))
    return min((limit for limit in found if limit[0] > 1), default=(np.inf, np.nan))


def _breaks(loop: DelayedLoop) -> tuple[float, float]:
    """Least and largest magnitude of a single loop's poles without the delay, none at 0."""
    breaks = np.abs(_roots(loop.denominator))
    breaks = breaks[breaks > 0]
    return float(np.min(breaks, initial=1.0)), float(np.max(breaks, initial=1.0))


def _grid(loop: DelayedLoop, slow: float, top: float) -> Array:
    """Frequencies up to the top between which neither L nor its delay turns by much."""
    step = np.pi / 8 / max(float(loop.delay), 1 / top)
    return np.union1d(np.geomspace(1e-3 * slow, top, 1000), np.arange(step, top, step))


def _angle_past_minus_one(loop: DelayedLoop, frequency: Array) -> Array:
    """Angle of -L at frequencies (..., n) of each loop: the lag that would put L on -1."""
    along = DelayedLoop(
        loop.numerator[..., None, :], loop.denominator[..., None, :], loop.delay[..., None]
    )
    with np.errstate(invalid="ignore"):  # NaN where there is no crossing
        return _angle(-along._at(1j * frequency))


def _first_delay(loop: DelayedLoop, frequency: Array) -> Array:
    """The first delay (..., n) at which a pole is on the imaginary axis at these frequencies."""
    undelayed = replace(loop, delay=np.zeros_like(loop.delay))
    return np.mod(_angle_past_minus_one(undelayed, frequency), 2 * np.pi) / frequency


def _undelayed_count(loop: DelayedLoop) -> Array:
    roots = _roots(loop.numerator + loop.denominator)
    size = np.max(np.abs(roots), axis=-1, initial=0.0, keepdims=True)
    return np.sum(roots.real > 1e-9 * size, axis=-1).astype(float)


def _windows(
    changes: list[tuple[float, int]], longest: float, inside: Callable[[int], bool]
) -> list[tuple[float, float]]:
    """Intervals of [0, longest] where the sum of the changes so far is inside, joined."""
    windows: list[tuple[float, float]] = []
    changes = sorted([*changes, (longest, 0)])
    count = 0
    for (start, change), (end, _) in itertools.pairwise(changes):
        count += change
        if inside(count) and end > start:
            if windows and windows[-1][1] == start:
                start = windows.pop()[0]
            windows.append((start, end))
    return windows


def _least(value: Array, at: Array, axis: int = -1) -> tuple[Array, Array]:
    """The least value along the axis, NaN left out (inf if there is none), and where it is."""
    value = np.where(np.isnan(value), np.inf, value)
    if not value.shape[axis]:
        shape = np.delete(value.shape, axis)
        return np.full(shape, np.inf), np.full(shape, np.nan)
    index = np.expand_dims(np.argmin(value, axis=axis), axis)
    least = np.take_along_axis(value, index, axis).squeeze(axis)
    at = np.take_along_axis(np.broadcast_to(at, value.shape), index, axis).squeeze(axis)
    return least, np.where(np.isfinite(least), at, np.nan)


def _zero_between(value: Array) -> Array:
    """Fraction of each step (n - 1, ...) at which the value passes zero, NaN where it does not."""
    before, after = value[:-1], value[1:]
    step = np.where(before == after, 1.0, before - after)
    return np.where((before < 0) != (after < 0), before / step, np.nan)


def _between(value: Array, fraction: Array) -> Array:
    return value[:-1] + fraction * (value[1:] - value[:-1])


def _angle(value: Complex) -> Array:
    return np.arctan2(value.imag, value.real)


def _stack(*coefficients: Any) -> Array:
    return np.stack(np.broadcast_arrays(*(np.asarray(c, float) for c in coefficients)), axis=-1)


def _multiply(p: Array, q: Array) -> Array:
    """Product of polynomials, coefficients along the last axis."""
    n = q.shape[-1]
    grid = np.broadcast_shapes(p.shape[:-1], q.shape[:-1])
    product = np.zeros((*grid, p.shape[-1] + n - 1))
    for i in range(p.shape[-1]):
        product[..., i : i + n] += p[..., i : i + 1] * q
    return product


def _squared_magnitude(p: Array) -> Array:
    """Coefficients of |p(jw)|^2 in x = w^2: those of p(s) p(-s) with s^2 = -x."""
    powers = np.arange(p.shape[-1] - 1, -1, -1)
    return _multiply(p, p * (-1.0) ** powers)[..., ::2] * (-1.0) ** powers


def _value(p: Array, x: Any) -> Any:
    """Horner; p (..., n + 1) and x broadcast over the grid."""
    value = p[..., 0] + 0 * x
    for i in range(1, p.shape[-1]):
        value = value * x + p[..., i]
    return value


def _roots(p: Array) -> Complex:
    """Roots of polynomials (..., n + 1): (..., n). A leading zero gives a root far away."""
    order = p.shape[-1] - 1
    if order == 0:
        return np.zeros((*p.shape[:-1], 0), dtype=complex)
    far = 1e-30 * np.max(np.abs(p), axis=-1)
    lead = np.where(p[..., 0] == 0, np.where(far == 0, 1.0, far), p[..., 0])
    companion = np.zeros((*p.shape[:-1], order, order))
    companion[..., np.arange(1, order), np.arange(order - 1)] = 1
    companion[..., 0, :] = -p[..., 1:] / lead[..., None]
    return np.linalg.eigvals(companion).astype(complex)


def _held(mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike) -> tuple[Array, Array, Array]:
    m = _positive(mass, "mass of hand and device")
    b = _positive(damping, "damping of hand and device")
    k = np.asarray(stiffness, dtype=float)
    if not np.all(k >= 0):
        raise DrakeTeleopError("the stiffness of the hand is negative")
    return m, b, k


def _positive(value: ArrayLike, what: str) -> Array:
    value = np.asarray(value, dtype=float)
    if not np.all(value > 0):
        raise DrakeTeleopError(f"the {what} is not positive")
    return value
