"""Draft of a log description from names and magnitudes of columns."""

from __future__ import annotations

import copy
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drake_teleop.common.rotations import EULER_AXIS_SEQUENCES
from drake_teleop.common.texts import to_yaml_text
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.read import description_fields
from drake_teleop.logs.read.description_fields import known_unit
from drake_teleop.logs.read.tables import ColumnsOnAccess, Table

_TIME_NAME_PATTERN = (
    r"(^|_)(t|(date_?)?time|time_?stamp|stamp|secs?|zeit|temps|tiempo|tempo)(_?(s|ms|us|ns))?$"
)
# Ends of the names of vectors, before the axis.
_VECTOR_NAME_PATTERNS = {
    "force": "f|forces?",
    "torque": "t|m|tau|torques?|moment",
    "specific_force": "a|s|acc|accel|(?<!angular_)acceleration",
    "angular_velocity": "w|g|omega|gyro|gyr|angular_velocity",
    "orientation": "q|quat|quaternion|orientation|rotation",
    "position": "p|pos|position|translation|tcp|ee|eef",
}
_VECTOR_PAIRS_WITH_SHARED_PREFIX = (
    ("force", "torque"),
    ("specific_force", "angular_velocity"),
    ("orientation", "position"),
)
# Names of three angles, without their unit, and the axes about which they turn.
_EULER_ANGLE_NAMES = {
    ("roll", "pitch", "yaw"): "xyz",
    ("yaw", "pitch", "roll"): "ZYX",
    ("a", "b", "c"): "ZYX",  # of KUKA
    ("w", "p", "r"): "xyz",  # of Fanuc
    ("rx", "ry", "rz"): "rotation_vector",  # or Euler angles, which the data determine
}
# Names of numbered columns, and positions of the components of a vector.
_NUMBERED_COLUMN_PATTERNS: dict[str, dict[str, tuple[int, ...]]] = {
    r"tcp_force$|f_ext|wrench$|force_torque$|(^|_)f$|(^|_)ft(_[a-z]+)?$": {
        "force": (0, 1, 2),
        "torque": (3, 4, 5),
    },
    r"tcp_pose$": {"position": (0, 1, 2), "rotation_vector": (3, 4, 5)},  # of Universal Robots
    r"posx$": {"position": (0, 1, 2), "ZYZ": (3, 4, 5)},  # of Doosan
    r"(^|_)t_ee$": {  # of Franka, column by column
        "matrix": (0, 4, 8, 1, 5, 9, 2, 6, 10),
        "position": (12, 13, 14),
    },
}
_HOMOGENEOUS_MATRIX_INDICES = {"matrix": (0, 1, 2, 4, 5, 6, 8, 9, 10), "position": (3, 7, 11)}
_MATRIX_ELEMENT_NAMES = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
_BASE_FORCE_REGEX = r"tcp_force(_?\d+)?$|^o_f_ext"
_ROBOT_COLUMN_NOTES = {
    r"tcp_force$": "The TCP's force excludes the payload set in the controller: set it to 0.",
    r"f_ext": "An external wrench is an estimate that excludes the load that is set in the robot.",
}
_ALLOWED_UNITS = {
    "force": description_fields.FORCE_UNITS, "torque": description_fields.TORQUE_UNITS,
    "specific_force": ("m/s^2", "mm/s^2", "g", "mg"),
    "angular_velocity": ("rad/s", "deg/s", "mdeg/s"),
    "rotation_vector": ("rad", "deg"), "position": description_fields.POSITION_UNITS,
    "euler": ("rad", "deg"), "time": ("s", "ms", "us", "ns"),
}  # fmt: skip
_POSE_VECTOR_PATTERN = r"(state|pose|tcp|eef?|cartesian)(_[a-z]+)*_\d+$"
_QUATERNION_LENGTH_TOLERANCE = 0.01  # of the length
_NUMBERED_QUATERNION_PATTERN = r"(^|_)(q|quat|quaternion|orient|orientation|rot)_?u?[0-4]$"
_MAX_ROWS_OF_STATIC_LOG = 200  # a table without time and with more rows has a constant rate
_MIN_MEDIAN_OF_RAW_SENSOR_COUNTS = 2000.0  # median of integers that are raw counts
_MAX_GYRO_RATE_DEG_S = 4000.0  # faster than any gyroscope measures
_FILL_IN_TEXT, _MIN_CLOCK_ROWS = "FILL IN", 20
_COUNTER_COLUMN_PATTERN = r"(^|_)(index|idx|frame|row|seq|counter|count|sample|episode)s?(_|$)"
_NANOSECOND_PART_NAME_ENDINGS = ("nanosec", "nanosecs", "nanoseconds", "nsec", "nsecs", "ns")
_RAW_COUNTS_NOTE = (
    "Force and torque are raw counts. scale is the value of one count in N and N m, from the"
    " manual of the sensor: 1e-6 for 1000000 counts per N. The data contain only the ratio of both."
)
_RAW_ACCELERATION_NOTE = (
    "The accelerometer is in none of g, mg, m/s^2, mm/s^2. scale is the value of one count in"
    " m/s^2, or one for each axis; the gyroscope is probably in counts too."
)
_NO_TORQUE_NOTE = "A force alone is not enough: the commands need force and torque."
_NO_TIME_NOTE = "No column of time was recognized; without one, set time: {rate: 500}, in Hz."


