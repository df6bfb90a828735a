"""The station's one axis as it is computed: sampled, held, at several rates, delayed by samples.

The station's timing is kept event by event. All updates at one instant read what stood before it:

* The device goes on by one hand period with the hand's pull and the felt force of its beginning
  held; its own damping acts all the time. In between, the others read where it will be.
* The servo takes the command that stands there and the slave as it is; its pull is held.
* The sensor sees the acceleration and the environment's force just before the servo's update.
  What reads it at the same instant gets the sample before. Its low-pass, if any, is digital.
* A channel with a delay of d whole hand periods hands on what was there d periods ago. Without
  delay there is none: d = 0.
* The slave moves continuously, against the environment's spring and damper.

Between two events everything is linear with constant inputs, so the map over the period that all
rates have in common is exact (matrix exponentials), whatever the rates.

If servo and sensor are as fast as the hand or a whole number of times faster, one loop through the
channel remains, L(z) z^(-D) with D = 2 d periods of the hand. It is cut where the hand feels the
force, and L = 1 - prod (z - m_i) / prod (z - p_i): p_i are the multipliers of the cut loop, m_i
those of the loop closed without delay. Its crossings of |L| = 1 say how many multipliers of the
closed loop lie outside the unit circle for every D at once (argument principle), without the
thousands of eigenvalues of a long delay.

Fields of `OneAxis` and `Sampling` may be arrays that broadcast; results have their shape in front.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import matrix_balance, schur

from drake_teleop._compiled import njit
from drake_teleop.analysis.one_axis import Complex, OneAxis
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.sensor.sensor_chain import butterworth_sections

Array = NDArray[np.float64]

INPUTS = ("hand_force", "environment_force")
OUTPUTS = ("x_m", "v_m", "x_s", "v_s", "felt_force")
_MOTION = ("x_m", "v_m", "servo_acceleration", "x_s", "v_s", "sample")
_X_M, _V_M, _SERVO, _X_S, _V_S, _SAMPLE, _FILTER = range(7)
# Behind the states: the inputs, held, and the force that is felt where the loop is cut.
_HAND, _ENVIRONMENT, _RECEIVED = -3, -2, -1
_MOST_EVENTS = 1000
# Frequencies at which L is looked at, as angles of z: five decades up to half the hand's rate.
_ANGLES = np.pi * np.logspace(-5, 0, 401)
_AROUND = np.array([-4.0, -2.0, -1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0, 2.0, 4.0])
_GOLDEN, _GOLDEN_STEPS = 0.6180339887498949, 25
_MOST_CROSSINGS = 32
_DOUBLINGS, _HALVINGS, _NEWTON_STEPS = 12, 30, 12  # for the rate of growth, from 1/s
_ON_THE_CIRCLE = 1e-9  # a multiplier as close to 1 is taken for 1


@dataclass(frozen=True)
class Sampling:
    """The rates of the station; the defaults are its own, with the ideal sensor.

    Args:
        hand_hz: of haptic device and channel [Hz].
        joint_control_hz, sensor_hz: [Hz].
        low_pass_hz: of the sensor's 4th-order Butterworth low-pass [Hz]; None: ideal sensor.
    """

    hand_hz: float = 2000.0
    joint_control_hz: float = 2000.0
    sensor_hz: float = 8000.0
    low_pass_hz: float | None = None


@dataclass(frozen=True)
class SampledLoop:
    """x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k] over the period of all rates.

    Outputs are those at the beginning of a period, before its updates. Inputs are held: what the
    hand pushes beyond its impedance, and what the slave exerts beyond the wall [N].

    Args:
        A, B, C, D: (..., n, n), (..., n, 2), (..., 5, n), (..., 5, 2).
        period: [s].
        states: their names.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    period: float
    states: tuple[str, ...]
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS

    def to_control(self) -> Any:
        """The same as a discrete `control.StateSpace` with named signals."""
        import control

        return control.ss(
            self.A, self.B, self.C, self.D, self.period,
            states=list(self.states), inputs=list(self.inputs), outputs=list(self.outputs),
        )  # fmt: skip


