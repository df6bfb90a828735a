"""Figs. 6 to 8 in the paper's layout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_teleop.common import style
from drake_teleop.common.numeric import Array
from drake_teleop.lab.reproduction.experiments import (
    MotionRun,
    RunsWithAndWithoutContact,
    time_of_largest_raw_force_after_contact,
)

FORCE_Z_INDEX, TORQUE_X_INDEX = 2, 3


def scaling_figure(run: MotionRun, component: int, *, symbol: str, unit: str) -> Figure:
    """Draw Fig. 6 or 7: one component at the slave for each sigma; right axes at the master.

    `symbol` is matplotlib text.
    """
    time, time_unit = _time_axis(run.result.t)
    traces = [wrench[:, component] for wrench in run.scaled_wrenches.values()]
    scale = run.scenario.force_scaling.force_scale
    at_master_and_back = (lambda v: np.asarray(v) * scale, lambda v: np.asarray(v) / scale)
    meanings = {1.0: "as measured", 0.0: "non-contact part eliminated"}
    with style.plot_style():
        figure = style.Picture(figsize=(7.6, 1.2 + 1.75 * len(traces)))
        rows = figure.subplots(len(traces), 1, sharex=True, sharey=True)
        for axes, trace, sigma in zip(rows, traces, run.scaled_wrenches, strict=True):
            axes.plot(time, trace, color=style.BLUE if sigma else style.GREEN)
            meaning = meanings.get(sigma, f"{sigma:.0%} of the non-contact part")
            axes.set(title=f"σ = {sigma:g}:  {meaning}", ylabel=f"{symbol} [{unit}]")
            peak = float(np.abs(trace).max())
            slave, master = _format_number(peak), _format_number(scale * peak)
            note = f"peak {slave} {unit}   ·   {master} {unit} at the master"
            _write_note_above_axes(axes, note)
            right = axes.secondary_yaxis("right", functions=at_master_and_back)
            right.set_ylabel(f"at the master [{unit}]", color=style.GREY)
            right.spines["right"].set_visible(True)
        rows[0].set(ylim=_common_value_range(traces), xlim=(time[0], time[-1]))
        rows[-1].set_xlabel(f"t [{time_unit}]")
    return figure


def contact_figure(run: RunsWithAndWithoutContact, detected_s: float | None) -> Figure:
    """Draw Fig. 8: measured force and calculated contact force [N], with shaded contact."""
    time, time_unit = _time_axis(run.touched.result.t)
    per_second = 1e3 if time_unit == "ms" else 1.0
    traces = [run.touched.scaled_wrenches[sigma][:, FORCE_Z_INDEX] for sigma in (1.0, 0.0)]
    touched, turning_s = run.in_contact, time_of_largest_raw_force_after_contact(run)
    with style.plot_style():
        figure = style.Picture(figsize=(7.6, 5.0))
        rows = figure.subplots(2, 1, sharex=True, sharey=True)
        titles = ("Measured force", "Calculated contact force, σ = 0")
        colours = (style.BLUE, style.GREEN)
        for axes, trace, title, colour in zip(rows, traces, titles, colours, strict=True):
            style.shade_contact(axes, time, touched)
            axes.plot(time, trace, color=colour)
            axes.set(title=title, ylabel="$f_z$ [N]")
            if turning_s is not None:
                _draw_time_mark(axes, turning_s * per_second, "no contact", style.GREY)
        if touched.any():
            _draw_time_mark(rows[0], time[np.argmax(touched)], "contact", style.VERMILION)
        if detected_s is not None:
            _draw_time_mark(rows[1], detected_s * per_second, "detected", style.VERMILION)
        for level in (-run.threshold_N, run.threshold_N):
            rows[1].axhline(level, color=style.VERMILION, linewidth=0.8, linestyle=":")
        peak, contact_peak = (f"peak {_format_number(np.abs(trace).max())} N" for trace in traces)
        _write_note_above_axes(rows[0], peak)
        threshold = f"threshold {_format_number(run.threshold_N)} N"
        _write_note_above_axes(rows[1], f"{contact_peak}   ·   {threshold}")
        rows[0].set(ylim=_common_value_range(traces), xlim=(time[0], time[-1]))
        rows[1].set_xlabel(f"t [{time_unit}]")
    return figure


def _time_axis(t: Array) -> tuple[Array, str]:
    return (t * 1e3, "ms") if t[-1] - t[0] <= 2 else (t, "s")


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
