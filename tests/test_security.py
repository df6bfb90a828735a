"""Statements of docs/security.md: no input is executed, and no port is open to other machines."""

from __future__ import annotations

import os
import pickle
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import sockets
import yaml
from sockets import THIS_MACHINE, listening, open_to_others

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab import identified_load
from drake_teleop.lab.studies.study import LoadStudy, study_command
from drake_teleop.load.identification import Identification
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.logs.read.description import load_description
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.station.replay_file import ReplayFile
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
RUNS_WHAT_IT_READS = re.compile(
    r"\w*pickle\w*|\b(?<!re\.)(?:eval|exec|compile|__import__)(?=\()|shell ?=|os\.(?:system|popen)"
    r"|subprocess|marshal|shelve|\bdill\b|joblib|import_module|ctypes|runpy|code_from|\bcffi\b"
    r"|yaml\.\w*load\w*|np\.(?:load|fromfile|memmap)|Loader=|SourceFileLoader|spec_from\w*"
)
EXPLAINED = {
    # Compiled code of the package, in the folders of its .pyc files; see the file itself.
    ("common/compiled.py", "pickle"),
    # NumPy files without objects.
    ("lab/identified_load.py", "np.load"), ("lab/identified_load.py", "allow_pickle"),
    ("logs/read/table_files.py", "np.load"), ("logs/read/table_files.py", "allow_pickle"),
    # Results of episodes in the output folder, for a continued run; processes of the package.
    ("logs/dataset/dataset.py", "np.load"), ("logs/dataset/dataset.py", "allow_pickle"),
    ("logs/dataset/dataset.py", "joblib"),
    # One of two names in the code.
    ("logs/read/array_files.py", "import_module"),
    # Processes that this one starts; they communicate by pipes.
    ("lab/studies/processes.py", "joblib"), ("lab/comparison/compare_passivity.py", "joblib"),
    # Module of the package by its name.
    ("cli/logs.py", "import_module"),
    ("__init__.py", "import_module"),
    ("robots/connections.py", "import_module"),
    # polars in a thread of its own.
    ("live/record.py", "import_module"),
    # Python file that the user names with --register.
    ("common/registry.py", "import_module"),
    # Child process of this package's code, with a host name as its argument.
    ("robots/rtde.py", "subprocess"),
    ("robots/changes.py", "subprocess"),  # the test of the fit, parallel to the loop
    # C compiler of the system, with sources of the package and numbers.
    ("robots/controller/export.py", "subprocess"),
    ("robots/ros2_node.py", "subprocess"),  # for the command `calibrate`
    # Packages of messages by names in the code.
    ("robots/ros2.py", "import_module"),
    # As above, with the addresses of a device and of this process.
    ("live/device_link.py", "subprocess"),
}  # fmt: skip
LISTENS = re.compile(
    r"\bMeshcat\(.*|\bClient\(|LocalCluster\(|\bsocket\b|\bhttp\.|socketserver|asyncio"
    r"|\bserve\("
)
LISTENING = {
    ("station/replay_file.py", 'Meshcat(MeshcatParams(host="localhost", port=0))'),
    ("lab/studies/processes.py", "Client("),
    # Access control: tests/live/test_server.py.
    ("live/page_scene.py", 'Meshcat(MeshcatParams(host="localhost", port=0))'),
    ("live/server.py", "asyncio"),
    ("live/server.py", "socket"),
    ("live/server.py", "serve("),
    # On this machine, unless the user gives another address: tests/robots/test_udp.py.
    ("robots/udp.py", "socket"),
    # Connected to the named sensor box, the only accepted sender; its page is read once.
    ("robots/netft.py", "socket"),
    # Connected to the drive, the only accepted sender; separate class.
    ("live/device_client.py", "socket"),
    ("robots/netft.py", "http."),
}
"""All code that can listen; tests check the sockets of both."""
# `files.write_text` and others are those of common/files.py, whose writers are explained there.
WRITES = re.compile(
    r"(?<!\bfiles)\.write_(?:text|bytes|csv|ipc|json|ndjson)(?=\()|\.(?:write_parquet|save|savefig|touch)(?=\()"
    r"|np\.save\w*|\bopen\(\"[wax]\w*|json\.dump(?=\()|os\.replace"
)
WRITING = {
    # Written to memory.
    ("common/style.py", ".savefig"),
    # Files for later runs, complete or absent; and a temporary folder.
    ("common/compiled.py", ".touch"), ("common/compiled.py", ".write_bytes"),
    ("common/compiled.py", "os.replace"),
    ("lab/identified_load.py", 'open("wb'), ("lab/identified_load.py", "np.savez"),
    ("station/slave/model/model_repair.py", ".write_text"),
    # One line for each change of a drive's inputs; it remains after a crash.
    ("live/record.py", 'open("x'),
    # Written to memory, then to the file after the earlier wrenches.
    ("robots/lines.py", ".write_csv"),
    # Under a temporary name until it was read back.
    ("lab/new_station/__init__.py", ".write_text"),
    ("robots/controller/export.py", ".write_text"),  # temporary folder for the compiler
    ("robots/controller/export.py", ".write_bytes"),  # by `replace_file_on_success`
    # Files in the output folder, by `replace_file_on_success`; a dataset of the package.
    ("logs/dataset/dataset.py", ".save"), ("logs/dataset/dataset.py", 'open("wb'),
    ("logs/dataset/dataset.py", "np.save"), ("logs/dataset/dataset_files.py", ".write_bytes"),
    # A marker of one byte.
    ("lab/studies/store.py", 'open("ab'),
    ("robots/changes.py", "json.dump"),  # to the process that requested it
    # Functions of the package that write by `common/files.py`.
    ("lab/run.py", ".save"), ("cli/logs.py", ".save"), ("cli/excitation.py", ".save"),
    ("lab/reproduction/reproduce.py", ".save"), ("lab/reproduction/reproduce.py", ".write_parquet"),
}  # fmt: skip


