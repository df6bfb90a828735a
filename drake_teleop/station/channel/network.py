"""Simulated network whose receiver reads the newest packet (docs/theory.md, (T26), (T27)).

Delays are independent, so jitter reorders packets. Losses follow a Gilbert-Elliott chain. Random
numbers are hashes of (seed, direction, step).
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import check_all_field_values, choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError, field_location
from drake_teleop.common.noise import random_bits
from drake_teleop.common.numeric import Array
from drake_teleop.common.registry import Presets
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.packet import has_packet_arrived, move_pose_into

FORWARD, BACKWARD = 0, 1  # master to slave, slave to master
MAX_DELAY_S = 10.0  # [s], bounds the memory
MAX_TRACE_DURATION_S = 36000.0  # [s]
MAX_POSE_EXTRAPOLATION_S = 0.1  # [s]; after it the pose is constant

# Distribution -> largest deviation from the mean, in units of jitter times delay. It cuts the delay
# of one packet in 1e7.
_MAX_DEVIATION_PER_JITTER = {"uniform": 1.0, "normal": 3.0, "gamma": 6.0}
_SILENCE_POLICY_NAMES = ("hold", "zero", "extrapolate")
_SILENCE_POLICY_ZERO, _SILENCE_POLICY_EXTRAPOLATE = 1, 2
_TRACE_STEP_S = 1e-3  # [s], for mean and maximum of a trace
_SILENCE_SIMULATION_S, _SILENCE_SIMULATION_SEED = 60.0, 20090101  # for `longest_silence`


@settings
@dataclass
class NetworkConfig:
    """Settings of one direction of a network; the default is ideal: packet k arrives at step k."""

    delay: float = quantity(0.0, "s", 0.0, MAX_DELAY_S, "mean one-way delay")
    jitter: float = quantity(0.0, "1", 0.0, 1.0, "sqrt(3) * standard deviation / mean of the delay")
    distribution: str = choice("uniform", tuple(_MAX_DEVIATION_PER_JITTER), "delay distribution")
    loss: float = quantity(0.0, "1", 0.0, 1.0, "mean share of lost packets")
    burst: float = quantity(0.0, "s", 0.0, 100.0, "mean duration of a loss burst; 0: no bursts")
    burst_loss: float = quantity(1.0, "1", 0.01, 1.0, "share of packets that a loss burst loses")
    duplicate: float = quantity(0.0, "1", 0.0, 1.0, "share of duplicated packets")
    rate_hz: float | None = quantity(None, "Hz", 1.0, 1e5, "largest packet rate; null: every step")
    playout: float = quantity(0.0, "s", 0.0, MAX_DELAY_S, "jitter buffer: least age of packets")
    redundant: bool = plain(False, "each packet repeats the data of the last `playout` seconds")
    trace: str | None = plain(
        None,
        "CSV file of a recorded delay, relative to the scenario's folder, instead of delay, jitter "
        "and distribution; columns: `time` [s], increasing, and `delay` [s], one-way, empty if the "
        "packet was lost. A row holds until the next; after the last row the file is repeated",
        is_path=True,
    )
    silence: str = choice(
        "hold",
        _SILENCE_POLICY_NAMES,
        "values at steps without a new packet; hold: the newest packet; zero: its pose with zero "
        "velocity and wrench; extrapolate: its pose moved on at its velocity, for up to 0.1 s. "
        "Energies and integrals are always held",
    )

    def check(self, where: str = "network") -> None:
        check_all_field_values(self, where)
        if self.loss > self.burst_loss:
            what = f"mean loss {self.loss:g} is above burst_loss {self.burst_loss:g}"
            place, remedy = field_location(where, "loss"), "raise burst_loss to at least the mean"
            raise DrakeTeleopError(what, where=place, remedy=f"{remedy} loss")


_presets = {
    "ideal": NetworkConfig(),
    "lan": NetworkConfig(delay=0.5e-3, jitter=0.5, distribution="gamma", loss=1e-5),
    "wan": NetworkConfig(delay=15e-3, jitter=0.1, distribution="gamma", loss=1e-3, burst=5e-3),
    "internet": NetworkConfig(
        delay=50e-3, jitter=0.2, distribution="gamma", loss=0.01, burst=0.02, duplicate=1e-3
    ),
    "geostationary": NetworkConfig(
        delay=0.3, jitter=0.03, distribution="gamma", loss=5e-3, burst=0.05
    ),
    "lunar": NetworkConfig(delay=1.3, jitter=0.01, distribution="gamma", loss=0.01, burst=0.1),
}
PRESETS = Presets(_presets)
"""Networks by name, the same in both directions. Only the delays have sources.

