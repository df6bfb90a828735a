"""Report of `drake-teleop analyze`: one page with a verdict, tables and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from drake_teleop.common.html import write_report_page_and_pictures
from drake_teleop.common.numeric import Array
from drake_teleop.common.style import BLACK, COLOURS, GREY, VERMILION, Picture, plot_style
from drake_teleop.lab.analysis import absolute_stability, two_port
from drake_teleop.lab.analysis.maps import StabilityMap
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis, environment_impedance

_GRIP_COLOURS = {"light": COLOURS[3], "medium": COLOURS[4], "firm": COLOURS[1]}
#: Parameter of a map -> label of its axis, factor to its unit, and scale.
_PLOT_AXIS_FORMAT_BY_MAP_PARAMETER = {
    "delay": ("round trip [ms]", 2e3, "linear"),
    "wall_stiffness": ("stiffness of the wall [kN/m]", 1e-3, "log"),
    "sigma": ("σ", 1.0, "linear"),
    "mass_error": ("estimated minus true mass [kg]", 1.0, "linear"),
    "rate": ("rate of the hand [kHz]", 1e-3, "log"),
}


@dataclass(frozen=True, eq=False)
class ReportCurves:
    """Data of the report's pictures that the summary does not contain."""

    axis: OneAxis  #: in contact with the wall
    omega: Array  #: (n,) [rad/s]
    H: Complex  #: (n, 2, 2) two-port of the Diagram, without the hand's mass
    nyquist: dict[str, Complex]  #: grip -> (n,) response -L; stability limit: -1
    maps: dict[str, dict[str, StabilityMap]]  #: title -> grip -> map


def write_report(summary: Mapping[str, Any], curves: ReportCurves, out: Path) -> None:
    pictures = {
        "bode": draw_rendered_impedance(curves, summary["measured"]),
        "nyquist": draw_nyquist(curves),
        "passive": draw_absolute_stability(curves),
        "widths": draw_z_widths(curves, summary["z_width"]),
        "maps": draw_stability_maps(curves, summary["grip"]),
    }
    write_report_page_and_pictures(
        out,
        "drake_teleop.lab.analysis",
        pictures,
        s=summary,
        wall=curves.axis.wall_stiffness,
        axis_rows=axis_parameter_rows(summary["axis"]),
        margin_rows=[margin_cells(row, summary["delay_s"]) for row in summary["margins"]],
    )


def axis_parameter_rows(axis: Mapping[str, Any]) -> list[tuple[str, str]]:
    scale = f"1/{1 / axis['force_scale']:.4g}" if axis["force_scale"] > 0 else "0"
    hand = f"{axis['hand_mass']:g} kg, {axis['hand_damping']:g} N s/m"
    loops = (f"{which} loop {axis[f'{which}_gain']:.4g} 1/s" for which in ("position", "velocity"))
    return [
        ("Hand", f"{hand}, {axis['hand_stiffness']:g} N/m"),
        ("Device", f"{axis['device_mass']:.4g} kg, {axis['device_damping']:.3g} N s/m"),
        ("Slave, with its tool", f"{axis['slave_mass']:.4g} kg at the tip"),
        ("Servo", ", ".join(loops)),
        ("Tool beyond the sensor", f"{axis['tool_mass']:g} kg"),
        ("Scales", f"force {scale}, motion {axis['position_scale']:g}"),
        ("Elimination", f"σ = {axis['sigma']:g}, γ = {axis['gamma']:g}"),
    ]


def margin_cells(row: Mapping[str, Any], one_way_delay_s: float) -> tuple[str, ...]:
    wall = "free motion" if row["wall_N_per_m"] == 0 else f"{row['wall_N_per_m'] / 1e3:.3g} kN/m"
    if not row["stable"]:
        return (row["grip"], wall, "no", "", "", "")
    trip = row["round_trip_s"]
    gain = "any" if row["gain"] is None else f"{row['gain']:.3g}"
    phase = "any" if row["phase_deg"] is None else f"{row['phase_deg']:.0f}°"
    reserve = "any" if trip is None else f"{1e3 * (trip - 2 * one_way_delay_s):.1f}"
    return (row["grip"], wall, "yes", gain, phase, reserve)


