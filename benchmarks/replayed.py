"""Does `compensate replay:LOG` equal `eliminate --causal`, and which residual remains?

`python benchmarks/replayed.py [--json FILE] [--data FOLDER] [LOG ...]` replays logs in chunks of
one reading, of 7, of 256 and of all, delayed and predicted, and counts the numbers that differ in
any bit. The logs are the two of the sample log, all records of NTNU, UR5 and UTIAS in FOLDER, and
those in the arguments, such as sensor_log.parquet of `drake-teleop run`. The load is that of
`identify` for the log, and for NTNU that of the 24 poses at rest. If there is none, it is 1 kg: the
comparison does not need the true one.

The second figure is the rms residual force at 30 Hz, for records of NTNU without contact. There are
three kinds of offsets, each zero-phase (`eliminate`) and live: the record's own, those of a tare in
its first half second, those of the load file. Compare only figures with equal offsets: the
zero-phase 0.30 and 0.32 N of the docs have the record's own. For the logs in the arguments,
"removed" is the share of the force without offsets that is removed where `eliminate` has no
contact.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from peers import described

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.logs.processing import EliminatedLog, eliminate_log, identify_log
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.logs.sample import sample_log_command
from drake_teleop.robots.compensate import compensate_stream
from drake_teleop.robots.compensator import TARE_AVERAGING_S, Compensator
from drake_teleop.robots.replay_log import ReplayLogSource
from drake_teleop.robots.streams import CompensatedWrench

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
CHUNKS = (1, 7, 256, 10**9)
PHI = phi_from_mass_com_inertia(1.0, [0.0, 0.01, 0.05], np.diag([0.003, 0.003, 0.002]))
ANY = Identification(
    *(PHI, np.zeros(6), 1e-6 * np.eye(16), np.ones(16, bool), 4.0, 0.0, np.full(6, 0.1)),
    *("batch least squares", 100),
)


class Kept(list[CompensatedWrench]):
    """Sink that stores the results."""

    def write(self, out: CompensatedWrench) -> None:
        """See `Sink`."""
        self.append(out)

    def close(self) -> None:
        """See `Sink`."""


def replayed(path: Path, load: Identification, chunk: int, mode: str) -> Kept:
    """Return the output of `compensate` for a log at its measured instants."""
    source, kept = ReplayLogSource(path, load, chunk=chunk), Kept()
    late = {"delay_readings": source.delay_readings, "predicted": mode == "predicted"}
    compensate_stream(source, Compensator(load, source.dt, sigma=0.3, gamma=1.5, **late), kept)  # type: ignore[arg-type]
    return Kept(row for row in kept if not row.flags)


def differing(path: Path, load: Identification) -> tuple[int, int]:
    """Return how many numbers were compared, and how many differ."""
    compared = different = 0
    for mode in ("delayed", "predicted"):
        wanted = eliminate_log(path, load, sigma=0.3, gamma=1.5, causal=mode)
        assert wanted.causal is not None
        table = np.hstack([wanted.log.t[:, None], wanted.causal.contact, wanted.causal.scaled])
        for chunk in CHUNKS:
            rows = [[row.t, *row.contact, *row.scaled] for row in replayed(path, load, chunk, mode)]
            found = np.array(rows).reshape(-1, table.shape[1])
            compared += table.size
            same = found.shape == table.shape
            different += int((found != table).sum()) if same else table.size
    return compared, different


def rms(contact: np.ndarray) -> float:
    """Return the rms of the force [N]."""
    return float(np.sqrt((contact[:, :3] ** 2).sum(axis=1).mean()))


def left(path: Path, load: Identification) -> dict[str, float]:
    """Return the residual force of a record without contact, with three kinds of offsets."""

    def of(**options: Any) -> EliminatedLog:
        return eliminate_log(path, load, causal="delayed", **options)

    own, tared, file = of(), of(causal_tare_s=TARE_AVERAGING_S), of(tare=False)
    assert own.causal is not None and tared.causal is not None and file.causal is not None
    later = tared.causal.offsets - file.offsets
    return {
        "own.zero_phase_N": rms(own.contact - own.contact.mean(axis=0)),
        "own.live_N": rms(own.causal.contact - own.causal.contact.mean(axis=0)),
        "tared.zero_phase_N": rms(file.contact - later),
        "tared.live_N": rms(tared.causal.contact),
        "file.zero_phase_N": rms(file.contact),
        "file.live_N": rms(file.causal.contact),
    }


def removed(path: Path, load: Identification) -> float:
    """Return the removed share of the force where `eliminate` has no contact."""
    found = eliminate_log(path, load, causal="delayed", causal_tare_s=TARE_AVERAGING_S)
    assert found.causal is not None
    free = ~found.touched
    return 1.0 - rms(found.causal.contact[free]) / rms(found.measured[free])


def ur5(data: Path, folder: Path) -> Iterator[Path]:
    """Return descriptions of the two records of a UR5 that have a wrench."""
    for record in ("No9_Singularity_Free_ForceSensor", "No10_Standstill_ForceSensor_All2"):
        files = {
            name: {"file": str(data / f"{record}__{name}.csv"), "header": False, "time": time}
            for name in ("log_force_sensor", "log_tool_vector")
            for time in [{"column": 0, "unit": "s"}]
        }
        first, second = {"columns": [1, 2, 3]}, {"columns": [4, 5, 6]}
        pose = second | {"form": "rotation_vector"}
        streams = {
            "wrench": files["log_force_sensor"] | {"force": first, "torque": second},
            "pose": files["log_tool_vector"] | {"orientation": pose, "position": first},
        }
        path = folder / f"{record}.yaml"
        path.write_text(json.dumps(streams))
        yield path


def utias(data: Path, folder: Path) -> Iterator[Path]:
    """Return the tools of UTIAS as canonical logs."""
    from utias import load as tool

    for file in sorted(data.glob("*.npz")):
        wrench, s, omega, alpha, _ = tool(file)
        with np.load(file) as told:
            log = Log(told["t"], wrench, s, omega, alpha)
        write_log(log, folder / f"{file.stem}.parquet")
        yield folder / f"{file.stem}.parquet"


def poses_of(records: Path, folder: Path) -> Identification:
    """Return the load of NTNU's poses at rest."""
    static = {
        "file": str(records / "0-calibration_fts-accel.csv"),
        "force": {"columns": ["fx", "fy", "fz"], "unit": "N"},
        "torque": {"columns": ["tx", "ty", "tz"], "unit": "N m"},
        "gravity": {"columns": ["gx", "gy", "gz"], "unit": "m/s^2"},
        "sign": -1,
    }
    (folder / "poses.yaml").write_text(json.dumps({"gravity": 9.82085, "static": static}))
    return identify_log(folder / "poses.yaml").identification


