"""Is each claim of README and docs shown by a run, and when was it run?

    python benchmarks/evidence.py                       writes docs/evidence.md and the README
    python benchmarks/evidence.py RUN ... [--beside T]  also makes these runs first

The page lists each claim of the docs (`evidence_claims.py`) with the figure of a run, the bound,
the command, the date and the commit, and then the claims that are not met or not shown. The README
of this folder lists the scripts, their questions and the same figures. `records/` contains the
figures of each run, as `--json` writes them. `--beside` names other programs that ran at the same
time (default: nothing else). `--from FILE` stores the figures of an earlier run.
"""

from __future__ import annotations

import argparse
import ast
import json
import shlex
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path
from typing import Any

from evidence_claims import CLAIMS, RUNS, Claim, InTests, NotShown

import drake_teleop

FOLDER = Path(__file__).parent
RECORDS = FOLDER / "records"
PAGE = FOLDER.parent / "docs" / "evidence.md"
README = FOLDER / "README.md"

_README_HEAD = """# Benchmarks

Each script answers one question. A baseline runs in the same process, so that the answer is a
ratio; times are those of the thread, for orientation. `--help` lists the options of a script.

<!-- not run by the tests: it installs from the network -->
```sh
.venv-test/bin/pip install -e '.[test,bench]'
OMP_NUM_THREADS=1 .venv-test/bin/python benchmarks/identification.py
```

`benchmarks/evidence.py` writes this page from the records of the runs (`benchmarks/records`) and
the claims of README and docs (`benchmarks/evidence_claims.py`). A claim that is not met is bold.
"""

_HEAD = """# Evidence

Claims of this library, and the run that shows each. Every figure is read from the record of its run
(`benchmarks/records`); `python benchmarks/evidence.py NAME` repeats the run. The first column links
to the page with the claim. Other programs on the machine affect times; the last column names them.
A claim with a test is checked by every run of the tests and has no figure here.
"""


def main(arguments: list[str] | None = None) -> None:
    """Make the named runs, then write the page and the README."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", nargs="*", choices=[*RUNS, []], metavar="RUN")
    parser.add_argument(
        "--beside", default="nothing else", help="other programs that ran at the same time"
    )
    parser.add_argument("--from", dest="file", type=Path, help="figures of an earlier run")
    asked = parser.parse_args(arguments)
    for name in asked.run:
        figures = json.loads(asked.file.read_text()) if asked.file else run(name)
        keep(name, figures, asked.beside)
    PAGE.write_text(page(), encoding="utf-8")
    README.write_text(readme(), encoding="utf-8")
    print(f"{PAGE}: {summary()}")


def run(name: str) -> Any:
    """Return the figures of one of `RUNS`; exit status 1 means that it missed its own bound."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "summary.json"
        command = RUNS[name].replace("FILE", str(file)).replace("FOLDER", folder)
        words = shlex.split(command)
        if words[0] == "drake-teleop":
            words[0] = str(Path(sys.executable).with_name(words[0]))
        code = subprocess.run([sys.executable, *words], cwd=FOLDER.parent).returncode
        if code not in (0, 1):
            raise SystemExit(f"{name}: {command} ended with status {code}")
        return json.loads(file.read_text(encoding="utf-8"))


