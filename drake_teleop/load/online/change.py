"""Noticing online that the load has changed: an object was grasped or released (section V, Eq. 14).

**What is watched.** Samples are averaged over blocks of `BLOCK` seconds. The mean of a block is

    F = [E V] theta + noise,    Cov(noise) = (R + J Q J^T) / n

with theta = [offsets; phi] known to be theta_0 with covariance P_0, R and Q the noise of wrench and
motion, J the derivative of V phi by the motion, and n samples. R and Q are long-run variances (the
variance of a mean of many samples, times their number): a block that is longer than the noise's
memory makes coloured noise white, and a low-pass of unit gain leaves these variances as they were
before it. Averaging also takes the noise out of V, which would bias least squares. Errors of gain,
cross-talk and alignment are a share of the wrench that changes as slowly as the motion: they count
as noise that remembers `MEMORY` seconds, and do not average out within a block.

A Kalman filter that starts from (theta_0, P_0) and learns from the blocks has white innovations;
each block's, normalised, is chi-squared with six degrees of freedom as long as the load is the
known one. It starts anew every `WINDOW` seconds, so that it cannot follow a load that changes
slowly. A cumulative sum (Page 1954) of what exceeds `_SLACK` times the mean alarms at `_ALARM`;
noise of up to sqrt(2) times the stated one is thus tolerated.

**Contact or load?** After the alarm a second filter explains the wrench by a new load: its prior
are the known offsets and the known load, the latter widened by `WIDE`. Its innovations pass the
same test::

    known       the known load explains the wrench
    disturbed   neither it nor a new load does: contact, or the very moment of a grasp. Whenever the
                second filter's test alarms, it starts anew
    changed     a new load has explained the wrench for `HOLD` seconds: what is fed back with the
                old one is wrong
    identified  its mass and first moments are known: from here on it is the known load

From disturbed and changed the way leads back as soon as the old load explains the wrench again.
A contact would have to follow the motion as a body's wrench does, in six channels and with
known offsets: force along s, moments about a point that moves with S. Where nothing moves, a
vertical push does that. It is then called changed until something moves or the push varies. It is
never identified: the first moment along gravity needs motion.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.arrays import Array, checked, checked_rows, positive
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.vectors import put
from drake_teleop.load.identification import METHODS, Identification, worth_stating
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.online.innovation import learn, whitening
from drake_teleop.load.online.recursive import PRIOR_STD
from drake_teleop.load.regressor import regressor_into
from drake_teleop.load.sample import (
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    SPECIFIC_FORCE,
    WRENCH_AND_MOTION,
)

STATES = ("known", "disturbed", "changed", "identified")
"""What `LoadChangeMonitor.state` may say."""
KNOWN, DISTURBED, CHANGED, IDENTIFIED = range(4)

BLOCK, WINDOW, HOLD, MEMORY = 0.016, 2.0, 0.2, 0.3
"""Durations in seconds (module docstring)."""
BOUND = 0.0025
"""Default of `LoadChangeMonitor`: 1 % of a new load's mass is then four standard deviations."""
OFFSET_DRIFT = (0.1,) * 3 + (0.005,) * 3
"""Default 1 sigma by which offsets may have drifted since the identification [N, N m]."""

# Standard deviations of what may be grasped or released [kg, kg m, kg m^2].
WIDE = PRIOR_STD[6:]
# Cumulative sums of a block's chi-squared of six degrees of freedom. With the slack of twice the
# mean, noise exceeds the alarm once in 1e10 blocks; the way back is that of five blocks of noise.
_SLACK, _ALARM, _BACK = 12.0, 60.0, -30.0
# First moments may be that much less certain than the mass, relative to what is natural for a load
# of this size, at least that large [m].
_MOMENTS, _SMALLEST_SIZE = 10.0, 0.03
# Standard deviations below zero from which on a new load cannot be a body.
_IMPOSSIBLE = 4.0

