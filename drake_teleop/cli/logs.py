"""Commands `identify`, `eliminate` and `detect`: write the results, print a table."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.cli.printing import print_detection, print_elimination, print_identification
from drake_teleop.common import files
from drake_teleop.load.batch.methods import DEFAULT_METHOD
from drake_teleop.load.contact.noise_floor import STATISTIC_NAMES
from drake_teleop.load.identification import Identification, load_of_object
from drake_teleop.logs import figures, processing
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
    summary = figures.summarize_log(log, found, cutoff_hz, result.delay_s) | {
        "samples": result.samples,
        **figures.summarize_load(result),
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
        "loads": [figures.summarize_record_part(stretch) for stretch in found.loads],
    }
    if alone is not None:
        summary |= {"gripper": str(gripper), "object": figures.summarize_object_alone(alone)}
        summary["notes"] += figures.notes_on_object_alone(alone)
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
    gripper: Path | None = None,
    sigma: float = 0.0,
    sigma_object: float | None = None,
    gamma: float = 1.0,
    eta: float | None = None,
    offsets: str = "record",
    untouched_s: tuple[float, float] | None = None,
    sigma_weight: float | None = None,
    sigma_inertia: float | None = None,
    causal: str | None = None,
    causal_tare_s: float | None = None,
    free: Path | None = None,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    quiet: bool = False,
) -> dict[str, Any]:
    """Remove the load's wrench from a log, write the contact wrench, return the summary."""
    load_file = Identification.load(load)
    scales: dict[str, Any] = dict(sigma=sigma, sigma_object=sigma_object, gamma=gamma, eta=eta)
    scales |= dict(sigma_weight=sigma_weight, sigma_inertia=sigma_inertia)
    found = processing.eliminate_log(
        log,
        load_file,
        **scales,
        gripper=gripper,
        tare=offsets == "record",
        untouched_s=untouched_s,
        causal=causal,
        causal_tare_s=causal_tare_s,
        free=free,
        cutoff_hz=cutoff_hz,
        delay=delay,
    )
    summary = figures.summarize_log(log, found, cutoff_hz, found.delay_s) | {
        "load": str(load),
        "gripper": None if gripper is None else str(gripper),
        **scales,
        "free": None if free is None else str(free),
        "offsets_from": offsets,
        "untouched_s": untouched_s,
        "tare": found.offsets - load_file.offsets,
        "tare_fraction": found.tare_fraction,
    }
    if found.tare_fraction < 0.5:
        summary["notes"].append(
            "less than half of the record agrees on the sensor's offsets: if it is in contact most"
            " of the time, the contact wrench may be off by a constant"
        )
    if found.detection is not None:
        summary["notes"] += found.detection.notes
    elif not found.log.static:
        summary["notes"].append(f"{len(found.log)} samples are too few to tell contact from noise")
    summary = files.to_json_data(
        summary
        | figures.summarize_wrenches(found)
        | figures.summarize_detected_contact(found, causal_tare_s)
    )
    from drake_teleop.logs.pictures import draw_elimination

    with files.output_folder(out):
        files.write_table(out / "contact_wrench.parquet", _wrench_table(found))
        files.write_picture(out / "contact_wrench.png", draw_elimination(found))
        files.write_json(out / "summary.json", summary)
    if not quiet:
        print_elimination(summary, out)
    return summary


def _wrench_table(found: processing.EliminatedLog) -> pl.DataFrame:
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
    """Detect contact in a log, write statistics and contact flags, return the summary."""
    found = processing.detect_log(
        log, load, free=free, statistic=statistic, cutoff_hz=cutoff_hz, delay=delay
    )
    eliminated = found.eliminated
    summary = figures.summarize_log(log, eliminated, cutoff_hz, eliminated.delay_s) | {
        "load": None if load is None else str(load),
        "free": None if free is None else str(free),
        "free_s": found.free_duration_s,
        "statistic": statistic,
        "threshold": found.threshold,
        "noise": found.noise_floor.noise,
        "per_acceleration": found.noise_floor.per_acceleration,
        "above_threshold": found.is_above_threshold.mean(),
        "in_contact": found.touched.mean(),
        "force_threshold": found.force_threshold,
        "above_force_threshold": figures.shares_of_samples_above_force(
            eliminated, found.force_threshold
        ),
        "contacts": summarize_contacts(eliminated.log.t, eliminated.contact, found.touched),
    }
    summary["notes"] += found.notes
    summary = files.to_json_data(summary)
    from drake_teleop.logs.pictures import draw_detection

    with files.output_folder(out):
        files.write_table(out / "detection.parquet", _detection_table(found))
        files.write_picture(out / "detection.png", draw_detection(found))
        files.write_json(out / "summary.json", summary)
    if not quiet:
        print_detection(summary, out)
    return summary


def _detection_table(found: processing.DetectedLog) -> pl.DataFrame:
    import polars as pl

    columns: dict[str, NDArray[Any]] = {"t": found.eliminated.log.t}
    columns |= {name: found.statistics[:, i] for i, name in enumerate(STATISTIC_NAMES)}
    contact = found.eliminated.contact
    columns |= {f"contact_{c}": contact[:, i] for i, c in enumerate(WRENCH_COLUMNS)}
    return pl.DataFrame(columns | {"in_contact": found.touched, "edge": found.eliminated.edge})