def draw_rendered_impedance(curves: ReportCurves, measured: Mapping[str, Any] | None) -> Figure:
    hertz, s = curves.omega / (2 * np.pi), 1j * curves.omega.astype(complex)
    wall = f"wall of {curves.axis.wall_stiffness / 1e3:.3g} kN/m"
    environments = {"free motion": np.zeros_like(s), wall: environment_impedance(curves.axis, s)}
    closed_form = two_port.hybrid_matrix(curves.axis, s)
    with plot_style():
        figure = Picture(figsize=(9.0, 5.4))
        grid = figure.subplots(2, 2, sharex=True, sharey="row")

        def draw(column: int, hertz: Array, displayed: Complex, label: str, **style: Any) -> None:
            grid[0, column].loglog(hertz, np.abs(displayed), label=label, **style)
            phase = np.degrees(np.unwrap(np.angle(displayed)))
            grid[1, column].semilogx(hertz, phase, **style)

        for column, (name, environment) in enumerate(environments.items()):
            ideal = two_port.ideal_impedance(curves.axis, s, environment)
            one_axis = two_port.transmitted_impedance(closed_form, environment)
            linear = two_port.transmitted_impedance(curves.H, environment)
            draw(column, hertz, ideal, "ideal", color=GREY, linestyle="--", linewidth=1.0)
            draw(column, hertz, one_axis, "closed form", color=COLOURS[3], linewidth=2.4)
            draw(column, hertz, linear, "Diagram, linearised", color=COLOURS[0], linewidth=1.1)
            grid[0, column].set_title(name)
            grid[1, column].set_xlabel("frequency [Hz]")
        if measured is not None:
            displayed = np.array(measured["felt_re"]) + 1j * np.array(measured["felt_im"])
            dots: dict[str, Any] = {"color": VERMILION, "linestyle": "", "marker": "o", "ms": 3.5}
            draw(0, measured["frequency_Hz"], displayed, "Diagram, simulated", **dots)
        grid[0, 0].set_ylabel("|Z| displayed [N s/m]")
        grid[1, 0].set_ylabel("phase [deg]")
        grid[0, 0].legend()
    return figure


def draw_nyquist(curves: ReportCurves) -> Figure:
    with plot_style():
        figure = Picture(figsize=(9.0, 4.2))
        whole, near = figure.subplots(1, 2)
        near.set(title="around -1", xlim=(-2.0, 1.0), ylim=(-1.3, 1.3))
        title = f"Loop at the displayed force, wall of {curves.axis.wall_stiffness / 1e3:.3g} kN/m"
        whole.set(title=title, ylabel="imaginary part")
        for axes, adjusted in ((whole, "datalim"), (near, "box")):
            for grip, loop in curves.nyquist.items():
                axes.plot(loop.real, loop.imag, color=_GRIP_COLOURS[grip], label=grip)
            axes.plot(-1, 0, color=BLACK, marker="+", ms=11, mew=2)
            axes.set_xlabel("real part")
            axes.set_aspect("equal", adjustable=adjusted)
        whole.legend(title="grip")
    return figure


def draw_absolute_stability(curves: ReportCurves) -> Figure:
    hertz, stiffest = curves.omega / (2 * np.pi), curves.axis.wall_stiffness
    _, S = two_port.power_scaled_matrices(curves.H, curves.axis)
    wall = absolute_stability.ImpedanceRange((0.0, 0.0), (0.0, 10.0), (0.0, stiffest))
    hands = absolute_stability.impedance_range_of_grips()
    bounded = absolute_stability.singular_value_in_ranges(curves.H, curves.omega, hands, wall)
    with plot_style():
        figure = Picture(figsize=(9.0, 3.6))
        left, right = figure.subplots(1, 2)
        left.semilogx(hertz, absolute_stability.llewellyn_parameter(curves.H), color=COLOURS[0])
        left.set(ylim=(-1.2, 5.0), title="Llewellyn's parameter (absolutely stable if >= 1)")
        realistic = f"hands from light to firm, walls up to {stiffest / 1e3:.3g} kN/m: μ"
        mu = absolute_stability.structured_singular_value(S)
        for label, value, colour in (
            ("passive: norm of S", absolute_stability.scattering_norm(S), COLOURS[2]),
            ("any passive hand and environment: μ", mu, COLOURS[0]),
            (realistic, bounded, COLOURS[3]),
        ):
            right.semilogx(hertz, value, color=colour, label=label)
        right.set(ylim=(0.0, 3.0), title="stable below 1")
        right.legend(fontsize=7.5)
        for axes in (left, right):
            axes.axhline(1.0, color=VERMILION, linewidth=0.9, linestyle="--")
            axes.set_xlabel("frequency [Hz]")
    return figure


