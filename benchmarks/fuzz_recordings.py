"""Inputs of `fuzz.py` for names, included files and recordings.

Each case is JSON. A case is good if the result has the property that the target names, or if a
DrakeTeleopError of one line is raised and no file remains.
"""

from __future__ import annotations

import base64
import json
import logging
import os
import random
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import fuzz_mutations as mutations
import numpy as np
import polars as pl
from pydrake.geometry import Meshcat, MeshcatParams, MeshcatVisualizer
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import DRIVE_INPUTS_FILE_NAME, models_dir
from drake_teleop.common.texts import read_json
from drake_teleop.lab import new_station
from drake_teleop.live.inputs import Inputs, read_inputs
from drake_teleop.live.record import SessionRecord, versions_and_file_digest
from drake_teleop.robots import lines
from drake_teleop.robots.recording import Recorder
from drake_teleop.robots.streams import CompensatedWrench, Reading
from drake_teleop.station.scenario import LoadScenario, Scenario
from drake_teleop.station.slave.models import ParseModel, translate_drake_errors

_SECRET = b"what is in no model's folder, and in no page"
_NAMES = (
    "arm",
    "arm #2",
    "a: b",
    "[a]",
    "*a",
    "1e-3",
    "~",
    "a\nb",
    "\udcff",
    "x" * 40,
    "%41",
    "..",
)
_STAMPS = ([[0.0, 800], [1e6, 1], [4.0, 300]], [[10.0, 60], [5.0, 700], [1e300, 3], [8.6, 10]])


def json_seeds(*cases: Any) -> Callable[[Path], list[bytes]]:
    """Return a function that makes the good inputs of a target."""
    return lambda _: [json.dumps(case).encode() for case in cases]


def _fields(path: Path, **defaults: Any) -> list[Any]:
    """Return the fields of a case, or the default where a mutation has changed the type."""
    data = read_json(path)
    found = data if isinstance(data, dict) else {}
    return [
        found[name] if isinstance(found.get(name), type(value)) else value
        for name, value in defaults.items()
    ]


# Names through `new`.

names = json_seeds(*({"arm": name, "frame": name[::-1], "package": "p"} for name in _NAMES))
_PLAN: list[new_station.StationPlan] = []


def name_mutation(rng: random.Random, content: bytes, _: bytes) -> bytes:
    """Return other names, which YAML and file systems interpret in several ways."""
    words = [
        *mutations.WORDS,
        *mutations.NUMBERS,
        *_NAMES,
        " ",
        "\t",
        "- ",
        "? ",
        ": ",
        " #",
        "\x85",
    ]
    drawn = ("".join(rng.choices(words, k=rng.randrange(1, 4)))[:80] for _ in range(3))
    return json.dumps(dict(zip(("arm", "frame", "package"), drawn, strict=True))).encode()


def new(path: Path) -> None:
    """Check that the station refers to these files, or that no file is left."""
    arm, frame, package = _fields(path, arm="arm", frame="sensor", package="p")
    original = models_dir() / "rx90.sdf"
    if not _PLAN:
        _PLAN.append(new_station.plan_station(original, "sensor"))
        new_station.plan_station = lambda *_: _PLAN[0]  # planning takes longer than all the rest
        new_station.run_command = lambda *_, **__: {}
        new_station.write_picture = lambda *_: None
    with tempfile.TemporaryDirectory() as folder, suppress(OSError, ValueError):
        model, packages = (Path(folder, f"{n}.d".replace("/", "_")) for n in (arm, package))
        packages.mkdir()
        model = packages / model.name
        model.touch()
        station = Path(folder, "mine", "new")
        try:
            new_station.new_command(station, model, frame, package_paths=(packages,), quiet=True)
        except DrakeTeleopError:
            if station.parent.exists():
                raise AssertionError("something is left") from None
            raise
        slave = LoadScenario(station / "station.yaml").slave
        read = slave.path, slave.package_folders, slave.sensor_frame
        if read != (model.resolve(), (packages.resolve(),), frame):
            raise AssertionError(f"is read as {read!r}")


# Files that a model names.

