"""Report of `drake-teleop compare-passivity`: verdicts (docs/delay.md), tables, pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from drake_teleop.common.html import write_report_page_and_pictures
from drake_teleop.common.numeric import Array
from drake_teleop.common.style import BLACK, COLOURS, GREY, Picture, plot_style
from drake_teleop.lab.comparison.one_dof import TAP_RATES_HZ, WRIST_TO_TIP_DISTANCE_M
from drake_teleop.station.channel.network import PRESETS
from drake_teleop.station.oscillation import MAX_FORCE_RIPPLE_RMS_AT_REST_N

VERDICT_UNSTABLE, VERDICT_POSITION_ERROR = "unstable", "position error"
VERDICT_CHATTERS, VERDICT_LEAKS, VERDICT_HOLDS = "chatters", "leaks", "holds"
MAX_POSITION_ERROR_M, MIN_LEAKED_ENERGY_J = 5e-3, 1e-3  #: m; J

#: Columns of the station's table: key of the row, heading, factor, decimals.
RUN_COLUMNS = (
    ("hunting", "Oscillation [mm]", 1e3, 2),
    ("turning", "Rotation [deg]", 180 / np.pi, 2),
    ("felt_force", "Rendered [N]", 1.0, 2),
    ("felt_share", "Rendered share [%]", 1e2, 1),
    ("chatter", "Chatter [N]", 1.0, 2),
    ("fast_force", "Above 5 Hz [N]", 1.0, 3),
    ("left_behind", "Position error [mm]", 1e3, 2),
    ("free_force", "Free force [N]", 1.0, 2),
    ("rise_delay", "Rise delay [ms]", 1e3, 0),
    ("leaked", "Leaked [mJ]", 1e3, 1),
)

#: Verdict -> mark, colour of the cell, colour of the text. The cells also differ in lightness.
VERDICT_STYLES = {
    VERDICT_HOLDS: ("✓", "#CBE4F4", BLACK),
    VERDICT_LEAKS: ("⚠", "#FBEBB8", BLACK),
    VERDICT_CHATTERS: ("≈", "#F7D39B", BLACK),
    VERDICT_POSITION_ERROR: ("↷", "#F0B878", BLACK),
    VERDICT_UNSTABLE: ("✗", "#565C66", "white"),
}
_NETWORK_MARKERS = "os^Dv"  # marks of the networks

Traces = Mapping[tuple[str, str], Mapping[str, Array]]


def write_report(summary: Mapping[str, Any], traces: Traces, out: Path) -> None:
    pictures = {
        "decision": draw_decision_table(summary),
        "hands": draw_release_and_taps(summary),
        "runs": draw_force_traces(summary, traces),
        "energy": draw_energy_traces(summary, traces),
        "limits": draw_round_trip_limits(summary["one_dof"]),
    }
    write_report_page_and_pictures(
        out,
        "drake_teleop.lab.comparison",
        pictures,
        networks=[(name, 2e3 * PRESETS[name].delay) for name in summary["networks"]],
        columns=[heading for _, heading, _, _ in RUN_COLUMNS],
        station=[(row, cells_of_run(row)) for row in summary["station"]],
        covering=summary["covering"],
    )


def cells_of_run(row: Mapping[str, Any]) -> list[str]:
    return [
        # Adding 0 removes the sign of -0.
        "–" if row[key] is None else f"{round(factor * row[key], decimals) + 0.0:.{decimals}f}"
        for key, _, factor, decimals in RUN_COLUMNS
    ]


@dataclass(frozen=True)
class MethodResult:
    """Verdict and figures of one passivity method over one network."""

    verdict: str
    #: For each leaf, means in the hold of the force on the hand and the scaled contact force [N].
    force_pairs: tuple[tuple[float, float], ...] = ()
    motion_texts: tuple[str, ...] = ()  #: for each leaf, motion in the hold as text; stable: empty
    leaked_J: float | None = None  #: largest leaked energy of all runs [J]; None: unstable

    @property
    def verdict_text(self) -> str:
        if self.verdict != VERDICT_LEAKS or self.leaked_J is None:
            return self.verdict
        number, unit = (1e3 * self.leaked_J, "mJ") if self.leaked_J < 1.0 else (self.leaked_J, "J")
        return f"leaks {_format_two_significant_digits(number)} {unit}"

    @property
    def least_displayed_share_text(self) -> str:
        """Smallest displayed share [%] of scaled contact force over all springs; "" if unstable."""
        shares = [displayed / pressed for displayed, pressed in self.force_pairs if pressed > 0.0]
        return f"{min(shares):.0%}" if shares else ""


def stability_table(summary: Mapping[str, Any]) -> dict[tuple[str, str], MethodResult]:
    """Return the result for each (method, network) of a summary."""
    table = {}
    for row in summary["hands"]:
        key = row["method"], row["network"]
        runs = [run for run in summary["station"] if (run["method"], run["network"]) == key]
        table[key] = _summarise_runs_of_method(runs, row["leaked"])
    return table


def _summarise_runs_of_method(
    runs: Sequence[Mapping[str, Any]], leaked_J_in_release_and_taps: float
) -> MethodResult:
    if not all(run["stable"] for run in runs):
        motions = tuple(map(_describe_motion_in_hold, runs))
        return MethodResult(VERDICT_UNSTABLE, motion_texts=motions)
    leaked = max(leaked_J_in_release_and_taps, *(run["leaked"] for run in runs))
    forces = tuple((run["felt_force"], run["pressed_force"]) for run in runs)
    if max(run["left_behind"] for run in runs) > MAX_POSITION_ERROR_M:
        return MethodResult(VERDICT_POSITION_ERROR, forces, leaked_J=leaked)
    if max(run["fast_force"] for run in runs) > MAX_FORCE_RIPPLE_RMS_AT_REST_N:
        return MethodResult(VERDICT_CHATTERS, forces, leaked_J=leaked)
    verdict = VERDICT_LEAKS if leaked > MIN_LEAKED_ENERGY_J else VERDICT_HOLDS
    return MethodResult(verdict, forces, leaked_J=leaked)


def _describe_motion_in_hold(run: Mapping[str, Any]) -> str:
    if run["stable"]:
        return "at rest"
    if run["hunting"] is None:
        return "ended early"
    if WRIST_TO_TIP_DISTANCE_M * run["turning"] > run["hunting"]:
        return f"turns by {_format_two_significant_digits(1e3 * run['turning'])} mrad"
    return f"moves by {_format_two_significant_digits(1e3 * run['hunting'])} mm"


def _format_two_significant_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"


def draw_decision_table(summary: Mapping[str, Any]) -> Figure:
    methods, networks, table = summary["methods"], summary["networks"], stability_table(summary)
    with plot_style():
        figure = Picture(figsize=(1.75 * len(networks) + 1.5, 0.72 * len(methods) + 1.1))
        axes = figure.subplots()
        for (method, network), cell in table.items():
            x, y = networks.index(network), methods.index(method)
            mark, colour, text_colour = VERDICT_STYLES[cell.verdict]
            axes.add_patch(Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, color=colour, linewidth=0))
            lines = [f"displays {force:.1f} of {true:.1f} N" for force, true in cell.force_pairs]
            lines += cell.motion_texts
            style: dict[str, Any] = {"color": text_colour, "ha": "center", "va": "center"}
            y -= 0.12 * len(lines)
            axes.text(x, y, f"{mark} {cell.verdict_text}", size=9.5, weight="bold", **style)
            for place, line in enumerate(lines, 1):
                axes.text(x, y + 0.27 * place, line, size=8.5, **style)
        axes.set(xlim=(-0.5, len(networks) - 0.5), ylim=(len(methods) - 0.5, -0.5))
        names = [f"{name}\n{2e3 * PRESETS[name].delay:g} ms" for name in networks]
        axes.set_xticks(range(len(networks)), names)
        axes.set_yticks(range(len(methods)), methods)
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.grid(False)
        axes.spines[:].set_visible(False)
        figure.suptitle("Verdict of each method over each network", x=0.01, ha="left")
    return figure


def draw_release_and_taps(summary: Mapping[str, Any]) -> Figure:
    methods, networks, rows = summary["methods"], summary["networks"], summary["hands"]
    shares = [f"displayed share of taps at {rate:g} Hz [%]" for rate in TAP_RATES_HZ]
    panels = (
        ("speed after release [m/s]", "log", lambda row: row["release_speed"]),
        (shares[0], "linear", lambda row: 100 * row["tap_shares"][0]),
        (shares[1], "linear", lambda row: 100 * row["tap_shares"][1]),
    )
    with plot_style():
        figure = Picture(figsize=(10.0, 0.36 * len(methods) + 1.5))
        columns = figure.subplots(1, len(panels), sharey=True)
        for axes, (title, scale, value) in zip(columns, panels, strict=True):
            for place, network in enumerate(networks):
                shown = [row for row in rows if row["network"] == network]
                # Offsets keep all marks visible.
                y = [methods.index(row["method"]) + 0.12 * (place - 2) for row in shown]
                marker, colour = _NETWORK_MARKERS[place % 5], COLOURS[place % len(COLOURS)]
                x = [max(value(row), 0.0) for row in shown]
                axes.plot(x, y, marker, markersize=5, color=colour, label=network)
            axes.set(xscale=scale, xlabel=title)
            if scale == "log":
                axes.xaxis.set_major_formatter("{x:g}")
            else:
                axes.set_xlim(left=0.0)
            axes.set_yticks(range(len(methods)), methods)
            axes.set_ylim(len(methods) - 0.5, -0.5)
        figure.legend(*columns[0].get_legend_handles_labels(), loc="outside upper center", ncols=6)
    return figure


def draw_force_traces(summary: Mapping[str, Any], traces: Traces) -> Figure:
    def draw_run(axes: Any, trace: Mapping[str, Array]) -> None:
        axes.plot(trace["t"], trace["pressed"], color=GREY, linewidth=0.8)
        axes.plot(trace["t"], trace["hand_force"], color=COLOURS[0], linewidth=0.9)

    figure = _draw_trace_grid(summary, traces, draw_run, "force [N]")
    figure.suptitle("Rendered force (blue) and scaled contact force (grey)", x=0.01, ha="left")
    return figure


def draw_energy_traces(summary: Mapping[str, Any], traces: Traces) -> Figure:
    def draw_run_energy(axes: Any, trace: Mapping[str, Array]) -> None:
        axes.axhline(0.0, color=GREY, linewidth=0.6)
        axes.plot(trace["t"], trace["energy"], color=COLOURS[2], linewidth=1.0)

    figure = _draw_trace_grid(summary, traces, draw_run_energy, "energy [J]")
    words = "Energy between hand and actual motion:\nbelow 0 the station is active"
    figure.suptitle(words, x=0.01, ha="left")
    return figure


def _draw_trace_grid(summary: Mapping[str, Any], traces: Traces, draw: Any, unit: str) -> Figure:
    methods, networks = summary["methods"], summary["networks"]
    with plot_style():
        figure = Picture(figsize=(max(3.0 * len(networks), 7.5), 1.5 * len(methods) + 0.8))
        grid = figure.subplots(len(methods), len(networks), squeeze=False, sharex="col")
        for i, method in enumerate(methods):
            for j, network in enumerate(networks):
                axes, trace = grid[i, j], traces.get((network, method))
                if i == 0:
                    axes.set_title(f"{network}, RTT {2e3 * PRESETS[network].delay:g} ms")
                if j == 0:
                    axes.set_ylabel(f"{method}\n{unit}", fontsize=8)
                if trace is None:
                    axes.text(0.5, 0.5, "ended early", transform=axes.transAxes, ha="center")
                else:
                    draw(axes, trace)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
    return figure


def draw_round_trip_limits(rows: Sequence[Mapping[str, Any]]) -> Figure:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    walls = sorted({row["wall_N_per_m"] for row in rows})
    with plot_style():
        figure = Picture(figsize=(3.6 * len(walls), 0.36 * len(methods) + 1.3))
        panels = figure.subplots(1, len(walls), squeeze=False, sharey=True)[0]
        for axes, wall in zip(panels, walls, strict=True):
            at_wall = [row for row in rows if row["wall_N_per_m"] == wall]
            for place, method in enumerate(methods):
                found = [1e3 * row["longest_s"] for row in at_wall if row["method"] == method]
                shortest, longest = max(min(found), 1.0), max(max(found), 1.0)
                axes.plot([1.0, shortest], [place, place], color=COLOURS[0], linewidth=5)
                axes.plot([shortest, longest], [place, place], color=COLOURS[5], linewidth=2)
            axes.set(xscale="log", xlim=(1.0, 1e3 * max(rows[0]["grid_s"])))
            axes.set_yticks(range(len(methods)), methods)
            axes.invert_yaxis()
            title, label = f"wall of {wall / 1e3:g} kN/m", "longest stable round trip [ms]"
            axes.set(title=title, xlabel=label)
    return figure


def print_tables(summary: Mapping[str, Any], out: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console, table = Console(), stability_table(summary)
    grid = Table(title="Displayed / scaled contact force", title_justify="left", box=SIMPLE_HEAD)
    grid.add_column("Method", no_wrap=True)
    for network in summary["networks"]:
        grid.add_column(f"{network}\n{2e3 * PRESETS[network].delay:g} ms", overflow="fold")
    for method in summary["methods"]:
        cells = [table[method, network] for network in summary["networks"]]
        texts = (f"{cell.verdict_text} {cell.least_displayed_share_text}" for cell in cells)
        grid.add_row(method, *map(str.strip, texts))
    console.print(grid)
    console.print(f"written to {out}; open {out / 'report.html'}", highlight=False, markup=False)
