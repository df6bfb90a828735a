"""What `drake-teleop identify` and `drake-teleop eliminate` do, as functions.

Names in the summaries (and in summary.json); forces in N, torques in N m, frame S:

====================== ==========================================================================
both
====================== ==========================================================================
log                    the file that was read
samples, duration_s    samples used, and the time that they span
rate_hz                of the log on its common clock; 0 for static poses
cutoff_hz              zero-phase low-pass on everything; null if there was none
delay_s                how far the motion lags behind the wrench; it was moved forward by this
delay_source           "given", "estimated" (from this record), "load" (of the load file, because
                       this record does not determine it), "undetermined" (0 was used), or
                       "static" (poses at rest have none)
notes                  what had to be assumed, and the findings, in words
findings               list of name and message: suspected errors of the description; see
                       `drake_teleop.logs.check.inspection`. Only looked for if the fit is poor
====================== ==========================================================================

====================== ==========================================================================
identify
====================== ==========================================================================
mass, mass_std         kg; standard deviations are null for what is not determined at all
com, com_std           m; the standard deviation is of com with the mass held
inertia_com            kg m^2, about the centre of mass, axes of S
offsets, offsets_std   [f; tau]
phi, phi_std           Eq. (6), in the order of this project
phi_interval           (10, 2) ends of the 95 % intervals
verdicts               of each parameter: identified, weakly, not, prior; see
                       `drake_teleop.load.identification.Identification.verdicts`
identifiable           the names of what the record determines
not_identifiable       the names of what it does not: do not use their values
physically_consistent  whether phi belongs to a possible body
determined             in words: how many independent combinations of offsets and load the record
                       determines, which ones where single parameters are not, and what is weak
method                 of the fit, in words
rejected               share of the samples that a robust fit took for disturbed and left out
condition_number       of the regression
residual_rms           [f; tau], after the fit
residual_rms_force     of |F|
load_changes           list of t_s, mass_before, mass_after: where the load changes in the record,
                       so that one load for all of it is wrong
gripper                its file, if --gripper was given; otherwise this and the next are absent
object                 of phi_total - phi_gr: mass, com, inertia_com, phi with their standard
                       deviations, identifiable, not_identifiable and physically_consistent as
                       above; consistency_margin and consistency_margin_std, see
                       `drake_teleop.load.gripper.consistency_margin`
====================== ==========================================================================

========================= =======================================================================
eliminate
========================= =======================================================================
load, gripper             the identification files; gripper is null if there is none
sigma, sigma_object,      as given
gamma, eta
tare                      [f; tau], offsets of this record minus those of the load file
tare_fraction             share of the samples that the offsets were taken from (those that agree)
raw_rms                   rms of |F| with the offsets removed and nothing else
gravity_only_rms          rms of |F| with offsets and m g removed; null if no orientation is known
residual_rms              rms of |F_c|, the contact force: in free motion, what is left
residual_peak             largest |F_c|
raw_torque_rms ...        the same four of the torque
raw_rms_per_channel ...   the same four of each channel [f; tau]
noise_floor               [f; tau], standard deviation of the contact wrench where it is quiet
contacts                  list of start_s, stop_s, peak_N, peak_Nm: from where a channel exceeds 5.5
                          noise floors until all are below 4; null for static poses
in_contact                share of the samples in `contacts`; null for static poses
causal                    null, or, if --causal was given: mode, lag_s (by how much the output is
                          late, or would be without prediction), offsets, tare_s (length of the
                          start that they are of; null if of the load file), residual_rms,
                          noise_floor as above, and difference_rms, of |F_causal - F_c|
========================= =======================================================================
"""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drake_teleop.load.batch.methods import DEFAULT_METHOD
from drake_teleop.load.batch.uncertainty import intervals
from drake_teleop.load.gripper import SIGNIFICANT, consistency_margin, identified_object
from drake_teleop.load.identification import PARAMETERS, Identification
from drake_teleop.logs.contact import contacts_of, noise_floor
from drake_teleop.logs.processing import EliminatedLog, IdentifiedLog, eliminate_log, identify_log
from drake_teleop.logs.read.canonical import WRENCH


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
    """`identify_log`, writing its results into `out`.

    Files: identification.json; summary.json; report.html; fit.png and knowledge.png, its
    pictures; report.png, both on one page.

    Args:
        method: of the fit, one of `drake_teleop.load.batch.methods.METHODS`.
        gripper: identification.json of the gripper alone; then the object's object.json, of the
            same format, is written too (see `drake_teleop.load.gripper`).

    Returns:
        the summary; its names are explained at the top of this module.
    """
    gripper_load = None if gripper is None else Identification.load(gripper)
    found = identify_log(log, method=method, cutoff_hz=cutoff_hz, delay=delay)
    result = found.identification
    alone = None if gripper_load is None else identified_object(result, gripper_load)
    summary = common_figures(log, found, cutoff_hz, result.delay_s) | {
        "samples": result.samples,
        **_load_figures(result),
        "offsets": result.offsets,
        "offsets_std": result.standard_deviations[:6],
        "determined": found.base.lines(),
        "method": result.method,
        "rejected": found.rejected.mean(),
        "condition_number": result.condition_number,
        "residual_rms": result.residual_rms,
        "residual_rms_force": float(np.linalg.norm(result.residual_rms[:3])),
        "load_changes": [
            {
                "t_s": found.log.t[after.start],
                "mass_before": before.load.mass,
                "mass_after": after.load.mass,
            }
            for before, after in pairwise(found.loads)
        ],
    }
    if alone is not None:
        summary |= {"gripper": str(gripper), "object": _object_figures(alone)}
        summary["notes"] += _object_notes(alone)
    summary = plain(summary)
    from drake_teleop.logs.pictures import draw_fit, draw_knowledge, one_page
    from drake_teleop.logs.report import write_report

    out.mkdir(parents=True, exist_ok=True)
    result.save(out / "identification.json")
    if alone is not None:
        alone.save(out / "object.json")
    draw_fit(found).savefig(out / "fit.png")
    draw_knowledge(found).savefig(out / "knowledge.png")
    one_page(out / "fit.png", out / "knowledge.png", out / "report.png")
    write_report(out / "report.html", found, summary, alone)
    write_summary(out, summary)
    if not quiet:
        _print_identification(summary, out)
    return summary


