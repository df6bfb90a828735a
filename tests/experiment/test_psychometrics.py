"""Thresholds from answers, compared with known thresholds and a direct calculation."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.live.experiment.psychometrics import PsiMethod, correct_answer_probability


def test_the_threshold_is_where_d_prime_is_1():
    assert correct_answer_probability(2.0, 2.0, 1.7, 0.0) == pytest.approx(0.7602, abs=1e-4)
    assert correct_answer_probability(0.0, 2.0, 1.7, 0.04) == pytest.approx(0.5)
    assert correct_answer_probability(1e6, 2.0, 1.7, 0.04) == pytest.approx(0.98)


def test_next_level_minimises_the_expected_entropy():
    psi = PsiMethod(0.2, 20.0)
    for level, correct in ((2.0, True), (1.0, False), (0.9, True)):
        psi.update_posterior(level, correct)

    def expected(level: float) -> float:
        """Return the expected entropy of the threshold, by explicit updates of the grid."""
        posterior = psi._posterior
        p = float((psi._correct_probability_on_grid(level) * posterior).sum())
        after = []
        for correct in (True, False):
            other = PsiMethod(0.2, 20.0)
            other._posterior = posterior.copy()
            other.update_posterior(level, correct)
            share = other._posterior.sum(axis=(1, 2))
            after.append(-float(share @ np.log(share)))
        return p * after[0] + (1.0 - p) * after[1]

    assert psi.next_level() == min(psi.levels, key=expected)


def test_intervals_contain_the_true_thresholds():
    """96 % of 200 participants (benchmarks/participants.py), 28 of these 30."""
    rng = np.random.default_rng(0)
    held, off = [], []
    for _ in range(30):
        truth = float(np.exp(rng.uniform(np.log(0.4), np.log(10.0))))
        psi = PsiMethod(0.2, 20.0)
        for _ in range(40):
            level = psi.next_level()
            psi.update_posterior(
                level, rng.random() < correct_answer_probability(level, truth, 1.5, 0.02)
            )
        found, d = psi.threshold(), psi.estimate_d_prime(truth)
        held.append(found.low <= truth <= found.high and d.low <= 1.0 <= d.high)
        off.append(abs(np.log(found.value / truth)))
    assert sum(held) >= 28
    assert np.exp(np.median(off)) < 1.3


@pytest.mark.parametrize(("low", "high"), [(0.2, 20.0), (0.004, 0.15)])
@pytest.mark.parametrize(("node", "slope", "lapse"), [(3, 0, 0), (40, 2, 3), (77, 6, 1)])
def test_a_single_node_of_the_grid_is_the_median(low, high, node, slope, lapse):
    psi = PsiMethod(low, high)
    psi._posterior[:] = 0.0
    psi._posterior[node, slope, lapse] = 1.0
    spacing = (4.0 * high / low) ** (1 / 80)  # of 81 thresholds from low / 2 to 2 high
    threshold = low / 2.0 * spacing**node
    cell = threshold * spacing ** np.array([0.0, -0.475, 0.475])
    np.testing.assert_allclose(psi.threshold(), cell, rtol=1e-12)
    for level in (low, high):
        expected = (level / threshold) ** np.geomspace(0.7, 3.0, 7)[slope]
        assert psi.estimate_d_prime(level).value == pytest.approx(expected)
