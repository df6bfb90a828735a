"""Draw the pictures of README and docs into docs/figures.

They are the station, its frames and signs, Fig. 8 as `reproduce` draws it with its 3D scene, the
sample log, the frames of a log and the noise of the wrist sensor.

Usage: `python docs/make_figures.py`. Chromium draws the scene from `replay.html`; without Chromium
the old picture remains.
"""

from __future__ import annotations

import runpy
import shutil
import subprocess
import tempfile
from base64 import b64decode
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import nbformat
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch
from nbclient import NotebookClient
from scipy.signal import welch

from drake_teleop.cli.excitation import excite_command
from drake_teleop.common.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILION,
    Picture,
    plot_style,
    shade_contact,
)
from drake_teleop.lab.reproduction.reproduce import reproduce_command
from drake_teleop.logs.processing import detect_log, identify_log
from drake_teleop.logs.sample import sample_log_command
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import without_parts

FIGURES = Path(__file__).parent / "figures"
NOISE = runpy.run_path(str(Path(__file__).parent / "_ext" / "sensor_noise.py"))
NOTEBOOKS = Path(__file__).parents[1] / "notebooks"

# Inches: columns from operator to slave; rows for motion, force and auxiliary blocks.
COLUMNS = (0.72, 2.2, 3.68, 5.16, 6.64, 8.12, 9.82)
MOTION, FORCE, BELOW = 3.3, 1.9, 0.55
WIDTH, HEIGHT = 1.04, 0.68
_CORNER = "angle,angleA=-90,angleB=0,rad=5"
MASTER, LINE, SLAVE = "#EEF4FA", "#F3F4F6", "#FBF1EA"


def station_figure() -> Picture:
    """Draw the paper's Fig. 4 with the blocks of this library."""
    operator, master, scaling, channel, ik, control, slave = COLUMNS
    with plot_style(), mpl.rc_context({"mathtext.fontset": "dejavuserif"}):
        figure = Picture(figsize=(10.7, 4.32), facecolor="white", layout="none")
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, 10.7), ylim=(-0.05, 4.27), aspect="equal")
        axes.axis("off")
        _side(axes, 0.08, 4.32, "master", MASTER)
        _side(axes, 4.44, 5.88, "channel", LINE)
        _side(axes, 6.0, 10.62, "slave", SLAVE)

        _block(axes, operator, MOTION, "operator")
        _block(axes, master, MOTION, "master\ndevice")
        _block(axes, scaling, MOTION, "kinematic\nscaling")
        middle, tall = (MOTION + FORCE) / 2, MOTION - FORCE + HEIGHT
        text = "network\n\nat both ends:\npassivity\nmethod,\nsafe state"
        _block(axes, channel, middle, text, height=tall)
        _block(axes, ik, MOTION, "inverse\nkinematics")
        _block(axes, control, MOTION, "joint\ncontrol")
        _block(axes, slave, MOTION, "slave arm")
        _block(axes, master, FORCE, "force display\n" r"$J_M^{\,T}$, limits")
        _block(axes, ik, FORCE, "to the master\n" r"$\times\ 1/17.5$")
        _block(axes, control, FORCE, "elimination,\nscaling " r"$\sigma,\gamma,\eta$", heavy=True)
        _block(axes, slave, FORCE, "wrist sensor")
        _block(axes, control, BELOW, "load\nestimator", colour=GREEN)
        _block(axes, slave, BELOW, "tool on the\nsheet spring", colour=GREY)

        _arrow(axes, (operator, MOTION + 0.14), (master, MOTION + 0.14), "hand", BLUE)
        _arrow(axes, (master, MOTION - 0.14), (operator, MOTION - 0.14), "force", VERMILION, -1)
        _arrow(axes, (master, MOTION), (scaling, MOTION), r"${}^B T_E$", BLUE)
        _arrow(axes, (scaling, MOTION), (channel, MOTION), r"${}^R T_E$", BLUE)
        _arrow(axes, (channel, MOTION), (ik, MOTION), "", BLUE)
        _arrow(axes, (ik, MOTION), (control, MOTION), r"$\bar q_S$", BLUE)
        _arrow(axes, (control, MOTION), (slave, MOTION), r"$\tau$", BLUE)
        _arrow(axes, (slave, MOTION), (slave, FORCE), r"$q_S,\ \dot q_S$", BLUE)
        _arrow(axes, (slave, FORCE + 0.14), (control, FORCE + 0.14), r"$f_S,\tau_S$", VERMILION)
        _arrow(axes, (slave, FORCE - 0.14), (control, FORCE - 0.14), r"$s,\omega,\alpha$", BLUE, -1)
        _arrow(axes, (control, FORCE), (ik, FORCE), r"$F'$", VERMILION)
        _arrow(axes, (ik, FORCE), (channel, FORCE), "", VERMILION)
        _arrow(axes, (channel, FORCE), (master, FORCE), r"$\bar f_M,\ \bar\tau_M$", VERMILION)
        _arrow(axes, (master, FORCE), (master, MOTION), r"$\bar m_M$", VERMILION)
        _arrow(axes, (control, BELOW), (control, FORCE), r"$\hat\varphi,\ F_o$", GREEN)
        _arrow(axes, (slave, BELOW), (slave, FORCE), "contact", VERMILION)
        tap = slave - WIDTH / 2 - 0.1
        for height in (FORCE + 0.14, FORCE - 0.14):
            axes.plot(tap, height, "o", color=GREEN, markersize=4, zorder=4)
        _line(axes, (tap, FORCE + 0.14), (control + WIDTH / 2, BELOW), GREEN, _CORNER)
        axes.text(
            (operator + scaling) / 2, BELOW + 0.2, r"$F' \;=\; \gamma\,(F - F_o - V\varphi)"
            r" \;+\; \sigma\,V\varphi$", ha="center", va="center", fontsize=13, color=BLACK,
        )  # fmt: skip
        for x, word, colour in (
            (1.3, "motion", BLUE),
            (2.2, "force", VERMILION),
            (3.1, "load", GREEN),
        ):
            axes.text(x, BELOW - 0.2, f"\u2192 {word}", ha="center", va="center", color=colour)
    return figure


