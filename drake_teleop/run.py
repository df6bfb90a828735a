"""`drake-teleop run SCENARIO`: one scenario, its log, its picture and its figures.

What the station knows about its load, by one rule:

- A scenario whose load estimator is enabled starts from nothing and learns while it runs. If its
  operator wants nothing either (the shipped "identification"), the slave alone runs an excitation
  trajectory as long as the scenario.
- Every other scenario does what an honest user would: it first identifies the load with that
  trajectory and its own sensor, from the sensor's samples alone; or it takes what was found when
  that was done before, see `drake_teleop.identified_load`.

`summary.json` holds, beside what was run:

=========================== =====================================================================
peak_measured_force_N       largest measured |f|, offsets removed; likewise peak_measured_torque_Nm;
                            this and the next two with the load estimate of the end
peak_contact_force_N        largest calculated contact force; likewise peak_contact_torque_Nm
residual_force_max_N        largest contact force calculated while there was no contact; null if
                            there was contact throughout; likewise residual_torque_max_Nm
true_contact_s              [start, end] of each contact
contact_noticed_ms          with contact_detection: how long after the beginning of each contact the
                            detector noticed it, null if it did not; likewise contact_at_hand_ms
false_contacts              how often the detector began to notice a contact that there was not
success, task_time_s, ...   with a task, see `drake_teleop.task_measures`; null for
                            what did not happen
failure                     with a task: why it failed, in words; null if it did not
peak_force_to_master_N      largest force that the device displayed
joint_speed_use             largest share of a joint's speed limit; likewise joint_torque_use
mass_error_percent          of the estimate at the end; likewise com_error_mm
assumed                     what the models of arm and tool do not say, if anything
contact_by                  if Drake's contact results are used, which takes longer: why
moved_mm                    with bodies that move: how far each is at the end from where it was;
                            likewise turned_deg
warnings                    what was not as it should be, and when, see `drake_teleop.run_warnings`
=========================== =====================================================================

The same scenario gives the same bytes in every file but `session.json`, which holds

=========================== =====================================================================
load_source                 which load was used: "learnt while it ran", "identified before the run",
                            "cache", identified before an earlier run, or "of the drive"
real_time_factor            simulated over elapsed time, this machine, compilation included
=========================== =====================================================================
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.identification import (
    identify_load,
    sensor_samples,
    slave_arm,
    timed,
)
from drake_teleop.identified_load import identified_load
from drake_teleop.live.session import Drive, read_drive, repeat
from drake_teleop.load.arrays import learnt
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.pages.progress import Stage, show_progress
from drake_teleop.pages.style import contact_spans
from drake_teleop.quaternions import conjugate, logarithm, multiply
from drake_teleop.replay import write_replay
from drake_teleop.result import SimulationResult, remove_log
from drake_teleop.run_warnings import run_warnings
from drake_teleop.scenario import LoadScenario, Scenario, check_scenario, replace
from drake_teleop.scenario_reference import write_scenario
from drake_teleop.signals import POSE_OF
from drake_teleop.slave.plant import AddSlavePlant, NominalSlave
from drake_teleop.station import MakeTeleopStation
from drake_teleop.task_measures import task_failure, task_measures
from drake_teleop.writing import (
    CannotWrite,
    naming,
    output_folder,
    write_json,
    write_picture,
    write_table,
)

Array = NDArray[np.float64]

# After a contact has ended the sensor's filter still shows it for this long [s].
FILTER_TAIL = 0.01
_LEARNT = "learnt while it ran"
_WRITTEN_AT_THE_END = (
    "sensor_log.parquet",
    "identification.json",
    "overview.png",
    "replay.html",
    "session.json",
)


@dataclass(frozen=True, eq=False)
class ScenarioRun:
    """A scenario that was run.

    Attributes:
        scenario: with the seed that was used.
        result: the recorded signals.
        identification: what was found beforehand; None if the scenario learnt while it ran.
        load_source: as in session.json.
        real_time_factor: simulated over elapsed time.
    """

    scenario: Scenario
    result: SimulationResult
    identification: Identification | None
    load_source: str
    real_time_factor: float


def run_command(
    scenario: str | Path | None,
    out: Path,
    *,
    inputs: Path | None = None,
    seed: int | None = None,
    fresh: bool = False,
    quiet: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Runs one scenario.

    Writes log.parquet, sensor_log.parquet (canonical, for `drake-teleop identify`), overview.png,
    replay.html (the film in 3D), scenario.yaml (all fields, as they were run), identification.json
    (unless the scenario learnt while it ran), session.json and summary.json into `out`. The log is
    a folder, written while the station runs; all but the scenario follow at the end, the summary
    last. What an earlier run left there is removed first; a run that fails before it begins leaves
    nothing.

    Args:
        scenario: the name of a shipped one, or a YAML file.
        out: the folder.
        inputs: instead of the scenario, the folder of a recorded drive, which is repeated.
        seed: instead of the scenario's.
        fresh: whether to identify the load anew although it was kept.
        quiet: no progress bars and no table.
        progress: False for no progress bars alone.

    Returns:
        The summary, and what is in session.json.

    Raises:
        DrakeTeleopError: if the scenario cannot be used, a joint leaves its range, or a file cannot
            be written; then saying what was.
        KeyboardInterrupt: saying what was recorded until then.
    """
    drive = None if inputs is None else read_drive(inputs)
    if drive is not None and (seed is not None or fresh):
        raise DrakeTeleopError("a drive has its own seed and load", where="run --inputs")
    if inputs is not None and out.resolve() == inputs.resolve():
        raise DrakeTeleopError("is the drive itself", where=str(out), remedy="give another --out")
    setup = LoadScenario(scenario or "") if drive is None else drive.scenario
    if seed is not None:
        setup = replace(setup, simulation__seed=seed)
    with output_folder(out):
        with show_progress(progress and not quiet) as stage:
            run = _logged(setup, out, stage, fresh, drive)
            written = stage("Write pictures and film")
            write_picture(out / "overview.png", overview(run.result))
            written(0.3)
            write_replay(out / "replay.html", run.result, run.scenario)
            written(1.0)
        summary = {"scenario": str(scenario or inputs)} | summarise(run)
        session = {"load_source": run.load_source, "real_time_factor": run.real_time_factor}
        write_table(out / "sensor_log.parquet", run.result.sensor_log())
        if run.identification is not None:
            run.identification.save(out / "identification.json")
        write_json(out / "session.json", session)
        write_json(out / "summary.json", summary)
    if not quiet:
        _print(summary | session, out)
    return summary | session


