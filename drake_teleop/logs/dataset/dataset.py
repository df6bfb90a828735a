"""Command `dataset`: contact wrench and verdict for each episode of a robot-learning dataset."""

from __future__ import annotations

import copy
import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from drake_teleop.common import files
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import replace_file_on_success
from drake_teleop.common.html import render_page
from drake_teleop.common.numeric import Array, one_blas_thread, samples_to_nearest_true
from drake_teleop.common.progress import show_progress
from drake_teleop.common.texts import read_yaml, to_yaml_text
from drake_teleop.load.contact.detection import ContactDetector
from drake_teleop.load.identification import Identification
from drake_teleop.logs.check.conventions import check_conventions
from drake_teleop.logs.check.draft import Draft, draft_description
from drake_teleop.logs.dataset import dataset_files, episode_verdict, shared_load
from drake_teleop.logs.dataset.dataset_files import ContactColumns, Dataset, Episode
from drake_teleop.logs.dataset.episode_faults import EpisodeFault, list_faults, saturation_faults
from drake_teleop.logs.dataset.episode_verdict import EpisodeSignals, WrenchHypothesis
from drake_teleop.logs.dataset.shared_load import SharedLoad
from drake_teleop.logs.read.alignment import resample
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.clocks import read_clock
from drake_teleop.logs.read.description import Description, validation_error
from drake_teleop.logs.read.reading import read_described_log
from drake_teleop.logs.read.tables import Table
from drake_teleop.logs.summaries import summarize_load

# Episodes that determine load, lag and noise: fewer if they are long.
_MIN_EPISODES_FOR_SHARED_LOAD, _MAX_EPISODES_FOR_SHARED_LOAD = 8, 24
_MAX_ROWS_FOR_SHARED_LOAD = 12_000
_MAX_DRAFTED_EPISODES, _MAX_DRAFT_CORRECTIONS = 3, 5
_STREAM_NAMES = ("wrench", "imu", "pose")
_MAX_LN_RATIO_TO_USUAL_WIDTH = 1.5  # of the residual of the best hypothesis
_CONTACT_MARGIN_FRAMES, _MIN_FREE_FRAMES_FOR_OFFSETS = 2, 20


class DatasetAndLoad(NamedTuple):
    """Dataset with described streams and shared load."""

    dataset: Dataset
    streams: dict[str, Any]
    shared_load: SharedLoad


def dataset_command(
    path: Path,
    out: Path,
    *,
    load: Path | None = None,
    identify: bool = False,
    description: Path | None = None,
    jobs: int = 1,
    quiet: bool = False,
) -> dict[str, Any]:
    """Write a copy of a dataset with contact wrenches, summary.json and report.html.

    After an interruption, repeat the command. The dataset stays unchanged.

    Args:
        load: identification.json of the load.
        identify: identify the load from the episodes instead.
        description: log description; its `file` is replaced by each episode.
        jobs: number of parallel processes.
    """
    if (load is None) != identify:
        what = "exactly one of --load and --identify is required"
        raise DrakeTeleopError(what, where="dataset", remedy="give one")
    known = None if load is None else Identification.load(load)
    dataset, copied = dataset_files.open_dataset(path), out / path.resolve().name
    if path.resolve() in (out.resolve(), copied.resolve(), *out.resolve().parents):
        what = "the output folder is in the dataset, which must not change"
        raise DrakeTeleopError(what, where=str(out), remedy="give another --out")
    files.make_folder(out)
    with files.output_folder(out), show_progress(not quiet) as stage, one_blas_thread():
        streams = _described_or_drafted_streams(dataset, description)
        if streams["wrench"].get("weight") == "removed" or (known and known.weight_removed):
            what = "a load whose weight the robot has removed cannot be shared by episodes"
            remedy = "describe wrench.weight as [m, m c_x, m c_y, m c_z], and use --identify"
            raise DrakeTeleopError(what, where="dataset", remedy=remedy)
        settings = [load and load.read_bytes(), streams]
        work = _open_work_folder(out, dataset, settings)
        shared = _estimate_shared_load(dataset, streams, known, stage("load"))
        task = DatasetAndLoad(dataset, streams, shared)
        rows = _judge_all_episodes(task, work, jobs, stage("episodes"))
        judged = [np.load(work / f"{k}.npy", allow_pickle=False) for k in range(len(rows))]
        columns = [ContactColumns(x[:, :6], x[:, 6] > 0.5) for x in judged]
        dataset_files.write_dataset_copy(dataset, copied, columns)
        files.write_text(out / "description.yaml", to_yaml_text(streams))
        shared.identification.save(out / "identification.json")
        summary = files.to_json_data(_dataset_summary(dataset, copied, shared, rows))
        texts = {"name": copied.name, "summary": summary}
        page = render_page("drake_teleop.logs", "dataset.html.j2", **texts)
        files.write_text(out / "report.html", page)
        shutil.rmtree(work)
        files.write_json(out / "summary.json", summary)
    if not quiet:
        _print_summary(summary, out)
    return summary