def _side(axes: Axes, left: float, right: float, name: str, colour: str) -> None:
    style = "round,pad=0,rounding_size=0.12"
    axes.add_patch(
        FancyBboxPatch(
            (left, 0.05), right - left, 4.12, boxstyle=style, facecolor=colour, edgecolor="none"
        )
    )
    axes.text(left + 0.14, 4.0, name, va="center", color=GREY, fontsize=10)


def _block(
    axes: Axes,
    x: float,
    y: float,
    text: str,
    *,
    height: float = HEIGHT,
    heavy: bool = False,
    colour: str = BLACK,
) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (x - WIDTH / 2, y - height / 2), WIDTH, height,
            boxstyle="round,pad=0,rounding_size=0.07",
            facecolor="white",
            edgecolor=VERMILION if heavy else colour,
            linewidth=2.0 if heavy else 0.9,
            zorder=3,
        )
    )  # fmt: skip
    axes.text(
        x, y, text, ha="center", va="center", fontsize=9.5, color=BLACK, linespacing=1.35, zorder=4
    )


def _arrow(
    axes: Axes,
    start: tuple[float, float],
    stop: tuple[float, float],
    label: str,
    colour: str,
    side: int = 1,
) -> None:
    """Draw an arrow between two blocks' edges, with its label above or right (side = 1)."""
    (x0, y0), (x1, y1) = start, stop
    if y0 == y1:
        shift = (WIDTH / 2) * (1 if x1 > x0 else -1)
        x0, x1 = x0 + shift, x1 - shift
        place, alignment = ((x0 + x1) / 2, y0 + 0.06 * side), ("center", _above(side))
    else:
        shift = (HEIGHT / 2) * (1 if y1 > y0 else -1)
        y0, y1 = y0 + shift, y1 - shift
        place, alignment = (x0 + 0.07, (y0 + y1) / 2), ("left", "center")
    _line(axes, (x0, y0), (x1, y1), colour, "arc3")
    axes.text(*place, label, ha=alignment[0], va=alignment[1], fontsize=9, color=colour, zorder=4)


def _above(side: int) -> str:
    return "bottom" if side > 0 else "top"


def _line(
    axes: Axes, start: tuple[float, float], stop: tuple[float, float], colour: str, style: str
) -> None:
    arrow = {
        "arrowstyle": "-|>,head_width=0.22,head_length=0.42",
        "connectionstyle": style,
        "color": colour,
        "linewidth": 1.3,
        "shrinkA": 0,
        "shrinkB": 0.5,
    }
    axes.annotate("", xy=stop, xytext=start, arrowprops=arrow, zorder=2)