_LINK = '<link name="l"/>'
_SDF = '<sdf version="1.9"><model name="m">{}</model></sdf>'
_URDF = """<robot name="r"><link name="l"><inertial><mass value="1"/><inertia ixx="1" ixy="0"
ixz="0" iyy="1" iyz="0" izz="1"/></inertial><visual><geometry><mesh filename="{}"/></geometry>
</visual></link></robot>"""
_CORNERS = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1], "<f4").tobytes()
_FACES = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], "<u2").tobytes()
_GLTF = {
    "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "buffers": [{"uri": "data:application/octet-stream;base64,"
                 + base64.b64encode(_CORNERS + _FACES).decode(), "byteLength": 72}],
    "bufferViews": [{"buffer": 0, "byteLength": 48},
                    {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
    "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3",
                   "min": [0, 0, 0], "max": [1, 1, 1]},
                  {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"}],
    "images": [{"uri": "a.png"}], "textures": [{"source": 0}],
}  # fmt: skip
_OBJ = "mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
_BODY = '<worldbody><body name="l"><geom size="1" mass="1"/></body></worldbody>'
includes = json_seeds(
    {"a.sdf": _SDF.format("<include><uri>b.sdf</uri></include>"), "b.sdf": _SDF.format(_LINK)},
    {"a.xml": '<mujoco model="a"><include file="b.xml"/></mujoco>',
     "b.xml": f"<mujoco>{_BODY}</mujoco>"},
    {"a.dmd.yaml": "directives: [add_directives: {file: 'file://{folder}/b.dmd.yaml'}]",
     "b.dmd.yaml": "directives: [add_model: {name: m, file: 'file://{folder}/b.sdf'}]",
     "b.sdf": _SDF.format(_LINK)},
    {"a.urdf": _URDF.format("x.gltf"), "x.gltf": json.dumps(_GLTF), "a.png": ""},
    {"a.urdf": _URDF.format("x.obj"), "x.obj": _OBJ, "x.mtl": "newmtl a\nmap_Kd a.png\n"},
)  # fmt: skip
_PLACES = (
    "../",
    "{folder}/",
    "file://",
    "file://{folder}/../",
    "package://",
    "package://../",
    "/",
    "",
)
_FILES = ("a.sdf", "b.sdf", "a.xml", "a.dmd.yaml", "link.sdf", "outside.sdf", "outside.png")
_NAMED = ("a.sdf", "b.sdf", "a.xml", "b.xml", "b.dmd.yaml", "x.gltf", "x.obj", "x.mtl", "a.png")


def include_mutation(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change addresses, damage texts, or add a file of another model."""
    files = json.loads(content) | (json.loads(other) if rng.random() < 0.2 else {})
    for name, text in files.items():
        places = [old for old in _NAMED if old in text]
        if places and rng.random() < 0.7:
            text = text.replace(rng.choice(places), rng.choice(_PLACES) + rng.choice(_FILES))
        if rng.random() < 0.3:
            text = mutations.text(rng, text.encode(), text.encode()).decode(errors="replace")
        files[name] = text
    return json.dumps(files).encode()


def model(path: Path) -> None:
    """Check that neither plant nor page contains bodies or bytes of files outside the folder."""
    files = {name: text for name, text in read_json(path).items() if isinstance(text, str)}
    with tempfile.TemporaryDirectory() as outside:
        folder = Path(outside, "model")
        folder.mkdir()
        for name, content in (("outside.png", _SECRET), ("outside.sdf", _outside())):
            Path(outside, name).write_bytes(content)
        (folder / "link.sdf").symlink_to(Path(outside, "outside.sdf"))
        for name, text in files.items():
            (folder / Path(name).name[:50]).write_text(text.replace("{folder}", str(folder)))
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        first = folder / next(iter(files), "a.sdf")
        ParseModel(plant, first, "l")
        logging.getLogger("drake").setLevel(logging.ERROR)  # of missing textures
        with translate_drake_errors(first):
            plant.Finalize()
            meshcat = Meshcat(MeshcatParams(host="localhost"))
            MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
            diagram = builder.Build()
            diagram.ForcedPublish(diagram.CreateDefaultContext())
        bodies = {plant.get_body(BodyIndex(k)).name() for k in range(plant.num_bodies())}
        page = meshcat.StaticHtml()
        if "outside" in bodies or base64.b64encode(_SECRET[:30]).decode() in page:
            raise AssertionError("a file outside the model's folder was read")


def _outside() -> bytes:
    return _SDF.format(_LINK + '<link name="outside"/>').encode()


# Recordings.

stamps = json_seeds(*({"parts": parts, "step": 5e-3} for parts in _STAMPS))


def recorded(path: Path) -> None:
    """Check that the longest run of readings on one clock is kept, except for its first second."""
    parts, step = _fields(path, parts=_STAMPS[0], step=5e-3)
    step = min(max(abs(step), 1e-4), 0.9) if np.isfinite(step) else 5e-3
    recorder, longest = Recorder(), 0.0
    for k, part in enumerate(parts):
        start, count = (part if isinstance(part, list) and len(part) == 2 else (0.0, 1))[:2]
        start = start if isinstance(start, (int, float)) else float("nan")
        count = min(abs(count), 2000) if isinstance(count, int) else 1
        for t in start + step * np.arange(count):
            recorder.add(Reading(k, float(t), np.ones(15)))
        if count >= 50 and abs(start) < 1e9:
            longest = max(longest, (count - 1) * step)
    if recorder.longest_record_s < longest - 1.0 - 50 * step:
        raise AssertionError(f"{recorder.longest_record_s} s are kept of {longest} s")


sizes = json_seeds(*({"room": 10**6, "rows": 90, "name": name} for name in ("x.csv", "x.parquet")))


def full_disk(path: Path) -> None:
    """Check that the rows that were written before the disk was full are complete and in order."""
    room, rows, name = _fields(path, room=4096, rows=100, name="x.csv")
    room, rows = min(max(abs(room), 4096), 10**6), min(abs(rows), 1000)
    target = path.parent / "disk"
    target.mkdir(exist_ok=True)
    with ExitStack() as last:
        _limit(target, room, last)
        file = target / ("x.parquet" if "parquet" in name else "x.csv")
        lines.TABLE_WRITE_PERIOD_S = dict.fromkeys(lines.TABLE_WRITE_PERIOD_S, 0.0)
        sink = lines.TableSink(file)
        try:
            for k in range(rows):
                sink.write(CompensatedWrench(k, 1e-5 / (k + 1), np.ones(6), np.zeros(6), 0))
            sink.close()
        except DrakeTeleopError:
            if file.exists():
                _check_rows(file)
            raise
        finally:
            shutil.rmtree(file, ignore_errors=True)
            file.unlink(missing_ok=True)


def _limit(folder: Path, room: int, last: ExitStack) -> None:
    """Mount a tmpfs if possible; otherwise limit the size of each file."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", str(folder)]
    if os.geteuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0:
        last.callback(subprocess.run, ["umount", "-l", str(folder)])
    else:
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
        last.callback(resource.setrlimit, resource.RLIMIT_FSIZE, limits)


def _check_rows(file: Path) -> None:
    empty = file.stat().st_size == 0 if file.is_file() else not any(file.iterdir())
    if not empty:
        found = (pl.read_csv if file.suffix == ".csv" else pl.read_parquet)(file)
        if found["number"].to_list() != list(range(len(found))):
            raise AssertionError("rows are lost")
        np.testing.assert_array_equal(found["t"], 1e-5 / np.arange(1, len(found) + 1))


delays = json_seeds(*({"microseconds": 10**k} for k in (2, 3, 4)))


def killed(path: Path) -> None:
    """Check that a drive that is killed at any time has all its inputs up to then, or is absent."""
    (microseconds,) = _fields(path, microseconds=1000)
    folder, scenario = path.parent / "drive", Scenario()
    shutil.rmtree(folder, ignore_errors=True)
    child = os.fork()
    if not child:
        with suppress(BaseException):
            record = SessionRecord(folder, scenario, None, Inputs(), device=False)
            for ms in range(10**6):
                record.write(ms, Inputs(x=ms % 1000))
        os._exit(0)
    while not (folder / DRIVE_INPUTS_FILE_NAME).exists() and not os.waitpid(child, os.WNOHANG)[0]:
        time.sleep(1e-4)
    time.sleep(1e-6 * min(abs(microseconds), 30_000))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    text = (folder / DRIVE_INPUTS_FILE_NAME).read_text()
    if text.count("\n") < 4:
        return
    changes = read_inputs(
        folder / DRIVE_INPUTS_FILE_NAME,
        versions_and_file_digest(LoadScenario(folder / "scenario.yaml")),
    )
    expected = [(0, 0), *((ms, ms % 1000) for ms in range(1, len(changes)))]
    if [(ms, inputs.x) for ms, inputs in changes] != expected:
        raise AssertionError("inputs are lost")
