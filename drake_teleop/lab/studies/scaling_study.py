"""`drake-teleop scaling-study`: best force scales for the simulated operator.

The merit of a point (sigma, gamma) is the mean over tasks of its criteria divided by those of
sigma = gamma = 1; a bootstrap over seeds gives intervals (docs/scaling-study.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from drake_teleop.common import files
from drake_teleop.common.numeric import Array
from drake_teleop.common.style import COLOURS, Picture, plot_style
from drake_teleop.lab.studies import effects
from drake_teleop.lab.studies.store import Store
from drake_teleop.lab.studies.study import LoadStudy, study_command

if TYPE_CHECKING:
    import polars as pl

CRITERIA = {"effort": "effort_Ns", "time": "task_time_s", "force": "contact_force_overshoot_N"}
#: Selections of equally weighted criteria.
CRITERIA_BY_CHOICE = {"all": tuple(CRITERIA), **{name: (name,) for name in CRITERIA}}
TASK_CRITERIA = dict.fromkeys(("reach", "touch", "press", "insert"), tuple(CRITERIA))
"""Criteria of each task; free reaching has no contact."""
TASK_CRITERIA["reach"] = ("effort", "time")
_OBJECT_SHARE_STUDY_NAME = "scaling_object"
_SIGMA_KEY, _GAMMA_KEY, _ETA_KEY = (f"force_scaling.{name}" for name in ("sigma", "gamma", "eta"))
_NUM_BOOTSTRAP_DRAWS, _BOOTSTRAP_SEED = 2000, 0
_MAX_FAILED_RUN_SHARE, _MIN_SHARE_OF_DRAWS_AS_BEST = 0.05, 0.05


@dataclass(frozen=True, eq=False)
class ScaleRating:
    """Result for one selection of criteria: arrays (s, g) over s values of sigma and g of gamma.

    Attributes:
        merit: mean relative criterion, below 1 is better; nan with too many failures.
        merit_low, merit_high: limits of the merit's 95 % interval.
        best_share: share of bootstrap draws in which the point is the best.
        failure_share: share of failed runs in the worst task.
    """

    merit: Array
    merit_low: Array
    merit_high: Array
    best_share: Array
    failure_share: Array


def scaling_study_command(
    out: Path, *, quiet: bool = False, progress: bool = True, **options: Any
) -> dict[str, Any]:
    """Run the missing runs of the scaling studies; write results; return the data of answer.json.

    The other options are those of `study_command`.
    """
    files.make_folder(out)
    rows = {}
    for name in (*(f"scaling_{task}" for task in TASK_CRITERIA), _OBJECT_SHARE_STUDY_NAME):
        study_command(name, out / name, quiet=quiet, progress=progress, **options)
        rows[name] = Store(out / name / "runs.parquet").read()
    tables = {task: _criterion_tables(rows[f"scaling_{task}"], task) for task in TASK_CRITERIA}
    ratings = {
        name: judge_scales(tables, criteria) for name, criteria in CRITERIA_BY_CHOICE.items()
    }
    summary = {
        "runs": sum(table.height for table in rows.values()),
        "choice": {selection: _find_best_scales(rating) for selection, rating in ratings.items()},
        "eta": _summarise_measures_by_object_share(rows[_OBJECT_SHARE_STUDY_NAME]),
    }
    with files.output_folder(out, "answer.json"):
        files.write_table(out / "answer.csv", _merit_table(ratings))
        files.write_picture(out / "answer.png", draw_task_criteria_over_scales(rows))
        files.write_picture(out / "choice.png", draw_best_scales(ratings, *_sigmas_and_gammas()))
        files.write_json(out / "answer.json", summary)
    if not quiet:
        _print_best_scales(summary, out)
    return summary


def judge_scales(tables: dict[str, dict[str, Array]], criteria: tuple[str, ...]) -> ScaleRating:
    """Return the rating of each sigma and gamma by these `criteria`.

    `tables[task]` maps criterion names and "success" to arrays (sigmas, gammas, seeds).
    """
    # A task may have none of the selected criteria.
    counted = {task: [name for name in TASK_CRITERIA[task] if name in criteria] for task in tables}
    count = next(iter(tables.values()))["success"].shape[-1]
    generator, equal = np.random.default_rng(_BOOTSTRAP_SEED), np.full(count, 1 / count)
    draws = generator.multinomial(count, equal, _NUM_BOOTSTRAP_DRAWS)
    weights = np.vstack([np.ones(count), draws]).astype(float)
    parts = [
        np.mean([_mean_ratios_to_unscaled(tables[task][name], weights) for name in names], axis=0)
        for task, names in counted.items()
        if names
    ]
    merits = np.mean(parts, axis=0)
    failures = np.max([(1 - t["success"]).mean(axis=-1) for t in tables.values()], axis=0)
    usable = failures <= _MAX_FAILED_RUN_SHARE
    # Draws in which the reference has no successful run are undefined.
    known = np.isfinite(merits[:, usable]).all(axis=1)
    merits[:, ~usable] = np.nan
    drawn, best = merits[1:][known[1:]], np.zeros(usable.size)
    if not (usable.any() and known[0] and len(drawn)):
        nothing = np.full(usable.shape, np.nan)
        return ScaleRating(nothing, nothing, nothing, best.reshape(usable.shape), failures)
    flat = np.where(usable, drawn, np.inf).reshape(len(drawn), -1)
    best = np.bincount(flat.argmin(axis=1), minlength=usable.size) / len(drawn)
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    return ScaleRating(merits[0], low, high, best.reshape(usable.shape), failures)


def _mean_ratios_to_unscaled(table: Array, weights: Array) -> Array:
    known = np.isfinite(table)
    with np.errstate(invalid="ignore", divide="ignore"):
        sums = np.einsum("sgk,dk->dsg", np.where(known, table, 0.0), weights)
        means = sums / np.einsum("sgk,dk->dsg", known.astype(float), weights)
    return means / means[:, -1, _sigmas_and_gammas()[1].index(1.0), None, None]  # sigma = gamma = 1


@cache
def _sigmas_and_gammas() -> tuple[list[float], list[float]]:
    factors = {factor.field: factor.values for factor in LoadStudy("scaling_touch").factors}
    return factors[_SIGMA_KEY], factors[_GAMMA_KEY]


def _criterion_tables(rows: pl.DataFrame, task: str) -> dict[str, Array]:
    sigmas, gammas = _sigmas_and_gammas()
    seeds = rows["seed"].n_unique()
    count = len(gammas) if _GAMMA_KEY in rows.columns else 1
    measures = {"success": "success"} | {name: CRITERIA[name] for name in TASK_CRITERIA[task]}
    tables = {}
    for name, measure in measures.items():
        values = effects.measure_values(rows, measure)
        values = np.nan_to_num(values) if name == "success" else values
        shaped = values.reshape(len(sigmas), count, seeds)
        tables[name] = np.broadcast_to(shaped, (len(sigmas), len(gammas), seeds))
    return tables


def _find_best_scales(rating: ScaleRating) -> dict[str, Any] | None:
    if not np.isfinite(rating.merit).any():
        return None
    sigmas, gammas = _sigmas_and_gammas()
    s, g = np.unravel_index(np.nanargmin(rating.merit), rating.merit.shape)
    near = np.argwhere(rating.best_share >= _MIN_SHARE_OF_DRAWS_AS_BEST)
    return {
        "sigma": sigmas[s],
        "gamma": gammas[g],
        "merit": rating.merit[s, g],
        "interval": [rating.merit_low[s, g], rating.merit_high[s, g]],
        "best_in": rating.best_share[s, g],
        "others": [
            {"sigma": sigmas[i], "gamma": gammas[j], "best_in": rating.best_share[i, j]}
            for i, j in near
            if (i, j) != (s, g)
        ],
    }


def _merit_table(ratings: dict[str, ScaleRating]) -> pl.DataFrame:
    import polars as pl

    sigmas, gammas = _sigmas_and_gammas()
    tables = [
        {
            "way": [selection] * rating.merit.size,
            "sigma": np.repeat(sigmas, len(gammas)),
            "gamma": np.tile(gammas, len(sigmas)),
            "merit": rating.merit.ravel(),
            "low": rating.merit_low.ravel(),
            "high": rating.merit_high.ravel(),
            "best_in": rating.best_share.ravel(),
        }
        for selection, rating in ratings.items()
    ]
    return pl.concat(map(pl.DataFrame, tables))


def _summarise_measures_by_object_share(rows: pl.DataFrame) -> list[dict[str, Any]]:
    etas = sorted(rows[_ETA_KEY].unique().to_list())
    table: list[dict[str, Any]] = [{"eta": eta} for eta in etas]
    for measure in ("success", *CRITERIA.values(), "detection_time_s"):
        values = effects.values_by_seed(rows, measure, by=_ETA_KEY)
        of_effect = effects.effect_half_widths_over_seeds(values)
        figures = *effects.means_and_half_widths_over_seeds(values), of_effect
        names = (measure, f"{measure}_half", f"{measure}_effect_half")
        for row, at_eta in zip(table, np.column_stack(figures), strict=True):
            row |= {n: v if np.isfinite(v) else None for n, v in zip(names, at_eta, strict=True)}
    return table


def draw_task_criteria_over_scales(rows: dict[str, pl.DataFrame]) -> Figure:
    sigmas, gammas = _sigmas_and_gammas()
    tasks = [task for task in TASK_CRITERIA if "force" in TASK_CRITERIA[task]]
    with plot_style():
        figure = Picture(figsize=(10.0, 7.6))
        grid = figure.subplots(len(tasks), 3, sharex=True)
        for line, task in zip(grid, tasks, strict=True):
            table = rows[f"scaling_{task}"]
            for axes, measure in zip(line, CRITERIA.values(), strict=True):
                values = effects.values_by_seed(table, measure)
                means = effects.means_and_half_widths_over_seeds(values)[0].reshape(-1, len(gammas))
                bars = effects.effect_half_widths_over_seeds(values).reshape(means.shape)
                for j, gamma in enumerate(gammas):
                    axes.errorbar(
                        sigmas, means[:, j], np.nan_to_num(bars[:, j]), color=COLOURS[j],
                        marker="o", ms=3, capsize=2, label=f"$\\gamma$ = {gamma:g}",
                    )  # fmt: skip
                axes.set_title(f"{task}: {measure}")
                axes.set_ylim(bottom=0)
        for axes in grid[-1]:
            axes.set_xlabel("$\\sigma$")
        grid[0, -1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def draw_best_scales(
    ratings: dict[str, ScaleRating], sigmas: list[float], gammas: list[float]
) -> Figure:
    known = np.concatenate([rating.merit[np.isfinite(rating.merit)] for rating in ratings.values()])
    farthest = np.abs(np.log2(known)).max(initial=0.01)
    # The colour scale is symmetric about 1 in ratios; excluded points are grey.
    ends = 2.0**-farthest, 2.0**farthest
    scale = LogNorm(*ends)
    cmap = colormaps["RdBu_r"].with_extremes(bad="#dddddd")
    with plot_style():
        figure = Picture(figsize=(10.0, 7.6))
        grid = figure.subplots(2, 2)
        for axes, (selection, rating) in zip(grid.ravel(), ratings.items(), strict=True):
            drawn = axes.imshow(rating.merit, origin="lower", aspect="auto", cmap=cmap, norm=scale)
            axes.grid(False)
            axes.set_xticks(range(len(gammas)), [f"{gamma:g}" for gamma in gammas])
            axes.set_yticks(range(len(sigmas)), [f"{sigma:g}" for sigma in sigmas])
            axes.set_xlabel("$\\gamma$")
            axes.set_ylabel("$\\sigma$")
            axes.set_title(f"criteria: {selection}")
            for i, j in np.ndindex(rating.merit.shape):
                dark = abs(scale(rating.merit[i, j]) - 0.5) > 0.3
                axes.text(j, i, _merit_cell_text(rating, i, j), color="white" if dark else "black",
                          ha="center", va="center", fontsize=7.5)  # fmt: skip
        bar = figure.colorbar(drawn, ax=grid, label="merit (less: better; 1 at sigma = gamma = 1)")
        ticks = [tick for tick in (0.1, 0.2, 0.5, 1, 2, 5, 10) if ends[0] <= tick <= ends[1]]
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks], minor=False)
        bar.minorticks_off()
        words = "Merit, and share of draws in which a point is best; grey: too many failed runs"
        figure.suptitle(words, x=0.01, ha="left")
    return figure


def _merit_cell_text(rating: ScaleRating, i: int, j: int) -> str:
    if not np.isfinite(rating.merit[i, j]):
        return f"{rating.failure_share[i, j]:.0%} fail"
    best = f"\nbest: {rating.best_share[i, j]:.0%}" if rating.best_share[i, j] >= 0.005 else ""
    return f"{rating.merit[i, j]:.2f}{best}"


def _print_best_scales(summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("criteria", "sigma", "gamma", "merit", "95 %", "best in draws")
    for selection, found in summary["choice"].items():
        if found is not None:
            low, high = found["interval"]
            table.add_row(
                selection, f"{found['sigma']:g}", f"{found['gamma']:g}", f"{found['merit']:.3f}",
                f"{low:.3f} to {high:.3f}", f"{found['best_in']:.0%}",
            )  # fmt: skip
    console = Console()
    console.print(table)
    console.print(f"{summary['runs']} runs; written to {out}", highlight=False, markup=False)