def eliminate_command(
    log: Path,
    load: Path,
    out: Path,
    *,
    gripper: Path | None = None,
    sigma: float = 0.0,
    sigma_object: float | None = None,
    gamma: float = 1.0,
    eta: float | None = None,
    causal: str | None = None,
    causal_tare_s: float | None = None,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    quiet: bool = False,
) -> dict[str, Any]:
    """`eliminate_log`, writing contact_wrench.parquet, contact_wrench.png and summary.json.

    The Parquet table has `t` and, for each channel such as f_x, `contact_f_x`, `scaled_f_x`,
    `non_contact_f_x` and `measured_f_x` (offsets removed); with `causal` (see `eliminate_log`) also
    `causal_contact_f_x` and `causal_scaled_f_x`. The flag `in_contact` says where there is contact.

    Returns:
        the summary; its names are explained at the top of this module.
    """
    load_file = Identification.load(load)
    found = eliminate_log(
        log,
        load_file,
        gripper=gripper,
        sigma=sigma,
        sigma_object=sigma_object,
        gamma=gamma,
        eta=eta,
        causal=causal,
        causal_tare_s=causal_tare_s,
        cutoff_hz=cutoff_hz,
        delay=delay,
    )
    summary = common_figures(log, found, cutoff_hz, found.delay_s) | {
        "load": str(load),
        "gripper": None if gripper is None else str(gripper),
        "sigma": sigma,
        "sigma_object": sigma_object,
        "gamma": gamma,
        "eta": eta,
        "tare": found.offsets - load_file.offsets,
        "tare_fraction": found.tare_fraction,
    }
    if found.point_mass:
        summary["notes"].append(
            f"{', '.join(found.point_mass)} of the load file are not identifiable: those of a point"
            " mass are used"
        )
    if found.tare_fraction < 0.5:
        summary["notes"].append(
            "less than half of the record agrees on the sensor's offsets: if it is in contact most"
            " of the time, the contact wrench may be off by a constant"
        )
    summary = plain(summary | _rms_figures(found) | _contact_figures(found, causal_tare_s))
    from drake_teleop.logs.pictures import draw_elimination

    out.mkdir(parents=True, exist_ok=True)
    _write_wrenches(found, out / "contact_wrench.parquet")
    draw_elimination(found).savefig(out / "contact_wrench.png")
    write_summary(out, summary)
    if not quiet:
        _print_elimination(summary, out)
    return summary


