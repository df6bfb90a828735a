"""The pictures of a study: main effects, interactions, and the Pareto front."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_teleop.pages.style import BLUE, GREY, VERMILION, Picture, house_style
from drake_teleop.studies import effects
from drake_teleop.studies.design import Study
from drake_teleop.studies.effects import PARETO, numbers, pair_means, pareto, varied
from drake_teleop.studies.level_model import CONFIDENCE
from drake_teleop.writing import write_picture

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
            write_picture(written[-1], picture, bbox_inches="tight")
    return written


def main_effects(study: Study, rows: pl.DataFrame, measures: list[str]) -> Figure:
    """The mean of each measure at each level of each factor; dotted, that of all levels.

    Bars are intervals of the level's difference from the mean of all, which is what a factor does.
    """
    factors, fitted = varied(study), False
    with house_style():
        size = (1.2 + 2.3 * len(factors), 0.8 + 1.6 * len(measures))
        figure = Picture(figsize=size)
        grid = figure.subplots(len(measures), len(factors), squeeze=False, sharey="row")
        for line, measure in zip(grid, measures, strict=True):
            found = effects.main_effects(study, rows, measure)
            for axes, factor in zip(line, factors, strict=True):
                _levels(axes, found[factor.field])
                fitted |= found[factor.field].fitted
            line[0].set_ylabel(measure, fontsize=7)
        for axes, factor in zip(grid[-1], factors, strict=True):
            axes.set_xlabel(factor.field)
        figure.suptitle(f"Main effects{_effects_caption(study, fitted)}", x=0.01, ha="left")
    return figure


def _levels(axes: Axes, found: effects.MainEffect) -> None:
    place = np.arange(len(found.names))
    bars = np.nan_to_num(found.effect_half)
    axes.errorbar(place, found.mean, bars, color=BLUE, marker="o", ms=3.5, capsize=3)
    axes.axhline(found.mean[0] - found.effect[0], color=GREY, lw=0.8, ls=":")
    axes.set_xticks(place, found.names)
    axes.set_xlim(-0.4, len(place) - 0.6)
    if np.isnan(found.mean).all():
        axes.text(0.5, 0.5, "too few points", transform=axes.transAxes, ha="center", fontsize=8)


def interactions(study: Study, rows: pl.DataFrame, measure: str) -> Figure | None:
    """The mean of a measure over each pair of factors; None if there are too few points for it."""
    maps = pair_means(study, rows, measure)
    if not maps:
        return None
    columns = min(len(maps), 3)
    lines = -(-len(maps) // columns)
    with house_style():
        figure = Picture(figsize=(1.0 + 3.1 * columns, 0.6 + 2.6 * lines))
        grid = figure.subplots(lines, columns, squeeze=False)
        low, high = (end([end(found.mean) for found in maps]) for end in (np.min, np.max))
        for axes, found in zip(grid.ravel(), maps, strict=False):
            drawn = axes.imshow(found.mean, origin="lower", aspect="auto", vmin=low, vmax=high)
            axes.grid(False)
            axes.set_xticks(range(len(found.names[1])), found.names[1])
            axes.set_yticks(range(len(found.names[0])), found.names[0])
            axes.set_xlabel(found.fields[1])
            axes.set_ylabel(found.fields[0])
        for axes in grid.ravel()[len(maps) :]:
            axes.set_visible(False)
        figure.colorbar(drawn, ax=grid, label=measure)
        words = ", fitted: levels of each, and products" if maps[0].fitted else ""
        figure.suptitle(f"Interactions: mean of {measure}{words}", x=0.01, ha="left")
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


def _effects_caption(study: Study, fitted: bool) -> str:
    if not fitted:
        return _caption(study, "of a level against the mean")
    words = f"; bars: {CONFIDENCE:.0%} intervals of all levels against the mean, over the design"
    return f"{words}; one seed" if study.repeats == 1 else f"{words} and {study.repeats} seeds"


def _caption(study: Study, what: str) -> str:
    if study.repeats == 1:
        return "; one repeat has no intervals"
    return f"; bars: {CONFIDENCE:.0%} intervals {what}, over {study.repeats} seeds"
