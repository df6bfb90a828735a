"""HTML report of the command `identify`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.files import write_text
from drake_teleop.common.html import png_data_url, render_page
from drake_teleop.load.batch.uncertainty import confidence_intervals
from drake_teleop.load.identification import Identification
from drake_teleop.logs.pictures import TEXT_OF_VERDICT
from drake_teleop.logs.processing import IdentifiedLog

PARAMETER_FORMATS = (
    *(("f", f"o,{axis}", "N", 1.0) for axis in "xyz"),
    *(("τ", f"o,{axis}", "N m", 1.0) for axis in "xyz"),
    ("m", "", "kg", 1.0),
    *(("m c", axis, "g m", 1e3) for axis in "xyz"),
    *(("I", axes, "g m²", 1e3) for axes in ("xx", "xy", "xz", "yy", "yz", "zz")),
)
"""Symbol, index, printed unit and its factor from SI of the parameters of Eq. (7)."""
_CSS_CLASS_OF_VERDICT = {"identified": "agrees", "not": "differs"}


@dataclass(frozen=True)
class ParameterRow:
    """Row of one parameter in the report, as text; numbers are in `unit`."""

    symbol: str
    index: str
    value: str
    deviation: str
    interval: str
    unit: str
    verdict: str
    pill: str


def parameter_rows(load: Identification) -> list[ParameterRow]:
    """Return the 16 rows of [offsets; phi], Eq. (7); unidentified parameters have no value."""
    theta = np.concatenate([load.offsets, load.phi])
    columns = np.stack([theta, load.standard_deviations, *confidence_intervals(load)], axis=1)
    rows = []
    for (symbol, index, unit, scale), values, verdict in zip(
        PARAMETER_FORMATS, columns, load.verdicts, strict=True
    ):
        words, pill = TEXT_OF_VERDICT[verdict], _CSS_CLASS_OF_VERDICT.get(verdict, "")
        texts = ("–", "", "")
        if verdict != "not" and np.isfinite(values).all():
            # Two digits of the uncertainty determine the decimals of the value.
            exponent = np.floor(np.log10(scale * values[1])) if values[1] > 0 else -3
            decimals = int(np.clip(1 - exponent, 0, 9))
            value, deviation, low, high = (f"{x:.{decimals}f}" for x in scale * values)
            texts = (value, deviation, f"{low} … {high}")
        rows.append(ParameterRow(symbol, index, *texts, unit, words, pill))
    return rows


def write_report(
    path: Path,
    identified: IdentifiedLog,
    summary: Mapping[str, Any],
    object_load: Identification | None = None,
) -> None:
    """Write the HTML report of an identification, with pictures fit.png and knowledge.png.

    `object_load` is the load of the object alone, if the gripper is known.
    """
    log, result = identified.log, identified.identification
    text = (
        "About the origin of the sensor frame S, in its axes. The intervals contain the true value"
        " in 95 of 100 records, if the residual is noise. Parameters that the record does not"
        " determine have no value."
    )
    tables = [("The load and the sensor's offsets", text, parameter_rows(result))]
    if object_load is not None:
        text = "The load minus the given gripper; the uncertainties of both are combined."
        tables.append(("The object alone", text, parameter_rows(object_load)[6:]))
    samples = f"{summary['samples']} poses at rest"
    if not log.static:
        samples = (
            f"{summary['samples']} samples, {summary['duration_s']:.1f} s at"
            f" {summary['rate_hz']:.4g} Hz; motion {1e3 * summary['delay_s']:.2f} ms behind the"
            f" wrench ({summary['delay_source']})"
        )
    if summary["rejected"] > 0:
        samples += f"; {summary['rejected']:.1%} of them rejected as disturbed, shaded below"
    fit = "Measured wrench and V φ, both without offsets, and their difference."
    identifiability = (
        f"Top: the residual at {'each pose' if log.static else 'each frequency'}. Below: each"
        " parameter with its interval, and its standard deviation, relative to a typical value for"
        " a load of this mass and size: identified up to 5 %, weakly identified up to 50 %, else"
        " not identified."
    )
    picture = png_data_url(path.parent / "knowledge.png")
    page = render_page(
        "drake_teleop.logs",
        "report.html.j2",
        name=Path(summary["log"]).name,
        setting=f"{samples}. Method: {result.method}.",
        tiles=_summary_tiles(result),
        notes=summary["notes"],
        tables=tables,
        determined=identified.base_parameters.text_lines(),
        figures=[
            ("Fit", png_data_url(path.parent / "fit.png"), fit),
            ("Residual, intervals and identifiability", picture, identifiability),
        ],
        summary=dict(summary),
    )
    write_text(path, page)


def _summary_tiles(load: Identification) -> list[tuple[str, str, str]]:
    deviation = load.standard_deviations[6]
    mass = f"{load.mass:.4g}" if load.identifiable[6] else "–"
    com = ", ".join(
        f"{1e3 * c:.1f}" if known else "–"
        for c, known in zip(load.com, load.identifiable[7:10] & load.identifiable[6], strict=True)
    )
    count = int(load.identifiable[6:].sum())
    force, torque = (np.linalg.norm(part) for part in np.split(load.residual_rms, 2))
    rms = "rms of the force and of the torque that the load does not explain"
    return [
        (mass, "kg", f"mass, ± {deviation:.2g} kg" if load.identifiable[6] else "mass"),
        (com, "mm", "centre of mass from the origin of S: x, y, z"),
        (f"{count} of 10", "", "parameters of the load are identified"),
        (f"{force:.2g} N, {torque:.2g}", "N m", rms),
    ]
