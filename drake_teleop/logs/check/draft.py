"""Draft of a log description for an unknown table."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drake_teleop.common.texts import yaml_text
from drake_teleop.logs.read.description import UNITS
from drake_teleop.logs.read.tables import Table

_TIME = r"(^|_)(t|time|timestamp|stamp|time_?stamp|secs?)(_?(s|ms|us|ns))?$"
# Ends of the names of vectors, before the axis.
_VECTORS = {
    "force": "f|forces?",
    "torque": "t|m|tau|torques?|moment",
    "specific_force": "a|s|acc|accel|(?<!angular_)acceleration",
    "angular_velocity": "w|g|omega|gyro|gyr|angular_velocity",
    "orientation": "q|quat|quaternion|orientation",
    "position": "p|pos|position|translation",
}
# Names of numbered columns, and positions of the components of a vector.
_NUMBERED: dict[str, dict[str, tuple[int, ...]]] = {
    r"tcp_force$|f_ext|wrench$|force_torque$|(^|_)(f|ft)$": {
        "force": (0, 1, 2),
        "torque": (3, 4, 5),
    },
    r"tcp_pose$": {"position": (0, 1, 2), "rotation_vector": (3, 4, 5)},  # of Universal Robots
    r"(^|_)t_ee$": {  # of Franka, column by column
        "matrix": (0, 4, 8, 1, 5, 9, 2, 6, 10),
        "position": (12, 13, 14),
    },
}
_HOMOGENEOUS = {"matrix": (0, 1, 2, 4, 5, 6, 8, 9, 10), "position": (3, 7, 11)}
_MATRIX = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
_IN_BASE = r"tcp_force$|^o_f_ext"
_ROBOT_NOTES = {
    r"tcp_force$": "The payload that the controller was told is not in the TCP's force: tell it 0.",
    r"f_ext": "An external wrench is estimated, and without the load that the robot was told.",
}
_UNIT_NAMES = {
    **{re.sub(r"[ ^]", "", unit).lower(): unit for unit in (*UNITS, "g")},
    "µs": "us",
    "°": "deg",
    "°/s": "deg/s",
    "m/s²": "m/s^2",
    "n*m": "N m",
    "n.m": "N m",
}
_UNITS = {
    "force": ("N", "lbf"),
    "torque": ("N m", "N mm", "lbf in"),
    "specific_force": ("m/s^2", "mm/s^2", "g"),
    "angular_velocity": ("rad/s", "deg/s"),
    "rotation_vector": ("rad", "deg"),
    "position": ("m", "mm"),
    "time": ("s", "ms", "us", "ns"),
}
_FILL_IN = "FILL IN"
_WITHOUT_TIME = "No column of time was recognized; where there is none, time: {rate: 500}, in Hz."


class _Columns(NamedTuple):
    columns: list[str]
    unit: str


_NOTHING = _Columns([], "")


def draft_description(table: Table, folder: Path, *, header: bool = True) -> str:
    """Return a draft of a log description (YAML), guessed from names and magnitudes of columns.

    `folder` is that of the draft, to which the path to the table is relative.
    """
    plain = {name: _normalized(name) for name in table.columns}
    found = _vectors(plain) | _numbered(plain) | _arrays(table, plain)
    file = {"file": os.path.relpath(table.path, folder)} | ({} if header else {"header": False})

    def stream(**groups: Any) -> dict[str, Any]:
        beside = next(iter(groups.values()))["columns"][0]
        return {**file, "time": _time(table, plain, beside), **groups}

    none = _Columns([_FILL_IN] * 3, "")
    wrench = stream(
        **{kind: _group(table, kind, found.get(kind, none)) for kind in ("force", "torque")}, sign=1
    )
    forces = [_without_number(plain[name][0]) for name in found.get("force", _NOTHING).columns[:1]]
    if any(re.search(_IN_BASE, name) for name in forces):
        wrench["frame"] = "base"
    draft: dict[str, Any] = {}
    if "force" in found or "torque" in found:
        draft["wrench"] = wrench
    imu = {
        kind: _group(table, kind, found[kind])
        for kind in ("specific_force", "angular_velocity")
        if _width(table, found.get(kind, _NOTHING)) == 3
    }
    if imu:
        draft["imu"] = stream(**imu)
    pose = _pose(table, found)
    if pose:
        draft["pose"] = stream(**pose)
    if not draft:
        draft["wrench"] = wrench  # a template
    groups = [group for stream in draft.values() for group in stream.values()]
    used = {
        name for group in groups if isinstance(group, dict) for name in group.get("columns", ())
    }
    times = {stream["time"]["column"] for stream in draft.values()}
    used |= times
    arrays = _array_names(table)
    used |= {name.partition("[")[0] for name in used}
    parts = {
        name for name in table.columns if name not in arrays and name.partition("[")[0] in arrays
    }
    unused = [name for name in table.columns if name not in used | parts]
    head = [
        "DRAFT, guessed from names and magnitudes by `drake-teleop inspect`: check every line,",
        "above all wrench.sign, units and frames, and inspect it.",
        f"Columns without a guess: {', '.join(unused) or 'none'}.",
        *([_WITHOUT_TIME] if _FILL_IN in times else []),
        *(text for what, text in _ROBOT_NOTES.items() for n in forces if re.search(what, n)),
    ]
    return yaml_text(draft, head=head)


def _normalized(name: str) -> tuple[str, str]:
    unit = re.search(r"[\[(]\s*([^\])\d][^\])]*)[\])]\s*$", name)
    rest = name[: unit.start()] if unit else name
    return re.sub(r"[^a-z0-9]+", "_", rest.lower()).strip("_"), unit[1].strip() if unit else ""


def _without_number(plain: str) -> str:
    return re.sub(r"_?\d+$", "", plain)


def _vectors(plain: dict[str, tuple[str, str]]) -> dict[str, _Columns]:
    found: dict[str, _Columns] = {}
    for kind, names in _VECTORS.items():
        axes = "wxyz" if kind == "orientation" else "xyz"
        ends = rf"^(.*?)(?:(?:^|_)(?:{names}))_?([{axes}])$"
        groups: dict[str, dict[str, str]] = {}
        for name, (words, _) in plain.items():
            if match := re.match(ends, words):
                groups.setdefault(match[1], {}).setdefault(match[2], name)
            elif kind == "position" and words in ("x", "y", "z"):
                groups.setdefault("", {}).setdefault(words, name)
        whole = [group for group in groups.values() if len(group) == len(axes)]
        for group in (whole or list(groups.values()))[:1]:
            columns = [group[axis] for axis in axes if axis in group]
            found[kind] = _Columns(columns, plain[columns[0]][1])
    return found


def _numbered(plain: dict[str, tuple[str, str]]) -> dict[str, _Columns]:
    groups: dict[str, list[str]] = {}
    for name, (words, _) in plain.items():
        if re.search(r"\d$", words):
            groups.setdefault(_without_number(words), []).append(name)
    found: dict[str, _Columns] = {}
    for start, kinds in _NUMBERED.items():
        most = max(k for places in kinds.values() for k in places)
        fit = [base for base in groups if re.search(start, base) and len(groups[base]) > most]
        for base in sorted(fit, key=lambda name: "target" in name)[:1]:
            for kind, places in kinds.items():
                columns = [groups[base][k] for k in places]
                found[kind] = _Columns(columns, plain[columns[0]][1])
    by_words = {words: name for name, (words, _) in plain.items()}
    if all(word in by_words for word in _MATRIX):
        found["matrix"] = _Columns([by_words[word] for word in _MATRIX], "")
    return found


def _arrays(table: Table, plain: dict[str, tuple[str, str]]) -> dict[str, _Columns]:
    found: dict[str, _Columns] = {}
    arrays = _array_names(table)
    for kind, names in {**_VECTORS, "matrix": "r|rot|rotation(_matrix)?"}.items():
        width = {"orientation": 4, "matrix": 9}.get(kind, 3)
        for name in arrays:
            words, unit = plain[name]
            whole = _Columns([name], unit)
            fits = _width(table, whole) == width
            if kind not in found and fits and re.search(rf"(?:^|_)(?:{names})$", words):
                found[kind] = whole
    for name in [name for name in arrays if table.columns[name].shape[1:] == (4, 4)][:1]:
        for kind, places in _HOMOGENEOUS.items():
            found[kind] = _Columns([f"{name}[{k}]" for k in places], "")
    return found


def _array_names(table: Table) -> list[str]:
    return [name for name in table.columns if f"{name}[0]" in table.columns]


def _width(table: Table, found: _Columns) -> int:
    return sum(math.prod(table.columns[name].shape[1:]) for name in found.columns)


def _group(table: Table, kind: str, found: _Columns) -> dict[str, Any]:
    group: dict[str, Any] = {"columns": list(found.columns)}
    if found.unit:
        unit = _UNIT_NAMES.get(re.sub(r"[ ^]", "", found.unit).lower(), "")
        group["unit"] = unit if unit in _UNITS[kind] else _FILL_IN
        return group
    if _FILL_IN in found.columns or kind in ("force", "torque"):
        return group
    size = np.linalg.norm(np.hstack([table.raw(n, n) for n in found.columns]), axis=1)
    usual, other = {
        "specific_force": ("m/s^2", "g" if float(np.nanmedian(size)) < 3 else ""),
        "angular_velocity": ("rad/s", "deg/s" if float(np.nanmax(size)) > 15 else ""),
        "rotation_vector": ("rad", "deg" if float(np.nanmax(size)) > 15 else ""),
        "position": ("m", "mm" if float(np.nanmax(size)) > 20 else ""),
    }[kind]
    group["unit"] = other or usual
    return group


def _pose(table: Table, found: dict[str, _Columns]) -> dict[str, Any]:
    if _width(table, found.get("orientation", _NOTHING)) == 4:
        orientation = {"columns": found["orientation"].columns, "form": "quaternion_wxyz"}
    elif "matrix" in found:
        orientation = {"columns": found["matrix"].columns, "form": "matrix"}
    elif "rotation_vector" in found:
        orientation = _group(table, "rotation_vector", found["rotation_vector"])
        orientation["form"] = "rotation_vector"
    else:
        return {}
    pose: dict[str, Any] = {"orientation": orientation}
    if _width(table, found.get("position", _NOTHING)) == 3:
        pose["position"] = _group(table, "position", found["position"])
    return pose


def _time(table: Table, plain: dict[str, tuple[str, str]], beside: str) -> dict[str, Any]:
    named = [name for name, (words, _) in plain.items() if re.search(_TIME, words)]
    named += [name for name, (_, unit) in plain.items() if unit.lower() in _UNITS["time"]]
    named = [name for name in named if f"{name}[0]" not in table.columns]
    if not named:
        return {"column": _FILL_IN}
    if beside in table.columns:
        structure, rows = beside.rpartition(".")[0], len(table.columns[beside])
        named.sort(
            key=lambda name: (
                name.rpartition(".")[0] != structure,
                len(table.columns[name]) != rows,
            )
        )
    unit = _UNIT_NAMES.get(plain[named[0]][1].lower(), "")
    return {
        "column": named[0],
        "unit": unit if unit in _UNITS["time"] else _time_unit(table, named[0]),
    }


def _time_unit(table: Table, column: str) -> str:
    step = float(np.median(np.abs(np.diff(table.single(column, column)))))
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if step * scale <= 0.3:
            return unit
    return "ns"
