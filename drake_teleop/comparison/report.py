"""The report of `drake-teleop compare-passivity`: one page with tables and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_teleop.channel.network import PRESETS
from drake_teleop.pages.html import embedded, render
from drake_teleop.pages.style import COLOURS, GREY, Picture, house_style
from drake_teleop.writing import write_picture, write_text

#: Columns of the station's table: key of the row, heading, factor, decimals.
COLUMNS = (
    ("hunting", "Hunting [mm]", 1e3, 2),
    ("turning", "Turning [deg]", 180 / np.pi, 2),
    ("felt_force", "Felt [N]", 1.0, 2),
    ("chatter", "Chatter [N]", 1.0, 2),
    ("force_error", "Force error [%]", 1e2, 1),
    ("drift", "Drift [mm]", 1e3, 2),
    ("free_force", "Free force [N]", 1.0, 2),
    ("rise_delay", "Rise delay [ms]", 1e3, 0),
    ("least_energy", "Least energy [J]", 1.0, 3),
)

# What fits on a terminal of 80 columns, first of all what the verdict is from; the page has all.
_TERMINAL = ("hunting", "turning", "felt_force", "force_error", "free_force", "rise_delay")

Traces = Mapping[tuple[str, str], Mapping[str, NDArray[np.float64]]]


def write_report(summary: Mapping[str, Any], traces: Traces, out: Path) -> None:
    """Writes report.html, runs.png, energy.png and limits.png into `out`."""
    pictures = {
        "runs": draw_runs(summary, traces),
        "energy": draw_energy(summary, traces),
        "limits": draw_limits(summary["one_dof"]),
    }
    for name, figure in pictures.items():
        write_picture(out / f"{name}.png", figure)
    page = render(
        "drake_teleop.comparison",
        "report.html.j2",
        networks=[(name, 2e3 * PRESETS[name].delay) for name in summary["networks"]],
        columns=[heading for _, heading, _, _ in COLUMNS],
        station=[(row, cells(row)) for row in summary["station"]],
        covering=summary["covering"],
        pictures={name: embedded(figure) for name, figure in pictures.items()},
    )
    write_text(out / "report.html", page)


def cells(row: Mapping[str, Any]) -> list[str]:
    """The figures of one run of the station, as printed; a run that ended early has none."""
    return [
        # Adding 0 to what is rounded takes the sign from -0.
        "–" if row[key] is None else f"{round(factor * row[key], decimals) + 0.0:.{decimals}f}"
        for key, _, factor, decimals in COLUMNS
    ]


def draw_runs(summary: Mapping[str, Any], traces: Traces) -> Figure:
    """What the hand feels over time: a row for each method, a column for each network."""

    def draw(axes: Any, shown: Mapping[str, NDArray[np.float64]]) -> None:
        axes.plot(shown["t"], shown["pressed"], color=GREY, linewidth=0.8)
        axes.plot(shown["t"], shown["felt"], color=COLOURS[0], linewidth=0.9)

    figure = _grid(summary, traces, draw, "force [N]")
    figure.suptitle("Felt force (blue) and scaled contact force (grey)", x=0.01, ha="left")
    return figure


def draw_energy(summary: Mapping[str, Any], traces: Traces) -> Figure:
    """The energy that both ends have put into the channel, over time: negative is active."""

    def draw(axes: Any, shown: Mapping[str, NDArray[np.float64]]) -> None:
        axes.axhline(0.0, color=GREY, linewidth=0.6)
        axes.plot(shown["t"], shown["energy"], color=COLOURS[2], linewidth=1.0)

    figure = _grid(summary, traces, draw, "energy [J]")
    figure.suptitle(
        "Energy put into the channel by hand and slave: below 0 it gave out more than it got",
        x=0.01,
        ha="left",
    )
    return figure


def _grid(summary: Mapping[str, Any], traces: Traces, draw: Any, unit: str) -> Figure:
    methods, networks = summary["methods"], summary["networks"]
    with house_style():
        figure = Picture(figsize=(max(3.0 * len(networks), 7.5), 1.5 * len(methods) + 0.8))
        grid = figure.subplots(len(methods), len(networks), squeeze=False, sharex="col")
        for i, method in enumerate(methods):
            for j, network in enumerate(networks):
                axes, shown = grid[i, j], traces.get((network, method))
                if i == 0:
                    axes.set_title(f"{network}, RTT {2e3 * PRESETS[network].delay:g} ms")
                if j == 0:
                    axes.set_ylabel(f"{method}\n{unit}", fontsize=8)
                if shown is None:
                    axes.text(0.5, 0.5, "ended early", transform=axes.transAxes, ha="center")
                else:
                    draw(axes, shown)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
    return figure


def draw_limits(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The longest stable round trip of each method: a panel for each wall."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    walls = sorted({row["wall_N_per_m"] for row in rows})
    with house_style():
        figure = Picture(figsize=(3.6 * len(walls), 0.36 * len(methods) + 1.3))
        for axes, wall in zip(
            figure.subplots(1, len(walls), squeeze=False, sharey=True)[0], walls, strict=True
        ):
            for place, method in enumerate(methods):
                found = [
                    1e3 * row["longest_s"]
                    for row in rows
                    if row["method"] == method and row["wall_N_per_m"] == wall
                ]
                shortest, longest = max(min(found), 1.0), max(max(found), 1.0)
                axes.plot([1.0, shortest], [place, place], color=COLOURS[0], linewidth=5)
                axes.plot([shortest, longest], [place, place], color=COLOURS[5], linewidth=2)
            axes.set_xscale("log")
            axes.set_xlim(1.0, 1e3 * max(rows[0]["grid_s"]))
            axes.set_yticks(range(len(methods)), methods)
            axes.invert_yaxis()
            axes.set_title(f"wall of {wall / 1e3:g} kN/m")
            axes.set_xlabel("longest stable round trip [ms]")
    return figure


def print_tables(summary: Mapping[str, Any], out: Path) -> None:
    """The tables on the terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    for network in summary["networks"]:
        for leaf in dict.fromkeys(row["leaf"] for row in summary["station"]):
            table = Table(
                title=f"{network}, RTT {2e3 * PRESETS[network].delay:g} ms: {leaf}",
                title_justify="left",
                box=SIMPLE_HEAD,
            )
            table.add_column("Method", no_wrap=True)
            table.add_column("Stable", justify="right")
            for key, heading, _, _ in COLUMNS:
                if key in _TERMINAL:
                    word = max(map(len, heading.split()))
                    table.add_column(Text(heading), justify="right", min_width=word)
            for row in summary["station"]:
                if (row["network"], row["leaf"]) == (network, leaf):
                    verdict = "[green]yes" if row["stable"] else "[red]no"
                    named = zip(COLUMNS, cells(row), strict=True)
                    shown = [cell for (key, *_), cell in named if key in _TERMINAL]
                    table.add_row(row["method"], verdict, *shown)
            console.print(table)
    console.print(f"written to {out}; open {out / 'report.html'}", highlight=False, markup=False)
