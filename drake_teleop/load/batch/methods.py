"""Batch estimators by name, for the load and the sensor's offsets from a record.

| name | what it does | when |
|---|---|---|
| `ordinary` | least squares, N and N m alike, Eqs. (7)-(8) | to compare with |
| `whitened` | rows divided by each channel's noise, given or estimated | the plain weighted fit |
| `total` | `whitened` with errors in variables (`total_least_squares`) | motion's noise is given |
| `robust` | `total` without knocks and short contacts | |
| `consistent` | `robust`, and a body can have these parameters (`consistent`) | default |

A negative mass is no body's and stays as it is.

The first three see the record only as a (19, 19) matrix of second moments (`moments`), in one
pass. The noise of the wrench, if not given, comes from the residual of a first fit, without what
the noise of the motion explains of it, and once more from the residual of the second.

`robust` is iteratively reweighted least squares with Huber's weights (Huber, Robust Statistics,
1981, chapter 7), which a few bad samples cannot lead far astray, then least squares on the samples
within 4.5 robust standard deviations (1.4826 x median of the absolute residual) in all channels,
repeated until they stay the same. Of normal noise it rejects one sample in 25000. In a record that
rests most of the time all errors of the motion (delay, scale, mounting) look like disturbances, and
the samples that say most would be rejected. Therefore nothing is, and `BatchResult.note` says so,
where the rest of the samples would double some standard deviation: knocks and contacts raise it by
15 %, motion taken for a disturbance by 30 % to a hundredfold. Nor is anything of less than 12
samples.

Averages over poses at rest leave no noise but errors of calibration and orientation, which turn
with the pose and belong to no channel. With `shared_noise` the three forces have one estimated
noise and the three torques one; weights of their own would make mass and centre of mass worse by
10 to 30 % (simulated gain errors of 0.3 % and tilts of 4 mrad).

`covariance` says how sure each of them is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.arrays import Array, checked_rows, number
from drake_teleop.common.errors import DrakeTeleopError, expect
from drake_teleop.load.batch.consistent import Ellipsoid, Prior, consistent_least_squares
from drake_teleop.load.batch.covariance import (
    covariance_of,
    gain_covariance,
    walk_covariance,
    white_covariance,
    with_prior,
)
from drake_teleop.load.batch.moments import (
    Moments,
    Noise,
    excited_columns,
    inverse_root,
    normal_equations,
    residual_covariance,
)
from drake_teleop.load.batch.record import CHUNK, Fit, Options, Record
from drake_teleop.load.batch.total_least_squares import NormalForm, total_least_squares
from drake_teleop.load.identification import Identification, worth_stating
from drake_teleop.load.normal_equations import NormalEquations

# Least noise of a channel, relative to the wrench: what rounding leaves of a perfect record.
_ROUNDING = 1e-7
# A wrench's variance is at least this share of the residual's, whatever the motion's explains.
_LEAST_SHARE = 0.01
# Huber's limit and the rejection's, in robust standard deviations; fits at most; and how many
# samples the median looks at.
_HUBER, _REJECT, _FITS, _MEDIAN_SAMPLES = 3.0, 4.5, 30, 20000
_NORMAL_MAD = 1.4826
# Samples of which a median says something, samples from which to start, and how much a standard
# deviation may grow by what is rejected.
_FEWEST_TO_REJECT, _SOME, _MOST_LOSS = 12, 50_000, 2.0
_NOTHING_REJECTED = (
    "the residual is large where the load moves and small where it rests, so that disturbances"
    " cannot be told from errors of the motion (delay, scale, mounting): no sample was rejected"
)


@dataclass(frozen=True, eq=False)
class BatchResult:
    """An identification by one of `METHODS`, and what it rests upon.

    Attributes:
        identification: the load.
        noise: (6,) standard deviations of the wrench channels that gave the weights [N, N m].
        rejected: (N,) bools, samples that the fit did without.
        note: what a user has to know of the fit; mostly empty.
        equations: of the samples that were used, with these weights: what
            `uncertainty.base_parameters` asks for.
    """

    identification: Identification
    noise: Array
    rejected: NDArray[np.bool_]
    note: str
    equations: NormalEquations


def _ordinary(record: Record, options: Options) -> Fit:
    form = total_least_squares(record.moments, Noise(), np.ones(6), offsets=options.offsets)
    return Fit(form, np.ones(6), record.moments, np.zeros(len(record.s), bool))


def _whitened(record: Record, options: Options) -> Fit:
    return _weighted(record.moments, replace(options, noise=Noise(options.noise.wrench)), record)


def _total(record: Record, options: Options) -> Fit:
    return _weighted(record.moments, options, record)


def _consistent(record: Record, options: Options) -> Fit:
    fit = _robust(record, options)
    gram, right, theta = fit.form[:3]
    if theta[6] < 0.0:
        # An inverted sign, or no load: the nearest possible body, nothing at all, would hide it.
        return fit
    theta = consistent_least_squares(gram, right, theta, options.prior, options.ellipsoid)
    return replace(fit, form=fit.form._replace(theta=theta))


def _robust(record: Record, options: Options) -> Fit:
    whole = _total(record, options)
    n = len(record.s)
    if n < _FEWEST_TO_REJECT:
        return whole
    # The start need not be better than what some of the samples say.
    form = _huber(record.every(max(1, n // _SOME)), options)
    rejected = np.zeros(n, bool)
    for _ in range(_FITS):
        last = rejected
        rejected = _distances(record, form.theta, options.shared_noise) > _REJECT
        moments = Moments()
        moments.add(*record.arrays, weights=~rejected)
        if _loss(whole, moments) > _MOST_LOSS:
            return replace(whole, note=_NOTHING_REJECTED)
        fit = _weighted(moments, options, record)
        form = fit.form
        if (rejected == last).all():
            break
    return replace(fit, rejected=rejected)


def _huber(record: Record, options: Options) -> NormalForm:
    """Iteratively reweighted, until the weights stay the same."""
    moments, weights = record.moments, np.ones(len(record.s))
    for _ in range(_FITS):
        before = weights
        form = _weighted(moments, options, record).form
        distances = _distances(record, form.theta, options.shared_noise)
        weights = np.minimum(1.0, _HUBER / np.maximum(distances, _HUBER))
        if np.abs(weights - before).max() < 0.01:
            break
        moments = Moments()
        moments.add(*record.arrays, weights=weights)
    return form


def _loss(whole: Fit, kept: Moments) -> float:
    """By how much fewer samples enlarge the standard deviation that grows most, noise alike."""
    if kept.samples < _FEWEST_TO_REJECT:
        return np.inf
    used = excited_columns(whole.moments.mean)
    variances = []
    for moments in (whole.moments, kept):
        gram = moments.samples * normal_equations(moments.mean, whole.form.weights)[0]
        variances.append(np.sum(inverse_root(gram, used) ** 2, axis=1)[used])
    return float(np.sqrt(np.max(variances[1] / variances[0])))


class Method(NamedTuple):
    """An estimator, and what `Identification.method` calls it."""

    name: str
    fit: Callable[[Record, Options], Fit]


METHODS = {
    "ordinary": Method("batch least squares", _ordinary),
    "whitened": Method("whitened least squares", _whitened),
    "robust": Method("robust least squares", _robust),
    "total": Method("total least squares", _total),
    "consistent": Method("physically consistent least squares", _consistent),
}
"""The estimators by name, all with one signature: a line here enters one."""

DEFAULT_METHOD = "consistent"


def check_method(method: str) -> None:
    """Raises DrakeTeleopError unless it is one of `METHODS`."""
    if not isinstance(method, str) or method not in METHODS:
        raise DrakeTeleopError(f"{method!r} is not one of {sorted(METHODS)}", where="method")


def identify_batch(
    wrench: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    *,
    method: str = DEFAULT_METHOD,
    noise: Noise | None = None,
    offsets: bool = True,
    shared_noise: bool = False,
    resolution: tuple[float, float] = (0.0, 0.0),
    prior: Prior | None = None,
    ellipsoid: Ellipsoid | None = None,
    delay_s: float = 0.0,
    gain_std: float = 0.0,
) -> BatchResult:
    """Load and sensor offsets of a free motion by any of `METHODS`.

    Args:
        wrench: (N, 6) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
        s, omega, alpha: (N, 3) specific force a - g [m/s^2], angular velocity [rad/s] and angular
            acceleration [rad/s^2] of S in S, in the order of time.
        method: one of `METHODS`.
        noise: of wrench and motion; default: that of the wrench is estimated, the motion is exact
            and offsets do not wander.
        offsets: whether to estimate the sensor's; otherwise they were subtracted before.
        shared_noise: whether the three forces have one estimated noise, and the three torques one,
            as is right for averages over poses at rest (module docstring).
        resolution: step of the numbers of forces and torques [N, N m], for averages over poses.
        prior, ellipsoid: what is known of the load, for "consistent".
        delay_s: the delay that was taken out of the motion, for the record [s].
        gain_std: standard deviation of each of the sensor's 36 gains, such as 0.01, of one between
            force and torque as at `drake_teleop.load.batch.covariance.ARM`; it enters the
            covariance.

    Raises:
        DrakeTeleopError: for an unknown method, arrays of another shape, numbers that are not
            finite, a negative `gain_std`, fewer than 3 samples, or a wrench that is zero
            throughout.
    """
    check_method(method)
    expect((Noise, type(None)), noise, "noise")
    if not number("gain_std", gain_std) >= 0.0:
        raise DrakeTeleopError("is negative", where="gain_std")
    if method != "consistent" and (prior, ellipsoid) != (None, None):
        raise DrakeTeleopError(
            f"{method!r} takes no prior and no ellipsoid", where="method", remedy="use consistent"
        )
    _, rows = checked_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
    record = Record(*rows)
    fit = METHODS[method].fit(
        record, Options(noise or Noise(), offsets, shared_noise, prior, ellipsoid)
    )
    equations = NormalEquations(
        np.diag(fit.form.weights) ** -0.5, resolution=resolution if shared_noise else None
    )
    kept = ~fit.rejected
    equations.add(*(rows if kept.all() else [table[kept] for table in rows]))
    plain = equations.solve(delay_s)
    theta, Z = fit.form.theta, fit.moments.mean
    steps = residual_covariance(Moments.walk_covariance(noise or Noise()), theta)
    white = white_covariance(plain.covariance, equations, fit)
    covariance = covariance_of(white + walk_covariance(record, kept, fit, steps), fit.form, offsets)
    if gain_std > 0.0:
        known = np.isfinite(np.diag(covariance))
        covariance += np.outer(known, known) * gain_std**2 * gain_covariance(fit, offsets)
    dominated = np.zeros(16, bool)
    if prior is not None:
        covariance, dominated = with_prior(covariance, prior.information(plain.samples))
    deviations = np.sqrt(np.diag(covariance))
    identification = replace(
        plain,
        phi=theta[6:],
        offsets=theta[:6],
        covariance=covariance,
        identifiable=worth_stating(deviations, theta[6:]) & ~dominated,
        prior_dominated=dominated,
        residual_rms=np.sqrt(np.diag(residual_covariance(Z, theta)).clip(0.0)),
        method=METHODS[method].name,
    )
    return BatchResult(identification, fit.wrench_noise, fit.rejected, fit.note, equations)


def _weighted(moments: Moments, options: Options, record: Record) -> Fit:
    """Errors in variables with the noise that is given, or with the residual's."""
    noise, Z = options.noise, moments.mean
    if noise.wrench is not None:
        std = np.asarray(noise.wrench, np.float64)
    else:
        std = np.ones(6)
        floor = _ROUNDING * np.sqrt(np.diag(Z)[1:7].reshape(2, 3).sum(axis=1)).repeat(3)
        floor = np.where(floor > 0.0, floor, 1.0)
        for known in (Noise(), noise):
            theta = total_least_squares(moments, known, std, offsets=options.offsets).theta
            squares = np.diag(residual_covariance(Z, theta))
            motion = moments.noise_covariance(noise, np.zeros(6))
            explained = np.diag(residual_covariance(motion, theta))
            if options.shared_noise:
                squares, explained = (
                    x.reshape(2, 3).mean(axis=1).repeat(3) for x in (squares, explained)
                )
            std = np.sqrt(np.maximum(squares - explained, _LEAST_SHARE * squares).clip(floor**2))
    form = total_least_squares(moments, noise, std, offsets=options.offsets)
    return Fit(form, std, moments, np.zeros(len(record.s), bool))


def _distances(record: Record, theta: Array, shared: bool) -> Array:
    """(N,) largest residual of a sample's channels over the channel's robust deviation."""
    n = len(record.s)
    some = np.abs(record.residual(theta, slice(0, n, max(1, n // _MEDIAN_SAMPLES))))
    median = np.median(some, axis=0)
    if shared:
        median = np.median(some.reshape(-1, 2, 3), axis=(0, 2)).repeat(3)
    rms = np.sqrt(np.mean(record.wrench**2, axis=0).reshape(2, 3).sum(axis=1)).repeat(3)
    scale = np.maximum(_NORMAL_MAD * median, _ROUNDING * rms)
    scale = np.where(scale > 0.0, scale, 1.0)
    out = np.empty(n)
    for start in range(0, n, CHUNK):
        part = slice(start, start + CHUNK)
        out[part] = (np.abs(record.residual(theta, part)) / scale).max(axis=1)
    return out