lan: switched network, round trip 1 ms, most of it in the hosts. wan: 1500 km of fibre at 5 us/km
(ITU-T G.114), doubled for detours and routers, 30 ms; loss at the bound of classes 0 to 4 of ITU-T
Y.1541. internet: 5000 km, doubled likewise, 100 ms; best effort with loss in bursts.
geostationary: up and down 240 to 279 ms (RFC 2488, section 2); round trip with coding and ground
stations 600 ms. lunar: 384 400 km are 1.28 s; round trip with ground stations 2.6 s.
"""

# Parameters of a line in one array: these, then the trace in steps, -1 for a lost packet.
_RANDOM_KEY, _STEP_PERIOD, _MEAN_DELAY_STEPS, _DELAY_JITTER = range(4)
_DELAY_DISTRIBUTION, _MAX_DELAY_STEPS, _BAD_STATE_SHARE, _BAD_STATE_PERSISTENCE = range(4, 8)
_BAD_STATE_LOSS_SHARE, _DUPLICATE_SHARE, _PACKETS_PER_STEP = range(8, 11)
_PLAYOUT_STEPS, _IS_REDUNDANT, _NUM_TRANSIT_SLOTS, _SILENCE_POLICY = range(11, 15)
_MIN_DELAY_STEPS, _DELAY_TRACE_START = 15, 16
# State of a receiver: these, then its last packet. In transit: slots, then sent packets.
_IS_BAD_STATE, _NEWEST_ARRIVED_PACKET, _NEWEST_READ_PACKET, _SILENT_STEPS, _LAST_PACKET = range(5)


def network_parameters(
    config: NetworkConfig, seed: int, direction: int, period: float, min_steps: int = 0,
    delays: NDArray[np.int64] | None = None,
) -> Array:  # fmt: skip
    """Return the parameters of one direction for `send_packet` and `receive_packet`.

    Args:
        direction: FORWARD or BACKWARD, with independent random numbers.
        period: time between steps [s].
        min_steps: smallest delay of a packet [steps].
        delays: (M,) recorded delays [steps], -1 if lost, instead of `config.trace`; repeated.
    """
    config.check()
    trace = np.zeros(0) if config.trace is None else _read_delay_trace(Path(config.trace), period)
    trace = trace if delays is None else np.asarray(delays, np.float64)
    mean, playout = config.delay / period, math.floor(config.playout / period + 0.5)
    max_deviation = _MAX_DEVIATION_PER_JITTER[config.distribution] * config.jitter
    longest = math.floor(mean * (1 + max_deviation) + 0.5)
    if trace.size:
        longest = max(int(trace.max()), 0)
    longest = max(longest, min_steps)
    bad = config.loss / config.burst_loss
    time_constant = config.burst * (1 - bad)  # time constant of the chain
    p = np.empty(_DELAY_TRACE_START + trace.size)
    # 53 bits of a key are exact in a float.
    p[_RANDOM_KEY] = random_bits(np.uint64(random_bits(np.uint64(seed % 2**64), 0)), direction)
    p[_STEP_PERIOD], p[_DELAY_JITTER] = period, config.jitter
    p[_MEAN_DELAY_STEPS], p[_MAX_DELAY_STEPS] = mean, longest
    p[_DELAY_DISTRIBUTION] = list(_MAX_DEVIATION_PER_JITTER).index(config.distribution)
    p[_BAD_STATE_SHARE] = bad
    p[_BAD_STATE_PERSISTENCE] = math.exp(-period / time_constant) if time_constant > 0 else 0.0
    p[_BAD_STATE_LOSS_SHARE], p[_DUPLICATE_SHARE] = config.burst_loss, config.duplicate
    p[_PACKETS_PER_STEP] = min(1.0, period * config.rate_hz) if config.rate_hz is not None else 1.0
    p[_PLAYOUT_STEPS], p[_IS_REDUNDANT] = playout, config.redundant
    p[_NUM_TRANSIT_SLOTS] = max(longest, playout) + 1
    p[_SILENCE_POLICY], p[_MIN_DELAY_STEPS] = _SILENCE_POLICY_NAMES.index(config.silence), min_steps
    p[_DELAY_TRACE_START:] = trace
    return p


def mean_delay(config: NetworkConfig) -> float:
    """Return the mean one-way delay of arriving packets [s], but at least the playout time."""
    if config.trace is None:
        return max(config.delay, config.playout)
    delays = _read_delay_trace(Path(config.trace), _TRACE_STEP_S) * _TRACE_STEP_S
    used = np.maximum(delays[delays >= 0], config.playout)
    return float(used.mean()) if used.size else config.playout


def longest_delay(config: NetworkConfig) -> float:
    """Return the largest one-way delay of an arriving packet [s], but at least the playout time."""
    longest = config.delay * (1 + _MAX_DEVIATION_PER_JITTER[config.distribution] * config.jitter)
    if config.trace is not None:
        longest = float(_read_delay_trace(Path(config.trace), _TRACE_STEP_S).max()) * _TRACE_STEP_S
    return max(longest, config.playout)


def _read_delay_trace(path: Path, period: float) -> Array:
    """Return a trace file's delays (N,) [steps], one packet a period; -1 for a lost packet."""
    # The table reader starts slowly and is needed only for a trace.
    from drake_teleop.logs.read.table_files import read_table

    table = read_table(path)
    time = table.finite_numbers(["time"], 1, str(path))[:, 0]
    delay = table.single_column("delay", str(path))
    if len(delay) != len(time):
        what = f"has {len(delay)} values, but column time has {len(time)}"
        raise DrakeTeleopError(what, where=f"{path}:delay", remedy="give one delay for each time")
    lost, age = np.isnan(delay), time - time[0]
    too_late = f"is more than {MAX_TRACE_DURATION_S:g} s after the first time"
    for column, values, bad, what in (
        ("time", time, np.diff(time, prepend=-np.inf) <= 0, "does not increase"),
        ("time", time, age > MAX_TRACE_DURATION_S, too_late),
        ("delay", delay, (delay < 0) | (delay > MAX_DELAY_S), f"is outside 0 to {MAX_DELAY_S:g} s"),
    ):
        if bad.any():
            first = int(np.argmax(bad))
            what = f"row {table.line_in_file(first)}: {values[first]:g} {what}"
            remedy = "give seconds, sorted by time; an empty delay is a lost packet"
            raise DrakeTeleopError(what, where=f"{path}:{column}", remedy=remedy)
    sent = np.arange(math.floor(age[-1] / period + 0.5) + 1) * period
    row = np.searchsorted(age, sent + 1e-6 * period, side="right") - 1
    return np.where(lost, -1.0, np.floor(delay / period + 0.5))[row]


