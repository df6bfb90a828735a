"""What was not as it should be in a run, and when, from its recorded signals.

============== =================================================================================
saturated      the wrist sensor says so
fault          numbers in the loop that cannot be, see `drake_teleop.common.fault`
unreachable    the inverse kinematics say so
clipped        a joint asks for its largest speed, or its motor gives its largest torque; the device
               displays its largest force or torque
leaf           it bends further than its model goes
safe state     an end of the channel has heard nothing for longer than the channel's timeout
behind         the command that leaves the channel, or a joint, is not within the range of what it
               was asked for within the time that delay and bandwidth explain
reserve        the command that leaves a `ledger` is behind a hand that is faster than the ledger's
               reserve pays for
hunting        the hand, the command that leaves the channel or a joint goes to and fro, while what
               it was asked for does not
============== =================================================================================

The first five are said however short they were, the others if they last for longer than 0.2 s; the
reserve's in all, because a hand that swings overtakes what is behind it.
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
"""What is over sooner [s] may be a movement's own."""
# What comes again sooner than this has not been away [s].
_GAP = 0.05
# As good as at a limit, which is reached by a product that rounds.
_AT_LIMIT = 1 - 1e-9
# How far behind is behind: command [m], its turn [rad], joint [rad], 3 mm at a reach of 1 m.
_FAR, _TURNED, _JOINT_FAR = 2e-3, np.deg2rad(1.0), np.deg2rad(0.2)
# After so long a ledger's command is where it was told to be [s], if energy is not short.
_GENERATOR = 0.05
_DEGREES = 180 / np.pi
# To and fro by more than this is hunting: hand and command [m], their turn [rad], joint [rad].
_SWING, _TURN_SWING, _JOINT_SWING = 5e-4, np.deg2rad(0.5), np.deg2rad(0.1)
NEAR = 0.25
"""So near to a turn of the command [s] a turn is that one's."""
# So many turns make it hunting, each within this time of the one before [s].
_TURNS, _SLOWEST = 4, 0.5
# After so many time constants of the position loop a command has been met to 0.3 %.
_TIME_CONSTANTS = 6.0
# More times than this are counted, not listed.
_LISTED = 3


def run_warnings(result: SimulationResult, scenario: Scenario, arm: ArmModel) -> list[str]:
    """One sentence for each thing of the table above that happened, with its times.

    Args:
        result: of a run; what was not recorded is not looked at.
        scenario: that was run.
        arm: the slave's, with its limits.
    """
    return [
        f"{what} {_when(spans)}"
        for found in (_faults(result), _limits(result, scenario, arm), _channel(result, scenario),
                      _joints(result, scenario, arm), _hand(result))
        for what, spans in found
        if spans
    ]  # fmt: skip


def spans_of(t: Array, happened: Flags, least: float = 0.0) -> Spans:
    """From when to when something was so, if for at least so long; short gaps are closed.

    Args:
        t: (N,) [s].
        happened: (N,).
        least: [s].
    """
    spans: Spans = []
    for start, stop in contact_spans(t, happened):
        if spans and start - spans[-1][1] < _GAP:
            start = spans.pop()[0]
        spans.append((start, stop))
    return [(start, stop) for start, stop in spans if stop - start >= least]


def behind(t: Array, command: Array, actual: Array, window: float) -> Array:
    """(N,) how far the actual motion is from all that was commanded within the last time `window`.

    A delay gives what was commanded earlier, and a loop that does not overshoot a weighted mean of
    it: both are in the range of those commands. What is outside it is explained by neither.

    Args:
        t: (N,) [s], evenly.
        command, actual: (N, k) in one unit.
        window: [s].
    """
    rows = max(round(window / (t[1] - t[0])), 1) + 1 if len(t) > 1 else 1
    above = actual - _largest_of_last(command, rows)
    below = -_largest_of_last(-command, rows) - actual
    return np.linalg.norm(np.maximum(np.maximum(above, below), 0.0), axis=1)


def turns(x: Array, swing: float) -> NDArray[np.intp]:
    """Where a signal turns: its extremes, each further than `swing` from the one before.

    Args:
        x: (N,).
        swing: in its unit.
    """
    slope = np.diff(x)
    near = np.flatnonzero(slope[1:] * slope[:-1] <= 0.0) + 1
    found: list[int] = []
    high = low = 0
    rising = 0  # unknown, until it has gone far enough from its start
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
    """(N,) whether the actual motion goes to and fro while the commanded one does not.

    Four turns or more, each within 0.5 s of the one before. A turn that is near one of the command
    is its answer; but only one for each.

    Args:
        t: (N,) [s].
        command, actual: (N, k) in one unit; a turn of any component of the command counts.
        swing: in that unit.
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
    """Of the slave; and of the hand what does not come from there."""
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
    # An end that hears nothing goes by the last packet until `timeout`.
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
    """Where `ledger` lets the slave go slower than the hand, for lack of energy."""
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
    """(N,) how old the newest packet was at the slave's end, for this network is the run's [s]."""
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
    """(N,) whether a pose (N, 7) hunts, by its place or its orientation."""
    turned, wanted = (_turned(pose, command) for pose in (actual, command))
    swaying = hunts(t, command[:, 4:], actual[:, 4:], _SWING, near)
    return swaying | hunts(t, wanted, turned, _TURN_SWING, near)


def _turned(pose: Array, reference: Array) -> Array:
    """(N, 4) of which a small change is as large as the turn [rad]: twice the quaternion.

    Its sign is that of the first pose of the reference.
    """
    q: Array = pose[:, :4]
    return 2 * q * np.sign(q @ reference[0, :4])[:, np.newaxis]


def _joint_error(result: SimulationResult) -> Array:
    if "joint_command" not in result:
        return np.zeros((len(result.t), 1))
    command = result["joint_command"]
    return command - result["slave_state"][:, : command.shape[1]]


def _full_torque(torque: Array, master_state: Array, device: HapticDevice) -> Flags:
    """(N,) whether a wrist motor of the device gives its largest torque."""
    full, peak = np.zeros(len(torque), dtype=bool), _AT_LIMIT * device.peak_torque
    # A motor's torque is the component about its axis: no larger than the torque.
    for k in np.flatnonzero(np.linalg.norm(torque, axis=1) >= peak.min()):
        turned = np.abs(torque[k] @ device.jacobian(master_state[k, :6])[3:, 3:])
        full[k] = (turned >= peak).any()
    return full


def _largest_of_last(x: Array, rows: int) -> Array:
    """(N, k) the largest of the last so many rows, by doubling."""
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
