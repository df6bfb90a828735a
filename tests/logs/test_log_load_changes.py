"""Load changes that `identify` reports, in simulated and real records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from known_motion import GRAVITY_W, Motion, motion_at, quaternions
from scipy.spatial.transform import Rotation
from test_log_commands import GRAVITY, describe_poses, describe_record

from drake_teleop.cli.logs import identify_command
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.online.change import (
    STATE_CHANGED,
    STATE_KNOWN,
    change_detector_parameters,
    detector_states_of_log,
    initial_change_memory,
)
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causes.explain import explain_misfit
from drake_teleop.logs.causes.instants import block_means_of_record
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.canonical import Log, write_log

TOOL = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))
OBJECT = phi_from_mass_com_inertia(0.8, [0.04, 0.0, 0.2], np.diag([8e-4, 8e-4, 4e-4]))
OFFSETS = np.array([3.0, -2.0, 7.0, 0.1, 0.2, -0.3])


def simulated(path: Path, grasped_at: float, clock: float = 0.0) -> Path:
    """Write a canonical log, 12 s at 500 Hz."""
    t = np.arange(0.0, 12.0, 2e-3)
    motion = motion_at(t)
    parts = motion.specific_force, motion.omega, motion.alpha
    share = np.clip((t - grasped_at) / 0.05, 0.0, 1.0)[:, None]
    wrench = OFFSETS + non_contact_wrench(*parts, TOOL) + share * non_contact_wrench(*parts, OBJECT)
    wrench += np.repeat([0.2, 0.01], 3) * np.random.default_rng(3).normal(size=wrench.shape)
    write_log(Log(t + clock, wrench, *parts), path)
    return path


@pytest.mark.slow
def test_identify_reports_the_time_of_a_load_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The time is that of the log."""
    summary = identify_command(simulated(tmp_path / "log.parquet", 4.0, clock=100.0), tmp_path)
    (cause,) = summary["causes"]
    assert cause["name"] == "load change"
    assert cause["start_s"] == pytest.approx(104.0, abs=0.1)
    before, after = summary["loads"]
    assert before["mass"] == pytest.approx(3.13, rel=0.01)
    assert after["mass"] == pytest.approx(3.93, rel=0.01)
    assert summary["mass"] == before["mass"]
    assert "from t = 104.0" in capsys.readouterr().out.replace("\n", " ")


@pytest.mark.slow
def test_identify_reports_no_change_of_a_constant_load(tmp_path: Path) -> None:
    summary = identify_command(simulated(tmp_path / "log.parquet", 20.0), tmp_path, quiet=True)
    assert summary["causes"] == [] and summary["loads"] == []


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize(("record", "cutoff_hz"), [("1-baseline", 30.0), ("2-vibrations", None)])
def test_ntnu_records_have_one_load(
    ntnu: Path, tmp_path: Path, record: str, cutoff_hz: float | None
) -> None:
    """The sensor rotates about one axis, freely and with a hammer that taps on the robot."""
    assert identify_log(describe_record(tmp_path, ntnu, record), cutoff_hz=cutoff_hz).loads == ()


@pytest.mark.slow
@pytest.mark.parametrize("record", ["1-baseline", "2-vibrations"])
def test_only_an_added_load_is_found(ntnu: Path, tmp_path: Path, record: str) -> None:
    """The log is unfiltered; the load is from poses of another day, with 2 % of model errors.

    Vibration is four times the noise at rest (README of the records), offsets drift by 0.5 N. The
    hammer is a disturbance, not a load. Adding 0.25 kg to the wrench is a change.
    """
    known = identify_log(describe_poses(tmp_path, ntnu, GRAVITY)).identification
    log = identify_log(describe_record(tmp_path, ntnu, record), cutoff_hz=None).log
    noise = 4.0 * np.array([0.035, 0.021, 0.075, 0.0012, 0.0019, 0.0003])
    motion_std, drift = np.repeat([0.1, 0.0, 0.0], 3), np.repeat([0.5, 0.02], 3)

    theta = np.concatenate([known.offsets, known.phi])

    def states(wrench: np.ndarray) -> np.ndarray:
        parameters = change_detector_parameters(
            noise, motion_std, log.dt, relative_wrench_error=0.02
        )
        memory = initial_change_memory(theta, known.covariance, drift)
        return detector_states_of_log(memory, parameters, wrench, *log.motion)

    free = states(log.wrench)
    assert free.max() < STATE_CHANGED and free[-1] == STATE_KNOWN
    assert (free == STATE_KNOWN).mean() > (1 - 1e-9 if record == "1-baseline" else 0.95)
    added = phi_from_mass_com_inertia(0.25, [0.0, 0.0, 0.08], 1e-5 * np.eye(3))
    after = log.t - log.t[0] - 2.5
    grasped = states(log.wrench + (after > 0)[:, None] * non_contact_wrench(*log.motion, added))
    assert 0.0 < after[np.argmax(grasped == STATE_CHANGED)] < 0.5


