"""Warnings about a run from its recorded signals.

============== ===================================================================================
saturated      the wrist sensor is saturated
fault          invalid numbers in the loop, see `drake_teleop.common.fault`
unreachable    the inverse kinematics have no solution
clipped        a joint speed or motor torque, or the displayed force or torque, is at its limit
leaf           the deflection is outside the validity of its model
safe state     an end of the channel receives no packets for longer than the channel's timeout
behind         a pose or joint lags its command by more than delay and bandwidth explain
reserve        the hand is faster than the energy reserve of `ledger` allows for the slave
hunting        hand, command or joint oscillates (limit cycle) while its command does not
============== ===================================================================================

The first five are always reported, the others if they last longer than 0.2 s (`reserve`: in total).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.fault import MEANINGS, Fault
from drake_teleop.common.style import contact_spans
from drake_teleop.load.regressor import LOST
from drake_teleop.station.channel.network import FORWARD, longest_delay, newest_packets
from drake_teleop.station.channel_side import power_scale, told_of_the_arm
from drake_teleop.station.master.dynamics import HapticDevice
from drake_teleop.station.master.leader import LeaderDevice
from drake_teleop.station.passivity.ledger import fastest
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.arm import SLIDES, ArmModel
from drake_teleop.station.slave.inverse_kinematics import IkStatus

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Spans = list[tuple[float, float]]

LASTING = 0.2
"""Shortest reported duration [s]; a normal motion may cause shorter ones."""
# Shorter gaps are closed [s].
_GAP = 0.05
# Tolerance for rounding at a limit.
_AT_LIMIT = 1 - 1e-9
# Smallest reported lag: command [m], its orientation [rad], joint [rad] (3 mm at 1 m).
_FAR, _TURNED, _JOINT_FAR = 2e-3, np.deg2rad(1.0), np.deg2rad(0.2)
# Settling time of a ledger's command with sufficient energy [s].
_GENERATOR = 0.05
_DEGREES = 180 / np.pi
# Smallest reported amplitude: hand and command [m], their orientation [rad], joint [rad].
_SWING, _TURN_SWING, _JOINT_SWING = 5e-4, np.deg2rad(0.5), np.deg2rad(0.1)
NEAR = 0.25
"""A reversal within this time of a command's reversal is explained by it [s]."""
# Reversals of an oscillation, and longest time between two of them [s].
_TURNS, _SLOWEST = 4, 0.5
# Time constants of the position loop until the error is 0.3 %.
_TIME_CONSTANTS = 6.0
# Further times are only counted.
_LISTED = 3


def run_warnings(result: SimulationResult, scenario: Scenario, arm: ArmModel) -> list[str]:
    """Return one sentence for each condition of the table above that occurred, with times.

    Args:
        result: result of a run; checks whose signals were not recorded are skipped.
        scenario: scenario of the run.
        arm: model of the slave's arm, with limits.
    """
    return [
        f"{what} {_when(spans)}"
        for found in (_faults(result), _limits(result, scenario, arm), _channel(result, scenario),
                      _joints(result, scenario, arm), _hand(result))
        for what, spans in found
        if spans
    ]  # fmt: skip


def spans_of(t: Array, happened: Flags, least: float = 0.0) -> Spans:
    """Return start and stop times of a condition; gaps shorter than 50 ms are closed.

    Args:
        t: (N,) [s].
        happened: (N,) condition.
        least: shortest interval to return [s].
    """
    spans: Spans = []
    for start, stop in contact_spans(t, happened):
        if spans and start - spans[-1][1] < _GAP:
            start = spans.pop()[0]
        spans.append((start, stop))
    return [(start, stop) for start, stop in spans if stop - start >= least]


def behind(t: Array, command: Array, actual: Array, window: float) -> Array:
    """Return (N,) distance of the actual motion from the range of recent commands.

    A delay reproduces earlier commands; a loop without overshoot returns a weighted mean of them.
    Both stay inside the range of the commands in `window`.

    Args:
        t: (N,) evenly spaced [s].
        command, actual: (N, k) in one unit.
        window: time before now whose commands count [s].
    """
    rows = max(round(window / (t[1] - t[0])), 1) + 1 if len(t) > 1 else 1
    above = actual - _largest_of_last(command, rows)
    below = -_largest_of_last(-command, rows) - actual
    return np.linalg.norm(np.maximum(np.maximum(above, below), 0.0), axis=1)


