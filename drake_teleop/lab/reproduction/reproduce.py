"""`drake-teleop reproduce`: the paper's experiments, Figs. 6 to 8."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common import files
from drake_teleop.common.progress import UpdateProgress, show_progress
from drake_teleop.lab.identification import (
    LoadIdentification,
    identification_scenario,
    identify_load,
    true_load,
)
from drake_teleop.lab.reproduction import experiments, report
from drake_teleop.station.replay import write_replay
from drake_teleop.station.scenario import LoadScenario, Scenario, Simulation, replace
from drake_teleop.station.scenario_reference import write_scenario
from drake_teleop.station.simulation import MakeSimulator, advance_without_garbage_collection
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.station import MakeTeleopStation

_NUM_TIMINGS, _SIMULATED_TIME_PER_TIMING_S = 11, 0.1  # simulated time of one measurement [s]


def reproduce_command(
    out: Path, *, seed: int | None = None, quiet: bool = False, progress: bool = True
) -> experiments.NamedValues:
    """Repeat the paper's experiments; write figures, logs and a report into a folder.

    Return the summary and "speed", the measured simulation speed, in one dictionary.
    """
    seed = seed or 0
    files.make_folder(out)  # fail early for a bad path
    with show_progress(progress and not quiet) as stage:
        names = ("free_motion_force", "free_motion_torque", "contact_transition")
        # Each run has another seed.
        force, torque, contact = (
            replace(each, rates__log_hz=each.rates.hand_hz, simulation__seed=seed + k)
            for k, each in enumerate(map(LoadScenario, names), 1)
        )
        load = identify_load(identification_scenario(force, seed), stage)
        estimate = load.estimate
        simulate = experiments.simulate_motion
        force_run = simulate(force, estimate, stage("Fig. 6: vertical free motion"))
        torque_run = simulate(torque, estimate, stage("Fig. 7: horizontal free motion"))
        about_all_axes = stage("Rotation about all axes, ideal sensor")
        ideal_run = experiments.simulate_ideal_motion(about_all_axes)
        contact_run = experiments.simulate_contact(contact, estimate, stage)
        measure_free_run = experiments.peaks_and_residuals_of_free_run
        summary = {
            "free_force": measure_free_run(force_run, report.FORCE_Z_INDEX, "N"),
            "free_torque": measure_free_run(torque_run, report.TORQUE_X_INDEX, "Nm"),
            "ideal": experiments.wrench_errors_of_ideal_run(ideal_run),
            "contact": experiments.detection_and_peaks_of_contact_run(contact_run),
            "identification": experiments.errors_of_identification(load, force),
        }
        session = {"speed": _measure_simulation_speed(stage("Measure the speed"))}
        detected_s = summary["contact"]["detected_s"]
        pictures = {
            "fig6": report.scaling_figure(force_run, report.FORCE_Z_INDEX, "$f_z$", "N"),
            "fig7": report.scaling_figure(torque_run, report.TORQUE_X_INDEX, r"$\tau_x$", "N m"),
            "fig8": report.contact_figure(contact_run, detected_s),
        }
        runs = dict(zip(names, (force_run, torque_run, contact_run.touched), strict=True))
        runs["contact_transition_without_sheet"] = contact_run.free
        written = stage("Write figures, replay and report")
        with files.output_folder(out):
            _write_results(out, seed, summary, load, runs, pictures)
            files.write_json(out / "session.json", session)
            files.write_json(out / "summary.json", summary)
        written(1.0)
    if not quiet:
        _print_comparison(report.compare_with_paper(report.values_by_full_name(summary)), out)
    return summary | session


def _measure_simulation_speed(progress: UpdateProgress) -> experiments.NamedValues:
    scenario = LoadScenario("free_motion_force")
    simulators = {"bare": MakeBarePlantSimulator(scenario)}
    simulators["station"] = MakeSettledStationSimulator(scenario)
    cost = cpu_time_per_simulated_second(simulators, progress=progress)
    return {
        "real_time_factor": 1 / cost["station"],
        "cost_over_bare_plant": cost["station"] / cost["bare"],
    }


def MakeBarePlantSimulator(scenario: Scenario, *, touching: bool = False) -> Simulator:
    """Return a simulator of the arm held by constant torques; `touching` adds the environment."""
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, scenario.slave, scenario.surroundings if touching else None)
    step = 1 / scenario.rates.sensor_hz
    simulation = Simulation(integrator="runge_kutta2", max_step=step)
    simulator = MakeSimulator(builder.Build(), simulation)
    context = slave.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    gravity = slave.plant.CalcGravityGeneralizedForces(context)
    torque = -slave.plant.GetVelocitiesFromArray(slave.instance, gravity)
    slave.plant.get_actuation_input_port(slave.instance).FixValue(context, list(torque))
    simulator.Initialize()
    return simulator


def MakeSettledStationSimulator(scenario: Scenario) -> Simulator:
    # The value of the estimate does not change the cost.
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    simulator = MakeSimulator(station, scenario.simulation)
    simulator.Initialize()
    advance_without_garbage_collection(simulator, scenario.simulation.settle)
    return simulator


def cpu_time_per_simulated_second(
    simulators: Mapping[str, Simulator], *, progress: UpdateProgress = lambda done: None
) -> dict[str, float]:
    """Return the CPU time [s] per simulated second of each simulator, the least of several."""
    times_s: dict[str, list[float]] = {name: [] for name in simulators}
    for k in range(_NUM_TIMINGS):
        for name, simulator in simulators.items():
            start = time.thread_time()
            end = simulator.get_context().get_time() + _SIMULATED_TIME_PER_TIMING_S
            advance_without_garbage_collection(simulator, end)
            times_s[name].append((time.thread_time() - start) / _SIMULATED_TIME_PER_TIMING_S)
        progress((k + 1) / _NUM_TIMINGS)
    return {name: min(times) for name, times in times_s.items()}


def _write_results(
    out: Path,
    seed: int,
    summary: experiments.NamedValues,
    load: LoadIdentification,
    runs: dict[str, experiments.MotionRun],
    pictures: dict[str, Figure],
) -> None:
    scenario, contact = runs["free_motion_force"].scenario, runs["contact_transition"]
    logs = {"identification": (load.result, identification_scenario(scenario, seed))}
    logs |= {name: (run.result, run.scenario) for name, run in runs.items()}
    files.make_folder(out / "logs")
    for name, (result, of_log) in logs.items():
        result.write_parquet(out / "logs" / f"{name}.parquet")
        write_scenario(out / "logs" / f"{name}.yaml", of_log)
    files.write_table(out / "logs" / "identification_sensor_log.parquet", load.result.sensor_log())
    load.identification.save(out / "identification.json")
    # The contact lasts 40 ms.
    write_replay(out / "replay.html", contact.result, contact.scenario, slow_motion=8.0)
    figures = report.values_by_full_name(summary)
    files.write_text(out / "table.md", _markdown_table(report.compare_with_paper(figures)))
    true = experiments.true_offsets_and_phi(scenario)
    rows = report.parameter_rows(true, load.estimate, load.batch.standard_deviations)
    setup = _describe_setup(seed, scenario, load)
    report.write_report(out, pictures, setup=setup, summary=figures, parameters=rows)


def _describe_setup(seed: int, scenario: Scenario, load: LoadIdentification) -> dict[str, str]:
    rates, scale = scenario.rates, scenario.force_scaling.force_scale
    return {
        "Seed": str(seed),
        "Rates": (
            f"wrist sensor {rates.sensor_hz:g} Hz, hand and channel {rates.hand_hz:g} Hz, joint "
            f"control {rates.joint_control_hz:g} Hz, load estimator {rates.estimator_hz:g} Hz"
        ),
        "Plant": (
            f"continuous, {scenario.simulation.integrator}, no step longer than a period of the "
            "joint control; the sensor samples inside the steps"
        ),
        "Excitation": (
            f"one period of {load.trajectory.period:g} s, {load.trajectory.rho.shape[1]} "
            f"harmonics, condition number {load.kappa_w10:.1f}"
        ),
        "Force scale": f"1/{1 / scale:g}, slave to master",
    }


def _markdown_table(rows: list[report.Comparison]) -> str:
    lines = ["| What | Paper | This run | | Accepted | Verdict |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {row.quantity.replace('|', '&#124;')} | {row.paper_value} | {row.reproduced_value} "
        f"| {row.set_or_found} | {row.accepted_range or '–'} | {row.verdict} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def _print_comparison(rows: list[report.Comparison], out: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table("What", "Paper", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("This run", justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("Verdict", no_wrap=True)
    colours = {"agrees": "green", "differs": "bold red", "": "dim"}
    for row in rows:
        verdict = f"[{colours[row.css_class]}]{row.verdict}[/]"
        values = row.paper_value, row.reproduced_value, row.set_or_found
        table.add_row(row.quantity, *values, verdict)
    console = Console()
    console.print(table)
    console.print(f"written to {out}; open {out / 'report.html'}", highlight=False, markup=False)
