"""Pictures of a log: measured wrench, explained part and residual."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from drake_teleop.common.files import replace_file_on_success
from drake_teleop.common.numeric import Array
from drake_teleop.common.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    VERMILION,
    Picture,
    plot_style,
    shade_contact,
)
from drake_teleop.load.batch.uncertainty import confidence_intervals
from drake_teleop.load.contact.noise_floor import STATISTIC_NAMES
from drake_teleop.load.identification import VERDICT_NAMES, Identification, natural_scales
from drake_teleop.logs.processing import DetectedLog, EliminatedLog, IdentifiedLog
from drake_teleop.logs.read.canonical import Log

_CHANNEL_SYMBOLS = ("$f_x$", "$f_y$", "$f_z$", r"$\tau_x$", r"$\tau_y$", r"$\tau_z$")
_PARAMETER_SYMBOLS = (
    *(rf"$f_{{o{a}}}$" for a in "xyz"),
    *(rf"$\tau_{{o{a}}}$" for a in "xyz"),
    *("$m$", "$m c_x$", "$m c_y$", "$m c_z$"),
    *(f"$I_{{{axes}}}$" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")),
)
VERDICT_COLOURS = dict(zip(VERDICT_NAMES, (GREEN, ORANGE, VERMILION, PURPLE), strict=True))
_VERDICT_TEXTS = ("identified", "weakly identified", "not identified", "mostly from the prior")
TEXT_OF_VERDICT = dict(zip(VERDICT_NAMES, _VERDICT_TEXTS, strict=True))
_MAX_CURVE_POINTS, _MAX_WELCH_WINDOW_SAMPLES = 4000, 2**14
# Lighter than the grey of the style, because it is under all other curves.
_MEASURED_CURVE_COLOUR = "#A3AAB5"
_Curves = list[tuple[str, Array, str]]  # name, values and colour


def draw_fit(found: IdentifiedLog) -> Figure:
    """Draw measured wrench, load's wrench and residual without offsets; shade rejected samples."""
    log, result = found.log, found.identification
    curves = [
        ("measured, offsets removed", log.wrench - result.offsets, _MEASURED_CURVE_COLOUR),
        (r"$V\,\varphi$", found.predicted - result.offsets, BLUE),
        ("residual", log.wrench - found.predicted, VERMILION),
    ]
    rms = zip(_CHANNEL_SYMBOLS, result.residual_rms, ["N"] * 3 + ["N m"] * 3, strict=True)
    titles = [f"{symbol}: residual {x:.3g} {unit} rms" for symbol, x, unit in rms]
    com = ", ".join(f"{1e3 * c:.2f}" for c in result.com)
    title = f"{result.mass:.4f} kg, centre of mass ({com}) mm"
    with plot_style():
        figure = Picture(figsize=(10, 7))
        _draw_channels(figure, log.t, curves, titles, found.rejected & (not log.static), log.static)
        _add_legend_and_title(figure, title, log, result.delay_s)
    return figure


def draw_spectrum_and_intervals(found: IdentifiedLog) -> Figure:
    """Draw the residual's spectrum, and intervals and identifiability of parameters."""
    with plot_style():
        figure: Any = Picture(figsize=(10, 7.4))
        log, result = found.log, found.identification
        residual = log.wrench - found.predicted
        if log.static:
            rate, shown = 1.0 + np.arange(len(log)), residual
        else:
            rate, shown = amplitude_spectral_densities(residual, log.dt)
        spectra, known = figure.subfigures(2, 1, height_ratios=[1, 1.5])
        left, right = spectra.subplots(1, 2)
        for axis, columns, unit in ((left, slice(0, 3), "N"), (right, slice(3, 6), "N m")):
            axis.set_prop_cycle(color=(BLUE, VERMILION, GREEN))
            if log.static:
                axis.plot(rate, shown[:, columns], "o", label=_CHANNEL_SYMBOLS[columns])
                axis.set(xlabel="pose", ylabel=f"residual [{unit}]", title="Residual of each pose")
            else:
                axis.loglog(rate, shown[:, columns], label=_CHANNEL_SYMBOLS[columns])
                axis.set(xlabel="frequency [Hz]", ylabel=f"[{unit}/√Hz]", title="Residual spectrum")
                # Frequencies above the cut-off do not show sensor noise.
                top = axis.get_ylim()[1]
                axis.set_ylim(bottom=max(axis.get_ylim()[0], 1e-6 * top), top=top)
            axis.legend(ncols=3)
        _draw_parameter_intervals(known, result)
    return figure


