"""`drake-teleop run SCENARIO`: run one scenario; write its log, picture and summary."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Protocol

from drake_teleop.common import files
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.progress import StartStage, UpdateProgress, show_progress
from drake_teleop.lab.identification import identify_load, simulate_with_real_time_factor
from drake_teleop.lab.identified_load import IdentifiedLoad, identified_load
from drake_teleop.lab.run_summary import ScenarioRun, draw_overview, summarise
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, check_scenario, replace
from drake_teleop.station.scenario_reference import write_scenario
from drake_teleop.station.station import MakeTeleopStation

_SCENARIO_FILE_NAME = "scenario.yaml"
_RESULT_FILE_NAMES = (
    *("sensor_log.parquet", "identification.json", "overview.png", "replay.html", "session.json"),
)


class RecordedDrive(Protocol):
    """Recorded live session that can be simulated again."""

    @property
    def folder(self) -> Path:
        """Folder of the recording."""

    @property
    def scenario(self) -> Scenario:
        """Scenario of the session, with the session's duration."""

    @property
    def load(self) -> IdentifiedLoad | None:
        """Load identified before the session; None if estimated during it."""

    def repeat(self, progress: UpdateProgress, log: Path | None = None) -> SimulationResult:
        """Simulate the recorded session again."""


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
    """Run one scenario or `drive`; write all results into `out` and delete those of an earlier run.

    Return the content of summary.json and session.json. The message of a KeyboardInterrupt
    contains the number of recorded samples.
    """
    if drive is not None and (seed is not None or fresh):
        what = "a recorded drive contains its seed and load, which cannot be replaced"
        raise DrakeTeleopError(what, where="run --inputs", remedy="remove --seed and --fresh")
    files.refuse_to_replace_inputs(out / _SCENARIO_FILE_NAME, scenario)
    from drake_teleop.station.replay import write_replay  # needs Matplotlib

    setup = LoadScenario(scenario or "") if drive is None else drive.scenario
    if seed is not None:
        setup = replace(setup, simulation__seed=seed)
    with files.output_folder(out):
        with show_progress(progress and not quiet) as stage:
            run = _run_into_folder(setup, out, stage, fresh, drive)
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


def _run_into_folder(
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
            return _repeat_drive(drive, stage, log)
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
    """Run a scenario; estimate the load during the run, or use the cached or newly identified load.

    An estimation without intended motion or task uses an excitation trajectory.

    Args:
        progress: True shows progress bars; or a `StartStage` that receives the progress.
        log: folder of the log, see `simulate`.
        fresh: True ignores the cached load.
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


def _repeat_drive(drive: RecordedDrive, progress: StartStage, log: Path) -> ScenarioRun:
    start = time.perf_counter()
    result = drive.repeat(progress("Repeat the drive"), log)
    factor = drive.scenario.simulation.duration / (time.perf_counter() - start)
    identification = None if drive.load is None else drive.load.identification
    return ScenarioRun(drive.scenario, result, identification, "from the recorded drive", factor)


def _describe_unfinished_log(log: Path) -> str:
    if not log.exists():
        return ""
    return f"{log} contains the {len(SimulationResult.scan_parquet(log).t)} samples until then"


def _print_summary(summary: dict[str, Any], out: Path) -> None:
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


def _format_ms(delay: float | None) -> str:
    return "never" if delay is None else f"{delay:.1f} ms"
