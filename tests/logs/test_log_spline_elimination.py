"""`eliminate` and `detect` with spline motion: residuals, contacts and edges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from posed_record import GRAVITY_W, LATE, OFFSETS, PHI, SECONDS, Kind, motion_at, record
from scipy.spatial.transform import Rotation

from drake_teleop.cli.logs import detect_command, eliminate_command
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causal import causal_low_pass
from drake_teleop.logs.contact import summarize_contacts
from drake_teleop.logs.pose_motion.estimate import fit_motion_to_load
from drake_teleop.logs.pose_motion.poses import Poses
from drake_teleop.logs.pose_motion.rigid import wrench_coefficients_of_load
from drake_teleop.logs.pose_motion.splines import PoseSplines
from drake_teleop.logs.processing import EliminatedLog, eliminate_log, identify_log
from drake_teleop.logs.read.alignment import low_pass, remove_delay
from drake_teleop.logs.read.canonical import POSITION_COLUMNS, QUATERNION_COLUMNS
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS as CANONICAL
from drake_teleop.logs.read.description_fields import SI_VALUE_OF_UNIT
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.sample import FINGERTIP_PUSHES as TOUCHES_OF_SAMPLE
from drake_teleop.logs.sample import POSE_CLOCK_OFFSET_S, sample_log_command
from drake_teleop.logs.sample import WRENCH_NOISE_STD as SAMPLE_NOISE

WRENCH, POSE = ("fx", "fy", "fz", "tx", "ty", "tz"), ("qw", "qx", "qy", "qz", "x", "y", "z")
NOISE = np.repeat([0.1, 0.004], 3)
TOUCHES = ((4.0, 4.12, 9.0), (9.0, 9.8, -6.0), (15.0, 15.3, 5.0))
PUSH = np.array([0.4, -0.3, 0.87, 0.05, 0.06, -0.02])
LOAD = Identification(
    phi=PHI,
    offsets=OFFSETS,
    covariance=np.diag(np.repeat([1e-6, 1e-8, 1e-8, 1e-10], [3, 3, 4, 6])),
    identifiable=np.ones(16, bool),
    condition_number=10.0,
    delay_s=0.02,
    residual_rms=0.5 * NOISE,
    method="batch least squares",
    samples=1000,
)


def contact_at(t: np.ndarray, touches: tuple = TOUCHES) -> np.ndarray:
    """Return (N, 6) half sines along `PUSH`."""
    out = np.zeros((len(t), 6))
    for start, stop, size in touches:
        share = np.clip((t - start) / (stop - start), 0.0, 1.0)
        out += np.outer(size * np.sin(np.pi * share), PUSH)
    return out


def described(folder: Path, tables: dict[str, tuple[np.ndarray, tuple, np.ndarray]]) -> Path:
    """Write tables of times, names and values of each stream, and their description."""
    document: dict = {"gravity": GRAVITY_W.tolist()}
    for name, (t, names, values) in tables.items():
        columns = {"t": t} | dict(zip(names, values.T, strict=True))
        pl.DataFrame(columns).write_parquet(folder / f"{name}.parquet")
        document[name] = {"file": f"{name}.parquet", "time": {"column": "t"}}
    document["wrench"] |= {
        "force": {"columns": list(WRENCH[:3])},
        "torque": {"columns": list(WRENCH[3:])},
    }
    document["pose"] |= {
        "orientation": {"columns": list(POSE[:4]), "form": "quaternion_wxyz"},
        "position": {"columns": list(POSE[4:])},
    }
    if "imu" in tables:
        document["imu"] |= {
            "specific_force": {"columns": ["sx", "sy", "sz"]},
            "angular_velocity": {"columns": ["wx", "wy", "wz"]},
        }
    path = folder / "log.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def log_of(
    folder: Path, kind: Kind, *, held: float = 0.0, touches: tuple = (), seconds: float = SECONDS
) -> Path:
    """Write a record as a log; with `held` [Hz] as a table of the newest samples at that rate."""
    t, wrench, poses = record(replace(kind, wrench_rate=500.0) if held else kind)
    wrench = wrench + contact_at(t, touches)
    rows = np.hstack([poses.quaternion, poses.position])
    stamps = poses.t
    if held:
        frames = np.arange(0.05, seconds, 1.0 / held)
        newest = [np.searchsorted(x, frames, side="right") - 1 for x in (t, stamps)]
        t, wrench, stamps, rows = frames, wrench[newest[0]], frames, rows[newest[1]]
    kept, posed = t < seconds, stamps < seconds
    return described(
        folder,
        {
            "wrench": (t[kept], WRENCH, wrench[kept]),
            "pose": (stamps[posed], POSE, rows[posed]),
        },
    )


def noise_ratio(found: EliminatedLog, touches: tuple = ()) -> np.ndarray:
    """Return (2,) rms residual of force and torque over that of the sensor's noise."""
    dt, begin = found.log.dt, 0.05 if found.log.dt > 0.015 else 0.0
    passed = low_pass(np.random.default_rng(0).normal(size=(4000, 1)), dt, 30.0).std()
    truth = low_pass(contact_at(found.log.t + begin, touches), dt, 30.0)
    left = (found.contact - truth)[~found.edge] / (NOISE * passed)
    return np.sqrt(np.mean(left.reshape(-1, 2, 3) ** 2, axis=(0, 2)))


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the sample log, and the load that is identified from its free motion."""
    folder = tmp_path_factory.mktemp("sample")
    sample_log_command(folder, quiet=True)
    identify_log(folder / "free.yaml").identification.save(folder / "load.json")
    return folder


def held_sample(
    sample: Path, folder: Path, name: str, rate: float, begin: float = 0.05, stop: float = 8.95
) -> Path:
    """Write a sample log as a canonical table at `rate` [Hz] of the newest samples at each time."""
    wrench, pose = (pl.read_csv(sample / f"{name}_{x}.csv").to_numpy() for x in ("wrench", "pose"))
    frames = np.arange(begin, stop, 1.0 / rate)
    w, p = (
        table[np.searchsorted(t, frames, side="right") - 1, 1:]
        for t, table in ((wrench[:, 0] / 1e3, wrench), (pose[:, 0] - POSE_CLOCK_OFFSET_S, pose))
    )
    units = np.repeat([SI_VALUE_OF_UNIT["lbf"], SI_VALUE_OF_UNIT["lbf in"]], 3)
    quaternion = Rotation.from_rotvec(p[:, 3:], degrees=True).as_quat()[:, [3, 0, 1, 2]]
    columns = np.hstack([(frames - begin)[:, None], -w * units, quaternion, p[:, :3] / 1e3])
    path = folder / "log.csv"
    pl.DataFrame(
        columns, schema=["t", *CANONICAL, *QUATERNION_COLUMNS, *POSITION_COLUMNS]
    ).write_csv(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("rate", [25.0, 30.0, 50.0, 60.0])
def test_residual_at_the_rate_of_a_camera_is_the_noise_of_the_record(sample, tmp_path, rate):
    path = held_sample(sample, tmp_path, "free", rate)
    found = eliminate_log(path, sample / "load.json")
    left = np.sqrt(np.mean(found.contact[~found.edge].reshape(-1, 2, 3) ** 2, axis=(0, 2)))
    assert (left < 1.2 * SAMPLE_NOISE[[0, 3]]).all()
    assert not found.touched.any() and found.delay_source == "estimated"
    own = identify_log(path).identification
    found = eliminate_log(path, own)
    left = np.sqrt(np.mean(found.contact[~found.edge].reshape(-1, 2, 3) ** 2, axis=(0, 2)))
    assert (left < 1.1 * SAMPLE_NOISE[[0, 3]]).all()


@pytest.mark.slow
@pytest.mark.parametrize("rate", [30.0, 50.0])
def test_contacts_at_the_rate_of_a_camera_are_those_at_the_full_rate(sample, tmp_path, rate):
    held = held_sample(sample, tmp_path, "touched", rate)
    found, full = (eliminate_log(x, sample / "load.json") for x in (held, sample / "touched.yaml"))
    newest = found.log.t + 0.05 - 0.001
    contact = np.stack([np.interp(newest, full.log.t, x) for x in full.contact.T], axis=1)
    off = (found.contact - contact)[~found.edge, :3]
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.17
    for one, begin in ((found, 0.05), (full, 0.0)):
        starts = summarize_contacts(one.log.t, one.contact, one.touched)
        assert [round(x["start_s"] + begin, 1) for x in starts] == pytest.approx(
            [touch.start_s for touch in TOUCHES_OF_SAMPLE], abs=0.11
        )


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "seed"), [(30.0, 4), (125.0, 5), (1000.0, 6)])
@pytest.mark.parametrize("touches", [(), TOUCHES])
def test_residual_is_the_noise_of_the_sensor(tmp_path, rate, seed, touches):
    kind = Kind(rate=rate, place=5e-5, turn=1e-4, seed=seed)
    found = eliminate_log(log_of(tmp_path, kind, touches=touches), LOAD)
    assert (noise_ratio(found, touches) < 1.2).all()
    assert found.delay_s == pytest.approx(LATE, abs=3e-4)
    np.testing.assert_allclose(found.offsets, OFFSETS, atol=0.05)
    in_touch = np.abs(contact_at(found.log.t, touches)).max(axis=1) > 1.0
    assert found.touched[in_touch & ~found.edge].all()
    assert found.touched.mean() < in_touch.mean() + 0.05


@pytest.mark.parametrize(("place", "turn", "colour"), [(3e-4, 6e-4, 0.0), (1e-4, 2e-4, 0.9)])
def test_noise_of_the_poses_is_no_contact(tmp_path, place, turn, colour):
    """Differentiated at 30 Hz, such poses leave 10 to 50 times the sensor's noise."""
    kind = Kind(rate=250.0, place=place, turn=turn, colour=colour, seed=6)
    found = eliminate_log(log_of(tmp_path, kind, touches=TOUCHES), LOAD)
    assert (noise_ratio(found, TOUCHES) < 1.35).all()
    assert found.delay_s == pytest.approx(LATE, abs=3e-4)