class Draft(NamedTuple):
    """Draft of a log description: streams as in YAML, comments and findings on these."""

    streams: dict[str, Any]
    comment_lines: list[str]
    findings: tuple[Finding, ...] = ()

    def text(self) -> str:
        return to_yaml_text(self.streams, head=self.comment_lines)

    def with_finding_corrected(self, finding: Finding) -> Draft:
        streams = copy.deepcopy(self.streams)
        for path, value in finding.fields.items():
            *outer, last = path.split(".")
            place = streams
            for name in outer:
                place = place.setdefault(name, {})
            place[last] = value
        lines = [*self.comment_lines, f"Corrected by the data: {finding.message}."]
        return Draft(streams, lines, self.findings)


def join_drafts(drafts: Sequence[Draft]) -> Draft:
    """Join drafts of a log description: each stream is from the first draft that contains it."""
    streams: dict[str, Any] = {}
    for draft in drafts:
        whole = {name: stream for name, stream in draft.streams.items() if not _is_unfilled(stream)}
        streams = whole | streams
    streams = streams or drafts[0].streams
    order = ["wrench", "imu", "pose", "static"]
    ordered = {name: streams[name] for name in order if name in streams}
    lines = dict.fromkeys(x for draft in drafts for x in draft.comment_lines)
    return Draft(ordered, [*lines], tuple(x for draft in drafts for x in draft.findings))


def _is_unfilled(stream: dict[str, Any]) -> bool:
    groups = [group for group in stream.values() if isinstance(group, dict)]
    columns = [column for group in groups for column in group.get("columns", ())]
    return bool(columns) and set(columns) == {_FILL_IN_TEXT}


_ColumnLabels = dict[str, tuple[str, str]]  # by column: its normalized name, and its unit
_ColumnsByVector = dict[str, list[str]]  # names of the columns of each recognized vector