def found(pattern: re.Pattern[str], folder: Path) -> set[tuple[str, str]]:
    """Return file and matched text of a pattern in all files of the package."""
    return {
        (path.relative_to(folder).as_posix(), match.group())
        for path in folder.rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        for match in pattern.finditer(line)
    }


@pytest.mark.parametrize(
    ("pattern", "explained"),
    [
        (RUNS_WHAT_IT_READS, EXPLAINED),
        (LISTENS, LISTENING),
        (WRITES, WRITING),
        # The command line hides warnings, so it reports necessary facts in another way.
        (re.compile(r"\bwarn\("), set()),
    ],
    ids=["run", "listen", "write", "warn"],
)
def test_what_runs_listens_writes_and_warns_is_explained(pattern, explained):
    there = found(pattern, ROOT / "drake_teleop")
    assert {(file, what) for file, what in there if file != "common/files.py"} == explained


@pytest.mark.parametrize(
    "line",
    [
        "pickle.load(file)", "import cloudpickle", "eval(text)", "exec(text)", "os.system(text)",
        "np.load(path)", "np.load(path, allow_pickle=True)", "yaml.load(text)", "joblib.load(path)",
        "yaml.unsafe_load(text)", "run(text, shell=True)", "subprocess.run(words)",
    ],
)  # fmt: skip
def test_a_line_that_runs_what_it_reads_is_found(tmp_path, line):
    (tmp_path / "new.py").write_text(f"def f():\n    {line}\n")
    assert found(RUNS_WHAT_IT_READS, tmp_path)