def turns(x: Array, swing: float) -> NDArray[np.intp]:
    """Return the indices of local extremes that differ by more than `swing` from the previous one.

    Args:
        x: (N,).
        swing: in the unit of `x`.
    """
    slope = np.diff(x)
    near = np.flatnonzero(slope[1:] * slope[:-1] <= 0.0) + 1
    found: list[int] = []
    high = low = 0
    rising = 0  # 0: unknown
    for k in [*near, len(x) - 1]:
        high, low = (k if x[k] > x[high] else high), (k if x[k] < x[low] else low)
        if rising >= 0 and x[high] - x[k] > swing:
            found += [high] if rising else []
            rising, high, low = -1, k, k
        elif rising <= 0 and x[k] - x[low] > swing:
            found += [low] if rising else []
            rising, high, low = 1, k, k
    return np.array(found, dtype=np.intp)


def hunts(t: Array, command: Array, actual: Array, swing: float, near: float = NEAR) -> Flags:
    """Return (N,) whether the actual motion oscillates while the commanded one does not.

    An oscillation has at least four reversals, each within 0.5 s of the previous one. A reversal
    of the command explains one reversal of the motion within `near`.

    Args:
        t: (N,) [s].
        command, actual: (N, k) in one unit.
        swing: smallest amplitude, in that unit.
        near: [s].
    """
    asked = np.sort(np.concatenate([t[turns(x, swing)] for x in command.T]))
    hunting = np.zeros(len(t), dtype=bool)
    for x in actual.T:
        mine = turns(x, swing)
        for time in asked:
            if len(mine) and abs(t[mine] - time).min() < near:
                mine = np.delete(mine, abs(t[mine] - time).argmin())
        for chain in np.split(mine, np.flatnonzero(np.diff(t[mine]) > _SLOWEST) + 1):
            if len(chain) >= _TURNS:
                hunting[chain[0] : chain[-1] + 1] = True
    return hunting


def _faults(result: SimulationResult) -> Iterator[tuple[str, Spans]]:
    """Yield slave faults, and operator-side faults that no slave fault explains."""
    t = result.t
    slave = hand = np.zeros(len(t))
    if "fault" in result:
        slave = result["fault"][:, 0]
    if "fault_at_hand" in result:
        hand = result["fault_at_hand"][:, 0]
    for fault, meaning in MEANINGS.items():
        if fault != Fault.RESUMING:
            happened = (slave == fault) | ((hand == fault) & (slave == 0))
            yield f"a fault: {meaning},", spans_of(t, happened)


def _limits(
    result: SimulationResult, scenario: Scenario, arm: ArmModel
) -> Iterator[tuple[str, Spans]]:
    t = result.t
    yield "the wrist sensor saturates", spans_of(t, _saturated(result))
    if "ik_status" in result:
        for status in list(IkStatus)[1:]:
            happened = result["ik_status"][:, 0] == status
            yield f"inverse kinematics: {status.name}", spans_of(t, happened)
    control = scenario.joint_control
    asked, fastest = control.speed_gain * _joint_error(result), arm.velocity_limit
    if control.position_interface is not None:
        fastest = np.minimum(fastest, control.position_interface.max_speed)
    for what, values, limit in (
        ("speed", asked, fastest),
        ("torque", result["joint_torque"], arm.effort_limit),
    ):
        clipped = np.abs(values) >= _AT_LIMIT * limit
        for joint in np.flatnonzero(clipped.any(axis=0)):
            yield f"joint {joint + 1} is at its largest {what}", spans_of(t, clipped[:, joint])
    if "force_to_master" in result:
        shown, device = result["force_to_master"], scenario.master.device(0.0, 0.0)
        full = np.linalg.norm(shown[:, :3], axis=1) >= _AT_LIMIT * device.peak_force
        if isinstance(device, LeaderDevice):
            full |= np.linalg.norm(shown[:, 3:], axis=1) >= _AT_LIMIT * device.peak_torque[0]
        elif device.peak_torque.all():
            full |= _full_torque(shown[:, 3:], result["master_state"], device)
        yield "the device displays the most that it can", spans_of(t, full, LASTING)
        ended = device.at_an_end(result["master_state"][:, : device.num_joints])
        yield "the device is at the end of its workspace", spans_of(t, ended)
    if scenario.leaf is not None and "sheet_state" in result:
        bent = scenario.leaf.largest_small_deflection
        yield (
            f"the leaf bends by more than {1e3 * bent:.0f} mm, where its model is no longer good,",
            spans_of(t, np.abs(result["sheet_state"][:, 0]) > bent),
        )


