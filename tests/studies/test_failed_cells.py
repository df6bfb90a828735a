"""Effects and pictures of studies with failed runs."""

from __future__ import annotations

import itertools

import numpy as np
import polars as pl
import pytest
from matplotlib.patches import Rectangle
from scipy.special import stdtrit
from scipy.stats import qmc

from drake_teleop.lab.studies import pictures
from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.lab.studies.effects import (
    FactorialModel,
    fill_missing_values,
    main_effects,
    main_effects_table,
    means_and_half_widths_over_seeds,
    pair_means,
)
from drake_teleop.lab.studies.level_model import (
    NO_RUN,
    NO_SUCCESS,
    NOT_COMPARABLE,
    fit_level_model,
    largest_complete_block,
    missing_value_reasons,
)

EFFORT = "effort_Ns"
SIGMAS, GAMMAS = [0.0, 0.1, 0.5, 1.0], [0.25, 1.0, 4.0, 8.0, 16.0]
TOUCH = Study(
    factors=[
        Factor("force_scaling.sigma", values=SIGMAS),
        Factor("force_scaling.gamma", values=GAMMAS),
    ],
    repeats=4,
    measures=[EFFORT],
)


def fails(sigma: float, gamma: float) -> bool:
    """Return failures as in `scaling_touch`: a large gamma needs a large sigma; 16 always fails."""
    return gamma > 8 or sigma < {4.0: 0.5, 8.0: 1.0}.get(gamma, 0.0)


def effort(sigma: float, gamma: float) -> float:
    """Return a nonlinear effort, so that a linear extrapolation is wrong."""
    return 1.0 + 10.0 * sigma**2 / gamma + np.log2(gamma) ** 2


def rows_of(study: Study, noise: float = 0.0) -> pl.DataFrame:
    random, rows = np.random.default_rng(0), study.rows(study.points())
    for row in rows:
        sigma, gamma = row["force_scaling.sigma"], row["force_scaling.gamma"]
        value = effort(sigma, gamma) + 0.3 * row["seed"] + noise * random.normal()
        row[EFFORT] = None if fails(sigma, gamma) else value
    return pl.DataFrame(rows, infer_schema_length=None)


def test_cell_without_successful_run_has_no_value():
    rows = rows_of(TOUCH)
    (pair,) = pair_means(TOUCH, rows, EFFORT)
    expected = [
        [np.nan if fails(s, g) else effort(s, g) + 0.9 for g in GAMMAS] for s in SIGMAS
    ]  # the mean of seeds 0, 2, 4, 6 is 3
    np.testing.assert_allclose(pair.mean, expected)
    assert set(pair.missing_reasons[np.isnan(pair.mean)]) == {NO_SUCCESS}
    assert set(pair.missing_reasons[np.isfinite(pair.mean)]) == {""}


def test_effects_compare_equal_combinations_only():
    found = main_effects(TOUCH, rows_of(TOUCH, noise=0.1), EFFORT)
    sigma, gamma = found["force_scaling.sigma"], found["force_scaling.gamma"]
    # All sigmas have gamma 0.25 and 1; sigma 1 has all successful gammas.
    assert (sigma.num_used_combinations, sigma.num_unused_combinations) == (2, 3)
    assert (gamma.num_used_combinations, gamma.num_unused_combinations) == (1, 3)
    truth = np.array([np.mean([effort(s, g) for g in GAMMAS[:2]]) for s in SIGMAS])
    assert np.all(np.abs(sigma.effect - truth + truth.mean()) <= sigma.effect_half_width)
    assert np.all(np.abs(sigma.mean - truth - 0.9) <= sigma.half_width)
    truth = np.array([effort(1.0, g) for g in GAMMAS[:4]])
    assert np.all(np.abs(gamma.effect[:4] - truth + truth.mean()) <= gamma.effect_half_width[:4])
    assert np.all(gamma.effect_half_width[:4] < 1.0)
    assert gamma.missing_reasons == ["", "", "", "", NO_SUCCESS]
    for figures in (gamma.mean, gamma.half_width, gamma.effect, gamma.effect_half_width):
        assert np.isnan(figures[4])
    assert not gamma.is_fitted


