"""Command `drake-teleop inspect`: quality of a log, suspected errors, or a draft description."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, to_one_line
from drake_teleop.common.files import make_folder, output_folder, write_json, write_text
from drake_teleop.common.numeric import Array, find_runs_of_true, white_noise_deviations
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check.conventions import check_conventions
from drake_teleop.logs.check.draft import Draft, draft_description, join_drafts
from drake_teleop.logs.explained_log import check_request
from drake_teleop.logs.processing import check_log
from drake_teleop.logs.read import clocks
from drake_teleop.logs.read.bags import draft_of_bag, is_bag, list_topics, read_bag_topic_or_table
from drake_teleop.logs.read.canonical import describe_canonical
from drake_teleop.logs.read.description import Description, load_description
from drake_teleop.logs.read.table_files import is_decimal_number, read_table
from drake_teleop.logs.read.tables import Table

BANDWIDTH_FOR_GAP_LENGTH_HZ = 30.0
"""Bandwidth of interest, which determines the length of a gap [Hz]."""
MIN_REPEATED_ROW_SHARE, MIN_REPEATED_BLOCK_ROWS = 0.05, 5
"""Smallest reported share of repeated rows, and smallest number of rows of a reported block."""
_MIN_FROZEN_ROWS, _MIN_MOTION_SHARE_BESIDE_FROZEN = 50, 0.3
_MAX_DRAFT_CORRECTIONS = 5  # by the data
_MIN_DATA_DECIMALS = 3  # numbers with a point in a first line that is no header
_CHECKSUM_LINE_START = "# `inspect` replaces this file only if it is unchanged: "
_COLUMNS_THAT_MARK_CANONICAL_LOG = {"f_x", "tau_x"}
_INSPECTED_QUANTITIES = (
    *("force", "torque", "specific_force", "angular_velocity", "angular_acceleration"),
    *("orientation", "position", "gravity"),
)


def inspect_command(
    log: Path, out: Path, *, others: Sequence[Path] = (), quiet: bool = False
) -> dict[str, Any]:
    """Inspect a canonical log, a log description, any table or a bag; return the summary.

    Write summary.json into the folder `out`. For unknown tables and bags also write draft.yaml: a
    description of `log` and `others` (files of the same recording) that fits the data. A draft
    that the user changed is kept; the new one is draft-2.yaml, draft-3.yaml, ...
    """
    summary: dict[str, Any] = {"log": str(log), "kind": "description", "topics": {}, "streams": {}}
    summary |= {"findings": [], "fit": None, "mounting": None, "delay_s": None, "draft": None}
    make_folder(out)
    if not others and log.suffix.lower() in (".yaml", ".yml"):
        _inspect_described_log(load_description(log), str(log), {}, summary)
    elif (
        not (others or is_bag(log))
        and (table := read_table(log)).columns.keys() >= _COLUMNS_THAT_MARK_CANONICAL_LOG
    ):
        summary["kind"] = "canonical"
        _inspect_described_log(
            _describe_canonical_without_nan_rows(log, table), str(log), {log: table}, summary
        )
    else:
        drafts = [_draft_of_recording(path, out, summary) for path in (log, *others)]
        with output_folder(out):
            draft = join_drafts(drafts)
            _correct_and_write_draft(draft, _find_writable_draft_path(out), summary)
        summary["findings"] += [{"name": x.name, "message": x.message} for x in draft.findings]
    with output_folder(out):
        write_json(out / "summary.json", summary)
    if not quiet:
        _print_summary(summary)
    return summary


def _describe_canonical_without_nan_rows(log: Path, table: Table) -> Description:
    try:
        return describe_canonical(log, table)
    except DrakeTeleopError:
        # A canonical log with NaN or a missing column gets the specific message.
        columns = [table.numbers_with_nan(name, name) for name in table.columns]
        if len({len(x) for x in columns}) != 1:
            raise
        rows = np.flatnonzero(~np.isfinite(np.hstack(columns)).all(axis=1))
        return describe_canonical(log, _remove_rows(table, rows))


def _draft_of_recording(path: Path, out: Path, summary: dict[str, Any]) -> Draft:
    if is_bag(path):
        topics = list_topics(path)
        summary["kind"] = "bag"
        summary["topics"] |= {
            topic.name: {"type": topic.type, "messages": topic.messages, "rate_hz": topic.rate_hz}
            for topic in topics
        }
        return Draft(*draft_of_bag(path, topics, out))
    if path.suffix.lower() in (".yaml", ".yml"):
        what = "a log description names all files of a recording, so that no others can be added"
        remedy = "inspect it alone, or give only tables and bags"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    summary["kind"] = "unknown"
    table = read_table(path)
    # polars adds a suffix to repeated names.
    names = [name.partition("_duplicated_")[0] for name in table.columns]
    numbers = [name for name in names if is_decimal_number(name)]
    header = len(numbers) < len(names) and sum("." in name for name in numbers) < _MIN_DATA_DECIMALS
    table = table if header else read_table(path, header=False)
    return draft_description(table, out, header=header)


def _find_writable_draft_path(out: Path) -> Path:
    names = ("draft.yaml", *(f"draft-{k}.yaml" for k in range(2, 1000)))
    return next(path for path in map(out.joinpath, names) if _is_missing_or_unchanged_draft(path))


def _is_missing_or_unchanged_draft(path: Path) -> bool:
    if not path.exists():
        return True
    text = path.read_text(encoding="utf-8", errors="replace")
    return _append_checksum(text.rpartition(_CHECKSUM_LINE_START)[0]) == text


def _append_checksum(text: str) -> str:
    return f"{text}{_CHECKSUM_LINE_START}{sha256(text.encode()).hexdigest()[:16]}\n"


def _correct_and_write_draft(draft: Draft, path: Path, summary: dict[str, Any]) -> None:
    write_text(path, _append_checksum(draft.text()))
    summary["draft"] = str(path)
    places = ", ".join(_names_of_fields_to_fill_in(draft.streams))
    lacking = [f"fields that were not recognized: FILL IN {places}"] if places else []
    try:
        load_description(path)
    except DrakeTeleopError as error:
        lacking.append(str(error).removeprefix(str(path)).lstrip(": "))
    if not lacking:
        _correct_draft_by_data(draft, path, summary)
        return
    text = draft.text()
    for message in lacking:
        summary["findings"].append({"name": "incomplete", "message": f"{path.name}: {message}"})
        text += f"# {to_one_line(f'INCOMPLETE: {message}')}\n"
    write_text(path, _append_checksum(text))


def _names_of_fields_to_fill_in(fields: dict[str, Any], prefix: str = "") -> list[str]:
    out = []
    for name, value in fields.items():
        if isinstance(value, dict):
            out += _names_of_fields_to_fill_in(value, f"{prefix}{name}.")
        elif value == "FILL IN" or (isinstance(value, list) and "FILL IN" in value):
            out.append(f"{prefix}{name}")
    return out


def _correct_draft_by_data(draft: Draft, path: Path, summary: dict[str, Any]) -> None:
    tables: dict[Path, Table] = {}
    corrected, first, given = draft, None, dict(summary)
    for _ in range(_MAX_DRAFT_CORRECTIONS):
        found = _inspect_described_log(load_description(path), str(path), dict(tables), summary)
        finding = next((finding for finding in found if finding.fields), None)
        if finding is None:
            break
        if first is None:
            first, given = finding, dict(summary)
        corrected = corrected.with_finding_corrected(finding)
        write_text(path, _append_checksum(corrected.text()))
    if first is not None and any(finding.name == "misfit" for finding in found):
        write_text(path, _append_checksum(draft.text()))
        question = {"name": "misfit", "message": check_request(first)}
        others = [x for x in given["findings"] if x["message"] != first.message]
        summary |= given | {"findings": [*others, question]}


def _inspect_described_log(
    description: Description, source: str, tables: dict[Path, Table], summary: dict[str, Any]
) -> list[Finding]:
    findings: list[Finding] = []
    bad: dict[Path, list[NDArray[np.intp]]] = {}
    timed = [x for x in (description.wrench, description.imu, description.pose) if x]
    unstamped = {stream.source for stream in timed if stream.time.column is None}
    for name, stream in description.streams.items():
        if stream.source not in tables:
            tables[stream.source] = read_bag_topic_or_table(stream)
            if note := tables[stream.source].note:
                findings.append(Finding("sheet", note))
        table = tables[stream.source].rows_with_any_number(stream.columns)
        delete = "empty" if stream.source in unstamped else "delete"
        figures, more, rows = _inspect_stream_and_list_bad_rows(name, stream, table, source, delete)
        summary["streams"][name] = figures
        findings += more
        if stream.source in unstamped:  # removal would shift the times of the following rows
            tables[stream.source] = _set_cells_to_nan(tables[stream.source], stream.columns, rows)
            rows = rows[:0]
        bad.setdefault(stream.source, []).append(rows)
    clean = {path: _remove_rows(tables[path], np.concatenate(rows)) for path, rows in bad.items()}
    try:
        found = check_log(Path(source), check_conventions(description, source, clean))
    except DrakeTeleopError as error:
        findings.append(Finding("unusable", str(error)))
    else:
        findings += found.findings
        summary["delay_s"] = found.delay_s
        summary["fit"] = {"mass": found.fit.mass, "unexplained": found.fit.unexplained}
        if (imu := found.mounting) is not None:
            rotation = {"R_SI": imu.R_SI.tolist(), "angle_deg": imu.rotation_angle_deg}
            rotation["right_angled"] = imu.is_right_angled
            clock = {"lag_s": imu.lag_s, "drift": imu.clock_drift}
            summary["mounting"] = {**rotation, **clock, "unexplained": imu.unexplained}
    summary["findings"] = [{"name": f.name, "message": f.message} for f in findings]
    return findings


def _inspect_stream_and_list_bad_rows(
    name: str, stream: Any, table: Table, source: str, delete: str
) -> tuple[dict[str, Any], list[Finding], NDArray[np.intp]]:
    columns = [
        str(column)
        for field in _INSPECTED_QUANTITIES
        for column in getattr(getattr(stream, field, None), "columns", ())
    ]
    values = table.numbers_with_nan_side_by_side(columns, f"{source}:{name}")
    good = np.asarray(np.isfinite(values).all(axis=1))
    findings: list[Finding] = []
    figures: dict[str, Any] = {"rows": len(values)}
    at = f"{name} ({table.path.name})"
    time = getattr(stream, "time", None)
    if time is not None:
        more, usable = _inspect_clock_and_flag_usable_rows(at, time, table, columns, figures)
        findings += more
        if len(usable) != len(good):
            what = f"has {len(good)} rows, but {len(usable)} times"
            remedy = "use columns of the same length"
            raise DrakeTeleopError(what, where=f"{source}:{name}", remedy=remedy)
    figures["nan_rows"], figures["nan_longest"] = int((~good).sum()), _max_run_length(~good)
    if not good.all():
        first = table.line_in_file(int(np.argmin(good)))
        text = f"{at}: {figures['nan_rows']} rows contain NaN or infinity (first in row {first}),"
        text += f" the longest block has {figures['nan_longest']} rows; {delete} or repair them"
        findings.append(Finding("nan", text))
    repeats = np.zeros(len(values), bool)
    repeats[1:] = (values[1:] == values[:-1]).all(axis=1)
    figures["repeated_rows"] = int(repeats.sum())
    moving = name in ("wrench", "imu") and not repeats[1:].all()
    if moving:
        findings += _repeated_rows_findings(at, values, repeats, figures.get("rate_hz"), time)
    figures["columns"] = {}
    frozen = _frozen_row_spans(values, repeats) if moving else {}
    for i, (column, x) in enumerate(zip(_channel_labels(columns, table), values.T, strict=True)):
        finite = x[np.isfinite(x)]
        if not len(finite):
            continue
        saturated = 0
        if i in frozen:
            first, last = (table.line_in_file(row) for row in frozen[i])
            value = f"{x[frozen[i][0]]:.4g}"
            text = f"{at}: {column} keeps the value {value} in rows {first} to {last}, but other"
            text += f" channels vary: sensor or connection failed; {delete} these rows"
            findings.append(Finding("dead channel", text))
        elif time is not None and moving:
            saturated = _count_saturated_samples(x, repeats)
        ends = {"min": float(finite.min()), "max": float(finite.max())}
        noise = float(white_noise_deviations(finite[:, None])[0])
        mean = {"mean": float(finite.mean()), "noise": noise, "saturated": saturated}
        figures["columns"][column] = ends | mean
        if saturated:
            text = f"{at}: {column} stays at the end of its range ({finite.min():.4g} ..."
            text += f" {finite.max():.4g}) for {saturated} samples; {delete} them or move slower"
            findings.append(Finding("saturation", text))
    rows = np.flatnonzero(~(good & usable if time is not None else good))
    return figures, findings, rows if table.kept_rows is None else table.kept_rows[rows]


def _repeated_rows_findings(
    at: str, values: Array, repeats: NDArray[np.bool_], rate: float | None, time: Any
) -> list[Finding]:
    held = int(repeats.sum())
    news_after = np.flatnonzero(repeats[:-1] & ~repeats[1:]) + 1
    changing = values[:, (values[1:] != values[:-1]).any(axis=0)]
    differ = (changing[news_after] != changing[news_after - 1]).mean(axis=1)
    longest = _max_run_length(repeats)
    enough = repeats.mean() > MIN_REPEATED_ROW_SHARE or longest >= MIN_REPEATED_BLOCK_ROWS
    if not enough or (len(differ) and np.median(differ) <= 0.5):
        return []
    fresh = np.flatnonzero(~repeats)
    period = int(np.median(np.diff(fresh)))
    news = "" if rate is None else f": new values come at {rate * len(fresh) / len(repeats):.4g} Hz"
    if period > 1 and rate is not None:
        what = f"every value is held for {period} rows{news}, not {rate:.4g} Hz"
    else:
        what = f"{held} rows repeat the one before in all channels, at most {longest} at once{news}"
    remedy = "delete the repeated rows"
    if time is not None and time.column is None:
        remedy = f"give time stamps (time.column) and {remedy}"
    return [Finding("repeated rows", f"{at}: {what}; {remedy}")]


def _inspect_clock_and_flag_usable_rows(
    at: str, time: Any, table: Table, columns: Sequence[str], figures: dict[str, Any]
) -> tuple[list[Finding], NDArray[np.bool_]]:
    stamps, episodes = clocks.time_stamps_and_num_episodes(time, table, columns, at)
    if time.column is None:
        duration = float(np.ptp(stamps)) if len(stamps) else 0.0
        figures |= {"rate_hz": time.rate / time.scale, "duration_s": duration}
        return [], np.ones(len(stamps), bool)
    figures["episodes"] = episodes
    before = np.fmax.accumulate(np.concatenate([[-np.inf], stamps[:-1]]))
    usable = np.isfinite(stamps) & (stamps > before)
    t = stamps[np.isfinite(stamps)]
    steps = np.diff(t)
    forward = steps[steps > 0]
    if not len(forward):
        what = "the time stamps never increase"
        raise DrakeTeleopError(what, where=at, remedy="set time.column or time.rate")
    median = float(np.median(forward))
    back, inner = (steps <= 0).sum(), clocks.set_episode_steps_to_zero(steps, median, episodes)
    gaps = int((inner > clocks.min_gap_length_s(median, BANDWIDTH_FOR_GAP_LENGTH_HZ)).sum())
    longest = float(inner.max())
    rate = len(t) / len(np.unique(t)) / median  # of rows, which may share time stamps
    figures |= {"rate_hz": rate, "duration_s": float(t[-1] - t[0]), "longest_gap_s": longest}
    figures |= {"gaps": gaps, "clock_jumps": int(back)}
    findings = []
    if gaps:
        where = float(t[int(np.argmax(inner))] - t[0])
        text = f"{at}: {gaps} gaps, the longest {longest:.3g} s at {where:.3g} s (missing rows, or"
        text += " a jump of the clock), are not used; record again if these parts are required"
        findings.append(Finding("gap", text))
    if back:
        finite = np.flatnonzero(np.isfinite(stamps))
        row = table.line_in_file(finite[int(np.argmax(steps <= 0)) + 1])
        text = (
            f"{at}: {back} time stamps repeat or decrease, the first in row {row}; rows with"
            " repeated stamps are omitted if their values repeat, else spread evenly; a log with"
            " decreasing stamps is refused: split it where they decrease, or give time.rate"
        )
        findings.append(Finding("clock jump", text))
    return findings, usable


def _channel_labels(columns: Sequence[str], table: Table) -> list[str]:
    labels: list[str] = []
    for column in columns:
        width = table.numbers_with_nan(column, column).shape[1]
        labels += [column] if width == 1 else [f"{column}[{i}]" for i in range(width)]
    return labels


def _max_run_length(flags: NDArray[np.bool_]) -> int:
    return int(np.diff(find_runs_of_true(flags)).max(initial=0))


def _count_saturated_samples(x: Array, repeats: NDArray[np.bool_]) -> int:
    held = np.zeros(len(x), bool)
    held[1:] = (x[1:] == x[:-1]) & ~repeats[1:]
    ends = (x == np.nanmax(x)) | (x == np.nanmin(x))
    inside, outside = _max_run_length(held & ends), _max_run_length(held & ~ends)
    return int(ends.sum()) if inside >= MIN_REPEATED_BLOCK_ROWS and inside > 2 * outside else 0


def _frozen_row_spans(values: Array, repeats: NDArray[np.bool_]) -> dict[int, tuple[int, int]]:
    """Return first and last row of a wrongly constant part, by index of the channel (N, k)."""
    found = {}
    for i, x in enumerate(values.T):
        held = np.concatenate([[False], x[1:] == x[:-1]])
        runs = find_runs_of_true(held)
        start, stop = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
        if stop - start < _MIN_FROZEN_ROWS or repeats[start:stop].all():
            continue
        vector = values[:, 3 * (i // 3) : 3 * (i // 3) + 3]
        ranges = np.nanmax(vector, axis=0) - np.nanmin(vector, axis=0)
        covers = np.ptp(vector[start:stop], axis=0) > _MIN_MOTION_SHARE_BESIDE_FROZEN * ranges
        changes_elsewhere = np.mean(np.delete(held, slice(start, stop))) < 0.5
        at_end = x[start] in (np.nanmin(x), np.nanmax(x))
        if changes_elsewhere and not at_end and covers.any():
            found[i] = (int(start) - 1, int(stop) - 1)
    return found


def _remove_rows(table: Table, rows: NDArray[np.intp]) -> Table:
    if not len(rows):
        return table
    kept = np.setdiff1d(np.arange(table.rows), rows)
    whole = {n: x[kept] if len(x) == table.rows else x for n, x in table.columns.items()}
    return replace(table, columns=whole)


def _set_cells_to_nan(table: Table, names: Sequence[Any], rows: NDArray[np.intp]) -> Table:
    cells = {str(name): table.numbers_with_nan(name, "").copy() for name in names}
    for column in cells.values():
        column[rows] = np.nan
    return replace(table, columns={**table.columns, **cells}) if len(rows) else table


def _print_summary(summary: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as Grid

    console = Console()
    grid = Grid(
        "stream", "rows", "rate [Hz]", r"span \[s]", r"longest step \[s]", "NaN", "repeated"
    )
    for name, figures in summary["streams"].items():
        shown = (figures.get(key) for key in ("rate_hz", "duration_s", "longest_gap_s"))
        grid.add_row(
            *(name, str(figures["rows"])),
            *("" if x is None else f"{x:.4g}" for x in shown),
            *(str(figures["nan_rows"]), str(figures["repeated_rows"])),
        )
    if summary["streams"]:
        console.print(grid)
    for finding in summary["findings"]:
        console.print(f"[bold]{escape(finding['name'])}[/bold]: {escape(finding['message'])}")
    if summary["topics"]:
        grid = Grid("topic", "type", "messages", "rate [Hz]")
        for name, topic in summary["topics"].items():
            grid.add_row(name, topic["type"], str(topic["messages"]), f"{topic['rate_hz']:.4g}")
        console.print(grid)
    if summary["draft"]:
        console.print(f"a draft description is in {escape(summary['draft'])}")
    elif not summary["findings"]:
        console.print("nothing suspicious")