@pytest.mark.parametrize(("held", "seconds"), [(30.0, 3.0), (30.0, 5.0), (50.0, 4.0), (0.0, 2.0)])
def test_short_records_have_splines(tmp_path, held, seconds):
    kind = Kind(rate=500.0, place=5e-5, turn=1e-4, seed=7)
    found = eliminate_log(log_of(tmp_path, kind, held=held, seconds=seconds), LOAD)
    assert (noise_ratio(found) < 1.25).all()
    assert found.delay_s == pytest.approx(LATE, abs=2e-3)


def test_ends_are_marked_and_excluded_from_figures(sample, tmp_path):
    path = held_sample(sample, tmp_path, "free", 30.0, begin=1.0, stop=8.0)  # in motion
    summary = eliminate_command(path, sample / "load.json", tmp_path / "out", quiet=True)
    table = pl.read_parquet(tmp_path / "out" / "contact_wrench.parquet")
    edge = table["edge"].to_numpy()
    assert summary["edge_s"] == pytest.approx(edge.sum() / 30.0, rel=1e-3)
    assert 0.2 < summary["edge_s"] < 1.5
    middle = np.flatnonzero(~edge)
    assert edge[: middle[0]].all() and edge[middle[-1] + 1 :].all() and middle[-1] < len(edge) - 1
    assert not (edge & table["in_contact"].to_numpy()).any()
    force = np.linalg.norm(table[[f"contact_f_{x}" for x in "xyz"]].to_numpy(), axis=1)
    assert force[edge].max() > 1.0  # of splines with poses on one side only
    assert summary["residual_peak"] == pytest.approx(force[~edge].max())
    assert summary["residual_peak"] < 0.45
    assert summary["residual_rms"] == pytest.approx(np.sqrt(np.mean(force[~edge] ** 2)))
    assert summary["contacts"] == []


