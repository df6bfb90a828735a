"""Robot-learning datasets: verdicts of episodes, copies with contact wrenches, resumption."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.logs.dataset import dataset as command
from drake_teleop.logs.dataset.dataset import dataset_command
from drake_teleop.logs.dataset.dataset_files import (
    ContactColumns,
    open_dataset,
    write_dataset_copy,
)
from drake_teleop.logs.dataset.episode_faults import list_faults, saturation_faults
from drake_teleop.logs.dataset.episode_verdict import (
    EpisodeSignals,
    find_offset_step,
    find_simplest_hypothesis_and_residual,
)
from drake_teleop.logs.dataset.shared_load import find_shared_load
from drake_teleop.logs.pose_motion.poses import Poses, PosesOfLog
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.sample import TRUE_LOAD, WRENCH_NOISE_STD, SampleEpisode, sample_episode

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from sample_dataset import write_sample_dataset

GRAVITY_W = np.array([0.0, 0.0, -9.80665])
QUARTER_Z = Rotation.from_euler("z", 90, degrees=True).as_matrix()


def log_of(x: SampleEpisode) -> Log:
    poses, none = (
        Poses(x.t, x.position, x.quaternion).with_continuous_quaternions(),
        np.zeros((len(x.t), 3)),
    )
    return Log(x.t, x.wrench, none, none, none, posed=PosesOfLog(poses, GRAVITY_W))


def verdict(x: SampleEpisode) -> set[str]:
    fps = 1.0 / (x.t[1] - x.t[0])
    signals = EpisodeSignals(log_of(x))
    found, residual = find_simplest_hypothesis_and_residual(
        signals, TRUE_LOAD, 0.0, 0.8 * WRENCH_NOISE_STD
    )
    names = {f.name for f in list_faults(found, 0.0, TRUE_LOAD, fps) + saturation_faults(x.wrench)}
    step = find_offset_step(residual, found.spread)
    return names | ({"tared"} if step is not None else set())


def test_shared_load_is_uncertain_by_its_noise_and_the_level_has_its_own_threshold() -> None:
    found = find_shared_load([log_of(sample_episode(seed)) for seed in range(3)], None)
    load, floor = found.identification, found.noise_floor
    np.testing.assert_allclose(
        load.standard_deviations[:6], load.residual_rms / np.sqrt(load.samples), rtol=1e-6
    )
    assert found.threshold == pytest.approx(max(6.2, 1.1 * floor.free_maxima[0]))
    assert floor.free_maxima[0] < 0.9 * floor.free_maxima.max()
    error = found.phi[0] - TRUE_LOAD[0]
    assert abs(error) < 5.0 * load.standard_deviations[6] + 0.01 * TRUE_LOAD[0]


def mapped(M: Any, force: float = 1.0, torque: float = 1.0) -> Callable[..., SampleEpisode]:
    def fault(x: SampleEpisode) -> SampleEpisode:
        f, tau = x.wrench[:, :3] @ np.transpose(M), x.wrench[:, 3:] @ np.transpose(M)
        return x._replace(wrench=np.hstack([force * f, torque * tau]))

    return fault


def tared(x: SampleEpisode) -> SampleEpisode:
    quiet = [k for k in range(40, len(x.t) - 40) if not x.contact_wrench[k - 5 : k + 5].any()]
    k = min(quiet, key=lambda row: abs(row - len(x.t) // 2))
    wrench = x.wrench.copy()
    wrench[k:] -= wrench[k]
    return x._replace(wrench=wrench)


def clipped(x: SampleEpisode) -> SampleEpisode:
    limit = np.quantile(x.wrench, 0.9, axis=0)
    return x._replace(wrench=np.minimum(x.wrench, limit))


FAULTS = {
    "turned": ({"frame"}, mapped(QUARTER_Z)),
    "turned by 30 deg": ({"frame"}, mapped(Rotation.from_rotvec([0.2, 0.3, 0.38]).as_matrix())),
    "negated": ({"sign"}, mapped(-np.eye(3))),
    "turned and negated": ({"frame", "sign"}, mapped(-QUARTER_Z)),
    "one axis": ({"sign"}, mapped(np.diag([1, -1, 1]))),
    "lbf": ({"unit"}, mapped(np.eye(3), 1 / 4.4482, 1 / 0.112985)),
    "N mm": ({"unit"}, mapped(np.eye(3), 1, 1000)),
    "late": ({"lag"}, lambda x: x._replace(wrench=np.roll(x.wrench, -2, axis=0))),
    "tared": ({"tared"}, tared),
    "saturated": ({"saturated"}, clipped),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_planted_fault_is_named(name: str) -> None:
    names, fault = FAULTS[name]
    assert verdict(fault(sample_episode(101))) == names


def test_another_tool_is_named() -> None:
    other = phi_from_mass_com_inertia(0.6, np.array([0.0, 0.01, 0.04]), 1e-3 * np.eye(3))
    assert verdict(sample_episode(101, phi=other)) == {"tool changed"}


@pytest.mark.parametrize("fps", [10.0, 30.0, 50.0])
def test_clean_episodes_have_no_finding(fps: float) -> None:
    assert [verdict(sample_episode(k, fps=fps)) for k in range(3)] == [set()] * 3


def test_free_motion_leaves_the_noise_of_the_sensor_also_at_the_ends() -> None:
    phi = phi_from_mass_com_inertia(1.8, np.array([0.02, 0.01, 0.09]), 3.6e-3 * np.eye(3))
    squares = []
    for number in range(6):
        x = sample_episode(number, phi=phi, contacts=0)
        reading, load_wrench = EpisodeSignals(log_of(x)).measured_and_load_wrench(
            phi, "sensor", 0.0
        )
        rest = reading - load_wrench
        squares.append(((rest - np.median(rest, axis=0)) / WRENCH_NOISE_STD) ** 2)
    assert np.sqrt(np.mean(squares)) < 1.2
    assert np.sqrt(np.mean([x[[0, -1]] for x in squares])) < 4.0


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(st.integers(0, 50), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0.35, 3.0))
def test_any_large_rotation_of_the_wrench_is_found(
    number: int, axis: tuple[float, float, float], angle: float
) -> None:
    axis = np.array(axis) + 1e-3
    R = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    x = mapped(R)(sample_episode(number, contacts=1))
    signals = EpisodeSignals(log_of(x))
    found, _ = find_simplest_hypothesis_and_residual(
        signals, TRUE_LOAD, 0.0, 0.8 * WRENCH_NOISE_STD
    )
    assert np.degrees(Rotation.from_matrix(found.axes[0] @ R.T).magnitude()) < 3.0


STATE_COLUMNS = [f"observation.state[{k}]" for k in range(7)]
WRENCH_COLUMNS = [f"observation.wrench[{k}]" for k in range(6)]
LEROBOT = {
    "wrench": {"force": {"columns": WRENCH_COLUMNS[:3]}, "torque": {"columns": WRENCH_COLUMNS[3:]}},
    "pose": {
        "position": {"columns": STATE_COLUMNS[:3]},
        "orientation": {"columns": STATE_COLUMNS[3:], "form": "quaternion_wxyz"},
    },
}


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_lerobot_copy_has_contact_wrenches_and_the_same_other_bytes(tmp_path: Path) -> None:
    source = tmp_path / "demo"
    faults = {2: mapped(-QUARTER_Z)}
    episodes = write_sample_dataset(source, episodes=4, faults=faults)
    (source / "videos").mkdir()
    (source / "videos" / "a.mp4").write_bytes(b"film")
    before = files_of(source)
    summary = dataset_command(source, tmp_path / "out", identify=True, quiet=True)
    assert [row["verdict"] for row in summary["episodes"]] == [
        *(["ok"], ["ok"], ["sign", "frame"], ["ok"])
    ]
    assert summary["mass"] == pytest.approx(TRUE_LOAD[0], rel=5e-3)
    assert files_of(source) == before
    data = "data/chunk-000/file-000.parquet"
    old, new = (pl.read_parquet(folder / data) for folder in (source, tmp_path / "out" / "demo"))
    assert new.drop("observation.contact_wrench", "observation.in_contact").equals(old)
    contact = np.array(new["observation.contact_wrench"].to_list())
    truth = np.vstack([x.contact_wrench for x in episodes])
    free = ~truth.any(axis=1)
    assert (np.sqrt(np.mean(contact[free] ** 2, axis=0)) < 1.5 * WRENCH_NOISE_STD).all()
    touched, true = (
        new["observation.in_contact"].to_numpy(),
        np.hstack([x.in_contact for x in episodes]),
    )
    assert 2 * (touched & true).sum() / (touched.sum() + true.sum()) > 0.9
    copied = files_of(tmp_path / "out" / "demo")
    changed = {data, "meta/info.json", "meta/stats.json"}
    assert {name for name in before if copied[name] != before[name]} == changed
    stats = json.loads(copied["meta/stats.json"])["observation.contact_wrench"]
    np.testing.assert_allclose(stats["mean"], contact.mean(axis=0), atol=1e-6)
    info = json.loads(copied["meta/info.json"])["features"]
    assert info["observation.contact_wrench"]["shape"] == [6]
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.slow
def test_a_killed_run_continues_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "demo"
    write_sample_dataset(source, episodes=2)
    # A given description: the draft from the data takes most of the time of a run.
    description = tmp_path / "columns.yaml"
    description.write_text(json.dumps(LEROBOT))
    options: dict[str, Any] = {"identify": True, "description": description, "quiet": True}
    dataset_command(source, tmp_path / "whole", **options)
    judged, left = [], command._write_verdict_of_episode

    def judge(task: Any, work: Path, number: int) -> None:
        if len(judged) == 1:
            raise KeyboardInterrupt
        judged.append(number)
        left(task, work, number)

    monkeypatch.setattr(command, "_write_verdict_of_episode", judge)
    out = tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        dataset_command(source, out, **options)
    assert not (out / "summary.json").exists()
    judged.clear()
    dataset_command(source, out, **options)
    assert judged == [1]
    whole, resumed = files_of(tmp_path / "whole"), files_of(out)
    for files in (whole, resumed):
        files.pop("summary.json"), files.pop("report.html")  # contain the name of the folder
    assert whole == resumed


def test_a_file_that_changes_is_read_again(tmp_path: Path) -> None:
    for seed in (0, 1):
        episodes = write_sample_dataset(tmp_path / "demo", episodes=2, seed=seed)
        dataset = open_dataset(tmp_path / "demo")
        for episode, made in zip(dataset.episodes, episodes, strict=True):
            read = dataset.read_episode(episode).numbers_with_nan("observation.wrench[2]", "test")[
                :, 0
            ]
            np.testing.assert_allclose(read, made.wrench[:, 2], atol=1e-5)


STATE = {
    "wrench": {"force": {"columns": ["f[0]", "f[1]", "f[2]"]}, "torque": {"columns": ["tau"]}},
    "pose": {
        "orientation": {"columns": ["quat"], "form": "quaternion_wxyz"},
        "position": {"columns": ["pos"]},
    },
}


def arrays(x: SampleEpisode) -> dict[str, Any]:
    return {"f": x.wrench[:, :3], "tau": x.wrench[:, 3:], "quat": x.quaternion, "pos": x.position}


def described(folder: Path, prefix: str, **time: Any) -> Path:
    text = json.dumps(STATE)
    for name in ("f[0]", "f[1]", "f[2]", "tau", "quat", "pos"):
        text = text.replace(f'"{name}"', f'"{prefix}{name}"')
    data = json.loads(text)
    for stream in data.values():
        stream |= {"time": time} if time else {}
    (folder / "columns.yaml").write_text(json.dumps(data))
    return folder / "columns.yaml"


@pytest.mark.slow
def test_robomimic_file_gets_observations(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "demo.hdf5"
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = '{"env_kwargs": {"control_freq": 30}}'
        for k in range(3):
            for name, values in arrays(sample_episode(k)).items():
                file[f"data/demo_{k}/obs/{name}"] = values
    before = path.read_bytes()
    options: dict[str, Any] = {"identify": True, "quiet": True}
    options["description"] = described(tmp_path, "obs.")
    summary = dataset_command(path, tmp_path / "out", **options)
    assert summary["ok"] == 3 and path.read_bytes() == before
    with h5py.File(tmp_path / "out" / "demo.hdf5") as file:
        assert file["data/demo_2/obs/contact_wrench"].shape == (180, 6)
        np.testing.assert_array_equal(file["data/demo_1/obs/pos"], sample_episode(1).position)


@pytest.mark.slow
def test_zarr_gets_arrays(tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr")
    path = tmp_path / "demo.zarr"
    episodes = [sample_episode(k) for k in range(3)]
    root = zarr.open_group(path, mode="w")
    for name in arrays(episodes[0]):
        whole = np.vstack([arrays(x)[name] for x in episodes])
        root.create_array(f"data/{name}", data=whole)
    root.create_array("meta/episode_ends", data=np.array([180, 360, 540]))
    before = files_of(path)
    description = described(tmp_path, "", rate=30)
    options: dict[str, Any] = {"identify": True, "quiet": True, "description": description}
    assert dataset_command(path, tmp_path / "out", **options)["ok"] == 3
    assert files_of(path) == before
    copied = zarr.open_group(tmp_path / "out" / "demo.zarr", mode="r")
    assert copied["data/contact_wrench"].shape == (540, 6)
    assert copied["data/in_contact"].dtype == bool


@pytest.mark.slow
def test_csv_episodes_keep_their_text(tmp_path: Path) -> None:
    source = tmp_path / "demo"
    source.mkdir()
    names = [*("fx", "fy", "fz", "tx", "ty", "tz"), *("x", "y", "z", "qw", "qx", "qy", "qz")]
    for k in range(3):
        x = sample_episode(k)
        table = np.hstack([x.t[:, None], x.wrench, x.position, x.quaternion])
        pl.DataFrame(table, schema=["t", *names]).write_csv(source / f"{k}.csv", float_precision=6)
    summary = dataset_command(source, tmp_path / "out", identify=True, quiet=True)
    assert [row["verdict"] for row in summary["episodes"]] == [["ok"]] * 3
    for k in range(3):
        old = (source / f"{k}.csv").read_text().splitlines()
        new = (tmp_path / "out" / "demo" / f"{k}.csv").read_text().splitlines()
        assert len(new) == len(old)
        assert all(b.startswith(f"{a},") for a, b in zip(old, new, strict=True))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "one of --load and --identify"),
        ({"identify": True, "load": Path("load.json")}, "one of --load and --identify"),
        ({"identify": True}, "contains no episodes"),
    ],
)
def test_invalid_input_is_one_error(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(DrakeTeleopError, match=words):
        dataset_command(tmp_path, tmp_path.with_name("out"), quiet=True, **options)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("wrench: {colums: [fx]}", r"d\.yaml:wrench\.colums: unknown field"),
        ("pose: {}", r"d\.yaml:wrench: is missing"),
    ],
)
def test_invalid_description_is_an_error_with_its_field(
    tmp_path: Path, text: str, words: str
) -> None:
    (tmp_path / "demo").mkdir()
    pl.DataFrame({"t": [0.0, 0.1], "fx": [0.0, 1.0]}).write_csv(tmp_path / "demo" / "0.csv")
    (tmp_path / "d.yaml").write_text(text)
    options: dict[str, Any] = {"identify": True, "quiet": True, "description": tmp_path / "d.yaml"}
    with pytest.raises(DrakeTeleopError, match=words):
        dataset_command(tmp_path / "demo", tmp_path / "out", **options)


def new_columns(rows: int, unusable: int = 0) -> ContactColumns:
    wrench = np.arange(6.0 * rows).reshape(rows, 6) + 0.25
    wrench[:unusable] = np.nan
    return ContactColumns(wrench, np.arange(rows) > rows // 2)


@pytest.mark.parametrize(
    ("separator", "decimal"), [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]
)
@pytest.mark.parametrize("names", [("t", "Fx"), ("t [s]", "Fx [N]"), ("time of row", "F in x")])
@pytest.mark.parametrize("suffix", ["csv", "tsv"])
def test_new_columns_of_text_have_its_separator_and_decimal_sign(
    tmp_path: Path, separator: str, decimal: str, names: tuple[str, str], suffix: str
) -> None:
    (tmp_path / "demo").mkdir()
    rows = [separator.join([str(k), f"{k}.5".replace(".", decimal)]) for k in range(5)]
    path = tmp_path / "demo" / f"0.{suffix}"
    path.write_text("\n".join([separator.join(names), *rows, ""]))
    write_dataset_copy(open_dataset(path.parent), tmp_path / "copy", [new_columns(5)])
    new = pl.read_csv(
        tmp_path / "copy" / f"0.{suffix}", separator=separator, decimal_comma=decimal == ","
    )
    assert new.columns[:2] == list(names) and new.width == 9
    np.testing.assert_allclose(new.to_numpy()[:, 2:8], new_columns(5).contact_wrench)
    np.testing.assert_allclose(new.to_numpy()[:, 1], np.arange(5) + 0.5)


@pytest.mark.parametrize("unusable", [0, 1, 180, 300, 360])
def test_statistics_leave_out_frames_without_a_contact_wrench(
    tmp_path: Path, unusable: int
) -> None:
    write_sample_dataset(tmp_path / "demo", episodes=2)
    whole = new_columns(360, unusable)
    columns = [ContactColumns(*(x[part] for x in whole)) for part in np.split(np.arange(360), 2)]
    write_dataset_copy(open_dataset(tmp_path / "demo"), tmp_path / "copy", columns)
    text = (tmp_path / "copy" / "meta" / "stats.json").read_text()
    assert "NaN" not in text
    stats = json.loads(text)
    assert stats["observation.in_contact"]["count"] == [360]
    if unusable == 360:
        assert "observation.contact_wrench" not in stats
        return
    found, used = stats["observation.contact_wrench"], whole.contact_wrench[unusable:]
    assert found["count"] == [360 - unusable]
    np.testing.assert_allclose(found["mean"], used.mean(axis=0))
    np.testing.assert_allclose(found["min"], used.min(axis=0))


@pytest.mark.filterwarnings("ignore:.*onsolidated metadata:UserWarning")
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("consolidated", [False, True])
def test_zarr_of_both_versions_lists_the_new_arrays(
    tmp_path: Path, version: Any, consolidated: bool
) -> None:
    zarr = pytest.importorskip("zarr")
    path = tmp_path / "demo.zarr"
    root = zarr.open_group(path, mode="w", zarr_format=version)
    root.create_array("data/force", data=np.zeros((9, 3)))
    root.create_array("meta/episode_ends", data=np.array([5, 9]))
    if consolidated:
        zarr.consolidate_metadata(path, zarr_format=version)
    before = files_of(path)
    columns = [new_columns(5), new_columns(4)]
    write_dataset_copy(open_dataset(path), tmp_path / "copy.zarr", columns)
    assert files_of(path) == before
    copied = zarr.open_group(tmp_path / "copy.zarr", mode="r")
    np.testing.assert_array_equal(copied["data/contact_wrench"][5:], columns[1].contact_wrench)
    assert copied["data/in_contact"].shape == (9,)


@pytest.mark.parametrize("others", [2, 60, 400])
def test_new_columns_have_the_length_of_the_wrench(tmp_path: Path, others: int) -> None:
    """Other arrays of the group, such as initial states, may be shorter or longer."""
    h5py = pytest.importorskip("h5py")
    path, x = tmp_path / "demo.hdf5", sample_episode(0)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = '{"env_kwargs": {"control_freq": 30}}'
        file["data/demo_0/initial_state"] = np.zeros(others)
        for name, values in arrays(x).items():
            file[f"data/demo_0/obs/{name}"] = values
    dataset = open_dataset(path)
    streams = json.loads(described(tmp_path, "obs.").read_text())
    log, at = command._read_log_and_row_times(dataset, streams, dataset.episodes[0])
    assert len(at) == len(x.t) and at[-1] == pytest.approx(log.t[-1])


@pytest.mark.parametrize(("fps", "is_kept"), [(30.0, True), (31.0, False), (10.0, False)])
def test_results_at_another_rate_are_not_continued(
    tmp_path: Path, fps: float, is_kept: bool
) -> None:
    write_sample_dataset(tmp_path / "demo", episodes=1)
    dataset = open_dataset(tmp_path / "demo")._replace(fps=30.0)
    work = command._open_work_folder(tmp_path / "out", dataset, [])
    (work / "0.json").write_text("{}")
    command._open_work_folder(tmp_path / "out", dataset._replace(fps=fps), [])
    assert (work / "0.json").exists() == is_kept


def key_of_interrupted_run(folder: Path, load: Path, description: Any = LEROBOT) -> str:
    (folder / "d.yaml").write_text(json.dumps(description))
    options: dict[str, Any] = {"load": load, "description": folder / "d.yaml", "quiet": True}
    with pytest.raises(KeyboardInterrupt):
        dataset_command(folder / "demo", folder / "out", **options)
    return (folder / "out" / "unfinished-demo" / "key").read_text()


def identification(**changes: Any) -> Identification:
    covariance = np.eye(16) * 1e-8
    known = {"phi": TRUE_LOAD, "offsets": np.zeros(6), "covariance": covariance} | changes
    numbers = np.ones(16, bool), 1.0, 0.0, np.ones(6), "test", 100
    return Identification(*known.values(), *numbers)


@pytest.mark.parametrize("factor", [1.0, 1.0 + 1e-9, 1.0 + 1e-6, 1.001])
def test_results_with_another_load_are_not_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_estimate_shared_load", interrupt)
    write_sample_dataset(tmp_path / "demo", episodes=1)
    load, keys = tmp_path / "load.json", []
    for covariance in np.eye(16) * 1e-8, factor * np.eye(16) * 1e-8:
        identification(covariance=covariance).save(load)
        keys.append(key_of_interrupted_run(tmp_path, load))
    assert (keys[0] == keys[1]) == (factor == 1.0)


@pytest.mark.parametrize("suffix", [".zarr", ".hdf5"])
def test_results_of_changed_arrays_are_not_continued(tmp_path: Path, suffix: str) -> None:
    zarr, h5py = pytest.importorskip("zarr"), pytest.importorskip("h5py")
    path = tmp_path / f"demo{suffix}"
    root = zarr.open_group(path, mode="w") if suffix == ".zarr" else h5py.File(path, "w")
    root["data/a/force"] = np.zeros((9, 3))
    root["meta/episode_ends"] = np.array([9])
    if suffix == ".hdf5":
        root.close()
    dataset = open_dataset(path)
    work = command._open_work_folder(tmp_path / "out", dataset, [])
    (work / "0.json").write_text("{}")
    command._open_work_folder(tmp_path / "out", dataset, [])
    assert (work / "0.json").exists()
    root = zarr.open_group(path, mode="r+") if suffix == ".zarr" else h5py.File(path, "r+")
    root["data/a/force"][:] = np.ones((9, 3))
    if suffix == ".hdf5":
        root.close()
    command._open_work_folder(tmp_path / "out", dataset, [])
    assert not (work / "0.json").exists()


@pytest.mark.parametrize("name", ["demo", "unfinished", "unfinished-unfinished", "key"])
def test_copy_is_not_in_the_folder_of_unfinished_results(tmp_path: Path, name: str) -> None:
    write_sample_dataset(tmp_path / name, episodes=1)
    work = command._open_work_folder(tmp_path / "out", open_dataset(tmp_path / name), [])
    assert tmp_path / "out" / name not in (work, *work.parents)


@pytest.mark.slow
def test_shared_load_has_the_usual_delay_and_is_uncertain_by_gain_errors() -> None:
    logs = [log_of(sample_episode(k, lag_frames=2.0)) for k in range(2)]
    plain, widened = (
        find_shared_load([replace(log, gain_std=gain_std) for log in logs], None).identification
        for gain_std in (0.0, 0.05)
    )
    assert plain.delay_s == pytest.approx(2.0 / 30.0, abs=0.15 / 30.0)
    np.testing.assert_array_equal(plain.phi, widened.phi)
    increase = widened.standard_deviations[6] - plain.standard_deviations[6]
    assert 0.6 < increase / (0.05 * TRUE_LOAD[0]) < 1.1
    assert (widened.standard_deviations[7:10] > 5.0 * plain.standard_deviations[7:10]).all()


@pytest.mark.parametrize("removed_from", ["episodes", "load"])
def test_removed_weight_is_refused(tmp_path: Path, removed_from: str) -> None:
    write_sample_dataset(tmp_path / "demo", episodes=1)
    described = json.loads(json.dumps(LEROBOT))
    if removed_from == "episodes":
        described["wrench"]["weight"] = "removed"
    (tmp_path / "d.yaml").write_text(json.dumps(described))
    load = replace(identification(), weight_removed=removed_from == "load")
    load.save(tmp_path / "load.json")
    options: dict[str, Any] = {"load": tmp_path / "load.json", "description": tmp_path / "d.yaml"}
    with pytest.raises(DrakeTeleopError, match=r"weight the robot has removed.*wrench\.weight"):
        dataset_command(tmp_path / "demo", tmp_path / "out", quiet=True, **options)


@pytest.mark.parametrize(("number", "row"), [(0, 0), (1, 7), (2, 179)])
def test_rows_in_messages_are_those_of_the_file(tmp_path: Path, number: int, row: int) -> None:
    write_sample_dataset(tmp_path / "demo", episodes=3)
    dataset = open_dataset(tmp_path / "demo")
    table = dataset.read_episode(dataset.episodes[number])
    assert table.line_in_file(row) == 180 * number + row + 1
    index = pl.read_parquet(table.path)["index"]
    assert index[table.line_in_file(row) - 1] == table.columns["index"][row]
