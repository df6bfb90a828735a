"""Newest packet, received packet, and their statistics."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit
from pydrake.common.yaml import yaml_load_typed

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.vectors import quaternion_exponential, quaternion_product
from drake_teleop.station.channel import network
from drake_teleop.station.channel.network import (
    BACKWARD,
    FORWARD,
    MAX_POSE_EXTRAPOLATION_S,
    PRESETS,
    NetworkConfig,
    initial_network_state,
    mean_delay,
    network_parameters,
    newest_packets,
    receive_packet,
    send_packet,
)
from drake_teleop.station.passivity.packet import (
    CUMULATIVE_ENERGY,
    METHOD_VALUES,
    PACKET_LOAD_WRENCH,
    PACKET_NUMBER,
    PACKET_SIZE,
    POSE,
    VELOCITY,
    WRENCH,
)

PERIOD = 1e-3
STEPS = 700
ROUGH = NetworkConfig(
    delay=0.04, jitter=1.0, distribution="gamma", loss=0.3, burst=0.02, duplicate=0.2
)


def packet_delays(config, seed, direction, steps, period):
    return network.packet_delay_steps(network_parameters(config, seed, direction, period), steps)


def share(high: float = 1.0) -> st.SearchStrategy[float]:
    return st.one_of(st.sampled_from([0.0, high]), st.floats(0.0, high))


@st.composite
def networks(draw) -> NetworkConfig:
    burst_loss = draw(st.sampled_from([1.0, 0.95, 0.6]))
    return NetworkConfig(
        delay=draw(share(0.3)),
        jitter=draw(share()),
        distribution=draw(st.sampled_from(["uniform", "normal", "gamma"])),
        loss=draw(share(0.5)),
        burst=draw(share(0.1)),
        burst_loss=burst_loss,
        duplicate=draw(share()),
        rate_hz=draw(st.none() | st.floats(20.0, 2000.0)),
        playout=draw(share(0.2)),
        redundant=draw(st.booleans()),
    )


seeds = st.integers(0, 2**63 - 1)


# Not cached: numba does not detect changes of called functions.
@njit
def _exchange(p, state, packets, received, newest, fresh):
    for k in range(len(packets)):
        send_packet(p, state, k, packets[k])
        newest[k], fresh[k] = receive_packet(p, state, k, received[k])


def exchange(config: NetworkConfig, packets: np.ndarray, seed=0, neutral=None):
    """Return received packets, newest steps and whether they are new, from the step form."""
    p = network_parameters(config, seed, FORWARD, PERIOD)
    neutral = np.zeros(packets.shape[1]) if neutral is None else neutral
    received, newest = np.empty_like(packets), np.empty(len(packets), int)
    fresh = np.empty(len(packets), bool)
    _exchange(p, initial_network_state(p, neutral), packets, received, newest, fresh)
    return received, newest, fresh


def random_packets(steps: int = STEPS, seed: int = 0) -> np.ndarray:
    packets = np.random.default_rng(seed).normal(size=(steps, PACKET_SIZE))
    packets[:, PACKET_NUMBER] = np.arange(steps)
    return packets


def newest_by_definition(config: NetworkConfig, seed: int) -> np.ndarray:
    """Return the newest packet by its definition: of all that have arrived, the one sent last."""
    playout = round(config.playout / PERIOD)
    arrivals = []
    for sent, copies in enumerate(packet_delays(config, seed, FORWARD, STEPS, PERIOD).tolist()):
        least = 0 if config.redundant else playout
        arrivals += [(sent + max(travel, least), sent) for travel in copies if travel >= 0]
    newest = [max((j for at, j in arrivals if at <= k), default=-1) for k in range(STEPS)]
    if config.redundant:  # every sample up to the newest has arrived and is played at its time
        newest = [min(j, max(k - playout, -1)) for k, j in enumerate(newest)]
    return np.array(newest)


# Newest packet


@pytest.mark.slow
@given(networks(), seeds)
@example(ROUGH, 0)
@example(replace(ROUGH, playout=0.05), 1)
@example(replace(ROUGH, playout=0.05, redundant=True, rate_hz=300.0), 2)
@example(replace(ROUGH, delay=0.1, playout=0.05, redundant=True), 3)
def test_step_form_equals_the_vectorised_form(config, seed):
    packets = random_packets()
    received, newest, fresh = exchange(config, packets, seed)
    np.testing.assert_array_equal(newest, newest_packets(config, seed, FORWARD, STEPS, PERIOD))
    # The received packet is the newest one, for any loss, delay or duplication.
    some = newest >= 0
    np.testing.assert_array_equal(received[some], packets[newest[some]])
    assert not received[~some].any()
    # The index never decreases, is never in the future, and is new only when it changes.
    assert (np.diff(newest, prepend=-1) >= 0).all()
    assert (newest <= np.arange(STEPS)).all()
    np.testing.assert_array_equal(fresh, np.diff(newest, prepend=-1) > 0)


@settings(max_examples=20)
@given(networks(), seeds)
@example(ROUGH, 0)
@example(replace(ROUGH, playout=0.05), 1)
@example(replace(ROUGH, playout=0.05, redundant=True, rate_hz=300.0), 2)
@example(replace(ROUGH, delay=0.1, playout=0.05, redundant=True), 3)
def test_newest_packet_is_the_last_sent_of_all_arrivals(config, seed):
    np.testing.assert_array_equal(
        newest_packets(config, seed, FORWARD, STEPS, PERIOD), newest_by_definition(config, seed)
    )


def test_an_ideal_network_delivers_each_packet_in_its_step():
    packets = random_packets()
    received, newest, fresh = exchange(NetworkConfig(), packets)
    np.testing.assert_array_equal(received, packets)
    np.testing.assert_array_equal(newest, np.arange(STEPS))
    assert fresh.all()


@pytest.mark.parametrize("steps", [1, 2, 37])
def test_a_constant_delay_is_a_shift(steps):
    newest = newest_packets(NetworkConfig(delay=steps * PERIOD), 0, FORWARD, STEPS, PERIOD)
    np.testing.assert_array_equal(newest, np.maximum(np.arange(STEPS) - steps, -1))


@given(networks(), seeds)
def test_duplicates_only_reduce_the_delay(config, seed):
    once = newest_packets(replace(config, duplicate=0.0), seed, FORWARD, STEPS, PERIOD)
    twice = newest_packets(replace(config, duplicate=1.0), seed, FORWARD, STEPS, PERIOD)
    assert (twice >= once).all()
    if config.jitter == 0.0:
        np.testing.assert_array_equal(twice, once)


@given(networks(), seeds)
@example(NetworkConfig(), 0)
def test_no_packet_is_received_before_the_least_delay(config, seed):
    packets, least = random_packets(200), 3
    p = network_parameters(config, seed, FORWARD, PERIOD, least)
    received, newest, fresh = np.empty_like(packets), np.empty(200, int), np.empty(200, bool)
    _exchange(p, initial_network_state(p, np.zeros(PACKET_SIZE)), packets, received, newest, fresh)
    assert (newest <= np.maximum(np.arange(200) - least, -1)).all()
    np.testing.assert_array_equal(received[newest >= 0], packets[newest[newest >= 0]])
    if config == NetworkConfig():
        np.testing.assert_array_equal(newest, np.maximum(np.arange(200) - least, -1))


def test_overtaken_packets_are_never_received():
    delays = packet_delays(replace(ROUGH, duplicate=0.0), 0, FORWARD, STEPS, PERIOD)[:, 0]
    arrival = np.where(delays >= 0, np.arange(STEPS) + delays, 10 * STEPS)
    overtaken = [k for k in range(STEPS) if (arrival[k + 1 :] <= arrival[k]).any()]
    newest = newest_packets(replace(ROUGH, duplicate=0.0), 0, FORWARD, STEPS, PERIOD)
    assert len(overtaken) > STEPS / 2
    assert not set(overtaken) & set(newest)


@given(networks(), seeds)
@example(ROUGH, 0)
def test_a_playout_buffer_above_the_greatest_age_is_a_constant_delay(config, seed):
    raw = replace(config, playout=0.0, redundant=False)
    age = np.arange(STEPS) - newest_packets(raw, seed, FORWARD, STEPS, PERIOD)
    oldest = int(age.max())
    packets = random_packets()

    def received_bytes(config: NetworkConfig) -> bytes:
        return exchange(config, packets, seed)[0].tobytes()

    buffered = replace(config, playout=oldest * PERIOD, redundant=True)
    assert received_bytes(buffered) == received_bytes(NetworkConfig(delay=oldest * PERIOD))
    # With one step less, some sample arrives too late: the bound is sharp.
    if oldest > 0:
        sooner = (oldest - 1) * PERIOD
        late = replace(config, playout=sooner, redundant=True)
        assert received_bytes(late) != received_bytes(NetworkConfig(delay=sooner))


@given(networks(), seeds)
def test_without_loss_the_playout_buffer_needs_no_redundancy(config, seed):
    config = replace(config, loss=0.0, rate_hz=None, redundant=False)
    longest = packet_delays(config, seed, FORWARD, STEPS, PERIOD).max() * PERIOD
    newest = newest_packets(replace(config, playout=longest), seed, FORWARD, STEPS, PERIOD)
    constant = newest_packets(NetworkConfig(delay=longest), seed, FORWARD, STEPS, PERIOD)
    np.testing.assert_array_equal(newest, constant)


def test_packets_depend_on_seed_and_direction():
    first = newest_packets(ROUGH, 7, FORWARD, STEPS, PERIOD)
    np.testing.assert_array_equal(first, newest_packets(ROUGH, 7, FORWARD, STEPS, PERIOD))
    assert (first != newest_packets(ROUGH, 8, FORWARD, STEPS, PERIOD)).mean() > 0.5
    assert (first != newest_packets(ROUGH, 7, BACKWARD, STEPS, PERIOD)).mean() > 0.5


def test_longer_run_has_the_packets_of_a_shorter_one():
    np.testing.assert_array_equal(
        newest_packets(ROUGH, 3, FORWARD, 10 * STEPS, PERIOD)[:STEPS],
        newest_packets(ROUGH, 3, FORWARD, STEPS, PERIOD),
    )


def test_no_packet_is_received_if_all_are_lost():
    packets, neutral = random_packets(), np.arange(float(PACKET_SIZE))
    received, newest, fresh = exchange(NetworkConfig(loss=1.0, burst=0.1), packets, 0, neutral)
    assert (newest == -1).all() and not fresh.any()
    np.testing.assert_array_equal(received, np.tile(neutral, (STEPS, 1)))


# Statistics. Tolerances are five standard deviations of the estimate; the seed is fixed.

MANY = 200_000


@pytest.mark.parametrize("jitter", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("distribution", ["uniform", "normal", "gamma"])
def test_delay_has_the_configured_mean_spread_and_floor(distribution, jitter):
    mean = 500  # steps, to avoid rounding to whole steps
    config = NetworkConfig(delay=mean * PERIOD, jitter=jitter, distribution=distribution)
    delays = packet_delays(config, 1, FORWARD, MANY, PERIOD)[:, 0]
    std = jitter * mean / math.sqrt(3)
    expected_mean, expected_std = float(mean), std
    if distribution == "normal":  # max(0, .): the moments of a rectified Gaussian
        z = mean / std
        above, density = 0.5 * math.erfc(-z / math.sqrt(2)), math.exp(-z * z / 2) / math.tau**0.5
        expected_mean = mean * above + std * density
        square = (mean**2 + std**2) * above + mean * std * density
        expected_std = math.sqrt(square - expected_mean**2)
        assert expected_mean < 1.011 * mean
    else:
        assert delays.min() >= round((1 - jitter) * mean)
    # The fourth moment of the gamma distribution of shape 3 is 5 std^4: the widest of the three.
    assert delays.mean() == pytest.approx(expected_mean, abs=5 * std / math.sqrt(MANY))
    assert delays.std() == pytest.approx(expected_std, abs=5 * std / math.sqrt(MANY))
    if distribution == "uniform":
        assert delays.max() <= round((1 + jitter) * mean)
    if distribution == "gamma":  # P(x > its mean) of a gamma of shape 3 is e^-3 (1 + 3 + 9/2)
        assert (delays > mean).mean() == pytest.approx(8.5 * math.exp(-3), abs=0.008)


def test_delays_are_independent_of_each_other():
    config = NetworkConfig(delay=0.5, jitter=1.0, duplicate=1.0)
    first, second = packet_delays(config, 2, FORWARD, MANY, PERIOD).T.astype(float)
    backward = packet_delays(config, 2, BACKWARD, MANY, PERIOD)[:, 0].astype(float)
    next_seed = packet_delays(config, 3, FORWARD, MANY, PERIOD)[:, 0].astype(float)
    pairs = [(first[1:], first[:-1]), (first, second), (first, backward), (first, next_seed)]
    for a, b in pairs:
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / math.sqrt(MANY)


@pytest.mark.parametrize("distribution", ["uniform", "normal", "gamma"])
def test_no_two_packets_share_a_random_number(monkeypatch, distribution):
    """Each of the sixteen numbers of a packet has one purpose."""
    config = NetworkConfig(
        delay=0.1, jitter=0.5, distribution=distribution, loss=0.2, burst_loss=0.5, duplicate=0.7
    )
    p, taken = network_parameters(config, 0, FORWARD, PERIOD), []

    def uniform(p, k, draw):
        taken.append((k, draw))
        return 0.6  # no packet is lost, and each is duplicated

    monkeypatch.setattr(network, "_random_uniform", uniform)
    monkeypatch.setattr(
        network, "_random_packet_delay_steps", network._random_packet_delay_steps.py_func
    )
    for k in range(100, 120):
        network._random_loss_and_delays.py_func(p, k, 0.0)
    packets, draws = np.array(taken).T
    assert set(packets) == set(range(100, 120)) and set(draws) <= set(range(16))
    each = {"uniform": 1, "normal": 2, "gamma": 3}[distribution]
    # Those of the chain, of the duplicate, and of both delays.
    assert len(taken) == len(set(taken)) == 20 * (2 + 2 * each)


def runs_of(lost: np.ndarray) -> np.ndarray:
    """Return the lengths of the runs of losses that begin and end inside."""
    edges = np.flatnonzero(np.diff(lost.astype(int)))
    return np.diff(edges)[int(lost[0]) :: 2] if edges.size else edges


@pytest.mark.parametrize("burst", [0.0, 1e-3, 0.02])
@pytest.mark.parametrize("loss", [0.01, 0.3, 0.9])
def test_loss_and_mean_burst_length_are_as_configured(loss, burst):
    config = NetworkConfig(loss=loss, burst=burst)
    lost = packet_delays(config, 4, FORWARD, MANY, PERIOD)[:, 0] < 0
    memory = math.exp(-PERIOD / (burst * (1 - loss))) if burst else 0.0
    std = math.sqrt(loss * (1 - loss) * (1 + memory) / (1 - memory) / MANY)
    assert lost.mean() == pytest.approx(loss, abs=5 * std)
    # Runs of a chain are geometric: the mean is 1/q, with q the probability to leave a bad state.
    runs, leave = runs_of(lost), (1 - loss) * (1 - memory)
    std = math.sqrt(1 - leave) / leave / math.sqrt(len(runs))
    assert runs.mean() == pytest.approx(1 / leave, abs=5 * std)
    if burst == 0.02 and loss < 0.5:  # twenty packets: the effect of sampling is negligible
        assert 1 / leave == pytest.approx(burst / PERIOD, rel=0.04)


def test_loss_is_equal_at_the_first_and_later_steps():
    config = NetworkConfig(loss=0.3, burst=10.0)
    lost = [packet_delays(config, seed, FORWARD, 1, PERIOD)[0, 0] < 0 for seed in range(2000)]
    assert np.mean(lost) == pytest.approx(0.3, abs=5 * math.sqrt(0.21 / 2000))


def test_burst_length_is_independent_of_the_packet_rate():
    config, lengths = NetworkConfig(loss=0.2, burst=0.05), []
    for period in (5e-4, 2e-3):
        lost = packet_delays(config, 5, FORWARD, MANY, period)[:, 0] < 0
        lengths.append(runs_of(lost).mean() * period)
    # Some 2000 and 8000 bursts: 2.5 % is one standard deviation; sampling lengthens by 2.5 %.
    assert lengths[0] == pytest.approx(0.05, rel=0.1)
    assert lengths[1] == pytest.approx(0.05, rel=0.1)


def test_only_bad_states_lose_packets():
    config = NetworkConfig(loss=0.19, burst=0.5, burst_loss=0.95)
    lost = packet_delays(config, 6, FORWARD, 10 * MANY, PERIOD)[:, 0] < 0
    share = np.convolve(lost, np.ones(20), "valid") / 20
    # Within a state, windows of 20 ms lose no packet or about 95 %; few are in between.
    bad = share > 0.5
    assert bad.mean() == pytest.approx(0.2, abs=0.02)
    assert share[bad].mean() == pytest.approx(0.95, abs=0.02)
    assert (share[~bad] == 0).mean() > 0.97


def test_fraction_of_arrived_packets_is_duplicated():
    config = replace(ROUGH, burst=0.0)
    first, second = packet_delays(config, 0, FORWARD, MANY, PERIOD).T
    arrived = first >= 0
    share, std = config.duplicate, math.sqrt(0.2 * 0.8 / arrived.sum())
    assert (second[arrived] >= 0).mean() == pytest.approx(share, abs=5 * std)
    assert (second[~arrived] == -1).all()


@given(st.floats(1.0, 3000.0))
@example(1000.0)
@example(290.0)
def test_sender_sends_evenly_at_the_configured_rate(rate):
    steps = 5000
    delays = packet_delays(NetworkConfig(rate_hz=rate), 0, FORWARD, steps, PERIOD)[:, 0]
    sent = np.flatnonzero(delays >= 0)
    most = min(rate, 1 / PERIOD)
    assert abs(len(sent) - most * steps * PERIOD) <= 1
    assert sent[0] == 0
    gaps = np.diff(sent)
    assert gaps.size == 0 or gaps.max() - gaps.min() <= 1


@pytest.mark.parametrize(
    ("name", "round_trip"),
    [
        ("ideal", 0.0),
        ("lan", 1e-3),
        ("wan", 0.03),
        ("internet", 0.1),
        ("geostationary", 0.6),
        ("lunar", 2.6),
    ],
)
def test_presets_have_their_round_trip_time(name, round_trip):
    config = PRESETS[name]
    config.check()
    period = 1e-5 if name == "lan" else PERIOD
    means = [
        (delays := packet_delays(config, 0, direction, 20_000, period)[:, 0])[delays >= 0].mean()
        for direction in (FORWARD, BACKWARD)
    ]
    assert sum(means) * period == pytest.approx(round_trip, rel=0.01)


def test_list_of_presets_is_complete():
    assert list(PRESETS) == ["ideal", "lan", "wan", "internet", "geostationary", "lunar"]


# Received packet without arrivals


def receive_after_silence(silence: str, silent: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a packet with motion, and the packet received `silent` steps after it."""
    p = network_parameters(NetworkConfig(silence=silence, rate_hz=1.0), 0, FORWARD, PERIOD)
    packet = random_packets(1)[0]
    packet[POSE][:4] /= np.linalg.norm(packet[POSE][:4])
    state, received = initial_network_state(p, np.zeros(PACKET_SIZE)), np.empty(PACKET_SIZE)
    for k in range(silent + 1):
        send_packet(p, state, k, packet if k == 0 else np.full(PACKET_SIZE, np.nan))
        newest, fresh = receive_packet(p, state, k, received)
        assert newest == 0 and fresh == (k == 0)
    return packet, received