def common_figures(
    path: Path, found: IdentifiedLog | EliminatedLog, cutoff_hz: float | None, delay_s: float
) -> dict[str, Any]:
    log = found.log
    findings = [{"name": finding.name, "message": finding.message} for finding in found.findings]
    return {
        "log": str(path),
        "samples": len(log),
        "duration_s": 0.0 if log.static else float(log.t[-1] - log.t[0]),
        "rate_hz": 0.0 if log.static else 1 / log.dt,
        "cutoff_hz": None if log.static else cutoff_hz,
        "delay_s": delay_s,
        "delay_source": found.delay_source,
        "notes": [*log.notes, *(f"{f['name']}: {f['message']}" for f in findings)],
        "findings": findings,
    }


def _load_figures(load: Identification) -> dict[str, Any]:
    deviations = load.standard_deviations
    ends = intervals(load)
    return {
        "mass": load.mass,
        "mass_std": deviations[6],
        "com": load.com,
        "com_std": deviations[7:10] / load.mass,
        "inertia_com": load.inertia_com,
        "phi": load.phi,
        "phi_std": deviations[6:],
        "phi_interval": np.stack(ends, axis=1)[6:],
        "verdicts": dict(zip(PARAMETERS, load.verdicts, strict=True)),
        "identifiable": _named(load, True),
        "not_identifiable": _named(load, False),
        "physically_consistent": load.physically_consistent,
    }


def _object_figures(alone: Identification) -> dict[str, Any]:
    margin, deviation = consistency_margin(alone)
    figures = _load_figures(alone)
    for name in ("identifiable", "not_identifiable"):
        figures[name] = [entry for entry in figures[name] if entry in PARAMETERS[6:]]
    return figures | {"consistency_margin": margin, "consistency_margin_std": deviation}


def _object_notes(alone: Identification) -> list[str]:
    """What to know about the object; the mass is not significantly negative here."""
    deviation = float(alone.standard_deviations[6])
    if alone.mass < SIGNIFICANT * deviation:
        return [
            f"no object: the gripper's mass is exceeded by {alone.mass:.4g} ± {deviation:.2g} kg"
        ]
    if not alone.identifiable[6:].all() or alone.physically_consistent:
        return []
    margin, deviation = consistency_margin(alone)
    if margin < -SIGNIFICANT * deviation:
        return [
            "no body can have the object's parameters: were gripper and total identified about the"
            " same sensor frame, with the same gripper?"
        ]
    return ["the object's parameters are those of a possible body within their uncertainty only"]


def _named(result: Identification, identifiable: bool) -> list[str]:
    pairs = zip(PARAMETERS, result.identifiable, strict=True)
    return [name for name, flag in pairs if bool(flag) == identifiable]


