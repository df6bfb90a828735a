"""Simulated robot-learning dataset of LeRobot (v3.0), from the episodes of `sample_episode`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.files import write_json, write_table
from drake_teleop.common.numeric import Array
from drake_teleop.logs.sample import SampleEpisode, sample_episode

TASK = "Touch the table."
Fault = Callable[[SampleEpisode], SampleEpisode]


def write_sample_dataset(
    folder: Path,
    *,
    episodes: int = 5,
    fps: float = 30.0,
    duration_s: float = 6.0,
    seed: int = 0,
    faults: Mapping[int, Fault] | None = None,
    changes: Mapping[int, Mapping[str, Any]] | None = None,
) -> list[SampleEpisode]:
    """Write a LeRobot dataset (v3.0) in one data file, and return its episodes.

    Args:
        faults: function for each faulty episode, which returns the recorded episode.
        changes: arguments of `sample_episode` for single episodes.
    """
    import polars as pl

    made = []
    for k in range(episodes):
        options = dict((changes or {}).get(k, {}))
        episode = sample_episode(k, fps=fps, duration_s=duration_s, seed=seed, **options)
        made.append((faults or {}).get(k, lambda x: x)(episode))
    frames = []
    for k, x in enumerate(made):
        count, first = len(x.t), sum(len(other.t) for other in made[:k])
        state = np.hstack([x.position, x.quaternion])
        listed = {"observation.state": state, "observation.wrench": x.wrench, "action": state}
        frames.append(
            pl.DataFrame(
                [
                    *(_series(name, values) for name, values in listed.items()),
                    pl.Series("timestamp", x.t, dtype=pl.Float32),
                    pl.Series("frame_index", np.arange(count), dtype=pl.Int64),
                    pl.Series("episode_index", np.full(count, k), dtype=pl.Int64),
                    pl.Series("index", first + np.arange(count), dtype=pl.Int64),
                    pl.Series("task_index", np.zeros(count, int), dtype=pl.Int64),
                ]
            )
        )
    for name in ("data/chunk-000", "meta/episodes/chunk-000"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    whole = pl.concat(frames)
    write_table(folder / "data/chunk-000/file-000.parquet", whole)
    lengths = [len(x.t) for x in made]
    ends = np.cumsum(lengths)
    index = {
        "episode_index": np.arange(episodes),
        "tasks": [[TASK]] * episodes,
        "length": lengths,
        "data/chunk_index": np.zeros(episodes, int),
        "data/file_index": np.zeros(episodes, int),
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": np.zeros(episodes, int),
        "meta/episodes/file_index": np.zeros(episodes, int),
    }
    tasks = pl.DataFrame({"task_index": [0], "task": [TASK]})
    write_table(folder / "meta/tasks.parquet", tasks)
    write_table(folder / "meta/episodes/chunk-000/file-000.parquet", pl.DataFrame(index))
    _write_meta(folder, whole, episodes, fps)
    return made


def _series(name: str, values: Array) -> Any:
    import polars as pl

    return pl.Series(name, values.astype(np.float32).tolist(), dtype=pl.List(pl.Float32))


def _write_meta(folder: Path, whole: Any, episodes: int, fps: float) -> None:
    names = {
        "observation.state": [*("x", "y", "z"), *("qw", "qx", "qy", "qz")],
        "observation.wrench": ["fx", "fy", "fz", "tx", "ty", "tz"],
    }
    names["action"] = names["observation.state"]
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(x)], "names": x} for name, x in names.items()
    }
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        dtype = "float32" if name == "timestamp" else "int64"
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    info = {
        "codebase_version": "v3.0",
        "robot_type": "ur5e",
        "total_episodes": episodes,
        "total_frames": len(whole),
        "total_tasks": 1,
        "fps": round(fps),
        "splits": {"train": f"0:{episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": features,
    }
    write_json(folder / "meta/info.json", info)
    stats = {}
    for name in names:
        x = np.array(whole[name].to_list(), dtype=float)
        parts = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0)}
        stats[name] = {key: value.tolist() for key, value in parts.items()} | {"count": [len(x)]}
    (folder / "meta/stats.json").write_text(json.dumps(stats, indent=4))
