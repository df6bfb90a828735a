"""Valid logs, and errors of convention to plant into them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import yaml
from known_motion import motion_at, quaternions
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.inspection import inspect_command

PHI = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))
OFFSETS = np.array([3.0, -2.0, 7.0, 0.1, 0.2, -0.3])

Columns = dict[str, np.ndarray]


def good(
    *, delay_s: float = 0.0, seed: int = 5, phi: NDArray[np.float64] = PHI, start: float = 0.0
) -> Columns:
    """Return noisy data of a wrist sensor with an IMU and the pose of the arm, 4 s at 500 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 4, 2e-3)
    now, then = motion_at(start + t), motion_at(start + t - delay_s)
    wrench = non_contact_wrench(now.specific_force, now.omega, now.alpha, phi) + OFFSETS
    return {
        "t": t,
        "force": wrench[:, :3] + 0.1 * rng.normal(size=(len(t), 3)),
        "torque": wrench[:, 3:] + 0.01 * rng.normal(size=(len(t), 3)),
        "s": then.specific_force + 0.06 * rng.normal(size=(len(t), 3)),
        "omega": then.omega + 2e-3 * rng.normal(size=(len(t), 3)),
        "R": then.R_WS,
        "p": then.p_WS + 1e-5 * rng.normal(size=(len(t), 3)),
    }


def written(folder: Path, columns: Columns, *, imu: bool = True, pose: bool = True) -> Path:
    """Write each stream of the columns to a table, and the description."""
    form = "quaternion_wxyz" if columns.get("vectors") is None else "rotation_vector"
    q = columns.get("q", columns.get("vectors"))
    q = quaternions(columns["R"]) if q is None else q
    stored = {
        "wrench": {"f": columns["force"], "m": columns["torque"]},
        "imu": {"a": columns["s"], "w": columns["omega"]},
        "pose": {"q": q, "p": columns["p"]},
    }
    for name, fields in stored.items():
        data = {"t": columns.get(f"{name}_t", columns["t"])}
        data |= {f"{k}{i}": x[:, i] for k, x in fields.items() for i in range(len(x[0]))}
        pl.DataFrame(data).write_parquet(folder / f"{name}.parquet")

    def stream(name: str) -> dict[str, Any]:
        return {"file": f"{name}.parquet", "time": {"column": "t"}}

    def field(key: str, width: int = 3) -> dict[str, Any]:
        return {"columns": [f"{key}{i}" for i in range(width)]}

    data: dict[str, Any] = {
        "wrench": stream("wrench") | {"force": field("f"), "torque": field("m")}
    }
    if imu:
        data["imu"] = stream("imu") | {"specific_force": field("a"), "angular_velocity": field("w")}
    if pose:
        orientation = field("q", len(q[0])) | {"form": form}
        data["pose"] = stream("pose") | {"orientation": orientation, "position": field("p")}
    (folder / "log.yaml").write_text(yaml.safe_dump(data))
    return folder / "log.yaml"


def findings(folder: Path, columns: Columns, **streams: bool) -> dict[str, str]:
    summary = inspect_command(written(folder, columns, **streams), folder / "out", quiet=True)
    return {found["name"]: found["message"] for found in summary["findings"]}


def sign(c: Columns) -> None:
    c["force"], c["torque"] = -c["force"], -c["torque"]


def inverted(c: Columns) -> None:
    c["R"] = np.swapaxes(c["R"], 1, 2)


def base(c: Columns) -> None:
    for key in ("force", "torque"):
        c[key] = np.einsum("nij,nj->ni", c["R"], c[key])


def reversed_gravity(c: Columns) -> None:
    c["s"] = -c["s"]


def in_g(c: Columns) -> None:
    c["s"] = c["s"] / 9.80665


def in_mm(c: Columns) -> None:
    c["p"] = 1e3 * c["p"]


def degrees(c: Columns) -> None:
    c["omega"] = np.degrees(c["omega"])


def swapped_wrench(c: Columns) -> None:
    c["force"], c["torque"] = c["force"][:, [1, 0, 2]], c["torque"][:, [1, 0, 2]]


def swapped_imu(c: Columns) -> None:
    c["s"], c["omega"] = c["s"][:, [1, 0, 2]], c["omega"][:, [1, 0, 2]]


def turned_imu(c: Columns) -> None:
    c["s"], c["omega"] = c["s"][:, [2, 0, 1]], c["omega"][:, [2, 0, 1]]


def clock(c: Columns) -> None:
    c["imu_t"] = c["t"] + 0.3


def pose_clock(c: Columns) -> None:
    c["pose_t"] = c["t"] + 0.3


def wrench_clock(c: Columns) -> None:
    c["wrench_t"] = c["t"] + 0.5


def drifting_clock(c: Columns) -> None:
    c["imu_t"] = 0.1 + 1.02 * c["t"]


def degree_vectors(c: Columns) -> None:
    c["vectors"] = Rotation.from_matrix(c["R"]).as_rotvec(degrees=True)


def xyzw(c: Columns) -> None:
    c["q"] = Rotation.from_matrix(c["R"]).as_quat()


def held(c: Columns) -> None:
    for key in ("force", "torque"):
        c[key] = c[key][np.arange(len(c[key])) // 5 * 5]


def repeated(c: Columns) -> None:
    for key in ("force", "torque"):
        c[key][300:320] = c[key][300]


def nan(c: Columns) -> None:
    c["force"][500:540] = np.nan


def saturated(c: Columns) -> None:
    c["force"][:, 2] = np.minimum(c["force"][:, 2], np.quantile(c["force"][:, 2], 0.95))


def ntnu_log(folder: Path, tmp_path: Path, record: str, **imu: Any) -> Path:
    """Return the description of a real record; `imu` has more fields of that stream."""

    def stream(name: str) -> dict[str, Any]:
        return {"file": str(folder / f"{record}_{name}.csv"), "time": {"column": "t", "unit": "us"}}

    matrix = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    accelerometer = {"columns": ["ax", "ay", "az"], "unit": "g", "bias": [-0.0037, 0.0088, 0.0771]}
    data = {
        "gravity": 9.82,
        "wrench": stream("wrench")
        | {
            "force": {"columns": ["fx", "fy", "fz"]},
            "torque": {"columns": ["tx", "ty", "tz"]},
            "sign": -1,
        },
        "imu": stream("accel") | {"specific_force": accelerometer} | imu,
        "pose": stream("orientations") | {"orientation": {"columns": matrix, "form": "matrix"}},
    }
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(data))
    return tmp_path / "log.yaml"


NTNU_FRAME = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]]