def frames_figure() -> Picture:
    """Draw world, sensor frame and posed frame of a log, with the fields that describe them."""
    with plot_style():
        figure = Picture(figsize=(6.4, 3.3), facecolor="white", layout="none")
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, 6.4), ylim=(0, 3.3), aspect="equal")
        axes.axis("off")
        world, sensor, posed, centre = ((0.6, 0.5), (3.0, 2.1), (5.2, 1.0), (3.9, 1.55))
        for at, along, size, colour in (
            ((2.45, 2.42), -20.0, (0.62, 0.46), GREY),  # wrist, sensor and load
            ((2.8, 2.29), -20.0, (0.28, 0.46), ORANGE),
            ((3.06, 2.19), -20.0, (1.75, 0.46), BLUE),
        ):
            turned = mpl.transforms.Affine2D().rotate_deg_around(*at, along)
            place = (at[0], at[1] - size[1])
            box = FancyBboxPatch(
                place, *size, boxstyle="round,pad=0,rounding_size=0.05", fc=colour, ec=BLACK
            )
            box.set(alpha=0.25, transform=turned + axes.transData)
            axes.add_patch(box)
        for origin, name, z, x in (
            (world, "W", 90.0, 0.0),
            (sensor, "S", -20.0, 70.0),
            (posed, "P", 25.0, 115.0),
        ):
            for degrees, label in ((z, "z"), (x, "x")):
                way = np.radians(degrees)
                tip = np.array(origin) + 0.55 * np.array([np.cos(way), np.sin(way)])
                _pointer(axes, origin, tip, BLACK)
                axes.text(*(tip + 0.16 * (tip - origin)), label, ha="center", va="center")
            axes.text(origin[0] - 0.2, origin[1] - 0.2, name, weight="bold", ha="center")
        _pointer(axes, sensor, posed, VERMILION)
        axes.text(4.1, 2.1, "position_in_sensor", color=VERMILION)
        _pointer(axes, world, posed, GREEN)
        axes.text(2.2, 0.45, "position, orientation: as recorded", color=GREEN)
        axes.plot(*centre, "o", color=BLUE)
        axes.text(centre[0] - 0.1, centre[1] - 0.4, "centre of mass", color=BLUE, ha="right")
        _pointer(axes, (0.6, 2.9), (0.6, 2.2), GREY)
        axes.text(0.72, 2.5, "gravity", color=GREY)
        axes.text(5.2, 0.7, "TCP, flange,\ntracked body", va="top")
        axes.text(2.55, 2.85, "sensor", color=ORANGE)
    return figure


def _pointer(axes: Axes, start: object, end: object, colour: str) -> None:
    arrow = {"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=arrow)


def station_frames_figure() -> Picture:
    """Draw the frames: W, S, Bcm and contact at the slave, B and E at the master."""
    with plot_style(), mpl.rc_context({"mathtext.fontset": "dejavuserif"}):
        figure = Picture(figsize=(9.9, 3.3), facecolor="white", layout="none")
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, 9.9), ylim=(0.1, 3.4), aspect="equal")
        axes.axis("off")
        axes.plot([0.2, 3.0], [0.5, 0.5], color=GREY, linewidth=0.9)
        axes.plot([4.2, 8.4], [0.5, 0.5], color=GREY, linewidth=0.9)
        # Master: base, two links, stylus.
        axes.plot([0.8, 0.8, 1.7, 2.3], [0.5, 1.5, 2.3, 1.7], color=GREY, linewidth=6, alpha=0.5)
        _axes_of(axes, (0.8, 0.5), "B", "base of the device; x to the operator", side=-1)
        _axes_of(axes, (2.3, 1.7), "E", "stylus, in the hand", side=1)
        # Slave: three links, sensor, tool.
        axes.plot([4.9, 4.9, 6.2, 7.2], [0.5, 1.9, 3.0, 2.6], color=GREY, linewidth=8, alpha=0.5)
        _box(axes, (7.0, 2.35), 0.4, 0.2, GREEN)
        _box(axes, (7.08, 1.0), 0.24, 1.35, GREY)
        _axes_of(axes, (4.9, 0.5), "W", "world, z up", side=-1)
        _axes_of(axes, (7.2, 2.35), "S", "wrist sensor; its origin is So", side=1, z=-1)
        axes.plot(7.2, 1.6, "o", color=BLACK, markersize=5, zorder=5)
        axes.text(7.42, 1.6, "Bcm, of all beyond S", va="center", color=BLACK)
        _line(axes, (7.2, 2.35), (7.2, 1.6), BLACK, "arc3,rad=0.6")
        axes.text(6.86, 1.93, r"$p_{SoBcm}$", ha="right", va="center", color=BLACK, fontsize=11)
        _line(axes, (7.2, 0.52), (7.2, 0.98), VERMILION, "arc3")
        axes.text(7.42, 0.75, "contact", va="center", color=VERMILION)
    return figure