def stack_pictures(upper: Path, lower: Path, page: Path) -> None:
    """Write two PNG files of equal width, one above the other, to the PNG file `page`."""
    from matplotlib.image import imread, imsave

    with replace_file_on_success(page) as unfinished:
        imsave(unfinished, np.concatenate([imread(upper), imread(lower)]), format="png")


def amplitude_spectral_densities(x: Array, dt: float) -> tuple[Array, Array]:
    """Return frequencies (m,) > 0 [Hz] and one-sided densities (m, k) [x/sqrt(Hz)] of x (N, k)."""
    from scipy.signal import welch

    length = min(len(x), max(16, len(x) // 8), _MAX_WELCH_WINDOW_SAMPLES)
    rates, power = welch(x, 1.0 / dt, nperseg=length, axis=0)
    return rates[1:], np.sqrt(power[1:])


def _draw_parameter_intervals(figure: Any, result: Identification) -> None:
    natural = natural_scales(result.phi)
    theta = np.concatenate([result.offsets, result.phi]) / natural
    low, high = (end / natural for end in confidence_intervals(result))
    deviations = result.standard_deviations / natural
    rows = np.arange(16)
    colours = [VERDICT_COLOURS[verdict] for verdict in result.verdicts]
    left, right = figure.subplots(1, 2, sharey=True)
    left.set_yticks(rows, _PARAMETER_SYMBOLS)
    left.invert_yaxis()
    shown = np.abs(theta[np.isfinite(deviations) & result.identifiable])
    limit = 1.25 * max(1.0, float(shown.max()) if len(shown) else 1.0)
    ends = np.clip(low, -2 * limit, 2 * limit), np.clip(high, -2 * limit, 2 * limit)
    left.hlines(rows, *ends, colors=colours, linewidth=5, alpha=0.35)
    # Arrows point to estimates outside of the picture.
    for row, (value, colour) in enumerate(zip(theta, colours, strict=True)):
        marker = "o" if abs(value) < limit else ">" if value > 0 else "<"
        left.plot(np.clip(value, -0.97 * limit, 0.97 * limit), row, marker, color=colour, ms=4.5)
    left.set(xlim=(-limit, limit), title="95 % intervals / typical parameter value")
    left.axvline(0, color=GREY, linewidth=0.8)
    floor = 1e-5
    widths = np.clip(np.where(np.isfinite(deviations), deviations, 10.0), floor, 10.0)
    right.set_xscale("log")
    right.barh(rows, widths - floor / 2, left=floor / 2, color=colours, height=0.7)
    right.set_xlim(floor / 2, 10.0)
    for share, words in ((0.05, "5 %"), (0.5, "50 %")):
        right.axvline(share, color=BLACK, linewidth=0.8, linestyle="--")
        right.text(share, -0.9, words, fontsize=8, ha="center", va="bottom")
    right.set_title("Standard deviation / typical parameter value", pad=16)
    handles = [
        Patch(color=VERDICT_COLOURS[verdict], label=TEXT_OF_VERDICT[verdict])
        for verdict in VERDICT_NAMES
        if verdict in result.verdicts
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def draw_elimination(found: EliminatedLog) -> Figure:
    """Draw |F| and channels of measured, contact and scaled wrench; shade contacts."""
    curves = [("measured, offsets removed", found.measured, _MEASURED_CURVE_COLOUR)]
    curves += _curve_without_static_weight(found)
    if found.causal is not None:
        curves.append((f"contact, causal ({found.causal.mode})", found.causal.contact, PURPLE))
    curves.append(("contact wrench", found.contact, BLUE))
    if not np.array_equal(found.scaled, found.contact):
        curves.append(("scaled wrench", found.scaled, GREEN))
    inner = ~found.edge
    curves = [(name, wrench[inner], colour) for name, wrench, colour in curves]
    t, touched, static = found.log.t[inner], found.touched[inner], found.log.static
    with plot_style():
        figure = Picture(figsize=(10, 9))
        top, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[1, 2.6])[:, 0]
        magnitude = top.subplots()
        norms = [(n, np.linalg.norm(w[:, :3], axis=1), c) for n, w, c in curves]
        _draw_curves(magnitude, t, norms, static)
        magnitude.set_ylim(bottom=0)
        torques = [(n, np.linalg.norm(w[:, 3:], axis=1), c) for n, w, c in curves]
        title = f"$|F|$, rms in N: {_rms_text(norms)}\n$|\\tau|$, rms in N m: {_rms_text(torques)}"
        magnitude.set_title(title, fontsize=8.5)
        magnitude.set_ylabel("force [N]")
        shade_contact(magnitude, t, touched)
        _draw_channels(below, t, curves, _CHANNEL_SYMBOLS, touched, static)
        _add_legend_and_title(figure, Path(found.log.source).name, found.log, found.delay_s)
    return figure


def _curve_without_static_weight(found: EliminatedLog) -> _Curves:
    weightless = found.gravity_only
    return [] if weightless is None else [("static weight removed", weightless, ORANGE)]


def draw_detection(found: DetectedLog) -> Any:
    """Draw |F| before and after removal of the load, and the statistic with its threshold."""
    eliminated = found.eliminated
    inner = ~eliminated.edge
    t = eliminated.log.t[inner]
    with plot_style():
        figure = Picture(figsize=(10, 6))
        top, below = figure.subplots(2, 1, sharex=True)
        raw = eliminated.measured - eliminated.measured[0]
        for name, wrench, colour in (
            ("measured, tared at the start", raw, _MEASURED_CURVE_COLOUR),
            *_curve_without_static_weight(eliminated),
            ("contact", eliminated.contact, BLUE),
        ):
            top.plot(t, np.linalg.norm(wrench[inner, :3], axis=1), color=colour, label=name)
        top.axhline(found.force_threshold, color=BLACK, linewidth=0.8, linestyle=":")
        top.set_yscale("symlog", linthresh=1.0)
        top.set_ylim(bottom=0.0)
        top.set(ylabel="$|F|$ [N]", title="dotted: 1.25 x largest contact |F| in free motion")
        below.plot(t, found.statistics[inner, STATISTIC_NAMES.index(found.statistic)], color=BLUE)
        below.axhline(found.threshold, color=BLACK, linewidth=0.8, linestyle="--")
        below.set(xlabel="time [s]", ylabel=f"{found.statistic} [standard deviations]")
        share = 100 * found.is_above_threshold.mean()
        below.set_title(f"statistic above its threshold {share:.2g} % of the time")
        for axis in (top, below):
            shade_contact(axis, t, found.touched[inner])
        figure.legend(loc="outside lower center", ncols=3)
        figure.suptitle(Path(eliminated.log.source).name, x=0.01, ha="left", fontsize=11)
    return figure


def _rms_text(norms: _Curves) -> str:
    return ", ".join(f"{name} {np.sqrt(np.mean(values**2)):.3g}" for name, values, _ in norms)


def _draw_channels(
    figure: Any, t: Array, curves: _Curves, titles: Sequence[str], shaded: Any, static: bool
) -> None:
    grid = figure.subplots(3, 2, sharex=True, sharey="col")
    grid[1, 0].set_ylabel("force [N]")
    grid[1, 1].set_ylabel("torque [N m]")
    for i, (axis, title) in enumerate(zip(grid.T.ravel(), titles, strict=True)):
        _draw_curves(axis, t, [(n, w[:, i], c) for n, w, c in curves], static)
        axis.set_title(title)
        shade_contact(axis, t, shaded)
    for bottom in grid[2]:
        bottom.set_xlabel("pose" if static else "time [s]")


def _draw_curves(axes: Axes, t: Array, curves: _Curves, static: bool) -> None:
    # More points than pixels only make the drawing slow.
    every = max(1, len(t) // _MAX_CURVE_POINTS)
    for order, (name, values, colour) in enumerate(curves):
        if static:
            size = 7.0 if order == 0 else 3.0
            axes.plot(t + 1, values, "os^Dv"[order], markersize=size, color=colour, label=name)
        else:
            width = 2.2 if order == 0 else 1.1
            axes.plot(t[::every], values[::every], color=colour, linewidth=width, label=name)


def _add_legend_and_title(figure: Any, title: str, log: Log, delay_s: float) -> None:
    if not log.static:
        title += f", motion {1e3 * delay_s:.1f} ms behind the wrench"
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
