"""Warnings of a run: only planted conditions are reported, with their times."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from drake_teleop.common.files import models_dir
from drake_teleop.lab.identification import slave_arm, true_load
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import NetworkConfig, longest_delay
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.master.data_sheets import DeviceFigures, Master
from drake_teleop.station.master.leader_model import Leader
from drake_teleop.station.master.phantom import (
    HOME_POSTURE_RAD,
    PEAK_FORCE_N,
    PEAK_WRIST_TORQUES_N_M,
    jacobian_into,
)
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig
from drake_teleop.station.oscillation import (
    doubled_quaternions,
    find_contact_chatter,
    flag_unexplained_oscillation,
    reversal_indices,
)
from drake_teleop.station.passivity.ledger import LedgerConfig
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.run_warnings import (
    find_spans,
    lag_beyond_delay,
    run_warnings,
)
from drake_teleop.station.scenario import Scenario, Simulation, replace
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.signals import SIGNALS
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import IS_PRISMATIC_COLUMN
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.joint_control import JointControlConfig, PositionInterface
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.scene import Scene
from drake_teleop.station.station import MakeTeleopStation

T = np.arange(3001) / 1000
ARM = slave_arm(Scenario())
OVER_NETWORK = replace(
    Scenario(),
    channel=Channel(network="internet", timeout=0.1),
    passivity=PassivityConfig(method="two_layer"),
)
LATE = 0.05  # s, mean delay of the recorded channel, that of "internet"


def smooth(t):
    """Return a smooth step from 0 to 1 between 0.5 s and 1.3 s."""
    u = np.clip((t - 0.5) / 0.8, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def during(start: float, stop: float):
    return (start - 1e-9 < T) & (stop + 1e-9 > T)


def recorded(**changed):
    """Return a normal run over a network: a movement of 7 cm, or 0.2 rad of joint 2."""

    def pose(z):
        return np.column_stack([np.ones_like(T), *np.zeros((5, len(T))), z])

    def joints(angle):
        return np.column_stack([np.zeros_like(T), angle, *np.zeros((4, len(T)))])

    signals = {
        "saturated": np.zeros((len(T), 1)),
        "slave_state": np.column_stack([joints(0.2 * smooth(T - LATE - 0.016)), joints(0 * T)]),
        "joint_torque": joints(np.full_like(T, 20.0)),
        "intent": pose(-0.07 * smooth(T)),
        "master_state": np.tile([*HOME_POSTURE_RAD, *np.zeros(6)], (len(T), 1)),
        "pose_master": pose(-0.07 * smooth(T - 0.02)),
        "pose_command": pose(-0.07 * smooth(T)),
        "joint_command": joints(0.2 * smooth(T - LATE)),
        "ik_status": np.zeros((len(T), 1)),
        "force_to_master": np.zeros((len(T), 6)),
        "pose_received": pose(-0.07 * smooth(T - LATE)),
        "ports": np.zeros((len(T), 8)),
    }
    for name, (column, change) in changed.items():
        signals[name] = signals[name].copy()
        signals[name][:, column] += change
    order = [name for name in SIGNALS if name in signals]
    return SimulationResult(T, signals, [SIGNALS[name] for name in order])


PLANTED = [
    ("saturated", (0, during(1.0, 1.1)), "the wrist sensor saturates from 1.000 to 1.100 s"),
    ("saturated", (0, during(1.0, 1.0)), "the wrist sensor saturates at 1.000 s"),
    ("ik_status", (0, 3.0 * during(1, 2)), "OUT_OF_REACH from 1.000 to 2.000 s"),
    ("joint_torque", (4, 1e4 * during(2.5, 2.6)), "joint 5 is at its largest torque"),
    ("joint_command", (0, 0.2 * during(2.0, 2.1)), "joint 1 is at its largest speed"),
    ("force_to_master", (2, PEAK_FORCE_N * during(1, 2)), "its largest force or torque from 1.000"),
    ("master_state", (1, 2.1 * during(1, 2)), "at the end of its workspace from 1.000 to 2.000 s"),
    ("ports", (4, 0.15 * during(1, 2)), "master's end is in its safe state, no packets arrive"
     " from the slave, from 1.000 to 2.000 s"),
    ("ports", (5, np.where(during(1, 2), np.inf, 0)), "slave's end is in its safe state"),
    # The error of 4 cm is unexplained from 0.5 s + half of the movement + delay on.
    ("pose_received", (6, 0.04 * smooth(T)), "the channel (two_layer, network internet) delays"
     " the slave's command: up to 40.0 mm more than its delay explains, from 0.9"),
    ("pose_received", (3, 0.1 * during(2, 2.5)), "11.5 degrees more"),
    ("slave_state", (5, 0.01 * during(1, 1.5)), "joint 6 is up to 0.6 degrees behind"),
    ("slave_state", (3, 0.004 * np.sin(40 * T) * during(1, 2)), "the slave oscillates"),
    ("pose_master", (5, 0.002 * np.sin(15 * T) * during(1, 3)), "the hand oscillates"),
    ("pose_master", (1, 0.005 * np.sin(190 * T) * during(2, 3)), "the hand oscillates while its"
     " intent does not, from 2.0"),
    ("pose_received", (2, 0.005 * np.sin(40 * T) * during(2, 3)), "makes the slave's command"
     " oscillate"),
    ("force_to_master", (0, 0.1 * np.sin(2 * np.pi * 44 * T) * during(2, 3)), "the rendered force"
     " oscillates at 44 Hz with up to 0.07 N rms while the hand rests"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "said"), PLANTED, ids=[said for *_, said in PLANTED])
def test_only_the_planted_condition_is_reported(name, change, said):
    (warning,) = run_warnings(recorded(**{name: change}), OVER_NETWORK, ARM)
    assert said in warning


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("force_to_master", (2, PEAK_FORCE_N * during(1.0, 1.15))),
        ("ports", (5, 0.15 * during(1.0, 1.15))),
        ("pose_received", (6, 0.04 * during(1.6, 1.75))),
        ("slave_state", (5, 0.01 * during(1.0, 1.15))),
        # A response that rings twice, and an invisible tremor.
        ("pose_master", (5, 0.003 * np.exp(-8 * (T - 1)) * np.sin(25 * (T - 1)) * (T > 1))),
        ("slave_state", (3, 0.0008 * np.sin(40 * T) * during(1, 2))),
        ("force_to_master", (0, 0.06 * np.sin(2 * np.pi * 44 * T))),
        ("force_to_master", (0, np.sin(2 * np.pi * 44 * T) * during(0.5, 1.4))),
    ],
    ids=["display", "silence", "channel", "joint", "ringing", "tremble", "weak", "moving"],
)
def test_short_or_small_deviations_are_not_reported(name, change):
    assert run_warnings(recorded(**{name: change}), OVER_NETWORK, ARM) == []


def without_network(force):
    result = recorded(force_to_master=(slice(0, 3), force))
    names = [name for name in result.signals if name != "ports"]
    signals = {name: result[name] for name in names}
    return SimulationResult(T, signals, [SIGNALS[name] for name in names])


@pytest.mark.parametrize("noise", [0.0, 0.08])
def test_force_that_oscillates_at_rest_without_network_is_reported(noise):
    force = noise * np.random.default_rng(4).normal(size=(len(T), 3))
    force[:, 2] += 0.25 * np.sin(2 * np.pi * 62 * T) * during(2, 3)
    (warning,) = run_warnings(without_network(force), Scenario(), ARM)
    assert "rendered force oscillates at 62 Hz" in warning
    assert warning.endswith("; reduce force_scaling.gamma or force_scale")


@pytest.mark.quick_cases(4)
@pytest.mark.parametrize("seed", range(10))
def test_noise_of_the_force_at_rest_is_no_oscillation(seed):
    noise = 0.1 * np.random.default_rng(seed).normal(size=(len(T), 3))
    for force in (noise, gaussian_filter1d(3 * noise, 3, axis=0)):
        assert run_warnings(without_network(force), Scenario(), ARM) == []


@pytest.mark.parametrize("rms", [4.0, 12.0])
def test_force_too_large_for_sensor_noise_is_reported(rms):
    """A stiff wall lets the force chatter without one frequency."""
    force = rms * np.random.default_rng(4).normal(size=(len(T), 3)) * during(2, 3)[:, None]
    (warning,) = run_warnings(without_network(force), Scenario(), ARM)
    assert "the rendered force oscillates" in warning


def test_missed_orientation_of_an_arm_with_five_joints_is_no_warning(monkeypatch):
    result = recorded(ik_status=(0, IkStatus.WRIST_SINGULAR * during(1.0, 2.0)))
    assert "WRIST_SINGULAR from 1.000 to 2.000 s" in run_warnings(result, OVER_NETWORK, ARM)[0]
    monkeypatch.setattr(type(ARM), "num_joints", 5)
    assert run_warnings(result, OVER_NETWORK, ARM) == []
    result = recorded(ik_status=(0, IkStatus.OUT_OF_REACH * during(1.0, 2.0)))
    assert len(run_warnings(result, OVER_NETWORK, ARM)) == 1


def test_normal_run_has_no_warnings():
    assert run_warnings(recorded(), OVER_NETWORK, ARM) == []
    assert run_warnings(recorded(pose_received=(0, -2.0)), OVER_NETWORK, ARM) == []  # -q for q


def test_command_may_be_late_by_the_delay_of_the_forward_network():
    channel = Channel(delay=0.4, backward=NetworkConfig(delay=0.01), timeout=0.05)
    later = {"pose_received": (6, -0.07 * (smooth(T - 0.4) - smooth(T - LATE)))}
    assert run_warnings(recorded(**later), replace(OVER_NETWORK, channel=channel), ARM) == []
    swapped = Channel(delay=0.01, backward=NetworkConfig(delay=0.4), timeout=0.05)
    (warning,) = run_warnings(recorded(**later), replace(OVER_NETWORK, channel=swapped), ARM)
    assert "more than its delay explains" in warning


def test_speed_limit_of_a_position_interface_is_reported():
    interface = PositionInterface(max_speed=0.5)
    servo = JointControlConfig(servo="position", interface=interface)
    fast = recorded(joint_command=(0, 0.06 * during(2.0, 2.1)))  # 0.57 rad/s
    (warning,) = run_warnings(fast, replace(OVER_NETWORK, joint_control=servo), ARM)
    assert "joint 1 is at its largest speed from 2.000 to 2.100 s" in warning


def test_fault_at_the_hand_is_reported_unless_the_slave_has_one():
    run, faults = recorded(), {"fault": 2.0 * during(1, 2), "fault_at_hand": 5.0 * during(1.5, 3)}
    signals = {name: run[name] for name in run} | {k: v[:, None] for k, v in faults.items()}
    order = [SIGNALS[name] for name in SIGNALS if name in signals]
    found = run_warnings(SimulationResult(T, signals, order), OVER_NETWORK, ARM)
    assert [each.rpartition("from ")[2] for each in found] == [
        "1.000 to 2.000 s",
        "2.001 to 3.000 s",
    ]


def test_overlap_at_the_start_is_reported_with_bodies_depth_and_remedy():
    """The face of the wall is 20 mm above or below the end of the tool."""
    tip = NominalSlave(Scenario().slave).p_WTip_start
    for depth, count in ((0.02, 1), (-0.02, 0)):
        wall = Wall(position=[*tip[:2], tip[2] + depth], size=[0.05, 0.05])
        found = run_warnings(recorded(), replace(OVER_NETWORK, environment=[wall]), ARM)
        assert len(found) == count
        for warning in found:
            assert warning.startswith("tool and wall overlap by 20.0 mm at the start")
            assert warning.endswith("environment, or give another start in slave.home")


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "count"), [(0.9, 1), (9.0, 0)])
def test_motors_of_a_leader_that_limit_the_force_are_reported(limit, count):
    home = np.array([0.2, -0.6, 1.9, 0.3, 0.5, -0.2])
    leader = Leader(str(models_dir() / "leader_arm.urdf"), hand_frame="hand", home=home.tolist())
    leader.torque_limit = [limit]
    device = leader.device(Scenario().master.position, 0.0, 0.0)
    share = 0.9 / np.abs(device.jacobian(home).T @ [0, 0, 1, 0, 0, 0]).max()
    changed = {
        "master_state": (slice(0, 6), home - HOME_POSTURE_RAD),
        "force_to_master": (2, share * during(1, 2)),
    }
    scenario = replace(OVER_NETWORK, master=Master(model="leader", leader=leader))
    found = run_warnings(recorded(**changed), scenario, ARM)
    assert len(found) == count
    assert all("its largest force or torque" in each for each in found)


@pytest.mark.parametrize(
    ("torque", "peak", "count"),
    [
        ([0.5, 0.0, 0.0], 0.5, 1),
        ([0.1, -0.3, 0.3], 0.3, 1),
        ([0.4, 0.0, 0.3], 0.45, 0),  # below the limit about each axis, the norm above it
        ([0.2, -0.2, 0.2], 0.3, 0),
        ([0.0, 0.0, 0.0], 0.0, 0),  # a leader without torque display
    ],
)
def test_torque_of_a_leader_is_limited_about_each_axis(torque, peak, count):
    home = [0.2, -0.6, 1.9, 0.3, 0.5, -0.2]
    leader = Leader(str(models_dir() / "leader_arm.urdf"), hand_frame="hand", home=home)
    leader.torque_limit, leader.peak_torque = [1e3], peak
    changed = {
        "master_state": (slice(0, 6), home - HOME_POSTURE_RAD),
        "force_to_master": (slice(3, 6), np.outer(during(1, 2), torque)),
    }
    scenario = replace(OVER_NETWORK, master=Master(model="leader", leader=leader))
    found = run_warnings(recorded(**changed), scenario, ARM)
    assert len(found) == count
    assert all("its largest force or torque from 1.000 to 2.000 s" in each for each in found)


@pytest.mark.parametrize("peak_force", [0.0, 20.0])
def test_device_without_motors_is_not_at_its_largest_force(peak_force):
    figures = DeviceFigures(peak_force=peak_force)
    scenario = replace(OVER_NETWORK, master=Master(model="custom", figures=figures))
    shown = {"force_to_master": (slice(0, 3), np.outer(during(1, 2), [0.0, 0.0, peak_force]))}
    found = run_warnings(recorded(**shown), scenario, ARM)
    assert sum("largest force" in each for each in found) == (peak_force > 0.0)


@pytest.mark.parametrize("step", [100, 500, 1000, 1500])
def test_log_with_few_rows_has_no_warnings(step):
    assert run_warnings(recorded()[::step], OVER_NETWORK, ARM) == []
    assert run_warnings(recorded()[:0], OVER_NETWORK, ARM) == []


def test_ledger_reserve_warning_gives_the_required_energy():
    """The hand moves at up to 0.164 m/s; 0.02 J allow the slave 0.091 m/s."""
    scenario = replace(
        Scenario(),
        channel=Channel(delay=LATE),
        passivity=PassivityConfig(method="ledger", ledger=LedgerConfig(reserve=[0.02, 0.01])),
    )
    assert run_warnings(recorded(), scenario, ARM) == []
    held = np.clip(0.0904 * (T - 0.7 - LATE), 0.0, 0.07) - 0.07 * smooth(T - LATE)
    slower = {"pose_received": (6, -held)}
    found = [x for x in run_warnings(recorded(**slower), scenario, ARM) if "reserve" in x]
    (warning,) = found
    assert warning.startswith("the ledger's reserve limits the slave to 0.091 m/s, and the command")
    assert "moves at up to 0.16: " in warning
    # Distance to the nearest command of the last 50 ms.
    far = float(warning.split("command is up to ")[1].split(" mm")[0])
    assert 0.0 < 1e3 * np.abs(held).max() - far < 50 * 0.164
    # The required energy is (0.164 / 0.0905)^2 times the reserve; the hand's reserve of 0.02 J is
    # added to the start energy.
    assert "passivity.ledger.reserve [0.066, 0.01] and initial [0.086, 0.011]" in warning
    quiet = replace(scenario, passivity__ledger=LedgerConfig())
    assert not any("reserve" in x for x in run_warnings(recorded(**slower), quiet, ARM))


def test_wrist_motor_limit_uses_the_device_axes():
    q, J = np.array([0.3, 0.2, 0.4, -0.5, 0.6, 0.7]), np.empty((6, 6))
    jacobian_into.py_func(q, J)
    posture = (slice(0, 6), q - HOME_POSTURE_RAD)
    about = J[3:, 5]  # the last axis, with the weakest motor
    for share, warnings in ((1.0, 1), (0.99, 0)):
        torque = share * PEAK_WRIST_TORQUES_N_M[2] * during(1, 2)[:, np.newaxis] * about
        full = (slice(3, 6), torque)
        found = run_warnings(
            recorded(force_to_master=full, master_state=posture), OVER_NETWORK, ARM
        )
        assert len(found) == warnings
        assert all("the device displays its largest force or torque from 1.000" in x for x in found)


def test_spans_close_gaps_and_skip_short_spans():
    happened = during(0.5, 0.6) | during(0.62, 1.0) | during(2.0, 2.1)
    assert find_spans(T, happened) == [(0.5, 1.0), (2.0, 2.1)]
    assert find_spans(T, happened, 0.2) == [(0.5, 1.0)]
    assert find_spans(T, 0 * T > 1) == []


def test_further_times_are_counted():
    happened = np.sin(2 * np.pi * 2 * T) > 1e-9
    (warning,) = run_warnings(recorded(saturated=(0, happened)), OVER_NETWORK, ARM)
    assert warning.count("from") == 3
    assert " and 3 more times; move more slowly" in warning


def test_lag_of_prismatic_joint_is_in_millimetres():
    sliding = dataclasses.replace(ARM, table=ARM.table.copy())
    sliding.table[5, IS_PRISMATIC_COLUMN] = 1.0
    late = recorded(slave_state=(5, 0.003 * during(1, 1.5)))
    (warning,) = run_warnings(late, OVER_NETWORK, sliding)
    assert "joint 6 is up to 3.0 mm behind" in warning
    assert run_warnings(late, OVER_NETWORK, ARM) == []
    assert (
        run_warnings(recorded(slave_state=(5, 0.001 * during(1, 1.5))), OVER_NETWORK, sliding) == []
    )


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.3])
def test_lag_excludes_delay_and_low_pass(delay):
    command = np.column_stack([np.sin(5 * T), np.cos(3 * T)])
    late = np.column_stack([np.sin(5 * (T - delay)), np.cos(3 * (T - delay))])
    late[delay > T] = command[0]
    assert lag_beyond_delay(T, command, late, 0.3 + 1e-9).max() < 1e-9
    slow = command.copy()
    for k in range(1, len(T)):
        slow[k] = slow[k - 1] + 0.001 / 0.05 * (command[k - 1] - slow[k - 1])
    assert lag_beyond_delay(T, command, slow, 0.3).max() < 2 * np.exp(-6)
    step = np.where(T > 1.0 + 1e-9, 1.0, 0.0)[:, np.newaxis] * [3.0, 4.0]
    found = lag_beyond_delay(T, step, 0 * step, 0.2)
    np.testing.assert_allclose(found, np.where(T > 1.2 + 1e-9, 5.0, 0.0))


def test_reversals_are_extremes_beyond_the_swing():
    x = np.sin(2 * np.pi * T) + 0.01 * np.sin(2 * np.pi * 50 * T)
    np.testing.assert_allclose(T[reversal_indices(x, 0.1)], np.arange(6) / 2 + 0.25, atol=0.02)
    assert len(reversal_indices(x, 0.005)) > 50
    assert len(reversal_indices(np.zeros(10), 0.1)) == len(reversal_indices(T, 0.1)) == 0


def test_following_an_oscillating_command_is_no_oscillation():
    command = 0.066 * np.sin(2 * np.pi * 2.63 * T)[:, np.newaxis]
    follows = 0.06 * np.sin(2 * np.pi * 2.63 * (T - 0.06))[:, np.newaxis]
    assert not flag_unexplained_oscillation(T, command, follows, 5e-4).any()
    assert flag_unexplained_oscillation(T, 0 * command, follows, 5e-4).mean() > 0.8
    slow = 0.02 * np.sin(2 * np.pi * 2 * T)[:, np.newaxis]
    shaken = slow.copy()
    shaken[during(1, 2), 0] += 0.003 * np.sin(2 * np.pi * 20 * T[during(1, 2)])
    found = T[flag_unexplained_oscillation(T, slow, shaken, 5e-4)]
    assert 0.95 < found[0] < 1.1
    assert 1.9 < found[-1] < 2.05
    assert len(found) > 800


def test_the_longest_delay_is_that_of_the_latest_packet(tmp_path):
    assert longest_delay(NetworkConfig(delay=0.1, jitter=0.5, distribution="gamma")) == 0.4
    assert longest_delay(NetworkConfig(delay=0.1, playout=0.2)) == 0.2
    (tmp_path / "trace.csv").write_text("time,delay\n0,0.02\n1,0.07\n2,\n")
    found = longest_delay(NetworkConfig(trace=str(tmp_path / "trace.csv")))
    assert found == pytest.approx(0.07)


def touching(rate_hz, start, stop, peak=20.0, rest=0.0):
    """Return the force (N,) of half sines that fill half of each period, above `rest` [N]."""
    force = np.where(during(start, stop), peak * np.sin(2 * np.pi * rate_hz * (T - start)), 0.0)
    return np.maximum(force, rest)


@pytest.mark.parametrize("rate_hz", [5.5, 10.0, 40.0, 98.0])
@pytest.mark.parametrize("rest", [0.0, 1.5])
def test_chatter_is_reported_with_rate_force_and_time(rate_hz, rest):
    stop = 0.5 + max(9 / rate_hz, 0.4)
    (found,) = find_contact_chatter(T, touching(rate_hz, 0.5, stop, rest=rest), np.empty(0))
    assert found.rate_hz == pytest.approx(rate_hz, rel=0.02)
    assert found.peak_force == pytest.approx(20.0, rel=0.02)
    assert found.num_touches == pytest.approx((stop - 0.5) * rate_hz, abs=1.1)
    assert (found.start, found.stop) == pytest.approx((0.5, stop), abs=1.05 / rate_hz + 2e-3)


@pytest.mark.parametrize(
    "force",
    [
        touching(4.0, 0.5, 2.9),
        touching(20.0, 0.5, 0.84),  # 7 touches
        touching(40.0, 0.5, 0.78),  # too short
        touching(47.0, 0.5, 2.5, rest=4.0),  # contact persists by friction
        touching(40.0, 0.5, 2.5, peak=0.3),
        touching(300.0, 0.5, 2.5),  # one touch-down with small bounces
        sum(touching(60.0, start, start + 0.05) for start in (0.5, 1.0, 1.5)),
        0.0 * T,
    ],
)
def test_slow_short_shallow_or_weak_touches_are_no_chatter(force):
    assert find_contact_chatter(T, force, np.empty(0)) == []


def test_touches_that_the_operator_intends_are_no_chatter():
    contact = {"true_contact_wrench_W": np.column_stack([*np.zeros((2, len(T)))] + 4 * [0 * T])}
    for rate_hz, tapping in ((6.0, True), (30.0, False)):
        contact["true_contact_wrench_W"][:, 2] = touching(rate_hz, 0.5, 2.5)
        result = recorded(intent=(6, 0.01 * np.sin(2 * np.pi * 6.0 * T) * during(0.4, 2.6)))
        signals = {name: result[name] for name in result.signals} | contact
        order = [SIGNALS[name] for name in SIGNALS if name in signals]
        found = run_warnings(SimulationResult(T, signals, order), OVER_NETWORK, ARM)
        assert any("contact chatter" in warning for warning in found) != tapping


DRAWER = """<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="drawer"><link name="rail"/>
<link name="drawer"><inertial><mass>0.3</mass>
<inertia><ixx>0.001</ixx><iyy>0.001</iyy><izz>0.001</izz></inertia></inertial>
<collision name="front"><geometry><box><size>0.1 0.1 0.04</size></box></geometry>
<drake:proximity_properties><drake:point_contact_stiffness>2e4</drake:point_contact_stiffness>
<drake:hunt_crossley_dissipation>0.2</drake:hunt_crossley_dissipation>
<drake:mu_dynamic>0.3</drake:mu_dynamic></drake:proximity_properties></collision></link>
<joint name="slide" type="prismatic"><parent>rail</parent><child>drawer</child><axis>
<xyz>0 0 1</xyz><limit><lower>-0.1</lower><upper>0.1</upper><effort>0</effort></limit><dynamics>
<damping>DAMPING</damping><spring_stiffness>300</spring_stiffness></dynamics></axis></joint>
</model></sdf>"""


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "chatters"), [(0.2, True), (3.0, False)])
def test_chatter_on_a_spring_loaded_drawer_is_reported(tmp_path, damping, chatters):
    (tmp_path / "drawer.sdf").write_text(DRAWER.replace("DAMPING", str(damping)))
    drawer = Scene(file=str(tmp_path / "drawer.sdf"), position=[0.55, 0.0, 0.2])
    move = MinimumJerk(t_start=0.3, duration=0.8, translation=[0.0, 0.0, -0.08])
    scenario = replace(
        Scenario(),
        simulation=Simulation(duration=0.8, settle=0.5),
        operator=OperatorConfig(intent=[move]),
        environment=[drawer],
    )
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    found = run_warnings(simulate(station, scenario.simulation), scenario, slave_arm(scenario))
    assert len(found) == chatters
    assert all("touches at 3" in x and "damping of its joint" in x for x in found), found


@pytest.mark.slow
def test_slave_follows_with_a_late_wrist_sensor():
    """The sample, with its accelerations, is 6 ms late.

    Energy must not be calculated with joint angles of that time: it would empty the slave's tank,
    and the slave would lag by 4 cm without a warning.
    """
    move = MinimumJerk(t_start=0.5, duration=0.8, translation=[0.0, 0.0, -0.07])
    scenario = replace(
        OVER_NETWORK,
        simulation=Simulation(duration=1.1, settle=0.0),
        operator=OperatorConfig(intent=[move]),
        wrist_sensor=PRESETS["ati_gamma_imu"],
        force_scaling__sigma=1.0,  # so that no load is needed
    )
    result = simulate(MakeTeleopStation(scenario), scenario.simulation)
    assert run_warnings(result, scenario, slave_arm(scenario)) == []
    sent, received = result["pose_command"][:, 6], result["pose_received"][:, 6]
    assert sent[-1] < 0.42  # the slave moves
    assert abs(received[-1] - np.interp(result.t[-1] - LATE, result.t, sent)) < 2e-3


@pytest.mark.parametrize("dot", [-0.5, -0.0, 0.0, 0.5])
def test_doubled_quaternions_have_norm_2_and_the_nearer_sign(dot):
    reference = np.array([[1.0, 0.0, 0.0, 0.0, 9.0, 9.0, 9.0]])
    pose = np.array([[dot, np.sqrt(1.0 - dot**2), 0.0, 0.0, 1.0, 2.0, 3.0]])
    (doubled,) = doubled_quaternions(pose, reference)
    assert np.linalg.norm(doubled) == pytest.approx(2.0)
    assert doubled[0] >= 0.0
