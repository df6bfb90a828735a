"""docs/analysis.md: its scripts run; its tables equal their output or the Diagram's values."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drake_teleop.lab.analysis.absolute_stability import (
    impedance_range_of_grips,
    required_damping,
    stiffness_limit,
)
from drake_teleop.lab.analysis.cut_loop import count_unstable_multipliers, cut_loop
from drake_teleop.lab.analysis.linear_model import COMPONENT_NAMES
from drake_teleop.lab.analysis.linearization import linearize, two_port_along
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import Sampling, sampled_two_port
from drake_teleop.lab.analysis.task_direction import OneAxisFromScenario, task_direction
from drake_teleop.lab.analysis.two_port import absorb_impedances, hybrid_matrix
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.scenario import replace as with_values

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "analysis.md").read_text(encoding="utf-8")
MARGINS, IN_PYTHON, DIAGRAM = re.findall("```python\n(.*?)```", TEXT, re.S)
UP = (0.0, 0.0, 1.0)


def rows(heading: str) -> list[list[str]]:
    """Return the cells of the table with this heading."""
    _, table = TEXT.split(f"| {heading} |", 1)
    lines = table.split("\n\n", 1)[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def axis_of(grip: str) -> OneAxis:
    scenario = LoadScenario("contact_transition")
    scenario.operator.grip = grip
    return OneAxisFromScenario(scenario, UP)


def test_table_of_margins_equals_output_of_its_script(capsys):
    exec(compile(MARGINS, "analysis.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert [line for line in TEXT.splitlines() if line in printed] == printed
    assert len(rows("grip | wall, kN/m")) == len(printed) == 12


def test_functions_work_as_shown():
    names: dict = {}
    exec(compile(IN_PYTHON, "analysis.md", "exec"), names)
    assert not names["is_robust"]
    assert 0 < names["softest"] < np.inf
    assert names["frd"].omega[-1] == pytest.approx(200 * np.pi)


@pytest.mark.slow
def test_diagram_works_as_shown():
    # The script identifies this estimate, which takes some seconds.
    shown = 'dt.identify_load(dt.LoadScenario("identification")).estimate'
    assert shown in DIAGRAM
    true = np.concatenate([np.zeros(6), slave_arm(LoadScenario("free_motion_force")).phi_load])
    true.flags.writeable = False  # like the identified estimate
    names: dict = {"true": true}
    exec(compile(DIAGRAM.replace(shown, "true"), "analysis.md", "exec"), names)
    assert abs(names["closed"].multipliers[0]) < 1
    assert names["H"].shape == (50, 2, 2)


@pytest.fixture(scope="module")
def diagrams():
    """Return sensor -> (omega, H of the Diagram with the hand's mass, its axis, its rates)."""
    omega, found = 2 * np.pi * np.geomspace(0.1, 300.0, 500), {}
    for sensor, name in (("real", "contact_transition"), ("ideal", "ideal_sensor")):
        scenario = with_values(LoadScenario(name), sheet_spring=None, force_scaling__sigma=0.0)
        scenario.operator.grip = "firm"
        along = task_direction(scenario, UP)
        estimate = np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])
        cut = linearize(scenario, load_estimate=estimate)
        others = [axis for axis in COMPONENT_NAMES if axis != "z"]
        system = cut.close_loop(
            [f"operator_wrench.{axis}" for axis in others],
            [f"hand_wrench.{axis}" for axis in others],
        )
        system = system.close_loop("pose_command", "pose_received").close_loop(
            "wrench_B", "wrench_received"
        )
        H = two_port_along(system, omega, along.hand, along.tool)
        low_pass = None if sensor == "ideal" else scenario.wrist_sensor.bandwidth_hz
        found[sensor] = omega, H, along.axis, Sampling(low_pass_hz=low_pass)
    return found


@pytest.mark.slow
def test_deviations_of_the_models_from_the_diagram(diagrams):
    for model, sensor, *said in rows("model | sensor"):
        omega, H, axis, sampling = diagrams[sensor]
        band = omega <= 2 * np.pi * 30
        omega, H = omega[band], H[band]
        axis = replace(axis, device_mass=axis.device_mass + axis.hand_mass)
        other = (
            hybrid_matrix(axis, 1j * omega)
            if model == "closed form"
            else sampled_two_port(axis, sampling, omega)
        )
        off = 100 * np.abs(H - other).max(axis=0) / np.abs(other).max(axis=0)
        np.testing.assert_allclose(off.ravel(), [float(x) for x in said], atol=0.01, rtol=0.01)


@pytest.mark.slow
def test_lacking_damping_and_stiffness_limit_of_the_grips(diagrams):
    omega, H, axis, _ = diagrams["real"]
    H = absorb_impedances(H, hand=-1j * omega * axis.hand_mass)
    (damping,) = re.findall(r"lacks\s(\d+) N s/m", TEXT)
    assert required_damping(H).max() == pytest.approx(float(damping), rel=0.01)
    (limit,) = re.findall(r"at\swalls\sup\sto\s([\d.]+) kN/m", TEXT)
    softest = stiffness_limit(H, omega, impedance_range_of_grips()).min()
    assert softest == pytest.approx(1e3 * float(limit), rel=0.01)


@pytest.mark.slow
def test_bounds_on_mass_errors():
    error, sampling = np.arange(0.0, 14.0, 0.01), Sampling(low_pass_hz=500.0)
    for grip, *said in rows("grip | bound, kg"):
        axis = axis_of(grip)
        m, b = axis.hand_mass + axis.device_mass, axis.hand_damping + axis.device_damping
        k = axis.hand_stiffness
        wrong = replace(axis, wall_stiffness=0.0, wall_damping=0.0, mass_error=error)
        unstable = count_unstable_multipliers(cut_loop(wrong, sampling), 0.0) > 0
        found = [
            m / (axis.force_scale * axis.position_scale),
            error[np.argmax(unstable)],
            b * np.sqrt(m / k - b**2 / (4 * k**2)) / axis.force_scale,
        ]
        np.testing.assert_allclose(found, [float(x) for x in said], atol=0.06)