@pytest.mark.parametrize("silence", ["hold", "zero", "extrapolate"])
@pytest.mark.parametrize("silent", [0, 1, 50, 300])
def test_packet_is_held_zero_or_extrapolated_during_silence(silence, silent):
    packet, received = receive_after_silence(silence, silent)
    expected = packet.copy()
    if silent and silence == "zero":
        expected[VELOCITY] = expected[WRENCH] = expected[PACKET_LOAD_WRENCH] = 0.0
    if silent and silence == "extrapolate":
        time = min(silent * PERIOD, MAX_POSE_EXTRAPOLATION_S)
        v, w = packet[VELOCITY][:3], packet[VELOCITY][3:]
        expected[POSE][:4] = quaternion_product(
            quaternion_exponential(tuple(w * time)), tuple(packet[POSE][:4])
        )
        expected[POSE][4:] += v * time
        if silent * PERIOD > MAX_POSE_EXTRAPOLATION_S:
            expected[VELOCITY] = 0.0
    np.testing.assert_allclose(received, expected, rtol=0, atol=1e-14)
    # Counters and integrals are constant for any policy: silence adds no energy.
    for part in (METHOD_VALUES, slice(CUMULATIVE_ENERGY.start, PACKET_LOAD_WRENCH.start)):
        np.testing.assert_array_equal(received[part], packet[part])


