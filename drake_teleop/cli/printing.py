"""Printed results of `identify`, `eliminate`, `detect` and `parts`."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

from drake_teleop.load.identification import PARAMETER_NAMES


def print_identification(summary: dict[str, Any], out: Path) -> None:
    from rich.table import Table

    table = Table(title=f"Load identified from {Path(summary['log']).name}", title_justify="left")
    for heading in ("", "value", "std", "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    _add_parameter_rows(table, _load_rows(summary), summary["identifiable"])
    rows = [
        (name, value, std, 1.0, "N" if i < 3 else "N m", name)
        for i, (name, value, std) in enumerate(
            zip(PARAMETER_NAMES[:6], summary["offsets"], summary["offsets_std"], strict=True)
        )
    ]
    _add_parameter_rows(table, rows, summary["identifiable"])
    if "object" in summary:
        table.add_section()
        rows = [(f"object: {row[0]}", *row[1:]) for row in _load_rows(summary["object"])]
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


def _load_rows(load: dict[str, Any]) -> list[_ParameterRow]:
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


def print_elimination(summary: dict[str, Any], out: Path) -> None:
    from rich.table import Table

    table = Table(title=f"Contact wrench in {Path(summary['log']).name}", title_justify="left")
    for heading in ("rms of", "|F| [N]", "|tau| [N m]"):
        table.add_column(heading, justify="left" if heading == "rms of" else "right")
    for label, name in (
        ("measured, without offsets", "raw"),
        ("less static weight only", "gravity_only"),
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


def print_detection(summary: dict[str, Any], out: Path) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=f"Contact in {Path(summary['log']).name}", title_justify="left")
    for heading in ("from [s]", "to [s]", "|F| [N]", "|tau| [N m]", "direction in S"):
        table.add_column(escape(heading), justify="right")
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
    """Print a table, a text, the delay, the notes and the output folder."""
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

    for module in (
        "load.batch.methods",
        "logs.read.table_files",
        "robots.connections",
        "robots.export",
        "station.scenario",
    ):
        import_module(f"drake_teleop.{module}")
    for kind, table in sorted(REGISTRIES.items()):
        names = [name if name in table.shipped else f"{name}*" for name in table]
        click.echo(f"{kind}: {', '.join(names)}")