@dataclass(frozen=True)
class CutLoop:
    """L(z) from the felt force around to the felt force, without the channel's delay.

    Args:
        open: (..., n) multipliers of the cut loop.
        closed: (..., n) multipliers of the loop that is closed without delay.
        period: of the hand [s], (...).
        angles, phases, signs: (..., 32) where |L(e^(j angle))| passes 1, between 0 and pi: the
            unwrapped phase there, 1 where |L| falls below 1, -1 where it rises above. An end of
            the range that lies within |L| > 1 counts as a crossing. Unused places have sign 0.

    Crossings are looked for between 80 frequencies in a decade, more around the cut loop's own, and
    the peaks that those leave near 1.
    """

    open: Complex
    closed: Complex
    period: Array
    angles: Array
    phases: Array
    signs: Array

    @classmethod
    def of(
        cls, opened: Complex, closed: Complex, period: ArrayLike, level: ArrayLike = 1.0
    ) -> CutLoop:
        """From the multipliers and the period; finds the crossings, of |L| = level."""
        shape, n = opened.shape[:-1], opened.shape[-1]
        found = np.zeros((3, *shape, _MOST_CROSSINGS))
        _find_crossings(
            opened.reshape(-1, n),
            closed.reshape(-1, n),
            np.broadcast_to(level, shape).ravel(),
            _ANGLES,
            found.reshape(3, -1, _MOST_CROSSINGS),
        )
        return cls(opened, closed, np.broadcast_to(period, shape), *found)


def delay_steps(axis: OneAxis, sampling: Sampling) -> int:
    """Hand periods that a packet travels: rounded, at least one if there is any delay at all."""
    steps = math.floor(axis.delay * sampling.hand_hz + 0.5)
    return max(steps, 1) if axis.delay > 0 else 0


def sampled_loop(axis: OneAxis, sampling: Sampling) -> SampledLoop:
    """The closed loop over the period that all rates have in common.

    Args:
        axis: its delay must be one number; it is rounded as the channel does.
        sampling: the rates.

    Raises:
        DrakeTeleopError: for an ideal servo, or rates without a common period.
    """
    steps = delay_steps(axis, sampling)
    M, periods = _period_map(axis, sampling, steps, cut=False)
    n = M.shape[-1] - 3
    lines = [f"{line}_{i + 1}" for line in ("command", "wrench") for i in range(steps)]
    filters = [f"low_pass_{i + 1}" for i in range(n - _FILTER - 2 * steps)]
    C = np.zeros((len(OUTPUTS), n))
    C[range(5), [_X_M, _V_M, _X_S, _V_S, _SAMPLE if steps == 0 else n - 1]] = 1.0
    return SampledLoop(
        M[..., :n, :n],
        M[..., :n, n : n + 2],
        C,
        np.zeros((len(OUTPUTS), 2)),
        periods / sampling.hand_hz,
        (*_MOTION, *filters, *lines),
    )


def multipliers(system: Any) -> Complex:
    """Eigenvalues of the map over one period, (..., n), of a `SampledLoop` or `StateSpace`."""
    return np.linalg.eigvals(system.A).astype(np.complex128)


def growth_rate(system: Any) -> Any:
    """How fast a perturbation grows in the end, negative if it decays [1/s], (...).

    Args:
        system: a `SampledLoop` or a discrete `control.StateSpace`.
    """
    period = system.period if isinstance(system, SampledLoop) else system.dt
    return np.log(np.abs(multipliers(system)).max(axis=-1)) / period


