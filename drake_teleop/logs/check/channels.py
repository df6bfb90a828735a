"""Dead and repeated channels of wrench and IMU."""

from __future__ import annotations

from collections import Counter
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.check.corrections import Finding
from drake_teleop.logs.check.load_fit import white_noise
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.tables import Table

_FIELDS = {
    "wrench": ("force", "torque"),
    "imu": ("specific_force", "angular_velocity", "angular_acceleration"),
}
_MIN_NOISE_SHARE = 1e-6


def channel_findings(
    stream: str, description: Description, tables: dict[Path, Table]
) -> list[Finding]:
    """Return findings about dead and repeated channels of the stream "wrench" or "imu"."""
    described = getattr(description, stream)
    found: list[Finding] = []
    named: dict[str, str] = {}
    for field in _FIELDS[stream]:
        quantity = getattr(described, field, None)
        if quantity is None:
            continue
        where = f"{stream}.{field}"
        numbers = _numbers(tables[described.source], quantity.columns, where)
        twice = _repeated_names(where, quantity.columns, named)
        found += twice or [*_dead_channels(where, numbers), *_equal_channels(where, numbers)]
    return found


def _numbers(table: Table, columns: Any, where: str) -> dict[str, Array]:
    numbers: dict[str, Array] = {}
    for column in columns:
        x = table.raw(column, where)
        for i, values in enumerate(x.T):
            numbers[str(column) if len(x.T) == 1 else f"{column}[{i}]"] = values
    return numbers


def _repeated_names(where: str, columns: Any, named: dict[str, str]) -> list[Finding]:
    found = []
    for column, times in Counter(map(str, columns)).items():
        before = where if times > 1 else named.get(column)
        named[column] = where
        if before is not None:
            both = "twice" if before == where else f"in {before}.columns too"
            found.append(
                Finding(
                    "repeated channel",
                    f"{where}.columns names {column!r} {both}: one number cannot be two channels;"
                    f" set {where}.columns to three columns of their own",
                )
            )
    return found


def _dead_channels(where: str, numbers: dict[str, Array]) -> list[Finding]:
    spread = {name: float(np.ptp(x)) for name, x in numbers.items()}
    noise = white_noise(np.stack(list(numbers.values()), axis=1))
    alive = noise > _MIN_NOISE_SHARE * (np.array(list(spread.values())) + 1e-300)
    dead = [name for name, width in spread.items() if width == 0.0]
    if not dead or not (alive & (noise > 0.0)).any():
        return []
    return [
        Finding(
            "dead channel",
            f"{name!r} is {numbers[name][0]:.4g} in all rows, and its neighbours are not: the"
            f" channel is dead or not connected; name another column in {where}.columns, or record"
            " again",
        )
        for name in dead
    ]


def _equal_channels(where: str, numbers: dict[str, Array]) -> list[Finding]:
    return [
        Finding(
            "repeated channel",
            f"{a!r} and {b!r} are the same in all rows: one was recorded twice; name another column"
            f" in {where}.columns, or record again",
        )
        for (a, x), (b, y) in combinations(numbers.items(), 2)
        if np.ptp(x) > 0.0 and np.array_equal(x, y)
    ]