# Parts of the memory: status; squared residuals of the known and the new load; sums of a block;
# then beliefs [theta (16); P (256)]: the known load, the filter that watches it, and the new one.
_STATE, _BASE, _IN_BLOCK, _SAMPLES, _SUM, _BACK_SUM, _AGE, _START, _LEARNT, _POWER = range(10)
_RESIDUAL, _SQUARES, _WRENCH, _MOTION, _V, _KNOWN = 10, 16, 22, 28, 37, 97
_WATCH, _NEW = _KNOWN + 272, _KNOWN + 544

SIZE = _KNOWN + 816
"""Of the memory of `change_update`."""


@njit(cache=True)
def _explain(memory, belief, block, noise):
    """A block into a belief; returns the chi-squared of what the belief does not explain.

    The test takes model errors for as large as they are, learning for as long-lived as they are.
    The noise is that of the load as the belief has it: measured accelerations times mass.
    """
    phi = memory[belief + 6 : belief + 16].copy()
    wrench, motion = memory[_WRENCH:_MOTION], memory[_MOTION:_V]
    V = memory[_V:_KNOWN].reshape(6, 10)
    before = memory[belief : belief + 272].copy()
    chi = learn(before, V, wrench, whitening(motion, phi, noise, noise[15], block))
    if noise[15] == 0.0:
        put(memory, belief, before, 0, 272)
    else:
        lasting = whitening(motion, phi, noise, noise[15] * noise[16], block)
        learn(memory[belief : belief + 272], V, wrench, lasting)
    return chi


@njit(cache=True)
def _restart(memory, belief):
    """Sets a filter back to the known load, the new load's with a wide prior, and its test."""
    put(memory, belief, memory, _KNOWN, 272)
    if belief == _NEW:
        for j in range(10):
            memory[belief + 16 + 17 * (6 + j)] += WIDE[j] ** 2
        memory[_START] = memory[_SAMPLES]
        memory[_SQUARES:_WRENCH] = memory[_POWER] = 0.0
    memory[_SUM] = memory[_AGE] = 0.0


@njit(cache=True)
def _settled(memory, bound):
    """Whether the new load's mass and first moments are known to `bound` of what has changed."""
    theta, P = memory[_NEW : _NEW + 16], memory[_NEW + 16 : SIZE].reshape(16, 16)
    change = abs(theta[6] - memory[_KNOWN + 6])
    size = math.sqrt(theta[7] ** 2 + theta[8] ** 2 + theta[9] ** 2) / abs(theta[6])
    moment = bound * change * max(size, _SMALLEST_SIZE) * _MOMENTS
    largest = max(P[7, 7], P[8, 8], P[9, 9])
    return math.sqrt(P[6, 6]) <= bound * change and math.sqrt(largest) <= moment


@njit(cache=True)
def _doubt_inertias(memory, noise, block):
    """Adds what noise of alpha may have taken from the new load's inertias to their variances.

    Least squares shrinks them by the share of noise in the power of alpha.
    """
    theta, P = memory[_NEW : _NEW + 16], memory[_NEW + 16 : SIZE].reshape(16, 16)
    expected = memory[_AGE] * (noise[12] + noise[13] + noise[14]) / block
    share = min(1.0, expected / max(memory[_POWER], 1e-300))
    moment = theta[7] ** 2 + theta[8] ** 2 + theta[9] ** 2
    scale = abs(theta[10]) + abs(theta[13]) + abs(theta[15]) + 2.0 * moment / abs(theta[6])
    for i in range(10, 16):
        P[i, i] += (share * scale) ** 2


