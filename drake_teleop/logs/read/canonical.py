"""The canonical log: wrench and motion of the sensor frame S at common instants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.logs.read.description import (
    Acceleration,
    AngularAcceleration,
    AngularVelocity,
    Description,
    Force,
    Imu,
    Orientation,
    Pose,
    Position,
    Time,
    Torque,
    Wrench,
)
from drake_teleop.logs.read.tables import Table
from drake_teleop.writing import write_table

WRENCH = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
SPECIFIC_FORCE = ("s_x", "s_y", "s_z")
ANGULAR_VELOCITY = ("omega_x", "omega_y", "omega_z")
ANGULAR_ACCELERATION = ("alpha_x", "alpha_y", "alpha_z")
ORIENTATION = ("q_w", "q_x", "q_y", "q_z")
POSITION = ("p_x", "p_y", "p_z")
_ARRAYS = (
    "t",
    "wrench",
    "specific_force",
    "angular_velocity",
    "angular_acceleration",
    "gravity",
    "bridged",
)


@dataclass(frozen=True)
class Log:
    """What identification and elimination need: N samples on one clock, frame S, SI units.

    Args:
        t: (N,) time, uniformly spaced [s]; for static poses merely their number.
        wrench: (N, 6) [f; tau] with the sign of Eq. (1): what the sensor exerts on the load, about
            the origin of S [N, N m].
        specific_force: (N, 3) s = a - g of the origin of S, in S [m/s^2].
        angular_velocity: (N, 3) omega_WS_S [rad/s].
        angular_acceleration: (N, 3) alpha_WS_S [rad/s^2].
        gravity: (N, 3) g_S, gravity in S [m/s^2], if the orientation is known.
        static: the samples are separate poses at rest; there is nothing to filter or to shift.
        bridged: (N,) where a straight line stands in for samples that a stream does not have; None
            if there are no gaps.
        notes: what the reader had to assume, in words.
        source: the file, for messages.

    Raises:
        DrakeTeleopError: if the arrays do not fit each other, hold NaN or infinity, or `t` does not
            increase.
    """

    t: NDArray[np.float64]
    wrench: NDArray[np.float64]
    specific_force: NDArray[np.float64]
    angular_velocity: NDArray[np.float64]
    angular_acceleration: NDArray[np.float64]
    gravity: NDArray[np.float64] | None = None
    static: bool = False
    bridged: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()
    source: str = "log"

    def __post_init__(self) -> None:
        n = len(self.t)
        shapes = {
            "t": (n,),
            "wrench": (n, 6),
            "specific_force": (n, 3),
            "angular_velocity": (n, 3),
            "angular_acceleration": (n, 3),
            "gravity": (n, 3),
            "bridged": (n,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if np.shape(value) != shape:
                raise DrakeTeleopError(
                    f"has shape {np.shape(value)}, needs {shape}", where=f"{self.source}:{name}"
                )
            if not np.isfinite(value).all():
                raise DrakeTeleopError(
                    "holds NaN or infinity",
                    where=f"{self.source}:{name}",
                    remedy="cut or repair these samples",
                )
        if np.any(np.diff(self.t) <= 0):
            raise DrakeTeleopError("does not increase", where=f"{self.source}:t")

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def dt(self) -> float:
        """Time between samples [s]; where samples in gaps were taken out, between the others."""
        steps = np.diff(self.t)
        return float(steps[steps < 1.5 * np.median(steps)].mean())

    def only(self, rows: slice | NDArray[np.bool_]) -> Log:
        """These samples of the log.

        Args:
            rows: which.
        """
        if not isinstance(rows, slice) and rows.all():
            return self
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        taken: dict[str, Any] = {k: None if x is None else x[rows] for k, x in arrays.items()}
        return replace(self, **taken)

    @property
    def motion(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(specific_force, angular_velocity, angular_acceleration), the order of every function."""
        return self.specific_force, self.angular_velocity, self.angular_acceleration


def write_log(log: Log, path: str | Path) -> None:
    """Writes a log as a canonical table: columns t, f_x ... alpha_z.

    Args:
        log: the log.
        path: where to; ends in .csv or .parquet.

    Raises:
        DrakeTeleopError: for another suffix.
    """
    import polars as pl

    path = Path(path)
    names = (*WRENCH, *SPECIFIC_FORCE, *ANGULAR_VELOCITY, *ANGULAR_ACCELERATION)
    values = np.hstack([log.wrench, *log.motion])
    frame = pl.DataFrame({"t": log.t} | dict(zip(names, values.T, strict=True)))
    if path.suffix not in (".csv", ".parquet"):
        raise DrakeTeleopError(
            f"format {path.suffix!r} is not known",
            where=str(path),
            remedy="name it .csv or .parquet",
        )
    write_table(path, frame)


def describe_canonical(path: Path, table: Table) -> Description:
    """The description of a canonical table, so that there is one way of reading.

    Args:
        path: the table's file.
        table: what is in it.

    Raises:
        DrakeTeleopError: if the wrench, or the kinematics and the pose in their place, are absent.
    """

    def present(names: Sequence[str]) -> bool:
        found = [name for name in names if name in table.columns]
        if found and len(found) < len(names):
            table.numbers(names, len(names), str(path))
        return bool(found)

    if not {"t", *WRENCH} & set(table.columns):
        raise DrakeTeleopError(
            "is no canonical log: it has none of the columns t, f_x ... tau_z",
            where=str(path),
            remedy="describe it in a YAML file (docs/logs.md); `drake-teleop inspect` drafts one",
        )
    table.raw("t", str(path))
    table.numbers(WRENCH, 6, str(path))
    time = Time(column="t")
    s, omega, alpha, q, p = (
        present(names)
        for names in (
            SPECIFIC_FORCE,
            ANGULAR_VELOCITY,
            ANGULAR_ACCELERATION,
            ORIENTATION,
            POSITION,
        )
    )
    if not q and not (s and omega):
        missing = "s_x s_y s_z" if not s else "omega_x omega_y omega_z"
        raise DrakeTeleopError(
            f"a wrench without kinematics: no columns {missing}",
            where=str(path),
            remedy="add them, or the pose q_w q_x q_y q_z (and p_x p_y p_z)",
        )
    imu = pose = None
    if s or omega:
        imu = Imu(
            file=path,
            time=time,
            specific_force=Acceleration(columns=SPECIFIC_FORCE) if s else None,
            angular_velocity=AngularVelocity(columns=ANGULAR_VELOCITY) if omega else None,
            angular_acceleration=AngularAcceleration(columns=ANGULAR_ACCELERATION)
            if alpha
            else None,
        )
    if q:
        pose = Pose(
            file=path,
            time=time,
            orientation=Orientation(columns=ORIENTATION, form="quaternion_wxyz"),
            position=Position(columns=POSITION) if p else None,
        )
    wrench = Wrench(
        file=path,
        time=time,
        force=Force(columns=WRENCH[:3]),
        torque=Torque(columns=WRENCH[3:]),
    )
    return Description(wrench=wrench, imu=imu, pose=pose)