def draft_description(table: Table, folder: Path, *, header: bool = True) -> Draft:
    """Return a log description guessed from a table, with paths relative to `folder`."""
    labels = {name: _normalized_name_and_unit(name) for name in table.columns}
    found = _find_euler_angles(labels) | _find_pose_vectors(table, labels) | _find_vectors(labels)
    found |= _find_numbered_or_array_vectors(table, labels) | _find_quaternion(table, labels)
    ends = [labels[name][0].rpartition("_")[2] for name in found.get("torque", [])]
    if ends == ["tx", "ty", "tz"] and "force" not in found and "position" not in found:
        found["position"] = found.pop("torque")
    file = {"file": os.path.relpath(table.path, folder)} | ({} if header else {"header": False})

    def stream_with_time(**groups: Any) -> dict[str, Any]:
        vector_column = next(iter(groups.values()))["columns"][0]
        return {**file, "time": _draft_time(table, labels, vector_column), **groups}

    pair = {x: found.get(x, [_FILL_IN_TEXT] * 3) for x in ("force", "torque")}
    both = {kind: _draft_quantity(table, labels, kind, columns) for kind, columns in pair.items()}
    wrench = stream_with_time(**both, sign=1)
    forces = [_remove_trailing_number(labels[name][0]) for name in found.get("force", [])[:1]]
    if any(re.search(_BASE_FORCE_REGEX, name) for name in forces):
        wrench["frame"] = "base"
    draft: dict[str, Any] = {}
    if "force" in found or "torque" in found:
        draft["wrench"] = wrench
    imu = {
        kind: _draft_quantity(table, labels, kind, found[kind])
        for kind in ("specific_force", "angular_velocity")
        if _count_scalars_per_row(table, found.get(kind, [])) == 3
    }
    if imu:
        draft["imu"] = stream_with_time(**imu)
    pose = _draft_pose(table, labels, found)
    if pose:
        draft["pose"] = stream_with_time(**pose)
    if not draft:
        draft["wrench"] = wrench  # a template
    groups = [group for stream in draft.values() for group in stream.values()]
    used = {name for x in groups if isinstance(x, dict) for name in x.get("columns", ())}
    without_time = _FILL_IN_TEXT in str(draft.get("wrench", {}).get("time"))
    if without_time and table.rows <= _MAX_ROWS_OF_STATIC_LOG and pose and not _is_unfilled(wrench):
        kept = {name: value for name, value in wrench.items() if name != "time"}
        draft = {"static": {**kept, "orientation": pose["orientation"]}}
    times = {x.get("time", {}).get(k) for x in draft.values() for k in ("column", "nanoseconds")}
    used |= times - {None}
    arrays = _names_of_array_columns(table)
    used |= {name.partition("[")[0] for name in used}
    parts = {x for x in table.columns if x not in arrays and x.partition("[")[0] in arrays}
    unused = [name for name in table.columns if name not in used | parts]
    raw = f"'scale': '{_FILL_IN_TEXT}'"
    head = [
        "DRAFT, guessed from names and magnitudes by `drake-teleop inspect`: check every line,",
        "above all wrench.sign, units and frames.",
        f"Columns without a guess: {', '.join(unused) or 'none'}.",
        *([_NO_TORQUE_NOTE] if "force" in found and "torque" not in found else []),
        *([_NO_TIME_NOTE] if _FILL_IN_TEXT in times else []),
        *([_RAW_COUNTS_NOTE] if raw in str(draft | {"imu": None}) else []),
        *([_RAW_ACCELERATION_NOTE] if raw in str(draft.get("imu")) else []),
        *(text for what, text in _ROBOT_COLUMN_NOTES.items() for n in forces if re.search(what, n)),
    ]
    return Draft(draft, head, tuple(_findings_on_other_wrenches(table, labels, found)))


def _find_numbered_or_array_vectors(table: Table, labels: _ColumnLabels) -> _ColumnsByVector:
    numbered = _find_vectors_in_numbered_columns(labels)
    return numbered | _find_vectors_in_array_columns(table, labels)


def _findings_on_other_wrenches(
    table: Table, labels: _ColumnLabels, found: _ColumnsByVector
) -> Iterator[Finding]:
    """Yield a finding for each wrench in the table besides the drafted one, `found`."""
    pair = "force", "torque"
    used = {x for names in found.values() for x in names}
    taken = ", ".join(x for kind in pair for x in found.get(kind, ()))
    while taken:
        arrays = {name.partition("[")[0] for name in used}
        labels = {x: y for x, y in labels.items() if not {x, x.partition("[")[0]} & (used | arrays)}
        rest = replace(table, columns=ColumnsOnAccess(labels, table.columns.__getitem__))
        other = _find_vectors(labels) | _find_numbered_or_array_vectors(rest, labels)
        if any(_count_scalars_per_row(table, other.get(kind, [])) != 3 for kind in pair):
            return
        used = {x for kind in pair for x in other[kind]}
        lines = " and ".join(f"wrench.{kind}.columns: {other[kind]}" for kind in pair)
        frame = "base" if re.search(_BASE_FORCE_REGEX, labels[other["force"][0]][0]) else "sensor"
        text = f"the wrench is read from {taken}; another wrench is in {', '.join(sorted(used))}"
        yield Finding("other wrench", f"{text}; to use it, set {lines} and wrench.frame: {frame}")


