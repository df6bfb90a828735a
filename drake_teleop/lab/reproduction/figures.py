"""Figs. 6 to 8 from arrays, in the paper's layout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from drake_teleop.common import style
from drake_teleop.common.numeric import Array


def scaling_figure(
    t: ArrayLike,
    values: Sequence[ArrayLike],
    sigmas: Sequence[float],
    *,
    symbol: str,
    unit: str,
    downscaling: float,
) -> Figure:
    """Draw Fig. 6 or 7: one component at the slave for each sigma; right axes at the master.

    `symbol` is matplotlib text; `downscaling` is force at the slave over force at the master.
    """
    time, time_unit = _time_axis(t)
    traces = [np.asarray(trace, float) for trace in values]
    at_master_and_back = (
        lambda v: np.asarray(v) / downscaling,
        lambda v: np.asarray(v) * downscaling,
    )
    meanings = {1.0: "as measured", 0.0: "non-contact part eliminated"}
    with style.plot_style():
        figure = style.Picture(figsize=(7.6, 1.2 + 1.75 * len(traces)))
        rows = figure.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for axes, trace, sigma in zip(rows, traces, sigmas, strict=True):
            axes.plot(time, trace, color=style.BLUE if sigma else style.GREEN)
            meaning = meanings.get(sigma, f"{sigma:.0%} of the non-contact part")
            axes.set(title=f"σ = {sigma:g}:  {meaning}", ylabel=f"{symbol} [{unit}]")
            peak = float(np.abs(trace).max())
            slave, master = _format_number(peak), _format_number(peak / downscaling)
            note = f"peak {slave} {unit}   ·   {master} {unit} at the master"
            _write_note_above_axes(axes, note)
            right = axes.secondary_yaxis("right", functions=at_master_and_back)
            right.set_ylabel(f"at the master [{unit}]", color=style.GREY)
            right.spines["right"].set_visible(True)
        rows[0].set(ylim=_common_value_range(traces), xlim=(time[0], time[-1]))
        rows[-1].set_xlabel(f"t [{time_unit}]")
    return figure


def contact_figure(
    t: ArrayLike,
    measured: ArrayLike,
    contact_force: ArrayLike,
    *,
    symbol: str,
    contact: ArrayLike,
    detected_s: float,
    threshold: float,
    turning_s: float | None = None,
) -> Figure:
    """Draw Fig. 8: measured force and calculated contact force [N], with shaded contact (N,).

    `threshold` [N] and `detected_s` are of the detection; `turning_s`: reversal without contact.
    """
    time, time_unit = _time_axis(t)
    per_second = 1e3 if time_unit == "ms" else 1.0
    traces = [np.asarray(trace, float) for trace in (measured, contact_force)]
    touched = np.asarray(contact, bool)
    with style.plot_style():
        figure = style.Picture(figsize=(7.6, 5.0))
        rows = figure.subplots(2, 1, sharex=True, sharey=True)
        titles = ("Measured force", "Calculated contact force, σ = 0")
        colours = (style.BLUE, style.GREEN)
        for axes, trace, title, colour in zip(rows, traces, titles, colours, strict=True):
            style.shade_contact(axes, time, touched)
            axes.plot(time, trace, color=colour)
            axes.set(title=title, ylabel=f"{symbol} [N]")
            if turning_s is not None:
                _draw_time_mark(axes, turning_s * per_second, "no contact", style.GREY)
        if touched.any():
            _draw_time_mark(rows[0], time[np.argmax(touched)], "contact", style.VERMILION)
        _draw_time_mark(rows[1], detected_s * per_second, "detected", style.VERMILION)
        for level in (-threshold, threshold):
            rows[1].axhline(level, color=style.VERMILION, linewidth=0.8, linestyle=":")
        peaks = [f"peak {_format_number(np.abs(trace).max())} N" for trace in traces]
        _write_note_above_axes(rows[0], peaks[0])
        _write_note_above_axes(rows[1], f"{peaks[1]}   ·   threshold {_format_number(threshold)} N")
        rows[0].set(ylim=_common_value_range(traces), xlim=(time[0], time[-1]))
        rows[1].set_xlabel(f"t [{time_unit}]")
    return figure


def _time_axis(t: ArrayLike) -> tuple[Array, str]:
    seconds = np.asarray(t, float)
    return (seconds * 1e3, "ms") if seconds[-1] - seconds[0] <= 2 else (seconds, "s")


def _common_value_range(traces: Sequence[Array]) -> tuple[float, float]:
    low, high = min(0.0, float(np.min(traces))), max(0.0, float(np.max(traces)))
    margin = 0.1 * (high - low) or 1.0
    return low - margin, high + margin


def _format_number(value: float) -> str:
    rounded = float(f"{value:.3g}")
    decimals = max(0, 2 - int(np.floor(np.log10(abs(rounded))))) if rounded else 0
    return f"{rounded:.{decimals}f}"


def _write_note_above_axes(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="right", color=style.GREY, fontsize=8.5)


def _draw_time_mark(axes: Axes, time: float, text: str, colour: str) -> None:
    axes.axvline(time, color=colour, linewidth=0.9, linestyle="--")
    axes.annotate(
        text, (time, 0.03), xycoords=("data", "axes fraction"), xytext=(4, 0),
        textcoords="offset points", color=colour, fontsize=8.5,
    )  # fmt: skip