@njit(cache=True)
def change_update(memory, sample, block, noise, window, hold, bound):
    """One sample, in place; compiled, checks nothing.

    Args:
        memory: of `LoadChangeMonitor.initial_memory`, updated.
        sample: see `drake_teleop.load.sample`, its first 15 numbers.
        block: samples of a block.
        noise: (17,) long-run variances of a sample of the wrench (6) and the motion (9), square of
            the model error, and how many blocks that lasts.
        window, hold: blocks.
        bound: of `LoadChangeMonitor`.
    """
    V = np.empty((6, 10))
    s, omega, alpha = sample[SPECIFIC_FORCE], sample[ANGULAR_VELOCITY], sample[ANGULAR_ACCELERATION]
    regressor_into(s, omega, alpha, V)
    known = sample[WRENCH_AND_MOTION]
    for i in range(15):
        memory[_WRENCH + i] += known[i]
    for i in range(6):
        for j in range(10):
            memory[_V + 10 * i + j] += V[i, j]
    memory[_SAMPLES] += 1.0
    memory[_IN_BLOCK] += 1.0
    if memory[_IN_BLOCK] >= block:
        memory[_WRENCH:_KNOWN] /= block
        _judge(memory, block, noise, window, hold, bound)
        memory[_WRENCH:_KNOWN] = 0.0
        memory[_IN_BLOCK] = 0.0


@njit(cache=True)
def _judge(memory, block, noise, window, hold, bound):
    """What a block's means say about the load."""
    if memory[_STATE] == memory[_BASE]:
        if memory[_AGE] >= window:
            excess = memory[_SUM]
            _restart(memory, _WATCH)
            memory[_SUM] = excess
        memory[_AGE] += 1.0
        chi = _explain(memory, _WATCH, block, noise)
        memory[_SUM] = max(0.0, memory[_SUM] + chi - _SLACK)
        if memory[_SUM] > _ALARM:
            memory[_STATE], memory[_BACK_SUM] = DISTURBED, 0.0
            _restart(memory, _NEW)
        return
    # Does the old load explain this block by itself?
    put(memory, _WATCH, memory, _KNOWN, 272)
    chi = _explain(memory, _WATCH, block, noise)
    memory[_BACK_SUM] = min(0.0, memory[_BACK_SUM] + chi - _SLACK)
    if memory[_BACK_SUM] < _BACK:
        memory[_STATE] = memory[_BASE]
        _restart(memory, _WATCH)
        return
    # Does a new one explain it together with those before?
    chi = _explain(memory, _NEW, block, noise)
    memory[_AGE] += 1.0
    for k in range(3):
        memory[_POWER] += memory[_MOTION + 6 + k] ** 2
    for c in range(6):
        residual = memory[_WRENCH + c] - memory[_NEW + c]
        for j in range(10):
            residual -= memory[_V + 10 * c + j] * memory[_NEW + 6 + j]
        memory[_SQUARES + c] += residual * residual
    memory[_SUM] = max(0.0, memory[_SUM] + chi - _SLACK)
    # A body has mass.
    mass, deviation = memory[_NEW + 6], math.sqrt(memory[_NEW + 16 + 17 * 6])
    if memory[_SUM] > _ALARM or mass < -_IMPOSSIBLE * deviation:
        memory[_STATE] = DISTURBED
        _restart(memory, _NEW)
    elif memory[_STATE] == DISTURBED and memory[_AGE] >= hold:
        memory[_STATE] = CHANGED
    elif memory[_STATE] == CHANGED and _settled(memory, bound):
        memory[_STATE] = memory[_BASE] = IDENTIFIED
        _doubt_inertias(memory, noise, block)
        put(memory, _KNOWN, memory, _NEW, 272)
        memory[_LEARNT] = memory[_AGE] * block
        for i in range(_SQUARES - _RESIDUAL):
            memory[_RESIDUAL + i] = memory[_SQUARES + i] * (block / memory[_AGE])
        _restart(memory, _WATCH)


@njit(cache=True)
def _watch(memory, samples, states, block, noise, window, hold, bound):
    """`change_update` for each row of samples (N, 15); writes the states (N,)."""
    for k in range(samples.shape[0]):
        change_update(memory, samples[k], block, noise, window, hold, bound)
        states[k] = int(memory[_STATE])


Parameters: TypeAlias = tuple[int, Array, int, int, float]