def _rms_figures(found: EliminatedLog) -> dict[str, Any]:
    def rms(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sqrt(np.mean(x**2, axis=0))

    def peak(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.abs(x).max(axis=0)

    return (
        _reduced("raw", "rms", found.measured, rms)
        | _reduced("gravity_only", "rms", found.gravity_only, rms)
        | _reduced("residual", "rms", found.contact, rms)
        | _reduced("residual", "peak", found.contact, peak)
    )


def _contact_figures(found: EliminatedLog, causal_tare_s: float | None) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "noise_floor": found.noise_floor,
        "contacts": None,
        "in_contact": None,
        "causal": None,
    }
    if not found.log.static:
        touches = contacts_of(found.log.t, found.contact, found.touched)
        figures["contacts"] = [
            {
                "start_s": touch.start_s,
                "stop_s": touch.stop_s,
                "peak_N": touch.peak_force,
                "peak_Nm": touch.peak_torque,
            }
            for touch in touches
        ]
        figures["in_contact"] = found.touched.mean()
    if found.causal is not None:
        late = found.causal.contact

        def force_rms(wrench: NDArray[np.float64]) -> float:
            return float(np.sqrt(np.mean(np.sum(wrench[:, :3] ** 2, axis=1))))

        figures["causal"] = {
            "mode": found.causal.mode,
            "lag_s": found.causal.lag_s,
            "tare_s": causal_tare_s,
            "offsets": found.causal.offsets,
            "residual_rms": force_rms(late),
            "noise_floor": noise_floor(late),
            "difference_rms": force_rms(late - found.contact),
        }
    return figures


def _reduced(
    name: str,
    suffix: str,
    wrench: NDArray[np.float64] | None,
    reduce: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> dict[str, Any]:
    keys = (f"{name}_{suffix}", f"{name}_torque_{suffix}", f"{name}_{suffix}_per_channel")
    if wrench is None:
        return dict.fromkeys(keys)
    norms = [reduce(np.linalg.norm(part, axis=1)) for part in (wrench[:, :3], wrench[:, 3:])]
    return dict(zip(keys, [*norms, reduce(wrench)], strict=True))


def plain(value: Any) -> Any:
    """The same with lists and numbers of Python instead of numpy's, and null for infinity."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    return None if value in (float("inf"), float("-inf")) else value


def write_summary(out: Path, summary: dict[str, Any]) -> None:
    (out / "summary.json").write_text(
        json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8"
    )


def _write_wrenches(found: EliminatedLog, path: Path) -> None:
    import polars as pl

    columns: dict[str, NDArray[Any]] = {"t": found.log.t}
    for name in ("contact", "scaled", "non_contact", "measured"):
        values = getattr(found, name)
        columns |= {f"{name}_{c}": values[:, i] for i, c in enumerate(WRENCH)}
    if found.causal is not None:
        for name in ("contact", "scaled"):
            values = getattr(found.causal, name)
            columns |= {f"causal_{name}_{c}": values[:, i] for i, c in enumerate(WRENCH)}
    columns["in_contact"] = found.touched
    pl.DataFrame(columns).write_parquet(path)


def _print_identification(summary: dict[str, Any], out: Path) -> None:
    from rich.table import Table

    table = Table(title=f"Load identified from {Path(summary['log']).name}", title_justify="left")
    for heading in ("", "value", "std", "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    _add_rows(table, _load_rows(summary), summary["identifiable"])
    rows = [
        (name, value, std, 1.0, "N" if i < 3 else "N m", name)
        for i, (name, value, std) in enumerate(
            zip(PARAMETERS[:6], summary["offsets"], summary["offsets_std"], strict=True)
        )
    ]
    _add_rows(table, rows, summary["identifiable"])
    if "object" in summary:
        table.add_section()
        rows = [(f"object: {row[0]}", *row[1:]) for row in _load_rows(summary["object"])]
        _add_rows(table, rows, summary["object"]["identifiable"])
    figures = (
        f"residual {summary['residual_rms_force']:.4g} N rms of |F|,"
        f" condition number {summary['condition_number']:.3g}, {summary['samples']} samples"
    )
    if summary["rejected"] > 0:
        figures += f"; {summary['rejected']:.1%} of them rejected as disturbed"
    print_results(table, figures, summary, out)


_Row: TypeAlias = tuple[str, float, float, float, str, str]
"""Label, value, standard deviation, how many of the unit make one of SI, unit, parameter."""


def _load_rows(load: dict[str, Any]) -> list[_Row]:
    rows: list[_Row] = [("mass", load["mass"], load["mass_std"], 1.0, "kg", "m")]
    rows += [
        (f"com {axis}", load["com"][i], load["com_std"][i], 1e3, "mm", f"m c_{axis}")
        for i, axis in enumerate("xyz")
    ]
    return rows + [
        (name, load["phi"][4 + i], load["phi_std"][4 + i], 1e3, "g m^2", name)
        for i, name in enumerate(PARAMETERS[10:])
    ]


def _add_rows(table: Any, rows: list[_Row], identifiable: list[str]) -> None:
    for label, value, std, scale, unit, name in rows:
        if name in identifiable:
            table.add_row(label, f"{value * scale:.4f}", f"{std * scale:.4f}", unit)
        else:
            table.add_row(f"[dim]{label}", "[dim]not identifiable", "", "")


def _print_elimination(summary: dict[str, Any], out: Path) -> None:
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
    figures = f"largest contact force {summary['residual_peak']:.4g} N"
    contacts = summary["contacts"]
    if contacts:
        first = ", ".join(f"{c['start_s']:.3f}" for c in contacts[:5])
        more = " ..." if len(contacts) > 5 else ""
        figures += f"; {len(contacts)} contacts, from {first}{more} s"
    elif contacts is not None:
        figures += "; no contact found"
    causal = summary["causal"]
    if causal is not None:
        late = "late" if causal["mode"] == "delayed" else "made up for by prediction"
        figures += (
            f"\ncausal: {1e3 * causal['lag_s']:.1f} ms {late},"
            f" rms of |F| {causal['residual_rms']:.4g} N"
        )
    print_results(table, figures, summary, out)


def print_results(table: Any, figures: str, summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console

    lines = [figures]
    if summary["delay_source"] != "static":
        delay = f"{summary['delay_s'] * 1e3:.2f} ms behind the wrench ({summary['delay_source']})"
        lines.append(f"motion {delay}")
    lines += [f"note: {note}" for note in summary["notes"]]
    console = Console()
    console.print(table)
    for line in [*lines, f"written to {out}"]:
        console.print(line, highlight=False, markup=False)
