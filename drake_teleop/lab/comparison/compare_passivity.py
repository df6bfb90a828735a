"""`drake-teleop compare-passivity`: every passivity method over every network.

Four studies: presses of the whole station on sheet springs (`whole_station`); and with `one_dof`
release of the device and taps on a wall, longest stable round trips, energy added by the delay.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import Diagram

from drake_teleop.common.errors import DrakeTeleopError, suggest_name
from drake_teleop.common.files import make_folder, output_folder, write_json, write_table
from drake_teleop.common.numeric import Array
from drake_teleop.common.progress import StartStage, show_progress
from drake_teleop.lab.analysis.task_direction import check_can_press
from drake_teleop.lab.comparison import one_dof, whole_station
from drake_teleop.lab.comparison.one_dof import PERIOD_S, TAP_RATES_HZ, OneDof, RunMeasures, Task
from drake_teleop.lab.identification import true_load
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.station import simulation
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import PRESETS, NetworkConfig
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.oscillation import high_pass_above_5_hz
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig, step_addresses
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Rates, Scenario, Simulation, replace
from drake_teleop.station.station import MakeTeleopStation

NETWORKS = ("lan", "wan", "internet", "geostationary", "lunar")
#: Round trips of the study in one degree of freedom [s].
ROUND_TRIPS_S = (
    *(0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0),
)
WALL_STIFFNESSES_N_M = (500.0, 5100.0, 20000.0)  #: N/m
JITTER_AND_LOSS_PAIRS = ((0.0, 0.0), (0.5, 0.3))
"""(jitter, loss) of the networks of the study in one degree of freedom."""
SIGMAS = (0.0, 1.0)
_NUM_TAPS, _TAP_AMPLITUDE_ABOUT_WALL_M = 8, 0.03  # number; m, amplitude about the wall's surface
_INJECTED_ENERGY_STUDY_CASES = tuple(itertools.product(SIGMAS, (0.01, 0.1, 0.3), (0.0, 5100.0)))
#: Rates of every run: a quarter (sensor) or half of those of the shipped scenarios.
_SAMPLE_RATES = Rates(sensor_hz=2000.0, hand_hz=1000.0, joint_control_hz=1000.0, log_hz=1000.0)
#: Step [s], longer than the events' period; else tiny steps (rounding) precede the events.
_MAX_SIMULATION_STEP_S = 2e-3


def compare_command(
    out: Path,
    *,
    networks: Sequence[str] = NETWORKS,
    methods: Sequence[str] | None = None,
    scenario: str | Path = "contact_transition",
    seed: int = 0,
    jobs: int = -1,
    quiet: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Compare passivity methods (None: all); write summary, runs, report and pictures into `out`.

    The scenario's rates, integrator, environment and load estimator are unused. Return the content
    of summary.json (docs/delay-figures.md).
    """
    if unknown := [name for name in networks if name not in PRESETS]:
        remedy = suggest_name(unknown[0], tuple(PRESETS), f"choose among {', '.join(PRESETS)}")
        what = f"there is no network '{unknown[0]}'"
        raise DrakeTeleopError(what, where="networks", remedy=remedy)
    methods = tuple(METHODS) if methods is None else methods
    for where, chosen in (("networks", networks), ("methods", methods)):
        if not chosen:
            raise DrakeTeleopError("is empty", where=where, remedy="give one name or more")
    for name in methods:
        METHODS.check(name, "methods")
    if "ideal" in networks and "none" in methods:
        what = "method 'none' over network 'ideal' has no channel that measures energy"
        raise DrakeTeleopError(what, where="networks", remedy="remove 'ideal' or 'none'")
    base = base_scenario(scenario, seed)  # before the work, as the folder: errors come early
    for method in methods:  # else each of its runs would count as unstable
        settings = Channel(network=networks[0]), PassivityConfig(method=method)
        setup, _ = whole_station.press_scenario(base, *settings, "contact")
        try:
            MakeTeleopStation(setup, load_estimate=true_load(base))
        except DrakeTeleopError as error:
            remedy = f"or give `methods` without {method}"
            raise DrakeTeleopError(str(error), remedy=remedy) from error
    make_folder(out)
    with show_progress(progress and not quiet) as stage:
        limits = _run_longest_round_trip_study(methods, seed, jobs, stage)
        released = _run_release_and_tap_study(networks, methods, seed, jobs, stage)
        runs, traces = _run_station_study(base, networks, methods, jobs, stage)
        covering = _run_injected_energy_study(stage)
    summary = {
        "networks": list(networks),
        "methods": list(methods),
        "scenario": str(scenario),
        "seed": seed,
        "station": runs,
        "hands": released,
        "one_dof": limits,
        "covering": covering,
    }
    # Workers import this module without matplotlib and polars.
    import polars as pl

    from drake_teleop.lab.comparison.report import print_tables, stability_table, write_report

    summary["decision"] = [
        {
            "method": method,
            "network": network,
            "verdict": cell.verdict,
            "felt_N": [displayed for displayed, _ in cell.force_pairs],
            "pressed_N": [pressed for _, pressed in cell.force_pairs],
            "leaked_J": cell.leaked_J,
        }
        for (method, network), cell in stability_table(summary).items()
    ]
    with output_folder(out):
        write_table(out / "runs.parquet", pl.DataFrame(runs, infer_schema_length=None))
        write_report(summary, traces, out)
        write_json(out / "summary.json", summary)
    if not quiet:
        print_tables(summary, out)
    return summary