def _logged(
    setup: Scenario, out: Path, stage: Stage, fresh: bool, drive: Drive | None
) -> ScenarioRun:
    """Runs it with its log and its scenario in a folder, without what an earlier run left there."""
    log, its_scenario = out / "log.parquet", out / "scenario.yaml"
    # It must not be taken for what belongs to this run, should this one be interrupted.
    remove_log(log)
    for name in _WRITTEN_AT_THE_END:
        with naming(out / name):
            (out / name).unlink(missing_ok=True)
    earlier = its_scenario.exists()
    write_scenario(its_scenario, setup)
    try:
        if drive is not None:
            return _repeated(drive, stage, log)
        return run_scenario(setup, stage, log, fresh=fresh)
    except BaseException as error:
        if log.is_dir() and not any(log.iterdir()):
            log.rmdir()
        if not log.exists() and not earlier:
            its_scenario.unlink(missing_ok=True)
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(_kept(log)) from error
        if isinstance(error, CannotWrite):
            raise DrakeTeleopError(str(error), remedy=_kept(log)) from error
        raise


def run_scenario(
    scenario: Scenario,
    progress: bool | Stage = True,
    log: Path | None = None,
    *,
    fresh: bool = False,
) -> ScenarioRun:
    """Runs a scenario by the rule at the top of this module.

    Args:
        scenario: what to run.
        progress: whether bars are shown, or where: see `pages/progress.py`.
        log: as `simulate` has it.
        fresh: as for `identified_load`.

    Raises:
        DrakeTeleopError: if the scenario cannot be used or a joint leaves its range.
    """
    check_scenario(scenario)
    learns = scenario.load_estimator.enabled
    if learns and not scenario.operator.intent and scenario.operator.task is None:
        found = identify_load(scenario, progress, log=log)
        return ScenarioRun(
            scenario, found.result, found.identification, _LEARNT, found.real_time_factor
        )
    identification, estimate, floor, source = None, None, None, _LEARNT
    with show_progress(progress) as stage:
        if not learns:
            load = identified_load(scenario, stage, fresh=fresh)
            identification, estimate, floor = load.identification, load.estimate, load.noise_floor
            source = "cache" if load.from_cache else "identified before the run"
        station = MakeTeleopStation(scenario, load_estimate=estimate, noise_floor=floor)
        result, factor = timed(station, scenario.simulation, stage("Run the scenario"), log)
    return ScenarioRun(scenario, result, identification, source, factor)


