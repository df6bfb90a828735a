"""Command `drake-teleop detect`: contacts in a log (names of figures: docs/detection.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.contact.noise_floor import STATISTICS
from drake_teleop.load.identification import Identification
from drake_teleop.logs.contact import MIN_SAMPLES, Detection
from drake_teleop.logs.processing import EliminatedLog, eliminate_log, identify_log


@dataclass(frozen=True)
class DetectedLog(Detection):
    """Contacts of a log, and the log after removal of the load's wrench (`eliminated`)."""

    eliminated: EliminatedLog = field(kw_only=True)


def detect_log(
    path: str | Path,
    load: str | Path | Identification | None = None,
    *,
    free: str | Path | None = None,
    statistic: str = "level",
    cutoff_hz: float = 30.0,
    delay: str | float = "auto",
) -> DetectedLog:
    """Find contact in a log, after a zero-phase low-pass.

    Args:
        path: canonical table or log description.
        load: identification.json or its content; None: load identified from the log itself.
        free: log of equally fast free motion with the same load; None: calm parts of the log
            itself.
        statistic: "level", "cusum" or "glr".
        cutoff_hz: cut-off of the low-pass.
        delay: delay of the motion behind the wrench [s], or "auto".
    """
    if load is None:
        load = identify_log(path, cutoff_hz=cutoff_hz, delay=delay).identification
    elif not isinstance(load, Identification):
        load = Identification.load(load)
    found = eliminate_log(
        path, load, cutoff_hz=cutoff_hz, delay=delay, free=free, statistic=statistic
    )
    if found.log.static:
        raise DrakeTeleopError(
            "contains poses at rest, which have no contact", where=found.log.source
        )
    if found.detection is None:
        raise DrakeTeleopError(
            f"{len(found.log)} samples are too few to separate contact from noise",
            where=found.log.source,
            remedy=f"give a record of more than {MIN_SAMPLES} samples",
        )
    return DetectedLog(**vars(found.detection), eliminated=found)


def share_above_force(found: EliminatedLog, threshold: float) -> dict[str, Any]:
    """Return the share of samples with |F| > `threshold` [N], for raw and corrected wrenches."""
    wrenches = {
        "raw": found.measured - found.measured[0],
        "gravity_only": found.gravity_only,
        "eliminated": found.contact,
    }
    return {
        name: None
        if wrench is None
        else (np.linalg.norm(wrench[~found.edge, :3], axis=1) > threshold).mean()
        for name, wrench in wrenches.items()
    }


def draw_detection(found: DetectedLog) -> Any:
    """Draw |F| before and after removal of the load, and the statistic with its threshold."""
    from drake_teleop.common.style import BLACK, BLUE, ORANGE, Picture, plot_style, shade_contact

    eliminated = found.eliminated
    inner = ~eliminated.edge
    t = eliminated.log.t[inner]
    with plot_style():
        figure = Picture(figsize=(10, 6))
        top, below = figure.subplots(2, 1, sharex=True)
        raw = np.linalg.norm((eliminated.measured - eliminated.measured[0])[inner, :3], axis=1)
        top.plot(t, raw, color="#A3AAB5", label="measured, tared at the start")
        if eliminated.gravity_only is not None:
            weightless = np.linalg.norm(eliminated.gravity_only[inner, :3], axis=1)
            top.plot(t, weightless, color=ORANGE, label="static weight removed")
        contact = np.linalg.norm(eliminated.contact[inner, :3], axis=1)
        top.plot(t, contact, color=BLUE, label="contact")
        top.axhline(found.force_threshold, color=BLACK, linewidth=0.8, linestyle=":")
        top.set_yscale("symlog", linthresh=1.0)
        top.set_ylim(bottom=0.0)
        top.set_ylabel("$|F|$ [N]")
        top.set_title("dotted: the same threshold for all motions")
        below.plot(t, found.statistics[inner, STATISTICS.index(found.statistic)], color=BLUE)
        below.axhline(found.threshold, color=BLACK, linewidth=0.8, linestyle="--")
        below.set_ylabel(f"{found.statistic} [standard deviations]")
        below.set_xlabel("time [s]")
        below.set_title(f"above the threshold {100 * found.above.mean():.2g} % of the time")
        for axis in (top, below):
            shade_contact(axis, t, found.touched[inner])
        figure.legend(loc="outside lower center", ncols=3)
        figure.suptitle(Path(eliminated.log.source).name, x=0.01, ha="left", fontsize=11)
    return figure
