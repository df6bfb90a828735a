"""Selected rows of a record and their whitened sums of products."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.instants import ORDER, Instants
from drake_teleop.logs.causes.model import Model

_MIN_NOISE_ROWS = 50
"""Fewest rows for an autoregression."""
Spans = tuple[tuple[float, float], ...]
"""(start, stop) of contacts [s]."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Selected rows (`used`, (M,)) of a record, and columns of its signals, for a model."""

    data: Instants
    used: NDArray[np.bool_]
    times: tuple[float, ...]
    columns: NDArray[np.intp]

    def fits(self, model: Model) -> bool:
        """Return whether `model` uses the same signals."""
        return self.times == model.times and np.array_equal(self.columns, model.columns)

    @cached_property
    def y(self) -> Array:
        """Signals (M, W), 0 in unused rows."""
        return self.data.only(self.used).with_steps(self.times)[:, self.columns]

    @cached_property
    def sums(self) -> Array:
        """Sums (5, W, W) of products of the signals at lags 0 to 4."""
        return np.asarray(self.data.sums(self.y, rows=len(self.y))[0])

    @cached_property
    def whole(self) -> NDArray[np.intp]:
        """Indices of rows whose four predecessors are used, too."""
        whole = self.used.copy()
        whole[:ORDER] = False
        for d in range(1, ORDER + 1):
            whole[d:] &= self.used[:-d]
        return np.flatnonzero(whole)

    @cached_property
    def _partial(self) -> Array:
        padded = np.concatenate([self.used, np.zeros(ORDER, bool)])
        near = padded.copy()
        for d in range(1, ORDER + 1):
            near[d:] |= padded[:-d]
        near[self.whole] = False
        at = np.flatnonzero(near)[:, None] - np.arange(ORDER + 1)
        y = np.vstack([self.y, np.zeros((2 * ORDER, self.y.shape[1]))])
        return np.asarray(y[at])

    def whitened(self, filters: Array) -> Array:
        """Return sums of products (6, W, W) of the signals after filters (6, 5) per channel."""
        width = self.y.shape[1]
        taps = [(filters[:, : ORDER + 1 - d] * filters[:, d:]).sum(axis=1) for d in range(5)]
        full = np.stack(taps, axis=1) @ self.sums.reshape(ORDER + 1, -1)
        out = full.reshape(6, width, width)
        edge = np.tensordot(filters, self._partial, axes=(1, 1))
        return np.asarray(out - edge.transpose(0, 2, 1) @ edge)

    def noise(self, residual: Array, floor: Array, order: int = ORDER) -> tuple[Array, Array]:
        """Return whitening filters (6, 5) and noise power (6,) for the residual (6, W)."""
        e = self.y @ residual.T
        filters = np.zeros((6, ORDER + 1))
        filters[:, 0] = 1.0
        history = np.stack([e[self.whole - d] for d in range(ORDER + 1)], axis=2)
        products = np.einsum("nci,ncj->cij", history, history, optimize=True)
        products /= max(len(self.whole), 1)
        if order == 0 or len(self.whole) < _MIN_NOISE_ROWS:
            return filters, np.maximum(products[:, 0, 0], floor)
        inner = products[:, 1:, 1:] + 1e-9 * products[:, :1, :1] * np.eye(ORDER)
        inner += 1e-300 * np.eye(ORDER)
        filters[:, 1:] = -np.linalg.solve(inner, products[:, 1:, :1])[..., 0]
        power = products[:, 0, 0] + (filters[:, 1:] * products[:, 0, 1:]).sum(axis=1)
        return filters, np.maximum(power, floor)

    def rms(self, residual: Array) -> Array:
        """Return the RMS (6,) of a residual with coefficients (6, W) in the signals."""
        e = self.y @ residual.T
        return np.asarray(np.sqrt((e * e).sum(axis=0) / max(self.used.sum(), 1)))


def in_spans(data: Instants, spans: Spans) -> NDArray[np.bool_]:
    """Return (M,) booleans: True for rows within a time span."""
    inside = np.zeros(len(data.t), bool)
    for start, stop in spans:
        inside |= (data.t >= start) & (data.t <= stop)
    return inside
