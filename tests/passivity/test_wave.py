"""The wave line against its closed forms (Niemeyer and Slotine 1991), with T half of the RTT."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.station.passivity.memory import (
    CHANNEL_FILL_TIME_LEFT,
    RECEIVED_ENERGY,
    STORED_ENERGY,
    WRENCH_LIMIT,
)
from drake_teleop.station.passivity.methods import (
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    slave_step,
    step_addresses,
)
from drake_teleop.station.passivity.packet import (
    CUMULATIVE_ENERGY,
    METHOD_VALUES,
    PACKET_SIZE,
    POSE,
)
from drake_teleop.station.passivity.wave import WaveConfig

T, STEPS = 1e-3, 1200


def line(config, motion, contact, forward, backward, missing=range(0), fills=0):
    """Return the wrench at the hand and the motion of the slave's command (x alone), both (N,).

    `contact(u, x)` is the force of the slave's end [N], for the wave u that arrives there and the
    command x of the last step; packets travel for `forward` and `backward` steps. No packet arrives
    at the hand at steps `missing`; the slave's command is constant for the first `fills` steps.
    """
    p = method_parameters(
        PassivityConfig(method="wave", force_limit=1e3, retreat=[1e3, 1e3], wave=config)
    )
    start = np.array([1.0, 0, 0, 0, 0, 0, 0])
    memory = [initial_method_memory("wave", p, start) for _ in range(2)]
    memory[1][CHANNEL_FILL_TIME_LEFT] = (fills - 0.5) * T
    sent, command = np.zeros((2, len(motion), PACKET_SIZE)), np.zeros((len(motion), 13))
    nothing, zero, wrench = np.zeros(PACKET_SIZE), np.zeros(6), np.zeros((len(motion), 6))
    u = np.zeros(len(motion))
    for k, x in enumerate(motion):
        pose, dx = start.copy(), zero.copy()
        pose[4], dx[0] = x, x - motion[max(k - 1, 0)]
        if k not in missing:
            at_hand = sent[1, k - backward] if k >= backward else nothing
        master_step(
            step_addresses("wave"), at_hand, k not in missing, pose, dx / T, dx, zero,
            p[WRENCH_LIMIT], T, p, memory[0], wrench[k], sent[0, k],
        )  # fmt: skip
        u[k] = (sent[0, k, METHOD_VALUES][0] - (sent[0, k - 1, METHOD_VALUES][0] if k else 0.0)) / T
        received = sent[0, k - forward] if k >= forward else nothing
        f_e = zero.copy()
        f_e[0] = contact(u[k - forward] if k >= forward else 0.0, command[k - 1, 4])
        slave_step(
            step_addresses("wave"), received, True, start, zero, zero, f_e, T, p, memory[1],
            command[k], sent[1, k],
        )  # fmt: skip
    return wrench[:, 0], command[:, 4]


@pytest.fixture(scope="module")
def motion():
    rng = np.random.default_rng(0)
    t = np.arange(STEPS) * T
    return sum(0.02 * np.sin(w * t) for w in rng.uniform(2.0, 40.0, 5))


@pytest.mark.parametrize("delay", [1, 30, 500])
@pytest.mark.parametrize("end", ["matched", "free", "rigid"])
def test_line_equals_its_closed_forms(motion, end, delay):
    """Z = b matched, b tanh(s T) free, b coth(s T) rigid: as exact recursions over the RTT."""
    b, n = 10.0, 2 * delay
    contact = {
        "matched": lambda u, x: -np.sqrt(b / 2.0) * u,
        "free": lambda u, x: 0.0,
        "rigid": lambda u, x: -np.sqrt(2.0 * b) * u,
    }[end]
    config = WaveConfig(impedance=[b, 0.05], filter=0.0, matching=0.0)
    f, _ = line(config, motion, contact, delay, delay)
    F, v = -f, np.diff(motion, prepend=motion[0]) / T
    if end == "matched":
        np.testing.assert_allclose(F, b * v, atol=1e-12)
    elif end == "free":  # b (1 - z^-n) / (1 + z^-n)
        np.testing.assert_allclose(F[n:] + F[:-n], b * (v[n:] - v[:-n]), atol=1e-12)
    else:  # b (1 + z^-n) / (1 - z^-n)
        np.testing.assert_allclose(F[n:] - F[:-n], b * (v[n:] + v[:-n]), atol=1e-11)


@pytest.mark.parametrize("delay", [10, 50, 150])
def test_steady_position_error_is_the_momentum_on_the_line(delay):
    """x_m - x_s = f (T + filter) / b in a steady contact."""
    b, stiffness, filtering = 10.0, 291.0, 0.003
    config = WaveConfig(impedance=[b, 0.05], filter=filtering)
    pressed = 0.02 * np.minimum(np.arange(6000) * T / 0.5, 1.0)
    f, x = line(config, pressed, lambda u, x: -stiffness * max(x, 0.0), delay, delay)
    assert -f[-1] == pytest.approx(stiffness * x[-1], rel=0.01)
    assert pressed[-1] - x[-1] == pytest.approx(-f[-1] * (delay * T + filtering) / b, rel=0.03)


@pytest.mark.parametrize("delay", [1, 40])
def test_line_filled_in_contact_keeps_the_contact_force(delay):
    """5 N act before the line starts: the command stays, and 5 N are rendered."""
    f, x = line(WaveConfig(), np.zeros(400), lambda u, x: -5.0, delay, delay, fills=2 * delay + 100)
    assert np.abs(x).max() < 1e-12
    np.testing.assert_allclose(f[-200:], -5.0, rtol=1e-9)


@pytest.mark.parametrize("delay", [1, 40, 300])
def test_line_that_filled_in_contact_releases_only_its_energy(delay):
    """The energy is f^2 (T + filter) / 2 b for a round trip of 2 T, a matched wall and a hand
    whose speed extracts the most."""
    config, force, begin, steps = WaveConfig(), 5.0, 2 * delay + 100, 3 * delay + 300
    b = config.impedance[0]
    given = []
    for speed in (0.05, 0.2, 0.4):
        motion = -speed * T * np.maximum(np.arange(begin + steps) - begin + 1, 0)
        pushes: list[float] = []

        def contact(u, x, pushes=pushes):
            pushes.append(-force if len(pushes) < begin else -np.sqrt(b / 2.0) * u)
            return pushes[-1]

        f, x = line(config, motion, contact, delay, delay, fills=begin)
        work = f * np.diff(motion, prepend=0.0) - np.array(pushes) * np.diff(x, prepend=0.0)
        given.append(np.cumsum(work).max())
    stood = force**2 / (2.0 * b) * (delay * T + config.filter)
    assert 0.3 * stood < max(given) <= stood


def test_energy_that_fills_a_line_counts_once():
    """f^2 / 4 b returns, the store holds the filter's lag, received energy is used."""
    config, force, n = WaveConfig(), 5.0, 100
    p = method_parameters(PassivityConfig(method="wave", wave=config))
    start, zero, f_e = (
        np.array([1.0, 0, 0, 0, 0, 0, 0]),
        np.zeros(6),
        np.array([-force, *[0.0] * 5]),
    )
    memory, received = initial_method_memory("wave", p, start), np.zeros(PACKET_SIZE)
    memory[CHANNEL_FILL_TIME_LEFT], packet, command = (
        (n - 0.5) * T,
        np.zeros(PACKET_SIZE),
        np.zeros(13),
    )
    for k in range(n):
        received[CUMULATIVE_ENERGY] = 0.01 * k
        slave_step(
            step_addresses("wave"), received, True, start, zero, zero, f_e, T, p, memory, command,
            packet,
        )  # fmt: skip
    power = force**2 / (4.0 * config.impedance[0])
    np.testing.assert_allclose(packet[CUMULATIVE_ENERGY], [n * T * power, 0.0], rtol=1e-9)
    np.testing.assert_allclose(memory[STORED_ENERGY], [(T + config.filter) * power, 0.0], rtol=1e-9)
    np.testing.assert_allclose(memory[RECEIVED_ENERGY], 0.01 * (n - 1))