def sampled_response(system: Any, frequency: ArrayLike) -> Complex:
    """C (z - A)^-1 B + D at z = e^(j w T).

    Args:
        system: one `SampledLoop` or discrete `control.StateSpace`.
        frequency: (N,) w [rad/s].

    Returns:
        (N, outputs, inputs).
    """
    period = system.period if isinstance(system, SampledLoop) else system.dt
    z = np.exp(1j * np.atleast_1d(np.asarray(frequency, dtype=float)) * period)
    return _resolvent(system.A, system.B, system.C, z) + system.D


def sampled_two_port(axis: OneAxis, sampling: Sampling, frequency: ArrayLike) -> Complex:
    """H of [F_h; -V_s] = H [V_m; F_e] between a held hand force, a held environment and samples.

    Forces are taken by the share of a held one that is of the frequency itself: the spectrum of the
    hold, (1 - e^(-j w T)) / (j w T), is divided out. What is left of the continuous H's difference
    are the station's own holds and samples.

    Args:
        axis: hand and wall do not belong to the two-port and are left out; the delay, one number,
            is rounded as the channel does.
        sampling: the rates.
        frequency: (N,) w [rad/s], not zero, below half the hand's rate.

    Returns:
        (N, 2, 2) [N s/m, 1; 1, m/(N s)].

    Raises:
        DrakeTeleopError: as `cut_loop`.
    """
    bare = replace(
        axis,
        hand_mass=0.0,
        hand_damping=0.0,
        hand_stiffness=0.0,
        wall_stiffness=0.0,
        wall_damping=0.0,
    )
    M = _cut_map(bare, sampling)
    n, period = M.shape[-1] - 3, 1 / sampling.hand_hz
    w = np.atleast_1d(np.asarray(frequency, dtype=float))
    z = np.exp(1j * w * period)
    late = z ** -delay_steps(axis, sampling)
    # Without delay, of the device's own force and of the environment's.
    C = np.eye(n)[[_V_M, _V_S, _SAMPLE]]
    response = _resolvent(M[:n, :n], M[:n, n : n + 2], C, z)
    (v_m, _), (v_s, give), (felt, felt_e) = np.moveaxis(response, 0, 2)
    hold = -np.expm1(-1j * w * period) / (1j * w * period)
    H = np.array(
        [
            [hold * (1 + late**2 * felt) / v_m, late * felt_e],
            [-late * v_s / v_m, -give / hold],
        ]
    )
    return np.moveaxis(H, 2, 0)


def cut_loop(axis: OneAxis, sampling: Sampling) -> CutLoop:
    """The loop cut where the hand feels the force; `axis.delay` plays no part.

    Raises:
        DrakeTeleopError: for an ideal servo, or if servo or sensor do not run at the hand's rate or
            a whole number of times faster.
    """
    M = _cut_map(axis, sampling)
    n = M.shape[-1] - 3
    closed = M[..., :n, :n].copy()
    closed[..., :, _SAMPLE] += M[..., :n, n + 3 + _RECEIVED]
    opened = np.linalg.eigvals(M[..., :n, :n]).astype(np.complex128)
    zeros = np.linalg.eigvals(closed).astype(np.complex128)
    return CutLoop.of(opened, zeros, 1 / np.asarray(sampling.hand_hz))


def loop_response(loop: CutLoop, frequency: ArrayLike, delay: ArrayLike = 0.0) -> Complex:
    """L(z) z^(-D) at z = e^(j w T); the closed loop is at its limit where it is 1.

    Args:
        loop: the cut loop (...).
        frequency: (N,) w [rad/s].
        delay: one way [s], (...).

    Returns:
        (N, ...).
    """
    dimensions = max(loop.period.ndim, np.ndim(delay))
    w = np.atleast_1d(np.asarray(frequency, dtype=float)).reshape(-1, *[1] * dimensions)
    z = np.exp(1j * w * loop.period)[..., None]
    # Factor by factor, so that poles close to z = 1 cost no digits.
    L = 1 - np.prod((z - loop.closed) / (z - loop.open), axis=-1)
    return L * np.exp(-2j * w * np.asarray(delay))