def change_parameters(
    wrench_std: ArrayLike,
    motion_std: ArrayLike,
    period: float,
    *,
    model_error: float = 0.0,
    bound: float | None = None,
) -> Parameters:
    """What `change_update` takes beside memory and sample; arguments as of `LoadChangeMonitor`.

    Raises:
        DrakeTeleopError: for other shapes or values.
    """
    positive("period", period)
    if not 0.0 <= model_error < 1.0:
        raise DrakeTeleopError(f"{model_error} is not within [0, 1)", where="model_error")
    bound = max(BOUND, 2.0 * model_error) if bound is None else float(positive("bound", bound))
    block = max(1, round(BLOCK / period))
    window, hold, lasts = (max(1, round(x / (block * period))) for x in (WINDOW, HOLD, MEMORY))
    std = positive("wrench_std", wrench_std, 6), checked("motion_std", motion_std, 9)
    noise = np.concatenate([*std, [model_error]]) ** 2
    return block, np.append(noise, lasts), window, hold, bound


def change_memory(theta: Array, covariance: Array, offset_drift: ArrayLike = OFFSET_DRIFT) -> Array:
    """The memory (n,) of `change_update` before the first sample.

    Args:
        theta: (16,) known [offsets; phi].
        covariance: (16, 16) of it; what is not determined counts as wide open.
        offset_drift: of `LoadChangeMonitor`.
    """
    prior = np.square(PRIOR_STD)
    P = covariance.copy()
    unknown = np.diag(P) > prior
    P[unknown, :] = P[:, unknown] = 0.0
    P[unknown, unknown] = prior[unknown]
    P[range(6), range(6)] += np.square(offset_drift)
    # Least inertias that the mass implies, as in `logs.processing.usable_phi`.
    phi = theta[6:].copy()
    point = phi_from_mass_com_inertia(phi[0], phi[1:4] / phi[0], np.zeros((3, 3)))
    phi[4:] = np.where(unknown[10:], point[4:], phi[4:])
    memory = np.zeros(SIZE)
    memory[_KNOWN : _KNOWN + 16] = np.concatenate([theta[:6], phi])
    memory[_KNOWN + 16 : _WATCH] = P.ravel()
    put(memory, _WATCH, memory, _KNOWN, 272)
    return memory


@njit(cache=True)
def known_load(memory):
    """(16,) [offsets; phi] of the known load, a view: its offsets may be corrected."""
    return memory[_KNOWN : _KNOWN + 16]


@njit(cache=True)
def change_state(memory):
    """Index into `STATES`; once a load was identified, it is the known one: `KNOWN` again."""
    return KNOWN if memory[_STATE] == memory[_BASE] else int(memory[_STATE])


@njit(cache=True)
def new_load(memory):
    """(16,) [offsets; phi] of the new load as far as it is known."""
    return memory[_NEW : _NEW + 16]


@njit(cache=True)
def new_load_age(memory):
    """Samples since the newest new load has explained the wrench, if the known one does not."""
    return memory[_SAMPLES] - memory[_START]