class Planted:
    """Object whose unpickling creates a folder."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self):
        return os.mkdir, (str(self._path),)


READERS: dict[str, Callable[[Path], object]] = {
    "x.npz": read_table,
    "x.csv": read_table,
    "x.parquet": read_table,
    "x.mat": read_table,
    "x.yaml": load_description,
    "log.parquet": SimulationResult.read_parquet,
    "load-1.npz": identified_load.read_cached_load,
    "identification.json": Identification.load,
    "excitation.yaml": FourierTrajectory.load,
    "scenario.yaml": LoadScenario,
    "study.yaml": LoadStudy,
}


@pytest.mark.parametrize("name", READERS)
def test_a_planted_pickle_is_not_run(tmp_path, name):
    done, path = tmp_path / "done", tmp_path / name
    path.write_bytes(pickle.dumps(Planted(done)))
    with suppress(DrakeTeleopError):
        READERS[name](path)
    if name.endswith(".npz"):
        np.savez(path, a=np.array([Planted(done)], dtype=object))
        with suppress(DrakeTeleopError):
            READERS[name](path)
    assert not done.exists()
    pickle.loads(pickle.dumps(Planted(done)))
    assert done.exists()  # the folder that unpickling would create


STUDY = (
    "scenario: reach\nmeasures: [hand_work_J]\nfactors: [{field: rates.log_hz, values: [1e3]}]\n"
)


def test_a_pickle_that_is_planted_in_a_study_is_not_run(tmp_path, monkeypatch):
    """Try every file name that a study has or had."""
    monkeypatch.setattr(
        "drake_teleop.lab.studies.study.StationRunFunction.__call__",
        lambda self, values, seed: {"hand_work_J": 1.0},
    )
    path, out, done = tmp_path / "study.yaml", tmp_path / "out", tmp_path / "done"
    path.write_text(STUDY)

    def go_on() -> None:
        with suppress(DrakeTeleopError):
            study_command(path, out, jobs=1, quiet=True)

    go_on()
    names = [file.relative_to(out) for file in out.rglob("*") if file.is_file()]
    assert Path("runs.parquet/run_00000000.parquet") in names
    names += [Path("loads") / f"{key}.pickle" for key in ("0", "a" * 64)]
    names += map(Path, ("running/0", "running/x", "runs.parquet.unfinished"))
    names += [Path("runs.parquet") / f"run_{key}.parquet" for key in ("00000001", "abcdefgh")]
    for name in names:
        file = out / name
        earlier = file.read_bytes() if file.exists() else None
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(pickle.dumps(Planted(done)))
        go_on()
        assert not done.exists()
        if earlier is not None:
            file.write_bytes(earlier)
        else:
            file.unlink(missing_ok=True)


def test_a_film_is_made_for_this_machine_alone(tmp_path):
    seen = []

    def make_scene(meshcat):
        seen.append(listening())
        return lambda time, frame: None

    ReplayFile("x", np.arange(2.0), 1.0).write(tmp_path / "x.html", make_scene)
    assert seen[0] and seen[0] <= THIS_MACHINE


def test_a_socket_for_all_is_seen():
    import socket

    with socket.socket() as server:
        server.bind(("0.0.0.0", 0))
        sockets.on_purpose.add(server.getsockname()[1])
        server.listen()
        assert not listening() <= THIS_MACHINE
        assert not open_to_others()
        sockets.on_purpose.clear()
        assert open_to_others()
        sockets.on_purpose.add(server.getsockname()[1])
    with socket.create_server(("127.0.0.1", 0)):
        assert listening() <= THIS_MACHINE


USES = re.compile(r"uses: (\S+)@(\S+)  # (v\d+\.\d+\.\d+)")


def test_workflows_run_pinned_actions_and_the_job_that_publishes_runs_nothing_else():
    """Tags can be moved; the publishing job must not execute code of this repository."""
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        text = path.read_text()
        assert len(USES.findall(text)) == text.count("uses:")
        assert all(re.fullmatch("[0-9a-f]{40}", commit) for _, commit, _ in USES.findall(text))
        workflow = yaml.safe_load(text)
        assert workflow["permissions"] == {"contents": "read"}
        for job in workflow["jobs"].values():
            assert not ("permissions" in job and any("run" in step for step in job["steps"]))
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "site.yml").read_text())["jobs"]
    assert jobs["publish"]["permissions"] == {"pages": "write", "id-token": "write"}