def draw_z_widths(curves: ReportCurves, z_width: Mapping[str, Any]) -> Figure:
    hertz, width = curves.omega / (2 * np.pi), two_port.transmitted_z_width(curves.H)
    walls = z_width["walls"]
    damping = [row["wall_damping_Ns_per_m"] for row in walls]
    with plot_style():
        figure = Picture(figsize=(9.0, 3.6))
        left, right = figure.subplots(1, 2)
        free, rigid = np.abs(width.free), np.abs(width.rigid)
        left.fill_between(hertz, free, rigid, color=COLOURS[5], alpha=0.35)
        left.loglog(hertz, rigid, color=COLOURS[0], label="rigid environment")
        left.loglog(hertz, free, color=COLOURS[2], label="free motion")
        left.set(xlabel="frequency [Hz]", ylabel="|Z| displayed [N s/m]")
        left.set_title("Transmitted through the station")
        left.legend()
        shown = {
            "stable in this hand": ("stable_in_the_hand_N_per_m", COLOURS[0]),
            "passive with this hand's damping": ("passive_in_the_hand_N_per_m", COLOURS[2]),
            "passive by the device's damping": ("passive_N_per_m", GREY),
        }
        for label, (key, colour) in shown.items():
            right.plot(damping, [1e-3 * row[key] for row in walls], color=colour, label=label)
        right.set(xlabel="damping of the virtual wall [N s/m]", ylabel="stiffness [kN/m]")
        right.set_title(f"Virtual walls, sampled at {z_width['rate_Hz'] / 1e3:g} kHz")
        right.legend()
    return figure


