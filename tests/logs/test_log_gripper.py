"""Gripper and object on logs: `identify --gripper` and `eliminate --gripper`, Eq. (14)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from known_motion import motion_at
from shown import type_in

from drake_teleop.cli.logs import eliminate_command, identify_command
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.processing import eliminate_log
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS, Log, write_log
from drake_teleop.logs.summaries import notes_on_grasped_object

GRIPPER = phi_from_mass_com_inertia(1.2, [0.0, 0.01, 0.05], np.diag([0.004, 0.004, 0.002]))
DESCRIPTION = """
wrench:
  file: {name}.parquet
  time: {{column: t}}
  force: {{columns: [f_x, f_y, f_z]}}
  torque: {{columns: [tau_x, tau_y, tau_z]}}
  sign: 1
imu:
  file: {name}.parquet
  time: {{column: t}}
  specific_force: {{columns: [s_x, s_y, s_z]}}
  angular_velocity: {{columns: [omega_x, omega_y, omega_z]}}
  angular_acceleration: {{columns: [alpha_x, alpha_y, alpha_z]}}
"""
OBJECT = phi_from_mass_com_inertia(0.7, [0.01, -0.02, 0.16], np.diag([0.003, 0.002, 0.002]))


def simulated(path: Path, phi: np.ndarray, seed: int, contact: np.ndarray | None = None) -> Path:
    """Write a canonical log, 4 s at 500 Hz, with noise and offsets."""
    t = np.arange(0, 4, 2e-3)
    motion = motion_at(t)
    kinematics = motion.specific_force, motion.omega, motion.alpha
    wrench = non_contact_wrench(*kinematics, phi) + np.array([1.0, 2.0, -1.0, 0.1, 0.0, 0.2])
    wrench += np.random.default_rng(seed).normal(size=wrench.shape) * np.repeat([0.1, 0.01], 3)
    if contact is not None:
        wrench += contact
    write_log(Log(t, wrench, *kinematics), path)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder in which the commands of docs/theory.md have been run.

    Results: gripper/identification.json, total/ with object.json as well, and out/eliminate.
    """
    folder = tmp_path_factory.mktemp("gripper")
    push = np.zeros((2000, 6))
    push[1000:1200, 2] = 20.0
    simulated(folder / "gripper.parquet", GRIPPER, 1)
    simulated(folder / "total.parquet", GRIPPER + OBJECT, 2)
    simulated(folder / "log.parquet", GRIPPER + OBJECT, 3, push)
    for name in ("gripper", "total", "log"):
        (folder / f"{name}.yaml").write_text(DESCRIPTION.format(name=name))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        type_in("docs/theory.md", "drake-teleop identify gripper.yaml")
    return folder


@pytest.mark.slow
def test_identify_writes_the_object(files: Path) -> None:
    summary = json.loads((files / "total" / "summary.json").read_text())
    total, alone, found = (
        Identification.load(files / name)
        for name in (
            "total/identification.json",
            "gripper/identification.json",
            "total/object.json",
        )
    )
    np.testing.assert_allclose(found.phi, total.phi - alone.phi, atol=1e-15)
    assert found.mass == pytest.approx(0.7, abs=0.005)
    np.testing.assert_allclose(found.com, [0.01, -0.02, 0.16], atol=2e-3)
    assert found.physically_consistent
    assert summary["object"]["mass"] == found.mass
    assert summary["object"]["not_identifiable"] == []
    assert len(summary["object"]["identifiable"]) == 10
    assert summary["object"]["consistency_margin"] > summary["object"]["consistency_margin_std"]
    assert not [note for note in summary["notes"] if "object" in note]


@pytest.mark.slow
def test_result_is_half_of_the_object_plus_the_push(files: Path) -> None:
    summary = json.loads((files / "out" / "eliminate" / "summary.json").read_text())
    (push,) = summary["contacts"]
    assert push["peak_N"] == pytest.approx(20.0, rel=0.1)
    # The zero-phase low-pass of 30 Hz widens it by about 30 ms.
    assert 1.95 < push["start_s"] < 2.02 and 2.38 < push["stop_s"] < 2.45
    assert summary["eta"] == 0.5