def _normalized_name_and_unit(name: str) -> tuple[str, str]:
    unit = re.search(r"[\[(]\s*([^\])\d][^\])]*)[\])]\s*$", name)
    suffix = re.search(r"(?:(?<=[xyz])|(?<=ch|aw|ll))_([a-z/]+)$", name, re.IGNORECASE)
    if unit is None and suffix is not None and known_unit(suffix[1]):
        unit = suffix
    rest = name[: unit.start()] if unit else name
    return re.sub(r"[\W_]+", "_", rest.lower()).strip("_"), unit[1].strip() if unit else ""


def _remove_trailing_number(name: str) -> str:
    return re.sub(r"_?\d+$", "", name)


def _is_commanded_or_estimated_value(name: str) -> bool:
    return bool(re.search(r"(^|_)(target|tcp_force|ext|est|estimated|cmd|desired)(_|$)", name))


def _group_numbered_columns(labels: _ColumnLabels, pattern: str) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, (words, _) in labels.items():
        if re.search(pattern, words):
            groups.setdefault(_remove_trailing_number(words), []).append(name)
    return groups


def _find_vectors(labels: _ColumnLabels) -> _ColumnsByVector:
    groups = {kind: _group_by_vector(labels, kind, x) for kind, x in _VECTOR_NAME_PATTERNS.items()}
    found: _ColumnsByVector = {}
    for pair in _VECTOR_PAIRS_WITH_SHARED_PREFIX:
        shared = [name for name in groups[pair[0]] if name in groups[pair[1]]]
        shared.sort(key=_is_commanded_or_estimated_value)
        for kind in pair:
            for name in (shared or list(groups[kind]))[:1]:
                found[kind] = groups[kind][name]
    return found


def _group_by_vector(labels: _ColumnLabels, quantity: str, names: str) -> _ColumnsByVector:
    """Group x, y, z columns of a quantity `quantity` by name prefix; prefer complete groups."""
    axes = "wxyz" if quantity == "orientation" else "xyz"
    ends = rf"^(.*?)(?:(?:^|_)(?:{names}))_?([{axes}])$"
    groups: dict[str, dict[str, str]] = {}
    for name, (words, _) in labels.items():
        if match := re.match(ends, words):
            groups.setdefault(match[1], {}).setdefault(match[2], name)
        elif quantity == "position" and words in ("x", "y", "z"):
            groups.setdefault("", {}).setdefault(words, name)
    spelled = "|".join(x for x in names.split("|") if len(x) > 2)
    threes = {} if groups else _group_numbered_columns(labels, rf"(^|_)({spelled})_?[0-3]$")
    if found := {name: group for name, group in threes.items() if len(group) == len(axes) == 3}:
        return found
    for name, (words, unit) in labels.items() if not groups else ():  # in another language
        match = re.match(r"^(.*?)_?([xyz])$", words)
        if match and known_unit(unit) in _ALLOWED_UNITS.get(quantity, ()):
            groups.setdefault(match[1], {}).setdefault(match[2], name)
    whole = {name: group for name, group in groups.items() if len(group) == len(axes)}
    return {name: [x[a] for a in axes if a in x] for name, x in (whole or groups).items()}


def _find_euler_angles(labels: _ColumnLabels) -> _ColumnsByVector:
    ends: dict[str, dict[str, str]] = {}
    for name, (words, _) in labels.items():
        prefix, _, end = re.sub("theta_(?=[xyz]$)", "r", words).rpartition("_")  # of Kinova
        ends.setdefault(prefix, {}).setdefault(end, name)
    for names, axes in _EULER_ANGLE_NAMES.items():
        for group in ends.values():
            if all(name in group for name in names):
                position = {"position": [group[x] for x in "xyz"]} if {*"xyz"} <= {*group} else {}
                return {axes: [group[name] for name in names]} | position
    return {}


