"""Records in which the load changes, and records in which something else happens."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from load_cases import rotations

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.inertia import transform_phi
from drake_teleop.load.online.segments import segments

FILE = Path(__file__).parents[2] / "benchmarks" / "load_change.py"
SEEDS = range(8)


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("load_change", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["JR3", "ideal"])
def test_the_instant_and_both_loads(bench, sensor):
    full = bench.TOOL + bench.OBJECT
    for seed in SEEDS:
        for kind, first, then in (("grasp", bench.TOOL, full), ("release", full, bench.TOOL)):
            rows = bench.record(sensor, seed, kind, first)
            before, after = segments(*rows, bench.PERIOD)
            assert before.start == 0 and before.stop <= after.start
            # In the 50 ms that it took; an ideal sensor shows them as a part that is no load.
            assert abs(before.stop * bench.PERIOD - bench.EVENT - 0.025) < 0.035
            if sensor == "JR3":
                assert before.stop == after.start
            assert 0 <= len(rows[0]) - after.stop < 16
            error = 0.01 if sensor == "JR3" else 1e-3
            assert before.load.mass == pytest.approx(first[0], rel=error)
            assert after.load.mass == pytest.approx(then[0], rel=error)


def test_grasped_and_released(bench):
    """Two changes, the load of the third part is that of the first."""
    grasped = bench.record("JR3", 11, "grasp")
    released = bench.record("JR3", 12, "release", bench.TOOL + bench.OBJECT)
    rows = [np.concatenate(pair) for pair in zip(grasped, released, strict=True)]
    found = segments(*rows, bench.PERIOD)
    assert [part.stop for part in found[:-1]] == pytest.approx([3025, 13025], abs=35)
    masses = [part.load.mass for part in found]
    assert masses == pytest.approx([3.13, 3.93, 3.13], rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["JR3", "ideal"])
@pytest.mark.parametrize("kind", ["free", "knock", "push", "hand", "along g"])
def test_nothing_else_is_a_change(bench, sensor, kind):
    for seed in SEEDS:
        assert segments(*bench.record(sensor, seed, kind), bench.PERIOD) == []


def test_a_contact_between_two_loads_is_left_out(bench):
    """A second of pushing with up to 40 N, then the object is in the gripper."""
    t = np.arange(0.0, bench.DURATION, bench.PERIOD)
    direction = [1.0, 0.2, -1.0, 0.1, 0.2, 0.05]
    for seed in SEEDS:
        F, *measured = bench.record("JR3", seed, "grasp")
        pushed = (t > 2.0) & (t < bench.EVENT)
        F[pushed] += np.outer(20.0 + 20.0 * np.sin(9.0 * t[pushed]), direction)
        before, after = segments(F, *measured, bench.PERIOD)
        assert before.stop == pytest.approx(2000, abs=200)
        assert after.start == pytest.approx(3000, abs=200)
        assert [before.load.mass, after.load.mass] == pytest.approx([3.13, 3.93], rel=0.01)


def test_a_contact_does_not_cut_a_load_in_two(bench):
    """Pushed for half a second, some time before the object is grasped."""
    t = np.arange(0.0, bench.DURATION, bench.PERIOD)
    pushed = (t > 1.2) & (t < 1.7)
    for seed in SEEDS[:3]:
        F, *measured = bench.record("JR3", seed, "grasp")
        F[pushed] += np.outer(20.0 + 20.0 * np.sin(9.0 * t[pushed]), [1.0, 0.2, -1.0, 0.1, 0.2, 0])
        before, after = segments(F, *measured, bench.PERIOD)
        assert before.start == 0
        assert before.stop == after.start == pytest.approx(3025, abs=35)
        assert [before.load.mass, after.load.mass] == pytest.approx([3.13, 3.93], rel=0.01)


@settings(max_examples=5, deadline=None)
@given(rotations())
def test_the_axes_of_the_sensor_do_not_matter(R):
    spec = importlib.util.spec_from_file_location("load_change", FILE)
    bench = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bench)
    F, *motion = bench.record("ideal", 2, "grasp")
    turned = [np.hstack([F[:, :3] @ R.T, F[:, 3:] @ R.T]), *(x @ R.T for x in motion)]
    before, after = segments(*turned, bench.PERIOD)
    plain = segments(F, *motion, bench.PERIOD)
    assert abs(before.stop - plain[0].stop) <= 48
    expected = transform_phi(plain[1].load.phi, R, np.zeros(3))
    np.testing.assert_allclose(after.load.phi, expected, atol=2e-3)


def test_short_records_and_bad_input(bench):
    rows = [x[:300] for x in bench.record("JR3", 0)]
    assert segments(*rows, bench.PERIOD) == []
    with pytest.raises(DrakeTeleopError, match="period: is not positive"):
        segments(*rows, 0.0)
    with pytest.raises(DrakeTeleopError, match="numbers of samples differ"):
        segments(rows[0][:-1], *rows[1:], bench.PERIOD)
