"""What `calibrate` shows: a table that settles, and at the end a picture of how it did."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from rich.console import Group
from rich.table import Table
from rich.text import Text

from drake_teleop.load.tolerance import (
    QUANTITIES,
    UNITS,
    Tolerance,
    sizes_of,
    values_of,
)
from drake_teleop.pages.style import BLACK, COLOURS, GREY, Picture, house_style
from drake_teleop.robots.calibration import Look

_BAR, _DECADES = 24, 3.0  # cells, and decades of the half-width over the tolerance


def shown(at: Look, tolerance: Tolerance) -> Group:
    """The table of a look, and what to do next."""
    table = Table(title=f"{at.t:.1f} s recorded", title_justify="left")
    table.add_column("")
    for heading in ("value", "+- (95 %)", "asked", "unit"):
        table.add_column(heading, justify="left" if heading == "unit" else "right")
    table.add_column("settled", width=_BAR)
    table.add_column("verdict")
    units = [UNITS[name] for name in QUANTITIES for entry in tolerance.entries if name in entry]
    values = sizes = np.full(len(units), np.nan)
    if at.found is not None:
        phi = at.found.identification.phi
        values, sizes = values_of(tolerance, phi), sizes_of(tolerance, phi)
    for k, entry in enumerate(tolerance.entries):
        half = at.half[k]
        numbers = [f"{x:.4g}" if np.isfinite(x) else "?" for x in (values[k], half * sizes[k])]
        table.add_row(
            *(entry, *numbers, f"{sizes[k]:.3g}" if np.isfinite(sizes[k]) else "?", units[k]),
            *(_bar(half, bool(at.known[k])), _verdict(at, k)),
        )
    lines = [Text(line, style="red") for line in (*at.doubts, *([at.why] if at.why else []))]
    if at.advice:
        lines.append(Text(f"-> {at.advice}", style="bold"))
    return Group(table, *lines)


def _bar(half: float, known: bool) -> Text:
    """Full at the tolerance, empty `_DECADES` above it."""
    share = 1.0 - np.log10(max(half, 1.0)) / _DECADES if np.isfinite(half) else 0.0
    cells = int(np.clip(share, 0.0, 1.0) * _BAR)
    return Text("█" * cells + "·" * (_BAR - cells), style="green" if known else "yellow")


def _verdict(at: Look, k: int) -> str:
    if at.known[k]:
        return "known"
    if not np.isfinite(at.half[k]):
        return "not known: nothing tells it yet"
    if at.doubts:
        return "not known: see below"
    return "almost" if at.half[k] <= 1.0 else "not known"


def draw_settling(looks: list[Look], tolerance: Tolerance) -> Figure:
    """Half-widths of the 95 % intervals over the tolerances, and the advice under them."""
    with house_style():
        figure = Picture(figsize=(9, 5.5))
        axes = figure.subplots()
        t = np.array([at.t for at in looks])
        halves = np.array([at.half for at in looks])
        for k, entry in enumerate(tolerance.entries):
            style = ("-", "--")[k // len(COLOURS) % 2]
            finite = np.isfinite(halves[:, k])
            colour = COLOURS[k % len(COLOURS)]
            axes.plot(t[finite], halves[finite, k], style, marker=".", color=colour, label=entry)
        axes.axhline(1.0, color=BLACK, linestyle=":")
        last = ""
        for at in looks:
            if at.advice and at.advice != last:
                axes.axvline(at.t, color=GREY, linewidth=0.6)
                words = at.advice.split(",")[0].split(":")[0].replace(" the wrist", "")
                axes.text(
                    at.t, 0.02, words, rotation=90, size=7, transform=axes.get_xaxis_transform()
                )
                last = at.advice
        axes.set(
            title="Half of the 95 % interval over what is asked",
            xlabel="length of the record [s]",
            yscale="log",
        )
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
