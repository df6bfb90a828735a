"""Fitted model of a record: whitened rows, Gauss-Newton fit, and tests of its residual."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes import instants
from drake_teleop.logs.causes.instants import BlockMeans
from drake_teleop.logs.causes.model import SYMMETRIC_MATRIX_INDICES, LoadModel

MIN_ROWS_FOR_AUTOREGRESSION = 50
TimeSpans = tuple[tuple[float, float], ...]  # (start, stop) of contacts [s]


@dataclass(frozen=True, eq=False)
class UsedRows:
    """Rows of a record (flags `used` (M,)) and signal columns to which a model is fitted."""

    means: BlockMeans
    used: NDArray[np.bool_]
    step_times: tuple[float, ...]
    columns: NDArray[np.intp]

    @cached_property
    def y(self) -> Array:
        zeroed = self.means.with_only_used_rows(self.used)
        return zeroed.append_step_signals(self.step_times)[:, self.columns]

    @cached_property
    def lagged_product_sums(self) -> Array:
        """Sums (5, W, W) of products of W signals y_i y_(i-d)^T, lags d <= 4 rows; symmetrized."""
        return np.asarray(self.means.lagged_block_sums(self.y, rows=len(self.y))[0])

    @cached_property
    def rows_with_four_predecessors(self) -> NDArray[np.intp]:
        padded = np.pad(self.used, (instants.AR_ORDER, 0))
        return np.flatnonzero(sliding_window_view(padded, instants.AR_ORDER + 1).all(axis=1))

    @cached_property
    def _lagged_signals_near_gaps(self) -> Array:
        padded = np.pad(self.used, instants.AR_ORDER)
        near = np.flatnonzero(sliding_window_view(padded, instants.AR_ORDER + 1).any(axis=1))
        edge = np.setdiff1d(near, self.rows_with_four_predecessors)
        at = edge[:, None] - np.arange(instants.AR_ORDER + 1)
        y = np.vstack([self.y, np.zeros((2 * instants.AR_ORDER, self.y.shape[1]))])
        return np.asarray(y[at])

    def whitened_products(self, filters: Array) -> Array:
        """Return product sums (6, n, n) of n signals, whitened by each row of `filters` (6, 5)."""
        width = self.y.shape[1]
        taps = [(filters[:, : 5 - d] * filters[:, d:]).sum(axis=1) for d in range(5)]
        full = np.stack(taps, axis=1) @ self.lagged_product_sums.reshape(5, -1)
        out = full.reshape(6, width, width)
        edge = np.tensordot(filters, self._lagged_signals_near_gaps, axes=(1, 1))
        return np.asarray(out - edge.transpose(0, 2, 1) @ edge)

    def noise_filters_and_power(
        self, residual_coefficients: Array, floor: Array, is_white: bool = False
    ) -> tuple[Array, Array]:
        """Return the residual's whitening filters (6, 5) and noise power (6,), at least `floor`."""
        e = self.y @ residual_coefficients.T
        filters = np.eye(1, instants.AR_ORDER + 1).repeat(6, axis=0)
        now = self.rows_with_four_predecessors
        history = np.stack([e[now - d] for d in range(instants.AR_ORDER + 1)], axis=2)
        products = np.einsum("nci,ncj->cij", history, history, optimize=True)
        products /= max(len(now), 1)
        if is_white or len(now) < MIN_ROWS_FOR_AUTOREGRESSION:
            return filters, np.maximum(products[:, 0, 0], floor)
        inner = products[:, 1:, 1:] + 1e-9 * products[:, :1, :1] * np.eye(instants.AR_ORDER)
        inner += 1e-300 * np.eye(instants.AR_ORDER)
        filters[:, 1:] = -np.linalg.solve(inner, products[:, 1:, :1])[..., 0]
        power = products[:, 0, 0] + (filters[:, 1:] * products[:, 0, 1:]).sum(axis=1)
        return filters, np.maximum(power, floor)

    def residual_rms(self, residual_coefficients: Array) -> Array:
        e = self.y @ residual_coefficients.T
        return np.asarray(np.sqrt((e * e).sum(axis=0) / max(self.used.sum(), 1)))


def is_in_time_spans(means: BlockMeans, spans: TimeSpans) -> NDArray[np.bool_]:
    inside = [(means.t >= start) & (means.t <= stop) for start, stop in spans]
    return np.any([np.zeros(len(means.t), bool), *inside], axis=0)