def _repeated(drive: Drive, progress: Stage, log: Path) -> ScenarioRun:
    begin = time.perf_counter()
    result = repeat(drive, progress("Repeat the drive"), log)
    factor = drive.scenario.simulation.duration / (time.perf_counter() - begin)
    identification = None if drive.load is None else drive.load.identification
    return ScenarioRun(drive.scenario, result, identification, "of the drive", factor)


def in_contact(result: SimulationResult) -> NDArray[np.bool_]:
    """(N,) whether the tool touches something, from the simulation's truth.

    A touch with its bounces is one contact: gaps shorter than FILTER_TAIL are closed.
    """
    if "true_contact_wrench_W" not in result:
        return np.zeros(len(result.t), dtype=bool)
    touching = np.any(result["true_contact_wrench_W"] != 0, axis=1)
    return _time_since(touching, result.t) + _time_until(touching, result.t) < FILTER_TAIL


def calculated_contact_wrench(result: SimulationResult) -> Array:
    """(N, 6) Eq. (13) from the recorded samples and the load estimate of the end.

    Raises:
        DrakeTeleopError: if that load was never learnt.
    """
    estimate = result["load_estimate"][-1]
    learnt("load_estimate", estimate[6:])
    wrench, s, omega, alpha = sensor_samples(result)
    return contact_wrench(wrench, estimate[:6], s, omega, alpha, estimate[6:])


def summarise(run: ScenarioRun) -> dict[str, Any]:
    """The figures of summary.json (see the top of this module)."""
    result, arm = run.result, slave_arm(run.scenario)
    estimate = result["load_estimate"][-1]
    measured = result["measured_wrench_S"] - estimate[:6]
    calculated = calculated_contact_wrench(result)
    contact = in_contact(result)
    # Of the bounces that a touch begins with, the first may have been between two samples.
    free = _time_since(contact, result.t) > FILTER_TAIL
    free &= _time_until(contact, result.t) > FILTER_TAIL
    mass, com = _mass_and_com(estimate[6:])
    true_mass, true_com = _mass_and_com(arm.phi_load)
    n = arm.num_joints
    summary: dict[str, Any] = {
        "description": run.scenario.description,
        "seed": run.scenario.simulation.seed,
        "duration_s": round(float(result.t[-1]), 6),
        "samples": len(result.t),
        **_peaks("peak_measured", "", measured),
        **_peaks("peak_contact", "", calculated),
        **_peaks("residual", "_max", calculated[free]),
        "true_contact_s": [list(span) for span in contact_spans(result.t, contact)],
        "joint_speed_use": _use(result["slave_state"][:, n:], arm.velocity_limit),
        "joint_torque_use": _use(result["joint_torque"], arm.effort_limit),
        "mass_error_percent": 100 * abs(mass / true_mass - 1),
        "com_error_mm": 1e3 * float(np.linalg.norm(com - true_com)),
    }
    if "force_to_master" in result:
        summary |= _peaks("peak", "_to_master", result["force_to_master"])
    if "contact" in result:
        summary |= _detection_figures(result, contact_spans(result.t, contact))
    if beyond := _beyond(run.scenario):
        summary["contact_by"] = f"Drake's contact results (slower): {beyond}"
    summary |= _moved(result)
    if run.scenario.operator.task is not None:
        figures = task_measures(result, run.scenario)
        summary |= {name: None if np.isnan(x) else x for name, x in figures.items()}
        summary["failure"] = task_failure(result, run.scenario) or None
    assumed = NominalSlave(run.scenario.slave).assumptions
    if assumed:
        summary["assumed"] = list(assumed)
    return summary | {"warnings": run_warnings(result, run.scenario, arm)}


def overview(result: SimulationResult) -> Figure:
    """The picture of a run: the wrenches, the motion, what the hand feels; contact shaded."""
    wanted = ("measured_wrench_S", "contact_wrench_S", "pose_command", "force_to_master")
    if "contact_wrench_S" not in result:
        wanted = ("measured_wrench_S", "specific_force_S", "angular_velocity_S", "load_estimate")
    figure = result.plot(*wanted, contact=in_contact(result))
    figure.align_ylabels()
    return figure


def _detection_figures(
    result: SimulationResult, spans: list[tuple[float, float]]
) -> dict[str, Any]:
    """When each contact was noticed, at the slave and by the hand, and what was none."""
    t, summary = result.t, {}
    for name, key in (("contact", "contact_noticed_ms"), ("contact_at_hand", "contact_at_hand_ms")):
        flagged = t[result[name][:, 0] > 0]
        ends = [*(start for start, _ in spans[1:]), np.inf][: len(spans)]
        found = [
            flagged[(flagged >= start) & (flagged < end)]
            for (start, _), end in zip(spans, ends, strict=True)
        ]
        summary[key] = [
            1e3 * float(times[0] - start) if len(times) else None
            for times, (start, _) in zip(found, spans, strict=True)
        ]
    onsets = t[1:][np.diff(result["contact"][:, 0]) > 0]
    false = [x for x in onsets if not any(a <= x <= b + FILTER_TAIL for a, b in spans)]
    return summary | {"false_contacts": len(false)}


