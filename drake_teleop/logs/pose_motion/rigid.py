"""Rigid load, delay and transform between pose frame P and sensor, Eqs. (T78) to (T81)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.load.batch.uncertainty import GAIN_ERROR_TORQUE_ARM_M, parameter_errors_by_gains
from drake_teleop.load.identification import mark_undetermined
from drake_teleop.load.normal_equations import centripetal_matrix, regressor_coefficients
from drake_teleop.logs.pose_motion import spectra
from drake_teleop.logs.pose_motion.linear_model import LinearFit, min_noise_power
from drake_teleop.logs.pose_motion.spectra import NUM_SPECTRAL_COLUMNS, WRENCH_COLUMNS, NoiseLevels
from drake_teleop.logs.pose_motion.splines import GRAVITY_COLUMNS, NUM_MOTION_SIGNALS

NUM_RIGID_PARAMETERS = 23
"""Number of parameters: [offsets; phi] (16), tau, r (3), rho (3)."""
OFFSET_AND_LOAD_PARAMETERS, DELAY_PARAMETER = slice(0, 16), slice(16, 17)
LEVER_PARAMETERS, ROTATION_PARAMETERS = slice(17, 20), slice(20, 23)
_MAX_RIGID_FIT_STEPS, _MAX_CONVERGED_STEP_OVER_STD = 40, 1e-4
_MAX_RIGID_MISFIT_OVER_DOF, _MAX_GAIN_MISFIT_OVER_EXPECTED, _NOISE_MISFIT_OVER_DOF = 4.0, 1.5, 1.5
_MAX_GAUSS_NEWTON_STEP = np.repeat([np.inf, 0.03, 0.3, 0.6], [16, 1, 3, 3])  # [s, m, rad]
_MIN_WRENCH_NOISE_OVER_RESIDUAL, _ROTATION_DIFFERENCE_STEP_RAD = 0.1, 1e-4
_MIN_RELATIVE_GRAM_EIGENVALUE = 1e-12
_OMEGA_PRODUCT_AXIS_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, eq=False)
class RigidParameters:
    """Parameters [offsets; phi] (16,), delay tau [s], r = p_PoSo_P (Po to So) [m], R_PS; (T79)."""

    theta: Array
    delay_s: float
    p_PoSo_P: Array
    R_PS: Array


@dataclass(frozen=True, eq=False)
class RigidFit:
    """Fit of a rigid load to wrench and poses.

    Attributes:
        parameters: estimated; `delay_s` is relative to the delay of the `Spectra`.
        covariance: (23, 23) of [offsets, phi, delay, p_PoSo_P, rotation about the axes of S]; inf
            on the diagonal if undetermined, 0 if not free.
        misfit: twice the log likelihood ratio to the free linear model.
        degrees_of_freedom: those of the misfit.
        expected_misfit_by_gains: expected increase of the misfit by the stated gain errors.
    """

    parameters: RigidParameters
    covariance: Array
    misfit: float
    degrees_of_freedom: float
    expected_misfit_by_gains: float = 0.0

    @property
    def is_rigid(self) -> bool:
        """Whether a rigid load without gain errors explains the wrench."""
        return self.misfit < _MAX_RIGID_MISFIT_OVER_DOF * self.degrees_of_freedom

    @property
    def is_explained_by_gains(self) -> bool:
        """Whether a rigid load with the stated gain errors explains the wrench."""
        by_gains = _MAX_GAIN_MISFIT_OVER_EXPECTED * self.expected_misfit_by_gains
        return self.misfit < _MAX_RIGID_MISFIT_OVER_DOF * self.degrees_of_freedom + by_gains

    @property
    def std_inflation_by_misfit(self) -> float:
        left = self.misfit - _MAX_GAIN_MISFIT_OVER_EXPECTED * self.expected_misfit_by_gains
        by_noise = _NOISE_MISFIT_OVER_DOF * self.degrees_of_freedom
        return float(np.sqrt(max(1.0, left / by_noise)))


def motion_transformation_matrix(R_PS: Array, p_PoSo_P: Array) -> Array:
    """Return M (19, 22), (T79): M [16 signals of P; wrench] = [1; wrench; 12 signals of S]."""
    M = np.zeros((19, NUM_MOTION_SIGNALS + 6))
    M[0, 0] = 1.0
    M[1:7, NUM_MOTION_SIGNALS:] = np.eye(6)
    M[7:10, 1:4] = M[7:10, 4:7] = M[10:13, 7:10] = R_PS.T
    M[7:10, 7:10] = -R_PS.T @ cross_matrix(p_PoSo_P)
    M[7:10, 10:16] = R_PS.T @ centripetal_matrix(p_PoSo_P)
    i, j = np.transpose(_OMEGA_PRODUCT_AXIS_PAIRS)[:, :, None]
    k, m = np.transpose(_OMEGA_PRODUCT_AXIS_PAIRS)[:, None]
    M[13:19, 10:16] = R_PS[k, i] * R_PS[m, j] + (k != m) * R_PS[m, i] * R_PS[k, j]
    return M


def wrench_coefficients_of_load(phi: Array, removed_weight: Array | None = None) -> Array:
    """Return C (6, 16), Eq. (T73): C times the 16 motion signals is the wrench of load phi (10,).

    The robot has subtracted the `removed_weight` [m, m c] (4,).
    """
    M = motion_transformation_matrix(np.eye(3), np.zeros(3))[:, :NUM_MOTION_SIGNALS]

    def matrix_from_motion_signals_to_wrench(phi: Array) -> Array:
        theta = np.concatenate([np.zeros(6), phi])
        return np.asarray(np.einsum("cjk,j->ck", regressor_coefficients(), theta) @ M)

    C = matrix_from_motion_signals_to_wrench(phi)
    if removed_weight is not None:
        weight = matrix_from_motion_signals_to_wrench(np.concatenate([removed_weight, np.zeros(6)]))
        C[:, GRAVITY_COLUMNS] -= weight[:, GRAVITY_COLUMNS]
    return C


def fit_rigid(
    Z: Array,
    Q: Array,
    levels: NoiseLevels,
    start: RigidParameters,
    free: NDArray[np.bool_],
    linear: LinearFit,
    *,
    gain_std: float = 0.0,
) -> RigidFit:
    """Fit a rigid load; all bands have equal weights if no rigid load explains the wrench.

    Z (bands, 38, 38) are the second moments of signals, wrench and signal rates; Q is their part
    due to pose noise. Parameters with `free` (23,) True are estimated, from `start`.
    """
    record = _RigidFitData(Z, Q, levels, free, linear.noise_power)
    solution = _solve_rigid_fit(record, start)
    # The linear model is not compensated for noise, so the compared fit must not be either.
    plain = _solve_rigid_fit(replace(record, noise_moments=np.zeros_like(Q)), solution.parameters)
    power = levels.noise_power(_residual_channel_powers(record, plain.parameters))
    power = np.maximum(power, min_noise_power(record.moments, levels))
    fit = RigidFit(
        solution.parameters,
        covariance=np.zeros((0, 0)),
        misfit=2.0 * (float(levels.negative_log_likelihoods(power).sum()) - linear.cost),
        degrees_of_freedom=6.0 * NUM_MOTION_SIGNALS - float(free.sum()),
        expected_misfit_by_gains=_expected_misfit_by_gain_errors(record, plain, gain_std),
    )
    if not fit.is_rigid:
        solution = _solve_rigid_fit(record, solution.parameters, equal_band_weights=True)
        fit = replace(fit, parameters=solution.parameters)
    covariance = _parameter_covariance(record, solution, fit.std_inflation_by_misfit, gain_std)
    return replace(fit, covariance=covariance)


@dataclass(frozen=True, eq=False)
class _RigidFitData:
    moments: Array
    noise_moments: Array
    noise_levels: NoiseLevels
    is_free: NDArray[np.bool_]
    linear_noise_power: Array


@dataclass(frozen=True, eq=False)
class _RigidSolution:
    parameters: RigidParameters
    residual_derivative: Array
    residual_weights: Array
    inverse_gram: Array
    residual_covariances: Array
    is_undetermined: NDArray[np.bool_]


def _solve_rigid_fit(
    record: _RigidFitData, params: RigidParameters, *, equal_band_weights: bool = False
) -> _RigidSolution:
    sizes, clean = record.noise_levels.half_dof_of_bands, record.moments - record.noise_moments
    R = _residual_covariances(record, params, record.linear_noise_power * sizes[:, None])
    for _ in range(_MAX_RIGID_FIT_STEPS):
        W: Array = np.linalg.inv(R).astype(np.float64)
        if equal_band_weights:
            W[:] = np.linalg.inv(np.einsum("b,bcd->cd", sizes / sizes.sum(), R))
        B, Le = _residual_and_derivative(params)
        gram, right = _normal_equations(B, Le, clean, W)
        inverse, undetermined = _invert_gram_and_flag_undetermined(gram, record.is_free)
        step = inverse @ right
        size = np.sqrt(np.maximum(np.diag(inverse), 0.0)) + 1e-300
        step *= min(1.0, float(np.min(_MAX_GAUSS_NEWTON_STEP / np.maximum(np.abs(step), 1e-300))))
        params = _add_increments(params, step)
        half = np.einsum("cjk,ji->cik", B, inverse)
        used = np.einsum("cik,bkm,cim->bc", half, record.moments, B, optimize=True)
        used = np.clip(used * np.diagonal(W, axis1=1, axis2=2), 0.0, None)
        R = _residual_covariances(record, params, _residual_channel_powers(record, params), used)
        if np.max(np.abs(step) / size) < _MAX_CONVERGED_STEP_OVER_STD:
            break
    return _RigidSolution(params, B, W, inverse, R, undetermined)


def _parameter_covariance(
    record: _RigidFitData, solution: _RigidSolution, inflation: float, wrench_gain_std: float
) -> Array:
    inverse, undetermined = solution.inverse_gram, solution.is_undetermined
    W, none = solution.residual_weights, np.zeros((6, NUM_SPECTRAL_COLUMNS))
    W = W @ solution.residual_covariances @ W
    middle = _normal_equations(solution.residual_derivative, none, record.moments, W)[0]
    covariance = 0.5 * inverse @ middle @ inverse
    covariance *= np.outer(*2 * [_std_inflation_by_estimated_weights(record, solution)])
    larger = covariance * inflation**2
    if wrench_gain_std:
        clean = record.moments - record.noise_moments
        effects = wrench_gain_std * _parameter_errors_by_unit_gain_errors(solution, clean)
        covariance = covariance + effects @ effects.T
        ratio = np.diag(larger) / np.maximum(np.diag(covariance), 1e-300)
        scale = np.sqrt(np.maximum(1.0, ratio))
        larger = covariance * np.outer(scale, scale)
    return mark_undetermined(larger, undetermined)


def _std_inflation_by_estimated_weights(record: _RigidFitData, solution: _RigidSolution) -> Array:
    levels, B = record.noise_levels, solution.residual_derivative
    half = np.einsum("cjk,ji->cik", B, solution.inverse_gram)
    weight = np.diagonal(solution.residual_weights, axis1=1, axis2=2)
    part = np.einsum("cik,bkm,cim->bci", half, record.moments, half, optimize=True)
    part = levels.sums_over_groups(part * weight[..., None]).reshape(-1, NUM_RIGID_PARAMETERS)
    share = part / np.maximum(part.sum(axis=0), 1e-300)
    freedom = np.repeat(2.0 * levels.sums_over_groups(levels.half_dof_of_bands), 6)
    return np.sqrt(1.0 + 4.0 * np.sum(share * (1.0 - share) / freedom[:, None], axis=0))


def _delayed_motion_transformation(params: RigidParameters) -> Array:
    M = motion_transformation_matrix(params.R_PS, params.p_PoSo_P)
    return np.hstack([M, params.delay_s * M[:, :NUM_MOTION_SIGNALS]])


def _residual_wrench_coefficients(params: RigidParameters) -> Array:
    L = -np.einsum("cjk,j->ck", regressor_coefficients(), params.theta)
    L[np.arange(6), np.arange(1, 7)] += 1.0
    return L


def _residual_and_derivative(params: RigidParameters) -> tuple[Array, Array]:
    """Return -de/dx (6, 23, 38) by 23 parameters, e (6, 38): e times 38 signals is the residual."""
    L, M = _residual_wrench_coefficients(params), _delayed_motion_transformation(params)
    step = _ROTATION_DIFFERENCE_STEP_RAD
    B = np.zeros((6, NUM_RIGID_PARAMETERS, NUM_SPECTRAL_COLUMNS))
    B[:, OFFSET_AND_LOAD_PARAMETERS] = regressor_coefficients() @ M
    B[:, DELAY_PARAMETER, spectra.SIGNAL_RATE_SLICE] = -(L @ M)[:, None, :NUM_MOTION_SIGNALS]
    for i, unit in enumerate(np.eye(3)):
        lever = _delayed_motion_transformation(replace(params, p_PoSo_P=params.p_PoSo_P + unit)) - M
        turned = (_rotate_about_own_axes(params.R_PS, x * unit) for x in (step, -step))
        ahead, behind = (_delayed_motion_transformation(replace(params, R_PS=R)) for R in turned)
        B[:, 17 + i] = -L @ lever
        B[:, 20 + i] = -L @ (ahead - behind) / (2.0 * step)
    return B, L @ M


def _normal_equations(B: Array, Le: Array, Z: Array, W: Array) -> tuple[Array, Array]:
    columns = B.reshape(-1, NUM_SPECTRAL_COLUMNS)
    BZ = (columns @ Z).reshape(len(Z), 6, NUM_RIGID_PARAMETERS, NUM_SPECTRAL_COLUMNS)
    WB = np.einsum("bcd,bcjk->dbjk", W, BZ, optimize=True)
    gram = np.einsum("dbjk,dik->ji", WB, B, optimize=True)
    return 0.5 * (gram + gram.T), np.einsum("dbjk,dk->j", WB, Le, optimize=True)


def _invert_gram_and_flag_undetermined(
    gram: Array, free: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    diagonal = np.diag(gram)
    used = free & (diagonal > 0.0)
    scale = np.where(used, 1.0 / np.sqrt(np.where(used, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = values > _MIN_RELATIVE_GRAM_EIGENVALUE * values[-1]
    basis = scale[:, None] * vectors[:, kept]
    null = np.sum(vectors[:, ~kept] ** 2, axis=1) > 1e-6
    return (basis / values[kept]) @ basis.T, free & (~used | null)


def _residual_cross_powers(Z: Array, params: RigidParameters) -> Array:
    Le = _residual_wrench_coefficients(params) @ _delayed_motion_transformation(params)
    return np.asarray(Le @ Z @ Le.T)


def _residual_channel_powers(record: _RigidFitData, params: RigidParameters) -> Array:
    return np.asarray(np.diagonal(_residual_cross_powers(record.moments, params), axis1=1, axis2=2))


def _residual_covariances(
    record: _RigidFitData, params: RigidParameters, power_sums: Array, used_dof: Array | None = None
) -> Array:
    levels, sizes = record.noise_levels, record.noise_levels.half_dof_of_bands[:, None]
    P = _residual_cross_powers(record.noise_moments, params) / sizes[..., None]
    own = np.diagonal(P, axis1=1, axis2=2) * (sizes if used_dof is None else sizes - 0.5 * used_dof)
    least = np.maximum(
        _MIN_WRENCH_NOISE_OVER_RESIDUAL * levels.noise_power(power_sums, used_dof),
        min_noise_power(record.moments, levels),
    )
    rest = np.maximum(levels.noise_power(power_sums - own, used_dof), least)
    return np.asarray(P + rest[:, :, None] * np.eye(6))


def _parameter_errors_by_unit_gain_errors(solution: _RigidSolution, Z: Array) -> Array:
    BF = (solution.residual_derivative.reshape(-1, NUM_SPECTRAL_COLUMNS) @ Z)[:, :, WRENCH_COLUMNS]
    BF = BF.reshape(len(Z), 6, NUM_RIGID_PARAMETERS, 6)
    return parameter_errors_by_gains(BF, solution.residual_weights, solution.inverse_gram)


def _expected_misfit_by_gain_errors(
    record: _RigidFitData, solution: _RigidSolution, gain_std: float
) -> float:
    if gain_std == 0.0:
        return 0.0
    B, levels = solution.residual_derivative, record.noise_levels
    effects = _parameter_errors_by_unit_gain_errors(solution, record.moments)
    left = -np.einsum("cjk,ji->cik", B, effects)
    length = np.repeat([1.0, GAIN_ERROR_TORQUE_ARM_M], 3)
    left = left.reshape(6, 6, 6, NUM_SPECTRAL_COLUMNS)  # of channel c by gain d, k
    for c in range(6):
        left[c, c, :, WRENCH_COLUMNS] += np.diag(length[c] / length)
    left = left.reshape(6, 36, NUM_SPECTRAL_COLUMNS)
    sums = gain_std**2 * np.einsum("cik,bkm,cim->bc", left, record.moments, left, optimize=True)
    more = levels.noise_power(np.maximum(sums, 0.0)) / record.linear_noise_power
    return 2.0 * float(levels.negative_log_likelihoods(1.0 + more).sum())


def _add_increments(params: RigidParameters, change: Array) -> RigidParameters:
    theta = params.theta + change[OFFSET_AND_LOAD_PARAMETERS]
    delay_s, p = (params.delay_s + float(change[16]), params.p_PoSo_P + change[LEVER_PARAMETERS])
    R = _rotate_about_own_axes(params.R_PS, change[ROTATION_PARAMETERS])
    return RigidParameters(theta, delay_s, p, Rotation.from_matrix(R).as_matrix())


def _rotate_about_own_axes(R: Array, rho: Array) -> Array:
    return np.asarray(R @ Rotation.from_rotvec(rho).as_matrix())


_NUM_POSITION_UNIT_ITERATIONS = 5


@dataclass(frozen=True, eq=False)
class UnitsAndAxes:
    """Position unit, axes and masses that the fit of a linear model of the wrench implies.

    Attributes:
        position_unit_ratio: unit error kappa of position; 1e-3 for mm described as m.
        position_unit_ratio_std: its standard deviation; inf if undetermined.
        max_mass_std_kg: largest standard deviation in M_g (3, 3), where force = M_g (-gravity).
        R_SP: (3, 3) polar factor of M_g; determinant -1 if mirrored.
        axis_masses_kg: (3,) singular values of M_g [kg].
    """

    position_unit_ratio: float
    position_unit_ratio_std: float
    max_mass_std_kg: float
    R_SP: Array
    axis_masses_kg: Array

    @property
    def is_usable(self) -> bool:
        """Whether the standard deviations of M_g are below 5 % of the mean mass."""
        return bool(self.max_mass_std_kg < 0.05 * self.axis_masses_kg.mean())

    @property
    def is_mirrored(self) -> bool:
        return bool(np.linalg.det(self.R_SP) < 0.0)


def estimate_position_unit_axes_and_masses(fit: LinearFit) -> UnitsAndAxes:
    variances = np.diagonal(fit.covariance, axis1=1, axis2=2)[:3]
    M_a, M_g, v_a, v_g = (
        x[:, k] for x in (fit.coefficients[:3], variances) for k in (slice(1, 4), GRAVITY_COLUMNS)
    )
    U, masses, Vt = np.linalg.svd(M_g)
    largest = float(np.sqrt(v_g.max())) if (v_g > 0.0).all() else np.inf
    kappa, deviation = _position_unit_and_std(M_a, M_g, v_a, v_g)
    return UnitsAndAxes(kappa, deviation, largest, U @ Vt, masses)


def _position_unit_and_std(M_a: Array, M_g: Array, v_a: Array, v_g: Array) -> tuple[float, float]:
    known = (v_a > 0.0) & (v_g > 0.0)
    a, g, v_a, v_g = (x[known] for x in (M_a, M_g, v_a, v_g))
    kappa = 0.0
    for _ in range(_NUM_POSITION_UNIT_ITERATIONS):
        weight = 1.0 / (v_a + kappa**2 * v_g)
        information = float(weight @ np.maximum(g * g - v_g, 0.0))
        if not information > 0.0:  # gravity is not observable, or nothing is known
            return np.nan, np.inf
        kappa = float(weight @ (a * g)) / information
    return kappa, information**-0.5