def test_packet_size_equals_that_of_the_neutral_packet():
    p = network_parameters(NetworkConfig(), 0, FORWARD, PERIOD)
    packets, received = random_packets(3), np.zeros(PACKET_SIZE)
    state = initial_network_state(p, np.zeros(PACKET_LOAD_WRENCH.start))
    assert len(state[1]) < len(initial_network_state(p, np.zeros(PACKET_SIZE))[1])
    for k, packet in enumerate(packets):
        send_packet(p, state, k, packet)
        receive_packet(p, state, k, received)
        np.testing.assert_array_equal(
            received[: PACKET_LOAD_WRENCH.start], packet[: PACKET_LOAD_WRENCH.start]
        )
        assert not received[PACKET_LOAD_WRENCH].any()


@pytest.mark.parametrize("silence", ["hold", "zero", "extrapolate"])
def test_output_is_zero_before_the_first_packet(silence):
    config = NetworkConfig(delay=0.05, silence=silence)
    received, newest, _ = exchange(config, random_packets())
    assert (newest[:50] == -1).all() and not received[:50].any()


# Recorded delays


def write_trace(path, text: str) -> NetworkConfig:
    path.write_text(text)
    return NetworkConfig(trace=str(path))


def test_trace_is_replayed_periodically(tmp_path):
    config = write_trace(
        tmp_path / "net.csv", "time,delay\n10.000,0.004\n10.002,\n10.003,0.0021\n10.005,0\n"
    )
    delays = packet_delays(config, 0, FORWARD, 15, PERIOD)
    # Rows hold until the next; the empty one is a loss; six packets, then the same again.
    np.testing.assert_array_equal(delays[:, 0], [4, 4, -1, 2, 2, 0] * 2 + [4, 4, -1])
    assert (delays[:, 1] == -1).all()
    expected = [-1, -1, -1, -1, 0, 5, 5, 5, 5, 5, 6, 11, 11, 11, 11]
    np.testing.assert_array_equal(newest_packets(config, 0, FORWARD, 15, PERIOD), expected)
    packets = random_packets(15)
    np.testing.assert_array_equal(exchange(config, packets)[1], expected)


