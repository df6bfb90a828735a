"""Clock drift between motion and wrench, from the load."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.check.edits import edit_field
from drake_teleop.logs.check.finding import Finding
from drake_teleop.logs.check.load_fit import load_fit
from drake_teleop.logs.check.log_data import LogData
from drake_teleop.logs.read.alignment import undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.delay import estimate_delay
from drake_teleop.logs.read.description import Description

PARTS, _FEWEST = 8, 4
_LEAST, _CROOKED = 0.03, 0.15
"""Smallest change of the delay [s]; largest deviation from a line, as a share of it."""
_BETTER = 0.5


def drift_finding(description: Description, data: LogData) -> tuple[list[Finding], Description]:
    """Return a finding for a steadily growing delay, and the corrected description."""
    name = "imu" if description.pose is None else "pose"
    stream = getattr(description, name)
    if stream is None or description.wrench is None or (description.imu and description.pose):
        return [], description
    log = data.thin(description)
    line = _line(log)
    if line is None:
        return [], description
    late, slope = line
    start = data.start(stream, description) - data.start(description.wrench, description)
    scale = 1.0 / (1.0 + slope)
    lag = scale * (late + slope * start)
    offset, factor = stream.time.offset - lag, scale * stream.time.scale
    edited = edit_field(description, f"{name}.time.offset", offset)
    edited = edit_field(edited, f"{name}.time.scale", factor)
    if _left(data.thin(edited)) > _BETTER * _left(log):
        return [], description
    finding = Finding(
        "clock",
        f"the clock of the {name} runs away from that of the wrench: {1e3 * slope:.3g} ms more"
        f" behind each second; set {name}.time.offset: {offset:.3f}"
        f" and {name}.time.scale: {factor:.6f}",
    )
    return [finding], edited


def _line(log: Log) -> tuple[float, float] | None:
    span = float(log.t[-1] - log.t[0])
    edges = np.linspace(0, len(log), PARTS + 1).astype(int)
    found = []
    for a, b in pairwise(edges):
        part = log.only(slice(int(a), int(b)))
        delay = estimate_delay(part, 15.0)
        if delay is not None:
            found.append((0.5 * float(part.t[0] + part.t[-1]), delay))
    if len(found) < _FEWEST:
        return None
    t, delays = np.array(found).T
    slope, late = np.polyfit(t, delays, 1)
    change = abs(slope) * span
    strays = float(np.std(delays - late - slope * t))
    if change < _LEAST or strays > _CROOKED * change or abs(slope) > 0.2:
        return None
    return float(late + slope * log.t[0]), float(slope)


def _left(log: Log) -> float:
    try:
        return load_fit(undelayed(log, estimate_delay(log, 15.0) or 0.0)).unexplained
    except DrakeTeleopError:
        return np.inf
