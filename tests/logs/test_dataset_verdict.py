"""Parts of an episode's verdict: figures of findings, costs, calm frames, steps of the offsets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_dataset import log_of

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.dataset.episode_faults import list_faults, saturation_faults
from drake_teleop.logs.dataset.episode_verdict import (
    EpisodeSignals,
    WrenchHypothesis,
    _weighted_number_of_faults,
    fault_free_hypothesis,
    find_offset_step,
    ln_half_width_and_centre,
)
from drake_teleop.logs.sample import TRUE_LOAD, sample_episode

PLAIN, I3 = fault_free_hypothesis(2.0), np.eye(3)
QUARTER = Rotation.from_euler("y", 90, degrees=True).as_matrix()
SKEW = Rotation.from_euler("y", 30, degrees=True).as_matrix()
FLIP = np.diag([1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, []),
        ({"lag": 2.5}, []),
        ({"lag": 4.0}, ["2.0 frames (0.100 s) behind the wrench"]),
        ({"lag": -1.0}, ["3.0 frames (0.150 s) ahead of the wrench"]),
        ({"kind": "base"}, ["the axes of the base"]),
        ({"kind": "weight removed"}, ["already removed the load's weight"]),
        ({"axes": (-I3, -I3)}, ["the wrench is negated"]),
        ({"axes": (FLIP, FLIP)}, ["axis y of the wrench is reversed"]),
        ({"axes": (I3, SKEW)}, ["the torque is rotated by 30 deg about [0, 1, 0]"]),
        ({"axes": (-SKEW, I3)}, ["the force is negated", "the force is rotated by 30 deg"]),
        ({"gains": np.array([1.05, 0.95])}, []),
        (
            {"gains": np.array([0.1, 1.0])},
            ["the force is 0.1 times the value in N: its unit is daN"],
        ),
        (
            {"gains": np.array([1.0, 8.85])},
            ["torque is 8.85 times the value in N m: its unit is lbf in"],
        ),
        ({"gains": np.array([1.3, 1.0])}, ["the force is 1.3 times the value in N"]),
        ({"phi": 2.0 * TRUE_LOAD}, ["another one: "])
    ],
)  # fmt: skip
def test_findings_contain_figures_and_units(change, expected):
    found = list_faults(replace(PLAIN, **change), 2.0, TRUE_LOAD, 20.0)
    assert len(found) == len(expected)
    for finding, words in zip(found, expected, strict=True):
        assert words in finding.message
    if "1.3" in str(change.get("gains")):
        assert "its unit" not in found[0].message


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({}, 0.0),
        ({"lag": 2.125}, 1.0),
        ({"kind": "base"}, 1.0),
        ({"axes": (-I3, -I3)}, 1.0),
        ({"axes": (QUARTER, QUARTER)}, 1.5),
        ({"axes": (SKEW, SKEW)}, 2.5),
        ({"axes": (I3, FLIP)}, 1.0),
        ({"gains": np.array([2.0, 1.0])}, 1.0),
        ({"gains": np.array([1.0, 3.0])}, 1.0),
        ({"gains": np.array([2.0, 3.0]), "kind": "base"}, 3.0),
        ({"phi": TRUE_LOAD, "lag": 0.0}, 5.0),
    ],
)
def test_each_deviation_increases_the_cost(change, count):
    assert _weighted_number_of_faults(replace(PLAIN, **change), 2.0) == count


@pytest.mark.parametrize("gain", [(1.0, 1.0), (0.3, 7.0)])
def test_correct_is_the_inverse_of_apply(gain):
    wrench = np.random.default_rng(0).normal(size=(9, 6))
    x = WrenchHypothesis("sensor", 0.0, (SKEW, -QUARTER), np.array(gain))
    read = x.reading_of_load(wrench)
    np.testing.assert_allclose(read[:, :3], gain[0] * wrench[:, :3] @ SKEW.T)
    np.testing.assert_allclose(read[:, 3:], -gain[1] * wrench[:, 3:] @ QUARTER.T)
    np.testing.assert_allclose(x.wrench_of_reading(read), wrench)


def test_calm_half_is_the_narrowest_half_of_each_channel():
    """Five of 8 numbers are within 2 half widths: the half has 4 intervals."""
    x = np.array([5.0, 5.25, 5.5, 5.75, 6.0, 9.0, -20.0, 40.0])
    spread, centres = ln_half_width_and_centre(
        np.column_stack([x, 3.0 - 2.0 * x, 0.0 * x]), np.full(3, 1e-3)
    )
    np.testing.assert_allclose(np.exp(spread), [0.5, 1.0, 1e-3])
    np.testing.assert_allclose(centres, [5.5, -8.0, 0.0])


@pytest.mark.parametrize(
    ("step", "at", "found"),
    [(0.5, 70, True), (-0.3, 100, True), (0.5, 20, False), (0.5, 185, False), (0.03, 100, False)],
)
@pytest.mark.parametrize("channel", [0, 5])
def test_step_of_the_offsets_is_found_inside_the_episode(step, at, found, channel):
    noise = 0.01 * np.random.default_rng(1).normal(size=(200, 6))
    before = np.arange(6.0)
    residual = noise + before
    residual[at:, channel] += step
    spread = ln_half_width_and_centre(noise, np.zeros(6))[0]
    jump = find_offset_step(residual, spread)
    assert (jump is not None) == found
    if jump is not None:
        assert jump[0] == at
        np.testing.assert_allclose(jump[1], before, atol=0.01)
        np.testing.assert_allclose(jump[2] - before, step * np.eye(6)[channel], atol=0.02)
        residual[at - 8 : at + 8, channel] = before[channel] + step / 2.0  # no sharp step
        assert find_offset_step(residual, spread) is None


@pytest.mark.parametrize(("rows", "saturated"), [(3, False), (4, True), (9, True)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_frames_at_an_end_of_the_range_are_counted(rows, saturated, side):
    wrench = np.random.default_rng(2).normal(size=(100, 6))
    wrench[20 : 20 + rows, 4] = 9.0 * side
    found = saturation_faults(wrench)
    assert [f.message for f in found] == (
        [f"channels stay at the end of their range: tau_y for {rows} frames"] if saturated else []
    )
    wrench[50 : 50 + rows, 4] = 0.5  # a coarse step that lasts as long
    assert saturation_faults(wrench) == []
    wrench[:, 1] = 2.0
    assert saturation_faults(wrench)[0].name == "dead channel"


@pytest.mark.parametrize("lag", [0.0, 2.5, -3.0, 0.37])
def test_signals_of_an_episode_have_the_lag_and_the_axes_of_their_kind(lag):
    x = sample_episode(3)
    signals = EpisodeSignals(log_of(x))
    at = signals.motion(x.t + lag * (x.t[1] - x.t[0]))
    w = signals.measured_and_load_wrench(TRUE_LOAD, "sensor", lag)
    np.testing.assert_array_equal(w[0], x.wrench)
    expected = non_contact_wrench(at.s, at.omega, at.alpha, TRUE_LOAD)
    np.testing.assert_allclose(w[1], expected, atol=1e-6)
    np.testing.assert_allclose(signals.regressor_at_lag(lag) @ TRUE_LOAD, expected, atol=1e-6)
    weightless = signals.measured_and_load_wrench(TRUE_LOAD, "weight removed", lag)[1]
    weight = non_contact_wrench(-at.gravity, 0.0 * at.omega, 0.0 * at.alpha, TRUE_LOAD)
    np.testing.assert_allclose(weightless, expected - weight, atol=1e-6)
    turned = signals.measured_and_load_wrench(TRUE_LOAD, "base", lag)[0]
    for part in (slice(0, 3), slice(3, 6)):
        back = np.einsum("nij,nj->ni", at.R_WS, turned[:, part])
        np.testing.assert_allclose(back, x.wrench[:, part], atol=2e-3)
