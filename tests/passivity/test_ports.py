"""Energy limits of the methods at each port over a network with long bursts of loss.

A hand presses deep and slowly, and two packets of five are lost, in bursts of 0.3 s: commands jump,
and with a short time-out the safe state moves them too. Limits at the slave's command are also
tested in six degrees of freedom with arbitrary motion and wrenches. `ledger` has its own file.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_methods import START, energy_balance, line, poses, run, wrenches

from drake_teleop.lab.comparison.one_dof import (
    AT_COMMAND,
    AT_MOTOR,
    AT_SLAVE,
    PERIOD_S,
    REFERENCE_ONE_DOF,
    OneDofRun,
    Task,
    measures_of_run,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.energy import port_work
from drake_teleop.station.passivity.force_limit import ForceLimitConfig
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.passivity.packet import CUMULATIVE_ENERGY, pose_difference_into
from drake_teleop.station.passivity.tdpa import TdpaConfig
from drake_teleop.station.passivity.wave import WaveConfig

MEDIUM = dataclasses.replace(
    REFERENCE_ONE_DOF, hand_mass=0.25, hand_damping=8.0, hand_stiffness=250.0
)


def press_deeply(method: str, seed: int, timeout: float) -> OneDofRun:
    t = np.arange(6000) * PERIOD_S
    x = 0.055 * (0.45 + 1.5 * np.sin(0.9 * np.pi * t + 1.0))
    x = -0.04 + np.minimum(t / 0.5, 1.0) * (x + 0.04)
    found = run_one_dof(
        MEDIUM, PassivityConfig(method=method),
        NetworkConfig(delay=0.05, jitter=0.5, loss=0.4, burst=0.3),
        seed=seed, timeout=timeout, intent=np.stack([x, np.gradient(x, PERIOD_S)], axis=1),
    )  # fmt: skip
    assert found.wall_force.min() < -10.0, "the wall should have been touched"
    return found


def burst_line(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Return newest packets as `line`, with gaps of up to 0.15 s."""
    newest = line(rng, steps)
    for way in newest:
        for start in range(0, steps, 250):
            way[start : start + rng.integers(10, 150)] = way[start]
        np.maximum.accumulate(way, out=way)
    return newest


@pytest.mark.parametrize("method", ["wave", "tdpa", "charged_tdpa"])
def test_backward_pair_creates_no_energy_between_hand_and_command(method):
    """The balance holds for each group; the wrench is limited and does not fade."""
    rng, steps = np.random.default_rng(7), 3000
    config = PassivityConfig(
        method=method,
        force_limit=3.0,
        torque_limit=0.05,
        retreat=[1e3, 1e3],
    )
    master, f_e = poses(rng, steps), wrenches(rng, steps)
    wrench, command, _, dx, _ = run(
        method, config, master, poses(rng, steps), f_e, burst_line(rng, steps)
    )
    step = np.zeros(6)
    energy = np.zeros((steps, 2))
    for k in range(1, steps):
        pose_difference_into(command[k, :7], command[k - 1, :7], step)
        into = f_e[k] * step - wrench[k] * dx[0, k]
        energy[k] = energy[k - 1] + [into[:3].sum(), into[3:].sum()]
    assert (energy.max(0) > [1e-2, 1e-4]).all(), "somebody should have put something in"
    assert (energy.min(0) >= -1e-12).all()


@pytest.mark.parametrize(("seed", "timeout"), [(3, 0.1), (4, 1.0)])
@pytest.mark.parametrize("method", ["tdpa", "charged_tdpa"])
def test_tdpa_creates_at_most_the_kinetic_energy_at_the_slave(method, seed, timeout):
    """A jump of the command, and one by the safe state, released 0.96 to 1.2 J."""
    found = press_deeply(method, seed, timeout)
    moving = 0.5 * MEDIUM.force_scale * MEDIUM.slave_mass * TdpaConfig().speed[0] ** 2
    assert found.least_energy_sum(AT_SLAVE) > -moving
    assert found.least_energy_sum(AT_COMMAND) > -1e-3  # the hand's pair is the held one here


def test_wave_end_releases_only_received_energy():
    """Energy from hand, command and network is stored, sent or lost.

    This balance detects every wave without received energy; the balance of the ports requires a
    motion that extracts it.
    """
    rng, steps = np.random.default_rng(7), 3000
    config = PassivityConfig(
        method="wave", force_limit=3.0, torque_limit=0.05, retreat=[1e3, 1e3],
        wave=WaveConfig(drift_rate=0.0),  # its steps add energy
    )  # fmt: skip
    master, f_e = poses(rng, steps), wrenches(rng, steps)
    wrench, command, *_, memory = run(
        "wave", config, master, poses(rng, steps), f_e, burst_line(rng, steps)
    )
    at_hand = -port_work(wrench, master, "backward")[-1]
    at_command = port_work(f_e, command[:, :7], "backward")[-1]
    for put_in, end in zip((at_hand, at_command), map(energy_balance, memory), strict=True):
        assert (end.received > 1e-3).all() and (end.stored >= 0.0).all()
        kept = end.stored + end.sent + end.lost
        np.testing.assert_allclose(put_in + end.received, kept, rtol=1e-9)


