"""Commands `identify`, `eliminate`, `detect` and `parts`, and their printed tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common import files
from drake_teleop.load.batch.methods import DEFAULT_METHOD
from drake_teleop.load.contact.detection import MIN_NOISE_FLOOR_SAMPLES
from drake_teleop.load.contact.noise_floor import STATISTIC_NAMES
from drake_teleop.load.identification import PARAMETER_NAMES, Identification, load_of_object
from drake_teleop.logs import processing, summaries
from drake_teleop.logs.contact import summarize_contacts
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS

if TYPE_CHECKING:
    import polars as pl


def identify_command(
    log: Path,
    out: Path,
    *,
    gripper: Path | None = None,
    method: str = DEFAULT_METHOD,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    quiet: bool = False,
) -> dict[str, Any]:
    """Identify the load of a log, write the results into `out`, return the summary."""
    gripper_load = None if gripper is None else Identification.load(gripper)
    found = processing.identify_log(log, method=method, cutoff_hz=cutoff_hz, delay=delay)
    result = found.identification
    alone = None if gripper_load is None else load_of_object(result, gripper_load)
    summary = summaries.summarize_log(log, found, cutoff_hz, result.delay_s) | {
        "samples": result.samples,
        **summaries.summarize_load(result),
        "offsets": result.offsets,
        "offsets_std": result.standard_deviations[:6],
        "determined": found.base_parameters.text_lines(),
        "method": result.method,
        "rejected": found.rejected.mean(),
        "condition_number": result.condition_number,
        "residual_rms": result.residual_rms,
        "residual_rms_force": float(np.linalg.norm(result.residual_rms[:3])),
        "residual_rms_torque": float(np.linalg.norm(result.residual_rms[3:])),
        "causes": [asdict(cause) for cause in found.causes],
        "loads": [summaries.summarize_record_part(part) for part in found.loads],
    }
    if alone is not None:
        summary |= {"gripper": str(gripper), "object": summaries.summarize_grasped_object(alone)}
        summary["notes"] += summaries.notes_on_grasped_object(alone)
    summary = files.to_json_data(summary)
    from drake_teleop.logs.pictures import draw_fit, draw_spectrum_and_intervals, stack_pictures
    from drake_teleop.logs.report import write_report

    with files.output_folder(out):
        result.save(out / "identification.json")
        if alone is not None:
            alone.save(out / "object.json")
        files.write_picture(out / "fit.png", draw_fit(found))
        files.write_picture(out / "knowledge.png", draw_spectrum_and_intervals(found))
        stack_pictures(out / "fit.png", out / "knowledge.png", out / "report.png")
        write_report(out / "report.html", found, summary, alone)
        files.write_json(out / "summary.json", summary)
    if not quiet:
        print_identification(summary, out)
    return summary


def eliminate_command(
    log: Path,
    load: Path,
    out: Path,
    *,
    offsets: str = "record",
    cutoff_hz: float | None = 30.0,
    quiet: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Remove the load's wrench from a log, write the contact wrench, return the summary.

    `offsets` is their source: "record" or "load".
    """
    load_file = Identification.load(load)
    tare = offsets == "record"
    found = processing.eliminate_log(log, load_file, tare=tare, cutoff_hz=cutoff_hz, **options)
    scales: dict[str, Any] = {"sigma": 0.0, "sigma_object": None, "gamma": 1.0, "eta": None}
    scales |= {"sigma_weight": None, "sigma_inertia": None}
    summary = summaries.summarize_log(log, found, cutoff_hz, found.delay_s) | {
        "load": str(load),
        "gripper": options.get("gripper") and str(options["gripper"]),
        **{name: options.get(name, default) for name, default in scales.items()},
        "free": options.get("free") and str(options["free"]),
        "offsets_from": offsets,
        "untouched_s": options.get("untouched_s"),
        "tare": found.offsets - load_file.offsets,
        "tare_fraction": found.tare_fraction,
    }
    if found.tare_fraction < 0.5:
        summary["notes"].append(
            "less than half of the record has the same sensor offsets: if the tool is in contact"
            " most of the time, the contact wrench may have a constant error"
        )
    if found.detection is not None:
        summary["notes"] += found.detection.notes
    elif not found.log.static:
        few = f"contact flags are all False: {len(found.log)} samples are too few"
        required = f"record at least {MIN_NOISE_FLOOR_SAMPLES} besides both ends"
        summary["notes"].append(f"{few} to separate contact from noise; {required}")
    summary = files.to_json_data(
        summary
        | summaries.summarize_wrenches(found)
        | summaries.summarize_detected_contact(found, options.get("causal_tare_s"))
    )
    from drake_teleop.logs.pictures import draw_elimination

    with files.output_folder(out):
        files.write_table(out / "contact_wrench.parquet", _make_contact_wrench_table(found))
        files.write_picture(out / "contact_wrench.png", draw_elimination(found))
        files.write_json(out / "summary.json", summary)
    if not quiet:
        print_contact_wrench_summary(summary, out)
    return summary


