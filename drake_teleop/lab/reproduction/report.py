"""Report of `drake-teleop reproduce`: Figs. 6 to 8, and one self-contained page with tables."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from drake_teleop.common.html import write_report_page_and_pictures
from drake_teleop.common.numeric import Array
from drake_teleop.common.style import (
    BLUE,
    GREEN,
    GREY,
    VERMILION,
    Picture,
    plot_style,
    shade_contact,
)
from drake_teleop.lab.reproduction import experiments
from drake_teleop.logs.report import PARAMETER_FORMATS

FORCE_Z_INDEX, TORQUE_X_INDEX = 2, 3

_FIGURE_TITLES = {
    "fig6": "Fig. 6: scaling and elimination of non-contact forces",
    "fig7": "Fig. 7: scaling and elimination of non-contact torques",
    "fig8": "Fig. 8: contact transition",
}
_NOT_REPORTED = "not reported"


@dataclass(frozen=True)
class Comparison:
    """Row that compares paper and reproduction."""

    quantity: str
    paper_value: str
    reproduced_value: str
    set_or_found: str  #: "set" if the scenario was chosen to match the paper's value; else "found"
    accepted_range: str  #: as text; empty if the value is not comparable
    is_accepted: bool | None  #: None if the value is not comparable

    @property
    def verdict(self) -> str:
        if self.is_accepted is None:
            return "for the record"
        if self.paper_value == _NOT_REPORTED:
            return "within our bound" if self.is_accepted else "beyond our bound"
        if self.set_or_found == "set":
            return "as set" if self.is_accepted else "not as set"
        return "agrees" if self.is_accepted else "differs"

    @property
    def css_class(self) -> str:
        """CSS class of the verdict: "agrees", "differs" (highlighted) or "" (neutral)."""
        if self.is_accepted is False:
            return "differs"
        return "agrees" if self.verdict == "agrees" else ""


@dataclass(frozen=True)
class ParameterRow:
    """Row of the identification table; texts of numbers in `unit`."""

    symbol: str
    index: str
    true: str
    estimate: str
    error: str
    deviation: str
    unit: str


def compare_with_paper(summary: Mapping[str, Any]) -> list[Comparison]:
    s = summary
    delay_ms = 1e3 * (s["contact.detected_s"] - s["contact.true_s"])
    share = s["contact.peak_contact_N"] / s["contact.peak_inertial_N"]
    return [
        _compare_range("set", "Fig. 6: peak force at the slave, σ = 1", "about 100 N",
                       s["free_force.peak_raw_N"], "N", 90, 115),
        _compare_range("set", "Fig. 6: peak force at the master, σ = 1", "about 5.7 N",
                       s["free_force.peak_raw_master_N"], "N", 90 / 17.5, 115 / 17.5),
        _compare_range("set", "Fig. 6: rms force, σ = 0.5 / σ = 1", "half",
                       s["free_force.half_ratio"], "", 0.48, 0.52),
        _compare_range("found", "Fig. 6: largest residual force, σ = 0", "never above 5 N",
                       s["free_force.residual_max_N"], "N", 0, 5),
        _row_without_verdict("set", "Fig. 7: peak torque at the slave, σ = 1", "in the figure only",
                      s["free_torque.peak_raw_Nm"], "N m"),
        _compare_range("set", "Fig. 7: rms torque, σ = 0.5 / σ = 1", "half",
                       s["free_torque.half_ratio"], "", 0.48, 0.52),
        _row_without_verdict("found", "Fig. 7: largest residual torque, σ = 0", "“very low”",
                      s["free_torque.residual_max_Nm"], "N m"),
        _compare_range("found", "All axes, ideal sensor, true φ: residual force", _NOT_REPORTED,
                       s["ideal.residual_max_N"], "N", 0, 1e-9),
        _compare_range("found", "All axes, ideal sensor, true φ: residual torque", _NOT_REPORTED,
                       s["ideal.residual_max_Nm"], "N m", 0, 1e-9),
        _compare_range("set", "Fig. 8: time of contact", "about 220 ms",
                       1e3 * s["contact.true_s"], "ms", 205, 235),
        _compare_range("found", "Fig. 8: delay from contact to detection", "“clearly spotted”",
                       delay_ms, "ms", 0, 10),
        _compare_yes_no("Fig. 8: raw force exceeds its free range", "“less obvious”",
                        s["contact.raw_detectable"], False),
        _compare_yes_no("Fig. 8: false alarm after the contact", "no contact there",
                        s["contact.false_alarm_0_6_s"], False),
        _compare_range("found", "Fig. 8: contact / inertial peak force", "“significantly lower”",
                       share, "", 0, 0.7),
        _compare_range("found", "Mass, error of the estimate", _NOT_REPORTED,
                       s["identification.mass_error_percent"], "%", 0, 0.2),
        _compare_range("found", "Centre of mass, distance to estimate", _NOT_REPORTED,
                       s["identification.com_error_mm"], "mm", 0, 0.5),
    ]  # fmt: skip


def describe_values_outside_ranges(summary: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [
        f"{row.quantity}: {row.reproduced_value} (accepted: {row.accepted_range}): {row.verdict}"
        for row in compare_with_paper(values_by_full_name(summary))
        if row.is_accepted is False
    ]


def values_by_full_name(summary: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return all values in one dictionary, ``{"contact.true_s": 0.22, ...}``; None becomes NaN."""
    return {
        f"{part}.{name}": math.nan if value is None else value
        for part, figures in summary.items()
        for name, value in figures.items()
    }


