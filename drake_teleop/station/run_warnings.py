"""Warnings about a simulated run, from its recorded signals and overlapping shapes at its start."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from drake_teleop.common.blocks import FAULT_WARNINGS, Fault
from drake_teleop.common.numeric import Array, contact_spans
from drake_teleop.load.regressor import LOST_SAMPLE_FLAG_THRESHOLD
from drake_teleop.station import channel_side, oscillation
from drake_teleop.station.channel.network import FORWARD, longest_delay, newest_packets
from drake_teleop.station.master.dynamics import HapticDevice
from drake_teleop.station.master.leader import LeaderDevice
from drake_teleop.station.oscillation import doubled_quaternions, flag_pose_oscillation
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.posture_shapes import start_overlap_texts

Flags = NDArray[np.bool_]
Spans = list[tuple[float, float]]
Warnings = Iterator[tuple[str, Spans, str]]
"""Condition, time spans and advice of each warning."""

_MIN_WARNING_SPAN_S = 0.2
"""Shortest reported duration [s]; a normal motion may cause shorter ones."""
_MAX_GAP_OF_JOINED_SPANS_S = 0.05  # shorter gaps between time spans are closed
_WARNED_LIMIT_SHARE = 1 - 1e-9  # share from which a limit counts as reached (rounding)
_WARNED_MOTOR_LIMIT_SHARE = 0.999  # of a leader's motors, which the joints' motion changes
# Smallest reported lag: command [m], orientation of the command [rad], joint [rad] (3 mm at 1 m).
_MIN_WARNED_COMMAND_LAG_M = 2e-3
_MIN_COMMAND_LAG_RAD, _MIN_JOINT_LAG_RAD = np.deg2rad(1.0), np.deg2rad(0.2)
_LEDGER_COMMAND_SETTLING_TIME_S = 0.05  # with sufficient energy
_DEGREES_PER_RAD = 180 / np.pi
_MIN_JOINT_OSCILLATION_SWING_RAD = np.deg2rad(0.1)
_JOINT_SETTLING_TIME_CONSTANTS = 6.0  # of the position loop, until the error is 0.3 %
_MIN_INTENT_REST_S, _MAX_INTENT_REST_MOTION_M = 0.5, 1e-4
_MIN_FORCE_OSCILLATION_CYCLES = 4
_MIN_POWER_SHARE_NEAR_PEAK = 0.5  # near its frequency; white noise has less than 0.3
_ASSUMED_SENSOR_NOISE_RMS_N = 2.0
_MAX_LISTED_SPANS = 3  # further time spans are counted
_REDUCE_FORCE_ADVICE = "reduce force_scaling.gamma or force_scale"


def run_warnings(result: SimulationResult, scenario: Scenario, arm: ArmModel) -> list[str]:
    """Return a warning, with times, for each condition in docs/running.md that occurred.

    Checks whose optional signals were not recorded are skipped.
    """
    overlaps, _ = start_overlap_texts(scenario.slave, scenario.surroundings)
    if not len(result.t):
        return [*overlaps]
    found = chain(
        _check_faults(result),
        _check_reached_limits(result, scenario, arm),
        _check_channel_silence_and_lag(result, scenario),
        _check_joint_tracking(result, scenario, arm),
        _check_hand_oscillation(result),
        _check_contact_chatter(result),
        _check_rendered_force_oscillation(result),
    )
    texts = [f"{text} {_spans_text(x)}{note and '; '}{note}" for text, x, note in found if x]
    return [*overlaps, *texts]


def find_spans(t: Array, flags: Flags, min_duration: float = 0.0) -> Spans:
    """Return the time spans (start, stop) [s] during which `flags` (N,) is true.

    Gaps below 50 ms are closed; then spans shorter than `min_duration` [s] are dropped.
    """
    spans: Spans = []
    for start, stop in contact_spans(t, flags):
        if spans and start - spans[-1][1] < _MAX_GAP_OF_JOINED_SPANS_S:
            start = spans.pop()[0]
        spans.append((start, stop))
    return [(start, stop) for start, stop in spans if stop - start >= min_duration]


def lag_beyond_delay(t: Array, command: Array, actual: Array, window: float) -> Array:
    """Return distances (N,) of `actual` (N, k) from the range of `command` (N, k) in a window.

    The window is the last `window` [s]: a pure delay gives 0. Times `t` [s] are evenly spaced.
    """
    rows = max(round(window / (t[1] - t[0])), 1) + 1 if len(t) > 1 else 1
    above = actual - _trailing_maximum(command, rows)
    below = -_trailing_maximum(-command, rows) - actual
    return np.linalg.norm(np.maximum(np.maximum(above, below), 0.0), axis=1)


def _check_faults(result: SimulationResult) -> Warnings:
    t = result.t
    names = ("fault", "fault_at_hand")
    slave, hand = (result[n][:, 0] if n in result else np.zeros(len(t)) for n in names)
    for fault, meaning in FAULT_WARNINGS.items():
        if fault != Fault.RESUMING:
            happened = (slave == fault) | ((hand == fault) & (slave == 0))
            yield f"a fault: {meaning},", find_spans(t, happened), ""


def _check_reached_limits(result: SimulationResult, scenario: Scenario, arm: ArmModel) -> Warnings:
    t, flag = result.t, result["saturated"][:, 0]
    spans = find_spans(t, (flag > 0) & (flag < LOST_SAMPLE_FLAG_THRESHOLD))
    yield "the wrist sensor saturates", spans, "move more slowly, or use larger sensor ranges"
    if "ik_status" in result:
        # Fewer than six joints miss a part of nearly each pose; the assumptions contain it.
        for status in list(IkStatus)[1 if arm.num_joints > 5 else 2 :]:
            happened = result["ik_status"][:, 0] == status
            advice = "use smaller or slower motions, or another start posture"
            yield f"inverse kinematics: status {status.name}", find_spans(t, happened), advice
    control = scenario.joint_control
    checked = [("torque", result["joint_torque"], arm.effort_limit)]
    if "joint_command" in result:
        command, fastest = result["joint_command"], arm.velocity_limit
        if control.position_interface is not None:
            fastest = np.minimum(fastest, control.position_interface.max_speed)
        error = command - result["slave_state"][:, : command.shape[1]]
        checked.insert(0, ("speed", control.position_loop_gain_per_s * error, fastest))
    for what, values, limit in checked:
        clipped = np.abs(values) >= _WARNED_LIMIT_SHARE * limit
        for joint in np.flatnonzero(clipped.any(axis=0)):
            spans, advice = find_spans(t, clipped[:, joint]), "use smaller or slower motions"
            yield f"joint {joint + 1} is at its largest {what}", spans, advice
    if "force_to_master" in result:
        shown, device = result["force_to_master"], scenario.master.device(0.0, 0.0)
        limits = device.parameters
        largest_force = limits.peak_force or np.inf  # 0: the device has no motors
        full = np.linalg.norm(shown[:, :3], axis=1) >= _WARNED_LIMIT_SHARE * largest_force
        if isinstance(device, LeaderDevice):
            reached = np.abs(shown[:, 3:]) >= _WARNED_LIMIT_SHARE * limits.peak_torque
            full |= reached.any(axis=1) & limits.peak_torque.all()
            joints = result["master_state"][:, : device.num_joints]
            full |= device.flag_samples_at_motor_limit(joints, shown, _WARNED_MOTOR_LIMIT_SHARE)
        elif limits.peak_torque.all():
            full |= _is_torque_at_limit(shown[:, 3:], result["master_state"], device)
        spans = find_spans(t, full, _MIN_WARNING_SPAN_S)
        yield "the device displays its largest force or torque", spans, _REDUCE_FORCE_ADVICE
        ended = device.flag_samples_at_end_stop(result["master_state"][:, : device.num_joints])
        advice = "use smaller motions, or increase kinematic_scaling.translation_scale"
        yield "the device is at the end of its workspace", find_spans(t, ended), advice
    if scenario.first_sheet_spring is not None and "sheet_state" in result:
        bent = scenario.first_sheet_spring.max_deflection_of_linear_model
        text = f"the deflection of the leaf exceeds {1e3 * bent:.0f} mm, the limit of its model,"
        spans = find_spans(t, np.abs(result["sheet_state"][:, 0]) > bent)
        yield text, spans, "reduce the contact force"


def _check_channel_silence_and_lag(result: SimulationResult, scenario: Scenario) -> Warnings:
    if "ports" not in result:
        return
    t, timeout = result.t, scenario.channel.timeout_s(1.0 / scenario.rates.hand_hz)
    for end, other in (("master", "slave"), ("slave", "master")):
        spans = find_spans(t, result[f"ports.{end}_silent"] > timeout, _MIN_WARNING_SPAN_S)
        text = f"the {end}'s end is in its safe state, no packets arrive from the {other},"
        yield text, spans, "check loss, delay and timeout of the channel"
    # An end without new packets uses the last one until `timeout`.
    window = longest_delay(scenario.channel.networks_of_directions()[0]) + timeout
    sent, received = result["pose_command"], result["pose_received"]
    by = f"{scenario.passivity.method}, network {scenario.channel.network}"
    for command, actual, least, unit, scale in _pose_parts_with_lag_limits(sent, received):
        lag = lag_beyond_delay(t, command, actual, window)
        spans = find_spans(t, lag > least, _MIN_WARNING_SPAN_S)
        largest = _maximum_within_spans(t, lag, spans)
        late = f"up to {scale * largest:.1f} {unit} more than its delay explains,"
        advice = "move more slowly, or use another passivity method"
        yield f"the channel ({by}) delays the slave's command: {late}", spans, advice
    yield from _check_speed_permitted_by_reserve(result, scenario)
    window += oscillation.COMMAND_REVERSAL_WINDOW_S
    oscillating = flag_pose_oscillation(t, sent, received, window)
    spans = find_spans(t, oscillating, _MIN_WARNING_SPAN_S)
    advice = "use another passivity method or network"
    yield f"the channel ({by}) makes the slave's command oscillate", spans, advice


def _check_speed_permitted_by_reserve(result: SimulationResult, scenario: Scenario) -> Warnings:
    speed_limit = METHODS[scenario.passivity.method].speed_limit
    if speed_limit is None or len(result.t) < 2:
        return
    t, sent, received = result.t, result["pose_command"], result["pose_received"]
    config, row = scenario.passivity.method_config(), t[1] - t[0]
    mass = np.array(channel_side.passivity_config_with_arm_mass(scenario).slave_mass)
    limit = speed_limit(config, mass * channel_side.slave_to_master_power_unit_scale(scenario))
    forward, period = scenario.channel.networks_of_directions()[0], 1.0 / scenario.rates.hand_hz
    step = np.rint((t + scenario.simulation.settle) / period).astype(int)
    newest = newest_packets(forward, scenario.simulation.seed, FORWARD, step[-1] + 1, period)
    then = t - (step - newest[step]) * period  # when the newest received packet was sent
    window = longest_delay(forward) + _LEDGER_COMMAND_SETTLING_TIME_S
    parts = _pose_parts_with_lag_limits(sent, received)
    for g, (command, actual, least, unit, scale) in enumerate(parts):
        asked = np.column_stack([np.interp(then, t, x) for x in command.T])
        far = lag_beyond_delay(t, asked, actual, _LEDGER_COMMAND_SETTLING_TIME_S)
        way = np.linalg.norm(np.diff(command, axis=0, prepend=command[:1]), axis=1)
        speed = _trailing_maximum(way[:, np.newaxis], round(window / row) + 1)[:, 0] / row
        held = (then >= t[0]) & (speed > limit[g]) & (far > least)
        if held.sum() * row < _MIN_WARNING_SPAN_S:
            continue
        enough, speed_unit = np.array(config.reserve), ("m/s", "rad/s")[g]
        enough[g] *= (speed[held].max() / limit[g]) ** 2
        yield (
            f"the {scenario.passivity.method}'s reserve limits the slave to {limit[g]:.2g}"
            f" {speed_unit}, and the command moves at up to {speed[held].max():.2g}:"
            f" for {100 * held.mean():.0f} % of the time"
            f" the slave's command is up to {scale * far[held].max():.1f} {unit} from the received"
            " pose,",
            find_spans(t, held),
            f"move more slowly, or increase passivity.{scenario.passivity.method}.reserve"
            f" {_format_list(enough)} and initial {_format_list(enough + config.hand_reserve)}",
        )


def _pose_parts_with_lag_limits(
    command: Array, actual: Array
) -> tuple[tuple[Array, Array, float, str, float], ...]:
    """Return command, actual, largest lag, its unit and unit factor of position and rotation."""
    wanted, turned = (doubled_quaternions(pose, command) for pose in (command, actual))
    return (
        (command[:, 4:], actual[:, 4:], _MIN_WARNED_COMMAND_LAG_M, "mm", 1e3),
        (wanted, turned, _MIN_COMMAND_LAG_RAD, "degrees", _DEGREES_PER_RAD),
    )


def _format_list(values: Array) -> str:
    return "[" + ", ".join(f"{value:.2g}" for value in values) + "]"


def _check_joint_tracking(result: SimulationResult, scenario: Scenario, arm: ArmModel) -> Warnings:
    if "joint_command" not in result:
        return
    t, command = result.t, result["joint_command"]
    actual = result["slave_state"][:, : command.shape[1]]
    window = _JOINT_SETTLING_TIME_CONSTANTS * scenario.joint_control.tracking_delay_s
    window += 1 / scenario.rates.joint_control_hz
    for k in range(command.shape[1]):
        far = lag_beyond_delay(t, command[:, [k]], actual[:, [k]], window)
        slides = k in arm.sliding_joints
        least = _MIN_WARNED_COMMAND_LAG_M if slides else _MIN_JOINT_LAG_RAD
        spans = find_spans(t, far > least, _MIN_WARNING_SPAN_S)
        largest = _maximum_within_spans(t, far, spans)
        way = f"{1e3 * largest:.1f} mm" if slides else f"{np.rad2deg(largest):.1f} degrees"
        advice = "move more slowly, or increase the bandwidth of joint_control"
        yield f"joint {k + 1} is up to {way} behind its command", spans, advice
    least = _MIN_JOINT_OSCILLATION_SWING_RAD
    oscillating = oscillation.flag_unexplained_oscillation(t, command, actual, least)
    spans = find_spans(t, oscillating, _MIN_WARNING_SPAN_S)
    advice = "change the bandwidth of joint_control, or damp the touched object"
    yield "the slave oscillates while its command does not,", spans, advice


def _check_hand_oscillation(result: SimulationResult) -> Warnings:
    if "intent" in result and "pose_master" in result:
        oscillating = flag_pose_oscillation(result.t, result["intent"], result["pose_master"])
        spans = find_spans(result.t, oscillating, _MIN_WARNING_SPAN_S)
        yield "the hand oscillates while its intent does not,", spans, _REDUCE_FORCE_ADVICE


def _check_contact_chatter(result: SimulationResult) -> Warnings:
    if "true_contact_wrench_W" not in result:
        return
    force = np.linalg.norm(result["true_contact_wrench_W"][:, :3], axis=1)
    reversals = np.empty(0)
    if command := next((name for name in ("intent", "pose_command") if name in result), ""):
        reversals = oscillation.pose_reversal_times(result.t, result[command])
    if found := oscillation.find_contact_chatter(result.t, force, reversals):
        worst = max(found, key=lambda chatter: chatter.peak_force)
        yield (
            f"contact chatter of the tool: {sum(each.num_touches for each in found)} touches at"
            f" {worst.rate_hz:.2g} Hz with up to {worst.peak_force:.3g} N",
            [(chatter.start, chatter.stop) for chatter in found],
            "increase dissipation of the touched surface or damping of its joint, or reduce"
            " force_scaling.force_scale or kinematic_scaling.translation_scale",
        )


def _check_rendered_force_oscillation(result: SimulationResult) -> Warnings:
    if not {"intent", "force_to_master"} <= set(result.signals):
        return
    t, intent = result.t, result["intent"][:, 4:]
    force = oscillation.high_pass_above_5_hz(t, result["force_to_master"][:, :3])
    rows = max(round(_MIN_INTENT_REST_S / (t[1] - t[0])), 1) if len(t) > 1 else 1
    largest, least = _trailing_maximum(intent, rows), -_trailing_maximum(-intent, rows)
    rests = np.linalg.norm(largest - least, axis=1) < _MAX_INTENT_REST_MOTION_M
    rests[:rows] = False
    rms = np.sqrt(np.maximum(uniform_filter1d((force**2).sum(axis=1), rows), 0.0))
    oscillates = rests & (rms > oscillation.MAX_FORCE_RIPPLE_RMS_AT_REST_N)
    spans = find_spans(t, oscillates, _MIN_WARNING_SPAN_S)
    if not spans:
        return
    start, stop = max(spans, key=lambda span: span[1] - span[0])
    part = force[(t >= start) & (t <= stop)]
    strongest = part[:, part.std(axis=0).argmax()]
    crossings = np.count_nonzero(np.diff(np.signbit(strongest)))
    if crossings < 2 * _MIN_FORCE_OSCILLATION_CYCLES:  # a step is no oscillation
        return
    over_network = "ports" in result
    frequency, share = oscillation.dominant_frequency(t, part)
    largest_rms = _maximum_within_spans(t, rms, spans)
    small = largest_rms < _ASSUMED_SENSOR_NOISE_RMS_N
    if not over_network and small and share < _MIN_POWER_SHARE_NEAR_PEAK:
        return  # noise of the sensor
    ledger = ", or increase passivity.ledger.initial with ledger" if over_network else ""
    size = f"{frequency:.2g} Hz with up to {largest_rms:.2g} N rms"
    text = f"the rendered force oscillates at {size} while the hand rests"
    yield text, spans, f"{_REDUCE_FORCE_ADVICE}{ledger}"


def _is_torque_at_limit(torque: Array, master_state: Array, device: HapticDevice) -> Flags:
    full, peak = np.zeros(len(torque), bool), _WARNED_LIMIT_SHARE * device.parameters.peak_torque
    # A motor's torque is a component of the torque, so it is not larger.
    for k in np.flatnonzero(np.linalg.norm(torque, axis=1) >= peak.min()):
        turned = np.abs(torque[k] @ device.jacobian(master_state[k, :6])[3:, 3:])
        full[k] = (turned >= peak).any()
    return full


def _trailing_maximum(x: Array, num_rows: int) -> Array:
    largest, done = x.copy(), 1
    while done < min(num_rows, len(x)):
        step = min(done, num_rows - done)
        largest[step:] = np.maximum(largest[step:], largest[:-step])
        done += step
    return largest


def _maximum_within_spans(t: Array, values: Array, spans: Spans) -> float:
    return max((float(values[(t >= a) & (t <= b)].max()) for a, b in spans), default=0.0)


def _spans_text(spans: Spans) -> str:
    listed = [
        f"from {start:.3f} to {stop:.3f} s" if stop > start else f"at {start:.3f} s"
        for start, stop in spans[:_MAX_LISTED_SPANS]
    ]
    more = len(spans) - _MAX_LISTED_SPANS
    if more > 0:
        listed.append(f"{more} more time{'s' if more > 1 else ''}")
    return " and ".join([", ".join(listed[:-1]), listed[-1]] if len(listed) > 1 else listed)
