"""Load estimator in the loop: estimates and settling, for both methods."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import sosfilt

from drake_teleop.common.config import check_all_field_values
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.online.recursive import RecursiveEstimator, RecursiveLeastSquares
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares
from drake_teleop.load.regressor import SATURATION_FLAG_INDEX, non_contact_wrench
from drake_teleop.station.estimation.load_estimator import LoadEstimator, LoadEstimatorConfig
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig, butterworth_sections

SENSOR = WristSensorConfig()
PHI = phi_from_mass_com_inertia(3.13, [0.004, -0.003, 0.085], np.diag([0.012, 0.0115, 0.0045]))
INERTIAS = [10, 13, 15]


def samples(seed, duration=1.5, rate=8000.0, keep=8):
    """Return (N, 22) outputs of the wrist sensor at 1 kHz, with filtered noise."""
    rng, phases = np.random.default_rng(seed), np.random.default_rng(0).uniform(0, 6.28, (9, 4))
    t = np.arange(0.0, duration, 1 / rate)
    waves = np.sin(2 * np.pi / 1.5 * np.arange(1, 5) * t[:, None, None] + phases).sum(axis=2)
    motion = waves * np.repeat([6.0, 1.5, 8.0], 3)
    offset = SENSOR.offset + non_contact_wrench(*np.split(motion, 3, axis=1), PHI)
    sections = butterworth_sections(SENSOR.bandwidth_hz, rate)
    filters = np.hstack([sections[:, :3], np.ones((2, 1)), sections[:, 3:]])
    noise = sosfilt(filters, rng.normal(size=(len(t), 15)), axis=0)
    stated = np.concatenate([SENSOR.wrench_std(), SENSOR.motion_std()])
    rows = np.hstack([offset, motion]) + stated * noise
    return np.hstack([rows, np.zeros((len(t), 7))])[::keep]


def by(method):
    noise, motion = SENSOR.wrench_std(), SENSOR.motion_std()
    if method == "rls":
        return RecursiveLeastSquares(noise)
    return RecursiveTotalLeastSquares(noise, motion)


def run(system, rows):
    """Return the estimates and `settled` after each row."""
    context = system.CreateDefaultContext()
    history = []
    for row in rows:
        system.GetInputPort("sample").FixValue(context, row)
        context.SetDiscreteState(system.EvalUniquePeriodicDiscreteUpdate(context))
        history.append(
            [
                *system.GetOutputPort("load_estimate").Eval(context),
                system.GetOutputPort("load_state").Eval(context)[0],
            ]
        )
    return np.array(history)


def MakeEstimator(initial=None, **config):
    return LoadEstimator(
        LoadEstimatorConfig(enabled=True, **config),
        SENSOR.wrench_std(),
        SENSOR.motion_std(),
        1e-3,
        22,
        np.zeros(16) if initial is None else initial,
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rls", "rtls"])
def test_block_equals_the_estimator_of_logs(method):
    rows = samples(0, duration=0.3)
    rows[20, 15] = 1.0  # saturated samples are not used
    history = run(MakeEstimator(method=method), rows)
    usable = np.delete(rows, 20, axis=0)
    log = by(method)
    log.update_samples(usable[:, :6], usable[:, 6:9], usable[:, 9:12], usable[:, 12:15])
    np.testing.assert_array_equal(history[-1, :6], log.offsets)
    np.testing.assert_array_equal(history[-1, 6:16], log.phi)
    np.testing.assert_array_equal(history[19], history[20])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rls", "rtls"])
def test_settled_estimate_is_right(method):
    rows = samples(1)
    history = run(MakeEstimator(method=method, settled_bound=0.1), rows)
    settled = history[:, 16]
    assert settled[0] == 0.0 and settled[-1] == 1.0
    first = int(np.argmax(settled))
    assert history[first, 6] == pytest.approx(PHI[0], rel=0.1)
    assert set(settled) == {0.0, 1.0}


def test_given_load_stays_until_the_first_update():
    known = np.concatenate([SENSOR.offset, PHI])
    still = np.zeros((5, 22))
    still[:, :6] = SENSOR.offset
    for method in ("rls", "rtls"):
        history = run(MakeEstimator(known, method=method), still)
        np.testing.assert_allclose(history[-1, :16], known, rtol=1e-9)
        assert history[-1, 16] == 0.0


def test_saturated_samples_are_not_used_and_the_fallback_is_kept():
    known, rows = np.concatenate([SENSOR.offset, PHI]), samples(0, 0.2)
    rows[:, SATURATION_FLAG_INDEX] = 1.0
    np.testing.assert_array_equal(run(MakeEstimator(known), rows)[-1, :16], known)
    config, noise = LoadEstimatorConfig(watch=True), (SENSOR.wrench_std(), SENSOR.motion_std())
    block = LoadEstimator(config, *noise, 1e-3, 22, known, np.eye(16), 0.5 * PHI)
    np.testing.assert_array_equal(block._watch_arguments[0], 0.5 * PHI)


def test_total_least_squares_removes_the_bias_of_acceleration_noise():
    """Inertias of rls deviate by several sigma, those of rtls do not."""

    def errors(estimator: RecursiveEstimator, rows):
        estimator.update_samples(rows[:, :6], rows[:, 6:9], rows[:, 9:12], rows[:, 12:15])
        return (estimator.phi - PHI)[[i - 6 for i in INERTIAS]]

    records = [samples(seed) for seed in range(20)]
    least = np.array([errors(by("rls"), rows) for rows in records])
    total = np.array([errors(by("rtls"), rows) for rows in records])
    standard_error = least.std(axis=0) / np.sqrt(len(records))
    assert (least.mean(axis=0) < -3.0 * standard_error).all()
    assert (np.abs(total.mean(axis=0)) < 0.2 * np.abs(least.mean(axis=0))).all()


def test_unknown_method_is_rejected():
    with pytest.raises(DrakeTeleopError, match=r"method: there is no recursive estimator 'tls'"):
        check_all_field_values(LoadEstimatorConfig(method="tls"), "load_estimator")
