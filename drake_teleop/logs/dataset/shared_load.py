"""Load that most episodes of a dataset share, and their usual offsets, lag and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, samples_to_nearest_true
from drake_teleop.load.batch.consistent import consistent_least_squares
from drake_teleop.load.batch.uncertainty import parameter_errors_by_gains
from drake_teleop.load.contact import detection
from drake_teleop.load.contact.noise_floor import (
    DetectorSamples,
    NoiseFloor,
    limit_covariance_to_scales,
)
from drake_teleop.load.identification import Identification, is_precise_enough
from drake_teleop.logs.dataset import episode_verdict
from drake_teleop.logs.dataset.episode_verdict import EpisodeSignals, WrenchHypothesis
from drake_teleop.logs.processing import phi_with_inertia_replaced
from drake_teleop.logs.read.canonical import Log

_MIN_HALF_WIDTHS_N_NM = np.repeat([1e-3, 1e-4], 3)  # N, N m
_EXCESS_SPREAD_LIMIT, _MAX_MEMBER_EXCESS_SPREAD = 6.0, 2.0
_LAG_STEP_FRAMES, _MAX_LAG_FRAMES = 0.5, 3.0
_MIN_CONTACT_DEVIATIONS, _CONTACT_MARGIN_FRAMES = 5.0, 2
_THRESHOLD_OVER_MAX_FREE_STATISTIC = 1.1


@dataclass(frozen=True)
class SharedLoad:
    """Load that most episodes of a dataset share, with their usual delay and noise.

    Attributes:
        phi: (10,) load that is removed.
        lag_frames: usual delay of the motion behind the wrench [frames].
        usual_half_widths: (6,) usual half widths of the residual [N, N m].
        noise_floor, threshold: for contact detection.
    """

    identification: Identification
    phi: Array
    lag_frames: float
    usual_half_widths: Array
    noise_floor: NoiseFloor
    threshold: float


def find_shared_load(logs: Sequence[Log], load: Identification | None) -> SharedLoad:
    """Return the load that most episodes of a dataset share, or `load` if given."""
    signals = map(EpisodeSignals, logs)
    episodes = [_FittedEpisode(x, fit_own_load_of_episode(x)) for x in signals]
    if load is None:
        candidates = [x.own.phi for x in episodes if x.own.phi is not None and x.own.phi[0] > 0.0]
        if not candidates:
            what = "the fitted mass is negative in all episodes"
            remedy = "write wrench.sign: -1 into a --description file, or remove it if it is there"
            raise DrakeTeleopError(what, where="dataset", remedy=remedy)

        def robust_cost(phi: Array) -> float:
            return sum(min(x.spread_above_own_fit(phi), _EXCESS_SPREAD_LIMIT) for x in episodes)

        phi = min(candidates, key=robust_cost)
        for _ in range(2):
            load = _fit_shared_load(_episodes_sharing_load(episodes, phi), phi)
            phi = load.phi
    assert load is not None
    # Uncertain inertias are nearer to the truth than those of a point mass.
    determined = np.isfinite(load.standard_deviations).all()
    phi = load.phi if determined else phi_with_inertia_replaced(load)[0]
    chosen = _episodes_sharing_load(episodes, phi)
    usual = [x.fault_free_hypothesis_and_residual(phi) for x in chosen]
    steps = float(np.median([x.lag for x, _ in usual])) * episode_verdict.NUM_LAGS_PER_FRAME
    lag = round(steps) / episode_verdict.NUM_LAGS_PER_FRAME
    typical = np.exp(np.median([x.spread for x, _ in usual], axis=0))
    limit, free = _MIN_CONTACT_DEVIATIONS * typical / episode_verdict.STANDARD_NORMAL_QUARTILE, []
    for episode, (x, residual) in zip(chosen, usual, strict=True):
        contact = residual - x.offsets
        frames_from_touch = samples_to_nearest_true((np.abs(contact) > limit).any(axis=1))
        samples = samples_for_detector(episode.signals, x.lag, contact)
        free.append(samples.select_rows(frames_from_touch > _CONTACT_MARGIN_FRAMES))
    pooled = DetectorSamples(*(np.concatenate(parts) for parts in zip(*free, strict=True)))
    covariance = limit_covariance_to_scales(phi, load.covariance, tared=True)
    floor = detection.fit_noise_floor(*pooled, covariance, fade=0.0)
    threshold = max(
        detection.NOISE_LEVEL_ONCE_PER_MILLION_SAMPLES,
        _THRESHOLD_OVER_MAX_FREE_STATISTIC * float(floor.free_maxima[0]),
    )
    return SharedLoad(load, phi, lag, typical, floor, threshold)


def fit_own_load_of_episode(signals: EpisodeSignals) -> WrenchHypothesis:
    """Return the hypothesis with the load and lag that explain one episode best."""
    search = episode_verdict.HypothesisSearch(signals, np.zeros(10), 0.0, _MIN_HALF_WIDTHS_N_NM)
    lags = np.arange(-_MAX_LAG_FRAMES, _MAX_LAG_FRAMES + 0.1, _LAG_STEP_FRAMES)
    found = (search.hypothesis_of_other_load(float(lag)) for lag in lags)
    return min(found, key=lambda x: x.spread.sum())


class _FittedEpisode(NamedTuple):
    signals: EpisodeSignals
    own: WrenchHypothesis

    def fault_free_hypothesis_and_residual(self, phi: Array) -> tuple[WrenchHypothesis, Array]:
        """Return the best lag of load phi (10,) without faults, as hypothesis, and residual."""
        lag, count = self.own.lag, episode_verdict.NUM_LAGS_PER_FRAME
        search = episode_verdict.HypothesisSearch(self.signals, phi, lag, _MIN_HALF_WIDTHS_N_NM)
        lags = lag + np.arange(-count, count + 1) / count
        found = (
            search.with_spread_and_cost(episode_verdict.fault_free_hypothesis(float(lag)))
            for lag in lags
        )
        best = min(found, key=lambda x: x.spread.sum())
        return best, search.reading_without_load(best)

    def spread_above_own_fit(self, phi: Array) -> float:
        """Return the increase of the log spread by load phi (10,) instead of its own load."""
        usual = self.fault_free_hypothesis_and_residual(phi)[0]
        return float(usual.spread.sum() - self.own.spread.sum())


def _episodes_sharing_load(episodes: list[_FittedEpisode], phi: Array) -> list[_FittedEpisode]:
    found = [x for x in episodes if x.spread_above_own_fit(phi) < _MAX_MEMBER_EXCESS_SPREAD]
    return found or episodes


def _fit_shared_load(episodes: Sequence[_FittedEpisode], phi: Array) -> Identification:
    gram, right, squares, samples = np.zeros((10, 10)), np.zeros(10), np.zeros(6), 0
    offsets, delays, products, weights = [], [], [], []
    for episode in episodes:
        x, r = episode.fault_free_hypothesis_and_residual(phi)
        sigma = np.exp(x.spread) / episode_verdict.STANDARD_NORMAL_QUARTILE
        rows = (np.abs(r - x.offsets) < _MIN_CONTACT_DEVIATIONS * sigma).all(axis=1)
        V, w = episode.signals.regressor_at_lag(x.lag)[rows], episode.signals.log.wrench[rows]
        V, w = V - V.mean(axis=0), w - w.mean(axis=0)
        A, b = (V / sigma[:, None]).reshape(-1, 10), (w / sigma).ravel()
        gram, right = gram + A.T @ A, right + A.T @ b
        products.append(np.einsum("ncj,nk->cjk", V, w, optimize=True))
        weights.append(np.diag(sigma**-2))
        squares += ((r[rows] - r[rows].mean(axis=0)) ** 2).sum(axis=0)
        samples += int(rows.sum())
        offsets.append(x.offsets)
        delays.append(x.lag * episode.signals.log.dt)
    noise = np.sqrt(squares / max(samples, 1))
    size = np.sqrt(np.diag(gram)) + 1e-300
    inverse = np.linalg.pinv(gram / np.outer(size, size), rcond=1e-10, hermitian=True)
    inverse /= np.outer(size, size)
    fitted = inverse @ right
    whole = np.zeros((16, 16))
    whole[:6, :6], whole[6:, 6:] = np.diag(samples / noise**2), gram
    if fitted[0] > 0.0:
        theta = np.concatenate([np.zeros(6), fitted])
        fitted = consistent_least_squares(whole, whole @ theta, theta)[6:]
    covariance = np.zeros((16, 16))
    arrays = np.array(products), np.array(weights), np.asarray(inverse, float)
    effects = episodes[0].signals.log.gain_std * parameter_errors_by_gains(*arrays)
    covariance[:6, :6] = np.diag(noise**2 / samples)
    covariance[6:, 6:] = inverse + effects @ effects.T
    return Identification(
        phi=fitted,
        offsets=np.median(offsets, axis=0),
        covariance=covariance,
        identifiable=is_precise_enough(np.sqrt(np.diag(covariance)), fitted),
        condition_number=float(np.linalg.cond(gram / np.outer(size, size))),
        delay_s=float(np.median(delays)),
        residual_rms=noise,
        method="least squares of the calm frames of a dataset",
        samples=samples,
    )


def samples_for_detector(signals: EpisodeSignals, lag: float, contact: Array) -> DetectorSamples:
    at = signals.motion_at_lag(lag)
    return DetectorSamples(contact, at.s, at.omega, at.alpha, at.s + at.gravity)
