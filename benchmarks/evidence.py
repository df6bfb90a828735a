"""What is claimed, is it so, and when was that last seen?

    python benchmarks/evidence.py                       writes docs/evidence.md
    python benchmarks/evidence.py RUN ... [--beside T]  runs these first, and keeps their figures

The page has each claim of the docs (`evidence_claims.py`) with the figure that a run gave, the
bound, the command, the date and the commit, then what is not met and what is not shown at all.
Figures lie in `records/`, one file for each run, as its `--json` wrote them. `--beside` says what
else ran on the machine ("nothing else", if it is left out); times mean little beside something.
`--from FILE` keeps what a run of the same command has written already.
"""

from __future__ import annotations

import argparse
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

_HEAD = """# Evidence

What this library promises, and the run that shows it. Each figure is read from the record of that
run (`benchmarks/records`), not typed; `python benchmarks/evidence.py NAME` runs it again, and the
first column leads to where the promise is made. A time is only as good as the machine was idle,
which the last column says. What a test shows is shown by every run of the tests; it has no figure
here.
"""


def main(arguments: list[str] | None = None) -> None:
    """Runs what is named, then writes the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", nargs="*", choices=[*RUNS, []], metavar="RUN")
    parser.add_argument("--beside", default="nothing else", help="what else ran on the machine")
    parser.add_argument("--from", dest="file", type=Path, help="the figures of such a run")
    asked = parser.parse_args(arguments)
    for name in asked.run:
        figures = json.loads(asked.file.read_text()) if asked.file else run(name)
        keep(name, figures, asked.beside)
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE}: {summary()}")


def run(name: str) -> Any:
    """The figures of one of `RUNS`; exit status 1 is a bound of its own that it missed."""
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
    """Writes a record of today and of the package's newest commit."""
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
    """With six digits: more are never claimed."""
    if isinstance(figures, dict):
        return {key: _rounded(value) for key, value in figures.items()}
    if isinstance(figures, list):
        return [_rounded(value) for value in figures]
    return float(f"{figures:.6g}") if isinstance(figures, float) else figures


def records() -> dict[str, dict[str, Any]]:
    """All that are kept, by name."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(RECORDS.glob("*.json"))
    }


def summary() -> str:
    """How many claims are met, missed, tested, and not shown."""
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
    """The page, in Markdown."""
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
