"""Simulated robot-learning dataset of an arm with a gripper, and its true contact wrenches."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.files import write_json, write_table
from drake_teleop.common.numeric import Array
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.logs import sample

PHI = phi_from_mass_com_inertia(sample.MASS, sample.COM, sample.INERTIA_COM)
"""Load phi (10,) of the gripper."""
NOISE = sample.NOISE
_POSE_NOISE = np.repeat([5e-5, 2e-4], 3)  # m, rad
_HARMONICS, _REST_S = 5, 0.2
_MIN_CONTACT_N = 0.5
_SIZE = 0.35 * np.array([0.8, 0.4, 0.45, 1.0, 1.0, 1.3])  # amplitudes of the joints [rad]


class SampleEpisode(NamedTuple):
    """Frames of one episode: times, pose of S, reported wrench; true wrench and contact."""

    t: Array
    position: Array
    quaternion: Array
    wrench: Array
    contact_wrench: Array
    in_contact: NDArray[np.bool_]


def sample_episode(
    number: int,
    *,
    fps: float = 30.0,
    duration_s: float = 6.0,
    seed: int = 0,
    phi: Array = PHI,
    contacts: int = 2,
    lag_frames: float = 0.0,
) -> SampleEpisode:
    """Return an episode whose motion, contacts and noise follow from its number and the seed.

    Args:
        phi: (10,) load.
        lag_frames: delay of the poses behind the wrench [frames].
    """
    from scipy.spatial.transform import Rotation

    random = np.random.default_rng([2026, seed, number])
    t = np.arange(round(duration_s * fps)) / fps
    period = duration_s - 2 * _REST_S
    sine, cosine = random.normal(size=(2, 6, _HARMONICS - 1)) * _SIZE[:, np.newaxis]
    path = FourierTrajectory.at_rest(sample.HOME, sine, cosine, 1 / period)

    def motion(at: Array) -> tuple[Array, ...]:
        return sample.sensor_motion(*path.evaluate(np.clip(at - _REST_S, 0, period)))

    s, omega, alpha, R_WS, _ = motion(t)
    contact = np.zeros((len(t), 6))
    starts = np.sort(random.uniform(0.15, 0.75, contacts)) * duration_s
    for start in starts:
        push = random.normal(size=3)
        push *= random.uniform(5, 15) / np.linalg.norm(push)
        touch = sample.Touch(start, start + random.uniform(0.4, 0.9), tuple(push))
        f = np.einsum("nji,nj->ni", R_WS, -touch.force(t))
        contact += np.hstack([f, np.cross(sample.TIP_S, f)])
    offsets = sample.OFFSETS[0] + random.normal(size=6) * np.repeat([0.5, 0.02], 3)
    wrench = non_contact_wrench(s, omega, alpha, phi) + contact + offsets
    wrench += NOISE * random.normal(size=wrench.shape)
    *_, R_late, p_late = motion(t - lag_frames / fps)
    noise = _POSE_NOISE * random.normal(size=(len(t), 6))
    turned = Rotation.from_matrix(R_late) * Rotation.from_rotvec(noise[:, 3:])
    quaternion = turned.as_quat()[:, [3, 0, 1, 2]]
    touched = np.linalg.norm(contact[:, :3], axis=1) > _MIN_CONTACT_N
    return SampleEpisode(t, p_late + noise[:, :3], quaternion, wrench, contact, touched)


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
        "length": lengths,
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
    }
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