def _saturated(result: SimulationResult) -> Flags:
    flag: Array = result["saturated"][:, 0]
    return (flag > 0) & (flag < LOST)


def _channel(result: SimulationResult, scenario: Scenario) -> Iterator[tuple[str, Spans]]:
    if "ports" not in result:
        return
    t, timeout = result.t, scenario.channel.silent_after(1.0 / scenario.rates.hand_hz)
    for end, other in (("master", "slave"), ("slave", "master")):
        silent = result[f"ports.{end}_silent"] > timeout
        yield (
            f"the {end}'s end is in its safe state, as nothing comes from the {other},",
            spans_of(t, silent, LASTING),
        )
    # An end without new packets uses the last one until `timeout`.
    window = longest_delay(scenario.channel.lines()[0]) + timeout
    sent, received = result["pose_command"], result["pose_received"]
    far = behind(t, sent[:, 4:], received[:, 4:], window)
    turned = behind(t, _turned(sent, sent), _turned(received, sent), window)
    by = f"{scenario.passivity.method}, network {scenario.channel.network}"
    for values, least, unit, scale in (
        (far, _FAR, "mm", 1e3),
        (turned, _TURNED, "degrees", _DEGREES),
    ):
        spans = spans_of(t, values > least, LASTING)
        yield (
            f"the channel ({by}) holds the slave's command back: up to"
            f" {scale * _largest_in(t, values, spans):.1f} {unit} more than its delay explains,",
            spans,
        )
    yield from _reserve(result, scenario)
    hunting = _sways(t, sent, received, NEAR + window)
    yield f"the channel ({by}) lets the slave hunt, to and fro", spans_of(t, hunting, LASTING)


def _reserve(result: SimulationResult, scenario: Scenario) -> Iterator[tuple[str, Spans]]:
    """Yield the times when lack of energy in `ledger` makes the slave slower than the hand."""
    if scenario.passivity.method != "ledger" or len(result.t) < 2:
        return
    t, sent, received = result.t, result["pose_command"], result["pose_received"]
    config, row = scenario.passivity.ledger, t[1] - t[0]
    mass = np.array(told_of_the_arm(scenario).slave_mass) * power_scale(scenario)
    limit = fastest(config, mass)
    then = t - _ages(t, scenario)
    window = longest_delay(scenario.channel.lines()[0]) + _GENERATOR
    for g, per_s, command, actual, least, unit, scale in (
        (0, "m/s", sent[:, 4:], received[:, 4:], _FAR, "mm", 1e3),
        (1, "rad/s", _turned(sent, sent), _turned(received, sent), _TURNED, "degrees", _DEGREES),
    ):
        asked = np.column_stack([np.interp(then, t, x) for x in command.T])
        far = behind(t, asked, actual, _GENERATOR)
        way = np.linalg.norm(np.diff(command, axis=0, prepend=command[:1]), axis=1)
        speed = _largest_of_last(way[:, np.newaxis], round(window / row) + 1)[:, 0] / row
        held = (then >= t[0]) & (speed > limit[g]) & (far > least)
        if held.sum() * row < LASTING:
            continue
        enough = np.array(config.reserve)
        enough[g] *= (speed[held].max() / limit[g]) ** 2
        yield (
            f"the ledger's reserve lets the slave go at {limit[g]:.2g} {per_s}, and the hand wants"
            f" up to {speed[held].max():.2g}: {100 * held.mean():.0f} % of the time the slave's"
            f" command is up to {scale * far[held].max():.1f} {unit} from what it was told (move"
            f" more slowly, or declare the energy: passivity.ledger.reserve {_listed(enough)} and"
            f" initial {_listed(enough + config.hand_reserve)}),",
            spans_of(t, held),
        )


