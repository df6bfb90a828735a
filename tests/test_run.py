"""`drake-teleop run`: files, warnings, reproducibility."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from shown import type_in

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import scenarios_dir
from drake_teleop.lab.identification import slave_arm
from drake_teleop.lab.run import (
    FILTER_SETTLING_S,
    ScenarioRun,
    _detection_delays,
    _moving_body_displacements,
    _print_summary,
    is_in_contact,
    run_command,
    summarise,
)
from drake_teleop.load.batch.uncertainty import confidence_intervals
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import mass_com_inertia
from drake_teleop.logs.processing import identify_log
from drake_teleop.station.result import Signal, SimulationResult
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.signals import MOVING_BODY_POSE_PREFIX, SIGNALS

# The estimator runs in the loop, so no identification is needed.
QUICK = """
simulation: {duration: 0.15, settle: 0.05, seed: 4}
load_estimator: {enabled: true}
operator:
  grip: firm
  intent: [!Sine {duration: 10.0, ramp: 0.1, frequency: 3.0, translation: [0.01, 0.01, 0.02]}]
"""


@pytest.fixture(scope="module")
def typed(tmp_path_factory):
    """Run the commands of README and the beginners' page; return their output folder."""
    folder = tmp_path_factory.mktemp("typed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        type_in("README.md", ".venv/bin/drake-teleop run contact_transition")
        patch.setattr("drake_teleop.lab.run.draw_overview", lambda result: Figure())
        type_in("docs/start.md", ".venv/bin/drake-teleop run mine.yaml")
    return folder / "out"


def summary_of(out):
    return json.loads((out / "summary.json").read_text())


@pytest.fixture(scope="module")
def contact(typed):
    return summary_of(typed / "contact"), typed / "contact"


@pytest.fixture(scope="module")
def identification(tmp_path_factory):
    out = tmp_path_factory.mktemp("identification")
    return run_command("identification", out, quiet=True), out


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """Return a function that runs QUICK with further lines, without its picture."""
    monkeypatch.setattr("drake_teleop.lab.run.draw_overview", lambda result: Figure())

    def run(name: str, more: str = "", seed: int | None = None, quiet: bool = True):
        path = tmp_path / "quick.yaml"
        path.write_text(QUICK + more)
        return run_command(path, tmp_path / name, seed=seed, quiet=quiet), tmp_path / name

    return run


@pytest.mark.parametrize(("seed", "samples"), [(123456, 100001), (7, 20)])
def test_printed_seed_and_number_of_samples_are_exact(capsys, tmp_path, seed, samples):
    summary = {"description": "", "scenario": "touch", "seed": seed, "samples": samples}
    summary |= {"peak_force": 1.23456, "load_source": "", "true_contact_s": [], "warnings": []}
    _print_summary(summary, tmp_path)
    assert f"seed {seed} samples {samples} peak_force 1.235 " in " ".join(
        capsys.readouterr().out.replace("│", " ").split()
    )


@pytest.mark.slow
def test_contact_scenario_uses_an_identified_load(contact):
    summary, out = contact
    assert summary["warnings"] == []
    assert summary["mass_error_percent"] < 0.2
    assert summary["com_error_mm"] < 0.5
    ((start, stop),) = summary["true_contact_s"]
    assert 0.205 < start < 0.235 < stop < 0.3
    assert 10 < summary["peak_contact_force_N"] < 25
    assert 90 < summary["peak_measured_force_N"] < 115
    assert summary["residual_force_max_N"] < 1.5
    load = Identification.load(out / "identification.json")
    assert load.mass == pytest.approx(3.13, rel=2e-3)
    assert load.identifiable.all()
    assert load.method == "recursive total least squares"


@pytest.mark.slow
def test_everything_is_written(contact):
    summary, out = contact
    session = json.loads((out / "session.json").read_text())
    assert set(session) == {"load_source", "real_time_factor"}
    result = SimulationResult.read_parquet(out / "log.parquet")
    assert len(result.t) == summary["samples"] == 801
    assert {"measured_wrench_S", "sheet_state", "force_to_master"} <= set(result)
    log = pl.read_parquet(out / "sensor_log.parquet")
    np.testing.assert_array_equal(log["f_z"], result["measured_wrench_S"][:, 2])
    assert (out / "overview.png").read_bytes().startswith(b"\x89PNG")
    assert LoadScenario(out / "scenario.yaml") == LoadScenario("contact_transition")
    assert summary["description"] in (out / "replay.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_written_scenario_is_the_one_that_was_run(typed):
    contact, mine = (
        sorted((typed / name / "log.parquet").iterdir()) for name in ("contact", "mine")
    )
    assert [part.read_bytes() for part in contact] == [part.read_bytes() for part in mine]


@pytest.mark.slow
def test_peg_task_succeeds(typed):
    """Run the shipped scenario; `tests/operator/test_task.py` tests other outcomes."""
    summary = summary_of(typed / "insert")
    assert summary["success"] == 1 and summary["false_notices"] == 0


@pytest.mark.slow
def test_shipped_identification_matches_the_log_tools(identification):
    """The log tools find the same load in the run's sensor log."""
    summary, out = identification
    assert summary["duration_s"] == 6.0
    assert (out / "replay.html").exists()
    assert summary["residual_force_max_N"] < 1.5
    load = Identification.load(out / "identification.json")
    again = identify_log(out / "sensor_log.parquet", cutoff_hz=None, delay=0.0).identification
    found = np.concatenate([load.offsets, load.phi])
    from_log = np.concatenate([again.offsets, again.phi])
    # Only one estimator weights the channels by their noise.
    assert np.all(np.abs(found - from_log) < 5 * again.standard_deviations)


@pytest.mark.slow
def test_load_errors_match_their_stated_deviations(identification):
    _, out = identification
    load = Identification.load(out / "identification.json")
    scenario = LoadScenario("identification")
    mass, com, inertia = mass_com_inertia(slave_arm(scenario).phi_load)
    _, found_com, found_inertia = mass_com_inertia(load.phi)
    assert abs(load.mass / mass - 1) < 1e-3
    assert np.linalg.norm(found_com - com) < 3e-4
    principal = np.linalg.eigvalsh(found_inertia) / np.linalg.eigvalsh(inertia)
    assert np.abs(principal - 1).max() < 0.05
    error = np.abs(load.offsets - scenario.wrist_sensor.offset)
    assert np.all(error < [0.1, 0.1, 0.1, 0.005, 0.005, 0.005])
    low, high = confidence_intervals(load)
    truth = np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])
    # With 16 intervals of 95 %, four or more misses have a probability of 1 %.
    assert np.sum((low <= truth) & (truth <= high)) >= 13