@njit(cache=True)
def _random_uniform(p, packet, draw):
    return (float(random_bits(np.uint64(p[_RANDOM_KEY]), 16 * packet + draw)) + 1.0) * 2.0**-53


@njit(cache=True)
def _random_packet_delay_steps(p, k, draw):
    """Return the delay of packet k [steps] (-1: lost), from its random numbers from `draw` on."""
    if p.shape[0] > _DELAY_TRACE_START:
        steps = p[_DELAY_TRACE_START + k % (p.shape[0] - _DELAY_TRACE_START)]
        return int(max(steps, p[_MIN_DELAY_STEPS])) if steps >= 0.0 else -1
    mean, spread = p[_MEAN_DELAY_STEPS], p[_MEAN_DELAY_STEPS] * p[_DELAY_JITTER]
    if spread == 0.0:
        return int(p[_MAX_DELAY_STEPS])
    u = _random_uniform(p, k, draw)
    if p[_DELAY_DISTRIBUTION] == 0:
        delay = mean + spread * (2.0 * u - 1.0)
    elif p[_DELAY_DISTRIBUTION] == 1:  # Box and Muller
        angle = 2.0 * math.pi * _random_uniform(p, k, draw + 1)
        delay = mean + spread / math.sqrt(3.0) * math.sqrt(-2.0 * math.log(u)) * math.cos(angle)
    else:  # sum of three exponential waits
        u *= _random_uniform(p, k, draw + 1) * _random_uniform(p, k, draw + 2)
        delay = mean - spread - spread / 3.0 * math.log(u)
    return int(min(max(delay + 0.5, p[_MIN_DELAY_STEPS]), p[_MAX_DELAY_STEPS]))


