"""`drake-teleop calibrate`: identify the load from a stream until it is known, with advice.

Files in the output folder, beside those of `identify`:

============= ==================================================================================
log.parquet   the recorded log, for `identify log.parquet`; log.yaml with a table for each stream
              if the source delivers poses or an IMU
settling.png  half-widths of the intervals over time, with the advice
summary.json  that of `identify`, with "tolerance", "known" (by name), "all_known",
              "half_widths_95" divided by the tolerances, "doubts", "looks"
============= ==================================================================================
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from drake_teleop.cli.logs import identify_command
from drake_teleop.common.style import BLACK, COLOURS, GREY, Picture, house_style
from drake_teleop.common.writing import make_folder, write_json, write_picture
from drake_teleop.load.tolerance import (
    QUANTITIES,
    UNITS,
    Tolerance,
    read_tolerance,
    sizes_of,
    values_of,
)
from drake_teleop.robots.assembly import SensorPoseOfJoints
from drake_teleop.robots.calibration import DEFAULT_TOLERANCE, Evaluation, calibrate
from drake_teleop.robots.connections import open_recording

_BAR, _DECADES = 24, 3.0  # cells, and decades of the half-width over the tolerance


def calibrate_command(
    source: str,
    out: Path,
    *,
    until: str = DEFAULT_TOLERANCE,
    largest: tuple[float, float] | None = None,
    seconds: float = 120.0,
    real_time: bool = False,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    motion: str | None = None,
    sensor_pose: tuple[float, ...] | None = None,
    arm: SensorPoseOfJoints | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """The command `calibrate`; see the top of this module.

    Args:
        source, real_time, motion, sensor_pose: see `open_source`.
        out: the folder.
        until: see `read_tolerance`.
        largest: the sensor's range [N], [N m].
        seconds, cutoff_hz, delay: see `calibrate`.
        arm: as for `compensate_command`.
        quiet: no table.

    Returns:
        the summary.

    Raises:
        DrakeTeleopError: if one of them cannot be used, or nothing of a load is in the record.
    """
    tolerance = read_tolerance(until)
    make_folder(out)
    limits = None if largest is None else np.repeat(largest, 3)
    stream, recorder = open_recording(
        source, limits, real_time=real_time, motion=motion, sensor_pose=sensor_pose, arm=arm
    )
    console = Console(stderr=True, quiet=quiet)
    options = {"cutoff_hz": cutoff_hz, "delay": delay, "seconds": seconds}
    try:
        with Live(console=console, auto_refresh=False) as live:

            def show(at: Evaluation) -> None:
                live.update(shown(at, tolerance), refresh=True)

            path = out / recorder.file
            looks = calibrate(stream, recorder, path, tolerance, show=show, **options)  # type: ignore[arg-type]
    finally:
        stream.close()
    last = looks[-1]
    summary = identify_command(path, out, cutoff_hz=cutoff_hz, delay=delay, quiet=True)
    write_picture(out / "settling.png", draw_settling(looks, tolerance))
    summary |= {
        "tolerance": str(tolerance),
        "known": dict(zip(tolerance.entries, last.known.tolist(), strict=True)),
        "all_known": bool(last.known.all()),
        "half_widths_95": dict(zip(tolerance.entries, last.half.tolist(), strict=True)),
        "doubts": list(last.doubts),
        "advice": last.advice,
        "seconds": last.t,
        "looks": len(looks),
        "left_out": recorder.left_out,
        "began_anew": recorder.began_anew,
    }
    write_json(out / "summary.json", summary)
    if summary["all_known"]:
        console.print(f"known after {last.t:.1f} s: {tolerance}", highlight=False)
    else:
        console.print(f"[bold red]not known[/] after {last.t:.1f} s: {tolerance}", highlight=False)
    console.print(f"written to {out}", highlight=False, markup=False)
    return summary


def shown(at: Evaluation, tolerance: Tolerance) -> Group:
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


def _verdict(at: Evaluation, k: int) -> str:
    if at.known[k]:
        return "known"
    if not np.isfinite(at.half[k]):
        return "not known: nothing tells it yet"
    if at.doubts:
        return "not known: see below"
    return "almost" if at.half[k] <= 1.0 else "not known"


def draw_settling(looks: list[Evaluation], tolerance: Tolerance) -> Figure:
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