@pytest.mark.parametrize("missing", [1, 40, 90])
def test_wrench_rate_is_bounded_after_missing_packets(missing):
    """A moving hand in contact receives at most 450 N/s instead of 1 to 7 N in a step."""
    pressed, begin = 0.01 * (1.0 - np.cos(np.arange(600) * T / 0.15)), 150
    f, _ = line(
        WaveConfig(),
        pressed,
        lambda u, x: -2000.0 * max(x, 0.0),
        3,
        3,
        range(begin, begin + missing),
    )
    assert f[begin - 1] < -2.0
    assert np.abs(np.diff(f[begin:])).max() <= 450.0 * T * (1 + 1e-9)


@pytest.mark.parametrize(("touch", "rest"), [(0.0, (1 - 3 * T) ** 200), (1e-9, 1.0)])
def test_drift_fades_unless_that_increases_contact_force(touch, rest):
    """The wave transmits velocities; the position error is corrected slowly."""
    p = method_parameters(PassivityConfig(method="wave", wave=WaveConfig(drift_rate=3.0)))
    start, zero = np.array([1.0, 0, 0, 0, 0, 0, 0]), np.zeros(6)
    memory = [initial_method_memory("wave", p, start) for _ in range(2)]
    sent, packet, command = np.zeros(PACKET_SIZE), np.zeros(PACKET_SIZE), np.zeros(13)
    nothing = np.zeros(PACKET_SIZE)
    aside = np.array([0.01, -0.02, 0.03])
    for _ in range(200):
        master_step(
            step_addresses("wave"), nothing, True, start, zero, zero, zero, p[WRENCH_LIMIT], T, p,
            memory[0], zero.copy(), sent,
        )  # fmt: skip
        sent[POSE][4:] = aside
        f_e = np.array([*(-touch * aside), 0.0, 0.0, 0.0])
        slave_step(
            step_addresses("wave"),
            sent,
            True,
            start,
            zero,
            zero,
            f_e,
            T,
            p,
            memory[1],
            command,
            packet,
        )
    np.testing.assert_allclose(aside - command[4:7], rest * aside, rtol=1e-6)
