"""The whole comparison on a small set: table, page and verdicts."""

from __future__ import annotations

import itertools
import json
import re
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from shown import type_in

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.comparison import compare_passivity as study
from drake_teleop.lab.comparison import whole_station
from drake_teleop.lab.comparison.one_dof import OneDof, Task
from drake_teleop.lab.comparison.report import RUN_COLUMNS, cells_of_run
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.station.channel.network import PRESETS
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.scenario import LoadScenario

pytestmark = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.pictures
def test_comparison_writes_table_and_page(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "WALL_STIFFNESSES_N_M", (5100.0,))
    monkeypatch.setattr(study, "JITTER_AND_LOSS_PAIRS", ((0.0, 0.0),))
    leaves = {"contact": whole_station.LEAF_THICKNESSES_M["contact"]}
    monkeypatch.setattr(whole_station, "LEAF_THICKNESSES_M", leaves)
    monkeypatch.setattr(study, "ROUND_TRIPS_S", (0.01, 0.02, 0.03, 0.1))
    monkeypatch.setattr(
        study,
        "_INJECTED_ENERGY_STUDY_CASES",
        tuple(itertools.product((0.0, 1.0), (0.1,), (0.0, 5e3))),
    )
    # Use the load of the shipped scenario, which other tests have identified.
    task = Task(
        0.1,
        1.1,
        press_start=1.2,
        press_end=2.0,
        release_start=3.0,
        release_end=3.8,
        end=4.8,
        rest_window=0.6,
    )
    monkeypatch.setattr(whole_station, "task_for_round_trip", lambda round_trip: task)
    shipped = LoadScenario("contact_transition")
    monkeypatch.setattr(study, "identified_load", lambda base, stage: identified_load(shipped))
    compare = study.compare_command  # in this process, which has the settings above
    monkeypatch.setattr(
        study, "compare_command", lambda out, **options: compare(out, **(options | {"jobs": 1}))
    )
    monkeypatch.chdir(tmp_path)
    type_in("docs/delay.md", "drake-teleop compare-passivity")
    out = tmp_path / "out" / "passivity"
    summary = json.loads((out / "summary.json").read_text())
    runs = {row["method"]: row for row in summary["station"]}
    # Without a method the wrist oscillates on the leaf.
    assert {name: row["stable"] for name, row in runs.items()} == {"none": False, "tdpa": True}
    assert runs["none"]["turning"] > 2.5e-3 > 10 * runs["tdpa"]["turning"]
    for row in runs.values():
        assert row["hunting"] < 0.1e-3
        assert row["error"] is None
        assert row["felt_share"] == pytest.approx(1.0, abs=0.01)
        assert row["felt_force"] == pytest.approx(row["pressed_force"], rel=0.01)
        assert row["rise_delay"] is None or row["rise_delay"] >= 0.0
        assert row["leaked"] == max(-row["least_energy"], 0.0)
    assert 0.0 <= runs["tdpa"]["left_behind"] == abs(runs["tdpa"]["drift"]) < 0.5e-3
    # A run that is not at rest in its hold ends there.
    assert runs["none"]["left_behind"] is None is runs["none"]["drift"]
    assert cells_of_run(runs["none"])[[key for key, *_ in RUN_COLUMNS].index("left_behind")] == "–"
    assert runs["none"]["leaked"] > 0.3 > 100 * runs["tdpa"]["leaked"]
    # Taps leak, the press does not.
    assert [cell["verdict"] for cell in summary["decision"]] == ["unstable", "leaks"]
    limits = {row["method"]: row["longest_s"] for row in summary["one_dof"]}
    assert limits["none"] == 0.02 < limits["tdpa"]
    injected = {
        (row["sigma"], row["round_trip_s"]): row["damping_Ns_per_m"]
        for row in summary["covering"]
        if row["wall_N_per_m"] == 0
    }
    assert injected[0.0, 0.1] == 0.0 < injected[1.0, 0.1]
    assert pl.read_parquet(out / "runs.parquet").height == 2
    page = (out / "report.html").read_text()
    assert "round trip 1 ms" in page
    # All columns are visible in a window of 1200 px, of which the page uses 944: a letter has about
    # 8.5 px, and a column 11 px to its neighbour. Headings have one line a word.
    assert re.search(r"\nth\.number {[^}]*white-space: normal", page)
    rows = [["charged_tdpa", "Stable", *(heading for _, heading, _, _ in RUN_COLUMNS)]]
    rows += [["four_channel", "yes", *cells_of_run(row)] for row in summary["station"]]
    words = [max(map(len, " ".join(column).split())) for column in zip(*rows, strict=True)]
    assert page.split("</thead>")[0].count("<th") - 1 == len(words)  # <thead> is one of them
    assert sum(8.5 * letters + 11 for letters in words) < 944
    for name in ("decision", "hands", "runs", "energy", "limits"):
        assert (out / f"{name}.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"networks": ["mars"]}, r"networks.*no network 'mars'.*lunar"),
        ({"methods": ["magic"]}, r"methods.*no passivity method 'magic'.*tdpa"),
        ({"methods": []}, "methods: is empty; give"),
        ({"networks": []}, "networks: is empty; give"),
        ({"networks": ["ideal"]}, "networks: method 'none' over network 'ideal' .*; remove"),
        ({"networks": ["lan", "ideal"], "methods": ["tdpa", "none"]}, "networks: .*'ideal'"),
    ],
)
def test_invalid_names_raise(tmp_path, monkeypatch, arguments, message):
    monkeypatch.setattr(study, "_run_longest_round_trip_study", lambda *_: pytest.fail("too late"))
    with pytest.raises(DrakeTeleopError, match=message):
        study.compare_command(tmp_path, **arguments)


