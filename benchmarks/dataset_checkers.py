"""Which planted faults of a wrench do published checkers of robot-learning datasets name?

`python benchmarks/dataset_checkers.py [--bin FOLDER] [--json FILE]` plants each of the 20 faults of
`dataset.py` into episode 8 of 10 (30 fps, 0.95 kg). Then it runs `drake-teleop dataset --identify`
and the programs robovet, lerobot-doctor, rdq and kalanos of the extra `bench` (or in FOLDER). A
checker names a fault if it reports a warning or an error that it does not report for the clean
dataset. Each checker also judges the copies with our columns: its verdict must be that of the
input.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dataset import FAULTS, OTHER, TOOLS
from sample_dataset import write_sample_dataset

from drake_teleop.logs.dataset.dataset import dataset_command

_EPISODES, _FAULTY = 10, 8
Verdict = tuple[str, frozenset[str]]  # score or worst severity, and the warnings and errors


def robovet(report: Any) -> Verdict:
    found = (f"{x['check_id']} {x['severity']}" for x in report["results"])
    return report["worst"], frozenset(x for x in found if x.endswith(("WARN", "FAIL")))


def lerobot_doctor(report: Any) -> Verdict:
    found = {
        f"{check['name']}: {message['message']}"
        for check in report["checks"]
        for message in check["messages"]
        if message["severity"] in ("WARN", "FAIL")
    }
    return report["overall_severity"], frozenset(found)


def rdq(report: Any) -> Verdict:
    found = (json.dumps(finding, sort_keys=True) for finding in report["findings"])
    return str(report["score"]["dataset_score"]), frozenset(found)


def kalanos(report: Any) -> Verdict:
    found = [json.dumps(finding, sort_keys=True) for finding in report["findings"]]
    failing = [f"{episode} fails" for episode in report["gate"]["failing_episodes"]]
    return str(report["score"]["score"]), frozenset(found + failing)


CHECKERS: dict[str, tuple[list[str], Callable[[Any], Verdict]]] = {
    "robovet": (["doctor", "DATASET", "--json", "REPORT"], robovet),
    "lerobot-doctor": (["check", "DATASET", "--json"], lerobot_doctor),
    "rdq": (["check", "DATASET", "--json", "REPORT"], rdq),
    "kalanos": (["grade", "DATASET", "--json"], kalanos),
}


def verdict(program: str, name: str, dataset: Path) -> Verdict:
    """Return what the checker reports of a dataset; exit codes are verdicts too, not failures."""
    words, read = CHECKERS[name]
    report = dataset.parent / f"{name}.json"
    places = {"DATASET": dataset.name, "REPORT": report.name}
    command = [program, *(places.get(word, word) for word in words)]
    done = subprocess.run(command, cwd=dataset.parent, capture_output=True, text=True)
    if "REPORT" not in words:
        report.write_text(done.stdout)
    return read(json.loads(report.read_text()))


def judge(folder: Path, fault: str | None, programs: dict[str, str]) -> dict[str, Any]:
    """Write one dataset and return our verdict and those of the checkers, before and after."""
    phi = TOOLS[0]
    changes = {k: {"phi": phi} for k in range(_EPISODES)}
    faults = {}
    if fault:
        faults[_FAULTY] = lambda x: FAULTS[fault][1](x, phi)
    if fault == "other tool":
        changes[_FAULTY] = {"phi": OTHER}
    write_sample_dataset(folder / "in", episodes=_EPISODES, faults=faults, changes=changes)
    ours = dataset_command(folder / "in", folder / "out", identify=True, quiet=True)["episodes"]
    result: dict[str, Any] = {"ours": [row["verdict"] for row in ours]}
    (folder / "copy").mkdir()
    shutil.move(folder / "out" / "in", folder / "copy" / "in")
    for name, program in programs.items():
        before = verdict(program, name, folder / "in")
        result[name] = {"before": before, "after": verdict(program, name, folder / "copy" / "in")}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=Path, help="folder of the programs (default: those of PATH)")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    folder = given.bin or Path(sys.executable).parent
    programs = {name: shutil.which(name, path=str(folder)) or name for name in CHECKERS}
    with tempfile.TemporaryDirectory() as place:
        clean = judge(Path(place) / "clean", None, programs)
        rows = []
        for index, (fault, (expected, _)) in enumerate(FAULTS.items()):
            found = judge(Path(place) / str(index), fault, programs)
            named = {
                name: bool(found[name]["before"][1] - clean[name]["before"][1]) for name in programs
            }
            same = {name: found[name]["before"] == found[name]["after"] for name in programs}
            ours = set(found["ours"].pop(_FAULTY)) == expected
            false = sum(row != ["ok"] for row in found["ours"])
            row = {"fault": fault, "ours": ours, "ours_false": false}
            rows.append(row | {"named": named, "same": same})
            print(json.dumps(rows[-1]), flush=True)
    same = {name: clean[name]["before"] == clean[name]["after"] for name in programs}
    report = {
        "faults": len(rows),
        "clean": {"ours_false": sum(row != ["ok"] for row in clean["ours"]), "same": same},
        "named_by_ours": sum(row["ours"] for row in rows),
        "named": {name: sum(row["named"][name] for row in rows) for name in programs},
        "score_of_clean": {name: clean[name]["before"][0] for name in programs},
        "same_verdict": {
            name: same[name] + sum(row["same"][name] for row in rows) for name in programs
        },
        "rows": rows,
    }
    print(json.dumps({key: value for key, value in report.items() if key != "rows"}, indent=2))
    if given.json:
        given.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
