"""`drake-teleop analyze`: the report's figures agree with one another and with a simulation."""

from __future__ import annotations

import json
from dataclasses import replace as replace_fields

import numpy as np
import pytest
from shown import type_in

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis import analyze
from drake_teleop.lab.analysis.maps import stability_map
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import Sampling, sampled_two_port
from drake_teleop.lab.analysis.report import margin_cells, print_tables, verdict_sentences
from drake_teleop.lab.analysis.task_direction import task_direction
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, replace

pytestmark = pytest.mark.slow

PICTURES = ("bode", "nyquist", "passive", "widths", "maps")


@pytest.fixture(autouse=True, scope="module")
def coarse_maps():
    """Use coarse maps: test_maps.py tests them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analyze, "_NUM_POINTS_PER_MAP_AXIS", 12)
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return summary and folder of the command on the paper's contact."""
    folder = tmp_path_factory.mktemp("analyze")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        type_in("docs/analysis.md", "drake-teleop analyze")
    out = folder / "out" / "analysis"
    return json.loads((out / "summary.json").read_text()), out


@pytest.mark.slow
def test_page_contains_all_pictures(run):
    summary, out = run
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png") == len(PICTURES)
    for name in PICTURES:
        assert (out / f"{name}.png").stat().st_size > 10_000
    for sentence in summary["verdict"]:
        assert sentence.split("'")[0][:30] in page


@pytest.mark.slow
def test_diagram_equals_sampled_model_of_one_axis(run):
    """The hand holds all other directions; h11 contains their coupling."""
    assert max(run[0]["two_port"]["sampled"].values()) < 1e-4


@pytest.mark.slow
def test_slowest_motion_agrees_with_one_axis(run):
    """The slowest motion is vertical, and the wrist's coupling changes it by 1 %."""
    for point in run[0]["diagram"]:
        for name in ("decay_1_per_s", "frequency_Hz"):
            assert point[name] == pytest.approx(point["one_axis"][name], rel=0.02)


@pytest.mark.slow
def test_nonlinear_simulation_agrees_with_linearised_diagram(run):
    measured = run[0]["measured"]
    assert max(measured["frequency_Hz"]) > 29.9
    assert measured["greatest_error"] < 0.02 and measured["greatest_error_deg"] < 2.0
    assert min(measured["coherence"]) > 0.95


@pytest.mark.slow
def test_all_stability_figures_are_consistent(run):
    """The linearised Diagram, the margins, the stiffest walls and the maps agree."""
    summary, _ = run
    assert all(point["stable"] for point in summary["diagram"])
    for row in summary["margins"]:
        limit = summary["bounded"]["each"][row["grip"]]
        assert row["stable"] == (limit is None or row["wall_N_per_m"] < limit)
        assert row["stable"] or (row["gain"], row["round_trip_s"]) == (1.0, 0.0)
    # The limit of a range is not above that of its worst member.
    assert summary["bounded"]["grips"] <= 1.02 * min(summary["bounded"]["each"].values())
    (walls,) = (m for m in summary["maps"] if m["x"] == "delay" and m["y"] == "wall_stiffness")
    for grip, limit in summary["bounded"]["each"].items():
        without_delay = [y for x, y in walls["boundary"][grip] if x == 0.0]
        assert without_delay == pytest.approx([limit], rel=0.02)


@pytest.mark.slow
def test_printed_tables_have_units_and_verdict(run, capsys):
    print_tables(run[0], run[1])
    printed = " ".join(capsys.readouterr().out.split())
    assert "[ms]" in printed
    for sentence in run[0]["verdict"]:
        assert f"- {sentence}" in printed


@pytest.mark.slow
def test_the_verdict_follows_the_figures(run):
    summary, _ = run
    assert summary["verdict"] == verdict_sentences(summary)
    for sentence in summary["verdict"]:
        assert len(sentence) <= 100 and sentence.endswith(".") and ". " not in sentence
    other = summary | {"absolute": summary["absolute"] | {"absolutely_stable": True}}
    assert any("stable: no passive" in sentence for sentence in verdict_sentences(other))


