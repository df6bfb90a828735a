"""Figures of named causes, loads of the parts of a record, and the delay of a fitted model."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from posed_record import PHI
from test_causes_model import GRAVITY_W, OFFSETS, SWAPPED, T, moving, record

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causes.candidates import fit_candidates
from drake_teleop.logs.causes.cause import list_misfit_causes, loads_between_changes
from drake_teleop.logs.causes.changes import (
    add_step_change,
    find_contact_spans,
    fit_steps_at_middle_of_ramps,
    replace_steps_by_contact,
)
from drake_teleop.logs.causes.explain import _refit_with_shifted_motion
from drake_teleop.logs.causes.fitted_model import FittedModel, score_statistic
from drake_teleop.logs.causes.instants import block_means_of_record
from drake_teleop.logs.causes.model import DELAY_INDEX, LoadModel, StepChange

LOAD = np.array([0.5, 0.01, -0.02, 0.03, *np.zeros(6)])


def state_of(model: LoadModel, values: list[float], spans: tuple = ()) -> SimpleNamespace:
    x = np.concatenate([OFFSETS, PHI, [0.0], values])
    covariance = np.diag(1e-6 * np.arange(1.0, len(x) + 1))
    data = record(np.zeros((len(T), 6)))
    fit = SimpleNamespace(model=model, x=x, covariance=covariance, means=data, contact_spans=spans)
    fit.parameters_of_extension = partial(FittedModel.parameters_of_extension, fit)
    return fit


@pytest.mark.parametrize(
    ("model", "values", "name", "figures", "words"),
    [
        (LoadModel(axes=SWAPPED), [], "axes", {"axes": ["-y", "z", "x"]},
         "are -y, z, x of the motion"),
        (LoadModel(("gravity",)), [0.4, -0.3, 0.21], "gravity direction",
         {"gravity": [0.0, 0.0, -10.0], "angle_deg": 2.924}, "gravity is 2.92 deg (+- 0.049)"),
        (LoadModel(("weight",)), [1.72, 0.01, 0.02, 0.03], "weight removed",
         {"removed_mass": 1.72, "removed_moment": [0.01, 0.02, 0.03]}, "1.7 kg (+- 0.0052)"),
        (LoadModel(("weight",)), [1.6, 0.016, 0.032, -0.048], "payload configured",
         {"removed_mass": 1.6}, "1.6 kg (+- 0.0083) at [10, 20, -30] mm in S"),
        (LoadModel(("frame",)), [0.01, -0.02, 0.03], "pose frame",
         {"position_in_sensor": [-0.01, 0.02, -0.03]}, "[-10, 20, -30] mm in S (+- 8.8 mm)"),
        (LoadModel(("rotation",)), [0.0, 0.3, -0.4], "sensor rotation",
         {"rotation_vector": [0.0, 0.3, -0.4]}, "rotated by 28.65 deg (+- 0.5) relative to"),
        (LoadModel(gain_channels=(4,)), [0.2], "gain",
         {"gain": 1.2}, "tau_y reads 20.00 % (+- 0.83) more"),
        (LoadModel(("linear drift",)), [1.0, -2.0, 0.5, 0.1, 0.3, -0.2], "drift",
         {"range": [2.0, 4.0, 1.0, 0.2, 0.6, 0.4]}, "4 N and 0.6 N m"),
        (LoadModel(("drift",)), [*np.zeros(15), 0.1, -0.2, 0.3], "drift",
         {"range": [0, 0, 0, 0, 0, 1.2]}, "0 N and 1.2 N m"),
        (LoadModel(("cable",)), [*np.zeros(3), 3.0, 0.0, 0.0, -7.0, 0.0, 5.0, *np.zeros(3)],
         "cable", {"stiffness": 7.0}, "about 7 N/m"),
        (LoadModel(steps=(StepChange("offsets", 102.5),)), [1.0, 2.0, 3.0, 0.1, 0.2, 0.3],
         "zero change", {"change": [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]}, "from t = 102.50 s on"),
        (LoadModel(steps=(StepChange("load", 103.0),)), LOAD.tolist(), "load change",
         {"mass_change": 0.5, "com_of_change": [0.02, -0.04, 0.06]}, "[20, -40, 60] mm in S"),
        (LoadModel(steps=(StepChange("load", 103.0),)), (-LOAD).tolist(), "load change",
         {"mass_change": -0.5}, "0.5 kg (+- 0.0083) at [20, -40, 60] mm in S are removed"),
    ],
)  # fmt: skip
def test_a_cause_has_its_figures_with_intervals_of_95_percent(model, values, name, figures, words):
    (cause,) = list_misfit_causes(state_of(model, values))
    assert cause.name == name and words in cause.message
    for key, value in figures.items():
        found = cause.values[key]
        assert found == (value if key == "axes" else pytest.approx(value, abs=1e-3))
    given = list_misfit_causes(state_of(model, values), always_fitted=model.extensions)
    assert bool(given) != bool(model.extensions)


@pytest.mark.parametrize(
    ("span", "shown"),
    [((101.0, 101.5), True), ((102.8, 103.5), False), ((103.1, 109.0), True)],
)
def test_contacts_are_listed_unless_a_hand_changes_the_load(span, shown):
    steps = (StepChange("load", 103.0), StepChange("offsets", 105.0))
    values = [*LOAD, 1.0, *np.zeros(5)]
    fit = state_of(LoadModel(steps=steps), values, (span,))
    found = list_misfit_causes(fit)
    contacts = [(x.start_s, x.stop_s) for x in found if x.name == "contact"]
    margin = fit.means.dt
    assert contacts == ([(span[0] + margin, span[1] - margin)] if shown else [])
    starts = [x.start_s for x in found]
    assert starts == sorted(starts) and {103.0, 105.0} <= set(starts)


def test_load_of_each_part_includes_the_uncertainty_of_earlier_changes():
    steps = (StepChange("load", 104.0), StepChange("offsets", 101.0), StepChange("load", 102.0))
    values = [*(2.0 * LOAD), *np.ones(6), *LOAD]
    fit = state_of(LoadModel(steps=steps), values)
    covariance = 4.0 * fit.covariance[:16, :16]
    parts = loads_between_changes(fit, covariance)
    assert [(x.start_s, x.stop_s) for x in parts] == [
        (pytest.approx(a), pytest.approx(b))
        for a, b in ((100.0, 102.0), (102.0, 104.0), (104.0, T[-1]))
    ]
    for part, phi in zip(parts, (PHI, PHI + LOAD, PHI + 3.0 * LOAD), strict=True):
        np.testing.assert_allclose(part.phi, phi)
    np.testing.assert_allclose(parts[0].covariance, covariance)
    variance = 4e-6 * np.arange(7.0, 17.0)
    np.testing.assert_allclose(
        np.diag(parts[2].covariance)[6:],
        variance + 4e-6 * (np.arange(18.0, 28) + np.arange(34.0, 44)),
    )
    assert loads_between_changes(state_of(LoadModel(steps=steps[1:2]), [1.0] * 6), covariance) == []


@pytest.mark.parametrize(
    ("before", "moves"), [(0.0, True), (0.29, True), (0.31, False), (-0.31, False)]
)
@pytest.mark.parametrize("late", [0.004, -0.009])
def test_delay_of_a_model_is_removed_up_to_300_ms(before, moves, late):
    noise = np.repeat([1e-3, 1e-4], 3) * np.random.default_rng(0).normal(size=(len(T), 6))
    s, omega, alpha, *_ = moving(T)
    wrench = non_contact_wrench(s, omega, alpha, PHI) + OFFSETS + noise

    def with_delay(delay: float):
        return block_means_of_record(T, wrench, moving(T + delay - before - late), GRAVITY_W)

    fit = FittedModel.fit_record(with_delay(before), LoadModel())
    assert fit.x[DELAY_INDEX] == pytest.approx(late, abs=1e-3)
    after, delay = _refit_with_shifted_motion(fit, before, with_delay)
    assert delay == (pytest.approx(before + late, abs=5e-4) if moves else before)
    assert (abs(after.x[DELAY_INDEX]) < 5e-4) == moves
    assert _refit_with_shifted_motion(fit, before, None) == (fit, before)


@pytest.mark.parametrize("scale", [1.0, 1e2])
def test_gain_of_smooth_signals_counts_independent_ones(scale):
    rng = np.random.default_rng(0)
    A, e = rng.normal(size=(30, 4)) * [1.0, scale, 1e-3, 2.0], rng.normal(size=30)
    for columns, rank in ((A, 4), (np.column_stack([A, A[:, 0] + A[:, 3], 0.0 * e]), 4)):
        gain, found = score_statistic(columns.T @ columns, columns.T @ e)
        fitted = A @ np.linalg.lstsq(A, e, rcond=None)[0]
        assert found == rank and gain == pytest.approx(fitted @ fitted, rel=1e-5)
    some = score_statistic(A.T @ A, A.T @ e, np.array([0.0, 0.0, 1.0, 0.0]))
    assert some[1] == 3 and some[0] < gain


@pytest.mark.parametrize(
    ("kinds", "guess"),
    [(["load"], 103.04), (["offsets", "load"], 102.96), (["offsets"], 103.02)],
)
def test_gradual_change_is_at_the_middle_of_its_ramp(kinds, guess):
    """An earlier change stays; the ramp lasts 0.4 s."""
    s, omega, alpha, *_ = moving(T)
    step, load = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3]), LOAD + np.eye(10)[4] * 1e-3
    share = np.clip((T - 102.8) / 0.4, 0.0, 1.0)[:, None]
    wrench = non_contact_wrench(s, omega, alpha, PHI) + OFFSETS + (T[:, None] > 101.0) * step[::-1]
    wrench += share * ("load" in kinds) * non_contact_wrench(s, omega, alpha, load)
    wrench += share * ("offsets" in kinds) * step
    wrench += np.repeat([1e-2, 1e-3], 3) * np.random.default_rng(0).normal(size=wrench.shape)
    fit = FittedModel.fit_record(record(wrench), LoadModel(steps=(StepChange("offsets", 100.99),)))
    found = fit_steps_at_middle_of_ramps(fit, [kinds], [guess], ((100.5, 100.6),))
    assert found.contact_spans == ((100.5, 100.6), (guess - 0.25, guess + 0.25))
    assert [x.kind for x in found.model.steps] == ["offsets", *kinds]
    assert found.model.steps[0].time == 100.99
    for k, kind in enumerate(kinds, start=1):
        assert found.model.steps[k].time == pytest.approx(103.0, abs=0.03)
        value = found.parameters_of_extension(f"step {k}")[0]
        truth = load if kind == "load" else step
        np.testing.assert_allclose(value[:3], truth[:3], atol=0.02)


@pytest.mark.parametrize(
    ("start", "stop", "ends"), [(101.5, 103.0, 2), (99.0, 102.0, 1), (103.5, 107.0, 1)]
)
def test_contact_spans_cover_the_contact_and_cost_two_numbers_an_end(
    monkeypatch, start, stop, ends
):
    s, omega, alpha, *_ = moving(T)
    wrench = non_contact_wrench(s, omega, alpha, PHI) + OFFSETS
    wrench += np.repeat([0.02, 2e-3], 3) * np.random.default_rng(1).normal(size=wrench.shape)
    touched = ((start < T) & (stop > T))[:, None]
    wrench += touched * [8.0, 0.0, 5.0, 0.3, 0.0, 0.0] * (1.0 + np.sin(3.0 * T[:, None]))
    fit = FittedModel.fit_record(record(wrench), LoadModel())
    ((found_start, found_stop),) = find_contact_spans(fit)
    assert max(start, T[0] - 0.02) - 0.7 < found_start <= max(start, T[0])
    assert min(stop, T[-1]) <= found_stop < min(stop, T[-1]) + 0.7
    for name in (
        "_fit_with_extension",
        "_torque_factor_candidates",
        "_axis_permutation_candidates",
    ):
        monkeypatch.setattr(f"drake_teleop.logs.causes.candidates.{name}", lambda *_: iter(()))
    monkeypatch.setattr("drake_teleop.logs.causes.candidates.add_step_change", lambda *_: None)
    monkeypatch.setattr("drake_teleop.logs.causes.candidates._MIN_CHANNEL_GAIN_ERROR", 1.0)
    (contact,) = fit_candidates(fit, True)
    price = (6 + 2 * ends) * np.log(fit.means.used.sum())
    gain = 2.0 * (contact.fit.log_likelihood - fit.log_likelihood)
    assert contact.name == "contact" and contact.fit.contact_spans == ((found_start, found_stop),)
    assert contact.score == pytest.approx(gain - price)


@pytest.mark.parametrize("rest", [2.0, 3.0])
def test_rest_at_both_ends_does_not_make_another_error_a_contact(rest: float) -> None:
    """Any load explains the wrench at rest, but it does not predict that of the motion."""
    dt = 0.002
    t = np.arange(0.0, 20.0, dt)
    share = np.clip(2.0 * np.minimum(t - rest, 20.0 - rest - t), 0.0, 1.0)  # of the full speed
    s, omega, *_ = moving(np.cumsum(share) * dt)
    omega *= share[:, None]
    motion = (s, omega, np.gradient(omega, dt, axis=0))
    wrench = non_contact_wrench(*motion, PHI)[:, [1, 0, 2, 4, 3, 5]] + OFFSETS
    wrench += np.repeat([0.02, 2e-3], 3) * np.random.default_rng(1).normal(size=wrench.shape)
    assert (
        find_contact_spans(
            FittedModel.fit_record(block_means_of_record(t, wrench, motion, GRAVITY_W), LoadModel())
        )
        == ()
    )


@pytest.mark.quick_cases(2)
@pytest.mark.slow
@pytest.mark.parametrize("at", [0.35, -0.25, 0.25, -0.35, 0.06, -0.06])
def test_steps_are_found_except_within_two_tenths_of_a_second_of_an_end(at: float) -> None:
    s, omega, alpha, *_ = moving(T)
    wrench = non_contact_wrench(s, omega, alpha, PHI) + OFFSETS
    step = T[0] + at if at > 0.0 else T[-1] + at
    wrench += (step < T)[:, None] * np.array([30.0, -5.0, -7.0, 1.0, 3.0, 0.7])
    wrench += np.repeat([1e-2, 1e-3], 3) * np.random.default_rng(0).normal(size=wrench.shape)
    found = add_step_change(FittedModel.fit_record(record(wrench), LoadModel()), "offsets")
    times = () if found is None else found.model.step_times
    assert times == pytest.approx((step,) if abs(at) > 0.2 else (), abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.06, -0.06])
def test_steps_at_the_ends_of_a_record_are_no_changes(at: float) -> None:
    """A few samples determine no offsets, and the rest of the record is no contact."""
    s, omega, alpha, *_ = moving(T)
    wrench = non_contact_wrench(s, np.roll(omega, 25, axis=0), alpha, PHI) + OFFSETS
    step = T[0] + at if at > 0.0 else T[-1] + at
    wrench += (step < T)[:, None] * np.array([30.0, -5.0, -7.0, 1.0, 3.0, 0.7])
    wrench += np.repeat([1e-2, 1e-3], 3) * np.random.default_rng(0).normal(size=wrench.shape)
    plain = FittedModel.fit_record(record(wrench), LoadModel())
    found = add_step_change(plain, "offsets")
    assert all(T[0] + 0.2 < time < T[-1] - 0.2 for time in (found or plain).model.step_times)
    fit = FittedModel.fit_record(plain.means, LoadModel(steps=(StepChange("offsets", step),)))
    for span in replace_steps_by_contact(fit).contact_spans:
        assert span[1] - span[0] < 0.5 * (T[-1] - T[0])