@pytest.mark.slow
def test_table_has_columns_of_the_object_only_with_a_gripper(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, gripper = files / "total.parquet", files / "gripper" / "identification.json"
    identify_command(log, tmp_path, gripper=gripper, delay=0.0)
    assert "object: mass" in capsys.readouterr().out
    summary = identify_command(log, tmp_path / "single", delay=0.0)
    assert "object: " not in capsys.readouterr().out
    assert "object" not in summary
    assert not (tmp_path / "single" / "object.json").exists()


@pytest.mark.slow
def test_note_reports_a_gripper_without_object(files: Path, tmp_path: Path) -> None:
    gripper = files / "gripper" / "identification.json"
    log = simulated(tmp_path / "empty.parquet", GRIPPER, 8)
    summary = identify_command(log, tmp_path / "out", gripper=gripper, delay=0.0, quiet=True)
    assert any("no object" in note for note in summary["notes"])
    assert summary["object"]["identifiable"] == []


@pytest.mark.parametrize(
    ("mass", "std", "is_absent"),
    [(0.7, np.inf, False), (0.7, 0.2, False), (0.001, 0.002, True), (-0.001, 0.002, True)],
)
def test_object_with_unknown_mass_is_not_reported_as_absent(
    mass: float, std: float, is_absent: bool
) -> None:
    phi = phi_from_mass_com_inertia(mass, [0.0, 0.0, 0.1], 0.001 * mass * np.eye(3))
    covariance = np.diag(np.where(np.arange(16) == 6, std**2, 1e-6))
    load = Identification(
        phi, np.zeros(6), covariance, np.zeros(16, bool), 1.0, 0.0, np.ones(6), "method", 100
    )
    assert any("no object" in note for note in notes_on_grasped_object(load)) == is_absent


@pytest.mark.slow
def test_eta_splits_gripper_and_object(files: Path) -> None:
    load, gripper = (files / name / "identification.json" for name in ("total", "gripper"))
    log = files / "total.parquet"
    options = {"gripper": gripper, "delay": 0.0, "cutoff_hz": None}
    found = eliminate_log(log, load, eta=0.5, **options)
    phi_object = Identification.load(files / "total" / "object.json").phi
    kept = 0.5 * non_contact_wrench(*found.log.motion, phi_object)
    np.testing.assert_allclose(found.scaled, found.contact + kept, atol=1e-9)
    by_hand = eliminate_log(log, load, sigma=0.0, sigma_object=0.5, **options)
    np.testing.assert_array_equal(by_hand.scaled, found.scaled)
    # Truth: half of the non-contact wrench of the object, without that of the gripper.
    truth = 0.5 * non_contact_wrench(*found.log.motion, OBJECT)
    assert np.sqrt(np.mean((found.scaled - truth)[:, :3] ** 2)) < 0.12
    # With all scales at 1 the result is the measurement, for any split.
    whole = eliminate_log(log, load, sigma=1.0, **options)
    np.testing.assert_allclose(whole.scaled, whole.measured, atol=1e-9)


@pytest.mark.slow
def test_incompatible_scales_raise(files: Path) -> None:
    load, gripper = (files / name / "identification.json" for name in ("total", "gripper"))
    log = files / "total.parquet"
    with pytest.raises(DrakeTeleopError, match=r"sigma_object.*gripper"):
        eliminate_log(log, load, sigma_object=0.5)
    with pytest.raises(DrakeTeleopError, match="eta requires sigma = 0"):
        eliminate_log(log, load, gripper=gripper, eta=0.5, sigma_object=0.5)
    with pytest.raises(DrakeTeleopError, match="sigma_object: -1 is outside"):
        eliminate_log(log, load, gripper=gripper, sigma_object=-1.0)


@pytest.mark.slow
def test_exchanged_files_are_an_error_in_both_commands(files: Path, tmp_path: Path) -> None:
    load, gripper = (files / name / "identification.json" for name in ("total", "gripper"))
    with pytest.raises(DrakeTeleopError, match="kg for the object"):
        identify_command(files / "gripper.parquet", tmp_path / "a", gripper=load, quiet=True)
    with pytest.raises(DrakeTeleopError, match="kg for the object"):
        eliminate_command(files / "total.parquet", gripper, tmp_path / "b", gripper=load)
    assert not (tmp_path / "a").exists() and not (tmp_path / "b").exists()


@pytest.mark.slow
def test_eliminate_with_gripper_has_contacts_and_causal_wrench(files: Path, tmp_path: Path) -> None:
    t = np.arange(0, 4, 2e-3)
    force = np.where((t > 2.0) & (t < 2.5), 12 * np.sin(2 * np.pi * (t - 2.0)) ** 2, 0.0)
    touch = np.outer(force, [0.3, 0, -1, 0, 0.05, 0])
    log = simulated(tmp_path / "log.parquet", GRIPPER + OBJECT, 5, touch)
    load = files / "total" / "identification.json"
    out = tmp_path / "out"
    summary = eliminate_command(log, load, out, causal="delayed", delay=0.0, quiet=True)
    (found,) = summary["contacts"]
    assert 2.0 < found["start_s"] < 2.1 and 2.4 < found["stop_s"] < 2.51
    assert found["peak_N"] == pytest.approx(12 * np.hypot(0.3, 1), abs=0.3)
    assert found["peak_Nm"] == pytest.approx(0.6, abs=0.05)
    assert 0.08 < summary["in_contact"] < 0.13
    # White noise of 0.1 N at 500 Hz through the 30 Hz low-pass, in [f; tau].
    share = np.sqrt(np.mean(1 / (1 + (np.linspace(0, 250, 5000) / 30) ** 4) ** 2))
    np.testing.assert_allclose(summary["noise_floor"], share * np.repeat([0.1, 0.01], 3), rtol=0.25)
    table = pl.read_parquet(out / "contact_wrench.parquet")
    contact = table.select([f"contact_{c}" for c in WRENCH_COLUMNS]).to_numpy()
    late = table.select([f"causal_contact_{c}" for c in WRENCH_COLUMNS]).to_numpy()
    assert table["in_contact"].mean() == summary["in_contact"]
    assert summary["causal"]["mode"] == "delayed"
    assert summary["causal"]["lag_s"] == pytest.approx(0.0098, abs=2e-4)
    # The same force, delayed by the lag: 4 samples at 500 Hz.
    shifted = np.abs(late[4:, 2] - contact[:-4, 2]).max()
    assert shifted < 0.35 < 0.4 < np.abs(late[:, 2] - contact[:, 2]).max()
    ahead = eliminate_log(log, load, causal="predicted", delay=0.0).causal
    assert np.abs(ahead.contact[:, 2] - contact[:, 2]).max() < 0.4


@pytest.mark.slow
def test_a_free_record_has_no_contact(files: Path, tmp_path: Path) -> None:
    load = files / "total" / "identification.json"
    summary = eliminate_command(files / "total.parquet", load, tmp_path, delay=0.0, quiet=True)
    assert summary["contacts"] == [] and summary["in_contact"] == 0.0
    assert summary["causal"] is None
