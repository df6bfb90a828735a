"""Output of `arms.py`: the table, the totals, and the page `docs/arms.md`."""

from __future__ import annotations

import html
from pathlib import PurePosixPath
from typing import Any

from rich.console import Console
from rich.table import Table

_HEAD = """# Arms tried

The table lists published arm files, unchanged. Each was tried with one command, with the file and
the frame of its row: `drake-teleop new FOLDER --arm FILE --sensor-frame FRAME`.

`benchmarks/arms.py` makes this page from packages of the Python Package Index. Their licences
differ, so the files are not included here. An independent reader checks kinematics, masses and
limits: MuJoCo for MJCF, yourdfpy for URDF. "assumed" contains the messages of the command about
missing or impossible values. Three columns describe the start that the command chooses. σ is the
least singular value of the Jacobian over L, with rotations times L; L is a fifth of the arm's
length. "margin" is the smallest distance to a joint limit over half the range. "overlaps" is the
number of overlapping pairs of shapes.

| file | package | joints | sensor frame | σ | margin | overlaps | assumed | first run |
|---|---|---|---|---|---|---|---|---|
"""


def totals(rows: list[dict[str, Any]]) -> dict[str, int]:
    """Return the numbers of files for which each stage succeeded."""
    return {
        "files": len(rows),
        "read": sum(_ok(row, "read") for row in rows),
        "equal": sum(_ok(row, "check") and _ok(row, "read") for row in rows),
        "planned": sum(_ok(row, "plan") for row in rows),
        "without_overlaps": sum(row.get("plan", {}).get("overlaps") == [] for row in rows),
        "ran": sum(_ok(row, "run") for row in rows),
        "ran_without_warnings": sum(row.get("run", {}).get("warnings") == [] for row in rows),
    }


def _ok(row: dict[str, Any], stage: str) -> bool:
    return stage in row and not row[stage].get("error") and not row[stage].get("differs")


def print_table(figures: dict[str, Any]) -> None:
    """Print one row per file, then all texts of errors, differences and overlaps, and totals."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=170)
    table = Table()
    names = ("file", "joints", "read s", "equal", "position m", "plan s", "overlaps", "elbow up")
    names += ("lowest m", "sigma/L", "margin", "run s", "warnings")
    for name in names:
        justify = "left" if name == "file" else "right"
        table.add_column(name, justify=justify, overflow="fold", no_wrap=name != "file")
    for row in figures["rows"].values():
        table.add_row(*_cells(row))
    console.print(table)
    for name, row in figures["rows"].items():
        for text in _problems(row):
            console.print(f"{name} @{row['frame']}: {text}", markup=False, highlight=False)
    console.print(", ".join(f"{name} {value}" for name, value in figures["totals"].items()))


def _cells(row: dict[str, Any]) -> list[str]:
    read, check, plan, run = (row.get(key, {}) for key in ("read", "check", "plan", "run"))
    file = PurePosixPath(row["file"])
    name = f"{row['package']}: {file.parent.name}/{file.name}"
    joints = read.get("joints", check.get("joints", ""))
    return [
        name,
        str(len(joints) if isinstance(joints, list) else joints),
        _shown(read, "seconds"),
        "" if "differs" not in check else "no" if check["differs"] else "yes",
        _shown(check, "position_m", ".0e"),
        _shown(plan, "plan_s"),
        "" if "overlaps" not in plan else str(len(plan["overlaps"])),
        _shown(plan, "elbow_up", ".2f"),
        _shown(plan, "lowest_shape_m", ".3f"),
        _shown(plan, "sigma_over_L", ".2f"),
        _shown(plan, "limit_margin", ".2f"),
        _shown(run, "seconds"),
        "" if "warnings" not in run else str(len(run["warnings"])),
    ]


def _shown(figures: dict[str, Any], key: str, form: str = ".1f") -> str:
    if "error" in figures:
        return "-"
    return format(figures[key], form) if key in figures else ""


def _problems(row: dict[str, Any]) -> list[str]:
    texts, known = [], set()
    for stage in ("read", "check", "plan", "run"):
        found = row.get(stage, {})
        lines = [found["error"]] if found.get("error") else []
        lines += [] if found.get("printed") is None else [f"printed: {found['printed']}"]
        lines += [f"differs: {text}" for text in found.get("differs", ())]
        lines += [f"overlaps: {text}" for text in found.get("overlaps", ())]
        lines += [f"warning: {text}" for text in found.get("warnings", ())]
        # `new` repeats the error of the first stage.
        texts += [f"{stage}: {line}" for line in lines if line not in known]
        known |= set(lines)
    return texts


def page_text(rows: list[dict[str, Any]]) -> str:
    """Return the page of the documentation that lists the arms."""
    lines = [_page_row(row) for row in sorted(rows, key=lambda row: _short(row["file"]).lower())]
    return _HEAD + "\n".join(lines) + "\n"


def _page_row(row: dict[str, Any]) -> str:
    read, plan, run = (row.get(stage, {}) for stage in ("read", "plan", "run"))
    joints = len(read["joints"]) if "joints" in read else ""
    assumed = plan.get("assumed", read.get("assumed", []))
    cells = [f"`{_short(row['file'])}`", row["package"], str(joints), f"`{row['frame']}`"]
    cells += [_shown(plan, "sigma_over_L", ".2f"), _shown(plan, "limit_margin", ".2f")]
    cells.append(str(len(plan["overlaps"])) if "overlaps" in plan else "")
    return f"| {' | '.join([*cells, _folded(assumed), _first_run(read, plan, run)])} |"


def _short(file: str) -> str:
    path = PurePosixPath(file)
    return f"{path.parent.name}/{path.name}" if len(path.name) < 20 else path.name


def _first_run(read: dict[str, Any], plan: dict[str, Any], run: dict[str, Any]) -> str:
    for what, found in (("not read", read), ("no start found", plan), ("stopped", run)):
        if found.get("error"):
            return f"<details><summary>{what}</summary>{_escaped(found['error'])}</details>"
    if not run:
        return "planned" if plan else ""
    return _folded(run["warnings"], "warning") if run["warnings"] else "completed"


def _folded(texts: list[str], what: str = "line") -> str:
    if not texts:
        return ""
    head = f"{len(texts)} {what}{'s' if len(texts) > 1 else ''}"
    return f"<details><summary>{head}</summary>{'<br>'.join(map(_escaped, texts))}</details>"


def _escaped(text: str) -> str:
    """Return a text that neither Markdown nor HTML changes, in one cell of a table."""
    text = html.escape(" ".join(text.split()))
    for character in "|*_`[]$\\":
        text = text.replace(character, f"&#{ord(character)};")
    return text
