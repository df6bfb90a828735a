"""Report: verdicts from numbers, self-contained page."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from drake_teleop.common.style import Picture
from drake_teleop.lab.reproduction.experiments import (
    MotionRun,
    RunsWithAndWithoutContact,
    errors_of_identification,
    largest_raw_force_beyond_free_range,
    true_offsets_and_phi,
)
from drake_teleop.lab.reproduction.report import (
    Comparison,
    compare_with_paper,
    describe_values_outside_ranges,
    figure_captions,
    parameter_rows,
    write_report,
)
from drake_teleop.station.result import Signal, SimulationResult
from drake_teleop.station.scenario import LoadScenario

SUMMARY = {
    "free_force.peak_raw_N": 99.4,
    "free_force.peak_raw_master_N": 5.68,
    "free_force.half_ratio": 0.5003,
    "free_force.residual_max_N": 1.21,
    "ideal.residual_max_N": 3.2e-13,
    "free_torque.peak_raw_Nm": 5.1,
    "free_torque.half_ratio": 0.501,
    "free_torque.residual_max_Nm": 0.071,
    "ideal.residual_max_Nm": 2e-14,
    "contact.true_s": 0.2204,
    "contact.detected_s": 0.2229,
    "contact.raw_detectable": False,
    "contact.false_alarm_0_6_s": False,
    "contact.peak_contact_N": 35.2,
    "contact.peak_inertial_N": 91.0,
    "identification.mass_error_percent": 0.031,
    "identification.com_error_mm": 0.08,
}
TRUE = np.arange(1.0, 17.0)
STD = np.full(16, 0.012)


def write(out, summary=SUMMARY, setup=None) -> str:
    write_report(
        out,
        {"fig6": Picture(figsize=(2, 1))},
        setup=setup or {"Seed": "7"},
        summary=summary,
        parameters=parameter_rows(TRUE, TRUE + 0.01, STD),
    )
    return (out / "report.html").read_text(encoding="utf-8")


def test_only_found_and_reported_values_agree():
    rows = compare_with_paper(SUMMARY)
    verdicts = {row.quantity: row.verdict for row in rows}
    assert set(verdicts.values()) == {"agrees", "as set", "within our bound", "for the record"}
    assert [row.quantity for row in rows if row.verdict == "agrees"] == [
        "Fig. 6: largest residual force, σ = 0",
        "Fig. 8: delay from contact to detection",
        "Fig. 8: raw force exceeds its free range",
        "Fig. 8: false alarm after the contact",
        "Fig. 8: contact / inertial peak force",
    ]
    assert {row.set_or_found for row in rows if row.verdict == "agrees"} == {"found"}
    assert {row.set_or_found for row in rows if row.verdict == "as set"} == {"set"}
    bounded = {row.paper_value for row in rows if row.verdict == "within our bound"}
    assert bounded == {"not reported"}
    assert rows[0].reproduced_value == "99.4 N"
    assert rows[0].accepted_range == "90 to 115 N"


def test_unreported_values_never_agree():
    for origin in ("set", "found"):
        row = Comparison("Mass", "not reported", "0.1 %", origin, "at most 0.2 %", True)
        assert (row.verdict, row.css_class) == ("within our bound", "")


@pytest.mark.parametrize(
    ("name", "value", "what", "verdict"),
    [
        ("free_force.peak_raw_N", 130.0, "peak force at the slave", "not as set"),
        ("free_force.peak_raw_N", float("nan"), "peak force at the slave", "not as set"),
        ("free_force.half_ratio", 0.6, "σ = 0.5 / σ = 1", "not as set"),
        ("free_force.residual_max_N", 5.1, "largest residual force", "differs"),
        (
            "ideal.residual_max_N",
            1e-6,
            "All axes, ideal sensor, true φ: residual f",
            "beyond our bound",
        ),
        (
            "ideal.residual_max_Nm",
            1e-6,
            "All axes, ideal sensor, true φ: residual t",
            "beyond our bound",
        ),
        ("contact.detected_s", 0.2404, "delay from contact to detection", "differs"),
        ("contact.detected_s", 0.2154, "delay from contact to detection", "differs"),
        ("contact.raw_detectable", True, "raw force exceeds", "differs"),
        ("contact.false_alarm_0_6_s", True, "false alarm", "differs"),
        ("contact.peak_contact_N", 90.0, "contact / inertial peak", "differs"),
        ("identification.mass_error_percent", 0.3, "Mass", "beyond our bound"),
    ],
)
def test_each_wrong_value_changes_only_its_own_verdict(name, value, what, verdict, tmp_path):
    wrong = SUMMARY | {name: value}
    (row,) = (row for row in compare_with_paper(wrong) if row.css_class == "differs")
    assert what in row.quantity
    assert row.verdict == verdict
    page = write(tmp_path, wrong)
    assert page.count('class="pill differs"') == 1
    nested: dict[str, dict] = {}
    for full, number in wrong.items():
        part, _, short = full.partition(".")
        nested.setdefault(part, {})[short] = number
    (line,) = describe_values_outside_ranges(nested)
    assert line.startswith(row.quantity) and line.endswith(verdict)


def test_captions_contain_values_of_the_run():
    text = figure_captions(SUMMARY)
    assert "99.4 N" in text["fig6"] and "1.21 N remain" in text["fig6"]
    assert "5.10 N m" in text["fig7"]
    assert "at 220 ms" in text["fig8"] and "2.5 ms after" in text["fig8"]
    assert "no threshold on it separates" in text["fig8"]
    other = figure_captions(
        SUMMARY | {"contact.raw_detectable": True, "contact.false_alarm_0_6_s": True}
    )
    assert "a threshold on it separates" in other["fig8"]
    assert "it also crosses it" in other["fig8"]


def test_parameters_are_printed_with_significant_digits():
    rows = parameter_rows(TRUE, TRUE + 0.01, STD)
    assert (rows[0].symbol, rows[0].index, rows[0].unit) == ("f", "o,x", "N")
    assert (rows[0].true, rows[0].estimate) == ("1.000", "1.010")
    assert (rows[0].error, rows[0].deviation) == ("+0.010", "0.012")
    assert (rows[6].symbol, rows[6].unit, rows[6].true) == ("m", "kg", "7.000")
    # Printed in g m and g m^2.
    assert (rows[7].true, rows[7].error) == ("8000", "+10")
    assert [row.index for row in rows[10:]] == ["xx", "xy", "xz", "yy", "yz", "zz"]


def test_page_is_self_contained(tmp_path):
    page = write(tmp_path)
    sources = re.findall(r'(?:src|href)="([^"]{0,40})', page)
    assert [s for s in sources if not s.startswith("data:image/png;base64,")] == 2 * ["replay.html"]
    assert "http:" not in page and "https:" not in page
    assert "drake_teleop" in page and "Python" in page
    for name in SUMMARY:
        assert f"<code>{name}</code>" in page


def test_page_is_reproducible(tmp_path):
    assert write(tmp_path) == write(tmp_path)
    assert write(tmp_path) != write(tmp_path, SUMMARY | {"free_force.peak_raw_N": 98.0})


def test_text_is_escaped(tmp_path):
    page = write(tmp_path, setup={"Scenario": "<script>alert(1)</script>"})
    assert "<script>" not in page


def test_errors_of_the_identified_load_are_those_of_its_parameters():
    """The estimated tool is 1 % too heavy; its centre of mass is 3 and 4 mm off."""
    scenario = LoadScenario("free_motion_force")
    truth = true_offsets_and_phi(scenario)
    estimate = truth.copy()
    estimate[6] *= 1.01
    estimate[7:10] = 1.01 * truth[7:10] + estimate[6] * np.array([3e-3, 0.0, -4e-3])
    estimate[11] -= 2e-4
    estimate[:6] += [0.3, 0.0, 0.4, 0.0, -0.05, 0.12]
    load = SimpleNamespace(
        estimate=estimate,
        batch=SimpleNamespace(standard_deviations=np.full(16, 0.01), samples=7),
        max_recursive_minus_batch_in_stds=0.0,
        kappa_w10=5.0,
        trajectory=SimpleNamespace(period=8.0),
    )
    found = errors_of_identification(load, scenario)
    assert found["mass_error_percent"] == pytest.approx(1.0)
    assert found["com_error_mm"] == pytest.approx(5.0)
    assert found["inertia_error_max_g_m2"] == pytest.approx(0.2)
    assert (found["offset_error_N"], found["offset_error_Nm"]) == pytest.approx((0.5, 0.13))
    assert found["mass_std_percent"] == pytest.approx(1.0 / estimate[6])


def test_raw_force_is_beyond_its_free_range_on_either_side():
    t = 0.01 * np.arange(10)
    free = np.outer(np.linspace(-1.0, 1.0, 10), [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    measured = np.zeros((10, 6))
    measured[4] = [1.5, -2.75, 0.0, 9.0, 9.0, 9.0]
    touch = np.zeros((10, 6))
    touch[4, 2] = 1.0
    spec = Signal("true_contact_wrench_W", tuple("abcdef"), "N")
    result, scenario = SimulationResult(t, {spec.name: touch}, [spec]), LoadScenario("press")
    runs = (MotionRun(scenario, result, {1.0: wrench}) for wrench in (measured, free))
    run = RunsWithAndWithoutContact(*runs)
    beyond = largest_raw_force_beyond_free_range(run)
    np.testing.assert_allclose(beyond[:2], [0.5, 0.75])
    assert beyond[2] < 0.0