def unstable_multipliers(loop: CutLoop, delay: ArrayLike) -> NDArray[np.int64]:
    """How many multipliers of the closed loop lie outside the unit circle, (...).

    Of the argument principle: those of the cut loop, less the times that L z^(-D) goes around 1.
    It does so only while |L| > 1, so that the phases where it passes 1 are enough.

    Args:
        loop: the cut loop (...).
        delay: one way [s], (...). Exact at whole hand periods; in between the delay is taken as it
            is instead of rounded.
    """
    D = (2 * np.asarray(delay) / loop.period)[..., None]
    turns = (loop.phases - D * loop.angles) / (2 * np.pi)
    # Twice the whole turns passed, once for each sign of the frequency; the ends count half.
    around = np.where(loop.angles >= np.pi, np.rint(2 * turns), np.floor(turns) + np.ceil(turns))
    outside = (np.abs(loop.open) > 1 + _ON_THE_CIRCLE).sum(axis=-1)
    return outside - (loop.signs * around).sum(axis=-1).astype(np.int64)


def delay_margin(loop: CutLoop) -> Array:
    """The round-trip delay at which the loop first becomes unstable [s], (...).

    0 if it is unstable without any, infinite if no delay makes it so. Above it there may be windows
    in which the loop is stable again.
    """
    inside = (loop.angles > 0) & (loop.angles < np.pi) & (loop.signs != 0)
    steps = np.mod(loop.phases, 2 * np.pi) / np.where(inside, loop.angles, 1.0)
    first = np.where(inside, steps, np.inf).min(axis=-1) * loop.period
    return np.where(unstable_multipliers(loop, 0.0) > 0, 0.0, first)


def dominant_multiplier(loop: CutLoop, delay: ArrayLike) -> Complex:
    """The largest multiplier of the closed loop, of a pair the one above the real axis, (...).

    By the same count as `unstable_multipliers` on circles of other radii, bisected, and Newton's
    method from there: no matrix grows with the delay.

    Args:
        loop: the cut loop (...).
        delay: one way [s], (...); exact at whole hand periods.
    """
    shape = np.broadcast_shapes(loop.period.shape, np.shape(delay))
    n = loop.open.shape[-1]
    opened, closed = (np.broadcast_to(m, (*shape, n)) for m in (loop.open, loop.closed))
    period = np.broadcast_to(loop.period, shape)
    delay = np.broadcast_to(np.asarray(delay, dtype=float), shape)
    D = 2 * delay / period

    def on_circle(growth: Array) -> CutLoop:
        radius = np.exp(growth * period)[..., None]
        return CutLoop.of(opened / radius, closed / radius, period, radius[..., 0] ** D)

    # Growth rates: one with no multiplier outside, one with some.
    high, low = np.ones(shape), -np.ones(shape)
    for _ in range(_DOUBLINGS):
        some = unstable_multipliers(on_circle(high), delay) > 0
        none = unstable_multipliers(on_circle(low), delay) == 0
        if not (some | none).any():
            break
        high, low = np.where(some, 2 * high, high), np.where(none, 2 * low, low)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        some = unstable_multipliers(on_circle(middle), delay) > 0
        low, high = np.where(some, middle, low), np.where(some, high, middle)
    # Which one it is: roots of P (1 - z^-D) + M z^-D with P and M the products over `open` and
    # `closed`, from where |L| crosses on the circle and from the multipliers without delay.
    radius = np.exp(high * period)[..., None]
    crossings = np.where(radius > 0, radius * np.exp(1j * on_circle(high).angles), 0)
    z = np.concatenate([crossings, closed * (1 + 1e-7)], axis=-1)
    opened, closed, D = opened[..., None, :], closed[..., None, :], D[..., None]
    found = np.zeros(z.shape, dtype=bool)
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            to_open, to_closed = z[..., None] - opened, z[..., None] - closed
            P, M, late = to_open.prod(axis=-1), to_closed.prod(axis=-1), z**-D
            slope = P * (1 / to_open).sum(axis=-1) * (1 - late)
            slope += (M * (1 / to_closed).sum(axis=-1) + (P - M) * D / z) * late
            value = P * (1 - late) + M * late
            step = np.where(value == 0, 0.0, value / slope)
            # Once there it stays: on a root that is in P or M itself the slope means nothing.
            z = np.where(found | ~np.isfinite(step), z, z - step)
            found |= np.abs(step) < 1e-10
    off = np.where(found, np.abs(np.abs(z) / radius - 1), np.inf)
    z = np.take_along_axis(z, off.argmin(axis=-1)[..., None], axis=-1)[..., 0]
    return np.where(z.imag < 0, z.conj(), z)


