"""A draft of a log description for a table whose columns nobody has described."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.read.tables import Table

_NAMES = {
    "time": r"^(t|time|timestamp|stamp|time_?stamp|sec|secs)(_?(s|ms|us|ns))?$",
    "force": r"^(f|force|forces?)[._ ]?[xyz]$",
    "torque": r"^(t|m|tau|torque|moment)[._ ]?[xyz]$",
    "specific_force": r"^(a|s|acc|accel|acceleration|linear_acceleration)[._ ]?[xyz]$",
    "angular_velocity": r"^(w|g|omega|gyro|gyr|angular_velocity)[._ ]?[xyz]$",
    "orientation": r"^(q|quat|quaternion|orientation)[._ ]?[wxyz]$",
    "position": r"^(p|pos|position)?[._ ]?[xyz]$",
}


def draft_description(table: Table, folder: Path) -> str:
    """A draft of a log description, guessed from names and magnitudes of a table's columns.

    Args:
        table: any table.
        folder: where the draft will be, which its path to the table starts from.

    Returns:
        YAML text whose first line says that it is a draft, and what was not found.
    """
    import yaml

    columns: dict[str, list[str]] = {
        key: [name for name in table.columns if re.match(pattern, name, re.IGNORECASE)]
        for key, pattern in _NAMES.items()
    }
    file = os.path.relpath(table.path, folder)
    time: dict[str, Any] = {"column": "FILL IN"}
    if columns["time"]:
        time = {"column": columns["time"][0], "unit": _time_unit(table, columns["time"][0])}
    wrench = {
        "file": file,
        "time": time,
        "force": {"columns": columns["force"] or ["FILL IN"] * 3},
        "torque": {"columns": columns["torque"] or ["FILL IN"] * 3},
        "sign": 1,
    }
    draft: dict[str, Any] = {}
    if columns["force"] or columns["torque"]:
        draft["wrench"] = wrench
    imu: dict[str, Any] = {}
    if len(columns["specific_force"]) == 3:
        size = float(np.median(_norm(table, columns["specific_force"])))
        unit = "g" if size < 3 else "m/s^2"
        imu["specific_force"] = {"columns": columns["specific_force"], "unit": unit}
    if len(columns["angular_velocity"]) == 3:
        size = float(np.nanmax(_norm(table, columns["angular_velocity"])))
        unit = "deg/s" if size > 15 else "rad/s"
        imu["angular_velocity"] = {"columns": columns["angular_velocity"], "unit": unit}
    if imu:
        draft["imu"] = {"file": file, "time": dict(time)} | imu
    if len(columns["orientation"]) == 4:
        first = columns["orientation"][0].lower().endswith("w")
        form = "quaternion_wxyz" if first else "quaternion_xyzw"
        pose = {"columns": columns["orientation"], "form": form}
        draft["pose"] = {"file": file, "time": dict(time), "orientation": pose}
        if len(columns["position"]) == 3:
            size = float(np.nanmax(_norm(table, columns["position"])))
            unit = "mm" if size > 20 else "m"
            draft["pose"]["position"] = {"columns": columns["position"], "unit": unit}
    if not draft:
        draft["wrench"] = wrench  # to begin with something
    unused = [n for n in table.columns if not any(n in found for found in columns.values())]
    head = [
        "# DRAFT, guessed from names and magnitudes by `drake-teleop inspect`: check every line,",
        "# above all wrench.sign, units and frames, and inspect it.",
        f"# Columns without a guess: {', '.join(unused) or 'none'}.",
    ]
    return "\n".join(head) + "\n" + yaml.safe_dump(draft, sort_keys=False)


def _norm(table: Table, names: Sequence[str]) -> NDArray[np.float64]:
    return np.linalg.norm(np.hstack([table.raw(n, n) for n in names]), axis=1)


def _time_unit(table: Table, column: str) -> str:
    """The unit in which the median step is between 50 us and 1 s, the longest such step."""
    step = float(np.median(np.abs(np.diff(table.single(column, column)))))
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if step * scale <= 0.3:
            return unit
    return "ns"