@pytest.mark.slow
def test_ur5_pushes_are_not_a_load_change(ur5: Path, tmp_path: Path) -> None:
    """Eight pushes of up to 50 N act on a handle of 0.1 kg."""
    record = f"{ur5}/No9_Singularity_Free_ForceSensor__"
    description: dict[str, Any] = {
        "wrench": {
            "file": record + "log_force_sensor.csv",
            "header": False,
            "time": {"column": 0},
            "force": {"columns": [1, 2, 3]},
            "torque": {"columns": [4, 5, 6]},
        },
        "pose": {
            "file": record + "log_tool_vector.csv",
            "header": False,
            "time": {"column": 0},
            "orientation": {"columns": [4, 5, 6], "form": "rotation_vector"},
            "position": {"columns": [1, 2, 3]},
        },
    }
    path = tmp_path / "log.yaml"
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    assert identify_log(path).loads == ()


@pytest.mark.slow
def test_utias_records_have_one_load(utias: Path) -> None:
    """Ten tools from 9 g to 1 kg stop and go, with the noise that the authors call high."""
    s_std, alpha_std, f_std, tau_std = 0.1, 1.0, 0.2, 0.01
    for file in sorted(utias.glob("*.npz")):
        with np.load(file) as data:
            # These records have gravity upwards (their README).
            s = data["a_S"] - 9.81 * data["R_WS"][:, 2]
            wrench = np.hstack([data["f_S"], data["tau_S"]])
            omega, alpha = data["omega_S"], data["alpha_S"]
        rng = np.random.default_rng(0)
        wrench = wrench + np.repeat([f_std, tau_std], 3) * rng.normal(size=wrench.shape)
        s, alpha = (
            x + std * rng.normal(size=x.shape) for x, std in ((s, s_std), (alpha, alpha_std))
        )
        t = 0.01 * np.arange(len(s))
        why = explain_misfit(block_means_of_record(t, wrench, (s, omega, alpha), None))
        assert [cause.name for cause in why.causes if cause.name != "no load"] == [], file.stem


@pytest.fixture
def utias(ntnu: Path) -> Path:
    folder = ntnu.parent / "utias_workshop_tools"
    if not folder.is_dir():
        pytest.skip("needs the records utias_workshop_tools, which the project does not ship")
    return folder


def random_motion(t: np.ndarray) -> Motion:
    """A brisk motion of sums of sines, by central differences of a rotation and a position."""
    rng = np.random.default_rng(7)
    rates, phases = 0.7 * rng.uniform(0.4, 1.6, (6, 3)), rng.uniform(0.0, 2.0 * np.pi, (6, 3))
    sizes = np.repeat([0.6, 0.12], 3)[:, None] * rng.uniform(0.3, 0.8, (6, 3))
    sizes, rates = sizes[..., None], 2.0 * np.pi * rates[..., None]

    def pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = (sizes * np.sin(rates * t + phases[..., None])).sum(axis=1).T
        return Rotation.from_euler("ZYX", x[:, :3] + [0.0, 0.0, 2.6]).as_matrix(), x[:, 3:]

    h = 1e-4
    (R, p), (after, p2), (before, p1) = pose(t), pose(t + h), pose(t - h)
    turn = np.swapaxes(R, 1, 2) @ np.stack(
        [(after - before) / (2 * h), (after - 2 * R + before) / h**2]
    )
    omega, alpha = (
        np.stack(
            [W[:, 2, 1] - W[:, 1, 2], W[:, 0, 2] - W[:, 2, 0], W[:, 1, 0] - W[:, 0, 1]], axis=1
        )
        / 2
        for W in turn
    )
    s = np.einsum("nji,nj->ni", R, (p2 - 2 * p + p1) / h**2 - GRAVITY_W)
    return Motion(t, R, p, s, omega, alpha)