def figure_captions(summary: Mapping[str, Any]) -> dict[str, str]:
    s = summary
    lag = 1e3 * (s["contact.detected_s"] - s["contact.true_s"])
    threshold = "a threshold" if s["contact.raw_detectable"] else "no threshold"
    alarm = "also crosses it" if s["contact.false_alarm_0_6_s"] else "stays below it"
    return {
        "fig6": (
            f"A fast vertical movement of the stylus in free space. Top: the load causes up to "
            f"{s['free_force.peak_raw_N']:.1f} N on the wrist sensor, "
            f"{s['free_force.peak_raw_master_N']:.2f} N after scaling to the master. Middle: half "
            f"of the non-contact force is eliminated and {s['free_force.half_ratio']:.1%} remains "
            f"(rms). Bottom: all of it is eliminated; at most "
            f"{s['free_force.residual_max_N']:.2f} N remain, including sensor noise."
        ),
        "fig7": (
            f"The same for the torque, in a horizontal movement: "
            f"{s['free_torque.peak_raw_Nm']:.2f} N m as measured, "
            f"{s['free_torque.half_ratio']:.1%} of it (rms) with σ = 0.5, and at most "
            f"{s['free_torque.residual_max_Nm']:.3f} N m with σ = 0."
        ),
        "fig8": (
            f"A repetitive vertical movement that touches the sheet spring once, at "
            f"{1e3 * s['contact.true_s']:.0f} ms (shaded). The measured force is dominated by "
            f"inertia, {s['contact.peak_inertial_N']:.0f} N at its peak, and {threshold} on it "
            f"separates contact from free motion. The calculated contact force rises to "
            f"{s['contact.peak_contact_N']:.0f} N and crosses the threshold {lag:.1f} ms after "
            f"the touch; at the reversal without contact, at about 600 ms, it {alarm}."
        ),
    }


def parameter_rows(
    true: ArrayLike, estimate: ArrayLike, deviation: ArrayLike
) -> list[ParameterRow]:
    """Return table rows of [offsets; phi] (16,) [SI]: true values, estimates, deviations."""
    columns = np.stack([np.asarray(column, float) for column in (true, estimate, deviation)], 1)
    rows = []
    for (symbol, index, unit, scale), values in zip(PARAMETER_FORMATS, columns, strict=True):
        truth, found, sigma = scale * values
        # Two digits of the uncertainty determine the decimals of the value.
        decimals = 3 if sigma <= 0 else int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9))
        true_text, found_text, sigma_text = (f"{x:.{decimals}f}" for x in (truth, found, sigma))
        error = f"{found - truth:+.{decimals}f}"
        rows.append(ParameterRow(symbol, index, true_text, found_text, error, sigma_text, unit))
    return rows


