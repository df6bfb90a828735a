"""How much does a user type from a file of each usual format to the mass and the contact force?

`python benchmarks/formats.py [--only PATTERN] [--seeds 1] [--json FILE]` writes the same recording,
30 s at 100 Hz with two pushes, in the names, units, axes and files of 18 programs. `inspect` drafts
a description; the user adds the words of YAML in the row; `detect` gives the load and the contact
force. Errors are against the truth: of the mass, and the rms of the contact force over that of the
noise.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from known_paths import Array, direction, fourier, random_load
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import detect_log

_SECONDS, _RATE_HZ = 30.0, 100.0
_NOISE_N, _NOISE_NM = 0.08, 0.004
_PUSHES = ((10.0, 11.5), (21.0, 22.2))  # s
_GRAVITY_W = np.array([0.0, 0.0, -9.80665])
Files = list[Path]


@dataclass(frozen=True)
class Recording:
    """Times, pose of S in the base, wrench of the load on the sensor, and the truth."""

    t: Array
    position: Array
    rotation: Rotation
    wrench: Array
    contact: Array
    mass: float

    @property
    def xyzw(self) -> Array:
        return np.asarray(self.rotation.as_quat(canonical=False))

    def columns(self, names: str, *parts: Array) -> pl.DataFrame:
        """Return a table; `names` are those of the parts' columns, separated by spaces."""
        values = np.column_stack([self.t, *parts])
        return pl.DataFrame(values, schema=names.split(), orient="row")


def record(seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, _SECONDS, 1 / _RATE_HZ)
    motion, load = fourier(rng, _SECONDS)(t), random_load(rng, float(rng.uniform(0.6, 2.5)))
    contact_W = np.zeros((len(t), 3))
    for start, stop in _PUSHES:
        x = np.clip(np.minimum(t - start, stop - t) / 0.1, 0.0, 1.0)
        contact_W += np.outer(x * x * (3 - 2 * x), rng.uniform(8.0, 15.0) * direction(rng))
    force = -motion.in_S(contact_W)
    contact = np.hstack([force, np.cross(np.array([0.0, 0.0, 0.12]), force)])
    on_load = load.wrench(motion, _GRAVITY_W) + contact
    noise = rng.normal(size=on_load.shape) * np.repeat([_NOISE_N, _NOISE_NM], 3)
    offsets = rng.uniform(-1, 1, 6) * np.repeat([8.0, 0.4], 3)
    wrench = -on_load - offsets + noise
    return Recording(t, motion.p, Rotation.from_matrix(motion.R), wrench, contact, load.mass)


# Formats


def _plotjuggler(r: Recording, folder: Path) -> Files:
    """Write two topics in one table, with empty cells."""
    force = "/ft/wrench/force/x /ft/wrench/force/y /ft/wrench/force/z"
    torque = force.replace("force", "torque")
    pose = "/pose/pose/position/x /pose/pose/position/y /pose/pose/position/z"
    pose += "".join(f" /pose/pose/orientation/{k}" for k in "xyzw")
    one = r.columns(f"__time {force} {torque}", r.wrench)
    other = r.columns(f"__time {pose}", r.position, r.xyzw)[::2]
    other = other.with_columns(pl.col("__time") + 0.003)
    table = pl.concat([one, other], how="diagonal").sort("__time")
    table.write_csv(folder / "plotjuggler.csv")
    return [folder / "plotjuggler.csv"]


def _ur(r: Recording, folder: Path) -> Files:
    """Write rotation vectors, and the wrench of the sensor, `ft_raw_wrench`."""
    names = ["timestamp", *(f"actual_TCP_pose_{k}" for k in range(6))]
    names += [f"ft_raw_wrench_{k}" for k in range(6)]
    rotvec = r.rotation.as_rotvec()
    r.columns(" ".join(names), r.position, rotvec, r.wrench).write_csv(folder / "rtde.csv")
    return [folder / "rtde.csv"]