def _cut_map(axis: OneAxis, sampling: Sampling) -> Array:
    """(..., n + 3, n + 3) over the hand's period, without delay."""
    M, periods = _period_map(axis, sampling, 0, cut=True)
    if periods != 1:
        raise DrakeTeleopError(
            "the hand's period is not the period of all rates",
            where="sampling",
            remedy="let servo and sensor run a whole number of times faster, or use `sampled_loop`",
        )
    return M


def _period_map(axis: OneAxis, sampling: Sampling, steps: int, *, cut: bool) -> tuple[Array, int]:
    """The map of [states; held inputs; force received] over the common period, and its length.

    Returns:
        (..., n + 3, n + 3), in hand periods.
    """
    if axis.ideal_servo:
        raise DrakeTeleopError(
            "an ideal servo has no sampled form",
            where="axis.ideal_servo",
            remedy="give it high gains, or use the continuous model",
        )
    periods, events = _events(sampling)
    hand_period = 1 / np.asarray(sampling.hand_hz, dtype=float)
    sections = _sections(sampling)
    first_line = _FILTER + 2 * sections.shape[-2]
    n = first_line + 2 * steps
    rows = _Rows(axis, n + 3)
    command = first_line + steps - 1 if steps else _X_M
    received = _RECEIVED if cut else (n - 1 if steps else _SAMPLE)
    hand, servo, sensor = (
        rows.hand(hand_period, received),
        rows.servo(command),
        rows.sensor(sections),
    )
    gaps = {gap for gap, *_ in events}
    flows = {gap: rows.slave(float(gap) * hand_period) for gap in gaps}
    shape = np.broadcast_shapes(
        *(part.shape[:-2] for part in (hand, servo, sensor, *flows.values()))
    )
    M = np.broadcast_to(np.eye(n + 3), (*shape, n + 3, n + 3)).copy()
    for gap, at_hand, at_servo, at_sensor in events:
        new = M.copy()
        if at_hand:
            new[..., [_X_M, _V_M], :] = hand @ M
            for line, source in ((first_line, _X_M), (first_line + steps, _SAMPLE)):
                if steps:
                    new[..., line, :] = M[..., source, :]
                    new[..., line + 1 : line + steps, :] = M[..., line : line + steps - 1, :]
        if at_servo:
            new[..., [_SERVO], :] = servo @ M
        if at_sensor:
            new[..., _SAMPLE:first_line, :] = sensor @ M
        M = new
        M[..., [_X_S, _V_S], :] = flows[gap] @ M
    return M, periods


def _events(sampling: Sampling) -> tuple[int, list[tuple[Fraction, bool, bool, bool]]]:
    """Hand periods in the common period; each event's time to the next, and who updates at it."""
    hand = np.asarray(sampling.hand_hz, dtype=float)
    ratios = []
    for name in ("joint_control_hz", "sensor_hz"):
        ratio = np.unique(np.asarray(getattr(sampling, name) / hand, dtype=float))
        exact = Fraction(float(ratio[0])).limit_denominator(100)
        if exact <= 0 or np.ptp(ratio) > 1e-9 * ratio[0] or abs(exact - ratio[0]) > 1e-9 * ratio[0]:
            raise DrakeTeleopError(
                f"{name} is not in a simple ratio to hand_hz",
                where=f"sampling.{name}",
                remedy="choose rates whose ratios are ratios of small whole numbers",
            )
        ratios.append(exact)
    return _schedule(*ratios)