def signs_figure() -> Picture:
    """Draw the load at rest, swung upwards and on a table, with the force of the sensor."""
    cases = (
        ("at rest", 1.0, 0.0, "f = −m g"),
        ("swung upwards", 1.5, 0.0, "f = m (a − g)"),
        ("put on a table", 0.5, 0.5, "f = −m g − what the table does"),
    )
    with plot_style():
        figure = Picture(figsize=(8.6, 2.9), facecolor="white", layout="none")
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, 8.6), ylim=(-0.15, 2.75), aspect="equal")
        axes.axis("off")
        for k, (name, force, contact, words) in enumerate(cases):
            x = 1.3 + 2.9 * k
            _box(axes, (x - 0.12, 0.95), 0.24, 0.75, GREY)
            _line(axes, (x, 1.7), (x, 1.7 + 0.6 * force), GREEN, "arc3")
            axes.text(x + 0.12, 1.7 + 0.4 * force, "f", color=GREEN, fontsize=11)
            _line(axes, (x + 0.2, 1.3), (x + 0.2, 0.7), BLACK, "arc3")
            axes.text(x + 0.28, 1.02, "m g", color=BLACK)
            if contact:
                axes.plot([x - 0.6, x + 0.6], [0.93, 0.93], color=GREY, linewidth=1.2)
                _line(axes, (x - 0.3, 0.45), (x - 0.3, 0.93), VERMILION, "arc3")
                axes.text(x - 0.38, 0.62, "of the table", color=VERMILION, ha="right")
            axes.text(x, 0.06, f"{name}\n{words}", ha="center", color=BLACK, linespacing=1.4)
    return figure


def _axes_of(
    axes: Axes, origin: tuple[float, float], name: str, words: str, *, side: int, z: int = 1
) -> None:
    """Draw x and z of a frame as arrows, with its name and further words."""
    x0, z0 = origin
    _line(axes, (x0, z0), (x0 + 0.42, z0), BLUE, "arc3")
    _line(axes, (x0, z0), (x0, z0 + 0.42 * z), BLUE, "arc3")
    axes.text(x0 + 0.44, z0 + 0.05, "x", color=BLUE, fontsize=8.5)
    axes.text(x0 + 0.07, z0 + 0.4 * z, "z", color=BLUE, fontsize=8.5, va="center", zorder=6)
    place = (x0 - 0.1, z0 - 0.22) if side < 0 else (x0 + 0.3, z0 + 0.2)
    axes.text(*place, f"{name}: {words}", color=BLUE, fontsize=9, zorder=6)


def _box(axes: Axes, corner: tuple[float, float], width: float, height: float, colour: str) -> None:
    axes.add_patch(
        FancyBboxPatch(
            corner, width, height, boxstyle="round,pad=0,rounding_size=0.04",
            facecolor="white", edgecolor=colour, linewidth=1.2, zorder=1,
        )
    )  # fmt: skip


