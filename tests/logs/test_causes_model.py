"""Models of causes against the physics that they state, and their weighted sums and fits."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from posed_record import PHI
from scipy.spatial.transform import Rotation

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs import explained_log
from drake_teleop.logs.causes.candidates import Candidate
from drake_teleop.logs.causes.fitted_model import (
    UsedRows,
    fit_model,
    is_in_time_spans,
    regularized_inverse,
)
from drake_teleop.logs.causes.instants import (
    WRENCH_SIGNALS,
    BlockMeans,
    block_means_of_record,
    delay_of_linear_fit,
)
from drake_teleop.logs.causes.intervals import (
    _load_variances_by_rejected_causes,
    widening_factor_by_misfit,
)
from drake_teleop.logs.causes.model import DELAY_INDEX, LoadModel, StepChange

GRAVITY_W = np.array([0.4, -0.3, -9.79])
OFFSETS = np.array([3.0, -2.0, 5.0, 0.3, -0.2, 0.1])
T = np.arange(0.0, 6.0, 0.02) + 100.0
SWAPPED = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def moving(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return s, omega, alpha, R_WS, p; smooth, and consistent only in s."""
    waves = [np.sin(f * t[:, None] + np.arange(12) * f) for f in (1.3, 2.1, 3.4)]
    x = waves[0] + 0.5 * waves[1] - 0.3 * waves[2]
    R_WS = Rotation.from_rotvec(1.5 * x[:, :3]).as_matrix()
    s = np.einsum("nji,nj->ni", R_WS, 4.0 * x[:, 3:6] - GRAVITY_W)
    return s, 2.0 * x[:, 6:9], 9.0 * np.roll(x[:, 6:9], 1, axis=1), R_WS, 0.3 * x[:, 9:]


def record(wrench: np.ndarray) -> BlockMeans:
    return block_means_of_record(T, wrench, moving(T), GRAVITY_W)