def test_effects_table_lists_excluded_combinations():
    table = main_effects_table(TOUCH, rows_of(TOUCH)).filter(factor="force_scaling.gamma")
    assert table["level"].to_list() == ["0.25", "1", "4", "8", "16"]
    assert table["runs"].to_list() == [16, 16, 8, 4, 0]
    assert table["combinations"].to_list() == [1] * 5
    assert table["left_out"].to_list() == [3] * 5
    assert table["why"].to_list() == [None] * 4 + [NO_SUCCESS]


def test_pictures_hatch_empty_cells_with_a_legend():
    rows = rows_of(TOUCH)
    main, pairs = (
        pictures.draw_main_effects(TOUCH, rows, [EFFORT]),
        pictures.draw_interactions(TOUCH, rows, EFFORT),
    )
    empty = sum(fails(*point) for point in itertools.product(SIGMAS, GAMMAS))
    for figure, hatched in ((main, 1), (pairs, empty)):
        patches = [patch for axes in figure.axes for patch in axes.findobj(Rectangle)]
        assert sum(patch.get_hatch() == "////" for patch in patches) == hatched
        assert [text.get_text() for text in figure.legends[0].get_texts()] == [NO_SUCCESS]
    words = [axes.get_title(loc="right") for axes in main.axes]
    assert words == [
        "over 2 of 5 combinations of the other factors",
        "over 1 of 4 combinations of the other factors",
    ]
    # Only cells with runs have colours.
    assert pairs.axes[0].images[0].get_clim() == pytest.approx((1.9, effort(1.0, 0.25) + 0.9))


def test_largest_comparable_set_of_levels_is_used():
    there = np.array([[1, 1, 0, 0], [1, 1, 1, 1], [0, 0, 1, 0]], dtype=bool)
    rows, columns = largest_complete_block(there)
    assert rows.tolist() == [True, True, False] and columns.tolist() == [True, True, False, False]
    runs, good = np.array([3, 3, 0, 3]), np.array([2, 0, 0, 1])
    compared = np.array([True, False, False, False])
    assert missing_value_reasons(compared, runs, good) == ["", NO_SUCCESS, NO_RUN, NOT_COMPARABLE]


def test_levels_that_never_meet_are_not_compared():
    """One sigma has only small gammas, the other only large ones."""
    factors = [Factor("a.x", values=[0.0, 1.0]), Factor("a.y", values=[0.0, 1.0, 2.0])]
    study = Study(factors=factors, measures=[EFFORT])
    rows = pl.DataFrame(study.rows(study.points()))
    rows = rows.with_columns(
        pl.when((pl.col("a.x") > 0.5) == (pl.col("a.y") > 0.5)).then(1.0).alias(EFFORT)
    )
    found = main_effects(study, rows, EFFORT)["a.x"]
    assert (
        np.isnan(found.effect).all()
        and found.num_used_combinations == 0
        and found.num_unused_combinations == 3
    )
    assert found.missing_reasons == [NOT_COMPARABLE] * 2


def test_intervals_hold_where_some_seeds_of_a_point_are_missing():
    """A point with one run of six is as uncertain as one run."""
    random, inside, narrow = np.random.default_rng(2), [], []
    levels = [np.repeat([0, 1, 2], 2), np.tile([0, 1], 3)]
    seen = np.ones((6, 6), dtype=bool)
    seen[:2, 1:] = False
    for _ in range(40):
        table = random.normal(0, 3.0, 6) + random.normal(0, 0.5, (6, 6))
        table = fill_missing_values(np.where(seen, table, np.nan))
        for which, into in ((seen, inside), (np.ones_like(seen), narrow)):
            found, halves = FactorialModel(levels, [3, 2], which).effects_and_half_widths(table)
            into.append(np.abs(found[0]) <= halves[0])
    assert np.mean(inside) >= 0.9  # 0.95 in the long run
    assert np.mean(narrow) < 0.8


