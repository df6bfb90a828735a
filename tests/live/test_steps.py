import gc
import weakref

import numpy as np
import pytest
from pydrake.symbolic import Variable, if_then_else
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.primitives import SymbolicVectorSystem

from drake_teleop.live.inputs import SLICE_MS
from drake_teleop.live.session import Session, take_short_steps_after_rejection

SHORTEST, TICK = 2.5e-4, 5e-4


def ball_on_spring(max_step: float = TICK) -> Simulator:
    """Return a ball that falls by 1 mm and bounces; its contact vibrates at 700 Hz."""
    x, v = Variable("x"), Variable("v")
    spring = if_then_else(x < 0.0, -((2 * np.pi * 700.0) ** 2) * x, 0.0)
    ball = SymbolicVectorSystem(state=[x, v], dynamics=[v, spring - 9.81])
    simulator = Simulator(ball)
    ResetIntegratorFromFlags(simulator, "runge_kutta3", max_step)
    simulator.get_mutable_integrator().set_target_accuracy(2e-4)
    simulator.get_mutable_context().SetContinuousState([1e-3, 0.0])
    return simulator


def ticks(simulator: Simulator, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of steps taken and rejected in each tick."""
    integrator, counts = simulator.get_integrator(), []
    for k in range(1, number + 1):
        simulator.AdvanceTo(k * TICK)
        rejected = integrator.get_num_step_shrinkages_from_error_control()
        counts.append((integrator.get_num_steps_taken(), rejected))
    taken, rejected = np.diff(counts, axis=0, prepend=0).T
    return taken, rejected


def test_after_a_rejected_step_all_are_short_for_4_ms_and_none_is_rejected():
    simulator = ball_on_spring()
    take_short_steps_after_rejection(simulator, SHORTEST)
    taken, rejected = ticks(simulator, 160)
    hits = np.flatnonzero(rejected)
    assert hits.size > 1  # it fell twice
    for hit in hits:
        np.testing.assert_array_equal(taken[hit : hit + 8], 2)
        np.testing.assert_array_equal(rejected[hit + 1 : hit + 8], 0)
    short = np.arange(160) == 0  # error control begins with a small one
    for hit in hits:
        short[hit : hit + 9] = True
    np.testing.assert_array_equal(taken[~short], 1)
    assert np.count_nonzero(~short) > 80


def test_no_step_is_longer_than_the_scenarios_limit():
    simulator = ball_on_spring(max_step=1e-4)
    take_short_steps_after_rejection(simulator, SHORTEST)
    taken, _ = ticks(simulator, 60)
    assert taken.min() >= 5


def test_monitor_does_not_keep_the_simulator_alive():
    simulator = ball_on_spring()
    take_short_steps_after_rejection(simulator, SHORTEST)
    held = weakref.ref(simulator)
    del simulator
    gc.collect()
    assert held() is None


@pytest.mark.slow
def test_contact_takes_two_steps_a_tick_and_few_rejected_ones(scenario, load):
    session = Session(scenario, load)
    integrator = session._station.simulator.get_integrator()
    pressed, counts = [], []
    while session.ms < 1500:
        down = 0.5 - 0.5 * np.cos(2e-3 * np.pi * session.ms)
        session.apply_inputs(session.inputs.with_changes({"z": round(-4000 * down)}))
        session.advance()
        pressed.append(session.contact_force())
        session.new_rows()
        counts.append(integrator.get_num_derivative_evaluations())
    evaluations = np.diff(counts)[20:]
    ticks_of_slice = SLICE_MS * 1e-3 / TICK
    assert max(pressed) > 0.1
    assert evaluations.min() == 3 * ticks_of_slice
    # Six ticks of two steps, and three rejections; without short steps 96 in all.
    assert 6 * ticks_of_slice <= evaluations.max() <= 6 * ticks_of_slice + 9