_MAX_FIT_ITERATIONS, _CONVERGED_MOVE_OVER_DEVIATION, _UNWEIGHTED_FIT_ITERATIONS = 12, 0.02, 2
_RIDGE_OF_SCALED_GRAM, _MIN_NOISE_OVER_SIGNAL_POWER = 1e-11, 1e-14
_NUM_TIME_SEGMENTS_OF_MISFIT_TEST = 6
# (18, 27) from rotation-position products to the signals of a symmetric stiffness.
_CABLE_ENTRY_MASKS = [SYMMETRIC_MATRIX_INDICES.ravel() == k for k in (0, 3, 5, 1, 2, 4)]
_CABLE_STIFFNESS_MATRIX = np.vstack([np.kron(np.eye(3), entry) for entry in _CABLE_ENTRY_MASKS])


@dataclass(frozen=True, eq=False)
class FittedModel:
    """Model with parameters x (size,), fitted to rows of a record.

    Attributes:
        covariance: (size, size); huge for undetermined parameters.
        residual: (6, k) coefficients; their product with k signals of a row is the residual wrench.
        noise_filters: (6, 5) that whiten the residual e: sum over d of filter[c, d] e_c[n - d].
        noise_power: (6,) variance of the whitened residual.
        contact_spans: (start, stop) of contacts, whose rows are not used [s].
    """

    model: LoadModel
    rows: UsedRows
    x: Array
    covariance: Array
    residual: Array
    noise_filters: Array
    noise_power: Array
    contact_spans: TimeSpans = ()

    @classmethod
    def fit_record(
        cls, means: BlockMeans, model: LoadModel, start: Array | None = None, spans: TimeSpans = ()
    ) -> FittedModel:
        free = means.used & ~is_in_time_spans(means, spans)
        rows = UsedRows(means, free, model.step_times, model.columns)
        return fit_model(model, rows, start, spans)

    def refit(self, model: LoadModel, start: Array | None = None, **options: int) -> FittedModel:
        if start is None:
            start = model.start_parameters(self.x, self.model)
        rows = self._used_rows_with_columns_of_model(model)
        return fit_model(model, rows, start, self.contact_spans, **options)

    def _used_rows_with_columns_of_model(self, model: LoadModel) -> UsedRows:
        rows = self.rows
        if rows.step_times == model.step_times and np.array_equal(rows.columns, model.columns):
            return rows
        return UsedRows(self.means, rows.used, model.step_times, model.columns)

    @property
    def means(self) -> BlockMeans:
        return self.rows.means

    def parameters_of_extension(self, name: str) -> tuple[Array, Array]:
        """Return the parameters of a named extension of the model, and their covariance."""
        where = self.model.parameter_slices[name]
        return self.x[where], self.covariance[where, where]

    def normal_equations(self, model: LoadModel, x: Array) -> tuple[Array, Array]:
        """Return gram (size, size) and right side (size,) of the normal equations at x (size,)."""
        whitened = self.rows.whitened_products(self.noise_filters) / self.noise_power[:, None, None]
        J = model.wrench_jacobian(x).transpose(1, 0, 2)
        weighted = J @ whitened
        gram = (weighted @ J.transpose(0, 2, 1)).sum(axis=0)
        right = (weighted @ self.residual[:, :, None]).sum(axis=0)[:, 0]
        return 0.5 * (gram + gram.T), right

    @cached_property
    def log_likelihood(self) -> float:
        """Log likelihood of all rows; rows in contact have a separate noise power."""
        count = len(self.rows.rows_with_four_predecessors)
        own = -0.5 * count * float(np.log(self.noise_power).sum())
        if not self.contact_spans:
            return own
        inside = replace(self.rows, used=self.means.used & ~self.rows.used)
        power = inside.noise_filters_and_power(self.residual, 1e-6 * self.noise_power)[1]
        # Rows at the edges of contacts count as noise of this power, too.
        every = replace(self.rows, used=self.means.used)
        others = len(every.rows_with_four_predecessors) - count
        return own - 0.5 * others * float(np.log(power).sum())

    @cached_property
    def residual_ratio(self) -> float:
        """RMS residual over white noise, in the channel where this ratio is largest."""
        white = np.maximum(self.means.wrench_noise, 1e-12)
        return float(np.max(self.rows.residual_rms(self.residual) / white))

    @cached_property
    def smooth_misfit(self) -> float:
        """Gain in 2 log likelihood by smooth signals, per added parameter; about 1 for noise."""
        gain, freedom = self.smooth_likelihood_gain
        return gain / max(1, freedom - self.model.size)

    @cached_property
    def smooth_likelihood_gain(self) -> tuple[float, int]:
        """Gain in twice the log likelihood by generic smooth signals, and number of parameters."""
        y = self.means.y
        segments = _NUM_TIME_SEGMENTS_OF_MISFIT_TEST
        part = np.linspace(0.0, segments, len(y), endpoint=False).astype(int)
        parts = [y[:, : instants.OMEGA_PRODUCTS.stop]]
        if self.means.gravity_W is not None:
            parts.append(y[:, instants.ROTATION_SIGNALS])
        if self.means.has_positions:
            parts.append(y[:, instants.ROTATION_POSITION_PRODUCTS] @ _CABLE_STIFFNESS_MATRIX.T)
        columns = np.hstack([*parts, part[:, None] == np.arange(1.0, segments)])
        e = self.rows.y @ self.residual.T
        whole, filters = self.rows.rows_with_four_predecessors, self.noise_filters
        gain, freedom = 0.0, 0
        late = [columns[whole - d] for d in range(instants.AR_ORDER + 1)]
        for c in range(6):
            x = sum(a * part for a, part in zip(filters[c], late, strict=True))
            white = sum(a * e[whole - d, c] for d, a in enumerate(filters[c]))
            solved, rank = score_statistic(x.T @ x, x.T @ white)
            gain, freedom = gain + solved / self.noise_power[c], freedom + rank
        return gain, freedom

    def score_of_larger_model(self, model: LoadModel) -> float:
        """Return the first-order gain in twice the log likelihood with a larger model."""
        x = model.start_parameters(self.x, self.model)
        rows = self._used_rows_with_columns_of_model(model)
        residual = self.residual if rows is self.rows else model.residual_coefficients(x)
        other = replace(self, rows=rows, residual=residual)
        return score_statistic(*other.normal_equations(model, x))[0]