def _xarm(r: Recording, folder: Path) -> Files:
    """Write millimetres, and roll, pitch and yaw about fixed axes in degrees."""
    names = "time x y z roll pitch yaw " + " ".join(f"ft_raw_{k}" for k in range(6))
    rpy = r.rotation.as_euler("xyz", degrees=True)
    r.columns(names, 1e3 * r.position, rpy, r.wrench).write_csv(folder / "xarm.csv")
    return [folder / "xarm.csv"]


def _kuka(r: Recording, folder: Path) -> Files:
    """Write millimetres, A B C (about z, y and x) in degrees, tabs, time in ms."""
    names = "Zeit X Y Z A B C Fx Fy Fz Tx Ty Tz"
    abc = r.rotation.as_euler("ZYX", degrees=True)
    table = r.columns(names, 1e3 * r.position, abc, r.wrench)
    table.with_columns(1e3 * pl.col("Zeit")).write_csv(folder / "kuka.txt", separator="\t")
    return [folder / "kuka.txt"]


def _abb(r: Recording, folder: Path) -> Files:
    """Write millimetres, numbered quaternions with w first, time in ms."""
    names = "time_ms x y z q1 q2 q3 q4 Fx Fy Fz Tx Ty Tz"
    q = np.roll(r.xyzw, 1, axis=1)
    table = r.columns(names, 1e3 * r.position, q, r.wrench)
    table.with_columns(1e3 * pl.col("time_ms")).write_csv(folder / "abb.csv")
    return [folder / "abb.csv"]


def _fanuc(r: Recording, folder: Path) -> Files:
    """Write millimetres, W P R about fixed x, y and z in degrees, in a spreadsheet."""
    names = "Time X Y Z W P R Fx Fy Fz Mx My Mz"
    wpr = r.rotation.as_euler("xyz", degrees=True)
    r.columns(names, 1e3 * r.position, wpr, r.wrench).write_excel(folder / "fanuc.xlsx")
    return [folder / "fanuc.xlsx"]


def _german(r: Recording, folder: Path) -> Files:
    """Write semicolons and decimal commas, as German spreadsheets do."""
    names = "Zeit_s x_mm y_mm z_mm qx qy qz qw Fx_N Fy_N Fz_N Mx_Nm My_Nm Mz_Nm"
    table = r.columns(names, 1e3 * r.position, r.xyzw, r.wrench)
    table.write_csv(folder / "export.csv", separator=";", decimal_comma=True)
    return [folder / "export.csv"]


def _tum(r: Recording, folder: Path) -> Files:
    """Write a trajectory `timestamp tx ty tz qx qy qz qw`, and a table of the sensor."""
    pose = r.columns("timestamp tx ty tz qx qy qz qw", r.position, r.xyzw)
    pose.write_csv(folder / "pose.csv")
    r.columns("timestamp fx fy fz tx ty tz", r.wrench).write_csv(folder / "ft.csv")
    return [folder / "ft.csv", folder / "pose.csv"]


def _counts(r: Recording, folder: Path) -> Files:
    """Write integers: 1e4 per N and 1e5 per N m."""
    names = "time x y z qx qy qz qw Fx Fy Fz Tx Ty Tz"
    counts = np.round(r.wrench * np.repeat([1e4, 1e5], 3))
    r.columns(names, r.position, r.xyzw, counts).write_csv(folder / "counts.csv")
    return [folder / "counts.csv"]


def _lists(r: Recording) -> pl.DataFrame:
    state = np.hstack([r.position, r.xyzw])
    return pl.DataFrame(
        {
            "observation.wrench": pl.Series(r.wrench, dtype=pl.List(pl.Float64)),
            "observation.state": pl.Series(state, dtype=pl.List(pl.Float64)),
            "timestamp": r.t,
            "frame_index": np.arange(len(r.t)),
        }
    )


def _lerobot(r: Recording, folder: Path) -> Files:
    """Write one episode of a dataset: columns with lists."""
    _lists(r).write_parquet(folder / "episode_000000.parquet")
    return [folder / "episode_000000.parquet"]