@njit(cache=True)
def _random_loss_and_delays(p, k, bad):
    """Return if a loss burst continues, delays of packet k and its duplicate [steps], -1: none."""
    if p[_BAD_STATE_SHARE] > 0.0:
        likely = p[_BAD_STATE_SHARE] + (bad - p[_BAD_STATE_SHARE]) * p[_BAD_STATE_PERSISTENCE]
        bad = 1.0 if _random_uniform(p, k, 0) <= likely else 0.0
    rate = p[_PACKETS_PER_STEP]
    if rate < 1.0 and math.floor(k * rate + 1e-9) == math.floor((k - 1) * rate + 1e-9):
        return bad, -1, -1
    if bad == 1.0 and _random_uniform(p, k, 1) <= p[_BAD_STATE_LOSS_SHARE]:
        return bad, -1, -1
    first = _random_packet_delay_steps(p, k, 2)
    second = -1
    if first >= 0 and p[_DUPLICATE_SHARE] > 0.0 and _random_uniform(p, k, 5) <= p[_DUPLICATE_SHARE]:
        second = _random_packet_delay_steps(p, k, 6)
    return bad, first, second


def initial_network_state(p: Array, initial_packet: Array) -> tuple[Array, Array]:
    """Return the initial state of one direction: receiver (4 + N,), and packets in transit.

    The receiver reads `initial_packet` (N,) until the first packet arrives.
    """
    slots = int(p[_NUM_TRANSIT_SLOTS])
    receiver = np.concatenate([[p[_BAD_STATE_SHARE], -1.0, -1.0, 0.0], initial_packet])
    return receiver, np.concatenate([np.full(slots, -1.0), np.zeros(slots * len(initial_packet))])


@njit(cache=True)
def send_packet(p, state, k, packet):
    """Send `packet` at step `k` and update `state`; call this for every step from 0 on."""
    receiver, in_transit = state
    slots, size = int(p[_NUM_TRANSIT_SLOTS]), receiver.shape[0] - _LAST_PACKET
    receiver[_IS_BAD_STATE], first, second = _random_loss_and_delays(p, k, receiver[_IS_BAD_STATE])
    for travel in (first, second):
        if travel >= 0:
            if p[_IS_REDUNDANT] == 0.0:
                travel = max(travel, int(p[_PLAYOUT_STEPS]))
            # The previous content of the slot is older.
            in_transit[(k + travel) % slots] = k
    # A lost packet is written too, because a later redundant packet may contain it.
    copy_into(in_transit, slots + size * (k % slots), packet, 0, size)


