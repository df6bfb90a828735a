"""Limits and rates of inputs are independent of the speed of the simulation."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from drake_teleop.live.device_link import DeviceLink
from drake_teleop.live.device_packets import DeviceState, pack_state
from drake_teleop.live.inputs import INPUT_RANGES, Inputs
from drake_teleop.live.live import Live
from drake_teleop.live.motion_limits import InputRateIntegrator, MotionLimiter
from drake_teleop.live.scenarios import with_task_space_device
from drake_teleop.station.scenario import Scenario, replace

NAMES = ("x", "y", "z", "rx", "ry", "rz")


def pose_of(inputs: Inputs) -> np.ndarray:
    """Return [m, rad] at the hand."""
    return np.array([getattr(inputs, name) for name in NAMES]) * np.repeat([1e-5, 1e-4], 3)


def inputs_of(values: np.ndarray) -> Inputs:
    """Return the inputs of [m, rad]."""
    units = values / np.repeat([1e-5, 1e-4], 3)
    return Inputs().with_changes(dict(zip(NAMES, units.tolist(), strict=True)))


@pytest.mark.parametrize(("slice_s", "device"), [(2e-3, True), (5e-3, False)])
def test_a_motion_within_the_limits_passes_unchanged(slice_s, device):
    limiter = MotionLimiter(slice_s, (1.0, 1.0), device=device)
    for k in range(400):
        t = k * slice_s
        begun = min(t / 0.2, 1.0)
        ramp = begun**2 * (3.0 - 2.0 * begun)
        target = inputs_of(ramp * np.array([0.02, 0, -0.01, 0.1, -0.1, 0]) * math.sin(20.0 * t))
        assert limiter.limit_inputs(target, may_jump=False) == target


@pytest.mark.parametrize("scales", [(0.5, 4.0), (1.0, 1.0), (4.0, 0.5)])
@pytest.mark.parametrize(("slice_s", "device"), [(2e-3, True), (5e-3, False)])
def test_speed_and_acceleration_of_the_tool_are_limited_and_it_arrives(slice_s, device, scales):
    limiter = MotionLimiter(slice_s, scales, device=device)
    rng, target, path = np.random.default_rng(0), Inputs(), []
    for k in range(4000):
        if k % 40 == 0 and k < 3000:
            target = inputs_of(rng.uniform(-0.16, 0.16, 6) * [1, 1, 1, 7, 7, 7])  # partly outside
        path.append(pose_of(limiter.limit_inputs(target, may_jump=False)))
    tool = np.repeat(scales, 3) * path
    speed = np.diff(tool, axis=0) / slice_s
    roundings = np.array([2e-5, 2e-4]) * scales / slice_s
    limits = (slice(3), 0.8, 20.0), (slice(3, 6), 8.0, 250.0)
    for (part, most, change), rounding in zip(limits, roundings, strict=True):
        assert 0.9 * most < np.abs(speed[:, part]).max() < most + rounding
        if device:
            changes = np.abs(np.diff(speed[:, part], axis=0))
            assert changes.max() < change * slice_s + 2.0 * rounding
    np.testing.assert_array_equal(path[-1], pose_of(target))


def test_limited_motion_stops_without_overshoot():
    limiter, path = MotionLimiter(2e-3, (1.0, 1.0), device=True), []
    for _ in range(300):
        path.append(
            limiter.limit_inputs(inputs_of(np.array([0.05, 0, 0, 0, 0, 0.5])), may_jump=False)
        )
    assert max(each.x for each in path) <= 5000 * 1.01 and path[-1].x == 5000
    assert max(each.rz for each in path) <= 5000 * 1.01 and path[-1].rz == 5000
    assert path[60].x > 2500  # as soon as 20 m/s^2 allow


def test_free_target_may_jump():
    limiter, target = MotionLimiter(2e-3, (1.0, 1.0), device=True), inputs_of(np.full(6, 0.1))
    assert limiter.limit_inputs(target, may_jump=True) == target
    assert limiter.limit_inputs(target, may_jump=False) == target


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("slow", "rates"),
    [(10, {"x": 12_000, "rz": 5000}), (1, {"z": -777.7}), (1, {"y": 2400, "x": 0})],
)
def test_keys_move_the_hand_equally_per_simulated_second(scenario, load, slow, rates):
    now, live = 0.0, Live(scenario, load, None, lambda rows: {}, 0.0)
    live.join(1, now)
    live.handle_message(1, json.dumps({"slow": slow, "rates": rates}), now)
    while live.simulated_ms < 300:
        now += max(live.time_to_next_tick(now), 1e-3)
        live.tick(lambda now=now: now)
        live.handle_message(1, json.dumps({"rates": rates}), now)
    live.handle_message(1, json.dumps({"rates": {}}), now)
    found = live.frame()["inputs"]
    for name in NAMES:
        assert found[name] == pytest.approx(1e-3 * live.simulated_ms * rates.get(name, 0), abs=0.51)
    live.tick(lambda: now + slow)
    assert live.frame()["inputs"] == found


def test_rate_ends_one_second_after_its_last_repetition():
    steering, inputs = InputRateIntegrator(), Inputs()
    inputs = steering.set_rates({"x": 1000.0, "sigma": 9.0, "held": 1.0}, inputs, 0.0)
    for k in range(400):
        inputs = steering.advance_inputs(inputs, 5e-3, 5e-3 * k)
        assert inputs.sigma == 0
    assert inputs.x == pytest.approx(1000, abs=6)
    inputs = steering.set_rates({"x": 1e9}, inputs, 0.0)
    assert steering.advance_inputs(inputs, 5e-3, 0.1).x == INPUT_RANGES["x"][1]


def test_reversed_rate_leaves_the_end_of_the_range_at_once():
    steering, end = InputRateIntegrator(), INPUT_RANGES["x"][1]
    inputs = steering.set_rates({"x": 1e5}, Inputs(), 0.0)
    for k in range(100):
        inputs = steering.advance_inputs(inputs, 5e-3, 5e-3 * k)
    assert inputs.x == end
    inputs = steering.set_rates({"x": -1e4}, inputs, 0.5)
    for k in range(10):
        inputs = steering.advance_inputs(inputs, 5e-3, 0.5 + 5e-3 * k)
    assert end - 800 < inputs.x < end - 500  # 10 slices of 50, and the lead


def test_a_target_that_is_set_ends_a_rate(scenario, load):
    live = Live(scenario, load, None, lambda rows: {}, 0.0)
    live.join(1, 0.0)
    for text in ({"rates": {"x": 5000}}, {"set": {"x": 300}}):
        live.handle_message(1, json.dumps(text), 0.0)
        for _ in range(4):
            live._simulate_time_slice(0.0)
    assert live.frame()["inputs"]["x"] == 300


@pytest.fixture
def noisy(scenario) -> Scenario:
    """Return a scenario with a saturating sensor and a leaf out of reach."""
    sensor = {"wrist_sensor__ideal": False, "wrist_sensor__offset": [0.0] * 6}
    return replace(scenario, sheet_spring=None, **sensor)


@pytest.mark.quick_cases(2)
@pytest.mark.slow
@pytest.mark.parametrize(("slow", "jumps"), [(1, True), (5, True), (10, False), (20, True)])
def test_a_mouse_renders_no_force_in_free_motion_at_any_speed(noisy, load, slow, jumps):
    """The mouse moves by 60 mm at 1 Hz of real time."""
    now, rendered = 0.0, []
    live = Live(noisy, load, None, lambda rows: {}, now)
    live.join(1, now)
    live.handle_message(1, json.dumps({"slow": slow}), now)
    while live.simulated_ms < 500:
        sine = math.sin(2.0 * math.pi * now)
        target = 6000.0 * (math.copysign(1.0, sine) if jumps else sine)
        live.handle_message(1, json.dumps({"set": {"x": target, "z": 0.5 * target}}), now)
        frame = live.tick(lambda now=now: now)
        rendered += [frame["f"][2][1]] if frame and "f" in frame else []
        now += max(live.time_to_next_tick(now), 1e-3)
    assert len(rendered) > 20 and max(rendered) < 0.5


@pytest.mark.quick_cases(2)
@pytest.mark.slow
@pytest.mark.parametrize(("rate", "burst"), [(0.12, 6), (1.0, 1), (1.0, 50), (0.5, 25), (0.12, 1)])
def test_a_device_renders_no_force_in_free_motion_when_the_machine_is_slow(
    noisy, load, rate, burst
):
    """The device moves up and down by 45 mm with rests; slices come in bursts."""
    link = DeviceLink("udp://127.0.0.1:0")
    live = Live(with_task_space_device(noisy), load, None, lambda rows: {}, 0.0, link)
    rendered, now, due, number = [], 0.0, 0.0, 0
    while live.simulated_ms < 600:
        now, number = now + 1e-3, number + 1
        up = 0.045 * max(-1.0, min(3.0 * math.sin(2.0 * math.pi * now), 1.0))
        packet = pack_state(DeviceState(number, now, (up, 0.0, up)))
        link._accept_or_refuse_packet(packet, ("127.0.0.1", 9), now)
        if now >= due:
            for _ in range(burst):
                live._simulate_time_slice(now)
            due += burst * 2e-3 / rate
            rendered.append(live.frame()["f"][2][1])
    live.close()
    assert max(rendered) < 0.5