def _structures(r: Recording) -> list[dict[str, Any]]:
    def named(values: Array, names: str) -> dict[str, float]:
        return dict(zip(names, map(float, values), strict=True))

    return [
        {
            "stamp": {"sec": 1700000000 + int(t), "nanosec": round(t % 1 * 1e9)},
            "wrench": {"force": named(w[:3], "xyz"), "torque": named(w[3:], "xyz")},
            "pose": {"position": named(p, "xyz"), "orientation": named(q, "xyzw")},
        }
        for t, w, p, q in zip(r.t, r.wrench, r.position, r.xyzw, strict=True)
    ]


def _arrow(r: Recording, folder: Path) -> Files:
    """Write structures, as messages of ROS in a table."""
    pl.DataFrame(_structures(r)).write_ipc(folder / "messages.arrow")
    return [folder / "messages.arrow"]


def _json(r: Recording, folder: Path) -> Files:
    """Write one JSON object per line."""
    text = "\n".join(json.dumps(row) for row in _structures(r))
    (folder / "messages.jsonl").write_text(text + "\n", encoding="utf-8")
    return [folder / "messages.jsonl"]


def _hdf5(r: Recording, folder: Path) -> Files:
    """Write arrays `obs/...` of one demonstration; the order of quaternions is not stated."""
    import h5py

    with h5py.File(folder / "demo.hdf5", "w") as file:
        file["obs/robot0_eef_pos"], file["obs/robot0_eef_quat"] = r.position, r.xyzw
        file["obs/robot0_ee_force"], file["obs/robot0_ee_torque"] = r.wrench[:, :3], r.wrench[:, 3:]
        file["time"] = r.t
    return [folder / "demo.hdf5"]


def _zarr(r: Recording, folder: Path) -> Files:
    """Write arrays in a folder."""
    import zarr

    group = zarr.open_group(folder / "demo.zarr", mode="w")
    for name, data in (("timestamp", r.t), ("wrench", r.wrench), ("position", r.position),
                       ("quaternion_xyzw", r.xyzw)):  # fmt: skip
        group.create_array(name, data=data)
    return [folder / "demo.zarr"]


def _npz(r: Recording, folder: Path) -> Files:
    """Write arrays of NumPy; the quaternions have w first."""
    arrays = {"t": r.t, "ft": r.wrench, "pos": r.position, "quat": np.roll(r.xyzw, 1, axis=1)}
    np.savez(folder / "run.npz", **arrays)
    return [folder / "run.npz"]


def _matlab(r: Recording, folder: Path) -> Files:
    """Write variables of MATLAB; rotation matrices by rows."""
    from scipy.io import savemat

    R = r.rotation.as_matrix().reshape(-1, 9)
    variables = {"t": r.t, "F": r.wrench[:, :3], "M": r.wrench[:, 3:], "p": r.position, "R": R}
    savemat(folder / "run.mat", variables)
    return [folder / "run.mat"]


def _bag(r: Recording, path: Path, storage: str) -> Files:
    from rosbags import rosbag2, typesys

    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    types = {name.split("/")[-1]: kind for name, kind in store.types.items()}
    types["Time"] = store.types["builtin_interfaces/msg/Time"]

    def sent(t: float, frame: str) -> Any:
        stamp = types["Time"](1700000000 + int(t), round(t % 1 * 1e9))
        return types["Header"](stamp=stamp, frame_id=frame)

    def xyz(kind: str, values: Array) -> Any:
        return types[kind](*map(float, values))

    plugin = rosbag2.StoragePlugin[storage]
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag:
        for topic, kind in (("/ft_sensor", "WrenchStamped"), ("/tool_pose", "PoseStamped")):
            name = f"geometry_msgs/msg/{kind}"
            connection = bag.add_connection(topic, name, typestore=store)
            for t, w, p, q in zip(r.t, r.wrench, r.position, r.xyzw, strict=True):
                if kind == "WrenchStamped":
                    both = types["Wrench"](xyz("Vector3", w[:3]), xyz("Vector3", w[3:]))
                    message = types[kind](sent(t, "tool0"), both)
                else:
                    pose = types["Pose"](xyz("Point", p), xyz("Quaternion", q))
                    message = types[kind](sent(t, "base_link"), pose)
                time = round((1700000000 + t + 0.002) * 1e9)
                bag.write(connection, time, store.serialize_cdr(message, name))
    return [path]


