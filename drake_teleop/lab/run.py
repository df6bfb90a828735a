"""`drake-teleop run SCENARIO`: run one scenario; write its log, picture and summary.

docs/running.md lists the summary's fields.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common import files, vectors
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, check_load_not_all_zero, contact_spans
from drake_teleop.common.progress import StartStage, UpdateProgress, show_progress
from drake_teleop.lab.identification import (
    identify_load,
    sensor_samples,
    simulate_with_real_time_factor,
    slave_arm,
)
from drake_teleop.lab.identified_load import IdentifiedLoad, identified_load
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.run_warnings import run_warnings
from drake_teleop.station.scenario import LoadScenario, Scenario, check_scenario, replace
from drake_teleop.station.scenario_reference import write_scenario
from drake_teleop.station.signals import MOVING_BODY_POSE_PREFIX
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.posture_shapes import start_overlap_texts
from drake_teleop.station.station import MakeTeleopStation
from drake_teleop.station.task_measures import task_failure, task_measures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SCENARIO_FILE_NAME = "scenario.yaml"
_RESULT_FILE_NAMES = (
    *("sensor_log.parquet", "identification.json", "overview.png", "replay.html", "session.json"),
)
FILTER_SETTLING_S = 0.01
"""Settling time of the sensor's filter after a contact [s]."""


@dataclass(frozen=True, eq=False)
class ScenarioRun:
    """Scenario and results of one run; `identification` is the identified load, or None."""

    scenario: Scenario
    result: SimulationResult
    identification: Identification | None
    load_source: str
    real_time_factor: float


class RecordedDrive(Protocol):
    """Recorded live session that can be simulated again."""

    @property
    def folder(self) -> Path: ...

    @property
    def scenario(self) -> Scenario:
        """Scenario of the session, with the session's duration."""

    @property
    def load(self) -> IdentifiedLoad | None:
        """Load identified before the session; None if it was estimated in the session."""

    def repeat(self, progress: UpdateProgress, log: Path | None = None) -> SimulationResult: ...