def test_comparison_of_a_custom_scenario(monkeypatch, tmp_path):
    """The comparison keeps tool and grip, and uses the rates and leaves of the study."""
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        "{slave: {payload: {mass: 0.3}}, sheet_spring: {}, contact_detection: {},"
        " load_estimator: {enabled: true, method: rtls, watch: true},"
        " simulation: {integrator: runge_kutta2, max_step: 1.0e-4}}"
    )
    bases = []
    monkeypatch.setattr(study, "identified_load", lambda base, stage: SimpleNamespace(estimate=0))
    monkeypatch.setattr(
        study, "_run_in_processes", lambda run, cases, *_: bases.extend(c[0] for c in cases) or []
    )
    study._run_station_study(study.base_scenario(mine, 3), ["lan"], ["none"], 1, lambda name: None)
    base = bases[0]
    assert (base.slave.payload.mass, base.simulation.seed, base.rates) == (
        0.3,
        3,
        study._SAMPLE_RATES,
    )
    assert base.surroundings is None and base.contact_detection is None
    # An estimator would count the contact wrench as load.
    assert base.load_estimator == LoadEstimatorConfig()
    # Steps longer than the events' period avoid extra steps by rounding.
    assert base.simulation.integrator == "runge_kutta3"
    assert base.simulation.max_step > 1.5 / base.rates.hand_hz


@pytest.mark.parametrize(
    ("block", "name"),
    [("kinematic_scaling", "translation_scale"), ("force_scaling", "force_scale")],
)
def test_scale_of_0_is_refused(tmp_path, monkeypatch, block, name):
    monkeypatch.setattr(study, "_run_longest_round_trip_study", lambda *_: pytest.fail("too late"))
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"{{{block}: {{{name}: 0}}}}")
    with pytest.raises(DrakeTeleopError, match=rf"^{block}\.{name}: is 0"):
        study.compare_command(tmp_path / "out", scenario=mine)


@pytest.mark.parametrize(
    ("scenario", "methods", "message"),
    [
        ("{joint_control: {servo: ur_servoj}}", ["none", "ledger"],
         r"^joint_control\.servo: .*; or give `methods` without ledger$"),
        ("{kinematic_scaling: {rotation_scale: 0}}", ["ledger"],
         r"passivity\.method: .* scales.*; or give `methods` without ledger$"),
    ],
)  # fmt: skip
def test_scenario_that_a_method_does_not_support_is_refused(
    tmp_path, monkeypatch, scenario, methods, message
):
    """Else the report would call the method unstable."""
    monkeypatch.setattr(study, "_run_longest_round_trip_study", lambda *_: pytest.fail("too late"))
    mine = tmp_path / "mine.yaml"
    mine.write_text(scenario)
    with pytest.raises(DrakeTeleopError, match=message):
        study.compare_command(tmp_path / "out", scenario=mine, methods=methods)
    assert not (tmp_path / "out").exists()


def test_slip_speed_at_the_leaf_is_the_default(monkeypatch):
    """A tenth of that slip takes seven times the steps in a hold."""
    asked = []

    def refuse(scenario, load_estimate):
        asked.append(scenario)
        raise DrakeTeleopError("no", where="here", remedy="none")

    monkeypatch.setattr(study, "MakeTeleopStation", refuse)
    base = study.base_scenario("contact_transition", 0)
    row, shown = study.simulate_press(base, "tdpa", "lan", "stiff contact", np.zeros(16))
    assert asked[0].sheet_spring.slip_speed == Wall().slip_speed
    assert (row["stable"], shown) == (False, {}) and "no" in row["error"]


def test_preset_networks_have_the_known_delays():
    assert {name: round(2e3 * PRESETS[name].delay) for name in study.NETWORKS} == {
        "lan": 1,
        "wan": 30,
        "internet": 100,
        "geostationary": 600,
        "lunar": 2600,
    }


@pytest.mark.slow
def test_longest_round_trip_is_below_the_first_unstable_one():
    assert (
        study.longest_stable_round_trip("none", OneDof(wall_stiffness=500.0), 0.0, 0.0, [0]) == 1.0
    )
    assert (
        study.longest_stable_round_trip("none", OneDof(wall_stiffness=20000.0), 0.0, 0.0, [0])
        == 0.0
    )


def test_missing_scenario_is_an_error_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(
        study, "_run_longest_round_trip_study", lambda *_: pytest.fail("the work begins")
    )
    with pytest.raises(DrakeTeleopError, match="there is no scenario 'nope'"):
        study.compare_command(tmp_path / "out", scenario="nope", quiet=True)
    assert not (tmp_path / "out").exists()