def save(folder: Path) -> Path:
    LOAD.save(folder / "load.json")
    return folder / "load.json"


def test_detect_marks_the_ends(tmp_path):
    summary = detect_command(
        log_of(tmp_path, Kind(seed=9), held=30.0, touches=TOUCHES),
        tmp_path / "out",
        load=save(tmp_path),
        quiet=True,
    )
    table = pl.read_parquet(tmp_path / "out" / "detection.parquet")
    edge = table["edge"].to_numpy()
    assert edge.any() and (table["level"].to_numpy()[edge] == 0.0).all()
    assert [round(c["start_s"] + 0.05) for c in summary["contacts"]] == [4, 9, 15]


def test_a_gap_of_the_poses_has_edges(tmp_path):
    t, wrench, poses = record(Kind(seed=10))
    kept = (poses.t < 8.0) | (poses.t > 8.5)
    rows = np.hstack([poses.quaternion, poses.position])
    tables = {"wrench": (t, WRENCH, wrench), "pose": (poses.t[kept], POSE, rows[kept])}
    found = eliminate_log(described(tmp_path, tables), LOAD)
    beside = np.abs(found.log.t - 8.25) < 0.4
    assert found.edge[beside].all() and not found.edge[np.abs(found.log.t - 5.0) < 1.0].any()
    assert (noise_ratio(found) < 1.2).all() and not found.touched.any()


@pytest.mark.slow
def test_a_differentiated_motion_has_edges_of_half_a_window(tmp_path):
    """Splines need positions: half of 1.8 / 30 Hz, or four samples, at 125 Hz."""
    path = log_of(tmp_path, Kind(place=0.0, turn=0.0, seed=1))
    document = yaml.safe_load(path.read_text())
    del document["pose"]["position"]
    path.write_text(yaml.safe_dump(document))
    for cutoff_hz, expected in ((30.0, 1.0 / 30.0), (10.0, 0.1), (None, 4.0 / 125.0)):
        found = eliminate_log(path, LOAD, cutoff_hz=cutoff_hz)
        assert found.edge.sum() * found.log.dt == pytest.approx(2.0 * expected, abs=0.012)
        assert found.edge[0] and found.edge[-1]