def noise_figure() -> Picture:
    """Draw spectrum and Allan deviation of fx at rest: predicted (lines), simulated (dots)."""
    period, count = 125e-6, 300 * 8000
    lengths = np.unique(np.logspace(0, np.log10(count // 8), 31).astype(int))
    with plot_style():
        figure = Picture(figsize=(8.2, 3.2), facecolor="white")
        spectrum, allan = figure.subplots(1, 2)
        for name, colour in (("jr3_85m35a3", BLUE), ("ati_gamma_imu", VERMILION)):
            config = without_parts(PRESETS[name], "drift")
            record = NOISE["rest_record"](config, count, period, seed=1)[:, :1]
            f, density = welch(record[:, 0], 1 / period, nperseg=2**19)
            edges = np.logspace(np.log10(0.05), np.log10(3000), 32)
            places = np.sqrt(edges[1:] * edges[:-1])
            means = [density[(f >= a) & (f < b)].mean() for a, b in pairwise(edges)]
            grid = np.logspace(np.log10(0.05), np.log10(3000), 200)
            spectrum.plot(
                grid, NOISE["spectral_density"](config, grid, period)[0], color=colour, label=name
            )
            spectrum.plot(places, means, ".", color=colour)
            predicted = NOISE["predicted_allan_deviation"](config, lengths, period)[0]
            allan.plot(lengths * period, predicted, color=colour, label=name)
            allan.plot(
                lengths * period, NOISE["allan_deviation"](record, lengths)[0], ".", color=colour
            )
        spectrum.set(
            xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel=r"density of $f_x$ [N²/Hz]"
        )
        spectrum.set_ylim(1e-9, None)
        allan.set(
            xscale="log", yscale="log", xlabel="averaging time [s]",
            ylabel=r"Allan deviation of $f_x$ [N]",
        )  # fmt: skip
        spectrum.legend(loc="lower left")
    return figure


def log_figure(folder: Path) -> Picture:
    """Draw |F| of the sample log's second record: measured, without weight, and of the contact."""
    sample_log_command(folder, quiet=True)
    load = identify_log(folder / "free.yaml").identification
    found = detect_log(folder / "touched.yaml", load, free=folder / "free.yaml")
    log = found.eliminated
    assert log.gravity_only is not None  # its pose is known
    curves = (
        ("measured, without offsets", log.measured, GREY),
        ("without the weight", log.gravity_only, ORANGE),
        ("contact force", log.contact, BLUE),
    )
    with plot_style():
        figure = Picture(figsize=(8.2, 2.8), facecolor="white")
        axes = figure.subplots()
        for name, wrench, colour in curves:
            axes.plot(log.log.t, np.linalg.norm(wrench[:, :3], axis=1), color=colour, label=name)
        shade_contact(axes, log.log.t, found.touched)
        axes.set(xlabel="time [s]", ylabel="$|F|$ [N]", xlim=(0, 9), ylim=(0, None))
        figure.legend(loc="outside upper center", ncols=3)
    return figure


def film_picture(film: Path, time: float, target: Path) -> None:
    """Save the picture of a 3D replay at a time [s]."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        print(f"{target} stays as it is: there is no Chromium")
        return
    options = ("--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=1200,760")
    drawing = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    subprocess.run(
        [chromium, *options, *drawing, "--virtual-time-budget=4000", f"--screenshot={target}",
         f"{film.resolve().as_uri()}#{time:g}"],
        check=True, capture_output=True, timeout=300,
    )  # fmt: skip


def notebook_picture(name: str, cell: int, target: Path) -> None:
    """Save the picture of a cell of an executed notebook."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, resources={"metadata": {"path": str(NOTEBOOKS)}}).execute()
    (picture,) = (
        output.data["image/png"]
        for output in notebook.cells[cell].outputs
        if "image/png" in output.get("data", {})
    )
    target.write_bytes(b64decode(picture))


def main() -> None:
    FIGURES.mkdir(exist_ok=True)
    notebook_picture("02_delay_and_passivity", 3, FIGURES / "round_trips.png")
    notebook_picture("03_stability_and_transparency", 15, FIGURES / "stability_map.png")
    # Without date and random ids, so that the same script draws the same file.
    with mpl.rc_context({"svg.hashsalt": "drake_teleop"}):
        station_figure().savefig(FIGURES / "station.svg", metadata={"Date": None})
        frames_figure().savefig(FIGURES / "frames.svg", metadata={"Date": None})
        station_frames_figure().savefig(FIGURES / "station_frames.svg", metadata={"Date": None})
        signs_figure().savefig(FIGURES / "signs.svg", metadata={"Date": None})
        noise_figure().savefig(FIGURES / "sensor_noise.svg", metadata={"Date": None})
    with tempfile.TemporaryDirectory() as folder:
        log_figure(Path(folder) / "sample").savefig(FIGURES / "log.png")
        reproduce_command(Path(folder))
        shutil.copy(Path(folder) / "fig8.png", FIGURES / "result.png")
        # Time of the largest deflection of the leaf.
        film_picture(Path(folder) / "replay.html", 0.24, FIGURES / "scene.png")
        excite_command("identification", Path(folder) / "excite", quiet=True)
        film_picture(Path(folder) / "excite" / "excitation.html", 1.0, FIGURES / "excitation.png")


if __name__ == "__main__":
    main()