def _described_or_drafted_streams(dataset: Dataset, description: Path | None) -> dict[str, Any]:
    if description is None:
        return _draft_streams_by_majority(dataset)
    data = read_yaml(description)
    if not isinstance(data, dict) or not isinstance(data.get("wrench"), dict):
        remedy = "add `wrench:` with its columns (docs/log-description.md)"
        what = "is missing or not a mapping of fields"
        raise DrakeTeleopError(what, where=f"{description}:wrench", remedy=remedy)
    for name in _STREAM_NAMES:
        if isinstance(data.get(name), dict):
            data[name].pop("file", None)
    _description_of_episode(data, dataset.episodes[0], dataset.fps, description)  # early errors
    return data


def _description_of_episode(
    streams: dict[str, Any], episode: Episode, fps: float, where: Path | str = "description"
) -> Description:
    data = copy.deepcopy(streams)
    for name in _STREAM_NAMES:
        if name in data:
            time = {"rate": fps} if np.isfinite(fps) else {"column": "timestamp"}
            data[name] = {"file": episode.file, "time": time} | data[name]
    try:
        return Description.model_validate(data)
    except ValidationError as error:
        raise validation_error(error, where) from error


def _draft_streams_by_majority(dataset: Dataset) -> dict[str, Any]:
    count = len(dataset.episodes)
    chosen = sorted({0, count // 2, count - 1})[:_MAX_DRAFTED_EPISODES]
    episodes = [dataset.episodes[k] for k in chosen]
    drafts = [_draft_streams(dataset, episode) for episode in episodes]
    texts = Counter(json.dumps(draft, sort_keys=True) for draft in drafts)
    text, votes = texts.most_common(1)[0]
    streams = dict(json.loads(text)) if votes > 1 or count == 1 else drafts[0]
    return _choose_quaternion_order_and_wrench_sign(dataset, streams, episodes)


def _choose_quaternion_order_and_wrench_sign(
    dataset: Dataset, streams: dict[str, Any], episodes: Sequence[Episode]
) -> dict[str, Any]:
    form = streams.get("pose", {}).get("orientation", {}).get("form", "")
    found = []
    for order in ("quaternion_xyzw", "quaternion_wxyz") if "quaternion" in form else (form,):
        tried = copy.deepcopy(streams)
        if "quaternion" in form:
            tried["pose"]["orientation"]["form"] = order
        loads = []
        for episode in episodes:
            with suppress(DrakeTeleopError):
                log, _ = _read_log_and_row_times(dataset, tried, episode)
                loads.append(shared_load.fit_own_load_of_episode(EpisodeSignals(log)))
        if loads:
            spread = float(np.median([x.spread.sum() for x in loads]))
            mass = float(np.median([x.phi[0] for x in loads if x.phi is not None]))
            found.append((spread, order, mass, tried))
    if not found:
        return streams
    _, _, mass, streams = min(found, key=lambda x: x[:2])
    if mass < 0.0:
        streams["wrench"]["sign"] = -streams["wrench"].get("sign", 1)
    return streams


def _draft_streams(dataset: Dataset, episode: Episode) -> dict[str, Any]:
    table = dataset.read_episode(episode)
    draft = draft_description(table, episode.file.parent)
    streams = _streams_without_file_names(draft, dataset.fps)
    if "FILL IN" in str(streams) or "wrench" not in streams or not {"pose", "imu"} & set(streams):
        raise DrakeTeleopError(
            "wrench, time and motion are not all recognized by the names of the columns"
            f" ({', '.join(list(table.columns)[:12])} ...)",
            where=f"{episode.file.name}: {episode.name}",
            remedy="give a --description, see docs/robot-learning.md",
        )
    for _ in range(_MAX_DRAFT_CORRECTIONS):
        described = _description_of_episode(streams, episode, dataset.fps)
        try:
            found = check_conventions(described, str(episode.file), {episode.file: table}).findings
        except DrakeTeleopError:
            break
        fields = next((x for x in found if x.fields and "time" not in str(x.fields)), None)
        if fields is None:
            break
        draft = draft.with_finding_corrected(fields)
        streams = _streams_without_file_names(draft, dataset.fps)
    return streams


def _streams_without_file_names(draft: Draft, fps: float) -> dict[str, Any]:
    streams = {name: dict(x) for name, x in draft.streams.items()}
    for stream in streams.values():
        stream.pop("file", None)
        if stream.get("time", {}).get("column") == "FILL IN" and np.isfinite(fps):
            stream["time"] = {"rate": fps}
    return streams


def _read_log_and_row_times(
    dataset: Dataset, streams: dict[str, Any], episode: Episode
) -> tuple[Log, Array]:
    table = dataset.read_episode(episode)
    described = _description_of_episode(streams, episode, dataset.fps)
    source = f"{episode.file.name}: {episode.name}"
    log = read_described_log(described, source, tables={episode.file: table}, differentiate=False)
    if log.posed is None and log.R_WS is None:
        what, remedy = "the episode has no orientation", "give pose.orientation in --description"
        raise DrakeTeleopError(what, where=source, remedy=remedy)
    assert described.wrench is not None
    timed = table.rows_with_any_number(described.wrench.columns)
    clock = read_clock(described.wrench.time, timed, described.wrench.columns, source)
    rows = clock.kept_rows if timed.kept_rows is None else timed.kept_rows[clock.kept_rows]
    return log, np.interp(np.arange(_num_frames(table, streams)), rows, clock.t - clock.t[0])


def _num_frames(table: Table, streams: dict[str, Any]) -> int:
    column = str(streams["wrench"]["force"]["columns"][0])
    return len(table.columns[column]) if column in table.columns else table.rows


def _open_work_folder(out: Path, dataset: Dataset, settings: list[Any]) -> Path:
    files_or_folders = {episode.file for episode in dataset.episodes}
    paths = {path for file in files_or_folders for path in (file, *file.rglob("*"))}
    states = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in sorted(paths)]
    key = hashlib.sha256(repr((settings, dataset.fps, states)).encode()).hexdigest()
    work = out / f"unfinished-{dataset.path.resolve().name}"
    if work.is_dir() and (work / "key").is_file() and (work / "key").read_text() != key:
        shutil.rmtree(work)
    files.make_folder(work)
    files.write_text(work / "key", key)
    return work


def _estimate_shared_load(
    dataset: Dataset, streams: dict[str, Any], known: Identification | None, progress: Any
) -> SharedLoad:
    frames = max(np.median([episode.rows for episode in dataset.episodes]), 1)
    count = int(_MAX_ROWS_FOR_SHARED_LOAD // frames)
    count = min(max(count, _MIN_EPISODES_FOR_SHARED_LOAD), _MAX_EPISODES_FOR_SHARED_LOAD)
    step = -(-len(dataset.episodes) // count)
    logs, errors = [], []
    for k, episode in enumerate(dataset.episodes[::step]):
        try:
            logs.append(_read_log_and_row_times(dataset, streams, episode)[0])
        except DrakeTeleopError as error:
            errors.append(error)
        progress(0.5 * (k + 1) * step / len(dataset.episodes))
    if not logs:
        raise errors[0]
    shared = shared_load.find_shared_load(logs, known)
    progress(1.0)
    return shared


def _judge_all_episodes(
    task: DatasetAndLoad, work: Path, jobs: int, progress: Any
) -> list[dict[str, Any]]:
    from joblib import Parallel, delayed

    count = len(task.dataset.episodes)
    left = [k for k in range(count) if not (work / f"{k}.json").is_file()]
    progress(1.0 - len(left) / count)
    judge = delayed(partial(_write_verdict_of_episode, task, work))
    done = Parallel(n_jobs=jobs, return_as="generator_unordered")(map(judge, left))
    for number, _ in enumerate(done, start=count - len(left) + 1):
        progress(number / count, f"{number} of {count}")
    return [json.loads((work / f"{k}.json").read_text(encoding="utf-8")) for k in range(count)]


def _write_verdict_of_episode(task: DatasetAndLoad, work: Path, number: int) -> None:
    episode = task.dataset.episodes[number]
    try:
        with one_blas_thread():
            row, columns = _verdict_on_episode(task, episode)
    except DrakeTeleopError as error:
        rows = _num_frames(task.dataset.read_episode(episode), task.streams)
        columns = ContactColumns(np.full((rows, 6), np.nan), np.zeros(rows, bool))
        row = {"verdict": ["unusable"], "messages": [str(error)], "frames": rows}
    with replace_file_on_success(work / f"{number}.npy") as temporary, temporary.open("wb") as file:
        np.save(file, np.column_stack(columns))
    files.write_json(work / f"{number}.json", {"episode": episode.name} | row)


def _verdict_on_episode(
    task: DatasetAndLoad, episode: Episode
) -> tuple[dict[str, Any], ContactColumns]:
    shared, usual = task.shared_load, task.shared_load.usual_half_widths
    usual_lag = shared.lag_frames
    log, at = _read_log_and_row_times(task.dataset, task.streams, episode)
    signals = EpisodeSignals(log)
    found, residual = episode_verdict.find_simplest_hypothesis_and_residual(
        signals, shared.phi, usual_lag, usual
    )
    faults = saturation_faults(log.wrench)
    faults += list_faults(found, usual_lag, shared.phi, 1.0 / log.dt)
    offsets = np.tile(found.offsets, (len(residual), 1))
    step = episode_verdict.find_offset_step(residual, found.spread)
    if step is not None:
        k, before, after = step
        offsets[:k], offsets[k:] = before, after
        change = ", ".join(f"{x:.3g}" for x in after - before)
        text = f"the offsets change by [{change}] N, N m at {log.t[k]:.2f} s"
        faults.append(EpisodeFault("tared", text, float(log.t[k])))
    calm = residual - offsets
    spread, _ = episode_verdict.ln_half_width_and_centre(calm, 0.1 * usual)
    spread -= np.log(usual) + np.log(found.gains).repeat(3)
    if not faults and spread.mean() > _MAX_LN_RATIO_TO_USUAL_WIDTH:
        text = (
            "no single fault explains the wrench (possible causes: contact most of the time, or a"
            " change of the load)"
        )
        faults.append(EpisodeFault("unexplained", text, None))
    contact, touched = _contact_wrench_and_contact_flags(shared, signals, found, residual - offsets)
    rows = resample(at, log.t, contact)
    nearest = np.clip(np.round((at - log.t[0]) / log.dt).astype(int), 0, len(log) - 1)
    free = contact[~touched]
    row = {
        "verdict": list(dict.fromkeys(x.name for x in faults)) or ["ok"],
        "messages": [x.message for x in faults],
        "values": {x.name: x.value for x in faults},
        "frames": len(at),
        "rate_hz": 1.0 / log.dt,
        "lag_frames": found.lag,
        "offsets": found.offsets,
        "in_contact": float(touched[nearest].mean()),
        "free_rms": np.sqrt(np.mean(free**2, axis=0)) if len(free) else None,
        "notes": list(log.notes),
    }
    return row, ContactColumns(rows.astype(np.float32), touched[nearest])


def _contact_wrench_and_contact_flags(
    shared: SharedLoad, signals: EpisodeSignals, found: WrenchHypothesis, residual: Array
) -> tuple[Array, NDArray[np.bool_]]:
    for _ in range(3):
        contact = found.wrench_of_reading(residual)
        detector = ContactDetector(shared.noise_floor, shared.threshold, statistic="level", hold=1)
        touched = detector.detect(*shared_load.samples_for_detector(signals, found.lag, contact))
        free = samples_to_nearest_true(touched) > _CONTACT_MARGIN_FRAMES
        if free.sum() < _MIN_FREE_FRAMES_FOR_OFFSETS:
            break
        residual = residual - residual[free].mean(axis=0)
    return contact, touched


def _dataset_summary(
    dataset: Dataset, copied: Path, shared: SharedLoad, rows: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    names = Counter(name for row in rows for name in row["verdict"])
    return {
        "dataset": str(dataset.path),
        "kind": dataset.kind,
        "copy": str(copied),
        "episodes": list(rows),
        "frames": sum(row["frames"] for row in rows),
        "ok": names["ok"],
        "faults": dict(sorted((k, n) for k, n in names.items() if k != "ok")),
        "lag_frames": shared.lag_frames,
        "noise": shared.usual_half_widths / episode_verdict.STANDARD_NORMAL_QUARTILE,
        "contact_threshold": shared.threshold,
        **summarize_load(shared.identification),
    }


def _print_summary(summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console

    show = partial(Console(soft_wrap=True).print, highlight=False, markup=False)
    count = len(summary["episodes"])
    show(f"{count} episodes, {summary['frames']} frames, load {summary['mass']:.4g} kg")
    show(f"{summary['ok']} of {count} episodes are ok")
    for row in summary["episodes"]:
        for message in row["messages"]:
            show(f"  {row['episode']}: {message}")
    show(f"copy with contact wrenches: {summary['copy']}; report: {out / 'report.html'}")