@pytest.mark.parametrize("playout", [0.0, 0.03, 0.1])
def test_mean_delay_is_that_of_arriving_packets_after_the_playout_buffer(tmp_path, playout):
    config = write_trace(tmp_path / "net.csv", "time,delay\n5,0.01\n5.1,\n5.3,0.05\n5.6,0.02\n")
    number, delay = np.array([100, 300, 1]), np.array([0.01, 0.05, 0.02])
    expected = number @ np.maximum(delay, playout) / number.sum()
    assert mean_delay(replace(config, playout=playout)) == pytest.approx(expected, rel=1e-12)
    lost = write_trace(tmp_path / "lost.csv", "time,delay\n0,\n1,\n")
    assert mean_delay(replace(lost, playout=playout)) == playout
    assert mean_delay(NetworkConfig(delay=0.04, playout=playout)) == max(0.04, playout)


def test_losses_add_to_those_of_a_trace(tmp_path):
    config = write_trace(tmp_path / "net.csv", "time,delay\n0,0.01\n1,0.02\n")
    lost = packet_delays(replace(config, loss=0.4), 0, FORWARD, MANY, PERIOD)[:, 0] < 0
    assert lost.mean() == pytest.approx(0.4, abs=5 * math.sqrt(0.24 / MANY))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("time,dealy\n0,0.1\n", ["net.csv", "'delay'", "dealy"]),
        ("delay\n0.1\n", ["net.csv", "'time'"]),
        ("time,delay\n0,0.1\n1,-0.1\n", ["net.csv:delay", "row 3: -0.1 is outside", "0 to 10 s"]),
        ("time,delay\n0,0.1\n1,0.1\n2,120\n", ["net.csv:delay", "row 4", "seconds"]),
        ("time,delay\n0,0.1\n1,soon\n", ["net.csv:delay", "row 3", "soon"]),
        ("time,delay\n0,inf\n", ["net.csv:delay", "row 2"]),
        ("time,delay\n0,0.1\n0,0.1\n", ["net.csv:time", "row 3", "does not increase"]),
        ("time,delay\n0,0.1\n1e9,0.1\n", ["net.csv:time", "row 3", "36000 s"]),
        ("time,delay\n0,0.1\nnan,0.1\n", ["net.csv:time", "row 3"]),
        ("time,delay\n", ["net.csv", "no rows"]),
        ("", ["net.csv"]),
    ],
)
def test_invalid_trace_is_rejected_with_file_column_and_row(tmp_path, text, named):
    with pytest.raises(DrakeTeleopError) as error:
        network_parameters(write_trace(tmp_path / "net.csv", text), 0, FORWARD, PERIOD)
    message = str(error.value)
    assert "\n" not in message
    for word in named:
        assert word in message