def keep(name: str, figures: Any, beside: str) -> None:
    """Write a record with the date and the package's newest commit."""
    if isinstance(figures, dict):
        figures = {name: value for name, value in figures.items() if name != "records"}
    commit = _git("log", "-1", "--format=%h", "--", "drake_teleop") or "unknown"
    changed = _git("status", "--porcelain", "--", "drake_teleop")
    record = {
        "command": RUNS[name],
        "date": date.today().isoformat(),
        "version": drake_teleop.__version__,
        "commit": f"{commit}, changed" if changed else commit,
        "beside": beside,
        "figures": _rounded(figures),
    }
    text = json.dumps(record, ensure_ascii=False)
    RECORDS.mkdir(exist_ok=True)
    (RECORDS / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def _git(*arguments: str) -> str:
    git = ["git", "-C", str(FOLDER.parent), *arguments]
    return subprocess.run(git, capture_output=True, text=True).stdout.strip()


def _rounded(figures: Any) -> Any:
    """Return figures with six digits, more than any claim has."""
    if isinstance(figures, dict):
        return {key: _rounded(value) for key, value in figures.items()}
    if isinstance(figures, list):
        return [_rounded(value) for value in figures]
    return float(f"{figures:.6g}") if isinstance(figures, float) else figures


def records() -> dict[str, dict[str, Any]]:
    """Return all stored records by name."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(RECORDS.glob("*.json"))
    }


def summary() -> str:
    """Return the numbers of claims that are met, missed, tested, and not shown."""
    known = records()
    measured = [c for c in CLAIMS if isinstance(c, Claim) and c.run in known]
    met = sum(c.met(known[c.run]["figures"]) for c in measured)
    tested = sum(isinstance(c, InTests) for c in CLAIMS)
    open_ = len(CLAIMS) - len(measured) - tested
    return (
        f"{met} of {len(measured)} measured claims are met, {tested} are tested in every run of "
        f"the tests, {open_} are not shown"
    )


def page() -> str:
    """Return the page in Markdown."""
    known = records()
    parts = [_HEAD, f"{summary()[0].upper()}{summary()[1:]}.\n"]
    for section in dict.fromkeys(claim.section for claim in CLAIMS):
        shown = [c for c in CLAIMS if c.section == section and _shown(c, known)]
        if not shown:
            continue
        parts.append(f"## {section}\n\n| claim | where it holds | figure | bound | shown by |")
        parts.append("|---|---|---|---|---|")
        parts += [_row(claim, known) for claim in shown]
        parts.append("")
    missed = [
        c
        for c in CLAIMS
        if isinstance(c, Claim) and c.run in known and not c.met(known[c.run]["figures"])
    ]
    parts.append("## Not met\n")
    parts += [
        f"- {c.says} ({c.where}): {c.text(known[c.run]['figures'])}, not {c.bound}." for c in missed
    ] or ["Nothing of the above."]
    parts.append("\n## Not shown\n")
    for claim in CLAIMS:
        if isinstance(claim, NotShown):
            parts.append(f"- *{claim.section}.* {claim.says}: {claim.why}.")
        elif not _shown(claim, known):
            assert isinstance(claim, Claim)
            lacks = f"no record of `{RUNS[claim.run]}` is kept"
            parts.append(f"- *{claim.section}.* {claim.says} ({claim.where}): {lacks}.")
    return "\n".join(parts) + "\n"


def readme() -> str:
    """Return the README of this folder: scripts, questions, commands and figures."""
    known = records()
    parts = [_README_HEAD]
    helpers = []
    for script in sorted(FOLDER.glob("*.py")):
        doc = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
        question = doc.splitlines()[0].strip()
        if not question.endswith("?"):
            helpers.append(f"| `{script.name}` | {question} |")
            continue
        parts.append(f"## {script.name}\n\n{question}\n")
        runs = [name for name in RUNS if RUNS[name].split()[0] == f"benchmarks/{script.name}"]
        if not runs:
            parts.append("No record is kept.\n")
        for name in runs:
            parts += _run_lines(name, known.get(name))
    parts += ["## Modules of these scripts\n", "| module | contents |", "|---|---|", *helpers]
    return "\n".join(parts) + "\n"


def _run_lines(name: str, record: dict[str, Any] | None) -> list[str]:
    command = RUNS[name].replace("FILE", f"records/{name}.json")
    if record is None:
        return [f"`{command}`: no record is kept.\n"]
    lines = [
        f"`{command}`, {record['date']}, commit {record['commit']}, beside {record['beside']}:\n"
    ]
    claims = [claim for claim in CLAIMS if isinstance(claim, Claim) and claim.run == name]
    lines += ["| claim | where it holds | figure | bound |", "|---|---|---|---|"]
    for claim in claims:
        figure = claim.text(record["figures"])
        figure = figure if claim.met(record["figures"]) else f"**{figure}**"
        lines.append(f"| {claim.says} | {claim.where} | {figure} | {claim.bound} |")
    return [*lines, ""]


def _shown(claim: Claim | InTests | NotShown, known: dict[str, Any]) -> bool:
    return isinstance(claim, InTests) or (isinstance(claim, Claim) and claim.run in known)


def _row(claim: Any, known: dict[str, Any]) -> str:
    says = f"[{claim.says}]({claim.page})"
    if isinstance(claim, InTests):
        return f"| {says} | {claim.where} | – | – | `{claim.test}` |"
    record = known[claim.run]
    figure = claim.text(record["figures"])
    figure = figure if claim.met(record["figures"]) else f"**{figure}**"
    beside = "" if record["beside"] == "nothing else" else f", beside {record['beside']}"
    how = f"`{claim.run}`, {record['date']}, {record['commit']}{beside}"
    return f"| {says} | {claim.where} | {figure} | {claim.bound} | {how} |"


if __name__ == "__main__":
    main()
