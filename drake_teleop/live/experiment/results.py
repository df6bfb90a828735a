"""Thresholds, sensitivities, times and forces of an experiment with 95 % intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import polars as pl
from scipy.special import stdtrit

from drake_teleop.common.files import write_picture, write_table
from drake_teleop.live.experiment.design import ApparentMass, Experiment, PegInSlot, Task
from drake_teleop.live.experiment.psychometrics import EstimateWithLimits, PsiMethod
from drake_teleop.live.experiment.store import TrialRow, TrialStore, table_schema

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PLOTTED_QUANTITIES = (
    "threshold of contact [N at the tool]",
    "threshold of mass [kg at the hand]",
    "time to the floor [s]",
    "largest contact force [N]",
)
_DONE_SHARE_QUANTITY = "share of trials done"


class ResultRow(NamedTuple):
    """Row of the result table: a quantity with its 95 % interval; participant 0: the mean."""

    task: str
    condition: str
    participant: int
    trials: int
    quantity: str
    value: float
    low: float
    high: float


def compute_results(experiment: Experiment, store: TrialStore) -> list[ResultRow]:
    found = []
    numbers = store.participant_numbers()
    known = {n: [row for row in store.read_rows(n) if not row.practice] for n in numbers}
    for task in experiment.tasks:
        kind = type(task).__name__
        for condition in experiment.conditions:
            each: dict[str, list[ResultRow]] = {}
            for n, rows in known.items():
                done = [r for r in rows if (r.task, r.condition) == (kind, condition.name)]
                for quantity, estimate in _estimate_task_results(task, done).items():
                    result = ResultRow(kind, condition.name, n, len(done), quantity, *estimate)
                    each.setdefault(quantity, []).append(result)
            for quantity, one in each.items():
                found += one
                if len(one) > 1:
                    values, are_shares = [r.value for r in one], quantity == _DONE_SHARE_QUANTITY
                    over = _mean_with_interval(values, are_shares=are_shares)
                    trials = sum(r.trials for r in one)
                    found.append(ResultRow(kind, condition.name, 0, trials, quantity, *over))
    return found


def _estimate_task_results(task: Task, rows: Sequence[TrialRow]) -> dict[str, EstimateWithLimits]:
    if not rows:
        return {}
    if isinstance(task, PegInSlot):
        done = [row for row in rows if row.correct]
        from scipy.stats import binomtest

        share = binomtest(len(done), len(rows))
        interval = share.proportion_ci(method="wilson")
        found = {_DONE_SHARE_QUANTITY: EstimateWithLimits(share.statistic, *interval)}
        if done:
            found["time to the floor [s]"] = _mean_with_interval([row.time_s for row in done])
            found["largest contact force [N]"] = _mean_with_interval([row.force_N for row in done])
        return found
    psi = PsiMethod(task.low, task.high)
    for row in rows:
        psi.update_posterior(row.level, bool(row.correct))
    middle = math.sqrt(task.low * task.high)
    unit, name = "N", "threshold of contact [N at the tool]"
    if isinstance(task, ApparentMass):
        unit, name = "kg", "threshold of mass [kg at the hand]"
    return {name: psi.threshold(), f"d' at {middle:.3g} {unit}": psi.estimate_d_prime(middle)}


def _mean_with_interval(values: Sequence[float], *, are_shares: bool = False) -> EstimateWithLimits:
    """Return the geometric mean (arithmetic for shares from 0 to 1) with its 95 % interval."""
    x = np.asarray(values) if are_shares else np.log(np.maximum(values, 1e-9))
    mean, half = float(x.mean()), math.nan
    if len(x) > 1:
        half = float(stdtrit(len(x) - 1, 0.975) * x.std(ddof=1) / math.sqrt(len(x)))
    found = (mean, mean - half, mean + half)
    if are_shares:
        return EstimateWithLimits(*(min(max(v, 0.0), 1.0) if v == v else v for v in found))
    return EstimateWithLimits(*(math.exp(v) for v in found))


def write_results(experiment: Experiment, store: TrialStore) -> pl.DataFrame:
    found = compute_results(experiment, store)
    table = pl.DataFrame(found, schema=table_schema(ResultRow), orient="row").with_columns(
        pl.col("value", "low", "high").fill_nan(None)
    )
    write_table(store.folder / "trials.csv", store.trials_table())
    write_table(store.folder / "results.csv", table)
    _write_results_plot(store.folder / "results.png", experiment, found)
    return table


def _write_results_plot(path: Path, experiment: Experiment, found: list[ResultRow]) -> None:
    from drake_teleop.common.style import Picture, plot_style

    quantities = {r.quantity for r in found}
    shown = [quantity for quantity in _PLOTTED_QUANTITIES if quantity in quantities]
    if not shown:
        return
    names = [condition.name for condition in experiment.conditions]
    with plot_style():
        figure = Picture(figsize=(2.9 * len(shown), 0.9 + 0.62 * len(names)))
        grid = figure.subplots(1, len(shown), squeeze=False, sharey=True)
        for axes, quantity in zip(grid[0], shown, strict=True):
            _draw_results(axes, names, [r for r in found if r.quantity == quantity])
            axes.set_xlabel(quantity)
        grid[0][0].set_yticks(range(len(names)), names)
        grid[0][0].set_ylim(len(names) - 0.5, -0.5)
        people = len({r.participant for r in found} - {0})
        who = f"{people} participants and their mean" if people > 1 else "1 participant"
        figure.suptitle(f"{who}, 95 % intervals", x=0.01, ha="left", fontsize=10)
    write_picture(path, figure, bbox_inches="tight")


def _draw_results(axes: Axes, names: list[str], found: list[ResultRow]) -> None:
    from matplotlib.ticker import LogLocator

    from drake_teleop.common.style import BLUE, VERMILION

    people = sorted({r.participant for r in found} - {0})
    for r in found:
        place = float(names.index(r.condition))
        if r.participant and len(people) > 1:
            place += 0.1 + 0.25 * people.index(r.participant) / (len(people) - 1)
        large = not r.participant or len(people) == 1
        colour, thick = (VERMILION, 2.0) if large else (BLUE, 0.8)
        if not r.participant:
            place -= 0.15
        axes.plot(r.value, place, "o", color=colour, markersize=6 if large else 2.5)
        if math.isfinite(r.low):
            axes.plot([r.low, r.high], [place, place], color=colour, linewidth=thick)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    # The range may contain no power of ten.
    least, most = axes.get_xlim()
    axes.xaxis.set_minor_locator(LogLocator(subs=(2, 3, 4, 6) if most < 30 * least else (3,)))
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.grid(axis="y", visible=False)