def test_missing_trace_file_is_named():
    with pytest.raises(DrakeTeleopError, match=r"nowhere\.csv: no such file"):
        network_parameters(NetworkConfig(trace="nowhere.csv"), 0, FORWARD, PERIOD)


# Configuration


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"delay": -0.1}, "NetworkConfig.delay"),
        ({"delay": 50.0}, "NetworkConfig.delay"),
        ({"jitter": 1.5}, "NetworkConfig.jitter"),
        ({"loss": math.nan}, "NetworkConfig.loss"),
        ({"distribution": "pareto"}, "NetworkConfig.distribution"),
        ({"silence": "guess"}, "NetworkConfig.silence"),
        ({"rate_hz": 0.5}, "NetworkConfig.rate_hz"),
        ({"rate_hz": 0.0}, "network:rate_hz"),
        ({"loss": 0.5, "burst_loss": 0.4}, "network:loss"),
    ],
)
def test_invalid_values_are_rejected(change, named):
    with pytest.raises(DrakeTeleopError, match=f"^{named}: "):
        network_parameters(NetworkConfig(**change), 0, FORWARD, PERIOD)


def test_config_is_loaded_from_yaml():
    text = "{delay: 0.1, distribution: gamma, rate_hz: 500, trace: net.csv, redundant: true}"
    loaded = yaml_load_typed(schema=NetworkConfig, data=text, defaults=NetworkConfig())
    expected = NetworkConfig(
        delay=0.1, distribution="gamma", rate_hz=500.0, trace="net.csv", redundant=True
    )
    assert asdict(loaded) == asdict(expected)


@pytest.mark.parametrize(
    ("config", "direction", "longest"),
    [
        (NetworkConfig(delay=0.02), network.FORWARD, 1e-3),
        (NetworkConfig(delay=0.3, rate_hz=50.0), network.BACKWARD, 0.02),
        (NetworkConfig(loss=1.0), network.FORWARD, math.inf),
        # Longest bad state of a minute with n = 60 (0.3 / 0.08): at least 0.08 ln(n).
        (NetworkConfig(delay=0.05, jitter=0.5, loss=0.3, burst=0.08), network.BACKWARD, 0.49),
    ],
)
def test_longest_silence_in_a_minute_is_estimated(config, direction, longest):
    found = network.longest_silence(config, direction, 1e-3)
    assert found == pytest.approx(longest, rel=0.15 if config.burst else 1e-9)
