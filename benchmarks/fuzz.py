"""Does every damaged file or option end in a result or in one error line?

The fuzzer damages good inputs by grammar and passes them to every reader (`fuzz_targets.py`,
`fuzz_mutations.py`). A case is a finding

* if it raises anything but a DrakeTeleopError of one line of at most 1000 characters;
* if a warning or other text reaches stderr;
* if it takes more than 5 s of CPU (or a minute in all) or more than 4 GB;
* if its process dies.

    python benchmarks/fuzz.py [--seconds 60] [--seed 0] [--only scenario,sdf] [--json FILE]
    python benchmarks/fuzz.py --replay FILE          # one case again, in this process

Each finding is written to a folder, once for each code line that raises it, with the command that
repeats it; the exit status is then 1. The sequence of cases of a target depends only on the seed,
their number on the time.

Coverage guides the choice of inputs: the lines of the package that every fourth case reaches are
recorded, and a case that reaches a new line becomes an input for further cases. The fuzzer is not a
published tool for these reasons (2026): Atheris does not continue after an abort or a hang, and has
no wheels for macOS and Python 3.10. Its changes of bytes do not pass a parser, so that grammars
would be necessary all the same. Hypothesis needs a test that names the numbers to maximise, and its
cases change from version to version.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import math
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # before libraries read it
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    os.environ |= {"POLARS_MAX_THREADS": "1"}

from fuzz_targets import TARGETS, Target, target_of

import drake_teleop
from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError
from drake_teleop.common.progress import show_progress

_PACKAGE = str(Path(drake_teleop.__file__).parent)
_CPU_SECONDS, _SECONDS, _BYTES = 5.0, 60.0, 4 << 30
_DEATHS = {signal.SIGPROF: f"more than {_CPU_SECONDS:g} s of CPU"}
_DEATHS |= {signal.SIGALRM: f"more than {_SECONDS:g} s"}
_TRACED = 4  # one case of this number is traced
_LONGEST = 20_000  # bytes; longest case that becomes an input, beyond the length of the good inputs


def main() -> None:
    """Run the targets in parallel and report."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the whole run [s]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="number of parallel processes")
    parser.add_argument("--only", default="", help="targets, separated by commas")
    parser.add_argument("--cases", type=int, help="cases of each target, in place of --seconds")
    parser.add_argument("--folder", type=Path, help="folder of findings (default: out/fuzz)")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--replay", type=Path, metavar="FILE", help="file of a case, named TARGET-anything.suffix"
    )
    arguments = parser.parse_args()
    if arguments.replay:
        replay(arguments.replay)
        return
    targets = [t for t in TARGETS if not arguments.only or t.name in arguments.only.split(",")]
    with tempfile.TemporaryDirectory(prefix="fuzz_") as folder:
        found = fuzzed(targets, arguments, Path(folder))
    figures = report(found, arguments.folder or Path("out/fuzz"))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    sys.exit(1 if figures["findings"] else 0)


def replay(path: Path) -> None:
    """Run one case, named TARGET-anything, in this process, for use with a debugger."""
    target = target_of(path)
    with tempfile.TemporaryDirectory() as folder:
        target.seeds(Path(folder))
        case = Path(folder) / f"case{target.suffix}"
        case.write_bytes(path.read_bytes())
        try:
            target.run(case)
        except DrakeTeleopError as error:
            print(f"error: {error}")
        else:
            print("no error")


# One process: the cases of one target in sequence.


@dataclass
class State:
    """Progress of a target; a process that replaces a dead one starts with it."""

    target: Target
    folder: Path
    seconds: float
    counts: Any  # shared by the processes: cases, refused cases, whether a case is in preparation
    kept: list[bytes] = field(default_factory=list)
    lines: set[tuple[str, int]] = field(default_factory=set)
    findings: dict[str, Finding] = field(default_factory=dict)

    def keep(self, content: bytes, lines: set[tuple[str, int]]) -> None:
        """Add an input that reached these lines."""
        self.kept.append(content)
        self.lines |= lines

    def find(self, content: bytes, place: str, what: str) -> None:
        """Count a finding; keep the shortest content of each place."""
        finding = self.findings.setdefault(place, Finding(content, what))
        finding.times += 1
        if len(content) < len(finding.content):
            finding.content, finding.what = content, what