def _make_contact_wrench_table(found: processing.EliminatedLog) -> pl.DataFrame:
    import polars as pl

    columns: dict[str, NDArray[Any]] = {"t": found.log.t}
    for name in ("contact", "scaled", "non_contact", "measured"):
        columns |= {f"{name}_{c}": getattr(found, name)[:, i] for i, c in enumerate(WRENCH_COLUMNS)}
    if found.causal is not None:
        for name in ("contact", "scaled"):
            values = getattr(found.causal, name)
            columns |= {f"causal_{name}_{c}": values[:, i] for i, c in enumerate(WRENCH_COLUMNS)}
    columns |= {"in_contact": found.touched, "edge": found.edge}
    return pl.DataFrame(columns)


def detect_command(
    log: Path,
    out: Path,
    *,
    load: Path | None = None,
    free: Path | None = None,
    statistic: str = "level",
    cutoff_hz: float = 30.0,
    delay: str | float = "auto",
    quiet: bool = False,
) -> dict[str, Any]:
    """Detect contact in a log by noise of `free` motion, write flags, return the summary."""
    found = processing.detect_log(
        log, load, free=free, statistic=statistic, cutoff_hz=cutoff_hz, delay=delay
    )
    eliminated = found.eliminated
    summary = summaries.summarize_log(log, eliminated, cutoff_hz, eliminated.delay_s) | {
        "load": load and str(load),
        "free": free and str(free),
        "free_s": found.free_duration_s,
        "statistic": statistic,
        "threshold": found.threshold,
        "noise": found.noise_floor.noise,
        "per_acceleration": found.noise_floor.per_acceleration,
        "above_threshold": found.is_above_threshold.mean(),
        "in_contact": found.touched.mean(),
        "force_threshold": found.force_threshold,
        "above_force_threshold": summaries.shares_of_samples_above_force(
            eliminated, found.force_threshold
        ),
        "contacts": summarize_contacts(eliminated.log.t, eliminated.contact, found.touched),
    }
    summary["notes"] += found.notes
    summary = files.to_json_data(summary)
    from drake_teleop.logs.pictures import draw_detection

    with files.output_folder(out):
        files.write_table(out / "detection.parquet", _make_contact_detection_table(found))
        files.write_picture(out / "detection.png", draw_detection(found))
        files.write_json(out / "summary.json", summary)
    if not quiet:
        print_contact_detection_summary(summary, out)
    return summary


def _make_contact_detection_table(found: processing.DetectedLog) -> pl.DataFrame:
    import polars as pl

    columns: dict[str, NDArray[Any]] = {"t": found.eliminated.log.t}
    columns |= {name: found.statistics[:, i] for i, name in enumerate(STATISTIC_NAMES)}
    contact = found.eliminated.contact
    columns |= {f"contact_{c}": contact[:, i] for i, c in enumerate(WRENCH_COLUMNS)}
    return pl.DataFrame(columns | {"in_contact": found.touched, "edge": found.eliminated.edge})


def _make_empty_table(
    title: str, summary: dict[str, Any], headings: Sequence[str], left_aligned: Sequence[str] = ()
) -> Any:
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=f"{title} {Path(summary['log']).name}", title_justify="left")
    for heading in headings:
        table.add_column(escape(heading), justify="left" if heading in left_aligned else "right")
    return table