def load_of(path: Path) -> Identification:
    """Return the load by `identify`, or one of 1 kg."""
    try:
        return identify_log(path).identification
    except DrakeTeleopError:
        return ANY


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real records")
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG", help="additional logs")
    options = parser.parse_args()
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sample_log_command(folder / "sample", seed=0, quiet=True)
        cases = [(folder / "sample" / f"{kind}.yaml", None) for kind in ("free", "touched")]
        ntnu = options.data / "ntnu_fts_imu_contact"
        if ntnu.exists():
            poses = poses_of(ntnu, folder)
            for record in ("1-baseline", "2-vibrations"):
                path = described(ntnu, record, folder)
                figures |= {f"{record}.{key}": value for key, value in left(path, poses).items()}
                cases.append((path, poses))
        cases += [(path, None) for path in ur5(options.data / "ur5_imu_fts_contact", folder)]
        cases += [(path, None) for path in utias(options.data / "utias_workshop_tools", folder)]
        for path in options.logs:
            figures[f"{path.parent.name}.removed"] = removed(path, load_of(path))
            cases.append((path, None))
        compared = different = 0
        for path, load in cases:
            all_of, wrong = differing(path, load or load_of(path))
            print(f"{path.name:45} {all_of} numbers, {wrong} differ", flush=True)
            compared, different = compared + all_of, different + wrong
    figures |= {"logs": len(cases), "numbers": compared, "different": different}
    for key, value in figures.items():
        print(f"{key:40} {value:g}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
