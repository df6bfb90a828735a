"""Online detection of a changed load, its distinction from contact, and its identification."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.identification import Identification, load_of_object
from drake_teleop.load.normal_equations import NoiseStd
from drake_teleop.load.online.change import (
    MIN_NEW_LOAD_AGE_S,
    OBJECT_PRIOR_STD,
    current_state_index,
    update_change_detector,
)
from drake_teleop.load.regressor import non_contact_wrench, regressor

FILE = Path(__file__).parents[2] / "benchmarks" / "load_change.py"
KNOWN, DISTURBED, CHANGED, IDENTIFIED = range(4)
SEEDS = range(6)


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("load_change", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tool(bench) -> Identification:
    return bench.known("JR3")


def share(phi, whole):
    return phi[0] / whole[0] - 1.0


def test_motion_of_the_benchmark_is_a_body_motion(bench):
    """alpha is the derivative of omega; the vertical rotates against the body."""
    _, (s, omega, alpha), up = bench.motion(3)
    change = np.gradient(omega, bench.PERIOD, axis=0)[1:-1]
    np.testing.assert_allclose(change, alpha[1:-1], atol=1e-3 * np.abs(alpha).max())
    turning = np.gradient(up, bench.PERIOD, axis=0)[1:-1]
    np.testing.assert_allclose(turning, -np.cross(omega, up)[1:-1], atol=1e-3)
    assert np.linalg.norm(s - 9.81 * up, axis=1).max() < 10.0


@pytest.mark.slow
def test_free_motion_is_not_a_load_change(bench, tool):
    for seed in SEEDS:
        states = bench.monitor("JR3", tool).watch(*bench.record("JR3", seed))
        assert states.max() == KNOWN


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grasp", "release"])
def test_object_is_detected_and_identified(bench, tool, kind):
    """The alarm takes under 50 ms, the change under 0.5 s; the mass is within 1 %."""
    full = bench.TOOL + bench.OBJECT
    before = tool if kind == "grasp" else bench.known("JR3", full)
    for seed in SEEDS:
        monitor = bench.monitor("JR3", before)
        rows = bench.record("JR3", seed, kind, bench.TOOL if kind == "grasp" else full)
        states = monitor.watch(*rows)
        assert states[: int(bench.EVENT / bench.PERIOD)].max() == KNOWN
        alarm, change = (int(np.argmax(states >= k)) * bench.PERIOD - bench.EVENT for k in (1, 2))
        assert 0.0 < alarm < 0.05
        assert alarm + MIN_NEW_LOAD_AGE_S - 0.02 < change < 0.5
        assert -0.02 < monitor.changed_at - bench.EVENT < 0.3
        assert states[-1] == IDENTIFIED
        pair = (monitor.load, before) if kind == "grasp" else (before, monitor.load)
        found = load_of_object(*pair)
        error = np.concatenate([[share(found.phi, bench.OBJECT)], (found.phi - bench.OBJECT)[1:4]])
        assert abs(error[0]) < 0.01
        # Covariances add, so the stated uncertainty covers the error.
        assert (np.abs(error[1:]) < 4.5 * found.standard_deviations[7:10]).all()
        assert abs(error[0]) * 0.8 < 4.5 * found.standard_deviations[6]
        assert (np.abs(monitor.load.offsets - bench.OFFSETS) < 0.2).all()
        # The residual is the noise of a sample: for the force at least that of the sensor.
        assert (monitor.load.residual_rms[:3] > 0.2).all()
        assert (monitor.load.residual_rms[:3] < 1.2).all()


def test_an_ideal_sensor_finds_the_object_exactly_and_then_the_next(bench):
    monitor = bench.monitor("ideal", bench.known("ideal"))
    states = monitor.watch(*bench.record("ideal", 1, "grasp"))
    assert states[-1] == IDENTIFIED
    np.testing.assert_allclose(monitor.load.phi, bench.TOOL + bench.OBJECT, atol=1e-9)
    # With an identified object, its release is another change.
    full = bench.TOOL + bench.OBJECT
    again = monitor.watch(*bench.record("ideal", 2, "release", full))
    assert again[: int(bench.EVENT / bench.PERIOD)].max() == IDENTIFIED
    assert DISTURBED in again
    assert again[-1] == IDENTIFIED
    np.testing.assert_allclose(monitor.load.phi, bench.TOOL, atol=1e-9)


@pytest.mark.parametrize("sensor", ["JR3", "ideal"])
@pytest.mark.parametrize("kind", ["knock", "push", "hand", "along g"])
def test_contact_is_never_identified_as_a_load_and_is_reset_at_its_end(bench, sensor, kind):
    before = bench.known(sensor)
    for seed in SEEDS:
        monitor = bench.monitor(sensor, before)
        states = monitor.watch(*bench.record(sensor, seed, kind))
        assert states.max() < IDENTIFIED
        assert states[-1] == KNOWN and monitor.load is before
        assert states.max() >= DISTURBED
        if kind == "knock" or sensor == "ideal":
            assert states.max() < CHANGED


def test_vertical_push_at_rest_counts_as_weight_until_the_tool_moves(bench, tool):
    """Push and weight are equal at rest; in motion the push has a constant direction in S."""
    t, moving, up = bench.motion(5)
    still = [np.tile(x[:1] * keep, (len(t), 1)) for x, keep in zip(moving, (1, 0, 0), strict=True)]
    still[0] = np.tile(9.81 * up[:1], (len(t), 1))
    arm = np.array([0.0, 0.0, 0.2])
    rng = np.random.default_rng(0)
    monitor = bench.monitor("JR3", tool)
    for clean, vertical, expected in (
        (still, np.tile(up[:1], (len(t), 1)), CHANGED),
        (moving, up, 1),
    ):
        F = bench.OFFSETS + non_contact_wrench(*clean, bench.TOOL)
        F += 6.0 * np.hstack([vertical, np.cross(arm, vertical)])
        wrench_std, motion_std = bench.SENSORS["JR3"]
        F += np.repeat(wrench_std, 3) * rng.normal(size=F.shape)
        clean = [x + n * rng.normal(size=x.shape) for x, n in zip(clean, motion_std, strict=True)]
        states = monitor.watch(F, *clean)
        assert states.max() < IDENTIFIED
        assert np.bincount(states[1000:]).argmax() == expected


def test_object_grasped_at_rest_is_identified_in_motion(bench, tool):
    """A change is detected at once; the load is identified only in motion.

    Noise of alpha biases the inertias at rest. In motion they do not fit, and the fit restarts.
    """
    t, moving, up = bench.motion(6)
    still = [np.tile(x[:1], (len(t), 1)) for x in (9.81 * up, 0 * up, 0 * up)]
    rng, monitor = np.random.default_rng(6), bench.monitor("JR3", tool)
    wrench_std, motion_std = bench.SENSORS["JR3"]
    for clean, phi, last in (
        (still, bench.TOOL, KNOWN),
        (still, bench.TOOL + bench.OBJECT, CHANGED),
        (moving, bench.TOOL + bench.OBJECT, IDENTIFIED),
    ):
        F = bench.OFFSETS + non_contact_wrench(*clean, phi)
        F += np.repeat(wrench_std, 3) * rng.normal(size=F.shape)
        noisy = [x + n * rng.normal(size=x.shape) for x, n in zip(clean, motion_std, strict=True)]
        states = monitor.watch(F, *noisy)
        assert states[-1] == last
        assert (states[500:] >= min(last, CHANGED)).all()
    assert monitor.changed_at == pytest.approx(20.0, abs=0.5)
    assert monitor.load.mass - tool.mass == pytest.approx(0.8, rel=0.01)


def test_load_is_identified_in_slow_motion_with_noisy_alpha(bench, tool):
    """Noise dominates alpha in slow motion, and makes estimated inertias too small."""
    t, clean, up = bench.motion(8)
    turn = 0.6 * np.sin(0.8 * t)
    rate, change = 0.48 * np.cos(0.8 * t), -0.384 * np.sin(0.8 * t)
    axis = np.array([0.6, 0.8, 0.0])
    s = 9.81 * np.stack([-0.8 * np.sin(turn), 0.6 * np.sin(turn), np.cos(turn)], axis=1)
    s += clean[0] - 9.81 * up
    motion = [s, np.outer(rate, axis), np.outer(change, axis)]
    rng, monitor = np.random.default_rng(8), bench.monitor("JR3", tool)
    wrench_std, motion_std = bench.SENSORS["JR3"]
    for phi in (bench.TOOL, bench.TOOL + bench.OBJECT):
        F = bench.OFFSETS + non_contact_wrench(*motion, phi)
        F += np.repeat(wrench_std, 3) * rng.normal(size=F.shape)
        noisy = [x + n * rng.normal(size=x.shape) for x, n in zip(motion, motion_std, strict=True)]
        states = monitor.watch(F, *noisy)
    assert states[-1] == IDENTIFIED
    error = monitor.load.phi - bench.TOOL - bench.OBJECT
    assert (np.abs(error[4:]) < 3.0 * monitor.load.standard_deviations[10:]).all()
    assert error[4] < -0.005 and not monitor.load.identifiable[10]


@pytest.mark.slow
def test_coloured_noise_of_the_stated_long_run_variance_is_no_change(bench, tool):
    """AR(1) noise with a memory of 2 ms: the long-run variance is far above that of samples."""
    pole = 0.6
    for seed in SEEDS:
        rng, (t, clean, _) = np.random.default_rng(seed), bench.motion(seed)
        white = np.repeat([0.25, 0.012], 3) * rng.normal(size=(len(t), 6))
        F = bench.OFFSETS + non_contact_wrench(*clean, bench.TOOL)
        F += lfilter([1.0 - pole], [1.0, -pole], white, axis=0)
        states = bench.Monitor(tool, np.repeat([0.25, 0.012], 3), np.zeros(9)).watch(F, *clean)
        assert states.max() == KNOWN


def test_errors_of_gain_and_cross_talk_are_no_change_if_stated(bench, tool):
    """The load was identified with the same sensor, but in another motion."""
    noise = NoiseStd(np.repeat([0.25, 0.012], 3), 0.06, 0.0, 1.5)
    alarms = {0.0: 0, 0.01: 0}
    for seed in SEEDS:
        per_channel = np.repeat([1.0, 0.1], 3)
        wrong = np.random.default_rng(seed).uniform(-0.01, 0.01, (6, 6))
        gains = np.eye(6) + wrong * np.outer(per_channel, 1.0 / per_channel)
        F, *measured = bench.record("JR3", seed + 1000)
        load = identify_batch(F @ gains.T, *measured, method="total", noise=noise).identification
        F, *measured = bench.record("JR3", seed)
        grasped, *also = bench.record("JR3", seed, "grasp")
        std = [np.repeat(x, 3) for x in bench.SENSORS["JR3"]]
        for error in alarms:
            monitor = bench.Monitor(load, *std, 1e-3, relative_wrench_error=error)
            alarms[error] += int(monitor.watch(F @ gains.T, *measured).max() > KNOWN)
        monitor = bench.Monitor(load, *std, 1e-3, relative_wrench_error=0.01)
        assert monitor.watch(grasped @ gains.T, *also)[-1] == IDENTIFIED
        assert monitor.load.mass - load.mass == pytest.approx(0.8, rel=0.03)
    assert alarms[0.01] == 0 < alarms[0.0]


def test_the_new_load_is_the_least_squares_solution_with_the_known_prior(bench, tool):
    """The reference is a numpy solution from the means of the same blocks."""
    noise = np.repeat([0.25, 0.012], 3)
    monitor = bench.Monitor(tool, noise, np.zeros(9), 1e-3, offset_drift=np.full(6, 0.01))
    _, clean, _ = bench.motion(4)
    F = bench.OFFSETS + non_contact_wrench(*clean, bench.TOOL + bench.OBJECT)
    F += noise * np.random.default_rng(4).normal(size=F.shape)
    states = monitor.watch(F, *clean)
    stop, start = int(np.argmax(states == IDENTIFIED)) + 1, round(monitor.changed_at * 1e3)
    assert stop > start >= 16 and (stop - start) % 16 == 0
    assert monitor.load.samples == stop - start

    def means(x):
        return x[start:stop].reshape(-1, 16, *x.shape[1:]).mean(axis=1)

    V = means(regressor(*clean))
    rows = np.concatenate([np.broadcast_to(np.eye(6), (len(V), 6, 6)), V], axis=2)
    weights = 16.0 / noise**2
    prior = tool.covariance.copy()
    prior[np.arange(16), np.arange(16)] += np.concatenate(
        [np.full(6, 1e-4), np.square(OBJECT_PRIOR_STD)]
    )
    information = np.linalg.inv(prior)
    gram = np.einsum("nci,c,ncj->ij", rows, weights, rows) + information
    right = np.einsum("nci,c,nc->i", rows, weights, means(F))
    right += information @ np.concatenate([tool.offsets, tool.phi])
    expected = np.linalg.solve(gram, right)
    np.testing.assert_allclose(monitor.load.phi, expected[6:], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(monitor.load.offsets, expected[:6], rtol=1e-6)
    np.testing.assert_allclose(monitor.load.covariance, np.linalg.inv(gram), rtol=1e-4, atol=1e-12)


def test_single_samples_give_the_same_states_as_a_log(bench, tool):
    rows = [x[2900:3400] for x in bench.record("JR3", 7, "grasp")]
    at_once, single = bench.monitor("JR3", tool), bench.monitor("JR3", tool)
    states = at_once.watch(*rows)
    for k, row in enumerate(zip(*rows, strict=True)):
        update_change_detector(single.memory, np.concatenate([*row, [0.0]]), *single.parameters)
        assert current_state_index(single.memory) == states[k]
    assert states[-1] == CHANGED
    np.testing.assert_array_equal(single.memory, at_once.memory)


def test_undetermined_inertias_raise_no_alarm(bench, tool):
    """Undetermined inertias have no finite variance: no alarm, and the result can be saved."""
    covariance = tool.covariance.copy()
    covariance[10:, :] = covariance[:, 10:] = 0.0
    covariance[range(10, 16), range(10, 16)] = np.inf
    phi = np.concatenate([tool.phi[:4], np.zeros(6)])
    poses = replace(tool, phi=phi, covariance=covariance)
    monitor = bench.monitor("JR3", poses)
    assert monitor.watch(*bench.record("JR3", 0)).max() == KNOWN
    assert monitor.watch(*bench.record("JR3", 1, "grasp"))[-1] == IDENTIFIED
    assert monitor.load.phi[0] == pytest.approx(3.93, abs=0.02)
    assert np.isfinite(monitor.load.covariance).all()


def test_two_samples_per_block_detect_the_change(bench, tool):
    """A block has two samples at 100 Hz."""
    rows = [x[::10] for x in bench.record("JR3", 3, "grasp")]
    std = [np.repeat(x, 3) for x in bench.SENSORS["JR3"]]
    states = bench.Monitor(tool, *std, 1e-2).watch(*rows)
    assert states[:300].max() == KNOWN
    assert (states == CHANGED).any()
    assert np.argmax(states == CHANGED) < 350


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"period": 0.0}, "period: has the value 0, which is not positive"),
        (
            {"relative_wrench_error": 1.0},
            r"relative_wrench_error: 1.0 is outside the range 0 <= relative_wrench_error < 1",
        ),
        ({"mass_std_ratio": -1.0}, "mass_std_ratio: has the value -1, which is not positive"),
        ({"wrench_std": np.zeros(6)}, "wrench_std: has the value 0, which is not positive"),
        ({"motion_std": np.zeros(6)}, "motion_std: has shape"),
        ({"offset_drift": np.full(6, np.nan)}, "offset_drift: is not finite"),
    ],
)
def test_invalid_input_raises(bench, tool, change, words):
    good = {"wrench_std": np.ones(6), "motion_std": np.zeros(9), "period": 1e-3}
    with pytest.raises(DrakeTeleopError, match=words):
        bench.Monitor(tool, **(good | change))
    monitor = bench.Monitor(tool, **good)
    with pytest.raises(DrakeTeleopError, match="wrench: is not finite"):
        monitor.watch(np.full((1, 6), np.inf), *np.zeros((3, 1, 3)))