@cache
def _schedule(
    servo: Fraction, sensor: Fraction
) -> tuple[int, list[tuple[Fraction, bool, bool, bool]]]:
    """`_events` of a servo and a sensor so many times as fast as the hand."""
    lengths = [Fraction(1), 1 / servo, 1 / sensor]
    common = Fraction(
        math.lcm(*(length.numerator for length in lengths)),
        math.gcd(*(length.denominator for length in lengths)),
    )
    times = sorted({i * length for length in lengths for i in range(int(common / length))})
    if len(times) > _MOST_EVENTS:
        raise DrakeTeleopError(
            f"the rates take {float(common):g} hand periods to meet again",
            where="sampling",
            remedy="choose rates whose ratios are ratios of small whole numbers",
        )
    ends = [*times[1:], common]
    return int(common), [
        (end - time, *(time % length == 0 for length in lengths))  # type: ignore[misc]
        for time, end in zip(times, ends, strict=True)
    ]


def _sections(sampling: Sampling) -> Array:
    """(..., 2, 5) of the low-pass at the sensor's rate, (0, 5) for the ideal sensor."""
    if sampling.low_pass_hz is None:
        return np.zeros((0, 5))
    cutoffs, rates = np.broadcast_arrays(sampling.low_pass_hz, sampling.sensor_hz)
    if not (cutoffs < rates / 2).all():
        raise DrakeTeleopError(
            "the low-pass lets half the sensor's rate pass",
            where="sampling.low_pass_hz",
            remedy="choose less than half of sensor_hz",
        )
    pairs = zip(cutoffs.flat, rates.flat, strict=True)
    sections = np.array([butterworth_sections(cutoff, rate) for cutoff, rate in pairs])
    return sections.reshape(*rates.shape, 2, 5)


class _Rows:
    """What each event writes, as rows over [states; inputs; force received]."""

    def __init__(self, axis: OneAxis, size: int) -> None:
        self._axis, self._size = axis, size

    def _row(self, entries: dict[int, Any]) -> Array:
        """(..., size) from entries that broadcast."""
        values = np.broadcast_arrays(
            *(np.asarray(value, dtype=float) for value in entries.values())
        )
        row = np.zeros((*values[0].shape, self._size))
        for index, value in zip(entries, values, strict=True):
            row[..., index] += value
        return row

    def _environment(self) -> dict[int, Any]:
        return {_X_S: self._axis.wall_stiffness, _V_S: self._axis.wall_damping, _ENVIRONMENT: 1.0}

    def hand(self, period: Array, received: int) -> Array:
        """x_m and v_m a hand period later, with the force on the device held."""
        axis = self._axis
        mass = axis.hand_mass + axis.device_mass
        x, v, push = _held_response(0.0, axis.device_damping / mass, period)
        pull = {
            _X_M: -axis.hand_stiffness / mass,
            _V_M: -axis.hand_damping / mass,
            _HAND: 1 / mass,
        }
        force = self._row(pull) + self._row({received: -1 / mass})
        ahead = [force * push[..., i, None] for i in range(2)]
        for i in range(2):
            ahead[i] = ahead[i] + self._row({_X_M: x[..., i], _V_M: v[..., i]})
        return np.stack(np.broadcast_arrays(*ahead), axis=-2)

    def servo(self, command: int) -> Array:
        """The acceleration k_v (k_p (l_p x_command - x_s) - v_s)."""
        kv, kp = self._axis.velocity_gain, self._axis.position_gain
        row = self._row({command: kv * kp * self._axis.position_scale})
        return (row + self._row({_X_S: -kv * kp, _V_S: -kv}))[..., None, :]

    def sensor(self, sections: Array) -> Array:
        """The sample, scaled for the hand after the elimination, and the memory of its low-pass."""
        axis = self._axis
        felt_mass = axis.felt_tool_mass
        environment = axis.gamma - felt_mass / axis.slave_mass
        value = self._row(
            {
                index: axis.force_scale * environment * share
                for index, share in self._environment().items()
            }
        ) + self._row({_SERVO: axis.force_scale * felt_mass})
        memory = []
        for k in range(sections.shape[-2]):
            b0, b1, b2, a1, a2 = np.moveaxis(sections[..., k, :, None], -2, 0)
            first, second = _FILTER + 2 * k, _FILTER + 2 * k + 1
            filtered = b0 * value + self._row({first: 1.0})
            memory.append(b1 * value - a1 * filtered + self._row({second: 1.0}))
            memory.append(b2 * value - a2 * filtered)
            value = filtered
        return np.stack(np.broadcast_arrays(value, *memory), axis=-2)

    def slave(self, time: Array) -> Array:
        """x_s and v_s after `time` [s], with the servo's pull held, in touch with the wall."""
        axis = self._axis
        mass = axis.slave_mass
        x, v, push = _held_response(axis.wall_stiffness / mass, axis.wall_damping / mass, time)
        rows = []
        for i in range(2):
            p = push[..., i]
            rows.append(
                self._row({_X_S: x[..., i], _V_S: v[..., i], _SERVO: p, _ENVIRONMENT: -p / mass})
            )
        return np.stack(rows, axis=-2)


