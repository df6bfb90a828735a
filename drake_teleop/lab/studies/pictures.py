"""Pictures of a study's results."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from drake_teleop.common.files import write_picture
from drake_teleop.common.style import BLUE, GREY, VERMILION, Picture, plot_style
from drake_teleop.lab.studies import effects
from drake_teleop.lab.studies.design import Study
from drake_teleop.lab.studies.effects import (
    PARETO_MEASURES,
    measure_values,
    pair_means,
    pareto_table,
    varied_factors,
)
from drake_teleop.lab.studies.level_model import (
    CONFIDENCE_LEVEL,
    NO_RUN,
    NO_SUCCESS,
    NOT_COMPARABLE,
    TOO_FEW_POINTS,
)

if TYPE_CHECKING:
    import polars as pl

_MAX_UNROTATED_LABEL_LETTERS = 24  # letters that fit below a picture
# Hatches of cells without value.
_HATCH_BY_REASON = {NO_SUCCESS: "////", NO_RUN: "....", NOT_COMPARABLE: "xxxx", TOO_FEW_POINTS: ""}


def write_pictures(study: Study, rows: pl.DataFrame, out: Path) -> list[Path]:
    """Write the pictures that apply to a study into `out`; delete all other PNG files there."""
    for old in out.glob("*.png"):
        old.unlink()
    measures = [name for name in study.measures if np.isfinite(measure_values(rows, name)).any()]
    pictures: dict[str, Figure | None] = {}
    if measures and varied_factors(study):
        pictures["main_effects"] = draw_main_effects(study, rows, measures)
        if len(varied_factors(study)) > 1:
            pictures |= {f"interactions_{m}": draw_interactions(study, rows, m) for m in measures}
    pictures["pareto"] = draw_pareto_front(study, rows)
    drawn = {out / f"{name}.png": picture for name, picture in pictures.items() if picture}
    for path, picture in drawn.items():
        write_picture(path, picture, bbox_inches="tight")
    return list(drawn)


def draw_main_effects(study: Study, rows: pl.DataFrame, measures: list[str]) -> Figure:
    factors, is_fitted, reasons = varied_factors(study), False, set[str]()
    with plot_style():
        figure = Picture(figsize=(1.2 + 2.3 * len(factors), 0.8 + 1.6 * len(measures)))
        grid = figure.subplots(len(measures), len(factors), squeeze=False, sharey="row")
        for line, measure in zip(grid, measures, strict=True):
            found = effects.main_effects(study, rows, measure)
            for axes, factor in zip(line, factors, strict=True):
                _draw_level_means(axes, found[factor.field])
                is_fitted |= found[factor.field].is_fitted
                reasons |= set(found[factor.field].missing_reasons)
            words = textwrap.wrap(measure.replace("_", "_ "), 18)
            line[0].set_ylabel("\n".join(words).replace(" ", ""), fontsize=7)
        for axes, factor in zip(grid[-1], factors, strict=True):
            axes.set_xlabel(factor.field)
        figure.suptitle(f"Main effects{_effects_caption(study, is_fitted)}", x=0.01, ha="left")
        _draw_hatch_legend(figure, reasons)
    return figure


def _draw_level_means(axes: Axes, effect: effects.MainEffect) -> None:
    place = np.arange(len(effect.level_names))
    bars = np.nan_to_num(effect.effect_half_width)
    axes.errorbar(place, effect.mean, bars, color=BLUE, marker="o", ms=3.5, capsize=3)
    _label_levels(axes, effect.level_names)
    axes.set_xlim(-0.5, len(place) - 0.5)
    for level in place[np.isnan(effect.mean)]:
        bar = _make_hatched_cell(effect.missing_reasons[level], (level - 0.5, 0.0))
        bar.set_transform(axes.get_xaxis_transform())
        axes.add_patch(bar)
    if np.isnan(effect.mean).all():
        words = TOO_FEW_POINTS if TOO_FEW_POINTS in effect.missing_reasons else ""
        axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", fontsize=8)
        return
    axes.axhline(np.nanmax(effect.mean - effect.effect), color=GREY, lw=0.8, ls=":")
    axes.set_title(_describe_used_combinations(effect), fontsize=7, color=GREY, loc="right")


def _label_levels(axes: Axes, levels: list[str]) -> None:
    axes.set_xticks(range(len(levels)), levels)
    if len("".join(levels)) > _MAX_UNROTATED_LABEL_LETTERS:
        for label in axes.get_xticklabels():
            label.set(rotation=20, ha="right", rotation_mode="anchor")


def _describe_used_combinations(means: effects.MainEffect | effects.PairMeans) -> str:
    used, unused = means.num_used_combinations, means.num_unused_combinations
    return f"over {used} of {used + unused} combinations of the other factors" if unused else ""


def _make_hatched_cell(reason: str, corner: tuple[float, float]) -> Rectangle:
    return Rectangle(corner, 1.0, 1.0, hatch=_HATCH_BY_REASON[reason], fc="white", ec=GREY, lw=0)


def _draw_hatch_legend(figure: Figure, missing_reasons: Iterable[str]) -> None:
    names = [why for why in _HATCH_BY_REASON if why in missing_reasons and why != TOO_FEW_POINTS]
    if names:
        patches = [_make_hatched_cell(why, (0.0, 0.0)) for why in names]
        figure.legend(patches, names, loc="outside lower left", ncols=len(names))


def draw_interactions(study: Study, rows: pl.DataFrame, measure: str) -> Figure | None:
    maps = [found for found in pair_means(study, rows, measure) if np.isfinite(found.mean).any()]
    if not maps:
        return None
    columns = min(len(maps), 3)
    lines = -(-len(maps) // columns)
    with plot_style():
        figure = Picture(figsize=(1.0 + 3.1 * columns, 0.6 + 2.6 * lines))
        grid = figure.subplots(lines, columns, squeeze=False)
        low, high = (end([end(found.mean) for found in maps]) for end in (np.nanmin, np.nanmax))
        for axes, found in zip(grid.ravel(), maps, strict=False):
            drawn = axes.imshow(found.mean, origin="lower", aspect="auto", vmin=low, vmax=high)
            for row, column in np.argwhere(np.isnan(found.mean)):
                why, corner = found.missing_reasons[row, column], (column - 0.5, row - 0.5)
                axes.add_patch(_make_hatched_cell(why, corner))
            axes.grid(False)
            _label_levels(axes, found.level_names[1])
            axes.set_yticks(range(len(found.level_names[0])), found.level_names[0])
            axes.set_xlabel(found.fields[1])
            axes.set_ylabel(found.fields[0])
            axes.set_title(_describe_used_combinations(found), fontsize=7, color=GREY, loc="right")
        for axes in grid.ravel()[len(maps) :]:
            axes.set_visible(False)
        figure.colorbar(drawn, ax=grid, label=measure)
        words = ", by regression on levels and products" if maps[0].is_fitted else ""
        figure.suptitle(f"Interactions: mean of {measure}{words}", x=0.01, ha="left")
        _draw_hatch_legend(figure, set().union(*(found.missing_reasons.ravel() for found in maps)))
    return figure


def draw_pareto_front(study: Study, rows: pl.DataFrame) -> Figure | None:
    """Draw the hand's effort over task time and over force overshoot; None without points."""
    points = pareto_table(study, rows)
    if points is None or not points["complete"].any():
        return None
    points = points.filter("complete")
    on_front = points.filter("front")
    factors = [factor.field for factor in varied_factors(study)]
    with plot_style():
        figure = Picture(figsize=(10.0, 4.2))
        for axes, name in zip(figure.subplots(1, 2), PARETO_MEASURES[1:], strict=True):
            axes.plot(points[name], points[PARETO_MEASURES[0]], "o", ms=3, color=GREY, alpha=0.5)
            half = [np.nan_to_num(on_front[f"{key}_half"]) for key in (PARETO_MEASURES[0], name)]
            axes.errorbar(
                on_front[name], on_front[PARETO_MEASURES[0]], *half,
                color=VERMILION, marker="o", ms=4, lw=0, elinewidth=0.9, capsize=2,
            )  # fmt: skip
            axes.set_xlabel(name)
            axes.set_ylabel(PARETO_MEASURES[0])
        if on_front.height <= 24:  # more labels would overlap
            lines = []
            for place, point in enumerate(on_front.iter_rows(named=True), 1):
                for axes, name in zip(figure.axes, PARETO_MEASURES[1:], strict=True):
                    axes.annotate(str(place), (point[name], point[PARETO_MEASURES[0]]), (4, 4),
                                  textcoords="offset points", fontsize=8)  # fmt: skip
                values = (f"{field.split('.')[-1]} {point[field]}" for field in factors)
                lines.append(f"{place}: {', '.join(values)}")
            figure.text(1.0, 0.5, "\n".join(lines), fontsize=7.5, va="center")
        left = rows["point"].n_unique() - points.height
        words = f"; without {left} points that have failed runs" if left else ""
        title = f"Pareto front of all three (red){_interval_caption(study, 'of the mean')}{words}"
        figure.suptitle(title, x=0.01, ha="left")
    return figure


def _effects_caption(study: Study, is_fitted: bool) -> str:
    if not is_fitted:
        return _interval_caption(study, "of each level minus the mean (dotted)")
    words = f"; bars: {CONFIDENCE_LEVEL:.0%} intervals of all levels against the mean (dotted)"
    over = "one seed" if study.repeats == 1 else f"{study.repeats} seeds"
    return f"{words}, over the design and {over}"


def _interval_caption(study: Study, what: str) -> str:
    if study.repeats == 1:
        return "; one repeat has no intervals"
    return f"; bars: {CONFIDENCE_LEVEL:.0%} intervals {what}, over {study.repeats} seeds"
