"""Answer of the scaling study for synthetic rows."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest
from shown import type_in

from drake_teleop.common.files import studies_dir
from drake_teleop.lab.studies import scaling_study
from drake_teleop.lab.studies.scaling_study import (
    CRITERIA_BY_CHOICE,
    TASK_CRITERIA,
    draw_best_scales,
    judge_scales,
)
from drake_teleop.lab.studies.study import LoadStudy
from drake_teleop.station.scenario import ScenarioNames

STUDIES = sorted(path.stem for path in studies_dir().glob("*.yaml"))


def tables(seeds: int = 20, spread: float = 0.05) -> dict[str, dict[str, np.ndarray]]:
    """Effort rises with both scales, force falls with gamma, time has a minimum in the middle."""
    noise = np.random.default_rng(0)
    sigma, gamma = np.meshgrid([0, 0.1, 0.25, 0.5, 1], [0.25, 0.5, 1, 2, 4, 8], indexing="ij")
    means = {
        "effort": 1 + 4 * sigma + 0.2 * gamma,
        "time": 3 + (np.log2(gamma) - 1) ** 2 + sigma,
        "force": 10 / gamma,
    }
    return {
        task: {
            name: means[name][..., None] * (1 + spread * noise.normal(size=(5, 6, seeds)))
            for name in criteria
        }
        | {"success": np.ones((5, 6, seeds))}
        for task, criteria in TASK_CRITERIA.items()
    }


def test_best_point_of_each_selection():
    # Indices of (sigma, gamma).
    for criteria, best in ((("effort",), (0, 0)), (("time",), (0, 3)), (("force",), None)):
        found = judge_scales(tables(), criteria)
        place = np.unravel_index(np.nanargmin(found.merit), found.merit.shape)
        assert place[1] == 5 if best is None else place == best
        assert np.all((found.merit_low <= found.merit) & (found.merit <= found.merit_high))
        assert found.merit[4, 2] == pytest.approx(1.0)  # the reference against itself
        assert found.best_share.sum() == pytest.approx(1.0)
    assert judge_scales(tables(), ("effort",)).best_share[0, 0] > 0.95
    # Without dependence on sigma the choice must be uncertain.
    assert judge_scales(tables(), ("force",)).best_share.max() < 0.95


def test_points_with_many_failures_are_excluded():
    failing = tables()
    failing["press"]["success"][0, 0, :2] = 0.0  # one in ten
    failing["press"]["effort"][0, 0, :2] = np.nan
    found = judge_scales(failing, ("effort",))
    assert np.isnan(found.merit[0, 0])
    assert found.best_share[0, 0] == 0.0


@pytest.mark.parametrize(("failing", "seeds"), [(1, 20), (2, 40), (1, 19), (3, 40)])
def test_one_failure_in_twenty_is_accepted(failing, seeds):
    rows = tables(seeds)
    rows["press"]["success"][0, 0, :failing] = 0.0
    rows["press"]["effort"][0, 0, :failing] = np.nan
    assert np.isfinite(judge_scales(rows, ("effort",)).merit[0, 0]) == (20 * failing <= seeds)


@pytest.mark.parametrize(("failing", "best"), [(2, 1.0), (3, 0.0)])
def test_seeds_with_failed_reference_are_excluded(failing, best):
    rows = tables(seeds=3)
    rows["press"]["success"][4, 2, :failing] = 0.0
    rows["press"]["effort"][4, 2, :failing] = np.nan
    found = judge_scales(rows, ("effort",))
    assert np.isfinite(found.merit_low).sum() == np.isfinite(found.merit).sum() == 29 * best
    assert found.best_share.sum() == pytest.approx(best)


def test_choice_picture_has_one_scale_and_no_empty_cell():
    failing = tables()
    failing["press"]["success"][:2, 0, :3] = 0.0  # three of twenty
    answers = {way: judge_scales(failing, criteria) for way, criteria in CRITERIA_BY_CHOICE.items()}
    sigmas, gammas = [0, 0.1, 0.25, 0.5, 1], [0.25, 0.5, 1, 2, 4, 8]
    figure = draw_best_scales(answers, sigmas, gammas)
    images = [image for axes in figure.axes for image in axes.images]
    assert len(images) == len(CRITERIA_BY_CHOICE)
    assert len({image.norm for image in images}) == 1
    for axes, found in zip(figure.axes, answers.values(), strict=False):
        words = {text.get_position(): text.get_text() for text in axes.texts}
        assert len(words) == found.merit.size
        assert words[0, 0] == words[0, 1] == "15% fail"
        assert words[2, 4].startswith("1.00")  # the reference
        assert np.isfinite(axes.images[0].norm([0.1, 1.0, 10.0])).all()


def test_more_seeds_give_narrower_intervals():
    widths = [np.mean(found.merit_high - found.merit_low) for found in (
        judge_scales(tables(seeds, 0.3), ("effort", "time", "force")) for seeds in (10, 160)
    )]  # fmt: skip
    assert widths[1] < 0.5 * widths[0]


@pytest.mark.parametrize("name", STUDIES)
def test_the_shipped_studies_load(name):
    study = LoadStudy(name)
    assert study.description
    assert study.scenario in ScenarioNames()


def test_shipped_studies_share_their_scales():
    studies = {name: LoadStudy(name) for name in STUDIES}
    assert sum(study.num_points() * study.repeats for study in studies.values()) >= 1000
    scales = [
        [f for f in studies[f"scaling_{task}"].factors if f.field.startswith("force_scaling.")]
        for task in ("touch", "press", "insert", "reach")
    ]
    assert scales[0] == scales[1] == scales[2]
    assert scales[3] == scales[0][:1]


@pytest.mark.slow
@pytest.mark.pictures
def test_scaling_study_command_writes_its_answer(tmp_path, monkeypatch):
    """The rows are synthetic."""

    def fake_rows(name, out, *, repeats, **others):
        study = LoadStudy(name)
        assert repeats is None
        noise, rows = np.random.default_rng(0), study.rows(study.points())
        for row in rows:
            row |= {measure: 1 + noise.random() for measure in study.measures}
            row |= {"success": 1.0, "effort_Ns": 1 + row.get("force_scaling.sigma", 0)}
        (out / "runs.parquet").mkdir(parents=True)
        pl.DataFrame(rows).write_parquet(out / "runs.parquet" / "run_00000000.parquet")

    monkeypatch.setattr(scaling_study, "study_command", fake_rows)
    monkeypatch.chdir(tmp_path)
    type_in("docs/scaling-study.md", "drake-teleop scaling-study")
    out = tmp_path / "out" / "scaling-study"
    summary = json.loads((out / "answer.json").read_text())
    assert summary["runs"] == 12 * (5 + 3 * 30 + 5)
    assert summary["choice"]["effort"]["sigma"] == 0
    assert summary["choice"]["effort"]["merit"] == pytest.approx(0.5)
    assert [row["eta"] for row in summary["eta"]] == [0, 0.25, 0.5, 0.75, 1]
    assert pl.read_csv(out / "answer.csv").height == 4 * 30
    assert (out / "answer.png").exists() and (out / "choice.png").exists()
