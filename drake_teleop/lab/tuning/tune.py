"""`drake-teleop tune`: method, sigma, gamma, force scale and filter for a station."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from drake_teleop.common import files
from drake_teleop.common.html import write_report_page_and_pictures
from drake_teleop.common.progress import show_progress
from drake_teleop.common.style import BLACK, COLOURS, Picture, plot_style
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.lab.tuning import search
from drake_teleop.lab.tuning.press_trial import (
    StatedSet,
    StationPressTrial,
    TunedSettings,
    make_stated_set,
    without_task_and_method,
)
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.scenario_reference import to_commented_yaml, write_scenario


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
        hands: grips; settings hold from the softest to the firmest.
        walls: stiffnesses [kN/m]; settings hold from the lowest to the highest.
        network: preset; None: channel of the scenario.
        task: press, touch or insert.
        jobs: number of processes; -1: one for each core.
        quiet: True hides the sentences and progress bars; `progress` False only the bars.

    Returns:
        The content of summary.json (docs/choose.md).

    Raises:
        DrakeTeleopError: for an invalid set, or if no settings are stable.
    """
    given = scenario if isinstance(scenario, Scenario) else LoadScenario(scenario)
    out, stated = Path(out), make_stated_set(hands, walls, task)
    if not isinstance(scenario, Scenario):
        files.refuse_to_replace_inputs(out / "tuned.yaml", scenario)
    base = without_task_and_method(given, network)
    files.make_folder(out)
    shown = progress and not quiet
    with show_progress(shown) as stage:
        load = identified_load(base, stage)
    of_trials = {name: getattr(base, name) for name in ("simulation", "operator", "channel")}
    own = replace(given, contact_detection=None, **of_trials)
    trial = StationPressTrial(own, base, stated, load.estimate)
    basis = {
        "given": to_commented_yaml(given),
        "base": to_commented_yaml(base),
        "stated": dataclasses.asdict(stated),
        "estimate": load.estimate.tolist(),
    }
    found = search.search_settings(trial, search.make_study_executor(out, basis, jobs, shown))
    tuned = replace(given, channel=base.channel, force_scaling=base.force_scaling)
    tuned = found.settings.apply(tuned, stated)
    summary = _make_tuning_summary(found, tuned, stated, network)
    with files.output_folder(out):
        write_scenario(out / "tuned.yaml", tuned, heading=summary["sentences"])
        pictures = {"trade_off": draw_trade_off(found, summary)}
        package = "drake_teleop.lab.tuning"
        write_report_page_and_pictures(out, package, pictures, summary=summary)
        files.write_json(out / "summary.json", summary)
    if not quiet:
        from rich.console import Console

        console = Console()
        for line in (*summary["sentences"], f"written to {out}; run {out / 'tuned.yaml'}"):
            console.print(line, highlight=False, markup=False)
    return summary


def _make_tuning_summary(
    found: search.SearchResult, tuned: Scenario, stated: StatedSet, network: str | None
) -> dict[str, Any]:
    scale, gamma = tuned.force_scaling.force_scale, found.settings.gamma
    failed = [row for row in found.beyond_runs if not search.meets_requirements(row)]
    fails_at: dict[str, Any] | None = None
    if failed:
        hand, wall, failing = (failed[0][name] for name in ("hand", "wall", "gamma"))
        fails_at = {"hand": hand, "wall_N_per_m": wall, "gamma_factor": failing / gamma}
    shares = [row["share"] for row in found.inside_runs]
    edge = [row for row in found.inside_runs if row["gamma"] == gamma]  # without margin
    holds = all(map(search.meets_requirements, found.given_runs))
    worst_given = max(row["threshold_N"] for row in found.given_runs)
    figures = {
        "share": min(shares),
        "largest_share": max(shares),
        "threshold_N": max(row["threshold_N"] for row in edge),
        "given_threshold_N": worst_given if holds else None,
        "rest_force_N": max(row["rest_force_N"] for row in edge),
        "margin": stated.requirements.loop_gain_margin,
        "fails_at": fails_at,
        "beyond_N_per_m": max(row["wall"] for row in found.beyond_runs),
        "beyond_gamma_factor": max(row["gamma"] for row in found.beyond_runs) / gamma,
    }
    settings = dataclasses.asdict(found.settings) | {"sigma_weight": 0.0, "force_scale": scale}
    about = {
        "hands": list(stated.hands),
        "walls": list(stated.walls),
        "network": network or tuned.channel.network,
        "task": stated.task,
    }
    return {
        "settings": settings,
        "stated": about,
        "figures": figures,
        "sentences": _tuning_result_sentences(found.settings, figures, about, scale),
        "search": found.searched_settings,
        "trials": [*found.given_runs, *found.inside_runs, *found.beyond_runs],
    }


def _tuning_result_sentences(
    chosen: TunedSettings, figures: dict[str, Any], about: dict[str, Any], scale: float
) -> list[str]:
    low, high = (1e-3 * wall for wall in about["walls"])
    hands = " to ".join(dict.fromkeys((about["hands"][0], about["hands"][-1])))
    before = figures["given_threshold_N"]
    instead = "the scenario's own settings fail in this set"
    if before is not None:
        instead = f"with the scenario's own settings it is {before:.2f} N"
    lines = [
        f"Take passivity.method {chosen.method}, gamma {chosen.gamma:.2f}, sigma_weight 0, "
        f"sigma_inertia {chosen.sigma_inertia:g}, force_scale {scale:.4g}, and a low-pass of "
        f"{chosen.low_pass_hz:g} Hz.",
        f"The station is stable for a {hands} grip at walls of {low:g} to {high:g} kN/m over "
        f"{about['network']}, also with gamma {figures['margin']:g} times as large.",
        f"It renders {figures['share']:.2f} to {figures['largest_share']:.2f} of the scaled "
        f"contact force; above 5 Hz the force at rest has {figures['rest_force_N']:.3f} N rms.",
        f"The smallest contact force that the operator detects is {figures['threshold_N']:.2f} N "
        f"at the tool; {instead}.",
    ]
    fails = figures["fails_at"]
    if fails is None:
        last = (
            f"No failure was found up to walls of {figures['beyond_N_per_m'] / 1e3:g} kN/m, or "
            f"with gamma {figures['beyond_gamma_factor']:.2f} times as large."
        )
    else:
        wall, factor = fails["wall_N_per_m"] / 1e3, fails["gamma_factor"]
        last = (
            f"It fails with a {fails['hand']} grip at a wall of {wall:g} kN/m and gamma "
            f"{factor:.2f} times as large."
        )
    return [*lines, last]


def draw_trade_off(found: search.SearchResult, summary: dict[str, Any]) -> Figure:
    """Draw the detection threshold against the margin of gamma for each method."""
    with plot_style():
        figure = Picture(figsize=(6.4, 4.0))
        axes = figure.subplots()
        margins, searched = np.geomspace(1.0, 4.0, 50), found.searched_settings
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
        axes.set_xlabel("margin: factor by which gamma may grow")
        axes.legend()
    return figure