def longest_stable_round_trip(
    method: str, model: OneDof, jitter: float, loss: float, seeds: Sequence[int]
) -> float:
    """Return the longest round trip [s] up to which all runs are stable; 0: none.

    Without `jitter` (share of the delay) and `loss` (probability) only the first seed runs.
    """
    longest = 0.0
    for round_trip in ROUND_TRIPS_S:
        network = NetworkConfig(delay=round_trip / 2, jitter=jitter, loss=loss)
        for seed in seeds if jitter or loss else seeds[:1]:
            run = one_dof.run_one_dof(model, PassivityConfig(method=method), network, seed=seed)
            if not one_dof.measures_of_run(run, model).stable:
                return longest
        longest = round_trip
    return longest


def base_scenario(scenario: str | Path, seed: int) -> Scenario:
    """Return the scenario at common rates, without environment, detection and estimator."""
    given = LoadScenario(scenario).without_environment()
    check_can_press(given)
    return replace(
        given,
        simulation=Simulation(seed=seed, max_step=_MAX_SIMULATION_STEP_S),
        rates=_SAMPLE_RATES,
        contact_detection=None,
        load_estimator=LoadEstimatorConfig(),  # contact would count as load
    )


def simulate_press(
    scenario: Scenario, method: str, network: str, leaf: str, estimate: Array
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Simulate a press on a sheet spring (`leaf`); return measures (a row) and time series."""
    row: dict[str, Any] = {"method": method, "network": network, "leaf": leaf}
    names = [entry.name for entry in dataclasses.fields(RunMeasures)]
    names += ["pressed_force", "felt_share", "left_behind", "leaked", "fast_force"]
    channel, passivity = Channel(network=network), PassivityConfig(method=method)
    setup, task = whole_station.press_scenario(scenario, channel, passivity, leaf)
    try:
        station = MakeTeleopStation(setup, load_estimate=estimate)
        result, found = _simulate_press_while_stable(station, setup, task)
    except DrakeTeleopError as error:
        return row | dict.fromkeys(names) | {"stable": False, "error": str(error)}, {}
    shown = whole_station.force_and_energy_traces(result, setup)
    held = task.is_held(shown["t"])
    fast = high_pass_above_5_hz(result.t[held], result["force_to_master"][held, :3])
    additional = {
        "fast_force": float(np.sqrt((fast**2).sum(axis=1).mean())),
        "pressed_force": abs(float(shown["pressed"][held].mean())),
        "felt_share": found.rendered_share,
        "left_behind": abs(found.drift),
        "leaked": max(-found.least_energy, 0.0),
    }
    for name, value in (dataclasses.asdict(found) | additional).items():
        row[name] = None if isinstance(value, float) and not np.isfinite(value) else value
    return row | {"error": None}, shown


def _simulate_press_while_stable(
    station: Diagram, scenario: Scenario, task: Task
) -> tuple[SimulationResult, RunMeasures]:
    settle = scenario.simulation.settle
    simulator = simulation.MakeSimulator(station, scenario.simulation)
    simulator.Initialize()
    hold = dataclasses.replace(task, end=task.release_start)
    for part in (hold, task):
        end = 1e-3 * round(1e3 * (settle + part.end))  # exactly at the event
        simulation.advance_without_garbage_collection(simulator, end)
        result = simulation.read_recorded_signals(simulator, settle)
        found = whole_station.measures_of_press(result, scenario, part)
        if not found.stable:
            break
    # Without rest in the hold the drift is not defined.
    return result, found if part is task else dataclasses.replace(found, drift=float("nan"))


@dataclass(frozen=True)
class ReleaseAndTaps:
    """Nonnegative measures: motion after release of the device, impulses of taps, leaked energy."""

    release_force: float  #: mean magnitude of the force on the hand, 0.1 s before release [N]
    release_speed: float  #: largest speed of the device in the 2 s after release [m/s]
    release_way: float  #: largest displacement of the device in these 2 s [m]
    tap_shares: tuple[float, ...]  #: displayed impulse over the wall's, for each of `TAP_RATES_HZ`
    leaked: float  #: largest energy output to hand and slave beyond input and start energy [J]


def simulate_release_and_taps(method: str, network: str, seed: int = 0) -> ReleaseAndTaps:
    round_trip, model = 2 * PRESETS[network].delay, OneDof()

    def simulate_one_dof(intent: Array, grip: Array | None = None) -> one_dof.OneDofRun:
        return one_dof.run_one_dof(
            model,
            PassivityConfig(method=method),
            PRESETS[network],
            seed=seed,
            timeout=Channel(network=network).timeout_s(PERIOD_S),
            intent=intent,
            grip=grip,
        )

    release_time = 3.0 + 3 * round_trip
    end = release_time + 2.0
    task = Task(0.1, 0.6, 0.7, 1.5, release_time + 10.0, release_time + 11.0, end, rest_window=0.1)
    pressing = one_dof.operator_intent(task)
    release_row = round(release_time / PERIOD_S)
    grip = np.tile([model.hand_mass, model.hand_damping, model.hand_stiffness], (len(pressing), 1))
    grip[release_row:] = 0.0
    released = simulate_one_dof(pressing, grip)
    after = released.master_position[release_row:]
    tapping = [simulate_one_dof(_intended_tap_motion(rate, round_trip)) for rate in TAP_RATES_HZ]
    scale = model.force_scale * model.gamma
    return ReleaseAndTaps(
        release_force=float(np.abs(released.hand_force[release_row - 100 : release_row]).mean()),
        release_speed=float(np.abs(np.diff(after)).max() / PERIOD_S),
        release_way=float(np.abs(after - after[0]).max()),
        tap_shares=tuple(
            _displayed_share_of_tap_impulse(found, scale, rate, 0.5 * round_trip)
            for found, rate in zip(tapping, TAP_RATES_HZ, strict=True)
        ),
        leaked=max(0.0, *(-r.least_energy_sum(one_dof.AT_SLAVE) for r in (released, *tapping))),
    )


def _intended_tap_motion(tap_hz: float, round_trip: float) -> Array:
    t = np.arange(round((1.0 + _NUM_TAPS / tap_hz + round_trip + 1.0) / PERIOD_S)) * PERIOD_S - 0.5
    moving = (t > 0.0) & (t < _NUM_TAPS / tap_hz)
    x = np.where(moving, -_TAP_AMPLITUDE_ABOUT_WALL_M * np.sin(2 * np.pi * tap_hz * t), 0.0)
    return np.stack([x, np.gradient(x, PERIOD_S)], axis=1)


def _displayed_share_of_tap_impulse(
    run: one_dof.OneDofRun, force_scale: float, tap_hz: float, one_way_delay_s: float
) -> float:
    first = int(np.argmax(run.wall_force < 0.0))
    second = first + round(0.75 / tap_hz / PERIOD_S)  # between first and second contact
    pressed = force_scale * run.wall_force[second:].sum()
    displayed = run.hand_force[second + round(one_way_delay_s / PERIOD_S) :].sum()
    return float(max(displayed / pressed, 0.0)) if pressed < 0.0 else 0.0


def _run_longest_round_trip_study(
    methods: Sequence[str], seed: int, jobs: int, stage: StartStage
) -> list[dict[str, Any]]:
    product = itertools.product(methods, WALL_STIFFNESSES_N_M, JITTER_AND_LOSS_PAIRS)
    cases = [(method, wall, *pair) for method, wall, pair in product]
    # Compile here once, so that the parallel processes read the cache.
    longest_stable_round_trip(methods[0], OneDof(), 0.0, 0.0, [seed])
    for method in methods:
        step_addresses(method)
    seeds = [seed, seed + 1]
    runs = [(method, OneDof(wall_stiffness=wall), *pair, seeds) for method, wall, *pair in cases]
    found = _run_in_processes(longest_stable_round_trip, runs, jobs, stage("One degree of freedom"))
    names, grid = ("method", "wall_N_per_m", "jitter", "loss"), list(ROUND_TRIPS_S)
    return [
        dict(zip(names, case, strict=True)) | {"longest_s": longest, "grid_s": grid}
        for case, longest in zip(cases, found, strict=True)
    ]


def _run_release_and_tap_study(
    networks: Sequence[str], methods: Sequence[str], seed: int, jobs: int, stage: StartStage
) -> list[dict[str, Any]]:
    cases = list(itertools.product(networks, methods))
    runs = [(method, network, seed) for network, method in cases]
    found = _run_in_processes(simulate_release_and_taps, runs, jobs, stage("Release, and taps"))
    return [
        {"method": method, "network": network, **vars(one), "tap_shares": list(one.tap_shares)}
        for (network, method), one in zip(cases, found, strict=True)
    ]


def _run_station_study(
    base: Scenario, networks: Sequence[str], methods: Sequence[str], jobs: int, stage: StartStage
) -> tuple[list[dict[str, Any]], dict[tuple[str, str], dict[str, Array]]]:
    estimate = identified_load(base, stage).estimate
    # Longest runs first, for an even load of the processes.
    slowest = sorted(networks, key=lambda name: -PRESETS[name].delay)
    cases = list(itertools.product(slowest, whole_station.LEAF_THICKNESSES_M, methods))
    runs = [(base, method, network, leaf, estimate) for network, leaf, method in cases]
    results = _run_in_processes(simulate_press, runs, jobs, stage("The whole station"))
    leaves = list(whole_station.LEAF_THICKNESSES_M)
    rows = [row for row, _ in results]
    rows.sort(key=lambda row: (networks.index(row["network"]), leaves.index(row["leaf"])))
    traces = {
        (row["network"], row["method"]): shown
        for row, shown in results
        if row["leaf"] == leaves[0] and shown
    }
    return rows, traces


def _run_injected_energy_study(stage: StartStage) -> list[dict[str, Any]]:
    progress, rows = stage("Energy added by the delay"), []
    for done, (sigma, round_trip, wall) in enumerate(_INJECTED_ENERGY_STUDY_CASES):
        model = OneDof(sigma=sigma, wall_stiffness=wall)
        run = one_dof.run_one_dof(model, PassivityConfig(), NetworkConfig(delay=round_trip / 2))
        row = {"sigma": sigma, "round_trip_s": round_trip, "wall_N_per_m": wall}
        row["injected_J"] = max(0.0, -run.least_energy_sum(one_dof.AT_SLAVE))
        row["damping_Ns_per_m"] = one_dof.damping_for_passivity(model, round_trip)
        rows.append(row)
        progress((done + 1) / len(_INJECTED_ENERGY_STUDY_CASES))
    return rows


def _run_in_processes(function: Any, cases: list[Any], jobs: int, progress: Any) -> list[Any]:
    from joblib import Parallel, delayed

    results = []
    parallel = Parallel(n_jobs=min(jobs, len(cases)) if jobs > 0 else jobs, return_as="generator")
    for result in parallel(delayed(function)(*case) for case in cases):
        results.append(result)
        progress(len(results) / len(cases))
    return results
