"""`drake-teleop calibrate`: guided identification of the load from a live stream."""

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
from drake_teleop.common import files
from drake_teleop.common.style import BLACK, COLOURS, GREY, Picture, plot_style
from drake_teleop.load import tolerance as tolerances
from drake_teleop.robots.calibration import DEFAULT_TOLERANCES_TEXT, RecordEvaluation, calibrate
from drake_teleop.robots.connections import open_source_and_recorder

_BAR_CHARACTERS, _BAR_DECADES = 24, 3.0  # of a bar; of half-width over tolerance


def calibrate_command(
    source: str,
    out: Path,
    *,
    until: str = DEFAULT_TOLERANCES_TEXT,
    sensor_range: tuple[float, float] | None = None,
    seconds: float = 120.0,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    quiet: bool = False,
    **stream_options: Any,
) -> dict[str, Any]:
    """Identify a load from a live source; write the results into `out` and return the summary.

    `until`: required accuracy; `sensor_range`: force [N] and torque [N m]; `seconds`: record limit.
    """
    tolerance = tolerances.parse_tolerance(until)
    files.make_folder(out)
    limits = None if sensor_range is None else np.repeat(sensor_range, 3)
    stream, recorder = open_source_and_recorder(source, limits, **stream_options)
    path = out / recorder.log_file_name
    console = Console(stderr=True, quiet=quiet)
    processing: dict[str, Any] = {"cutoff_hz": cutoff_hz, "delay": delay}
    try:
        files.refuse_to_replace_inputs(path, *stream.files)
        with Live(console=console, auto_refresh=False) as live:

            def show_progress(evaluation: RecordEvaluation) -> None:
                live.update(make_progress_display(evaluation, tolerance), refresh=True)

            evaluations = calibrate(
                stream, recorder, path, tolerance, seconds=seconds, show=show_progress, **processing
            )
    finally:
        stream.close()
    last = evaluations[-1]
    summary = identify_command(path, out, quiet=True, **processing)
    files.write_picture(out / "settling.png", draw_accuracy(evaluations, tolerance))
    names = tolerance.required_entry_names
    summary |= {
        "tolerance": str(tolerance),
        "known": dict(zip(names, last.is_known.tolist(), strict=True)),
        "all_known": bool(last.is_known.all()),
        "half_widths_95": dict(zip(names, last.relative_half_widths.tolist(), strict=True)),
        "doubts": list(last.doubts),
        "advice": last.advice,
        "seconds": last.record_length_s,
        "looks": len(evaluations),
        "left_out": recorder.left_out,
        "clock_changes": recorder.clock_changes,
    }
    files.write_json(out / "summary.json", summary)
    verdict = "known" if summary["all_known"] else "[bold red]not known[/]"
    console.print(f"{verdict} after {last.record_length_s:.1f} s: {tolerance}", highlight=False)
    console.print(f"written to {out}", highlight=False, markup=False)
    return summary


def make_progress_display(evaluation: RecordEvaluation, tolerance: tolerances.Tolerance) -> Group:
    table = Table(title=f"{evaluation.record_length_s:.1f} s recorded", title_justify="left")
    table.add_column("")
    for heading in ("value", "+- (95 %)", "required", "unit"):
        table.add_column(heading, justify="left" if heading == "unit" else "right")
    table.add_column("settled", width=_BAR_CHARACTERS)
    table.add_column("verdict")
    # The first word of an entry's name is its quantity.
    entries = [entry.split()[0] for entry in tolerance.required_entry_names]
    units = [tolerances.QUANTITY_UNITS[name] for name in entries]
    values = sizes = np.full(len(units), np.nan)
    if evaluation.identified_log is not None:
        phi = evaluation.identified_log.identification.phi
        values = tolerances.display_values_of_required_entries(tolerance, phi)
        sizes = tolerances.tolerances_in_display_units(tolerance, phi)
    for k, entry in enumerate(tolerance.required_entry_names):
        half = evaluation.relative_half_widths[k]
        numbers = [f"{x:.4g}" if np.isfinite(x) else "?" for x in (values[k], half * sizes[k])]
        table.add_row(
            *(entry, *numbers, f"{sizes[k]:.3g}" if np.isfinite(sizes[k]) else "?", units[k]),
            _make_accuracy_bar(half, is_known=bool(evaluation.is_known[k])),
            _describe_parameter_accuracy(evaluation, k),
        )
    lines = [Text(line, style="red") for line in (*evaluation.doubts, evaluation.failure) if line]
    if evaluation.advice:
        lines.append(Text(f"-> {evaluation.advice}", style="bold"))
    return Group(table, *lines)


def _make_accuracy_bar(relative_half_width: float, *, is_known: bool) -> Text:
    share = 1.0 - np.log10(np.clip(relative_half_width, 1.0, None)) / _BAR_DECADES
    cells = int(np.clip(np.nan_to_num(share), 0.0, 1.0) * _BAR_CHARACTERS)
    colour = "green" if is_known else "yellow"
    return Text("█" * cells + "·" * (_BAR_CHARACTERS - cells), style=colour)


def _describe_parameter_accuracy(evaluation: RecordEvaluation, index: int) -> str:
    if evaluation.is_known[index]:
        return "known"
    if not np.isfinite(evaluation.relative_half_widths[index]):
        return "not known: no information yet"
    if evaluation.doubts:
        return "not known: see the text below"
    return "almost known" if evaluation.relative_half_widths[index] <= 1.0 else "not known"


def draw_accuracy(evaluations: list[RecordEvaluation], tolerance: tolerances.Tolerance) -> Figure:
    with plot_style():
        figure = Picture(figsize=(9, 5.5))
        axes = figure.subplots()
        t = np.array([at.record_length_s for at in evaluations])
        halves = np.array([at.relative_half_widths for at in evaluations])
        for k, entry in enumerate(tolerance.required_entry_names):
            style = ("-", "--")[k // len(COLOURS) % 2]
            finite = np.isfinite(halves[:, k])
            colour = COLOURS[k % len(COLOURS)]
            axes.plot(t[finite], halves[finite, k], style, marker=".", color=colour, label=entry)
        axes.axhline(1.0, color=BLACK, linestyle=":")
        last = ""
        for at in evaluations:
            if at.advice and at.advice != last:
                x, last, transform = at.record_length_s, at.advice, axes.get_xaxis_transform()
                axes.axvline(x, color=GREY, linewidth=0.6)
                words = at.advice.split(",")[0].split(":")[0].replace(" the wrist", "")
                axes.text(x, 0.02, words, rotation=90, size=7, transform=transform)
        axes.set_title("Half-width of the 95 % confidence interval / tolerance")
        axes.set(xlabel="length of the record [s]", yscale="log")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