def _ages(t: Array, scenario: Scenario) -> Array:
    """Return (N,) age of the newest packet at the slave's end [s], from the run's network model."""
    period = 1.0 / scenario.rates.hand_hz
    step = np.rint((t + scenario.simulation.settle) / period).astype(int)
    line, seed = scenario.channel.lines()[0], scenario.simulation.seed
    return (step - newest_packets(line, seed, FORWARD, step[-1] + 1, period)[step]) * period


def _listed(values: Array) -> str:
    return "[" + ", ".join(f"{value:.2g}" for value in values) + "]"


def _joints(
    result: SimulationResult, scenario: Scenario, arm: ArmModel
) -> Iterator[tuple[str, Spans]]:
    if "joint_command" not in result:
        return
    t, command = result.t, result["joint_command"]
    actual = result["slave_state"][:, : command.shape[1]]
    window = _TIME_CONSTANTS * scenario.joint_control.lag + 1 / scenario.rates.joint_control_hz
    for k in range(command.shape[1]):
        far = behind(t, command[:, [k]], actual[:, [k]], window)
        slides = arm.table[k, SLIDES] != 0.0
        spans = spans_of(t, far > (_FAR if slides else _JOINT_FAR), LASTING)
        largest = _largest_in(t, far, spans)
        way = f"{1e3 * largest:.1f} mm" if slides else f"{np.rad2deg(largest):.1f} degrees"
        yield f"joint {k + 1} is up to {way} behind its command", spans
    hunting = hunts(t, command, actual, _JOINT_SWING)
    yield "the slave hunts: it goes to and fro uncommanded", spans_of(t, hunting, LASTING)


def _hand(result: SimulationResult) -> Iterator[tuple[str, Spans]]:
    if "intent" in result and "pose_master" in result:
        hunting = _sways(result.t, result["intent"], result["pose_master"], NEAR)
        yield "the hand hunts: it is shaken to and fro", spans_of(result.t, hunting, LASTING)


def _sways(t: Array, command: Array, actual: Array, near: float) -> Flags:
    """Return (N,) whether a pose (N, 7) oscillates in position or orientation."""
    turned, wanted = (_turned(pose, command) for pose in (actual, command))
    swaying = hunts(t, command[:, 4:], actual[:, 4:], _SWING, near)
    return swaying | hunts(t, wanted, turned, _TURN_SWING, near)


def _turned(pose: Array, reference: Array) -> Array:
    """Return (N, 4) twice the quaternion: its small changes equal the rotation [rad].

    The sign is that of the first pose of `reference`.
    """
    q: Array = pose[:, :4]
    return 2 * q * np.sign(q @ reference[0, :4])[:, np.newaxis]


def _joint_error(result: SimulationResult) -> Array:
    if "joint_command" not in result:
        return np.zeros((len(result.t), 1))
    command = result["joint_command"]
    return command - result["slave_state"][:, : command.shape[1]]


def _full_torque(torque: Array, master_state: Array, device: HapticDevice) -> Flags:
    """Return (N,) whether a wrist motor of the device gives its largest torque."""
    full, peak = np.zeros(len(torque), dtype=bool), _AT_LIMIT * device.peak_torque
    # A motor's torque is a component of the torque, so it is not larger.
    for k in np.flatnonzero(np.linalg.norm(torque, axis=1) >= peak.min()):
        turned = np.abs(torque[k] @ device.jacobian(master_state[k, :6])[3:, 3:])
        full[k] = (turned >= peak).any()
    return full


def _largest_of_last(x: Array, rows: int) -> Array:
    """Return (N, k) running maximum over the last `rows` rows, by doubling."""
    largest, done = x.copy(), 1
    while done < min(rows, len(x)):
        step = min(done, rows - done)
        largest[step:] = np.maximum(largest[step:], largest[:-step])
        done += step
    return largest


def _largest_in(t: Array, values: Array, spans: Spans) -> float:
    return max((float(values[(t >= a) & (t <= b)].max()) for a, b in spans), default=0.0)


def _when(spans: Spans) -> str:
    listed = [
        f"from {start:.3f} to {stop:.3f} s" if stop > start else f"at {start:.3f} s"
        for start, stop in spans[:_LISTED]
    ]
    more = len(spans) - _LISTED
    if more > 0:
        listed.append(f"{more} more time{'s' if more > 1 else ''}")
    return " and ".join([", ".join(listed[:-1]), listed[-1]] if len(listed) > 1 else listed)