def figures(scenario: Scenario, direction: str = "z"):
    return analyze.analyze(scenario, direction)[0]


@pytest.mark.slow
def test_verdict_reports_instability_with_delay_and_light_grip():
    """sigma = 1 is unstable in free motion at round trips between 190 and 339 ms."""
    scenario = replace(
        LoadScenario("free_motion_force"),
        operator__grip="light",
        force_scaling__sigma=1.0,
        channel__delay=0.13,
    )
    found = figures(scenario)
    (free,) = found["diagram"]
    assert not free["stable"] and free["decay_1_per_s"] < 0
    assert any("unstable: motion doubles every" in sentence for sentence in found["verdict"])
    assert found["bounded"]["each"]["light"] == 0.0
    # Without the tool's inertia no delayed force exists.
    (sigmas,) = (m for m in found["maps"] if m["title"] == "Delay and σ, in free motion")
    assert min(sigma for _, sigma in sigmas["boundary"]["light"]) > 0.3


@pytest.mark.slow
def test_verdict_reports_coupled_direction_and_nonlinear_method():
    scenario = replace(
        LoadScenario("free_motion_force"), passivity__method="tdpa", channel__delay=0.01
    )
    found = figures(scenario, "x")
    assert "tdpa is not linear" in found["verdict"][0]
    assert found["direction"] == "x" and found["delay_s"] == 0.01
    # Sideways, contact rotates the tool; the verdict reports that one axis is not valid.
    assert found["two_port"]["sampled"]["h22"] > 0.1
    assert any("is not one axis" in sentence for sentence in found["verdict"])


@pytest.mark.parametrize(("gamma", "sigma"), [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5)])
def test_models_without_displayed_force_have_no_deviation(gamma, sigma):
    axis, sampling = OneAxis(gamma=gamma, sigma=sigma, wall_stiffness=0.0), Sampling()
    with_hand_mass = replace_fields(axis, device_mass=axis.device_mass + axis.hand_mass)
    H = sampled_two_port(with_hand_mass, sampling, analyze.OMEGA)
    found = analyze.two_port_errors_of_axis(H, axis, sampling)
    assert max(found["sampled"].values()) == 0.0
    assert np.isfinite(list(found["closed_form"].values())).all()


@pytest.mark.parametrize(("ahead", "back"), [(0.03, 0.01), (0.005, 0.08), (0.02, 0.02)])
@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_unequal_delays_are_no_deviation_from_one_axis(ahead, back, sigma):
    """Only their sum affects the hand; h12 has the delay back, h21 that of the way ahead."""
    channel = Channel(delay=ahead, backward=NetworkConfig(delay=back))
    scenario = replace(LoadScenario("contact_transition"), channel=channel)
    axis = OneAxis(sigma=sigma, wall_stiffness=0.0, delay=(ahead + back) / 2)
    models = [
        replace_fields(axis, device_mass=axis.device_mass + axis.hand_mass, delay=delay)
        for delay in (axis.delay, 0.0)
    ]
    H, undelayed = (sampled_two_port(model, Sampling(), analyze.OMEGA) for model in models)
    H[:, 0, 1] = undelayed[:, 0, 1] * np.exp(-analyze.J_OMEGA * back)
    H[:, 1, 0] = undelayed[:, 1, 0] * np.exp(-analyze.J_OMEGA * ahead)
    assert (
        max(analyze.two_port_errors_of_axis(H, axis, Sampling())["sampled"].values()) > 0.1
    ) == (ahead != back)
    found = analyze.two_port_errors_of_axis(analyze.with_mean_delays(H, scenario), axis, Sampling())
    assert max(found["sampled"].values()) < 1e-9