def print_identification(summary: dict[str, Any], out: Path) -> None:
    headings = ("", "value", "std", "unit")
    table = _make_empty_table("Load identified from", summary, headings, left_aligned=("", "unit"))
    offsets, deviations, units = summary["offsets"], summary["offsets_std"], ["N", "N m"]
    rows = _make_parameter_rows(summary) + [
        (name, offsets[i], deviations[i], 1.0, units[i // 3], name)
        for i, name in enumerate(PARAMETER_NAMES[:6])
    ]
    _add_parameter_rows(table, rows, summary["identifiable"])
    if "object" in summary:
        table.add_section()
        rows = [(f"object: {row[0]}", *row[1:]) for row in _make_parameter_rows(summary["object"])]
        _add_parameter_rows(table, rows, summary["object"]["identifiable"])
    figures = (
        "com from, and inertia about, the origin So of the sensor frame S\n"
        f"residual {summary['residual_rms_force']:.4g} N rms of |F|,"
        f" {summary['residual_rms_torque']:.4g} N m rms of |tau|,"
        f" condition number {summary['condition_number']:.3g}, {summary['samples']} samples"
    )
    if summary["rejected"] > 0:
        figures += f"; {summary['rejected']:.1%} of them rejected as disturbed"
    print_table_and_notes(table, figures, summary, out)


_ParameterRow: TypeAlias = tuple[str, float, float, float, str, str]
"""Table row: label, value, standard deviation, factor from SI to the unit, unit, parameter."""


def _make_parameter_rows(load: dict[str, Any]) -> list[_ParameterRow]:
    rows: list[_ParameterRow] = [("mass", load["mass"], load["mass_std"], 1.0, "kg", "m")]
    rows += [
        (f"com {axis}", load["com"][i], load["com_std"][i], 1e3, "mm", f"m c_{axis}")
        for i, axis in enumerate("xyz")
    ]
    return rows + [
        (name, load["phi"][4 + i], load["phi_std"][4 + i], 1e3, "g m^2", name)
        for i, name in enumerate(PARAMETER_NAMES[10:])
    ]


def _add_parameter_rows(table: Any, rows: list[_ParameterRow], identifiable: list[str]) -> None:
    for label, value, std, scale, unit, name in rows:
        # The centre of mass is the moment over the mass.
        needed = {"m", name} if name.startswith("m c") else {name}
        if needed <= set(identifiable):
            table.add_row(label, f"{value * scale:.4f}", f"{std * scale:.4f}", unit)
        else:
            table.add_row(f"[dim]{label}", "[dim]not identifiable", "", "")


def print_contact_wrench_summary(summary: dict[str, Any], out: Path) -> None:
    headings = ("rms of", "|F| [N]", "|tau| [N m]")
    table = _make_empty_table("Contact wrench in", summary, headings, left_aligned=("rms of",))
    for label, name in (
        ("measured, without offsets", "raw"),
        ("less the static weight only", "gravity_only"),
        ("less the non-contact wrench", "residual"),
    ):
        force, torque = summary[f"{name}_rms"], summary[f"{name}_torque_rms"]
        if force is not None:
            table.add_row(label, f"{force:.4g}", f"{torque:.4g}")
    figures = (
        f"largest contact force {summary['residual_peak']:.4g} N,"
        f" torque {summary['residual_torque_peak']:.4g} N m"
    )
    contacts = summary["contacts"]
    if contacts:
        first = ", ".join(f"{c['start_s']:.3f}" for c in contacts[:5])
        more = " ..." if len(contacts) > 5 else ""
        figures += f"; {len(contacts)} contacts, from {first}{more} s"
    elif contacts is not None:
        figures += "; no contact found"
    causal = summary["causal"]
    if causal is not None:
        late = "late" if causal["mode"] == "delayed" else "compensated by prediction"
        figures += (
            f"\ncausal: {1e3 * causal['lag_s']:.1f} ms {late},"
            f" rms of |F| {causal['residual_rms']:.4g} N,"
            f" of |tau| {causal['residual_torque_rms']:.4g} N m"
        )
    print_table_and_notes(table, figures, summary, out)


def print_contact_detection_summary(summary: dict[str, Any], out: Path) -> None:
    headings = ("from [s]", "to [s]", "|F| [N]", "|tau| [N m]", "direction in S")
    table = _make_empty_table("Contact in", summary, headings)
    for c in summary["contacts"]:
        push = "" if c["push"] is None else " ".join(f"{x:+.2f}" for x in c["push"])
        table.add_row(
            f"{c['start_s']:.3f}", f"{c['stop_s']:.3f}", f"{c['peak_N']:.3g}",
            f"{c['peak_Nm']:.3g}", push,
        )  # fmt: skip
    if not summary["contacts"]:
        table.add_row("none", *[""] * 4)
    said = {"raw": "measured", "gravity_only": "without the weight", "eliminated": "contact"}
    shares = ", ".join(
        f"{said[name]} {100 * share:.3g} %"
        for name, share in summary["above_force_threshold"].items()
        if share is not None
    )
    figures = (
        f"above the threshold ({summary['statistic']} {summary['threshold']:.3g})"
        f" {100 * summary['above_threshold']:.3g} % of the time, in contact"
        f" {100 * summary['in_contact']:.3g} %\n"
        f"|F| above {summary['force_threshold']:.3g} N, of the time: {shares}"
    )
    print_table_and_notes(table, figures, summary, out)


def print_table_and_notes(table: Any, text: str, summary: dict[str, Any], out: Path) -> None:
    """Print a table, `text`, the motion delay and notes in `summary`, and the output folder."""
    from rich.console import Console

    lines = [text]
    if summary["delay_source"] != "static":
        delay = f"{summary['delay_s'] * 1e3:.2f} ms behind the wrench ({summary['delay_source']})"
        lines.append(f"motion {delay}")
    lines += [f"note: {note}" for note in summary["notes"]]
    console = Console()
    console.print(table)
    for line in [*lines, f"written to {out}"]:
        console.print(line, highlight=False, markup=False)


def print_registered_names() -> None:
    import click

    from drake_teleop.common.registry import REGISTRIES

    others = "robots.connections", "robots.export", "station.scenario"
    for module in ("load.batch.methods", "logs.read.table_files", *others):
        import_module(f"drake_teleop.{module}")
    for kind, table in sorted(REGISTRIES.items()):
        names = [name if name in table.shipped else f"{name}*" for name in table]
        click.echo(f"{kind}: {', '.join(names)}")