@pytest.mark.slow
def test_files_are_reproducible_for_a_seed(quick):
    _, first = quick("first")
    _, again = quick("again")
    summary, other = quick("other", seed=5)
    assert summary["seed"] == 5
    logs = [
        [part.read_bytes() for part in sorted((out / "log.parquet").iterdir())]
        for out in (first, again, other)
    ]
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


@pytest.mark.slow
def test_enabled_load_estimator_needs_no_identification(quick):
    summary, out = quick("learning")
    assert not (out / "identification.json").exists()
    assert summary["seed"] == 4
    assert summary["true_contact_s"] == []


@pytest.mark.slow
def test_table_contains_saturation_and_reason_of_failure(quick, capsys):
    more = "  task: !Reach {t_start: 0.1}\nwrist_sensor: {force_range: [100, 100, 31]}"
    summary, _ = quick("saturated", more, quiet=False)
    assert summary["success"] == 0.0
    assert summary["failure"].startswith("the simulation ended after 0.10 s of the task, while")
    (warning,) = summary["warnings"]
    assert warning.startswith("the wrist sensor saturates from 0.")
    said = " ".join(capsys.readouterr().out.split())
    assert "peak_measured_force_N" in said
    assert f"the task failed: {summary['failure']}" in said
    assert "warning: the wrist sensor saturates" in said
    assert "written to" in said


@pytest.mark.slow
def test_a_pose_out_of_reach_is_reported_with_its_time(quick):
    summary, _ = quick(
        "far", "kinematic_scaling: {translation_scale: 30}\nslave: {position: [0.6, 0, 0.6]}"
    )
    assert any(
        warning.startswith("inverse kinematics: ") and " from 0." in warning and " to 0." in warning
        for warning in summary["warnings"]
    )


def test_an_unknown_scenario_names_those_that_exist(tmp_path):
    with pytest.raises(DrakeTeleopError, match="contact_transition"):
        run_command("no_such_scenario", tmp_path, quiet=True)