@njit(cache=True)
def receive_packet(p, state, k, packet):
    """Write the newest packet (N,) that has arrived by step `k` into `packet`.

    Return the step at which it was sent (-1: none), and True if it is new.
    """
    receiver, in_transit = state
    slots, size = int(p[_NUM_TRANSIT_SLOTS]), receiver.shape[0] - _LAST_PACKET
    # An old entry of the slot is smaller and has no effect.
    receiver[_NEWEST_ARRIVED_PACKET] = max(receiver[_NEWEST_ARRIVED_PACKET], in_transit[k % slots])
    newest = receiver[_NEWEST_ARRIVED_PACKET]
    if p[_IS_REDUNDANT] != 0.0:
        newest = min(newest, k - p[_PLAYOUT_STEPS])
    fresh = newest > receiver[_NEWEST_READ_PACKET]
    if fresh:
        receiver[_NEWEST_READ_PACKET], receiver[_SILENT_STEPS] = newest, 0.0
        copy_into(receiver, _LAST_PACKET, in_transit, slots + size * (int(newest) % slots), size)
    else:
        receiver[_SILENT_STEPS] += 1.0
    copy_into(packet, 0, receiver, _LAST_PACKET, size)
    if not fresh:
        _apply_silence_policy(p[_SILENCE_POLICY], receiver[_SILENT_STEPS] * p[_STEP_PERIOD], packet)
    return int(receiver[_NEWEST_READ_PACKET]), fresh


@njit(cache=True)
def _apply_silence_policy(policy, silence_s, packet):
    velocity, pose = packet[fields.VELOCITY], packet[fields.POSE]
    if policy == _SILENCE_POLICY_ZERO:
        velocity[:] = 0.0
        packet[fields.WRENCH] = packet[fields.PACKET_LOAD_WRENCH] = 0.0
    elif policy == _SILENCE_POLICY_EXTRAPOLATE and has_packet_arrived(packet):
        move_pose_into(pose, velocity * min(silence_s, MAX_POSE_EXTRAPOLATION_S), pose)
        if silence_s > MAX_POSE_EXTRAPOLATION_S:
            velocity[:] = 0.0


@njit(cache=True)
def packet_delay_steps(p, num_steps):
    """Return the delays (num_steps, 2) of packets and of their duplicates [steps]; -1: none."""
    delays, bad = np.empty((num_steps, 2), np.int64), p[_BAD_STATE_SHARE]
    for k in range(num_steps):
        bad, delays[k, 0], delays[k, 1] = _random_loss_and_delays(p, k, bad)
    return delays


def newest_packets(
    config: NetworkConfig, seed: int, direction: int, steps: int, period: float
) -> NDArray[np.int64]:
    """Return the send step of the newest received packet at each step, (steps,); -1: none."""
    p = network_parameters(config, seed, direction, period)
    sent, arrived, playout = np.arange(steps), np.full(steps, -1), int(p[_PLAYOUT_STEPS])
    for travel in packet_delay_steps(p, steps).T:
        used = travel if config.redundant else np.maximum(travel, playout)
        seen = (travel >= 0) & (sent + used < steps)
        np.maximum.at(arrived, (sent + used)[seen], sent[seen])
    newest = np.maximum.accumulate(arrived)
    return np.minimum(newest, np.maximum(sent - playout, -1)) if config.redundant else newest


def longest_silence(config: NetworkConfig, direction: int, period: float) -> float:
    """Return the longest time between new packets in a simulated minute [s]; inf without any."""
    steps = math.ceil((_SILENCE_SIMULATION_S + longest_delay(config)) / period)
    newest = newest_packets(config, _SILENCE_SIMULATION_SEED, direction, steps, period)
    fresh = np.flatnonzero(np.diff(newest, prepend=-1) > 0)
    return float(np.diff(fresh, append=steps).max(initial=0) * period) if len(fresh) else math.inf
