"""Pictures of a log: what was measured, what the load explains of it, and what is left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_teleop.logs.canonical import Log
from drake_teleop.logs.processing import EliminatedLog, IdentifiedLog
from drake_teleop.style import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    VERMILION,
    Picture,
    house_style,
    shade_contact,
)

_CHANNELS = ("$f_x$", "$f_y$", "$f_z$", r"$\tau_x$", r"$\tau_y$", r"$\tau_z$")
_POINTS = 4000
# Lighter than the house's grey: it lies under all the other curves.
_MEASURED = "#A3AAB5"


def draw_fit(found: IdentifiedLog) -> Figure:
    """Six channels: measured, offsets + V phi, and the residual, from which the offsets are gone.

    The three forces share one scale, and so do the three torques.
    """
    log, result = found.log, found.identification
    curves = [
        ("measured, offsets removed", log.wrench - result.offsets, _MEASURED),
        (r"$V\,\varphi$", found.predicted - result.offsets, BLUE),
        ("residual", log.wrench - found.predicted, VERMILION),
    ]
    rms = np.asarray(result.residual_rms)
    com = ", ".join(f"{1e3 * c:.2f}" for c in result.com)
    title = f"{result.mass:.4f} kg, centre of mass ({com}) mm"
    with house_style():
        figure = Picture(figsize=(10, 7))
        axes = _channel_axes(figure)
        for i, axis in enumerate(axes):
            _draw(axis, log.t, [(n, w[:, i], c) for n, w, c in curves], log.static)
            unit = "N" if i < 3 else "N m"
            axis.set_title(f"{_CHANNELS[i]}: residual {rms[i]:.3g} {unit} rms")
        _finish(figure, axes, title, log, result.delay_s)
    return figure


def draw_elimination(found: EliminatedLog) -> Figure:
    """|F| on top, then six channels: measured, static weight removed, contact wrench.

    The three forces share one scale, and so do the three torques. The scaled wrench is drawn if it
    differs from the contact wrench, the causal contact wrench if there is one; contacts are shaded.
    """
    curves = [("measured, offsets removed", found.measured, _MEASURED)]
    if found.gravity_only is not None:
        curves.append(("static weight removed", found.gravity_only, ORANGE))
    curves.append(("contact wrench", found.contact, BLUE))
    if not np.array_equal(found.scaled, found.contact):
        curves.append(("scaled wrench", found.scaled, GREEN))
    if found.causal is not None:
        curves.append(
            (f"contact wrench, causal, {found.causal.mode}", found.causal.contact, PURPLE)
        )
    t, static = found.log.t, found.log.static
    with house_style():
        figure = Picture(figsize=(10, 9))
        top, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[1, 2.6])[:, 0]
        magnitude = top.subplots()
        norms = [(n, np.linalg.norm(w[:, :3], axis=1), c) for n, w, c in curves]
        _draw(magnitude, t, norms, static)
        magnitude.set_ylim(bottom=0)
        magnitude.set_title("$|F|$, rms: " + ", ".join(_rms_words(norms)))
        magnitude.set_ylabel("force [N]")
        shade_contact(magnitude, t, found.touched)
        axes = _channel_axes(below)
        for i, axis in enumerate(axes):
            _draw(axis, t, [(n, w[:, i], c) for n, w, c in curves], static)
            axis.set_title(_CHANNELS[i])
            shade_contact(axis, t, found.touched)
        _finish(figure, axes, Path(found.log.source).name, found.log, found.delay_s)
    return figure


def _rms_words(norms: Sequence[tuple[str, NDArray[np.float64], str]]) -> list[str]:
    return [f"{name} {np.sqrt(np.mean(values**2)):.3g} N" for name, values, _ in norms]


def _channel_axes(figure: Any) -> list[Axes]:
    """Forces left, torques right, x y z downwards; a scale for each column."""
    grid = figure.subplots(3, 2, sharex=True, sharey="col")
    grid[1, 0].set_ylabel("force [N]")
    grid[1, 1].set_ylabel("torque [N m]")
    return list(grid.T.ravel())


def _draw(
    axes: Axes,
    t: NDArray[np.float64],
    curves: Sequence[tuple[str, NDArray[np.float64], str]],
    static: bool,
) -> None:
    # More points than pixels only make the file and the drawing slow.
    every = max(1, len(t) // _POINTS)
    for order, (name, values, colour) in enumerate(curves):
        if static:
            size = 7.0 if order == 0 else 3.0
            axes.plot(t + 1, values, "os^Dv"[order], markersize=size, color=colour, label=name)
        else:
            width = 2.2 if order == 0 else 1.1
            axes.plot(t[::every], values[::every], color=colour, linewidth=width, label=name)


def _finish(figure: Figure, axes: Sequence[Axes], title: str, log: Log, delay_s: float) -> None:
    for bottom in (axes[2], axes[5]):
        bottom.set_xlabel("pose" if log.static else "time [s]")
    if not log.static:
        title += f", motion {1e3 * delay_s:.1f} ms behind the wrench"
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