def read(name: str, values: np.ndarray) -> np.ndarray:
    """Return the wrench that a sensor with this cause reads, without offsets."""
    s, omega, alpha, R_WS, p = moving(T)
    R_SW = np.swapaxes(R_WS, 1, 2)
    if name == "gravity":
        s = s + R_SW @ values
    if name == "frame":
        s = s + np.cross(alpha, values) + np.cross(omega, np.cross(omega, values))
    wrench = non_contact_wrench(s, omega, alpha, PHI)
    if name == "weight":
        mass = np.concatenate([values, np.zeros(6)])
        wrench += non_contact_wrench(R_SW @ GRAVITY_W, 0.0 * omega, 0.0 * alpha, mass)
    if name == "cable":
        K = values[3:9][[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        force = np.einsum("nij,nj->ni", R_SW, values[:3] + p @ K)
        wrench += np.hstack([force, np.cross(values[9:], force)])
    both = wrench.reshape(-1, 2, 3)
    if name == "rotation":
        both = both @ Rotation.from_rotvec(values).as_matrix().T
    if name == "torque factor":
        both[:, 1] *= 1.0 + values
    wrench = both.reshape(-1, 6)
    if name.startswith("gain"):
        wrench[:, int(name[-1])] *= 1.0 + values[0]
    if "drift" in name:
        x = np.linspace(-1.0, 1.0, len(T))
        terms = [x, 1.5 * x**2 - 0.5, 2.5 * x**3 - 1.5 * x]
        wrench += np.transpose(terms)[:, : values.size // 6] @ values.reshape(6, -1).T
    return wrench


@pytest.mark.parametrize(
    ("name", "size"),
    [
        *(("gravity", 3), ("weight", 4), ("torque factor", 1), ("frame", 3), ("rotation", 3)),
        *(("linear drift", 6), ("drift", 18), ("cable", 12), ("gain 1", 1), ("gain 5", 1)),
    ],
)
def test_coefficients_of_a_cause_give_the_wrench_that_the_sensor_reads(name, size):
    values = np.random.default_rng(size).uniform(0.1, 0.5, size)
    gains = (int(name[-1]),) if "gain" in name else ()
    model = LoadModel(() if gains else (name,), gains)
    data = record(read(name, values) + OFFSETS)
    x = np.concatenate([OFFSETS, PHI, [0.0], values])
    y = data.append_step_signals(())
    np.testing.assert_allclose(
        model.wrench_coefficients(x[None])[0] @ y[1:-1].T, y[1:-1, WRENCH_SIGNALS].T, atol=1e-9
    )
    left = model.residual_coefficients(x) @ y[:, model.columns].T
    np.testing.assert_allclose(left, 0.0, atol=1e-9)
    move = 1e-6 * np.random.default_rng(1).normal(size=model.size)
    change = model.residual_coefficients(x + move) - model.residual_coefficients(x - move)
    expected = -2.0 * np.tensordot(move, model.wrench_jacobian(x), 1)
    np.testing.assert_allclose(change, expected, atol=1e-9)
    assert model.start_parameters(x, LoadModel())[: DELAY_INDEX + 1] == pytest.approx(
        x[: DELAY_INDEX + 1]
    )
    assert not model.start_parameters(x, LoadModel())[DELAY_INDEX + 1 :].any()
    other = model.with_extension("torque factor")
    np.testing.assert_array_equal(
        other.start_parameters(x, model)[other.parameter_slices[name]], values
    )


def test_axes_factor_and_steps_change_the_wrench_as_stated():
    """A step in the middle of a block has half its effect there."""
    load, offsets = np.arange(10.0) * 0.1, np.arange(1.0, 7.0)
    steps = StepChange("load", 102.0), StepChange("offsets", 103.01)
    model = LoadModel(steps=steps, axes=SWAPPED, torque_factor=10.0)
    x = np.concatenate([OFFSETS, PHI, [0.02], load, offsets])
    s, omega, alpha, *_ = moving(T)
    before, more = (non_contact_wrench(s, omega, alpha, phi) for phi in (PHI, load))
    share = np.where(T < 101.99, 0.0, np.where(T < 102.01, 0.5, 1.0))
    both = (before + share[:, None] * more).reshape(-1, 2, 3) @ SWAPPED.T * [[[1.0], [10.0]]]
    expected = both.reshape(-1, 6) + OFFSETS + np.where(T < 103.01, 0.0, 1.0)[:, None] * offsets
    rng = np.random.default_rng(0)
    data = record(rng.normal(size=(len(T), 6)))
    found = data.append_step_signals(model.step_times) @ model.wrench_coefficients(x[None])[0].T
    rates = np.gradient(data.y[:, WRENCH_SIGNALS], 0.02, axis=0)
    inside = slice(2, -2)
    np.testing.assert_allclose(found[inside], (expected + 0.02 * rates)[inside], atol=1e-9)


@pytest.mark.parametrize("gaps", [(), (3,), (40, 41, 44, 90)])
def test_whitened_sums_are_those_of_rows_with_four_predecessors(gaps):
    rng = np.random.default_rng(3)
    data = record(rng.normal(size=(len(T), 6)))
    used = data.used.copy()
    used[list(gaps)] = False
    model = LoadModel()
    rows = UsedRows(data, used, (), model.columns)
    whole = [n for n in range(4, len(T)) if used[n - 4 : n + 1].all()]
    np.testing.assert_array_equal(rows.rows_with_four_predecessors, whole)
    filters = rng.normal(size=(6, 5))
    found = rows.whitened_products(filters)
    residual = rng.normal(size=(6, len(model.columns)))
    e = rows.y @ residual.T
    order, power = rows.noise_filters_and_power(residual, np.zeros(6))
    for c in range(6):
        z = sum(filters[c, d] * rows.y[np.array(whole) - d] for d in range(5))
        np.testing.assert_allclose(found[c], z.T @ z, atol=1e-7 * np.abs(z.T @ z).max())
        past = np.stack([e[np.array(whole) - d, c] for d in range(1, 5)], axis=1)
        taps = np.linalg.lstsq(past, e[whole, c], rcond=None)[0]
        np.testing.assert_allclose(order[c], [1.0, *-taps], atol=1e-5)
        assert power[c] == pytest.approx(np.mean((e[whole, c] - past @ taps) ** 2), rel=1e-5)
    np.testing.assert_allclose(rows.residual_rms(residual), np.sqrt(np.mean(e[used] ** 2, axis=0)))
    assert rows.noise_filters_and_power(residual, np.full(6, 1e9))[1].tolist() == [1e9] * 6


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("frame", [0.03, -0.05, 0.2]),
        ("rotation", [0.1, -0.2, 0.3]),
        ("gravity", [0.3, 0.2, -0.1]),
        ("gain 2", [0.2]),
    ],
)
def test_fit_gives_the_cause_within_its_deviations(name, values):
    """The noise is an autoregression of order 1."""
    rng, white = np.random.default_rng(5), np.repeat([0.05, 0.004], 3)
    noise = white * rng.normal(size=(len(T), 6))
    for n in range(1, len(T)):
        noise[n] += 0.7 * noise[n - 1]
    data = record(read(name, np.array(values)) + OFFSETS + noise)
    gains = (int(name[-1]),) if "gain" in name else ()
    model = LoadModel(() if gains else (name,), gains)
    found = fit_model(model, UsedRows(data, data.used, (), model.columns))
    error = found.x - np.concatenate([OFFSETS, PHI, [0.0], values])
    deviations = np.sqrt(np.diag(found.covariance))
    assert np.abs(error / deviations).max() < 4.0
    assert np.linalg.norm(error[DELAY_INDEX + 1 :]) < 0.05 * np.linalg.norm(values)
    np.testing.assert_allclose(found.noise_filters[:, 1], -0.7, atol=0.25)
    np.testing.assert_allclose(np.sqrt(found.noise_power) / white, 1.0, atol=0.25)


def test_inverse_has_large_values_only_for_undetermined_parameters():
    A = np.random.default_rng(0).normal(size=(20, 4)) * [1.0, 1e3, 1e-3, 5.0]
    np.testing.assert_allclose(regularized_inverse(A.T @ A), np.linalg.inv(A.T @ A), rtol=1e-6)
    A[:, 3] = A[:, 0]
    inverse = regularized_inverse(A.T @ A)
    assert inverse[0, 0] > 1e6 and inverse[3, 3] > 1e6
    assert inverse[1, 1] < 1e-4
    np.testing.assert_allclose(inverse, inverse.T)


@pytest.mark.parametrize("delay", [0.0, 0.043, -0.12])
def test_free_delay_is_that_of_the_motion(delay):
    s, omega, alpha, *_ = moving(T + delay)
    data = record(non_contact_wrench(s, omega, alpha, PHI) + OFFSETS)
    assert delay_of_linear_fit(data) == pytest.approx(delay, abs=2e-3)


@pytest.mark.parametrize("size", [1, 4, 10])
def test_instants_are_block_means(size):
    """Blocks beside lost samples and at the ends are not used."""
    dt = 0.02 / size
    t = 100.0 + dt * np.arange(200 * size)
    noise = np.random.default_rng(0).normal(size=(len(t), 6)) * np.repeat([0.4, 0.03], 3)
    lost = np.zeros(len(t), bool)
    lost[[50 * size, 120 * size - 1]] = True
    data = block_means_of_record(t, noise, moving(t), GRAVITY_W, lost)
    np.testing.assert_array_equal(np.flatnonzero(~data.used), [0, 50, 119, 199])
    np.testing.assert_allclose(data.t, t.reshape(200, size).mean(axis=1))
    means = noise.reshape(200, size, 6).mean(axis=1)
    np.testing.assert_allclose(data.y[data.used][:, WRENCH_SIGNALS], means[data.used])
    np.testing.assert_allclose(
        data.wrench_noise * np.sqrt(size), np.repeat([0.4, 0.03], 3), rtol=0.25
    )
    called = block_means_of_record(t, noise, moving, GRAVITY_W, lost)
    np.testing.assert_allclose(called.y, data.y, atol=2e-3 * np.abs(data.y).max())
    fast = moving(8.0 * t), lambda t: moving(8.0 * t)
    means, called = (block_means_of_record(t, noise, motion, GRAVITY_W).y for motion in fast)
    assert np.abs(called - means).max() < 1e-3 * np.abs(means).max()
    assert data.dt == pytest.approx(0.02) and data.has_positions


@pytest.mark.parametrize(("size", "enough"), [(0.0, False), (0.5, True)])
def test_acceleration_of_the_origin_is_compared_with_its_noise(size, enough):
    """The specific force varies with the orientation, although the origin does not accelerate."""
    s, omega, alpha, R_WS, _ = moving(T)
    a = size * np.sin(3.0 * T[:, None] + np.arange(3))
    s = np.einsum("nji,nj->ni", R_WS, a - GRAVITY_W)
    motion = s, omega, alpha, R_WS
    data = block_means_of_record(T, np.zeros((len(T), 6)), motion, GRAVITY_W, None, 0.05)
    assert data.has_enough_acceleration is enough


def test_rejected_causes_widen_the_load_by_their_score_or_smaller_residual():
    def fit(shift: float, residual_ratio: float) -> SimpleNamespace:
        return SimpleNamespace(
            x=np.full(17, shift), covariance=4.0 * np.eye(17), residual_ratio=residual_ratio
        )

    for score, ratio, share in (
        (5.0, 1.0, 0.0),
        (7.5, 1.0, 0.5),
        (40.0, 1.0, 1.0),
        (0.0, 0.4, 1.0),
    ):
        rejected = [Candidate("drift", fit(3.0, ratio), score)]
        found = _load_variances_by_rejected_causes(fit(0.0, 1.0), rejected)
        np.testing.assert_allclose(found, share * (3.0**2 + 4.0))


@pytest.mark.parametrize("longer", [5.0, 0.0])
def test_samples_near_the_ends_of_wrench_and_poses_are_not_used(monkeypatch, longer):
    """Knots are 0.2 s apart; the poses are longer than the wrench, or as long."""
    monkeypatch.setattr(explained_log, "_acceleration_noise_of_splines_m_s2", lambda splines: 0.0)
    splines = SimpleNamespace(
        quaternion=lambda t: Rotation.from_matrix(moving(t)[3]).as_quat(scalar_first=True),
        position=lambda t: moving(t)[4],
        motion=lambda t, gravity: moving(t)[:3],
        poses=SimpleNamespace(t=np.array([T[0] - longer, T[-1] + longer])),
        spacing=0.2,
    )
    posed = SimpleNamespace(gravity_W=GRAVITY_W, poses=SimpleNamespace(position=np.zeros((2, 3))))
    log = SimpleNamespace(t=T, wrench=np.zeros((len(T), 6)), bridged=None, posed=posed)
    data = explained_log._block_means_of_splines(log, SimpleNamespace(splines=splines), 0.1)
    late = 0.0 if longer else 0.1
    kept = (T[0] + 0.4 <= T) & (T[-1] - 0.4 - late >= T)
    differs = np.flatnonzero(data.used != kept)
    assert len(differs) <= 2 and data.used.sum() > 200  # rounding at the borders


def test_rows_within_spans_are_marked():
    data = record(np.zeros((len(T), 6)))
    inside = is_in_time_spans(data, ((101.0, 101.5), (103.0, 103.0)))
    np.testing.assert_allclose(data.t[inside], [*np.arange(101.0, 101.51, 0.02), 103.0])


@pytest.mark.parametrize(
    ("ratio", "smooth", "parts", "factor"),
    [
        (1.0, 1.0, (), 1.0),
        (1.45, 1.35, (), 1.0),
        (2.3, 1.0, (), 2.0),
        (1.0, 1.85, (), 2.5),
        (4.6, 1.45, ("cable",), 4.0 * 1.5 * 1.3),
    ],
)
def test_deviations_widen_with_the_scatter_of_parts_and_with_a_smooth_misfit(
    ratio, smooth, parts, factor
):
    fit = SimpleNamespace(
        covariance=1e-12 * np.eye(40),
        model=SimpleNamespace(extensions=parts),
        smooth_misfit=smooth,
        x=np.concatenate([OFFSETS, PHI]),
    )
    assert widening_factor_by_misfit(fit, np.full(16, ratio * 1e-6)) == pytest.approx(factor)