def posed_log(folder: Path, t: np.ndarray, wrench: np.ndarray, *, sign: float = 1.0) -> Path:
    """A log of this wrench with the poses of the random motion."""
    at = random_motion(t)
    noise = np.random.default_rng(4).normal(size=wrench.shape)
    wrench = sign * wrench + np.repeat([0.1, 0.005], 3) * noise
    columns = {"q": quaternions(at.R_WS), "p": at.p_WS, "f": wrench[:, :3], "m": wrench[:, 3:]}
    table = {f"{k}{i}": x[:, i] for k, x in columns.items() for i in range(x.shape[1])}
    pl.DataFrame({"t": t} | table).write_parquet(folder / "log.parquet")
    file = {"file": "log.parquet", "time": {"column": "t"}}
    named = {k: {"columns": [f"{k}{i}" for i in range(x.shape[1])]} for k, x in columns.items()}
    form = {"form": "quaternion_wxyz"}
    log = {
        "gravity": [float(x) for x in GRAVITY_W],
        "wrench": {**file, "force": named["f"], "torque": named["m"]},
        "pose": {**file, "orientation": named["q"] | form, "position": named["p"]},
    }
    (folder / "log.yaml").write_text(yaml.safe_dump(log))
    return folder / "log.yaml"


def load_wrench(t: np.ndarray, phi: np.ndarray) -> np.ndarray:
    at = random_motion(t)
    return non_contact_wrench(at.specific_force, at.omega, at.alpha, phi)


@pytest.mark.slow
def test_delay_is_that_of_the_fit_with_the_load_change(tmp_path: Path) -> None:
    t = np.arange(0.0, 20.0, 4e-3)
    wrench = load_wrench(t, TOOL) - (t > 11.0)[:, None] * load_wrench(t, 0.8 * TOOL)
    found = identify_log(posed_log(tmp_path, t, wrench))
    assert [cause.name for cause in found.causes] == ["load change"]
    assert found.identification.delay_s == pytest.approx(0.0, abs=2e-4)
    residual = found.log.wrench - found.predicted
    first = found.log.t - found.log.t[0] < 10.5
    assert residual[first, :3].std() < 0.2


@pytest.mark.slow
def test_contact_in_most_of_a_record_leaves_the_load_of_the_rest(tmp_path: Path) -> None:
    """Also with an inverted wrench; no change of the load between two contacts is named."""
    t = np.arange(0.0, 30.0, 4e-3)
    R = random_motion(t).R_WS
    push = (np.sin(2.0 * np.pi * t / 7.0) > -0.3)[:, None] * np.einsum("nji,j->ni", R, [0, 0, 30.0])
    arm = np.array([0.0, 0.0, 0.18])
    wrench = load_wrench(t, TOOL) - np.hstack([push, np.cross(arm, push)])
    found = identify_log(posed_log(tmp_path, t, wrench, sign=-1.0))
    assert {cause.name for cause in found.causes} == {"axes", "contact"}
    assert found.identification.mass == pytest.approx(TOOL[0], rel=2e-3)
    assert found.identification.identifiable.all()


@pytest.mark.slow
def test_a_wrong_sign_is_no_error_of_the_clock(tmp_path: Path) -> None:
    t = np.arange(0.0, 12.0, 8e-3)
    wrench = load_wrench(t, TOOL)
    load = identify_log(posed_log(tmp_path, t, wrench)).identification
    found = eliminate_log(posed_log(tmp_path, t, wrench, sign=-1.0), load)
    assert [finding.name for finding in found.findings] == ["sign"]
    assert "clock" not in str(found.log.notes)