def test_tdpa_repays_the_energy_of_a_tap():
    """Taps of 50 mm at 2 Hz over 100 ms: 0.16 J in 4 s if it sends before it repays."""
    t = np.arange(4000) * PERIOD_S
    x = 0.05 * np.sin(4.0 * np.pi * t) * np.minimum(t / 0.5, 1.0)
    found = run_one_dof(
        REFERENCE_ONE_DOF, PassivityConfig(method="tdpa"), NetworkConfig(delay=0.05),
        intent=np.stack([x, np.gradient(x, PERIOD_S)], axis=1),
    )  # fmt: skip
    assert found.wall_force.min() < -10.0, "the wall should have been touched"
    assert found.least_energy_sum(AT_SLAVE) > -0.06


@pytest.mark.parametrize("method", ["tdpa", "charged_tdpa"])
def test_tdpa_repays_a_deficit_before_it_sends(method):
    """The slave goes 30 mm into a wall that pushes with 2 N, and is pushed 60 mm out again.

    The hand supplies little energy: in a whole run the drag of `charged_tdpa` would hide a lost
    deficit.
    """
    steps = 900
    master, slave = np.tile(START, (2, steps, 1))
    slave[:, 6] += 1e-4 * (np.abs(np.arange(steps) - 300) - 300)
    master[300:, 6] += 0.1  # out, so that command and slave do the same work
    wrench = np.tile([0.0, 0.0, 2.0, 0.0, 0.0, 0.0], (steps, 1))
    to_the_slave_alone = np.stack([np.arange(steps) - 1, np.full(steps, -1)])
    _, _, packets, dx, _ = run(
        method, PassivityConfig(method=method), master, slave, wrench, to_the_slave_alone
    )
    put_in, (paid, sent) = np.cumsum(2.0 * dx[1, :, 2]), packets[:, :, CUMULATIVE_ENERGY][..., 0]
    assert put_in.min() == pytest.approx(-0.06) and put_in[-1] > 0.059 > 4.0 * paid[-1]
    np.testing.assert_allclose(sent[1:], np.maximum(put_in[1:] + paid[:-1], 0.0), atol=1e-12)


@pytest.mark.parametrize("seed", [1, 3])
def test_tanks_cover_a_jump_of_the_command(seed):
    """Energy of 0.18 and 0.33 J was created without the servo's own acceleration."""
    found = press_deeply("two_layer", seed, 1.0)
    assert found.least_energy_sum(AT_SLAVE) >= 0.0 and found.least_energy_sum(AT_MOTOR) >= 0.0


@pytest.mark.parametrize(("seed", "timeout"), [(3, 0.1), (4, 1.0)])
def test_set_position_modulation_creates_no_energy_at_motor_and_slave(seed, timeout):
    found = press_deeply("pspm", seed, timeout)
    assert found.least_energy_sum(AT_SLAVE) >= 0.0 and found.least_energy_sum(AT_MOTOR) >= 0.0


@pytest.mark.parametrize(("seed", "timeout"), [(2, 0.1), (4, 1.0)])
def test_waves_create_no_energy_at_the_command(seed, timeout):
    assert press_deeply("wave", seed, timeout).least_energy_sum(AT_COMMAND) >= -1e-9


def test_force_limit_bounds_the_rendered_force():
    """The bound is reached: the wall's force is twice as large."""
    found = press_deeply("force_limit", 2, 1.0)
    limit = ForceLimitConfig().force
    assert MEDIUM.force_scale * np.abs(found.wall_force).max() > 2.0 * limit
    assert np.abs(found.hand_force).max() == pytest.approx(limit, rel=1e-12)
    assert found.least_energy_sum(AT_SLAVE) < -0.01


def test_four_channels_are_transparent_without_delay():
    """Rendered and contact force are equal, positions too, although the servo yields."""
    task = Task(
        press_start=0.5, press_end=1.5, release_start=4.0, release_end=5.0, end=6.0, rest_window=1.0
    )
    found = run_one_dof(
        MEDIUM, PassivityConfig(method="four_channel"), NetworkConfig(),
        intent=operator_intent(task), timeout=1.0,
    )  # fmt: skip
    assert abs(measures_of_run(found, MEDIUM, task).force_error) < 0.02
    held = slice(3500, 3900)
    assert found.wall_force[held].mean() / MEDIUM.servo_stiffness < -2e-4
    np.testing.assert_allclose(found.slave_position[held], found.master_position[held], atol=1e-6)
