"""Damping for passivity is sufficient and necessary for the hand in simulation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drake_teleop.lab.comparison import one_dof
from drake_teleop.lab.comparison.one_dof import PERIOD_S, OneDof, damping_for_passivity, run_one_dof
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.methods import PassivityConfig

#: A hand that forces its motion on the device, which has no friction.
FIRM = OneDof(hand_stiffness=2e5, hand_damping=500.0, device_friction=0.0)


def hand_work(model: OneDof, round_trip: float, frequency: float, damping: float) -> float:
    """Return the energy from hand and damping over whole periods of a small oscillation [J].

    The swing is around a point in the wall, or far from it if there is no wall.
    """
    t = np.arange(12000) * PERIOD_S
    fade = np.minimum(t / 2.0, 1.0)
    rest = 0.02 if model.wall_stiffness else -0.5
    x = rest + 1e-3 * fade * np.sin(2 * np.pi * frequency * t)
    intent = np.stack([x, np.gradient(x, PERIOD_S)], axis=1)
    run = run_one_dof(model, PassivityConfig(), NetworkConfig(delay=round_trip / 2), intent=intent)
    periods = np.floor(6.0 * frequency)
    last = slice(len(t) - 1 - round(periods / frequency / PERIOD_S), len(t))
    moved = np.diff(run.master_position[last])
    return float(-np.sum(run.hand_force[last][:-1] * moved) + damping * np.sum(moved**2) / PERIOD_S)


@pytest.mark.slow
@pytest.mark.parametrize("wall", [0.0, 5100.0])
@pytest.mark.parametrize("round_trip", [0.02, 0.1])
def test_damping_for_passivity_compensates_the_energy_of_the_delay(wall, round_trip):
    model = dataclasses.replace(FIRM, wall_stiffness=wall, sigma=1.0)
    damping = damping_for_passivity(model, round_trip)
    # At a wall the worst frequency is nearly 0, which takes too long to simulate.
    worst = one_dof._IMPEDANCE_FREQUENCIES_RAD_S[
        np.argmin(one_dof._displayed_impedance_real_part(model, round_trip))
    ]
    frequency = max(worst / (2 * np.pi), 0.5)
    assert damping > 1.0
    without = hand_work(model, round_trip, frequency, 0.0)
    assert without < 0.0
    assert hand_work(model, round_trip, frequency, damping) == pytest.approx(
        0.0, abs=0.05 * abs(without)
    )


def test_damping_for_passivity_in_free_motion_is_proportional_to_sigma():
    free = dataclasses.replace(FIRM, wall_stiffness=0.0)
    needed = [
        damping_for_passivity(dataclasses.replace(free, sigma=s), 0.1) for s in (0.0, 0.5, 1.0)
    ]
    assert needed[0] == 0.0
    assert needed[2] == pytest.approx(2 * needed[1])


def test_damping_for_passivity_at_a_wall_is_stiffness_times_delay():
    """Re K e^(-j w R) / (j w) = -K R sin(w R) / (w R), which is -K R at w = 0."""
    model = OneDof(ideal_servo=True, sigma=0.0)
    needed = damping_for_passivity(model, 0.1)
    assert needed == pytest.approx(5100 / 17.5 * (0.1 + 1.5 * PERIOD_S), rel=1e-3)
