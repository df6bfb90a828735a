"""The sheet spring against beam theory."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.operator.operator import MinimumJerk
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation


def leaf(sheet: SheetSpring):
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    sheet.AddTo(plant)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    plant.Finalize()
    return plant, Simulator(builder.Build())


def test_the_default_leaf_is_that_of_the_hardware_notes():
    """210 GPa, 60 x 2 mm, 170 mm long: 5.1 kN/m, 0.16 kg, of which 0.038 kg move."""
    sheet = SheetSpring()
    assert sheet.stiffness == pytest.approx(5129.0, rel=1e-3)
    assert sheet.effective_mass == pytest.approx(0.0377, rel=2e-3)
    assert sheet.max_deflection_of_linear_model == pytest.approx(0.017)


def test_leaf_has_the_frequency_of_its_stiffness_and_mass_and_decays():
    sheet = SheetSpring(thickness=0.001, damping_ratio=0.02)
    plant, simulator = leaf(sheet)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(context, [0.005])
    omega = np.sqrt(sheet.stiffness / sheet.effective_mass)
    damped = omega * np.sqrt(1 - 0.02**2)
    period = 2 * np.pi / damped
    simulator.get_mutable_integrator().set_target_accuracy(1e-9)
    simulator.AdvanceTo(3 * period)
    # Envelope of the free decay after three whole periods.
    expected = 0.005 * np.exp(-0.02 * omega * 3 * period)
    assert plant.GetPositions(context)[0] == pytest.approx(expected, rel=1e-4)


# Down into the leaf by 2 mm in one step, and up again.
STRIKE = [
    MinimumJerk(t_start=0.01, duration=0.14, translation=[0.004, 0.003, -0.058]),
    MinimumJerk(t_start=0.19, duration=0.14, translation=[0.0, 0.0, 0.058]),
]


@pytest.mark.slow
def test_a_contact_at_the_scenarios_step_agrees_with_a_tight_run():
    """RK2 at the sensor's 125 us differs by 8e-7 m from RK3 with error control at half of it."""
    scenario = replace(
        LoadScenario("contact_transition"),
        wrist_sensor__ideal=True,
        simulation__settle=0.0,
        simulation__duration=0.3,
        operator__intent=STRIKE,
        rates__log_hz=8000.0,
        force_scaling__sigma=1.0,  # no identified load is required
    )
    tight = replace(
        scenario,
        simulation__integrator="runge_kutta3",
        simulation__accuracy=1e-8,
        simulation__max_step=1.25e-4 / 2,
    )
    coarse_run, tight_run = (
        simulate(MakeTeleopStation(run), run.simulation) for run in (scenario, tight)
    )
    deflection, expected = coarse_run["sheet_state"][:, 0], tight_run["sheet_state"][:, 0]
    assert expected.min() < -2e-3  # there was a contact
    assert np.abs(deflection - expected).max() < 5e-5