def write_report(
    out: Path,
    pictures: Mapping[str, Figure],
    *,
    setup: Mapping[str, str],
    summary: Mapping[str, Any],
    parameters: Sequence[ParameterRow],
) -> None:
    """Write the figures (fig6 to fig8), and report.html with them and the given results."""
    names = ("drake_teleop", "drake", "numpy", "scipy", "numba")
    versions = {"Python": platform.python_version()} | {n: metadata.version(n) for n in names}
    write_report_page_and_pictures(
        out,
        "drake_teleop.lab.reproduction",
        pictures,
        setup=dict(setup),
        versions=versions,
        tiles=_summary_tiles(summary),
        comparisons=compare_with_paper(summary),
        titles=_FIGURE_TITLES,
        captions=figure_captions(summary),
        parameters=parameters,
        summary=summary,
    )


def _summary_tiles(s: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    lag = 1e3 * (s["contact.detected_s"] - s["contact.true_s"])
    left = f"{s['free_force.residual_max_N']:.2f} N, {s['free_torque.residual_max_Nm']:.2f}"
    return [
        (f"{s['free_force.peak_raw_N']:.0f}", "N", "on the sensor from moving the tool alone"),
        (left, "N m", "largest residual force and torque after elimination"),
        (f"{lag:.1f}", "ms", "from the touch to its detection"),
        (f"{s['identification.mass_error_percent']:.3f}", "%", "error of the identified mass"),
    ]


def _compare_range(
    origin: str, what: str, paper: str, value: float, unit: str, low: float, high: float
) -> Comparison:
    bounds = f"at most {high:.3g} {unit}" if low == 0 else f"{low:.3g} to {high:.3g} {unit}"
    holds = bool(low <= value <= high)
    return Comparison(what, paper, _format_value(value, unit), origin, bounds.strip(), holds)


def _compare_yes_no(what: str, paper: str, value: bool, expected: bool) -> Comparison:
    words, holds = {True: "yes", False: "no"}, bool(value) == expected
    return Comparison(what, paper, words[bool(value)], "found", words[expected], holds)


def _row_without_verdict(origin: str, what: str, paper: str, value: float, unit: str) -> Comparison:
    return Comparison(what, paper, _format_value(value, unit), origin, "", None)


def _format_value(value: float, unit: str) -> str:
    number = f"{value:.1e}" if 0 < abs(value) < 1e-3 else f"{value:#.3g}".rstrip(".")
    return f"{number} {unit}".strip()


def scaling_figure(run: experiments.MotionRun, component: int, symbol: str, unit: str) -> Figure:
    """Draw Fig. 6 or 7: a wrench component for each sigma, at the slave (left) and master (right).

    `symbol` is the component in Matplotlib's math text.
    """
    time, time_unit = _scale_time_to_ms_or_s(run.result.t)
    traces = [wrench[:, component] for wrench in run.scaled_wrenches.values()]
    scale = run.scenario.force_scaling.force_scale
    at_master_and_back = (lambda v: np.asarray(v) * scale, lambda v: np.asarray(v) / scale)
    meanings = {1.0: "as measured", 0.0: "non-contact part eliminated"}
    with plot_style():
        figure = Picture(figsize=(7.6, 1.2 + 1.75 * len(traces)))
        rows = figure.subplots(len(traces), 1, sharex=True, sharey=True)
        for axes, trace, sigma in zip(rows, traces, run.scaled_wrenches, strict=True):
            axes.plot(time, trace, color=BLUE if sigma else GREEN)
            meaning = meanings.get(sigma, f"{sigma:.0%} of the non-contact part")
            axes.set(title=f"σ = {sigma:g}:  {meaning}", ylabel=f"{symbol} [{unit}]")
            peak = float(np.abs(trace).max())
            slave, master = _format_number(peak), _format_number(scale * peak)
            note = f"peak {slave} {unit}   ·   {master} {unit} at the master"
            _write_note_above_axes(axes, note)
            right = axes.secondary_yaxis("right", functions=at_master_and_back)
            right.set_ylabel(f"at the master [{unit}]", color=GREY)
            right.spines["right"].set_visible(True)
        rows[0].set(ylim=_common_y_limits(traces), xlim=(time[0], time[-1]))
        rows[-1].set_xlabel(f"t [{time_unit}]")
    return figure


def contact_figure(run: experiments.RunsWithAndWithoutContact, detected_s: float | None) -> Figure:
    """Draw Fig. 8: measured force and calculated contact force [N], with shaded contact."""
    time, time_unit = _scale_time_to_ms_or_s(run.touched.result.t)
    per_second = 1e3 if time_unit == "ms" else 1.0
    traces = [run.touched.scaled_wrenches[sigma][:, FORCE_Z_INDEX] for sigma in (1.0, 0.0)]
    touched, turning_s = run.in_contact, experiments.time_of_largest_raw_force_after_contact(run)
    with plot_style():
        figure = Picture(figsize=(7.6, 5.0))
        rows = figure.subplots(2, 1, sharex=True, sharey=True)
        titles = ("Measured force", "Calculated contact force, σ = 0")
        colours = (BLUE, GREEN)
        for axes, trace, title, colour in zip(rows, traces, titles, colours, strict=True):
            shade_contact(axes, time, touched)
            axes.plot(time, trace, color=colour)
            axes.set(title=title, ylabel="$f_z$ [N]")
            if turning_s is not None:
                _draw_time_mark(axes, turning_s * per_second, "no contact", GREY)
        if touched.any():
            _draw_time_mark(rows[0], time[np.argmax(touched)], "contact", VERMILION)
        if detected_s is not None:
            _draw_time_mark(rows[1], detected_s * per_second, "detected", VERMILION)
        for level in (-run.threshold_N, run.threshold_N):
            rows[1].axhline(level, color=VERMILION, linewidth=0.8, linestyle=":")
        peak, contact_peak = (f"peak {_format_number(np.abs(trace).max())} N" for trace in traces)
        _write_note_above_axes(rows[0], peak)
        threshold = _format_number(run.threshold_N)
        _write_note_above_axes(rows[1], f"{contact_peak}   ·   threshold {threshold} N")
        rows[0].set(ylim=_common_y_limits(traces), xlim=(time[0], time[-1]))
        rows[1].set_xlabel(f"t [{time_unit}]")
    return figure


def _scale_time_to_ms_or_s(t: Array) -> tuple[Array, str]:
    return (t * 1e3, "ms") if t[-1] - t[0] <= 2 else (t, "s")


def _common_y_limits(traces: Sequence[Array]) -> tuple[float, float]:
    low, high = min(0.0, float(np.min(traces))), max(0.0, float(np.max(traces)))
    margin = 0.1 * (high - low) or 1.0
    return low - margin, high + margin


def _format_number(value: float) -> str:
    rounded = float(f"{value:.3g}")
    decimals = max(0, 2 - int(np.floor(np.log10(abs(rounded))))) if rounded else 0
    return f"{rounded:.{decimals}f}"


def _write_note_above_axes(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="right", color=GREY, fontsize=8.5)


def _draw_time_mark(axes: Axes, time: float, text: str, colour: str) -> None:
    axes.axvline(time, color=colour, linewidth=0.9, linestyle="--")
    axes.annotate(
        text, (time, 0.03), xycoords=("data", "axes fraction"), xytext=(4, 0),
        textcoords="offset points", color=colour, fontsize=8.5,
    )  # fmt: skip