def fit_model(
    model: LoadModel,
    rows: UsedRows,
    start: Array | None = None,
    spans: TimeSpans = (),
    *,
    iterations: int = _MAX_FIT_ITERATIONS,
) -> FittedModel:
    x = np.zeros(model.size) if start is None else start
    count = max(float(rows.used.sum()), 1.0)
    total = (rows.means.y[rows.used][:, instants.WRENCH_SIGNALS] ** 2).sum(axis=0) / count
    both = total.reshape(2, 3).sum(axis=1).repeat(3)
    floor = np.maximum(_MIN_NOISE_OVER_SIGNAL_POWER * both, 1e-30)
    white = np.eye(1, instants.AR_ORDER + 1).repeat(6, axis=0)
    residual, power = model.residual_coefficients(x), np.maximum(both, floor)
    found = FittedModel(model, rows, x, np.zeros(0), residual, white, power, spans)
    for iteration in range(iterations):
        gram, right = found.normal_equations(model, x)
        inverse = regularized_inverse(gram)
        move = inverse @ right
        move /= max(1.0, float(np.max(np.abs(move) / model.max_parameter_changes)))
        x = x + move
        residual = model.residual_coefficients(x)
        is_white = iteration + 1 < _UNWEIGHTED_FIT_ITERATIONS
        filters, power = rows.noise_filters_and_power(residual, floor, is_white)
        found = FittedModel(model, rows, x, inverse, residual, filters, power, spans)
        still = np.max(np.abs(move) / np.sqrt(np.diag(inverse))) < _CONVERGED_MOVE_OVER_DEVIATION
        if still and iteration > _UNWEIGHTED_FIT_ITERATIONS:
            break
    return found


def regularized_inverse(gram: Array) -> Array:
    diagonal = np.diag(gram)
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-14 * diagonal.max() + 1e-300))
    scaled = gram * np.outer(scale, scale)
    scaled[np.diag_indices(len(gram))] += _RIDGE_OF_SCALED_GRAM
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, _RIDGE_OF_SCALED_GRAM)
    return np.asarray(scale[:, None] * ((vectors / values) @ vectors.T) * scale)


def score_statistic(gram: Array, right: Array, min_diagonal: ArrayLike = 0.0) -> tuple[float, int]:
    """Return right^T gram^-1 right, the gain in twice the log likelihood, and rank of gram."""
    diagonal = np.diag(gram)
    used = diagonal > np.maximum(min_diagonal, 1e-12 * diagonal.max())
    if not used.any():
        return 0.0, 0
    scale = 1.0 / np.sqrt(diagonal[used])
    scaled = gram[np.ix_(used, used)] * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    kept = values > 1e-7 * values[-1]
    part = vectors[:, kept].T @ (scale * right[used])
    return float(np.sum(part**2 / values[kept])), int(kept.sum())
