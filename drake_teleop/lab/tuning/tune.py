"""`drake-teleop tune`: method, sigma, gamma, force scale and filter for a station.

The settings must meet the requirements for all given hands and walls. The search uses the linear
loop's limit, then one-axis simulations, then the whole station with several seeds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from drake_teleop.common import files
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.html import write_report_page_and_pictures
from drake_teleop.common.progress import UpdateProgress, show_progress
from drake_teleop.common.style import BLACK, COLOURS, Picture, plot_style
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.lab.studies.runs import run_study
from drake_teleop.lab.tuning import press_trial
from drake_teleop.lab.tuning.press_trial import StationPressTrial, TunedSettings
from drake_teleop.station.oscillation import MAX_FORCE_RIPPLE_RMS_AT_REST_N as MAX_REST_FORCE_N
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.scenario_reference import to_commented_yaml, write_scenario

CANDIDATE_METHODS = ("none", "ledger", "charged_tdpa", "wave")
"""Candidate passivity methods; other methods are inferior or render too little force."""
CANDIDATE_SIGMAS = (0.0, 0.3)
"""Candidate sigma_inertia: a larger one helps the hand to hold a wall, and masks contact."""
STIFFER_WALL_FACTORS = (1.2, 2.0)
"""Factors of the stiffest wall at which the chosen settings are tested for failure."""
LARGER_GAMMA_FACTOR = 1.2
"""Factor of gamma times margin at which the chosen settings are tested for failure."""
_CANDIDATE_LOW_PASS_CUTOFFS_HZ = (100.0, 50.0)  # Hz, candidates below the sensor's own bandwidth
_MAX_GAMMA_REDUCTION_FACTOR = 16.0  # from the limit in one axis to that of the station
_GAMMA_RATIO_AT_BISECTION_END = 1.15  # smallest unstable over largest stable gamma
# Gammas this factor above and below the limit of noise are assumed to fail and to hold.
_GAMMA_STEP_FACTOR_NEAR_NOISE_LIMIT = 1.03

Row = dict[str, Any]
StudyRunner = Callable[[str, Study, Any], list[Row]]


def tune(
    scenario: str | Path | Scenario,
    out: str | Path = "out/tune",
    *,
    hands: Sequence[str] = ("light", "firm"),
    walls: Sequence[float] = (0.5, 20.0),
    network: str | None = None,
    task: str = "press",
    jobs: int = -1,
    quiet: bool = True,
    progress: bool = True,
) -> dict[str, Any]:
    """Choose passivity method and force scales; write tuned.yaml, summary.json and report.html.

    Args:
        scenario: shipped name, YAML file, or scenario.
        out: folder of the results; the same call continues an interrupted one.
        hands: softest and firmest grip.
        walls: lowest and highest stiffness [kN/m].
        network: preset; None: channel of the scenario.
        task: press, touch or insert.
        jobs: number of processes; -1: one for each core.
        quiet: True hides result sentences and progress bars.

    Returns:
        The content of summary.json (docs/choose.md).

    Raises:
        DrakeTeleopError: for invalid hands, walls or names, or if no settings are stable.
    """
    given = scenario if isinstance(scenario, Scenario) else LoadScenario(scenario)
    out, stated = Path(out), press_trial.make_operating_range(hands, walls, task)
    if not isinstance(scenario, Scenario):
        files.refuse_to_replace_inputs(out / "tuned.yaml", scenario)
    base = press_trial.without_task_and_passivity_method(given, network)
    files.make_folder(out)
    shown = progress and not quiet
    with show_progress(shown) as stage:
        load = identified_load(base, stage)
    names = ("simulation", "operator", "channel", "load_estimator")
    of_trials = {name: getattr(base, name) for name in names}
    own = replace(given, contact_detection=None, **of_trials)
    trial = StationPressTrial(own, base, stated, load.estimate)
    inputs = {
        "given": to_commented_yaml(given),
        "base": to_commented_yaml(base),
        "stated": dataclasses.asdict(stated),
        "estimate": load.estimate.tolist(),
    }
    found = search_settings(trial, make_study_executor(out, inputs, jobs, shown))
    tuned = replace(given, channel=base.channel, force_scaling=base.force_scaling)
    tuned = found.settings.apply(tuned, stated)
    summary = _make_tuning_summary(found, tuned, stated, network)
    with files.output_folder(out):
        write_scenario(out / "tuned.yaml", tuned, heading=summary["sentences"])
        pictures = {"trade_off": draw_detectable_force_over_margin(found, summary)}
        package = "drake_teleop.lab.tuning"
        write_report_page_and_pictures(out, package, pictures, summary=summary)
        files.write_json(out / "summary.json", summary)
    if not quiet:
        from rich.console import Console

        console = Console()
        for line in (*summary["sentences"], f"written to {out}; run {out / 'tuned.yaml'}"):
            console.print(line, highlight=False, markup=False)
    return summary


@dataclass(frozen=True)
class SearchResult:
    """Settings chosen by `search_settings`, and the runs that it compared."""

    settings: TunedSettings
    #: Tried settings in one axis, with the predicted `threshold_N` and `gamma`.
    searched_settings: list[Row]
    given_runs: list[Row]  #: runs of the user's settings at the stiffest wall
    #: Runs in the operating range: gamma times margin, then gamma at the stiffest wall.
    inside_runs: list[Row]
    beyond_runs: list[Row]  #: runs with a larger gamma, then at stiffer walls


def search_settings(trial: StationPressTrial, execute: StudyRunner) -> SearchResult:
    """Return the stable settings with which the operator detects the smallest contact force."""
    base, stated = trial.base_scenario, trial.operating_range
    margin = stated.requirements.loop_gain_margin
    own = base.wrist_sensor.bandwidth_hz
    ends = list(dict.fromkeys((stated.hands[0], stated.hands[-1])))
    stiffest = stated.walls[1]
    unscaled = TunedSettings(press_trial.METHOD_NAME_OF_USER_SETTINGS, 1.0, 0.0, own)
    given = execute("as_given", _make_press_study(unscaled, ends, [stiffest]), trial)
    unscaled = dataclasses.replace(unscaled, method="ledger")
    quiet = execute("noise", _make_press_study(unscaled, ends, [stiffest]), trial)
    noise = max(1e-9, *(row["rest_force_N"] for row in quiet))  # N at gamma = 1
    lowest = np.inf if base.wrist_sensor.ideal else stated.requirements.min_low_pass_hz
    low_passes = [own, *(f for f in _CANDIDATE_LOW_PASS_CUTOFFS_HZ if lowest <= f < own)]
    noises = {f: noise * float(np.sqrt(f / own)) for f in low_passes}
    highest = margin / base.force_scaling.force_scale  # 1 N at the hand for 1 N at the tool
    caps = {f: min(MAX_REST_FORCE_N / noises[f], highest) for f in low_passes}
    factors = [
        Factor(field="method", words=list(CANDIDATE_METHODS)),
        Factor(field="sigma_inertia", values=list(CANDIDATE_SIGMAS)),
        Factor(field="low_pass_hz", values=low_passes),
    ]
    study = Study(factors=factors, measures=press_trial.ONE_AXIS_SEARCH_MEASURES)
    rows = execute("search", study, press_trial.OneAxisGammaSearch(base, stated, caps))
    search = [_add_predicted_force_threshold(row, trial, noises) for row in rows]
    candidates: dict[str, Row] = {}  # the best of each method
    for row in sorted(search, key=lambda row: float(row["threshold_N"])):
        if row["gamma"] > 0.0:
            candidates.setdefault(row["method"], row)
    found: list[tuple[float, TunedSettings, list[Row]]] = []
    for row in candidates.values():
        if found and found[0][0] <= row["threshold_N"]:
            break
        gamma, inside = _search_max_gamma(press_trial.settings_of_point(row), trial, execute)
        if inside:
            chosen = dataclasses.replace(press_trial.settings_of_point(row), gamma=gamma)
            found.append((row["threshold_N"] * row["gamma"] / gamma, chosen, inside))
            found.sort(key=lambda entry: entry[0])
    if not found:
        what = "no settings were stable for all given hands and walls"
        remedy = "give firmer --hands, softer --walls or a faster --network"
        raise DrakeTeleopError(what, where="tune", remedy=remedy)
    _, chosen, inside = found[0]
    larger = dataclasses.replace(chosen, gamma=LARGER_GAMMA_FACTOR * margin * chosen.gamma)
    beyond = execute("larger_gamma", _make_press_study(larger, ends, [stiffest], repeats=2), trial)
    walls = [factor * stiffest for factor in STIFFER_WALL_FACTORS]
    beyond += execute("stiffer_walls", _make_press_study(chosen, ends, walls, repeats=2), trial)
    return SearchResult(chosen, search, given, inside, beyond)


def _search_max_gamma(
    settings: TunedSettings, trial: StationPressTrial, execute: StudyRunner
) -> tuple[float, list[Row]]:
    def all_meet_requirements(rows: list[Row]) -> bool:
        return all(meets_requirements(row, press_trial.MAX_SEARCH_FORCE_ERROR) for row in rows)

    gamma, stable, failed = settings.gamma, 0.0, np.inf
    smallest = gamma / _MAX_GAMMA_REDUCTION_FACTOR
    inside: list[Row] = []
    while gamma >= smallest:
        rows: list[Row] = []
        for seed, (factor, hands, walls) in enumerate(trial.operating_range.tested_parts):
            tried = dataclasses.replace(settings, gamma=factor * gamma)
            name = f"station_{settings.method}_{gamma:.6g}_{seed}"
            rows += execute(name, _make_press_study(tried, hands, walls, seed=seed), trial)
            if not all_meet_requirements(rows):
                break
        else:
            stable, inside = gamma, rows
        if stable < gamma:
            failed, smaller = gamma, gamma / 2
            if all_meet_requirements([row | {"rest_force_N": 0.0} for row in rows]):
                # Noise grows with gamma.
                quiet = gamma * MAX_REST_FORCE_N / max(row["rest_force_N"] for row in rows)
                smaller = max(smaller, quiet / _GAMMA_STEP_FACTOR_NEAR_NOISE_LIMIT)
                failed = min(failed, quiet * _GAMMA_STEP_FACTOR_NEAR_NOISE_LIMIT)
        if failed == np.inf or failed <= _GAMMA_RATIO_AT_BISECTION_END * stable:
            break
        gamma = float(np.sqrt(stable * failed)) if stable else smaller
    return stable, inside


def meets_requirements(
    row: Row, max_force_error: float = press_trial.MAX_RELATIVE_FORCE_ERROR
) -> bool:
    """Return whether a run is at rest, quiet and within `max_force_error` of the contact force."""
    exact = press_trial.is_force_share_accepted(row["share"], max_force_error)
    return bool(row["rests"] and row["rest_force_N"] <= MAX_REST_FORCE_N and exact)


def make_study_executor(
    out: Path, inputs: dict[str, Any], jobs: int, progress: bool
) -> StudyRunner:
    """Return a function that runs a named study in the folder `out` / name."""

    def execute(name: str, study: Study, run_function: Any) -> list[Row]:
        with show_progress(progress) as stage:

            def start_trials(_: str) -> UpdateProgress:
                return stage(f"Trials {name}")

            found = run_study(
                study, out / name, run_function, inputs, jobs=jobs, progress=start_trials
            )
        for row in found.rows(named=True):
            if row["error"]:
                raise DrakeTeleopError(str(row["error"]), where=f"tune:{name}")
        return found.rows(named=True)

    return execute


def _add_predicted_force_threshold(
    row: Row, trial: StationPressTrial, noise_N_by_low_pass_hz: dict[float, float]
) -> Row:
    gamma = row["gamma_limit"] / trial.operating_range.requirements.loop_gain_margin
    human = trial.base_scenario.operator.perception
    scale = trial.base_scenario.force_scaling.force_scale
    motion_scale = trial.base_scenario.kinematic_scaling.translation_scale
    # The slave swings with this amplitude and frequency in `press_scenario`.
    amplitude, frequency = 0.02 * min(motion_scale, 1.0), 2 * np.pi * 1.5
    rms_load_force = float(trial.load_estimate[6] * amplitude * frequency**2 / np.sqrt(2))
    masked = row["sigma_inertia"] * scale * rms_load_force
    smallest = max(human.absolute_threshold, human.weber_fraction * masked)
    noise = 2 * noise_N_by_low_pass_hz[row["low_pass_hz"]] * gamma
    rendered = scale * gamma * row["share"]
    threshold = (smallest + noise) / rendered if rendered > 0.0 else np.inf
    return row | {"gamma": gamma, "threshold_N": float(threshold)}


def _make_press_study(
    settings: TunedSettings, hands: list[str], walls: list[float], seed: int = 0, repeats: int = 1
) -> Study:
    numbers = dataclasses.asdict(settings)
    factors = [Factor(field="method", words=[numbers.pop("method")])]
    factors += [Factor(field=name, values=[number]) for name, number in numbers.items()]
    factors += [Factor(field="hand", words=hands), Factor(field="wall", values=walls)]
    return Study(factors=factors, measures=press_trial.PRESS_MEASURES, seed=seed, repeats=repeats)


def _make_tuning_summary(
    result: SearchResult, tuned: Scenario, stated: press_trial.OperatingRange, network: str | None
) -> dict[str, Any]:
    scale, gamma = tuned.force_scaling.force_scale, result.settings.gamma
    failed = [row for row in result.beyond_runs if not meets_requirements(row)]
    fails_at: dict[str, Any] | None = None
    if failed:
        hand, wall, failing = (failed[0][name] for name in ("hand", "wall", "gamma"))
        fails_at = {"hand": hand, "wall_N_per_m": wall, "gamma_factor": failing / gamma}
    shares = [row["share"] for row in result.inside_runs]
    edge = [row for row in result.inside_runs if row["gamma"] == gamma]  # without margin
    holds = all(map(meets_requirements, result.given_runs))
    worst_given = max(row["threshold_N"] for row in result.given_runs)
    results = {
        "share": min(shares),
        "largest_share": max(shares),
        "threshold_N": max(row["threshold_N"] for row in edge),
        "given_threshold_N": worst_given if holds else None,
        "rest_force_N": max(row["rest_force_N"] for row in edge),
        "margin": stated.requirements.loop_gain_margin,
        "fails_at": fails_at,
        "beyond_N_per_m": max(row["wall"] for row in result.beyond_runs),
        "beyond_gamma_factor": max(row["gamma"] for row in result.beyond_runs) / gamma,
    }
    settings = dataclasses.asdict(result.settings) | {"sigma_weight": 0.0, "force_scale": scale}
    stated_data = {
        "hands": list(stated.hands),
        "walls": list(stated.walls),
        "network": network or tuned.channel.network,
        "task": stated.task,
    }
    return {
        "settings": settings,
        "stated": stated_data,
        "figures": results,
        "sentences": _tuning_result_sentences(result.settings, results, stated_data, scale),
        "search": result.searched_settings,
        "trials": [*result.given_runs, *result.inside_runs, *result.beyond_runs],
    }


def _tuning_result_sentences(
    chosen: TunedSettings, results: dict[str, Any], stated: dict[str, Any], force_scale: float
) -> list[str]:
    low, high = (1e-3 * wall for wall in stated["walls"])
    hands = " to ".join(dict.fromkeys((stated["hands"][0], stated["hands"][-1])))
    before = results["given_threshold_N"]
    instead = "the scenario's own settings fail for these hands and walls"
    if before is not None:
        instead = f"with the scenario's own settings it is {before:.2f} N"
    lines = [
        f"Use passivity.method {chosen.method}, gamma {chosen.gamma:.2f}, sigma_weight 0, "
        f"sigma_inertia {chosen.sigma_inertia:g}, force_scale {force_scale:.4g}, and a low-pass of "
        f"{chosen.low_pass_hz:g} Hz.",
        f"The station is stable for a {hands} grip at walls of {low:g} to {high:g} kN/m over "
        f"{stated['network']}, also with gamma {results['margin']:g} times as large.",
        f"It renders {results['share']:.2f} to {results['largest_share']:.2f} of the scaled "
        f"contact force; above 5 Hz the force at rest has {results['rest_force_N']:.3f} N rms.",
        f"The smallest contact force that the operator detects is {results['threshold_N']:.2f} N "
        f"at the tool; {instead}.",
    ]
    last = (
        f"No failure was found up to walls of {results['beyond_N_per_m'] / 1e3:g} kN/m, or "
        f"with gamma {results['beyond_gamma_factor']:.2f} times as large."
    )
    if fails := results["fails_at"]:
        wall, factor = fails["wall_N_per_m"] / 1e3, fails["gamma_factor"]
        last = (
            f"The station fails with a {fails['hand']} grip at a wall of {wall:g} kN/m and gamma "
            f"{factor:.2f} times as large."
        )
    return [*lines, last]


def draw_detectable_force_over_margin(result: SearchResult, summary: dict[str, Any]) -> Figure:
    with plot_style():
        figure = Picture(figsize=(6.4, 4.0))
        axes = figure.subplots()
        margins, searched = np.geomspace(1.0, 4.0, 50), result.searched_settings
        methods = dict.fromkeys(row["method"] for row in searched)
        for colour, method in zip(COLOURS, methods, strict=False):
            rows = [r for r in searched if r["method"] == method and r["gamma_limit"] > 0.0]
            if not rows:
                continue
            best = min(rows, key=lambda row: float(row["threshold_N"]))
            at_limit = best["threshold_N"] * best["gamma"] / best["gamma_limit"]
            axes.plot(margins, at_limit * margins, color=colour, label=method)
        figures = summary["figures"]
        axes.plot(figures["margin"], figures["threshold_N"], "o", color=BLACK, label="chosen")
        axes.set(yscale="log", ylabel="smallest detected contact force [N]")
        axes.set_xlabel("factor of gamma up to instability")
        axes.legend()
    return figure