@pytest.mark.parametrize(("rate", "low_pass"), [(2000.0, 500.0), (1e4, 4500.0), (2e4, 9500.0)])
def test_rates_of_the_map_increase_for_each_low_pass(monkeypatch, rate, low_pass):
    monkeypatch.setattr(analyze, "_NUM_POINTS_PER_MAP_AXIS", 2)
    maps = analyze.parameter_maps(
        *(OneAxis(wall_stiffness=0.0), OneAxis(), Sampling(rate, rate, rate, low_pass)),
        lambda name: lambda done: None,
    )
    for shown in maps["Rate and stiffness of the wall"].values():
        assert shown.x[0] == pytest.approx(2.4 * low_pass)
        assert shown.x[-1] == pytest.approx(max(4.8 * low_pass, 1e4))


@pytest.mark.parametrize(("delay", "more"), [(0.05, 86.0), (0.22, 63.8), (0.25, 3.8)])
def test_report_states_the_delay_that_may_be_added(delay, more):
    """The longer delays are stable beyond a range of unstable ones."""
    axis = OneAxis(sigma=1.0, wall_stiffness=0.0, delay=delay)
    light = analyze.margin_rows(axis, Sampling(), 0.0)[0]
    assert (light["grip"], light["stable"]) == ("light", True)
    assert float(margin_cells(light, delay)[-1]) == pytest.approx(more, abs=0.1)


@pytest.mark.parametrize(("deviation", "stated"), [(0.09, False), (0.11, True), (1.42, True)])
def test_verdict_names_both_causes_of_a_difference_from_one_axis(deviation, stated):
    fit = {"mass": 0.15, "stiffness": 291.0}
    both = {"felt": fit, "ideal": fit, "unnoticed_to_Hz": 5.0}
    figures = {
        "method": "none",
        "wall_is": "the leaf",
        "diagram": [],
        "margins": [],
        "grip": "firm",
        "direction": "z",
        "two_port": {"sampled": {"h11": 0.0, "h12": deviation}},
        "bounded": {"each": {}, "grips": None},
        "absolute": {"absolutely_stable": True},
        "axis": {"sigma": 0.0},
        "transparency": {"free": both, "wall": both, "tracking_bandwidth_Hz": 14.0},
    }
    text = " ".join(verdict_sentences(figures))
    assert ("Along z the station is not one axis." in text) == stated
    assert ("Contact rotates the tool, or its motion is estimated with a delay" in text) == stated


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("kinematic_scaling__translation_scale", r"^kinematic_scaling\.translation_scale: is 0, "),
        ("force_scaling__force_scale", r"^force_scaling\.force_scale: is 0, "),
    ],
)
@pytest.mark.parametrize("name", ["contact_transition", "free_motion_force"])
def test_scale_of_0_is_refused_before_the_work(monkeypatch, name, field, message):
    monkeypatch.setattr(analyze, "linearize", lambda *_, **__: pytest.fail("too late"))
    with pytest.raises(DrakeTeleopError, match=message):
        analyze.analyze(replace(LoadScenario(name), **{field: 0.0}), progress=False)


def test_eta_raises_because_of_two_sigmas():
    scenario = replace(
        LoadScenario("free_motion_force"),
        force_scaling__sigma=0.0,
        force_scaling__eta=0.5,
        force_scaling__gripper_phi=[1.0, *[0.0] * 9],
    )
    with pytest.raises(DrakeTeleopError, match="eta"):
        figures(scenario)


@pytest.mark.slow
def test_maps_agree_with_new_map_of_the_scenario(run):
    scenario = LoadScenario("contact_transition")
    found = run[0]["maps"][-1]
    axis = task_direction(scenario, (0.0, 0.0, 1.0)).axis
    x, y = (sorted({point[i] for point in found["boundary"]["firm"]}) for i in (0, 1))
    one = stability_map(
        axis,
        analyze.sampling_of_scenario(scenario),
        "rate",
        [x[0], x[-1]],
        "wall_stiffness",
        [100.0, 1e5],
    )
    assert one.stable[0].all() and not one.stable[1].any() and y