def test_half_widths_equal_least_squares():
    """Reference: regression with a column for each point and each seed."""
    random = np.random.default_rng(4)
    levels = [np.repeat([0, 1, 2], 2), np.tile([0, 1], 3)]
    seen = random.random((6, 4)) < 0.7
    table = fill_missing_values(np.where(seen, random.normal(size=(6, 4)), np.nan))
    design = FactorialModel(levels, [3, 2], seen)
    weights = design.comparison_weights(0)[2]
    weights -= weights.mean(axis=0)
    X = np.hstack([np.repeat(np.eye(6), 4, axis=0), np.tile(np.eye(4), (6, 1))])[seen.ravel()]
    solve = np.linalg.pinv(X)
    y = table.ravel()[seen.ravel()]
    freedom = seen.sum() - 9
    variance = np.sum((y - X @ solve @ y) ** 2) / freedom
    runs = seen.sum(axis=1)
    spread = np.sum((weights @ solve[:6]) ** 2, axis=1) - weights**2 @ ((runs - 1) / 12)
    expected = stdtrit(freedom, 0.975) ** 2 * variance * spread
    found = (
        design.means(table, weights)[1] ** 2
        - means_and_half_widths_over_seeds(weights @ table)[1] ** 2
    )
    assert spread.min() > 0
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_regression_does_not_extrapolate_into_failed_cells():
    factors = [Factor(f"a.{name}", low=0.0, high=1.0) for name in "xy"]
    points = qmc.Sobol(2, seed=np.random.default_rng(0)).random_base2(6)
    known = points[:, 0] - points[:, 1] < 0.4
    value = np.exp(3 * (points[:, 0] - points[:, 1]))[:, None]
    model = fit_level_model(factors, points.T.tolist(), known)
    kept, over, terms = model.comparison_weights(0)
    assert kept.all() and 1 <= over.sum() < 5
    means = model.means(value[known], terms)[0]
    assert value[known].min() < means.min() and means.max() < value[known].max()
    cells, _, terms = model.comparison_weights(0, 1)
    lost = model.excluded_cells[0, 1]
    assert np.argwhere(lost).tolist() == [[2, 0], [3, 0], [3, 1], [4, 0], [4, 1]]
    assert np.array_equal(cells, ~lost.ravel())
    # The edge of failures crosses one cell: one of its four points succeeded.
    x, y = (model.factors[k].index for k in (0, 1))
    assert known[(x == 3) & (y == 1)].sum() == 1


def study_with_gaps(design: str) -> tuple[Study, pl.DataFrame]:
    """Return a study without points in a corner and in some random cells."""
    factors = [Factor(f"a.{name}", low=0.0, high=1.0) for name in "xy"]
    study = Study(factors=factors, design=design, samples=32, objective=EFFORT, measures=[EFFORT])
    points = qmc.Sobol(2, seed=np.random.default_rng(0)).random_base2(5)
    points = points[(points[:, 0] < 0.6) | (points[:, 1] < 0.4)]
    rows = study.rows([{"a.x": x, "a.y": y} for x, y in points.tolist()])
    return study, pl.DataFrame(rows).with_columns((pl.col("a.x") + pl.col("a.y")).alias(EFFORT))


def test_cell_without_point_is_empty_but_does_not_exclude_levels():
    study, rows = study_with_gaps("sobol")
    (pair,) = pair_means(study, rows, EFFORT)
    points = rows.select("a.x", "a.y").to_numpy()
    there = np.histogram2d(*points.T, bins=5, range=[[0, 1], [0, 1]])[0] > 0
    assert 6 < (~there).sum() < 15
    assert np.array_equal(np.isfinite(pair.mean), there)
    assert set(pair.missing_reasons[~there]) == {NO_RUN}
    assert all(
        found.num_unused_combinations == 0 for found in main_effects(study, rows, EFFORT).values()
    )


def test_adaptive_design_has_no_value_in_unsearched_cells():
    study, rows = study_with_gaps("adaptive")
    for found in main_effects(study, rows, EFFORT).values():
        assert found.num_unused_combinations > 0
        shown = np.isfinite(found.effect)
        np.testing.assert_allclose(np.diff(found.mean[shown]), 0.2 * np.diff(np.flatnonzero(shown)))
