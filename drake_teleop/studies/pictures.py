"""The pictures of a study: main effects, interactions, and the Pareto front."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_teleop.pages.style import BLUE, GREY, VERMILION, Picture, house_style
from drake_teleop.studies.design import Study
from drake_teleop.studies.effects import (
    CONFIDENCE,
    PARETO,
    estimated,
    levels_of,
    numbers,
    pareto,
    varied,
)

if TYPE_CHECKING:
    import polars as pl

_LABELLED = 12  # points of the front that have room for their names


def write_pictures(study: Study, rows: pl.DataFrame, out: Path) -> list[Path]:
    """Writes those pictures that mean something for this study into the folder.

    Returns:
        Their files; of an earlier study of this folder none remain.
    """
    for old in out.glob("*.png"):
        old.unlink()
    measures = [name for name in study.measures if np.isfinite(numbers(rows, name)).any()]
    pictures: dict[str, Figure | None] = {}
    if measures and varied(study):
        pictures["main_effects"] = main_effects(study, rows, measures)
        if len(varied(study)) > 1:
            pictures |= {f"interactions_{m}": interactions(study, rows, m) for m in measures}
    pictures["pareto"] = pareto_front(study, rows)
    written = []
    for name, picture in pictures.items():
        if picture is not None:
            written.append(out / f"{name}.png")
            picture.savefig(written[-1], bbox_inches="tight")
    return written


def main_effects(study: Study, rows: pl.DataFrame, measures: list[str]) -> Figure:
    """The mean of each measure at each level of each factor.

    Bars are intervals of the level's difference from the mean of all, which is what a factor does.
    """
    factors, seeds = varied(study), rows["seed"].to_numpy()
    with house_style():
        size = (1.2 + 2.3 * len(factors), 0.8 + 1.6 * len(measures))
        figure = Picture(figsize=size)
        grid = figure.subplots(len(measures), len(factors), squeeze=False, sharey="row")
        for column, factor in enumerate(factors):
            levels, names = levels_of(factor, rows[factor.field].to_list())
            for axes, measure in zip(grid[:, column], measures, strict=True):
                found = estimated(numbers(rows, measure), levels, seeds, len(names))
                bars = np.nan_to_num(found.effect_half)
                place = np.arange(len(names))
                axes.errorbar(place, found.mean, bars, color=BLUE, marker="o", ms=3.5, capsize=3)
                axes.set_xticks(place, names)
                axes.set_xlim(-0.4, len(names) - 0.6)
            grid[-1, column].set_xlabel(factor.field)
        for axes, measure in zip(grid[:, 0], measures, strict=True):
            axes.set_ylabel(measure, fontsize=7)
        figure.suptitle(
            f"Main effects{_caption(study, 'of a level against the mean')}", x=0.01, ha="left"
        )
    return figure


def interactions(study: Study, rows: pl.DataFrame, measure: str) -> Figure:
    """The mean of a measure over each pair of factors."""
    pairs = list(itertools.combinations(varied(study), 2))
    seeds, values = rows["seed"].to_numpy(), numbers(rows, measure)
    columns = min(len(pairs), 3)
    lines = -(-len(pairs) // columns)
    with house_style():
        figure = Picture(figsize=(1.0 + 3.1 * columns, 0.6 + 2.6 * lines))
        grid = figure.subplots(lines, columns, squeeze=False)
        maps = []
        for first, second in pairs:
            a, names_a = levels_of(first, rows[first.field].to_list())
            b, names_b = levels_of(second, rows[second.field].to_list())
            count = len(names_a) * len(names_b)
            found = estimated(values, a * len(names_b) + b, seeds, count)
            maps.append((found.mean.reshape(len(names_a), -1), names_a, names_b))
        low = min(np.nanmin(table) for table, _, _ in maps)
        high = max(np.nanmax(table) for table, _, _ in maps)
        for axes, (first, second), (table, names_a, names_b) in zip(
            grid.ravel(), pairs, maps, strict=False
        ):
            drawn = axes.imshow(table, origin="lower", aspect="auto", vmin=low, vmax=high)
            axes.grid(False)
            axes.set_xticks(range(len(names_b)), names_b)
            axes.set_yticks(range(len(names_a)), names_a)
            axes.set_xlabel(second.field)
            axes.set_ylabel(first.field)
        for axes in grid.ravel()[len(pairs) :]:
            axes.set_visible(False)
        figure.colorbar(drawn, ax=grid, label=measure)
        figure.suptitle(f"Interactions: mean of {measure}", x=0.01, ha="left")
    return figure


def pareto_front(study: Study, rows: pl.DataFrame) -> Figure | None:
    """Effort against task time and overshoot of the contact force; None if not measured."""
    points = pareto(study, rows)
    if points is None or not points["complete"].any():
        return None
    points = points.filter("complete")
    on_front = points.filter("front")
    factors = [factor.field for factor in varied(study)]
    with house_style():
        figure = Picture(figsize=(10.0, 4.2))
        for axes, name in zip(figure.subplots(1, 2), PARETO[1:], strict=True):
            axes.plot(points[name], points[PARETO[0]], "o", ms=3, color=GREY, alpha=0.5)
            _bars(axes, on_front, name)
            axes.set_xlabel(name)
            axes.set_ylabel(PARETO[0])
        if on_front.height <= _LABELLED:
            for place, point in enumerate(on_front.iter_rows(named=True), 1):
                for axes, name in zip(figure.axes, PARETO[1:], strict=True):
                    axes.annotate(str(place), (point[name], point[PARETO[0]]), (4, 4),
                                  textcoords="offset points", fontsize=8)  # fmt: skip
            lines = [
                f"{place}: "
                + ", ".join(f"{field.split('.')[-1]} {point[field]}" for field in factors)
                for place, point in enumerate(on_front.iter_rows(named=True), 1)
            ]
            figure.text(1.0, 0.5, "\n".join(lines), fontsize=7.5, va="center")
        left = rows["point"].n_unique() - points.height
        words = f"; {left} points with failures are left out" if left else ""
        title = f"Pareto front of all three (red){_caption(study, 'of the mean')}{words}"
        figure.suptitle(title, x=0.01, ha="left")
    return figure


def _bars(axes: Axes, points: pl.DataFrame, name: str) -> None:
    half = [np.nan_to_num(points[f"{which}_half"].to_numpy()) for which in (name, PARETO[0])]
    axes.errorbar(
        points[name], points[PARETO[0]], half[1], half[0],
        color=VERMILION, marker="o", ms=4, lw=0, elinewidth=0.9, capsize=2,
    )  # fmt: skip


def _caption(study: Study, what: str) -> str:
    if study.repeats == 1:
        return "; one repeat has no intervals"
    return f"; bars: {CONFIDENCE:.0%} intervals {what}, over {study.repeats} seeds"