def _held_response(stiffness: Any, damping: Any, time: Array) -> tuple[Array, Array, Array]:
    """Of x'' = u - damping x' - stiffness x with u held: what (x, v) owe to x, to v and to u.

    Returns:
        Three arrays (..., 2).
    """
    k, b, t = np.broadcast_arrays(stiffness, damping, time)
    M = np.zeros((*k.shape, 3, 3))
    M[..., 0, 1], M[..., 1, 0], M[..., 1, 1], M[..., 1, 2] = t, -k * t, -b * t, t
    E = _exponential(M)
    return E[..., :2, 0], E[..., :2, 1], E[..., :2, 2]


def _resolvent(A: Array, B: Array, C: Array, z: Complex) -> Complex:
    """C (z - A)^-1 B, (N, p, m) at z (N,): by A's Schur form, triangular for every z."""
    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    T, Q = schur(balanced, output="complex")
    right, left = Q.conj().T @ (B / scale[:, None]), (C * scale) @ Q
    states = np.empty((len(T), len(z), right.shape[1]), complex)
    for i in reversed(range(len(T))):
        known = right[i] + np.tensordot(T[i, i + 1 :], states[i + 1 :], 1)
        states[i] = known / (z - T[i, i])[:, None]
    return np.moveaxis(np.tensordot(left, states, 1), 1, 0)


def _exponential(M: Array) -> Array:
    """e^M of (..., n, n), vectorised: the Taylor series of M / 2^s, squared s times."""
    largest = float(np.abs(M).sum(axis=-1).max(initial=0.0))
    halvings = max(0, math.ceil(math.log2(largest / 0.25))) if largest > 0.25 else 0
    term = E = np.broadcast_to(np.eye(M.shape[-1]), M.shape)
    for i in range(1, 15):  # 0.25^15 / 15! is below rounding
        term = term @ M / (i * 2.0**halvings)
        E = E + term
    for _ in range(halvings):
        E = E @ E
    return E


@njit(cache=True)
def _loop(closed, opened, angle, radius):
    """L at z = radius e^(j angle)."""
    z = complex(radius * math.cos(angle), radius * math.sin(angle))
    ratio = 1.0 + 0.0j
    for i in range(opened.shape[0]):
        ratio *= (z - closed[i]) / (z - opened[i])
    return 1.0 - ratio