class LoadChangeMonitor:
    """Watches whether the load is still the known one, sample by sample (module docstring).

    What it knows is a `memory` (an array); it can be kept outside, as in the state of a Drake
    system: `initial_memory`, `update_into`, `state_of`.

    Args:
        known: the load at the start and the offsets, with their covariance. What it does not
            determine counts as wide open.
        wrench_std: (6,) noise of the wrench channels, square roots of long-run variances of a
            sample (of white noise: its standard deviation) [N, N m].
        motion_std: (9,) the same of s [m/s^2], omega [rad/s] and alpha [rad/s^2].
        period: between samples [s].
        model_error: what the sensor's gains and cross-talk, the alignment in time and the like make
            of the load's wrench, as a share of it. 0 is for simulations: with as little as 1 % of
            gain error a load that is known from another motion is soon taken for disturbed.
        offset_drift: (6,) 1 sigma by which the offsets may have drifted since `known` [N, N m].
        bound: standard deviation over change of mass at which a new load's mass is known; the
            first moments ten times that of what is natural for the new load's size. Default:
            `BOUND`, or twice the model error.

    Raises:
        DrakeTeleopError: for other shapes or values.
    """

    def __init__(
        self,
        known: Identification,
        wrench_std: ArrayLike,
        motion_std: ArrayLike,
        period: float,
        *,
        model_error: float = 0.0,
        offset_drift: ArrayLike = OFFSET_DRIFT,
        bound: float | None = None,
    ) -> None:
        self._parameters = change_parameters(
            wrench_std, motion_std, period, model_error=model_error, bound=bound
        )
        self._drift = checked("offset_drift", offset_drift, 6)
        self._first, self._period = known, float(period)
        self._memory = self.initial_memory()

    def initial_memory(self) -> Array:
        """The memory before the first sample, (n,)."""
        theta = np.concatenate([self._first.offsets, self._first.phi])
        return change_memory(theta, self._first.covariance, self._drift)

    def update_into(self, memory: Array, sample: Array) -> None:
        """The update of a memory that is kept elsewhere; compiled, checks nothing.

        Args:
            memory: as from `initial_memory`, updated in place.
            sample: see `drake_teleop.load.sample`, its first 15 numbers.
        """
        change_update(memory, sample, *self._parameters)

    @staticmethod
    def state_of(memory: Array) -> str:
        """`state` of a memory that is kept elsewhere."""
        return STATES[int(memory[_STATE])]

    def update(self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> str:
        """Takes one sample and returns the `state`.

        Args:
            wrench: (6,) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
            s, omega, alpha: (3,) motion of S in S, as for `regressor`.

        Raises:
            DrakeTeleopError: for other shapes or numbers that are not finite.
        """
        parts = {"wrench": (wrench, 6), "s": (s, 3), "omega": (omega, 3), "alpha": (alpha, 3)}
        sample = np.concatenate([checked(name, x, n) for name, (x, n) in parts.items()])
        self.update_into(self._memory, sample)
        return self.state

    def watch(
        self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike
    ) -> NDArray[np.int_]:
        """`update` with each of N samples of a log, in a compiled loop.

        Args:
            wrench, s, omega, alpha: (N, 6), (N, 3), (N, 3), (N, 3).

        Returns:
            (N,) indices into `STATES`, after each sample.

        Raises:
            DrakeTeleopError: as `update`.
        """
        _, rows = checked_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
        states = np.empty(len(rows[0]), np.int_)
        _watch(self._memory, np.concatenate(rows, axis=1), states, *self._parameters)
        return states

    @property
    def state(self) -> str:
        """One of `STATES`."""
        return self.state_of(self._memory)

    @property
    def changed_at(self) -> float:
        """Since when the newest new load explains the wrench [s after the first sample]."""
        return float(self._memory[_START]) * self._period

    @property
    def load(self) -> Identification:
        """The known load; once "identified", the new one.

        Of a new load, `residual_rms` is that of the blocks' means times the root of a block's
        samples. Inertias that its motion has not excited are those of the load before, with a
        large standard deviation. `condition_number` and `delay_s` are those of the first load.
        """
        memory = self._memory
        if memory[_BASE] == KNOWN:
            return self._first
        phi, P = memory[_KNOWN + 6 : _KNOWN + 16].copy(), memory[_KNOWN + 16 : _WATCH]
        covariance = P.reshape(16, 16).copy()
        return replace(
            self._first,
            phi=phi,
            offsets=memory[_KNOWN : _KNOWN + 6].copy(),
            covariance=covariance,
            identifiable=worth_stating(np.sqrt(np.diag(covariance)), phi),
            residual_rms=np.sqrt(memory[_RESIDUAL:_SQUARES]),
            method=METHODS[1],
            samples=int(memory[_LEARNT]),
            degrees_of_freedom=np.full(16, np.inf),
            prior_dominated=np.zeros(16, dtype=bool),
        )