def run_command(
    scenario: str | Path | None,
    out: Path,
    *,
    drive: RecordedDrive | None = None,
    seed: int | None = None,
    fresh: bool = False,
    quiet: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Run a scenario, or repeat the recorded live session `drive`; replace the results in `out`.

    Return summary.json and session.json in one dictionary.
    """
    if drive is not None and (seed is not None or fresh):
        what = "a recorded drive contains its seed and load, which cannot be replaced"
        raise DrakeTeleopError(what, where="run --inputs", remedy="remove --seed and --fresh")
    files.refuse_to_replace_inputs(out / _SCENARIO_FILE_NAME, scenario or "")
    from drake_teleop.station.replay import write_replay  # needs Matplotlib

    setup = LoadScenario(scenario or "") if drive is None else drive.scenario
    if seed is not None:
        setup = replace(setup, simulation__seed=seed)
    with files.output_folder(out):
        with show_progress(progress and not quiet) as stage:
            run = _run_and_log_scenario_or_drive(setup, out, stage, fresh, drive)
            written = stage("Write pictures and 3D replay")
            files.write_picture(out / "overview.png", draw_overview(run.result))
            written(0.3)
            write_replay(out / "replay.html", run.result, run.scenario)
            written(1.0)
        summary = {"scenario": str(scenario if drive is None else drive.folder)} | summarise(run)
        session = {"load_source": run.load_source, "real_time_factor": run.real_time_factor}
        files.write_table(out / "sensor_log.parquet", run.result.sensor_log())
        if run.identification is not None:
            run.identification.save(out / "identification.json")
        files.write_json(out / "session.json", session)
        files.write_json(out / "summary.json", summary)
    if not quiet:
        _print_summary(summary | session, out)
    return summary | session


def _run_and_log_scenario_or_drive(
    setup: Scenario, out: Path, stage: StartStage, fresh: bool, drive: RecordedDrive | None
) -> ScenarioRun:
    log, scenario_file = out / "log.parquet", out / _SCENARIO_FILE_NAME
    # After an interruption, old files must not look like results of this run.
    files.remove_log(log)
    for name in _RESULT_FILE_NAMES:
        with files.wrap_write_errors(out / name):
            (out / name).unlink(missing_ok=True)
    had_scenario = scenario_file.exists()
    write_scenario(scenario_file, setup)
    try:
        if drive is not None:
            return _repeat_recorded_drive(drive, stage, log)
        return run_scenario(setup, stage, log, fresh=fresh)
    except BaseException as error:
        if log.is_dir() and not any(log.iterdir()):
            log.rmdir()
        if not log.exists() and not had_scenario:
            scenario_file.unlink(missing_ok=True)
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(_describe_unfinished_log(log)) from error
        if isinstance(error, files.CannotWrite):
            raise DrakeTeleopError(str(error), remedy=_describe_unfinished_log(log)) from error
        raise


def run_scenario(
    scenario: Scenario,
    progress: bool | StartStage = True,
    log: Path | None = None,
    *,
    fresh: bool = False,
) -> ScenarioRun:
    """Run a scenario; the load is estimated during the run, or else cached or identified before.

    Without operator motion and task, a run that estimates the load excites it by a trajectory.
    `progress`: True, or a `StartStage`; `log`: as in `simulate`; `fresh`: ignore the cached load.
    """
    check_scenario(scenario)
    estimates_load, source = scenario.load_estimator.enabled, "estimated during the run"
    if estimates_load and not scenario.operator.intent and scenario.operator.task is None:
        found = identify_load(scenario, progress, log=log)
        loaded = found.identification, source, found.real_time_factor
        return ScenarioRun(scenario, found.result, *loaded)
    identification, estimate, floor = None, None, None
    with show_progress(progress) as stage:
        if not estimates_load:
            load = identified_load(scenario, stage, fresh=fresh)
            identification, estimate, floor = load.identification, load.estimate, load.noise_floor
            source = "cache" if load.from_cache else "identified before the run"
        station = MakeTeleopStation(scenario, load_estimate=estimate, noise_floor=floor)
        started = stage("Run the scenario")
        result, factor = simulate_with_real_time_factor(station, scenario.simulation, started, log)
    return ScenarioRun(scenario, result, identification, source, factor)


def _repeat_recorded_drive(drive: RecordedDrive, progress: StartStage, log: Path) -> ScenarioRun:
    start = time.perf_counter()
    result = drive.repeat(progress("Repeat the drive"), log)
    factor = drive.scenario.simulation.duration / (time.perf_counter() - start)
    identification = None if drive.load is None else drive.load.identification
    return ScenarioRun(drive.scenario, result, identification, "from the recorded drive", factor)


def _describe_unfinished_log(log: Path) -> str:
    if not log.exists():
        return ""
    return f"{log} contains the first {len(SimulationResult.scan_parquet(log).t)} samples"


def _print_summary(summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for name, value in summary.items():
        if isinstance(value, (int, float)):
            table.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value))
    console = Console()
    console.print(summary["description"] or summary["scenario"], style="bold", markup=False)
    console.print(table)
    hint = "; --fresh repeats the identification" if summary["load_source"] == "cache" else ""
    console.print(f"load: {summary['load_source']}{hint}", highlight=False)
    for k, (start, stop) in enumerate(summary["true_contact_s"]):
        noticed = ""
        if "contact_noticed_ms" in summary:
            slave, hand = (summary[f"contact_{at}_ms"][k] for at in ("noticed", "at_hand"))
            noticed = f", noticed after {_format_ms(slave)}, at the hand after {_format_ms(hand)}"
        console.print(f"contact from {start:.4f} to {stop:.4f} s{noticed}", highlight=False)
    if "contact_by" in summary:
        console.print(f"contact by {summary['contact_by']}", highlight=False)
    for name, displacement in summary.get("moved_mm", {}).items():
        motion = f"{displacement:.1f} mm and rotated by {summary['turned_deg'][name]:.1f} degrees"
        console.print(f"{name} was moved by {motion}", highlight=False)
    if summary.get("failure"):
        console.print(f"[bold red]the task failed:[/] {summary['failure']}", highlight=False)
    for assumption in summary.get("assumed", ()):
        console.print(f"assumed: {assumption}", highlight=False, markup=False)
    for warning in summary["warnings"]:
        console.print(f"[bold yellow]warning:[/] {warning}", highlight=False)
    replay = out / "replay.html"
    console.print(f"written to {out}; 3D replay: {replay}", highlight=False, markup=False)


def _format_ms(delay_ms: float | None) -> str:
    return "never" if delay_ms is None else f"{delay_ms:.1f} ms"


def is_in_contact(result: SimulationResult) -> NDArray[np.bool_]:
    """Return flags (N,) of true contact; gaps shorter than `FILTER_SETTLING_S` count as contact."""
    if "true_contact_wrench_W" not in result:
        return np.zeros(len(result.t), dtype=bool)
    touch = np.any(result["true_contact_wrench_W"] != 0, axis=1)
    return _since_contact_s(touch, result.t) + _until_contact_s(touch, result.t) < FILTER_SETTLING_S


def summarise(run: ScenarioRun) -> dict[str, Any]:
    """Return the content of summary.json without the scenario's name."""
    result, arm = run.result, slave_arm(run.scenario)
    estimate = result["load_estimate"][-1]
    check_load_not_all_zero("load_estimate", estimate[6:])
    wrench, s, omega, alpha = sensor_samples(result)
    measured = wrench - estimate[:6]
    calculated = contact_wrench(wrench, estimate[:6], s, omega, alpha, estimate[6:])
    contact = is_in_contact(result)
    # The first bounce of a contact may be between two samples.
    free = _since_contact_s(contact, result.t) > FILTER_SETTLING_S
    free &= _until_contact_s(contact, result.t) > FILTER_SETTLING_S
    mass, com = _mass_and_com(estimate[6:])
    true_mass, true_com = _mass_and_com(arm.phi_load)
    n = arm.num_joints
    summary: dict[str, Any] = {
        "description": run.scenario.description,
        "seed": run.scenario.simulation.seed,
        "duration_s": round(float(result.t[-1]), 6),
        "samples": len(result.t),
        **_peak_force_torque_by_name("peak_measured", "", measured),
        **_peak_force_torque_by_name("peak_contact", "", calculated),
        **_peak_force_torque_by_name("residual", "_max", calculated[free]),
        "true_contact_s": [list(span) for span in contact_spans(result.t, contact)],
        "joint_speed_use": _max_ratio_to_limit(result["slave_state"][:, n:], arm.velocity_limit),
        "joint_torque_use": _max_ratio_to_limit(result["joint_torque"], arm.effort_limit),
        "mass_error_percent": 100 * abs(mass / true_mass - 1),
        "com_error_mm": 1e3 * float(np.linalg.norm(com - true_com)),
    }
    if "force_to_master" in result:
        summary |= _peak_force_torque_by_name("peak", "_to_master", result["force_to_master"])
    if "contact" in result:
        summary |= _detection_delays(result, contact_spans(result.t, contact))
    slave, surroundings = run.scenario.slave, run.scenario.surroundings
    if surroundings is not None:
        contact_model = AddSlavePlant(DiagramBuilder(), slave, surroundings).contact
        if reason := contact_model.drake_contact_reason:
            summary["contact_by"] = f"Drake's contact results (slower): {reason}"
    summary |= _moving_body_displacements(result)
    if run.scenario.operator.task is not None:
        figures = task_measures(result, run.scenario)
        summary |= {name: None if np.isnan(x) else x for name, x in figures.items()}
        summary["failure"] = task_failure(result, run.scenario) or None
    _, assumed = start_overlap_texts(slave, surroundings)
    if assumed:
        summary["assumed"] = list(assumed)
    return summary | {"warnings": run_warnings(result, run.scenario, arm)}


def draw_overview(result: SimulationResult) -> Figure:
    signals = ("measured_wrench_S", "contact_wrench_S", "pose_command", "force_to_master")
    if "contact_wrench_S" not in result:
        signals = ("measured_wrench_S", "specific_force_S", "angular_velocity_S", "load_estimate")
    figure = result.plot(*signals, contact=is_in_contact(result))
    figure.align_ylabels()
    return figure


def _detection_delays(result: SimulationResult, spans: list[tuple[float, float]]) -> dict[str, Any]:
    t, summary = result.t, {}
    starts = [start for start, _ in spans]
    for name, key in (("contact", "contact_noticed_ms"), ("contact_at_hand", "contact_at_hand_ms")):
        flagged, delays = t[result[name][:, 0] > 0], list[float | None]()
        for start, end in itertools.pairwise([*starts, np.inf]):
            times = flagged[(flagged >= start) & (flagged < end)]
            delays.append(1e3 * float(times[0] - start) if len(times) else None)
        summary[key] = delays
    onsets = t[1:][np.diff(result["contact"][:, 0]) > 0]
    false = [x for x in onsets if not any(a <= x <= b + FILTER_SETTLING_S for a, b in spans)]
    return summary | {"false_contacts": len(false)}


def _moving_body_displacements(result: SimulationResult) -> dict[str, dict[str, float]]:
    displacements, rotations = {}, {}
    for signal in (name for name in result.signals if name.startswith(MOVING_BODY_POSE_PREFIX)):
        name, first, last = signal.removeprefix(MOVING_BODY_POSE_PREFIX), *result[signal][[0, -1]]
        displacements[name] = 1e3 * float(np.linalg.norm(last[4:] - first[4:]))
        rotation = vectors.quaternion_product(
            tuple(last[:4]), vectors.conjugate_quaternion(tuple(first[:4]))
        )
        angle = np.linalg.norm(vectors.quaternion_logarithm(rotation))
        rotations[name] = float(np.degrees(angle))
    return {"moved_mm": displacements, "turned_deg": rotations} if displacements else {}


def _peak_force_torque_by_name(prefix: str, suffix: str, wrench: Array) -> dict[str, float | None]:
    names = (f"{prefix}_force{suffix}_N", f"{prefix}_torque{suffix}_Nm")
    if not len(wrench):
        return dict.fromkeys(names)
    norms = (np.linalg.norm(part, axis=1).max() for part in (wrench[:, :3], wrench[:, 3:]))
    return {name: float(norm) for name, norm in zip(names, norms, strict=True)}


def _since_contact_s(contact: NDArray[np.bool_], t: Array) -> Array:
    last = np.maximum.accumulate(np.where(contact, np.arange(len(t)), -1))
    return np.where(last < 0, np.inf, t - t[last])


def _until_contact_s(contact: NDArray[np.bool_], t: Array) -> Array:
    return _since_contact_s(contact[::-1], -t[::-1])[::-1]


def _mass_and_com(phi: Array) -> tuple[float, Array]:
    return float(phi[0]), phi[1:4] / phi[0]


def _max_ratio_to_limit(values: Array, limit: Array) -> float:
    return float(np.max(np.abs(values) / limit))