@njit(cache=True)
def _find_crossings(opened, closed, levels, angles, found):
    """Writes where |L| passes the level: angles, phases, signs, `found` (3, loops, places)."""
    for n in range(opened.shape[0]):
        poles, zeros, level, count = opened[n], closed[n], levels[n], 0
        # Around z = 1, where the cut loop has a multiplier if the hand has no stiffness.
        value = _loop(zeros, poles, 0.0, 1.0 + _ON_THE_CIRCLE)
        before, size = 0.0, abs(value)
        phase = 0.0 if value.real >= 0.0 else math.pi
        if size > level:
            found[0, n, 0], found[1, n, 0], found[2, n, 0] = 0.0, phase, -1.0
            count = 1
        at, values = _with_extremes(_with_peaks(angles, poles), poles, zeros, level)
        for i in range(at.shape[0]):
            angle, value = at[i], values[i]
            last_size, last_phase = size, phase
            size, phase = abs(value), _unwrapped(value, last_phase)
            if (size > level) != (last_size > level) and count < found.shape[2]:
                low, high = before, angle
                while high - low > 1e-12 * high:
                    middle = 0.5 * (low + high)
                    if (abs(_loop(zeros, poles, middle, 1.0)) > level) == (last_size > level):
                        low = middle
                    else:
                        high = middle
                found[0, n, count] = low
                found[1, n, count] = _unwrapped(_loop(zeros, poles, low, 1.0), last_phase)
                found[2, n, count] = 1.0 if size < last_size else -1.0
                count += 1
            before = angle
        if size > level and count < found.shape[2]:
            found[0, n, count], found[2, n, count] = math.pi, 1.0
            found[1, n, count] = math.pi * np.rint(phase / math.pi)


@njit(cache=True)
def _with_peaks(angles, poles):
    """The angles, and more at every pole, where |L| may have a peak as narrow as 1 - |pole|."""
    more = np.empty(_AROUND.shape[0] * poles.shape[0])
    count = 0
    for pole in poles:
        for share in _AROUND:
            angle = abs(math.atan2(pole.imag, pole.real)) + share * abs(1.0 - abs(pole))
            if angles[0] < angle < math.pi:
                more[count] = angle
                count += 1
    return np.sort(np.concatenate((angles, more[:count])))


@njit(cache=True)
def _with_extremes(angles, poles, zeros, level):
    """More angles, where |L| comes nearest to the level between two of them; and L at each."""
    values = np.empty(angles.shape[0], np.complex128)
    for i in range(angles.shape[0]):
        values[i] = _loop(zeros, poles, angles[i], 1.0)
    size = np.abs(values)
    more = np.empty(angles.shape[0])
    count = 0
    for i in range(1, angles.shape[0] - 1):
        sign = 1.0 if size[i] <= level else -1.0
        is_extreme = sign * size[i] >= max(sign * size[i - 1], sign * size[i + 1])
        if is_extreme and 0.5 * level < size[i] < 2.0 * level:
            low, high = angles[i - 1], angles[i + 1]
            for _ in range(_GOLDEN_STEPS):
                a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
                at_a, at_b = _loop(zeros, poles, a, 1.0), _loop(zeros, poles, b, 1.0)
                if sign * abs(at_a) > sign * abs(at_b):
                    high = b
                else:
                    low = a
            more[count] = 0.5 * (low + high)
            values = np.append(values, _loop(zeros, poles, more[count], 1.0))
            count += 1
    if count == 0:
        return angles, values
    angles = np.concatenate((angles, more[:count]))
    order = np.argsort(angles)
    return angles[order], values[order]


@njit(cache=True)
def _unwrapped(value, near):
    phase = math.atan2(value.imag, value.real)
    return phase + 2.0 * math.pi * np.rint((near - phase) / (2.0 * math.pi))
