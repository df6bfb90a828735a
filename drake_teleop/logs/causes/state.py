"""Fitted model of a record, and tests of its residual."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.fit import Fit, fit
from drake_teleop.logs.causes.instants import ORDER, PRODUCTS, RP, Instants, R
from drake_teleop.logs.causes.model import Model
from drake_teleop.logs.causes.rows import Rows, Spans, in_spans

_SEGMENTS = 6
_STIFFNESS_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, eq=False)
class State:
    """Model fitted to the rows of a record outside of contacts (`spans`: start, stop [s])."""

    data: Instants
    spans: Spans
    fit: Fit

    @classmethod
    def of(
        cls, data: Instants, model: Model, start: Array | None = None, spans: Spans = ()
    ) -> State:
        """Fit a model outside of the time spans, from the parameters `start`."""
        used = data.used & ~in_spans(data, spans)
        return cls(data, spans, fit(model, Rows(data, used, model.times, model.columns), start))

    def extended(self, model: Model, start: Array | None = None, **options: int) -> State:
        """Fit another model to the same rows."""
        if start is None:
            start = model.start(self.x, self.model)
        return State(self.data, self.spans, fit(model, self._rows_of(model), start, **options))

    def _rows_of(self, model: Model) -> Rows:
        if self.rows.fits(model):
            return self.rows
        return Rows(self.data, self.rows.used, model.times, model.columns)

    @property
    def model(self) -> Model:
        """Fitted model."""
        return self.fit.model

    @property
    def x(self) -> Array:
        """Fitted parameters (size,)."""
        return self.fit.x

    def extension(self, name: str) -> tuple[Array, Array]:
        """Return the parameters of an extension, and their covariance."""
        where = self.model.slices[name]
        return self.x[where], self.fit.covariance[where, where]

    @property
    def rows(self) -> Rows:
        """Rows outside of contacts."""
        return self.fit.rows

    @cached_property
    def likelihood(self) -> float:
        """Logarithm of the likelihood of all rows; contacts have separate noise."""
        if not self.spans:
            return self.fit.likelihood
        used = self.data.used & ~self.rows.used
        inside = Rows(self.data, used, self.model.times, self.model.columns)
        power = inside.noise(self.fit.residual, 1e-6 * self.fit.power)[1]
        # Rows at the edges of contacts count as noise of this power, too.
        count = len(self.whole) - len(self.rows.whole)
        return self.fit.likelihood - 0.5 * count * float(np.log(power).sum())

    @cached_property
    def whole(self) -> Array:
        """Indices of rows whose four predecessors are used, too."""
        return np.asarray(Rows(self.data, self.data.used, (), self.model.columns).whole)

    @cached_property
    def residual_ratio(self) -> float:
        """Ratio of RMS residual to white noise, in the channel where it is largest."""
        white = np.maximum(self.data.white, 1e-12)
        return float(np.max(self.rows.rms(self.fit.residual) / white))

    @cached_property
    def smooth_misfit(self) -> float:
        """Measure of how much generic smooth signals would reduce the residual.

        It is the gain of twice the log likelihood per degree of freedom: about 1 or below for noise
        of any colour.
        """
        gain, freedom = self.smooth_gain
        return gain / max(1, freedom - self.model.size)

    @cached_property
    def smooth_gain(self) -> tuple[float, int]:
        """Gain of twice the log likelihood by generic smooth signals, and their number."""
        columns = self.data.y[:, self._smooth()]
        if self.data.positions:
            columns = np.hstack([columns, self.data.y[:, RP] @ _springs().T])
        columns = np.hstack([columns, self._segments()])
        e = self.rows.y @ self.fit.residual.T
        whole, filters = self.rows.whole, self.fit.filters
        gain, freedom = 0.0, 0
        late = [columns[whole - d] for d in range(ORDER + 1)]
        for c in range(6):
            x = sum(a * part for a, part in zip(filters[c], late, strict=True))
            white = sum(a * e[whole - d, c] for d, a in enumerate(filters[c]))
            solved, rank = gain_of(x.T @ x, x.T @ white)
            gain, freedom = gain + solved / self.fit.power[c], freedom + rank
        return gain, freedom

    def _smooth(self) -> list[int]:
        used = list(range(PRODUCTS.stop))
        return used + list(range(R.start, R.stop)) if self.data.gravity_W is not None else used

    def _segments(self) -> Array:
        part = np.linspace(0.0, _SEGMENTS, len(self.data.t), endpoint=False).astype(int)
        return np.asarray(part[:, None] == np.arange(1, _SEGMENTS), float)

    def score(self, model: Model) -> float:
        """Return the first-order gain of twice the log likelihood by fitting a larger model."""
        x = model.start(self.x, self.model)
        rows = self._rows_of(model)
        residual = self.fit.residual if rows is self.rows else model.residual(x)
        return gain_of(*replace(self.fit, rows=rows, residual=residual).normal(model, x))[0]


def gain_of(gram: Array, right: Array, least: Array | float = 0.0) -> tuple[float, int]:
    """Return right^T gram^-1 right and the rank; diagonals below `least` count as rounding."""
    diagonal = np.diag(gram)
    used = diagonal > np.maximum(least, 1e-12 * diagonal.max())
    if not used.any():
        return 0.0, 0
    scale = 1.0 / np.sqrt(diagonal[used])
    scaled = gram[np.ix_(used, used)] * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    kept = values > 1e-7 * values[-1]
    part = vectors[:, kept].T @ (scale * right[used])
    return float(np.sum(part**2 / values[kept])), int(kept.sum())


def _springs() -> Array:
    out = np.zeros((6, 3, 27))
    for row, (j, k) in enumerate(_STIFFNESS_PAIRS):
        for i in range(3):
            for a, b in {(j, k), (k, j)}:
                out[row, i, 9 * i + 3 * a + b] = 1.0
    return out.reshape(18, 27)