def _mcap(r: Recording, folder: Path) -> Files:
    """Write a bag of ROS 2 with WrenchStamped and PoseStamped."""
    return _bag(r, folder / "run_mcap", "MCAP")


def _sqlite(r: Recording, folder: Path) -> Files:
    """Write the same bag in SQLite."""
    return _bag(r, folder / "run_sqlite", "SQLITE3")


@dataclass(frozen=True)
class Format:
    """Format: program, writer, and the words (old, new) that the user replaces in the draft."""

    name: str
    write: Callable[[Recording, Path], Files]
    edits: tuple[tuple[str, str], ...] = ()


_SCALES = (
    ("scale: FILL IN", "scale: 1e-4"),
    ("scale: FILL IN", "scale: 1e-5"),
    ("sign: 1", "sign: -1"),
)
FORMATS = (
    Format("PlotJuggler, CSV of two topics", _plotjuggler),
    Format("UR, CSV of RTDE", _ur),
    Format("xArm, CSV", _xarm),
    Format("KUKA, text with tabs", _kuka),
    Format("ABB, CSV", _abb),
    Format("Fanuc, XLSX", _fanuc),
    Format("CSV with decimal commas", _german),
    Format("TUM trajectory and CSV", _tum),
    Format("counts of a sensor, CSV", _counts, _SCALES),
    Format("LeRobot, Parquet with lists", _lerobot),
    Format("Arrow with structures", _arrow),
    Format("JSON lines", _json),
    Format("robomimic, HDF5", _hdf5),
    Format("zarr", _zarr),
    Format("NumPy, npz", _npz),
    Format("MATLAB, mat", _matlab),
    Format("ROS 2, MCAP", _mcap),
    Format("ROS 2, SQLite", _sqlite),
)


def solved(form: Format, seed: int, folder: Path) -> dict[str, Any]:
    """Return the user's input and its result: commands, words of YAML, and errors."""
    truth = record(seed)
    row: dict[str, Any] = {"format": form.name, "seed": seed, "commands": 2,
                           "words": len(form.edits)}  # fmt: skip
    try:
        first, *others = form.write(truth, folder)
        inspect_command(first, folder / "out", others=others, quiet=True)
        draft = folder / "out/draft.yaml"
        text = draft.read_text(encoding="utf-8")
        for old, new in form.edits:
            assert old in text, text
            text = text.replace(old, new, 1)
        draft.write_text(text, encoding="utf-8")
        found = detect_log(draft)
    except DrakeTeleopError as error:
        return row | {"error": str(error)}
    log, phi = found.eliminated.log, found.eliminated.phi
    exact = np.column_stack([np.interp(log.t, truth.t, x) for x in truth.contact[:, :3].T])
    inside = ~found.eliminated.edge
    error = (found.eliminated.contact[:, :3] - exact)[inside]
    return row | {
        "mass_error_%": float(100 * (phi[0] / truth.mass - 1)),
        "contact_rms_N": float(np.sqrt((error**2).mean())),
        "contacts": int((np.diff(found.touched.astype(int)) == 1).sum()),
        "findings": [x.name for x in found.eliminated.findings],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="*", help="pattern of the format's name")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    rows = []
    for form in FORMATS:
        for seed in range(arguments.seeds):
            if fnmatch(form.name, f"*{arguments.only}*"):
                with tempfile.TemporaryDirectory() as folder:
                    rows.append(solved(form, seed, Path(folder)))
                print(rows[-1], flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