@dataclass
class Finding:
    """Finding with its content."""

    content: bytes
    what: str
    times: int = 0


def work(state: State, seed: int, most: float, pipe: Connection) -> None:
    """Run cases until the time is up; send findings at once, because the process may die."""
    end = time.monotonic() + state.seconds
    target, errors = state.target, _quiet(state.folder)
    case = state.folder / f"case{target.suffix}"
    good = target.seeds(state.folder)
    for content in good:  # good inputs must pass, otherwise the mutations mean little
        case.write_bytes(content)
        with _traced(state.lines):
            target.run(case)
    os.ftruncate(errors, 0)
    _limit_memory()
    longest = max(map(len, good)) + _LONGEST
    while state.counts[0] < most and time.monotonic() < end:
        rng = random.Random(f"{seed} {target.name} {state.counts[0]}")
        pool = state.kept if state.kept and rng.random() < 0.5 else good
        origin = rng.choice(pool)
        # If the process dies while it makes a case, the original is left, and the next process
        # continues.
        case.write_bytes(origin)
        state.counts[0] += 1
        state.counts[2] = 1
        content = target.mutate(rng, origin, rng.choice(good))
        state.counts[2] = 0
        os.ftruncate(errors, 0)  # messages of libraries while a case is made
        case.write_bytes(content)
        lines: set[tuple[str, int]] = set()
        with _traced(lines) if state.counts[0] % _TRACED == 0 else nullcontext():
            kind, *finding = _outcome(target, case, errors)
        state.counts[1] += kind == "refused"
        if finding:
            pipe.send((State.find, content, *finding))
        if not lines <= state.lines and len(content) < longest:
            state.keep(content, lines)
            pipe.send((State.keep, content, lines))