def _beyond(scenario: Scenario) -> str:
    """What of the surroundings the compiled contact law does not know, see `Contact`."""
    surroundings = scenario.surroundings
    if surroundings is None:
        return ""
    builder = DiagramBuilder()
    return AddSlavePlant(builder, scenario.slave, surroundings).contact.beyond


def _moved(result: SimulationResult) -> dict[str, dict[str, float]]:
    """How far each body of the surroundings has moved and turned since t = 0."""
    moved, turned = {}, {}
    for signal in (name for name in result.signals if name.startswith(POSE_OF)):
        name, first, last = signal.removeprefix(POSE_OF), *result[signal][[0, -1]]
        moved[name] = 1e3 * float(np.linalg.norm(last[4:] - first[4:]))
        turn = logarithm(multiply(tuple(last[:4]), conjugate(tuple(first[:4]))))
        turned[name] = float(np.degrees(np.linalg.norm(turn)))
    return {"moved_mm": moved, "turned_deg": turned} if moved else {}


def _peaks(prefix: str, suffix: str, wrench: Array) -> dict[str, float | None]:
    names = (f"{prefix}_force{suffix}_N", f"{prefix}_torque{suffix}_Nm")
    if not len(wrench):
        return dict.fromkeys(names)
    norms = (np.linalg.norm(part, axis=1).max() for part in (wrench[:, :3], wrench[:, 3:]))
    return {name: float(norm) for name, norm in zip(names, norms, strict=True)}


def _time_since(contact: NDArray[np.bool_], t: Array) -> Array:
    """(N,) time since the last sample in contact; 0 in contact, inf before the first."""
    last = np.maximum.accumulate(np.where(contact, np.arange(len(t)), -1))
    return np.where(last < 0, np.inf, t - t[last])


def _time_until(contact: NDArray[np.bool_], t: Array) -> Array:
    """(N,) time until the next sample in contact; 0 in contact, inf after the last."""
    return _time_since(contact[::-1], -t[::-1])[::-1]


def _kept(log: Path) -> str:
    if not log.exists():
        return ""
    return f"{log} has the {len(SimulationResult.scan_parquet(log).t)} samples until then"


def _mass_and_com(phi: Array) -> tuple[float, Array]:
    return float(phi[0]), phi[1:4] / phi[0]


def _use(values: Array, limit: Array) -> float:
    return float(np.max(np.abs(values) / limit))


def _print(summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for name, value in summary.items():
        if isinstance(value, (int, float)):
            table.add_row(name, f"{value:.4g}")
    console = Console()
    console.print(summary["description"] or summary["scenario"], style="bold", markup=False)
    console.print(table)
    hint = "; --fresh identifies it anew" if summary["load_source"] == "cache" else ""
    console.print(f"load: {summary['load_source']}{hint}", highlight=False)
    for k, (start, stop) in enumerate(summary["true_contact_s"]):
        noticed = ""
        if "contact_noticed_ms" in summary:
            slave, hand = (summary[f"contact_{at}_ms"][k] for at in ("noticed", "at_hand"))
            noticed = f", noticed after {_ms(slave)}, at the hand after {_ms(hand)}"
        console.print(f"contact from {start:.4f} to {stop:.4f} s{noticed}", highlight=False)
    if "contact_by" in summary:
        console.print(f"contact by {summary['contact_by']}", highlight=False)
    for name, way in summary.get("moved_mm", {}).items():
        turn = f"{way:.1f} mm and turned by {summary['turned_deg'][name]:.1f} degrees"
        console.print(f"{name} was moved by {turn}", highlight=False)
    if summary.get("failure"):
        console.print(f"[bold red]the task failed:[/] {summary['failure']}", highlight=False)
    for words in summary.get("assumed", ()):
        console.print(f"assumed: {words}", highlight=False, markup=False)
    for warning in summary["warnings"]:
        console.print(f"[bold yellow]warning:[/] {warning}", highlight=False)
    console.print(
        f"written to {out}; its film: {out / 'replay.html'}", highlight=False, markup=False
    )


def _ms(delay: float | None) -> str:
    return "never" if delay is None else f"{delay:.1f} ms"
