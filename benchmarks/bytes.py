"""Do the commands write the same bytes, whatever the environment?

`python benchmarks/bytes.py [--all] [--json FILE]` executes drake-teleop run, reproduce, sample-log,
identify, eliminate, detect, inspect, study, excite and analyze with new output folders. The
combinations of BLAS threads, hash seeds, time zones, folders and locales contain every pair of
values. With --all every combination is tried, without analyze and with shorter runs (`SHORTER`).
The SHA-256 of all files except `session.json` are compared with those of the first combination.
The baseline repeats the first combination: differences there have other causes. Each combination
identifies its loads anew.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

SURROUNDINGS = {
    "threads": ("1", "2", "4"),
    "hash_seed": ("0", "4242"),
    "time_zone": ("UTC", "Pacific/Auckland"),
    "folder": ("plain", "mit Käse überbacken"),
    "locale": ("C.UTF-8", "POSIX"),
}
Combination: TypeAlias = tuple[str, ...]
"""One value of each part of the environment, in the order of `SURROUNDINGS`."""
Command: TypeAlias = Sequence[str]

FILES = {
    "study.yaml": """
scenario: reach
factors:
  - {field: force_scaling.sigma, low: 0.0, high: 1.0}
  - {field: wrist_sensor.preset, words: [ideal, ati_gamma_imu]}
  - {field: simulation.duration, values: [0.5]}
""",
    "short.yaml": """
simulation: {duration: 0.2, settle: 0.05}
operator:
  grip: firm
  intent: [!Sine {duration: 10.0, ramp: 0.1, frequency: 3.0, translation: [0.01, 0.01, 0.02]}]
load_estimator: {enabled: true}
channel: {network: internet}
""",
    "short_study.yaml": """
scenario: short.yaml
factors: [{field: force_scaling.sigma, low: 0.0, high: 1.0}]
""",
}
COMMANDS: dict[str, Command] = {
    "run": ("run", "contact_transition"),
    "run_task": ("run", "insert"),
    "reproduce": ("reproduce",),
    "sample_log": ("sample-log",),
    "identify": ("identify", "out/sample_log/free.yaml"),
    "eliminate": (
        *("eliminate", "out/sample_log/touched.yaml"),
        *("--load", "out/identify/identification.json"),
    ),
    "detect": ("detect", "out/sample_log/touched.yaml"),
    "inspect": ("inspect", "out/sample_log/free.yaml"),
    "study": ("study", "study.yaml", "--jobs", "2"),
    "excite": ("excite",),
    "analyze": ("analyze", "contact_transition"),
}
SHORTER: dict[str, Command] = {
    **{name: words for name, words in COMMANDS.items() if name not in ("run_task", "analyze")},
    "run": ("run", "short.yaml"),
    "detect": (*COMMANDS["detect"], "--load", "out/identify/identification.json"),
    "study": ("study", "short_study.yaml", "--jobs", "2"),
    "excite": ("excite", "--period", "1", "--harmonics", "2"),
}
"""Changes of `COMMANDS` for every combination."""
IN_ONE_PROCESS = """
import json, sys
from drake_teleop.cli.main import main
for words in json.loads(sys.argv[1]):
    try:
        main(words)
    except SystemExit as stop:
        if stop.code:
            raise
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--all", action="store_true", help="try every combination")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    everything = list(itertools.product(*SURROUNDINGS.values()))
    combinations, commands = pairwise(everything), COMMANDS
    if arguments.all:  # the most different combination first, because the others take long
        combinations += [each for each in everything if each not in combinations]
        commands = SHORTER
    with tempfile.TemporaryDirectory() as folder:
        figures = compared([combinations[0], *combinations], commands, Path(folder))
    for name, figure in figures.items():
        print(f"{name:22s} {figure}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


def pairwise(everything: Sequence[Combination]) -> list[Combination]:
    """Return combinations that contain each pair of values of different parts."""
    left = set().union(*map(pairs, everything))
    chosen: list[Combination] = []
    while left:
        chosen.append(max(everything, key=lambda each: len(pairs(each) & left)))
        left -= pairs(chosen[-1])
    return chosen


def pairs(combination: Combination) -> set[object]:
    """Return all pairs of values of a combination, with their positions."""
    return set(itertools.combinations(enumerate(combination), 2))


def compared(
    combinations: Sequence[Combination], commands: dict[str, Command], folder: Path
) -> dict[str, object]:
    """Return the number of files, and for each command those that were not always the same."""
    reference: dict[str, str] = {}
    differ: dict[str, set[str]] = {name: set() for name in commands}
    start = time.monotonic()
    for number, combination in enumerate(combinations):
        found = written(combination, commands, folder / str(number))
        reference = reference or found
        files = found.keys() | reference.keys()
        others = [file for file in files if found.get(file) != reference.get(file)]
        for file in others:
            differ[file.split("/")[0]].add(f"{file} ({', '.join(combination)})")
        print(f"{number}: {', '.join(combination)}: {len(others)} differ", file=sys.stderr)
    return {
        "combinations": len(combinations),
        "files": len(reference),
        **{f"{name}_differ": sorted(files) for name, files in differ.items()},
        "minutes": round((time.monotonic() - start) / 60, 1),
    }


def written(
    combination: Combination,
    commands: dict[str, Command],
    folder: Path,
    program: str = IN_ONE_PROCESS,
) -> dict[str, str]:
    """Return the `digests` of the commands' output in a process with this environment."""
    threads, hash_seed, time_zone, name, locale = combination
    place = folder / name
    place.mkdir(parents=True)
    for file, text in FILES.items():
        (place / file).write_text(text)
    surroundings = {
        "OPENBLAS_NUM_THREADS": threads,
        "OMP_NUM_THREADS": threads,
        "PYTHONHASHSEED": hash_seed,
        "TZ": time_zone,
        "LC_ALL": locale,
        "DRAKE_TELEOP_CACHE_DIR": str(place / "cache"),
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    subprocess.run(
        [sys.executable, "-c", program, json.dumps(typed(commands))],
        cwd=place,
        env={**os.environ, **surroundings},
        check=True,
    )
    return digests(place / "out")


def typed(commands: dict[str, Command]) -> list[list[str]]:
    """Return the words of each command, with its output folder."""
    return [[*words, "--out", f"out/{name}", "--quiet"] for name, words in commands.items()]


def digests(out: Path) -> dict[str, str]:
    """Return the SHA-256 of each file in a folder by its name, except those of a session."""
    return {
        file.relative_to(out).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in out.rglob("*")
        if file.is_file() and file.name != "session.json"
    }


if __name__ == "__main__":
    main()
