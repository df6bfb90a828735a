"""`drake-teleop reproduce`: values of the paper's figures, and their dependence on physics."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from collections import defaultdict
from functools import partial

import numpy as np
import pytest
from shown import type_in

from drake_teleop.cli.main import main
from drake_teleop.lab.identification import slave_arm
from drake_teleop.lab.reproduction import experiments, reproduce
from drake_teleop.lab.reproduction.experiments import (
    DISPLAYED_LOAD_SHARES,
    MotionRun,
    RunsWithAndWithoutContact,
    detection_and_peaks_of_contact_run,
    largest_raw_force_beyond_free_range,
    peaks_and_residuals_of_free_run,
    simulate_motion,
    time_of_largest_raw_force_after_contact,
    wrench_errors_of_ideal_run,
)
from drake_teleop.lab.reproduction.report import (
    compare_with_paper,
    describe_values_outside_ranges,
    values_by_full_name,
)
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import regressor_into
from drake_teleop.station.result import Signal, SimulationResult
from drake_teleop.station.scenario import LoadScenario, replace

pytestmark = pytest.mark.slow

FORCE_SCALE = 1 / 17.5


EXPERIMENTS = (
    "identify_load",
    "simulate_motion",
    "simulate_ideal_motion",
    "simulate_contact",
    "_measure_simulation_speed",
)


@pytest.fixture(scope="module")
def results():
    """Return a list for each experiment, to which `run` appends its results."""
    return {name: [] for name in EXPERIMENTS}


def module_of(experiment):
    """Return the module in which `reproduce_command` looks up this function."""
    return experiments if hasattr(experiments, experiment) else reproduce


def recorded(function, results):
    def call(*arguments):
        results.append(function(*arguments))
        return results[-1]

    return call


@pytest.fixture(scope="module")
def run(tmp_path_factory, results):
    folder = tmp_path_factory.mktemp("reproduce")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in EXPERIMENTS:
            module = module_of(name)
            patch.setattr(module, name, recorded(getattr(module, name), results[name]))
        type_in("docs/start.md", ".venv/bin/drake-teleop reproduce")
    out = folder / "out" / "r"
    written = (json.loads((out / f"{name}.json").read_text()) for name in ("summary", "session"))
    return next(written) | next(written), out


def log(out, name: str) -> SimulationResult:
    return SimulationResult.read_parquet(out / "logs" / f"{name}.parquet")


@pytest.mark.slow
def test_free_motion_is_as_in_figure_6(run):
    figures = run[0]["free_force"]
    assert 90 <= figures["peak_raw_N"] <= 115
    assert figures["peak_raw_master_N"] == pytest.approx(5.7, abs=0.3)
    assert 0.48 <= figures["half_ratio"] <= 0.52
    assert figures["residual_max_N"] <= figures["residual_norm_max_N"] <= 1.5


@pytest.mark.slow
def test_free_motion_is_as_in_figure_7(run):
    figures = run[0]["free_torque"]
    assert 3 <= figures["peak_raw_Nm"] <= 12
    assert figures["peak_raw_master_Nm"] == pytest.approx(FORCE_SCALE * figures["peak_raw_Nm"])
    assert 0.48 <= figures["half_ratio"] <= 0.52
    assert figures["residual_max_Nm"] <= 0.03 * figures["peak_raw_Nm"]


@pytest.mark.slow
def test_the_contact_is_as_in_figure_8(run):
    figures = run[0]["contact"]
    assert 0.205 <= figures["true_s"] <= 0.235
    assert 0 <= figures["detected_s"] - figures["true_s"] <= 0.010
    free = figures["free_residual_norm_max_N"]
    assert figures["threshold_N"] == pytest.approx(1.5 * free, rel=1e-12)
    assert figures["raw_detectable"] is False
    assert figures["false_alarm_0_6_s"] is False
    assert 10 <= figures["peak_contact_N"] <= 25
    assert figures["peak_contact_N"] < 0.5 * figures["peak_inertial_N"]


@pytest.mark.slow
def test_load_is_identified_from_sensor_samples(run):
    figures = run[0]["identification"]
    assert figures["mass_error_percent"] <= 0.2
    assert figures["com_error_mm"] <= 0.5
    assert figures["offset_error_N"] <= 0.05
    assert figures["recursive_against_batch_std"] < 1


@pytest.mark.slow
def test_the_speed_was_measured(run):
    """The time has no bound, because tests do not measure time."""
    speed = run[0]["speed"]
    assert speed["real_time_factor"] > 0
    assert speed["cost_over_bare_plant"] > 1


@pytest.mark.slow
def test_all_rows_are_accepted(run):
    assert describe_values_outside_ranges(run[0]) == []


@pytest.mark.slow
def test_everything_is_written(run):
    summary, out = run
    written = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert written.items() <= summary.items()
    assert "speed" not in written
    for name in ("fig6", "fig7", "fig8"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    table = (out / "table.md").read_text(encoding="utf-8")
    assert len(table.splitlines()) == 2 + len(compare_with_paper(values_by_full_name(summary)))
    assert [table.count(f"| {verdict} |") for verdict in ("agrees", "differs")] == [5, 0]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert 'src="replay.html"' in page
    assert page.count("data:image/png;base64,") == 3
    assert "contact.true_s" in page
    assert (out / "replay.html").stat().st_size > 1e6
    # Each record has its scenario, for `replay`.
    scenarios = sorted(path.stem for path in (out / "logs").glob("*.yaml"))
    assert [f"{name}.parquet" for name in scenarios] == sorted(
        path.name for path in (out / "logs").glob("*.parquet") if "sensor_log" not in path.name
    )
    assert LoadScenario(out / "logs" / "contact_transition.yaml").sheet_spring is not None
    without = LoadScenario(out / "logs" / "contact_transition_without_sheet.yaml")
    assert without.sheet_spring is None
    load = Identification.load(out / "identification.json")
    assert load.mass == summary["identification"]["mass_kg"]
    assert load.method == "recursive total least squares"


@pytest.mark.slow
def test_bottom_plots_equal_the_output_of_the_loop(run):
    _, out = run
    load = Identification.load(out / "identification.json")
    for name in ("free_motion_force", "free_motion_torque", "contact_transition"):
        result = log(out, name)
        bottom = contact_wrench(
            result["measured_wrench_S"],
            load.offsets,
            result["specific_force_S"],
            result["angular_velocity_S"],
            result["angular_acceleration_S"],
            load.phi,
        )
        np.testing.assert_allclose(bottom, result["scaled_wrench_S"], atol=1e-12)
        for part in (slice(0, 3), slice(3, 6)):
            felt = np.linalg.norm(result["force_to_master"][:, part], axis=1)
            left = np.linalg.norm(bottom[:, part], axis=1)
            np.testing.assert_allclose(felt, FORCE_SCALE * left, atol=1e-12)


@pytest.mark.slow
def test_sensor_log_alone_gives_the_same_load(run):
    """The log without states of the plant gives the same load."""
    _, out = run
    result = log(out, "identification")
    assert "contact_wrench_S" not in result
    np.testing.assert_array_equal(result["load_estimate"][0], 0.0)
    load = Identification.load(out / "identification.json")
    np.testing.assert_array_equal(
        result["load_estimate"][-1], np.concatenate([load.offsets, load.phi])
    )


# Values for synthetic motions.


def force(*components: float) -> np.ndarray:
    return np.array([*components, 0.0, 0.0, 0.0])


@pytest.fixture
def motion() -> RunsWithAndWithoutContact:
    """Return 100 N of motion and 15 N of contact at 0.22 s, at 2 kHz, with 0.5 N of noise."""
    t = np.arange(0.0, 0.8, 5e-4)
    free = np.zeros((len(t), 6))
    free[:, 2] = -30 + 70 * np.cos(2 * np.pi * (t - 0.05) / 0.38)
    residual = np.outer(np.sin(40 * t), force(0.0, 0.0, 0.5))
    touch = np.outer((t >= 0.22) & (t < 0.26), force(0.0, 0.0, 15.0))
    return RunsWithAndWithoutContact(
        motion_run(touch, free + touch + residual, touch + residual),
        motion_run(0.0 * touch, free + residual, residual),
    )


def motion_run(touch: np.ndarray, measured: np.ndarray, calculated: np.ndarray) -> MotionRun:
    t = 5e-4 * np.arange(len(touch))
    spec = Signal("true_contact_wrench_W", tuple("abcdef"), "N")
    sheet = Signal("sheet_state", ("z", "v"), ("m", "m/s"))
    signals = {spec.name: touch, sheet.name: np.zeros((len(t), 2))}
    wrenches = {1.0: measured, 0.0: calculated}
    scenario = LoadScenario("contact_transition")
    return MotionRun(scenario, SimulationResult(t, signals, [spec, sheet]), wrenches)


def test_contact_is_detected_at_once_but_not_in_the_raw_force(motion):
    figures = detection_and_peaks_of_contact_run(motion)
    assert figures["true_s"] == figures["detected_s"] == pytest.approx(0.22)
    assert figures["threshold_N"] == pytest.approx(0.75, rel=1e-3)
    assert figures["raw_detectable"] is False
    assert np.all(largest_raw_force_beyond_free_range(motion) <= 0)
    assert figures["false_alarm_0_6_s"] is False
    assert figures["duration_s"] == pytest.approx(0.04)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_raw_force_detects_contact_by_any_axis(motion, axis):
    motion.touched.scaled_wrenches[1.0][motion.in_contact, axis] += 180.0
    assert detection_and_peaks_of_contact_run(motion)["raw_detectable"] is True


def test_raw_force_detects_contact_by_its_norm(motion):
    """Each component is inside its range, but not the norm."""
    free, told = (one.scaled_wrenches[1.0] for one in (motion.free, motion.touched))
    free[:100, 0] = told[:100, 0] = 80.0
    told[motion.in_contact, 0] = 80.0
    excess = largest_raw_force_beyond_free_range(motion)
    assert np.all(excess[:3] <= 0)
    assert excess[3] > 0


def test_crossing_at_the_second_reversal_is_a_false_alarm(motion):
    run = motion.touched
    run.scaled_wrenches[0.0][np.argmin(np.abs(run.result.t - 0.6)), 2] = 2.0
    assert detection_and_peaks_of_contact_run(motion)["false_alarm_0_6_s"] is True


def test_contact_is_not_detected_without_elimination(motion):
    for one in (motion.touched, motion.free):
        one.scaled_wrenches[0.0] = one.scaled_wrenches[1.0]
    figures = detection_and_peaks_of_contact_run(motion)
    assert figures["detected_s"] is None
    assert np.isnan(values_by_full_name({"contact": figures})["contact.detected_s"])


def test_contact_time_is_null_without_contact(motion):
    without = RunsWithAndWithoutContact(motion.free, motion.free)
    figures = detection_and_peaks_of_contact_run(without)
    assert figures["true_s"] is figures["detected_s"] is None
    assert figures["raw_detectable"] is False
    assert time_of_largest_raw_force_after_contact(without) is None


def test_reversal_without_contact_has_the_largest_raw_force_after_contact(motion):
    assert time_of_largest_raw_force_after_contact(motion) == pytest.approx(0.62, abs=0.01)


def mutants_of_regressor():
    """Return copies of `regressor` that differ in one sign, for all terms of all entries of V."""
    source = inspect.getsource(regressor_into.py_func).split("\n", 1)[1]
    head, entries = source[: source.index("    V[:]")], source[source.index("    V[:]") :]
    mutants = {}
    # Each row assigns entries, comma-separated; a term is a product with an optional sign.
    for place, row in ((m.start(), m.group()) for m in re.finditer(r"V.* = (?!0\.0).*", entries)):
        names, terms = row.split(" = ")
        for term in re.finditer(r"(?:(?<=^)|(?<=, )|(?<= [+-] )|-)(?:[a-z]{2})", terms):
            flipped = term.group()[1:] if term.group()[0] == "-" else f"-{term.group()}"
            changed = terms[: term.start()] + flipped + terms[term.end() :]
            changed = changed.replace("+ -", "- ").replace("- -", "+ ")
            text = f"{head}{entries[:place]}{names} = {changed}{entries[place + len(row) :]}"
            space = {}
            exec(text, space)
            mutants[names, term.start()] = space["regressor_into"]
    return mutants


def per_sample(into):
    def mutated(s, omega, alpha):
        V = np.empty((len(s), 6, 10))
        for row, out in zip(zip(s, omega, alpha, strict=True), V, strict=True):
            into(*row, out)
        return V

    return mutated


def eliminate(mutated, wrench, offsets, s, omega, alpha, phi):
    return wrench - offsets - mutated(s, omega, alpha) @ phi


@pytest.fixture(scope="module")
def ideal_run(run, results):
    return results["simulate_ideal_motion"][0]


def ideal_rows(values):
    rows = compare_with_paper(defaultdict(lambda: 0.5, values_by_full_name({"ideal": values})))
    return [row.is_accepted for row in rows if row.quantity.startswith("All axes")]


def test_elimination_removes_the_reaction_force_of_the_plant(ideal_run):
    values = wrench_errors_of_ideal_run(ideal_run)
    assert 0 < values["residual_max_N"] < 1e-11
    assert 0 < values["residual_max_Nm"] < 1e-12
    assert ideal_rows(values) == [True, True]


def test_ideal_run_rejects_each_wrong_sign_of_the_regressor(ideal_run, monkeypatch):
    """Wrong signs in the regressor, and in the elimination's own function."""
    sparse = slice(None, None, 20)
    motion = tuple(part[sparse] for part in ideal_run.sensor_motion)
    run = dataclasses.replace(
        ideal_run, weld_reaction=ideal_run.weld_reaction[sparse], sensor_motion=motion
    )
    mutants = mutants_of_regressor()
    assert len(mutants) == 54
    for place, into in mutants.items():
        mutated = per_sample(into)
        with monkeypatch.context() as patch:
            patch.setattr(experiments, "regressor", mutated)
            assert False in ideal_rows(wrench_errors_of_ideal_run(run)), place
        with monkeypatch.context() as patch:
            patch.setattr(experiments, "contact_wrench", partial(eliminate, mutated))
            assert False in ideal_rows(wrench_errors_of_ideal_run(run)), place


