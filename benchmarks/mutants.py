"""Which mistakes in the numeric code would no test notice?

The script plants seeded mistakes, one at a time (`mutations.py`), in all files that compute. A
file's share is proportional to the root of its number of places for mistakes. For each mistake the
related tests run, the most direct and quickest first, until one fails. A mutant that passes all of
them has survived: it needs a test, or a reason in `mutants_equivalent.yaml` why no result changes.

    python benchmarks/mutants.py [--number 220] [--seed 0] [--only FILE ...] [--near] [--jobs 2]

It works on copies in a temporary folder. Results are written at once, so that the same command
continues after an interruption; `--again` runs the survivors again. Each mutant runs in a fork of
this process, which has already imported the libraries.
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import multiprocessing
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import yaml
from mutations import Mutation, mutations

PACKAGE = "drake_teleop"
GROUPS = ("station", "lab", "live")
"""Packages whose subpackages have test folders of their own."""
#: Tests of texts and long runs, which do not check single numbers of one package.
LEFT_OUT = {"test_benchmarks", "test_layers", "test_notebooks", "test_packaging", "test_quality"}
LEFT_OUT |= {"test_readme", "test_language"}
#: Limit of the CPU time of a test [s]; compilation takes most of it.
ENDLESS = 120
_LIBRARIES = """pytest hypothesis.strategies numba scipy.linalg scipy.optimize scipy.stats
scipy.signal matplotlib.pyplot control pydantic yaml pydrake.geometry pydrake.multibody.plant
pydrake.multibody.parsing pydrake.systems.analysis pydrake.systems.primitives"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--number", type=int, default=220, help="number of mutants (default: 220)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[""], help="parts of the paths of files")
    parser.add_argument("--near", action="store_true", help="run only tests of the package or file")
    parser.add_argument("--marks", default="not checks", help="marks of the tests, as pytest's -m")
    parser.add_argument("--jobs", type=int, default=2, help="number of parallel processes")
    parser.add_argument(
        "--budget", type=float, default=60.0, help="time of the tests for one mutant [s]"
    )
    parser.add_argument("--again", action="store_true", help="run survivors again")
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1])
    parser.add_argument(
        "--folder", type=Path, help="folder of copies and records (default: temporary)"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    root = arguments.root.resolve()
    folder = arguments.folder or Path(tempfile.gettempdir()) / f"{PACKAGE}_mutants"
    folder.mkdir(parents=True, exist_ok=True)
    made = sample(root, arguments.number, arguments.seed, arguments.only)
    records = tested(root, folder.resolve(), made, arguments)
    figures = summary(records)
    report(records, figures)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


def numeric_files(root: Path, only: Iterable[str] = ("",)) -> list[str]:
    """Return the files that compute and neither draw nor print."""
    files = []
    for path in sorted((root / PACKAGE).rglob("*.py")):
        file, text = path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")
        shows = path.name == "verdict.py" or re.search(
            rf"^\s*(from|import) (matplotlib|rich|{PACKAGE}\.common\.style)\b", text, re.M
        )
        if (
            any(part in file for part in only)
            and not shows
            and "/cli/" not in file
            and path.name != "__init__.py"
        ):
            files.append(file)
    return files


def package_of(file: str) -> str:
    """Return the name of a file's package, which is that of the folder of its tests."""
    parts = file.split("/")[1:-1]
    return parts[1] if len(parts) > 1 and parts[0] in GROUPS else parts[0]


def folder_of(file: str) -> str:
    """Return a file's subpackage, for the statistics."""
    return "/".join(file.split("/")[1:-1])


def sample(root: Path, number: int, seed: int, only: Iterable[str] = ("",)) -> list[Mutation]:
    """Return mutants of all numeric files; those of a file depend only on the seed and the file."""
    sites = {
        file: mutations(file, (root / file).read_bytes()) for file in numeric_files(root, only)
    }
    sites = {file: found for file, found in sites.items() if found}
    weights = {file: math.sqrt(len(found)) for file, found in sites.items()}
    chosen, before = [], 0.0
    for file, found in sites.items():
        after = before + number * weights[file] / sum(weights.values())
        draws = random.Random(f"{seed} {file}")
        chosen += _some(found, round(after) - round(before), draws, (root / file).read_bytes())
        before = after
    return chosen


def _some(
    found: list[Mutation], number: int, draws: random.Random, source: bytes
) -> list[Mutation]:
    """Choose mutants with equal probability of all kinds, on different lines if possible."""
    left, chosen = list(found), []
    while left and len(chosen) < number:
        lines = {mutant.line for mutant in chosen}
        free = [mutant for mutant in left if mutant.line not in lines] or left
        kind = draws.choice(sorted({mutant.kind for mutant in free}))
        mutant = draws.choice([mutant for mutant in free if mutant.kind == kind])
        left.remove(mutant)
        if mutant.valid(source):
            chosen.append(mutant)
    return sorted(chosen, key=lambda mutant: mutant.start)


# Which tests are related to a file.


def imports(root: Path) -> dict[str, set[str]]:
    """Return for each file of package and tests the files that it imports, lazily or not."""
    paths = [*(root / PACKAGE).rglob("*.py"), *(root / "tests").rglob("*.py")]
    files = {path.relative_to(root).as_posix(): path for path in paths}
    modules = {file.removesuffix(".py").replace("/", "."): file for file in files}
    modules |= {name.removesuffix(".__init__"): file for name, file in modules.items()}
    trees = {file: ast.parse(path.read_bytes()) for file, path in files.items()}
    # The package re-exports names of the modules that it imports.
    homes = {
        alias.name: modules[node.module]
        for node in ast.walk(trees[f"{PACKAGE}/__init__.py"])
        if isinstance(node, ast.ImportFrom) and node.module in modules
        for alias in node.names
    }
    found: dict[str, set[str]] = {}
    for file, tree in trees.items():
        neighbours = ".".join(file.split("/")[:-1])
        names = found.setdefault(file, set())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                wholes = [f"{node.module}.{alias.name}" for alias in node.names]
                wholes += [node.module, f"{neighbours}.{node.module}"]
            elif isinstance(node, ast.Import):
                wholes = [n for a in node.names for n in (a.name, f"{neighbours}.{a.name}")]
            else:
                continue
            names |= {modules[whole] for whole in wholes if whole in modules}
        if f"{PACKAGE}/__init__.py" in names and file.startswith("tests"):
            words = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
            words |= {
                a.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names
            }
            names |= {home for name, home in homes.items() if name in words}
        names.discard(f"{PACKAGE}/__init__.py")
    return found


def distances(graph: dict[str, set[str]], start: str) -> dict[str, int]:
    """Return the number of imports from `start` to each file that it reaches."""
    reached, layer = {start: 0}, {start}
    while layer:
        # The command line imports all modules; the test of a command uses only some.
        layer = {
            f for file in layer - {f"{PACKAGE}/cli/main.py"} for f in graph[file]
        } - reached.keys()
        reached |= dict.fromkeys(layer, max(reached.values()) + 1)
    return reached


def remoteness(file: str, test: str, reach: dict[str, int]) -> int:
    """Return 0 for a test file of the package that imports `file`, 1 if it is one of the two.

    Tests of the whole have 2, others 3.
    """
    package, folder = package_of(file), test.split("/")[1]
    direct, near = reach[file] == 1, folder in (package, f"test_{package}.py")
    return 2 - direct - near if direct or near else 2 if test.count("/") == 1 else 3


def related(
    file: str, reach: dict[str, dict[str, int]], seconds: dict[str, float], budget: float
) -> list[str]:
    """Return test files that import `file`, nearest and quickest first, within `budget` seconds."""
    tests = sorted(
        (test for test in seconds if file in reach[test]),
        key=lambda test: (remoteness(file, test, reach[test]), seconds[test]),
    )
    sums = [sum(seconds[test] for test in tests[:count]) for count in range(len(tests))]
    return [
        test
        for test, before in zip(tests, sums, strict=True)
        if before < budget or remoteness(file, test, reach[test]) == 0
    ]


# Running them.


def tested(
    root: Path, folder: Path, made: list[Mutation], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """Return the record of each mutant, from the file of records or new."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends the forks too, see below
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    for library in _LIBRARIES.split():
        import_module(library)
    tree, path = folder / "tree", folder / "records.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    known = {record["mutant"]: record for record in map(json.loads, lines)}
    names = {mutant: _name(mutant, (root / mutant.file).read_bytes()) for mutant in made}
    wanted = [
        mutant
        for mutant in made
        if names[mutant] not in known
        or (arguments.again and known[names[mutant]]["outcome"] == "survived")
    ]
    if wanted:
        files = {mutant.file for mutant in wanted}
        reach, seconds = warmed(root, tree, folder, files, arguments)
    # In random order, so that an interrupted run is a sample of all packages.
    random.Random(arguments.seed).shuffle(wanted)
    running: dict[Any, tuple[Mutation, Fork]] = {}
    try:
        while wanted or running:
            while wanted and len(running) < arguments.jobs:
                mutant = wanted.pop()
                tests = related(mutant.file, reach, seconds, arguments.budget)
                fork = Fork(_copy(tree, folder, mutant), tests, arguments.marks)
                running[fork.process.sentinel] = mutant, fork
            for sentinel in _over(running):
                mutant, fork = running.pop(sentinel)
                _keep_compiled(fork.tree, tree)
                record = _record(mutant, (root / mutant.file).read_bytes()) | fork.result()
                for test, duration in record.pop("durations").items():
                    seconds[test] = min(seconds.get(test, math.inf), duration)
                known[record["mutant"]] = record
                with path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(record) + "\n")
                done = f"{sum(name in known for name in names.values())}/{len(made)}"
                place = f"{mutant.file}:{mutant.line}"
                print(done, record["outcome"], place, record["new"], flush=True)
    finally:
        for _, fork in running.values():
            fork.result()
    return [known[name] for name in names.values()]


def _over(running: dict[Any, tuple[Mutation, Fork]]) -> list[Any]:
    """Return forks that have ended, or that wait too long."""
    over = wait(list(running), timeout=5.0)
    return over or [each for each, (_, fork) in running.items() if fork.waits_too_long()]


def _record(mutant: Mutation, source: bytes) -> dict[str, Any]:
    old, new = mutant.lines(source)
    place = {"file": mutant.file, "line": mutant.line, "kind": mutant.kind}
    return {"mutant": _name(mutant, source)} | place | {"old": old, "new": new}


def _name(mutant: Mutation, source: bytes) -> str:
    """Return the identifier in the records: text and place."""
    return " ".join([mutant.file, str(mutant.start), *mutant.lines(source)])


def warmed(
    root: Path, tree: Path, folder: Path, files: Iterable[str], arguments: argparse.Namespace
) -> tuple[dict[str, dict[str, int]], dict[str, float]]:
    """Make `tree` a copy of `root` with all code compiled that the tests need.

    Returns:
        The files that each test file reaches, and the time [s] of each that passed and reaches any
        of
        `files`.
    """
    changed = _renewed(root, tree)
    graph = imports(tree)
    tests = [
        file
        for file in graph
        if Path(file).name.startswith("test_") and Path(file).stem not in LEFT_OUT
    ]
    reach = {test: distances(graph, test) for test in tests}
    known = folder / "seconds.json"
    seconds = json.loads(known.read_text()) if known.exists() else {}
    seconds = {
        test: duration
        for test, duration in seconds.items()
        if test in reach and not changed & reach[test].keys()
    }
    farthest = 1 if arguments.near else 3
    new = [
        test
        for test in tests
        if test not in seconds
        and any(f in reach[test] and remoteness(f, test, reach[test]) <= farthest for f in files)
    ]
    print(f"{len(new)} test files without any mutant", flush=True)
    for test in sorted(new):  # one by one: a test that fails without a mutant has no meaning
        fork = Fork(tree, [test], arguments.marks)
        while fork.process.is_alive() and not fork.waits_too_long():
            fork.process.join(5.0)
        result = fork.result()
        if result["outcome"] == "survived":
            seconds[test] = sum(result["durations"].values())
        else:
            print(f"{test} fails without any mutant: {result['killer']}", flush=True)
        known.write_text(json.dumps(seconds))
    return reach, {test: duration for test, duration in seconds.items() if test in reach}


def _renewed(root: Path, tree: Path) -> set[str]:
    """Copy changed files of `root` to `tree`; return them."""

    def files(folder: Path) -> set[str]:
        kept = set()
        for path, folders, names in os.walk(folder):
            hidden = {".", "__pycache__", "out"}
            folders[:] = [f for f in folders if f not in hidden and not f.startswith(".")]
            kept |= {(Path(path) / n).relative_to(folder).as_posix() for n in names if n[0] != "."}
        return kept

    new, old = files(root), files(tree) if tree.exists() else set()
    changed = {f for f in new & old if (root / f).read_bytes() != (tree / f).read_bytes()}
    changed |= new ^ old
    for file in changed:
        (tree / file).unlink(missing_ok=True)
        if file in new:
            (tree / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / file, tree / file)
    return changed


def _copy(tree: Path, folder: Path, mutant: Mutation) -> Path:
    """Return a copy of the tree, by links to its files except for the mutated one."""
    copy = Path(tempfile.mkdtemp(dir=folder, prefix="mutant_")) / "tree"
    shutil.copytree(tree, copy, copy_function=os.link)
    source = (copy / mutant.file).read_bytes()
    (copy / mutant.file).unlink()
    (copy / mutant.file).write_bytes(mutant.applied(source))
    return copy


def _keep_compiled(copy: Path, tree: Path) -> None:
    """Link the code that a mutant's tests have compiled; its name identifies its source."""
    for code in copy.rglob("*.nbc"):
        kept = tree / code.relative_to(copy)
        kept.parent.mkdir(exist_ok=True)
        with suppress(FileExistsError):
            os.link(code, kept)


class Fork:
    """Process that runs tests until one fails."""

    def __init__(self, tree: Path, tests: list[str], marks: str) -> None:
        self.tree, self.tests = tree, tests
        self.found = tree.parent / "found.json"
        self.found.unlink(missing_ok=True)
        self._start = time.monotonic()
        context = multiprocessing.get_context("fork")
        self.process = context.Process(target=_run, args=(tree, tests, marks, self.found))
        self.process.start()

    def waits_too_long(self) -> bool:
        """Return whether the process stands still, by a wall time that suits a busy machine."""
        return time.monotonic() - self._start > 20 * ENDLESS

    def result(self) -> dict[str, Any]:
        """Return the result; remove the tree unless it is the one without a mutant."""
        if self.process.is_alive():
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.join()
        found = json.loads(self.found.read_text()) if self.found.exists() else {"durations": {}}
        code = self.process.exitcode
        outcome = "survived" if code == 0 else "killed"
        if code in (-signal.SIGVTALRM, -signal.SIGKILL):
            outcome = "timed out"
        if self.tree.name == "tree" and self.tree.parent.name.startswith("mutant_"):
            shutil.rmtree(self.tree.parent, ignore_errors=True)
        return {
            "outcome": outcome,
            "killer": found.get("killer", f"exit code {code}" if code else ""),
            "message": found.get("message", ""),
            "seconds": round(time.monotonic() - self._start, 1),
            "tests": len(self.tests),
            "durations": found["durations"],
        }


def _run(tree: Path, tests: list[str], marks: str, found: Path) -> None:
    """Run the tests in the fork; its exit code is pytest's."""
    import pytest

    os.setsid()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.nice(10)
    with (tree.parent / "output.txt").open("w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    os.chdir(tree)
    sys.path[:1] = [str(tree)]
    os.environ["PYTHONPATH"] = str(tree)
    # Variables of an outer pytest: its plugins are not available here.
    for name in ("PYTEST_ADDOPTS", "PYTEST_PLUGINS"):
        os.environ.pop(name, None)
    options = [
        "-x",
        "-q",
        "--tb=short",
        "--no-header",
        "-p",
        "no:cacheprovider",
        "-m",
        marks,
        f"--rootdir={tree}",
    ]
    options.append(f"--basetemp={tree.parent / 'temporary'}")
    code = 0
    # In two parts: collecting the far tests imports and compiles more than the near ones need.
    for part in (tests[:3], tests[3:]):
        if part and code == 0:
            code = int(pytest.main([*options, *part], plugins=[_Watch(found)]))
            code = 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else code
    sys.stdout.flush()
    os._exit(code)


class _Watch:
    """Plugin of pytest that records times and the first failure, and ends endless tests."""

    def __init__(self, found: Path) -> None:
        self._found = found
        self._notes = json.loads(found.read_text()) if found.exists() else {"durations": {}}

    def pytest_sessionstart(self) -> None:
        # Byte code counts as current by whole seconds and length, so old code would be used after a
        # change and its reversal. tests/conftest.py has enabled it.
        os.environ["PYTHONDONTWRITEBYTECODE"], sys.dont_write_bytecode = "1", True

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._spent = sum(os.times()[:4])  # with its children; other programs do not affect it
        # The kernel ends the process, because compiled code never calls a handler. The current test
        # is stored before it starts.
        self._write(killer=nodeid, message="endless or crashed")
        signal.setitimer(signal.ITIMER_VIRTUAL, ENDLESS)

    def pytest_runtest_logreport(self, report: Any) -> None:
        file = report.nodeid.partition("::")[0]
        durations = self._notes["durations"]
        durations[file] = durations.get(file, 0.0) + sum(os.times()[:4]) - self._spent
        self._spent = sum(os.times()[:4])
        if report.failed:
            self._fail(report)

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self._fail(report)

    def pytest_sessionfinish(self) -> None:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        if not self._notes.get("failed"):
            self._notes.pop("killer", None)
            self._notes.pop("message", None)
        self._write()

    def _fail(self, report: Any) -> None:
        self._notes["failed"] = True
        crash = getattr(report.longrepr, "reprcrash", None)
        message = crash.message if crash else str(report.longrepr)
        self._write(killer=report.nodeid, message=message[-200:] if not crash else message[:200])

    def _write(self, **notes: str) -> None:
        if notes and not (self._notes.get("failed") and "endless" in notes["message"]):
            self._notes |= notes
        self._found.write_text(json.dumps(self._notes))


# Results.


def explanations() -> dict[tuple[str, str, str], str]:
    """Return the reasons why survivors change no result, by file, old lines and new lines."""
    path = Path(__file__).with_name("mutants_equivalent.yaml")
    entries = yaml.safe_load(path.read_text(encoding="utf-8")) or []
    return {(entry["file"], entry["old"], entry["new"]): entry["why"] for entry in entries}


def summary(records: list[dict[str, Any]]) -> dict[str, float]:
    """Return figures by name: of all, and of each package."""
    known, counts = explanations(), Counter()
    for record in records:
        for group in ("all", folder_of(record["file"])):
            counts[f"{group}.made"] += 1
            counts[f"{group}.{record['outcome'].replace(' ', '_')}"] += 1
            if record["outcome"] == "survived":
                explained = (record["file"], record["old"], record["new"]) in known
                counts[f"{group}.explained"] += explained
    figures = {name: float(count) for name, count in sorted(counts.items())}
    noticed = counts["all.killed"] + counts["all.timed_out"]
    figures["all.killed_percent"] = 100.0 * noticed / max(counts["all.made"], 1)
    return figures


def report(records: list[dict[str, Any]], figures: dict[str, float]) -> None:
    known = explanations()
    for record in records:
        if record["outcome"] == "survived":
            print(f"\n{record['file']}:{record['line']} ({record['kind']})")
            print("\n".join(f"  - {line}" for line in record["old"].splitlines()))
            print("\n".join(f"  + {line}" for line in record["new"].splitlines()))
            why = known.get((record["file"], record["old"], record["new"]), "NO TEST NOTICES")
            print(f"  {why}")
    print()
    names = ("made", "killed", "timed_out", "survived", "explained")
    print(f"{'':24s}" + "".join(f"{name:>11s}" for name in names))
    for package in sorted({name.partition(".")[0] for name in figures}):
        cells = [figures.get(f"{package}.{name}", 0.0) for name in names]
        print(f"{package:24s}" + "".join(f"{cell:11.0f}" for cell in cells))
    print(f"noticed: {figures['all.killed_percent']:.1f} %")


if __name__ == "__main__":
    main()