def _find_pose_vectors(table: Table, labels: _ColumnLabels) -> _ColumnsByVector:
    groups = _group_numbered_columns(labels, _POSE_VECTOR_PATTERN)
    for columns in (group for group in groups.values() if len(group) in (7, 8)):
        for first, kind in ((3, "quaternion_xyzw"), (0, "orientation")):
            quaternion = columns[first : first + 4]
            if _are_unit_quaternions(table, quaternion):
                position = columns[:3] if first else columns[4:7]
                return {kind: quaternion, "position": position}
    return {}


def _are_unit_quaternions(table: Table, quaternion: list[str]) -> bool:
    length = np.linalg.norm(table.numbers_with_nan_side_by_side(quaternion, ""), axis=1)
    return bool(np.nanmax(np.abs(length - 1.0)) < _QUATERNION_LENGTH_TOLERANCE)


def _find_quaternion(table: Table, labels: _ColumnLabels) -> _ColumnsByVector:
    groups = _group_numbered_columns(labels, _NUMBERED_QUATERNION_PATTERN)
    fours = [group for group in groups.values() if len(group) == 4]
    found = next((group for group in fours if _are_unit_quaternions(table, group)), None)
    return {"orientation": found} if found else {}


def _find_vectors_in_numbered_columns(labels: _ColumnLabels) -> _ColumnsByVector:
    groups = _group_numbered_columns(labels, r"\d$")
    found: _ColumnsByVector = {}
    for start, kinds in _NUMBERED_COLUMN_PATTERNS.items():
        most = max(k for places in kinds.values() for k in places)
        fit = [base for base in groups if re.search(start, base) and len(groups[base]) > most]
        for base in sorted(fit, key=_is_commanded_or_estimated_value)[:1]:
            for kind, places in kinds.items():
                found[kind] = [groups[base][k] for k in places]
    by_words = {words: name for name, (words, _) in labels.items()}
    if all(word in by_words for word in _MATRIX_ELEMENT_NAMES):
        found["matrix"] = [by_words[word] for word in _MATRIX_ELEMENT_NAMES]
    return found


def _find_vectors_in_array_columns(table: Table, labels: _ColumnLabels) -> _ColumnsByVector:
    found: _ColumnsByVector = {}
    arrays = _names_of_array_columns(table)
    for kind, names in {**_VECTOR_NAME_PATTERNS, "matrix": "r|rot|rotation(_matrix)?"}.items():
        width = {"orientation": 4, "matrix": 9}.get(kind, 3)
        for name in arrays:
            words, form = labels[name][0], kind
            fits = _count_scalars_per_row(table, [name]) == width
            if kind == "orientation" and words.endswith(("_xyzw", "_wxyz")):
                words = words[:-5]
                form = "quaternion_xyzw" if labels[name][0].endswith("xyzw") else kind
            if form not in found and fits and re.search(rf"(?:^|_)(?:{names})$", words):
                found[form] = [name]
    for name in [name for name in arrays if table.columns[name].shape[1:] == (4, 4)][:1]:
        for kind, places in _HOMOGENEOUS_MATRIX_INDICES.items():
            found[kind] = [f"{name}[{k}]" for k in places]
    return found


def _names_of_array_columns(table: Table) -> list[str]:
    return [name for name in table.columns if f"{name}[0]" in table.columns]


def _count_scalars_per_row(table: Table, columns: list[str]) -> int:
    return sum(math.prod(table.columns[name].shape[1:]) for name in columns)


def _draft_quantity(
    table: Table, labels: _ColumnLabels, quantity: str, columns: list[str]
) -> dict[str, Any]:
    group: dict[str, Any] = {"columns": list(columns)}
    if _FILL_IN_TEXT in columns:
        return group
    if quantity in ("force", "torque"):
        x = table.numbers_with_nan(columns[0], columns[0])
        is_integer = (np.nan_to_num(x) % 1.0 == 0.0).all()
        if is_integer and np.nanmedian(np.abs(x)) > _MIN_MEDIAN_OF_RAW_SENSOR_COUNTS:
            group["scale"] = _FILL_IN_TEXT
    if spelling := labels[columns[0]][1]:
        unit = known_unit(spelling)
        group["unit"] = unit if unit in _ALLOWED_UNITS[quantity] else _FILL_IN_TEXT
        return group
    if quantity in ("force", "torque"):
        return group
    size = np.linalg.norm(table.numbers_with_nan_side_by_side(columns, columns[0]), axis=1)
    if quantity == "specific_force":
        median = np.nanmedian(size)
        limits = {"g": (0, 3), "m/s^2": (3, 30), "mg": (700, 1400), "mm/s^2": (7e3, 14e3)}
        fitting = [unit for unit, (low, high) in limits.items() if low <= median < high]
        return group | ({"unit": fitting[0]} if fitting else {"scale": _FILL_IN_TEXT})
    if quantity == "angular_velocity" and np.nanmax(size) > _MAX_GYRO_RATE_DEG_S:
        return group | {"unit": "mdeg/s"}
    units = {"angular_velocity": ("rad/s", "deg/s", 15), "position": ("m", "mm", 20)}
    usual, other, limit = units.get(quantity, ("rad", "deg", 15))
    return group | {"unit": other if np.nanmax(size) > limit else usual}


