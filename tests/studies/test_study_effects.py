"""Statistics of a study: coverage of intervals, Pareto front, pictures."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.lab.studies.effects import (
    PARETO_MEASURES,
    effect_half_widths_over_seeds,
    is_on_pareto_front,
    main_effects_table,
    means_and_half_widths_over_seeds,
    pareto_table,
)
from drake_teleop.lab.studies.pictures import write_pictures

MEASURES = ["success", *PARETO_MEASURES]
STUDY = Study(
    factors=[
        Factor("force_scaling.sigma", values=[0.0, 0.5, 1.0]),
        Factor("force_scaling.gamma", low=1.0, high=2.0, levels=2),
        Factor("operator.grip", words=["firm"]),
    ],
    repeats=6,
    measures=MEASURES,
)


def table(study: Study = STUDY, failing: int = -1) -> pl.DataFrame:
    """Effort falls with sigma and time rises; gamma has no effect; each seed shifts all points."""
    rows, noise = study.rows(study.points()), np.random.default_rng(0)
    for row in rows:
        sigma, seed = row.get("force_scaling.sigma", 0.0), row["seed"]
        row["success"] = 1.0
        row["effort_Ns"] = 5.0 - 2.0 * sigma + seed + noise.normal(0, 0.1)
        row["task_time_s"] = 1.0 + sigma + noise.normal(0, 0.1)
        row["contact_force_overshoot_N"] = 3.0
        if row["point"] == failing:
            row |= dict.fromkeys(PARETO_MEASURES)
    return pl.DataFrame(rows)


def test_intervals_have_their_coverage():
    """95 % of 2000 studies with 5 seeds contain true mean and true effect."""
    noise, truth = np.random.default_rng(1), np.array([1.0, 2.0, 6.0])
    inside, effect_inside, widths = [], [], []
    for _ in range(2000):
        values = truth[:, None] + noise.normal(0, 3.0, 5) + noise.normal(0, 0.5, (5, 3)).T
        mean, half = means_and_half_widths_over_seeds(values)
        inside.append(np.abs(mean - truth) <= half)
        effect, effect_half = mean - mean.mean(), effect_half_widths_over_seeds(values)
        effect_inside.append(np.abs(effect - (truth - truth.mean())) <= effect_half)
        widths.append(effect_half / half)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)
    assert np.mean(effect_inside) == pytest.approx(0.95, abs=0.01)
    assert np.median(widths) < 0.3  # common shifts of a seed cancel


def test_nan_values_are_ignored():
    values = np.array([[1.0, np.nan, 3.0, 5.0], [np.nan] * 4])
    mean, half = means_and_half_widths_over_seeds(values)
    assert mean[0] == 3.0
    assert np.isnan(mean[1]) and np.isnan(half[1])


def test_effects_equal_the_synthetic_ones():
    found = main_effects_table(STUDY, table())
    assert set(found["factor"]) == {"force_scaling.sigma", "force_scaling.gamma"}
    sigma = found.filter(measure="effort_Ns", factor="force_scaling.sigma")
    np.testing.assert_allclose(sigma["effect"], [1.0, 0.0, -1.0], atol=0.1)
    assert (sigma["effect_half"] < 0.15).all()
    assert (sigma["mean_half"] > 1.0).all()  # seeds differ by 10
    gamma = found.filter(measure="effort_Ns", factor="force_scaling.gamma")
    assert (gamma["effect"].abs() < 2 * gamma["effect_half"]).all()


@pytest.mark.parametrize("failing", [2, 99, 100, 119])
def test_reason_of_any_row_is_in_the_table(failing):
    sigma = Factor("force_scaling.sigma", low=0.0, high=1.0, levels=120)
    study = Study(factors=[sigma], measures=["effort_Ns"])
    found = main_effects_table(study, table(study, failing))
    assert found["why"].is_not_null().arg_true().to_list() == [failing]
    assert found["why"][failing] == "no successful run"


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ([1000001, 1000002.0], ["1000001.0", "1000002.0"]),
        ([0.3, 0.30000001, 2.0], ["0.3", "0.30000001", "2.0"]),
        ([1, 2.5, 1e6], ["1", "2.5", "1e+06"]),
    ],
)
def test_levels_with_different_values_have_different_names(values, names):
    study = Study(factors=[Factor("force_scaling.sigma", values=values)], measures=["effort_Ns"])
    assert main_effects_table(study, table(study))["level"].to_list() == names


@pytest.mark.parametrize("factor", [STUDY.factors[0], STUDY.factors[2]])
def test_table_without_effects_has_its_columns(factor):
    """No run succeeds, or no field varies."""
    study = Study(factors=[factor], measures=["effort_Ns"])
    rows = table(study).with_columns(effort_Ns=pl.lit(None))
    found = main_effects_table(study, rows)
    assert found.is_empty() and found.columns == main_effects_table(STUDY, table()).columns


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4), st.booleans()), max_size=30))
def test_front_contains_the_non_dominated_points(points):
    values = np.array([point[:2] for point in points], dtype=float).reshape(-1, 2)
    complete = np.array([point[2] for point in points], dtype=bool)
    expected = [
        full and not any(
            c and x <= a and y <= b and (x, y) != (a, b) for x, y, c in points
        )
        for a, b, full in points
    ]  # fmt: skip
    assert is_on_pareto_front(values, complete).tolist() == expected


def test_points_with_failures_are_not_on_the_front():
    found = pareto_table(STUDY, table(failing=5))
    assert found["complete"].to_list() == [True] * 5 + [False]
    assert not found["front"][5]
    assert found["front"].sum() >= 3  # one point of each sigma
    assert pareto_table(Study(factors=STUDY.factors, measures=["success"]), table()) is None


@pytest.mark.slow
@pytest.mark.pictures
def test_only_applicable_pictures_are_written(tmp_path):
    (tmp_path / "old.png").touch()
    names = sorted(path.stem for path in write_pictures(STUDY, table(), tmp_path))
    assert names == sorted(["main_effects", "pareto", *(f"interactions_{m}" for m in MEASURES)])
    assert sorted(path.stem for path in tmp_path.glob("*.png")) == names
    alone = Study(factors=STUDY.factors[:1], measures=["success"])
    names = [path.stem for path in write_pictures(alone, table(alone), tmp_path)]
    assert names == ["main_effects"]
    failed = table(alone).with_columns(success=pl.lit(None))
    assert write_pictures(alone, failed, tmp_path) == []


def test_range_of_a_sobol_design_has_equal_parts():
    factor = Factor("force_scaling.gamma", low=1.0, high=2.0)
    study = Study(factors=[factor], design="sobol", samples=16, measures=["success"])
    found = main_effects_table(study, table(study))
    assert found["level"].to_list() == ["1.1", "1.3", "1.5", "1.7", "1.9"]
    assert found["runs"].sum() == 16
    assert found["mean_half"].is_nan().all()  # one repeat