def draw_stability_maps(curves: ReportCurves, grip: str) -> Figure:
    with plot_style():
        rows = -(-len(curves.maps) // 2)
        figure = Picture(figsize=(9.0, 3.3 * rows))
        cells = figure.subplots(rows, 2, squeeze=False).ravel()
        for axes, (title, shown) in zip(cells, curves.maps.items(), strict=False):
            mesh = _draw_stability_map(axes, shown, grip)
            axes.set_title(title)
        for axes in cells[len(curves.maps) :]:
            axes.set_axis_off()
        legend = cells[len(curves.maps)] if len(cells) > len(curves.maps) else cells[0]
        for name, colour in _GRIP_COLOURS.items():
            legend.plot([], [], color=colour, label=f"limit of stability, {name} grip")
        legend.fill_between([], [], color=GREY, alpha=0.25, label=f"unstable with the {grip} grip")
        legend.legend(loc="upper left", fontsize=9)
        figure.colorbar(mesh, ax=legend, location="bottom", label="error of the displayed force")
    return figure


def _draw_stability_map(axes: Axes, map_of_grip: Mapping[str, StabilityMap], grip: str) -> Any:
    one = map_of_grip[grip]
    x_label, x_factor, x_scale = _PLOT_AXIS_FORMAT_BY_MAP_PARAMETER[one.x_name]
    y_label, y_factor, y_scale = _PLOT_AXIS_FORMAT_BY_MAP_PARAMETER[one.y_name]
    x, y = x_factor * one.x, y_factor * one.y
    distortion = np.ma.masked_where(~one.stable, np.clip(one.distortion, 0.01, 1.0))
    axes.set_facecolor("#D5D8DD")
    mesh = axes.pcolormesh(
        x, y, distortion, norm=LogNorm(0.01, 1.0), cmap="YlGnBu", shading="nearest", rasterized=True
    )
    for name, other in map_of_grip.items():
        edge = other.boundary * (x_factor, y_factor)
        axes.plot(*edge.T, color=_GRIP_COLOURS[name], linestyle="", marker=".", ms=2.2)
    axes.set(xscale=x_scale, xlim=(x[0], x[-1]), xlabel=x_label)
    axes.set(yscale=y_scale, ylim=(y[0], y[-1]), ylabel=y_label)
    axes.grid(False)
    return mesh


def verdict_sentences(summary: dict[str, Any]) -> list[str]:
    sentences = []
    if summary["method"] != "none":
        sentences += [
            f"The method {summary['method']} is not linear.",
            "The analysis is for the station without this method.",
        ]
    if "is not analysed" in summary["wall_is"]:
        sentences.append(f"The wall is {summary['wall_is']}.")
    sentences += [_stability_sentence(row, summary["grip"]) for row in summary["diagram"]]
    for row in summary["margins"]:
        if row["grip"] == summary["grip"] and row["wall_N_per_m"] == summary["wall_N_per_m"]:
            sentences += _margin_sentences(row, summary["delay_s"])
    if (worst := max(summary["two_port"]["sampled"].values())) > 0.1:
        sentences += [
            f"Along {summary['direction']} the station is not one axis.",
            "Contact rotates the tool, or its motion is estimated with a delay (encoders).",
            f"Its two-port differs from one axis by up to {100 * worst:.2g} % below 30 Hz.",
            "Margins and maps assume one axis and are approximate here.",
        ]
    return sentences + _stability_limit_sentences(summary) + _transparency_sentences(summary)


def _stability_sentence(row: dict[str, Any], grip: str) -> str:
    decay, hertz = row["decay_1_per_s"], row["frequency_Hz"]
    if decay is None:
        stable = "stable" if row["stable"] else "unstable"
        return f"In the state '{row['point']}' the one-axis model of the station is {stable}."
    state = f"In '{row['point']}', {grip} grip, the station is"
    motion = f"at {hertz:.3g} Hz" if hertz > 0.01 else "without oscillation"
    if row["stable"]:
        return f"{state} stable: motion halves every {1e3 * np.log(2) / decay:.3g} ms, {motion}."
    return f"{state} unstable: motion doubles every {-1e3 * np.log(2) / decay:.3g} ms, {motion}."


def _margin_sentences(row: dict[str, Any], one_way_delay_s: float) -> list[str]:
    wall = f"wall of {_stiffness_text(row['wall_N_per_m'])}"
    if not row["stable"]:
        return [f"At a {wall} the station is unstable with this grip."]
    trip, longest = row["round_trip_s"], "any round trip"
    if trip is not None:
        longest = f"{1e3 * (trip - 2 * one_way_delay_s):.3g} ms more round trip"
    more = "any gain" if row["gain"] is None else f"{row['gain']:.3g} times the loop gain"
    return [f"A {wall} is stable up to {longest}, or up to {more}."]


def _stability_limit_sentences(summary: dict[str, Any]) -> list[str]:
    bounded, absolute = summary["bounded"], summary["absolute"]
    each = ", ".join(f"{grip} {_stiffness_text(K)}" for grip, K in bounded["each"].items())
    every = _stiffness_text(bounded["grips"])
    sentences = [
        f"The stiffest stable wall depends on the grip: {each}.",
        f"For all hands between the lightest and the firmest grip this wall is {every}.",
        "These limits exclude Coulomb friction, which dissipates energy.",
    ]
    if absolute["absolutely_stable"]:
        stable = "The station is absolutely stable: no passive hand and wall make it oscillate."
        return [*sentences, stable]
    lacking = absolute["lacking_damping_Ns_per_m"]
    remedy = "No damping" if lacking is None else f"{lacking:.3g} N s/m more damping"
    return [
        *sentences,
        "The station is not absolutely stable: some passive hand and wall make it oscillate.",
        f"{remedy} of the device would make it absolutely stable.",
        "Position-force stations with a servo are rarely absolutely stable.",
        "For realistic hands and walls, the limits above apply.",
    ]


def _transparency_sentences(summary: dict[str, Any]) -> list[str]:
    free, wall = summary["transparency"]["free"], summary["transparency"]["wall"]
    rendered, ideal = wall["felt"]["stiffness"], wall["ideal"]["stiffness"]
    sigma = f"σ = {summary['axis']['sigma']:g}"
    return [
        f"In free motion the displayed mass is {1e3 * free['felt']['mass']:.3g} g.",
        f"The ideal mass for this device and {sigma} is {1e3 * free['ideal']['mass']:.3g} g.",
        f"At the wall the displayed stiffness is {rendered:.3g} N/m; the ideal is {ideal:.3g} N/m.",
        f"A human cannot distinguish it from the ideal up to {wall['unnoticed_to_Hz']:.2g} Hz.",
        f"The slave tracks up to {summary['transparency']['tracking_bandwidth_Hz']:.3g} Hz.",
    ]


def _stiffness_text(value: float | None) -> str:
    if value == 0:
        return "none"
    return "any stiffness" if value is None else f"{value / 1e3:.3g} kN/m"


def print_tables(summary: Mapping[str, Any], out: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    table = Table("Grip", "Wall", "Stable", title="Stability margins", box=SIMPLE_HEAD)
    table.title_justify = "left"
    for heading in ("Gain", "Phase", "More round trip [ms]"):
        table.add_column(escape(heading), justify="right")  # [ms] is no markup
    for row in summary["margins"]:
        table.add_row(*margin_cells(row, summary["delay_s"]))
    console.print(table)
    for sentence in summary["verdict"]:
        console.print(f"- {sentence}", highlight=False, markup=False)
    console.print(f"written to {out}; open {out / 'report.html'}", highlight=False, markup=False)