def _draft_pose(table: Table, labels: _ColumnLabels, found: _ColumnsByVector) -> dict[str, Any]:
    if _count_scalars_per_row(table, found.get("orientation", [])) == 4:
        orientation = {"columns": found["orientation"], "form": "quaternion_wxyz"}
    elif form := next((name for name in ("quaternion_xyzw", "matrix") if name in found), None):
        orientation = {"columns": found[form], "form": form}
    elif euler := next((name for name in found if name in EULER_AXIS_SEQUENCES), None):
        orientation = _draft_quantity(table, labels, "euler", found[euler])
        orientation |= {"form": "euler", "axes": euler}
    elif (name := "rotation_vector") in found:
        orientation = _draft_quantity(table, labels, name, found[name]) | {"form": name}
    else:
        return {}
    pose: dict[str, Any] = {"orientation": orientation}
    if _count_scalars_per_row(table, found.get("position", [])) == 3:
        pose["position"] = _draft_quantity(table, labels, "position", found["position"])
    return pose


def _draft_time(table: Table, labels: _ColumnLabels, vector_column: str) -> dict[str, Any]:
    named = [name for name, (words, _) in labels.items() if re.search(_TIME_NAME_PATTERN, words)]
    named += [name for name, (_, unit) in labels.items() if unit.lower() in _ALLOWED_UNITS["time"]]
    named = [name for name in named if f"{name}[0]" not in table.columns]
    named = named or _find_clock_columns(table, labels)
    if not named:
        return {"column": _FILL_IN_TEXT}
    if vector_column in table.columns:
        structure, rows = vector_column.rpartition(".")[0], len(table.columns[vector_column])
        named.sort(key=lambda name: len(table.columns[name]) != rows)
        named.sort(key=lambda name: name.rpartition(".")[0] != structure)
    unit = known_unit(labels[named[0]][1])
    start = labels[named[0]][0].removesuffix("s").removesuffix("sec")
    parts = {words: name for name, (words, _) in labels.items() if words.startswith(start)}
    for end in _NANOSECOND_PART_NAME_ENDINGS if start != labels[named[0]][0] else ():
        if start + end in parts:
            return {"column": named[0], "nanoseconds": parts[start + end]}
    if unit not in _ALLOWED_UNITS["time"]:
        times = table.single_column(named[0], named[0])
        step = float(np.median(np.abs(np.diff(times[np.isfinite(times)]))))
        units = ("s", 1.0), ("ms", 1e-3), ("us", 1e-6)
        unit = next((unit for unit, scale in units if step * scale <= 0.3), "ns")
    return {"column": named[0], "unit": unit}


def _find_clock_columns(table: Table, labels: _ColumnLabels) -> list[str]:
    def is_clock(name: str) -> bool:
        values = np.asarray(table.columns[name])
        if values.ndim != 1 or values.dtype.kind not in "fiu" or len(values) < _MIN_CLOCK_ROWS:
            return False
        steps = np.diff(values.astype(float))
        even = np.ptp(np.quantile(steps, [0.1, 0.9])) < steps.mean()
        is_counter = re.search(_COUNTER_COLUMN_PATTERN, labels[name][0])
        return bool((steps > 0.0).all() and even and not is_counter)

    return [name for name in labels if is_clock(name)]