def test_causal_wrench_uses_differentiated_motion(tmp_path):
    path = log_of(tmp_path, Kind(place=0.0, turn=0.0, seed=11), touches=TOUCHES)
    found = eliminate_log(path, LOAD, causal="delayed", delay=LATE)
    log = remove_delay(read_log(path), LATE)
    contact = contact_wrench(log.wrench, OFFSETS, *log.motion, PHI)
    expected = causal_low_pass(contact, log.dt, 30.0)
    wait = int(np.ceil(LATE / log.dt))
    assert found.causal is not None
    np.testing.assert_allclose(found.causal.contact[wait:], expected[:-wait], atol=1e-9)
    assert np.abs(found.contact - contact).max() > 1e-3  # of splines


def test_a_record_at_rest_takes_the_delay_of_the_load(tmp_path):
    t, wrench, poses = record(Kind(seed=12))
    at = motion_at(np.zeros(1))
    still = np.repeat(np.hstack([poses.quaternion[:1], poses.position[:1]]), len(poses.t), axis=0)
    rest = non_contact_wrench(at.specific_force - 0.0, np.zeros(3), np.zeros(3), PHI)
    noise = NOISE * np.random.default_rng(1).normal(size=wrench.shape)
    wrench = OFFSETS + rest + noise + contact_at(t)
    found = eliminate_log(
        described(tmp_path, {"wrench": (t, WRENCH, wrench), "pose": (poses.t, POSE, still)}), LOAD
    )
    assert (found.delay_s, found.delay_source) == (LOAD.delay_s, "load")
    assert (noise_ratio(found, TOUCHES) < 1.1).all()


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.15)])
def test_an_imu_is_used_where_the_load_explains_more_with_it(tmp_path, shift):
    """Splines win with poses of S: the IMU's noise would leave three times the sensor's."""
    t, wrench, poses = record(Kind(place=1e-4, turn=2e-4, seed=13))
    at = motion_at(t)
    rng = np.random.default_rng(3)
    size = (0.3, 0.01) if not any(shift) else (0.02, 0.001)
    s, omega = (
        x + n * rng.normal(size=x.shape)
        for x, n in zip((at.specific_force, at.omega), size, strict=True)
    )
    R = Rotation.from_quat(poses.quaternion[:, [1, 2, 3, 0]]).as_matrix()
    rows = np.hstack([poses.quaternion, poses.position + R @ np.array(shift)])
    tables = {
        "wrench": (t, WRENCH, wrench),
        "pose": (poses.t, POSE, rows),
        "imu": (t, ("sx", "sy", "sz", "wx", "wy", "wz"), np.hstack([s, omega])),
    }
    found = eliminate_log(described(tmp_path, tables), LOAD)
    assert (noise_ratio(found) < 1.2).all()
    assert found.delay_s == pytest.approx(0.0 if any(shift) else LATE, abs=1e-3)


@pytest.mark.parametrize("rate", [0.9996, 1.0, 1.0005])
def test_clock_of_the_poses_is_corrected_with_a_known_load(rate):
    t, wrench, poses = record(Kind(place=5e-5, turn=1e-4, seed=14))
    late = Poses(rate * poses.t, poses.position, poses.quaternion)
    found = fit_motion_to_load(t, wrench, late, GRAVITY_W, wrench_coefficients_of_load(PHI))
    assert found.clock_rate_error == pytest.approx(rate - 1.0, abs=2e-5)


def test_the_coefficients_of_a_load_give_its_wrench():
    rng = np.random.default_rng(2)
    _, _, poses = record(Kind(seed=15))
    splines, t = PoseSplines(poses.with_continuous_quaternions(), 0.1), np.linspace(1.0, 19.0, 50)
    weight = rng.normal(size=4)
    s, omega, alpha, gravity = splines.motion(t, GRAVITY_W)
    rest, zeta = np.zeros_like(s), splines.signals(t, GRAVITY_W)
    removed = non_contact_wrench(-gravity, rest, rest, np.concatenate([weight, np.zeros(6)]))
    expected = non_contact_wrench(s, omega, alpha, PHI)
    np.testing.assert_allclose(zeta @ wrench_coefficients_of_load(PHI).T, expected, atol=1e-12)
    np.testing.assert_allclose(
        zeta @ wrench_coefficients_of_load(PHI, weight).T, expected - removed, atol=1e-12
    )
