"""What the methods promise about energy, each at its port, over the worst network that is at hand.

A hand presses deep and slowly, and two packets of five are lost, in bursts of 0.3 s: commands jump,
and with a short time-out the safe state moves them too. `ledger` has its own file.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drake_teleop.channel.network import NetworkConfig
from drake_teleop.comparison.one_dof import (
    ACTUAL,
    COMMAND,
    MOTOR,
    PERIOD,
    REFERENCE,
    OneDofRun,
    run_one_dof,
)
from drake_teleop.passivity.methods import PassivityConfig
from drake_teleop.passivity.tdpa import TdpaConfig

MEDIUM = dataclasses.replace(REFERENCE, hand_mass=0.25, hand_damping=8.0, hand_stiffness=250.0)


def pressed(method: str, seed: int, timeout: float) -> OneDofRun:
    t = np.arange(6000) * PERIOD
    x = 0.055 * (0.45 + 1.5 * np.sin(0.9 * np.pi * t + 1.0))
    x = -0.04 + np.minimum(t / 0.5, 1.0) * (x + 0.04)
    run = run_one_dof(
        MEDIUM, PassivityConfig(method=method),
        NetworkConfig(delay=0.05, jitter=0.5, loss=0.4, burst=0.3),
        seed=seed, timeout=timeout, intent=np.stack([x, np.gradient(x, PERIOD)], axis=1),
    )  # fmt: skip
    assert run.wall.min() < -10.0, "the wall should have been touched"
    return run


@pytest.mark.parametrize(("seed", "timeout"), [(3, 0.1), (4, 1.0)])
@pytest.mark.parametrize("method", ["tdpa", "charged_tdpa"])
def test_tdpa_creates_nothing_at_the_command_and_at_most_a_motion_at_the_slave(
    method, seed, timeout
):
    """A command that jumped, and one that the safe state moved, gave out 0.96 to 1.2 J."""
    run = pressed(method, seed, timeout)
    moving = 0.5 * MEDIUM.force_scale * MEDIUM.slave_mass * TdpaConfig().speed[0] ** 2
    assert run.least(ACTUAL) > -moving
    assert run.least(COMMAND) > -1e-3  # the hand's pair is the held one here


@pytest.mark.parametrize("seed", [1, 3])
def test_tanks_pay_for_a_command_that_jumps(seed):
    """0.18 and 0.33 J were created, by a servo that accelerates more than was assumed."""
    run = pressed("two_layer", seed, 1.0)
    assert run.least(ACTUAL) >= 0.0 and run.least(MOTOR) >= 0.0


@pytest.mark.parametrize(("seed", "timeout"), [(3, 0.1), (4, 1.0)])
def test_set_positions_are_paid_for_at_motor_and_slave(seed, timeout):
    run = pressed("pspm", seed, timeout)
    assert run.least(ACTUAL) >= 0.0 and run.least(MOTOR) >= 0.0


@pytest.mark.parametrize(("seed", "timeout"), [(2, 0.1), (4, 1.0)])
def test_waves_create_nothing_at_the_command(seed, timeout):
    assert pressed("wave", seed, timeout).least(COMMAND) >= -1e-9
