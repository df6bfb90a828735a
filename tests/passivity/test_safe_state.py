"""Silence and its end: no steps, no replay, recovery."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drake_teleop.lab.comparison.one_dof import (
    PERIOD_S,
    OneDof,
    Task,
    measures_of_run,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.master.phantom import PEAK_FORCE_N
from drake_teleop.station.passivity.memory import WRENCH_LIMIT
from drake_teleop.station.passivity.methods import (
    METHODS,
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    slave_step,
    step_addresses,
)
from drake_teleop.station.passivity.packet import PACKET_SIZE
from drake_teleop.station.passivity.safe_state import RESUME_TIME_S, STOP_TIME_S

TIMEOUT = 0.1
LEDGERS = ("wave", "tdpa")  # all output energy has been received before


def silent(tmp_path, spans: list[tuple[float, float]], delay: float = 0.01) -> NetworkConfig:
    """Return a network that delivers no packets in the spans [s]."""
    rows = ["time,delay", f"0,{delay}"]
    for start, stop in spans:
        rows += [f"{start},", f"{stop},{delay}"]
    rows.append(f"60,{delay}")
    path = tmp_path / "trace.csv"
    path.write_text("\n".join(rows) + "\n")
    return NetworkConfig(trace=str(path))


def run(network: NetworkConfig, method: str, model: OneDof):
    return run_one_dof(model, PassivityConfig(method=method), network, timeout=TIMEOUT)


@pytest.mark.parametrize("method", METHODS)
def test_wrench_has_no_step_at_a_silence_in_contact(tmp_path, method):
    """The hand presses from 6.5 to 11.5 s; no packet arrives from 8 to 9 s."""
    model = OneDof(wall_stiffness=1000.0)
    result = run(silent(tmp_path, [(8.0, 9.0)]), method, model)
    t, felt, command = result.t, result.hand_force, result.command_position
    assert np.abs(felt[(t > 7.5) & (t < 8.0)]).min() > 0.3
    entered = 8.0 + 0.01 + TIMEOUT
    assert np.abs(felt[(t > entered + STOP_TIME_S + 0.01) & (t < 9.0)]).max() < 1e-12
    # The command is at rest soon, and stays.
    at_rest = command[(t > entered + STOP_TIME_S + 0.01) & (t < 9.0)]
    assert np.ptp(at_rest) < 1e-12
    # No signal has a step after the silence.
    resumed = (t > entered) & (t < 11.0)
    assert np.abs(np.diff(felt[resumed])).max() < 0.5
    assert np.abs(np.diff(command[resumed])).max() < 2e-3
    # The state is as before, but pushing back a hand that moved on during the silence requires
    # energy. Methods with an exact ledger have only the received energy, and press the wall less.
    again = (t > 9.0 + RESUME_TIME_S + 1.0) & (t < 11.4)
    tolerance = 0.15 if method in LEDGERS else 0.05
    assert felt[again].mean() == pytest.approx(felt[(t > 7.5) & (t < 8.0)].mean(), rel=tolerance)
    assert np.isfinite(felt).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", [m for m in METHODS if m != "tdpa"])
def test_second_press_is_independent_of_an_earlier_silence(tmp_path, method):
    """The wall is pressed twice; the first time there is silence in the middle.

    TDPA is excluded: the force of its slave depends on the whole history of its ledgers.
    """
    model = OneDof(wall_stiffness=1000.0)
    task = Task()
    intent = np.concatenate([operator_intent(task), operator_intent(task)])
    felt, wall = [], []
    for spans in ([(8.0, 9.0)], []):
        result = run_one_dof(
            model,
            PassivityConfig(method=method),
            silent(tmp_path, spans),
            timeout=TIMEOUT,
            intent=intent,
        )
        second = (result.t > task.end + 9.5) & (result.t < task.end + 11.4)
        felt.append(result.hand_force[second].mean())
        wall.append(result.wall_force[second].mean())
    assert felt[0] == pytest.approx(felt[1], rel=0.02)
    assert wall[0] == pytest.approx(wall[1], rel=0.02)


@pytest.mark.parametrize("method", METHODS)
def test_motion_during_silence_is_not_replayed(tmp_path, method):
    """The hand swings from 0.5 to 3 s; no packet arrives from 1 to 2.5 s."""
    result = run(silent(tmp_path, [(1.0, 2.5)]), method, OneDof())
    t = result.t
    # The speed is at most that of the hand plus that of the missed displacement on the ramp of the
    # resumption, whose steepest rate is 15/8.
    missed = np.ptp(result.master_position)
    fast = np.abs(np.diff(result.master_position)).max()
    fast += 15 / 8 * missed / RESUME_TIME_S * PERIOD_S
    back = ((t > 2.5) & (t < 2.5 + 0.1 + RESUME_TIME_S))[:-1]
    assert np.abs(np.diff(result.slave_position))[back].max() < fast
    if not METHODS[method].balance_at_motors:  # there the command is a force, written as a pose
        assert np.abs(np.diff(result.command_position))[back].max() < fast
    assert np.abs(np.diff(result.command_position)).max() < 5e-3


def rough_network(path: Path, rng: np.random.Generator, until: float = 9.0) -> NetworkConfig:
    """Return a network of jitter, reordering, loss, bursts and silence up to a time [s].

    Its delays are a recorded trace at 1 ms.
    """
    steps = round(until / PERIOD_S)
    mean, jitter = rng.uniform(0.0, 0.15), rng.uniform()
    delay = mean * (1.0 + jitter * rng.uniform(-1.0, 1.0, steps))
    lost = rng.uniform(size=steps) < rng.uniform(0.0, 0.5)
    start = 0.0
    while start < until:  # some bursts exceed the watchdog's time-out
        stop = start + rng.exponential(0.15)
        burst = slice(round(start / PERIOD_S), round(stop / PERIOD_S))
        lost[burst] |= rng.uniform(size=len(lost[burst])) < rng.uniform(0.5, 1.0)
        start = stop + rng.exponential(0.5)
    rows = ["time,delay"]
    for k in range(steps):
        rows.append(f"{k * PERIOD_S:.3f}," + ("" if lost[k] else f"{delay[k]:.6f}"))
    rows += [f"{k * PERIOD_S:.3f},0.01" for k in range(steps, 20000)]
    path.write_text("\n".join(rows) + "\n")
    return NetworkConfig(trace=str(path))


@pytest.fixture(scope="module")
def rough_networks(tmp_path_factory) -> list[tuple[NetworkConfig, NetworkConfig]]:
    """Return a strategy for pairs of directions."""
    rng, folder = np.random.default_rng(5), tmp_path_factory.mktemp("rough")
    lines = [rough_network(folder / f"{i}.csv", rng) for i in range(10)]
    return list(zip(lines[::2], lines[1::2], strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_station_recovers_after_every_rough_network(rough_networks, method):
    """The slave comes to rest at the hand in contact after any network until 9 s."""
    model = OneDof(wall_stiffness=500.0)
    for forward, backward in rough_networks:
        config = PassivityConfig(method=method, force_limit=5.0)
        result = run_one_dof(model, config, forward, backward, timeout=TIMEOUT)
        assert np.isfinite(result.hand_force).all() and np.isfinite(result.command_position).all()
        assert np.abs(result.hand_force).max() <= 5.0 + 1e-12
        found = measures_of_run(result, model)
        assert found.stable, found
        assert abs(found.drift) < 2e-3, found
        assert np.abs(result.hand_force[-1000:]).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_wrench_rises_without_steps_while_resuming(rough_networks, method):
    """The wrench is that of 0.5 s after a silence at the paper's wall, where methods chatter."""
    resumptions = 0
    for forward, backward in rough_networks:
        config = PassivityConfig(method=method)
        result = run_one_dof(OneDof(), config, forward, backward, timeout=TIMEOUT)
        silent, steps = result.time_without_packets[:, 0] > TIMEOUT, np.arange(len(result.t))
        since = steps - np.maximum.accumulate(np.where(silent, steps, -len(steps)))
        resuming = (since > 0) & (since < round(RESUME_TIME_S / PERIOD_S))
        resumptions += int((np.diff(silent.astype(int)) < 0).sum())
        growth = np.diff(np.abs(result.hand_force), prepend=0.0)[resuming]
        assert growth.max(initial=0.0) < 1.001 * PEAK_FORCE_N * PERIOD_S / RESUME_TIME_S
    assert resumptions >= 5


@pytest.mark.parametrize("method", METHODS)
def test_packet_does_not_contain_old_memory(method):
    """The sent packet is finite for any previous content of its memory."""
    p = method_parameters(PassivityConfig(method=method))
    pose = np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    number, still = step_addresses(method), np.zeros(6)
    for step, limits, out in (
        (master_step, [p[WRENCH_LIMIT]], np.zeros(6)),
        (slave_step, [], np.zeros(13)),
    ):
        packet = np.full(PACKET_SIZE, np.nan)
        memory = initial_method_memory(method, p, pose)
        received = np.zeros(PACKET_SIZE)
        motion = (pose, still, still, still, *limits)
        step(number, received, False, *motion, PERIOD_S, p, memory, out, packet)
        assert np.isfinite(packet).all()
