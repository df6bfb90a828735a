"""Effects of unbalanced designs: coverage of the intervals."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from scipy.stats import qmc

from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.lab.studies.effects import main_effects, main_effects_table, pair_means
from drake_teleop.lab.studies.level_model import factor_levels, fit_level_model

UNIT = [Factor(f"a.{name}", low=0.0, high=1.0) for name in "xyz"]
EDGES = np.linspace(0.0, 1.0, 6)


def true_function(points):
    """Function linear in x, quadratic in y, with their product; independent of z."""
    x, y, _ = points.T
    return 5 * x + np.sin(5 * y) + 3 * x * y


def true_effects() -> list[np.ndarray]:
    """Return the means of `true_function` over each fifth of each factor, minus the mean of all."""
    middles = (EDGES[1:] + EDGES[:-1]) / 2 - 0.5
    bent = -np.diff(np.cos(5 * EDGES)) / 5 / np.diff(EDGES)
    return [6.5 * middles, bent - bent.mean() + 1.5 * middles, np.zeros(5)]


def true_effects_with_a_corner_missing() -> list[np.ndarray]:
    """Return effects of x over the fifths of y without failures, and vice versa."""
    middles = (EDGES[1:] + EDGES[:-1]) / 2 - 0.5
    x, y, z = true_effects()
    return [x + 3 * (0.7 - 0.5) * middles, y + 3 * (0.3 - 0.5) * middles, z]


@pytest.mark.slow
@pytest.mark.parametrize("corner", [False, True])
@pytest.mark.parametrize(("noise", "seeds"), [(0.0, 1), (0.5, 3)])
def test_all_effects_are_in_their_intervals_in_nine_of_ten_sobol_designs(noise, seeds, corner):
    random = np.random.default_rng(0)
    truth = true_effects_with_a_corner_missing() if corner else true_effects()
    inside, plain, null = [], [], []
    for draw in range(200):
        points = qmc.Sobol(3, seed=np.random.default_rng(draw)).random_base2(6)
        table = true_function(points)[:, None] + random.normal(0, 1.0, seeds)  # shift of a seed
        table = table + random.normal(0, noise, table.shape)
        known_there = ~(corner & (points[:, 0] > 0.6) & (points[:, 1] < 0.4))
        model = fit_level_model(UNIT, points.T.tolist(), known_there)
        found, halves = model.effects_and_half_widths(table[known_there])
        near = [
            len(a) == len(b) and np.all(np.abs(a - b) <= h)
            for a, b, h in zip(found, truth, halves, strict=True)
        ]
        inside.append(all(near))
        cells = [table[known_there & (model.factors[2].index == k)].mean() for k in range(5)]
        plain.append(np.ptp(cells))
        null.append(np.ptp(found[2]))
    assert np.mean(inside) >= 0.9
    # The intervals are not trivially wide: an irrelevant factor shows less than in plain means.
    assert np.median(null) < 0.5 * np.median(plain)


def fake_rows(study: Study, value, fields=("a.x", "a.y", "a.w")) -> pl.DataFrame:
    rows = study.rows(study.points())
    for row in rows:
        row["hand_work_J"] = value(*(row[field] for field in fields), row["seed"])
    return pl.DataFrame(rows, infer_schema_length=None)


def sobol(samples: int, repeats: int = 1, seed: int = 0) -> Study:
    words = Factor("a.w", words=["ideal", "real", "other"])
    return Study(
        factors=[*UNIT[:2], words], design="sobol", samples=samples, repeats=repeats, seed=seed,
        measures=["hand_work_J"],
    )  # fmt: skip


def force(x, y, word, seed):
    """The third factor contributes 0.02 N, the others 6 N."""
    return 6 * x * (1 + y) + np.sin(5 * y) + 0.02 * (word == "real") + 0.1 * seed


def test_irrelevant_factor_has_no_significant_effect():
    """Plain means of its three levels differ by 2.2 N, because x and y differ."""
    study = sobol(32, repeats=2, seed=104)
    rows = fake_rows(study, force)
    plain = rows.group_by("a.w").agg(pl.col("hand_work_J").mean())["hand_work_J"].to_numpy()
    found = main_effects(study, rows, "hand_work_J")
    word = found["a.w"]
    assert word.level_names == ["ideal", "real", "other"]
    assert np.ptp(plain) > 2.0
    assert np.ptp(word.effect) < 0.1
    assert np.all(
        np.abs(word.effect - np.array([-0.02, 0.04, -0.02]) / 3) <= word.effect_half_width
    )
    # The effects of the others are visible; x is strongest at its ends.
    assert np.all(np.abs(found["a.x"].effect) > found["a.x"].effect_half_width)


def test_intervals_contain_seed_dependent_effects():
    study = sobol(64, repeats=3)
    alike = main_effects(study, fake_rows(study, force), "hand_work_J")
    rows = fake_rows(study, lambda x, y, w, seed: force(x, y, w, seed) + seed * x)
    apart = main_effects(study, rows, "hand_work_J")
    assert apart["a.x"].effect_half_width[0] > 5 * alike["a.x"].effect_half_width[0]
    assert apart["a.y"].effect_half_width[0] < 1.5 * alike["a.y"].effect_half_width[0]


def test_exact_fit_has_a_width_of_rounding():
    study = sobol(64)
    found = main_effects(study, fake_rows(study, lambda x, y, w, seed: 3 * x), "hand_work_J")
    for name, truth in (("a.x", 3 * np.array([-0.4, -0.2, 0, 0.2, 0.4])), ("a.y", np.zeros(5))):
        assert np.all(np.abs(found[name].effect - truth) <= found[name].effect_half_width)
        assert np.all(found[name].effect_half_width < 1e-8)


def test_failed_point_does_not_change_other_effects():
    factors = [Factor("a.x", values=[0.0, 1.0, 4.0]), Factor("a.y", values=[1.0, 2.0, 3.0, 5.0])]
    study = Study(factors=factors, repeats=2, measures=["hand_work_J"])
    rows = fake_rows(study, lambda x, y, seed: 2.0 * x + 10.0 * y + seed, ("a.x", "a.y"))
    whole = main_effects_table(study, rows)
    broken = rows.with_columns(
        hand_work_J=pl.when(pl.col("point").is_in([0, 5])).then(None).otherwise("hand_work_J")
    )
    np.testing.assert_allclose(
        main_effects_table(study, broken)["effect"], whole["effect"], atol=1e-9
    )
    assert main_effects_table(study, broken)["runs"].sum() == 2 * (24 - 4)
    # One run of a point; the weight of its seed does not change.
    broken = rows.with_columns(
        hand_work_J=pl.when(pl.col("run") == 3).then(None).otherwise("hand_work_J")
    )
    np.testing.assert_allclose(main_effects_table(study, broken)["mean"], whole["mean"], atol=1e-9)


def test_pair_means_equal_the_function():
    study = sobol(64)
    rows = fake_rows(study, lambda x, y, w, seed: 8 * x * y + (3 * y if w == "real" else 0))
    pairs = {found.fields: found for found in pair_means(study, rows, "hand_work_J")}
    assert len(pairs) == 3
    x, y = np.meshgrid(*(2 * [(EDGES[1:] + EDGES[:-1]) / 2]), indexing="ij")
    np.testing.assert_allclose(pairs["a.x", "a.y"].mean, 8 * x * y + y, atol=1e-9)
    expected = np.column_stack([4 * y[0], 7 * y[0], 4 * y[0]])
    np.testing.assert_allclose(pairs["a.y", "a.w"].mean, expected, atol=1e-9)
    few = sobol(16)
    assert pair_means(few, fake_rows(few, force), "hand_work_J") == []


def test_too_few_points_give_no_effects():
    study = sobol(2)
    found = main_effects(study, fake_rows(study, force), "hand_work_J")
    assert all(np.isnan(one.effect).all() for one in found.values())
    nothing = fake_rows(study, lambda *_: None)
    assert main_effects(study, nothing, "hand_work_J") == {}


def test_words_without_run_are_not_levels():
    factor = Factor("a.w", words=["a", "b", "c"])
    assert factor_levels(factor, ["c", "a", "c"]).names == ["a", "c"]