def _quiet(folder: Path) -> int:
    """Discard the standard output, send errors to a file, and return the file."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    errors = os.open(folder / "stderr", os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
    for number, file in ((0, nowhere), (1, nowhere), (2, errors)):
        os.dup2(file, number)
    warnings.simplefilter("always")
    for kind in (DeprecationWarning, PendingDeprecationWarning, ResourceWarning):
        warnings.simplefilter("ignore", kind)  # as Python does
    faulthandler.enable(errors)
    for late in _DEATHS:
        faulthandler.register(late, errors, all_threads=False, chain=True)
    return errors


def _limit_memory() -> None:
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + _BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


@contextmanager
def _traced(lines: set[tuple[str, int]]) -> Iterator[None]:
    """Record the lines of the package that are reached."""

    def in_function(frame: Any, event: str, _: Any) -> Any:
        lines.add((frame.f_code.co_filename, frame.f_lineno))
        return in_function

    def anywhere(frame: Any, event: str, _: Any) -> Any:
        return in_function if frame.f_code.co_filename.startswith(_PACKAGE) else None

    sys.settrace(anywhere)
    try:
        yield
    finally:
        sys.settrace(None)


def _outcome(target: Target, case: Path, errors: int) -> tuple[str, ...]:
    """Return ("good",), ("refused",) for one error line, or ("finding", place, what)."""
    # The kernel ends a process that exceeds its time, in any state.
    signal.setitimer(signal.ITIMER_PROF, _CPU_SECONDS)
    signal.setitimer(signal.ITIMER_REAL, _SECONDS)
    outcome: tuple[str, ...] = ("good",)
    try:
        target.run(case)
    except DrakeTeleopError as error:
        line, outcome = str(error), ("refused",)
        if len(line) > MAX_ERROR_LINE_LENGTH or len(line.splitlines()) != 1:
            what = f"a message of {len(line)} characters: {line}"
            outcome = "finding", _place(traceback.format_exc()), what
    except BaseException as error:
        said = traceback.format_exc()
        outcome = "finding", f"{type(error).__name__} at {_place(said)}", said
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    sys.stderr.flush()
    if said := os.pread(errors, 10_000, 0).decode(errors="replace"):
        os.ftruncate(errors, 0)
        outcome = "finding", "stderr " + re.sub(r"[\d.e+-]+", "0", said)[:80], said
    return outcome


def _place(said: str) -> str:
    """Return the innermost line of the package in a traceback."""
    places = re.findall(rf'File "{re.escape(_PACKAGE)}/(.*)", line (\d+)', said)
    in_order = places if "Traceback (" in said else places[::-1]  # or innermost first
    return ":".join(in_order[-1]) if in_order else "somewhere"


# All targets.


def fuzzed(targets: list[Target], arguments: argparse.Namespace, folder: Path) -> list[State]:
    """Run as many targets in parallel as there are processes, the largest share first."""
    context = multiprocessing.get_context("fork")
    second = arguments.seconds * arguments.jobs / sum(target.share for target in targets)
    states = []
    for target in sorted(targets, key=lambda target: -target.share):
        counts = context.Array("q", 3, lock=False)
        seconds = math.inf if arguments.cases else second * target.share
        states.append(State(target, folder / target.name, seconds, counts))
    most = arguments.cases or math.inf
    waiting, running, begin = list(states), {}, time.monotonic()
    with show_progress(True) as stage:
        told = stage("Fuzz")
        while waiting or running:
            while waiting and len(running) < arguments.jobs:
                state = waiting.pop(0)
                shutil.rmtree(state.folder, ignore_errors=True)  # left by a process that died
                state.folder.mkdir()
                here, there = context.Pipe(duplex=False)
                options = (state, arguments.seed, most, there)
                process = context.Process(target=work, args=options, daemon=True)
                process.start()
                there.close()
                running[here] = state, process, time.monotonic()
            for pipe in wait(list(running), timeout=1.0):
                state, process, since = running[pipe]
                try:
                    note, *found = pipe.recv()
                    note(state, *found)
                except EOFError:
                    process.join()
                    del running[pipe]
                    state.seconds -= time.monotonic() - since
                    if process.exitcode:
                        _died(state, process.exitcode)
                    if process.exitcode and state.seconds > 0.0:
                        waiting.insert(0, state)
            done = sum(state.counts[0] for state in states)
            part = done / most / len(states) or (time.monotonic() - begin) / arguments.seconds
            told(min(part, 1.0), f"{done} cases")
    return states


def _died(state: State, status: int) -> None:
    """Record the case at which a process died."""
    said = (state.folder / "stderr").read_text(errors="replace")
    if status < 0:
        name = _DEATHS.get(signal.Signals(-status), signal.Signals(-status).name)
    else:  # a good input was refused, or the fuzzer has an error
        name, state.seconds = "the fuzzer", 0.0
    if state.counts[2]:
        name, state.counts[2] = f"{name} while a case was made of this one", 0
    case = state.folder / f"case{state.target.suffix}"
    state.find(case.read_bytes(), f"{name} at {_place(said)}", f"{name}\n{said}")


def report(states: list[State], folder: Path) -> dict[str, Any]:
    """Print counts and findings, and write the latter."""
    print(f"{'':14}{'cases':>8}{'results':>9}{'one line':>9}{'lines':>7}{'findings':>9}")
    for state in states:
        cases, refused, _ = state.counts
        wrong = sum(finding.times for finding in state.findings.values())
        figures = (cases, cases - refused - wrong, refused, len(state.lines), wrong)
        print("{:14}{:8}{:9}{:9}{:7}{:9}".format(state.target.name, *figures))
    for state in states:
        for number, (place, finding) in enumerate(sorted(state.findings.items())):
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"{state.target.name}-{number}{state.target.suffix}"
            path.write_bytes(finding.content)
            print(f"\n{state.target.name}: {place}, {finding.times} times")
            print(finding.what.rstrip()[-3000:])
            print(f"again: python benchmarks/fuzz.py --replay {path}")
    figures = {f"{state.target.name}.cases": state.counts[0] for state in states}
    figures |= {"cases": sum(figures.values())}
    figures |= {"findings": sum(len(state.findings) for state in states)}
    print(f"\n{figures['cases']} cases, {figures['findings']} findings")
    if untested := [state.target.name for state in states if not state.counts[0]]:
        print(f"no time for a case, nothing is known of: {', '.join(untested)}")
    return figures


if __name__ == "__main__":
    main()