def test_bounces_belong_to_one_contact():
    t = np.arange(0.0, 0.1, 0.001)
    force = np.zeros((len(t), 6))
    force[10:15, 2] = force[18:22, 2] = 5.0  # a bounce of 3 ms
    force[60, 2] = 5.0
    spec = Signal("true_contact_wrench_W", tuple("abcdef"), "N")
    contact = is_in_contact(SimulationResult(t, {spec.name: force}, [spec]))
    np.testing.assert_array_equal(np.flatnonzero(contact), [*range(10, 22), 60])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before_s", "counts"), [(0.5 * FILTER_SETTLING_S, False), (1.5 * FILTER_SETTLING_S, True)]
)
@pytest.mark.parametrize("end", [False, True], ids=["before the contact", "after the contact"])
def test_residual_leaves_out_the_time_beside_a_contact(contact, before_s, counts, end):
    """50 N at one sample beside the contact appear in the residual only outside of the tail."""
    result = SimulationResult.read_parquet(contact[1] / "log.parquet")
    first, last = result.t[np.flatnonzero(is_in_contact(result))[[0, -1]]]
    at = last + before_s if end else first - before_s
    signals = {name: result[name].copy() for name in result.signals}
    signals["measured_wrench_S"][np.abs(result.t - at).argmin(), 0] += 50.0
    changed = SimulationResult(result.t, signals, list(result.specs))
    summary = summarise(ScenarioRun(LoadScenario("contact_transition"), changed, None, "", 1.0))
    assert (summary["residual_force_max_N"] > 40.0) == counts


@pytest.mark.slow
def test_detector_notices_contact_before_the_operator(tmp_path, capsys):
    text = (scenarios_dir() / "touch.yaml").read_text()
    path = tmp_path / "touch.yaml"
    path.write_text(text + "contact_detection: {}\n")
    summary = run_command(path, tmp_path / "out")
    assert summary["success"] == 1
    noticed, at_hand = summary["contact_noticed_ms"], summary["contact_at_hand_ms"]
    assert len(noticed) == len(summary["true_contact_s"])
    assert 0 < noticed[0] <= at_hand[0] < 10
    assert at_hand[0] < 1e3 * summary["detection_time_s"]
    assert summary["false_contacts"] == summary["false_notices"] == 0
    assert summary["press_error_N"] is None
    printed = " ".join(capsys.readouterr().out.split())
    assert f"noticed after {noticed[0]:.1f} ms, at the hand after {at_hand[0]:.1f} ms" in printed
    assert "task_time_s" in printed


def test_detection_delays_belong_to_the_contact_before_them():
    t = 0.01 * np.arange(100)
    (noticed, at_hand), spans = np.zeros((2, 100)), [(0.2, 0.3), (0.6, 0.7)]
    noticed[23:28] = noticed[31:33] = noticed[65:75] = noticed[90:] = 1.0
    at_hand[25:30] = 1.0
    signals = {"contact": noticed, "contact_at_hand": at_hand}
    result = SimulationResult(t, signals, [SIGNALS[name] for name in signals])
    assert _detection_delays(result, spans) == {
        "contact_noticed_ms": pytest.approx([30.0, 50.0]),
        "contact_at_hand_ms": [pytest.approx(50.0), None],
        "false_contacts": 1,  # the one at 0.31 s is within 10 ms of the contact
    }


def test_displacement_and_rotation_of_a_moved_body_are_in_mm_and_degrees():
    class Run(dict):
        signals = property(list)

    turn = Rotation.from_rotvec([0.3, -0.2, 0.1])
    turned = Rotation.from_rotvec([0.0, 0.3, 0.4]) * turn
    poses = [
        [*turn.as_quat(scalar_first=True), 1.0, 2.0, 3.0],
        [*turned.as_quat(scalar_first=True), 1.003, 2.0, 2.996],
    ]
    found = _moving_body_displacements(Run({f"{MOVING_BODY_POSE_PREFIX}block": np.array(poses)}))
    assert found["moved_mm"] == pytest.approx({"block": 5.0})
    assert found["turned_deg"] == pytest.approx({"block": np.degrees(0.5)})


def test_detection_delay_is_empty_without_contact():
    noticed = np.array([0.0, 1.0, 1.0, 0.0])
    signals = {"contact": noticed, "contact_at_hand": noticed}
    specs = [SIGNALS[name] for name in signals]
    result = SimulationResult(np.arange(4.0), signals, specs)
    expected = {"contact_noticed_ms": [], "contact_at_hand_ms": [], "false_contacts": 1}
    assert _detection_delays(result, []) == expected