def test_reproduce_exits_with_status_1_for_a_wrong_sign(
    run, results, tmp_path, monkeypatch, capsys
):
    """The sign is wrong in the evaluation of the same experiments."""
    for name in EXPERIMENTS:
        found = iter(results[name])
        monkeypatch.setattr(module_of(name), name, lambda *_, found=found: next(found))
    mutant = next(iter(mutants_of_regressor().values()))
    monkeypatch.setattr(experiments, "regressor", per_sample(mutant))
    with pytest.raises(SystemExit, match="1"):
        main(["reproduce", "--quiet", "--out", str(tmp_path)])
    assert capsys.readouterr().err.count("All axes") == 1


def test_wrong_mass_increases_the_residual():
    """A mass error of 10 % leaves 10 % of the force."""
    scenario = replace(
        LoadScenario("free_motion_force"), simulation__settle=0.7, simulation__duration=0.4
    )
    estimate = np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])
    estimate[6:] *= 1.1
    motion = simulate_motion(scenario, estimate, lambda done: None)
    assert tuple(motion.scaled_wrenches) == DISPLAYED_LOAD_SHARES
    figures = peaks_and_residuals_of_free_run(motion, 2, "N")
    assert figures["residual_max_N"] == pytest.approx(0.1 * figures["peak_raw_N"], rel=0.05)
    assert figures["half_ratio"] == pytest.approx(0.45, abs=0.01)
