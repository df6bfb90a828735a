"""How fast is the load core, compared with other libraries?

Every figure is a ratio of thread times, measured in turns (the best of several), next to the time
itself. The results are compared before the timing.

- V phi: one call for one sample, and for many at once, against pinocchio's body regressor.
- One update with all six rows: compiled loop, and `update` from Python, against padasip's and
  filterpy's and a plain numpy recursion; also recursive total least squares.
- A batch with offsets and covariance: against stacking [E V] and solving with numpy by lstsq and by
  the normal equations, which give the estimate alone; with the peak memory of each.
- The consistent load: against the same semidefinite program in cvxpy with the same solver
  (Clarabel), set up anew as for each new record, and with a repeated solution.

    pip install -e '.[bench]'
    OMP_NUM_THREADS=1 python benchmarks/identification.py [--json FILE] [--samples 1000000]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_teleop.load.batch.consistent import consistent_least_squares
from drake_teleop.load.inertia import (
    is_physically_consistent,
    phi_from_mass_com_inertia,
    pseudo_inertia,
)
from drake_teleop.load.normal_equations import SecondMoments, identify
from drake_teleop.load.online.recursive import PRIOR_STD, RecursiveLeastSquares
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares
from drake_teleop.load.regressor import (
    non_contact_wrench,
    non_contact_wrench_into,
    regressor,
    regressor_into,
)

Array = NDArray[np.float64]
PHI = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))
OFFSETS = np.array([6.2, -3.9, 8.1, 0.31, -0.42, 0.12])
NOISE = np.repeat([0.25, 0.012], 3)
# Pinocchio orders the inertia Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
PIN_ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]


def samples(n: int, seed: int = 1) -> tuple[Array, Array, Array, Array]:
    """Return (wrench, s, omega, alpha) of n samples of the load PHI with OFFSETS and NOISE."""
    rng = np.random.default_rng(seed)
    s, omega, alpha = (rng.normal(size=(n, 3)) * size for size in (8.0, 2.0, 15.0))
    wrench = non_contact_wrench(s, omega, alpha, PHI) + OFFSETS + NOISE * rng.normal(size=(n, 6))
    return wrench, s, omega, alpha


def best(functions: dict[str, Callable[[], Any]], rounds: int = 7) -> dict[str, float]:
    """Return the shortest thread time of each [s], measured in turns after a first call.

    Other programs on the machine do not affect thread times.
    """
    for function in functions.values():
        function()
    times = {name: np.inf for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.thread_time()
            function()
            times[name] = min(times[name], time.thread_time() - start)
    return times


def wrench_of_a_load() -> dict[str, float]:
    import pinocchio as pin

    n, few = 100_000, 5_000
    _, s, omega, alpha = samples(n)
    inertia = pin.Inertia.FromDynamicParameters(PHI[PIN_ORDER])

    def with_pinocchio(i: int) -> Array:
        # Pinocchio's twist does not contain a - g: its linear acceleration is spatial.
        velocity = pin.Motion(np.zeros(3), omega[i])
        return pin.bodyRegressor(velocity, pin.Motion(s[i], alpha[i])) @ PHI[PIN_ORDER]

    def with_pinocchio_inertia(i: int) -> Array:
        velocity, acceleration = pin.Motion(np.zeros(3), omega[i]), pin.Motion(s[i], alpha[i])
        return (inertia * acceleration + velocity.cross(inertia * velocity)).vector

    for i in range(20):
        expected = non_contact_wrench(s[i], omega[i], alpha[i], PHI)
        np.testing.assert_allclose(with_pinocchio(i), expected, atol=1e-9)
        np.testing.assert_allclose(with_pinocchio_inertia(i), expected, atol=1e-9)
    out = np.empty(6)
    V = np.empty((6, 10))

    @njit
    def kernels(s: Array, omega: Array, alpha: Array, phi: Array, out: Array) -> None:
        for i in range(s.shape[0]):
            non_contact_wrench_into(s[i], omega[i], alpha[i], phi, out)

    times = best(
        {
            "compiled": lambda: kernels(s, omega, alpha, PHI, out),
            "vectorised": lambda: non_contact_wrench(s, omega, alpha, PHI),
            "call": lambda: [
                non_contact_wrench_into(s[i], omega[i], alpha[i], PHI, out) for i in range(few)
            ],
            "regressor_call": lambda: [
                regressor_into(s[i], omega[i], alpha[i], V) for i in range(few)
            ],
            "pin_regressor": lambda: [with_pinocchio(i) for i in range(few)],
            "pin_inertia": lambda: [with_pinocchio_inertia(i) for i in range(few)],
        }
    )
    each = {
        name: t / (n if name in ("compiled", "vectorised") else few) for name, t in times.items()
    }
    return {
        "wrench_call_us": 1e6 * each["call"],
        "wrench_in_compiled_loop_us": 1e6 * each["compiled"],
        "wrench_vectorised_us": 1e6 * each["vectorised"],
        "regressor_call_us": 1e6 * each["regressor_call"],
        "wrench_pin_regressor_over_call": each["pin_regressor"] / each["call"],
        "wrench_pin_inertia_over_call": each["pin_inertia"] / each["call"],
        "wrench_pin_regressor_over_vectorised": each["pin_regressor"] / each["vectorised"],
        "wrench_pin_inertia_over_vectorised": each["pin_inertia"] / each["vectorised"],
    }


def recursive_update() -> dict[str, float]:
    import padasip
    from filterpy.kalman import KalmanFilter

    n, few = 20_000, 1_000
    wrench, s, omega, alpha = samples(n)
    prior = np.array(PRIOR_STD) ** 2
    rows = np.concatenate([np.tile(np.eye(6), (few, 1, 1)), regressor(s, omega, alpha)[:few]], 2)

    def compiled(count: int = n) -> Array:
        estimator = RecursiveLeastSquares(NOISE)
        estimator.update_samples(wrench[:count], s[:count], omega[:count], alpha[:count])
        return np.concatenate([estimator.offsets, estimator.phi])

    def total() -> None:
        # Noise of s, omega and alpha; its size does not affect the time.
        motion_std = np.repeat([0.05, 0.002, 1.0], 3)
        RecursiveTotalLeastSquares(NOISE, motion_std).update_samples(wrench, s, omega, alpha)

    def python() -> Array:
        estimator = RecursiveLeastSquares(NOISE)
        for i in range(few):
            estimator.update(wrench[i], s[i], omega[i], alpha[i])
        return np.concatenate([estimator.offsets, estimator.phi])

    def numpy_blocks() -> Array:
        theta, P, R = np.zeros(16), np.diag(prior), np.diag(NOISE**2)
        for i in range(few):
            A = rows[i]
            K = np.linalg.solve(A @ P @ A.T + R, A @ P).T
            theta = theta + K @ (wrench[i] - A @ theta)
            P = P - K @ (A @ P)
        return theta

    def with_filterpy() -> Array:
        kalman = KalmanFilter(dim_x=16, dim_z=6)
        kalman.x, kalman.P, kalman.R = np.zeros(16), np.diag(prior), np.diag(NOISE**2)
        for i in range(few):
            kalman.update(wrench[i], H=rows[i])
        return kalman.x

    def with_padasip() -> Array:
        # One row at a time, divided by its noise; eps is the inverse of one prior for all.
        rls = padasip.filters.FilterRLS(16, mu=1.0, eps=1e-4, w="zeros")
        for i in range(few):
            for c in range(6):
                rls.adapt(wrench[i, c] / NOISE[c], rows[i, c] / NOISE[c])
        return rls.w

    expected = compiled(few)
    for name, function, tolerance in (
        ("python", python, 1e-9),
        ("numpy", numpy_blocks, 1e-6),
        ("filterpy", with_filterpy, 1e-6),
        ("padasip", with_padasip, 1e-3),
    ):
        error = np.abs(function() - expected).max()
        if error > tolerance:
            raise SystemExit(f"{name} does not do the same: {error:.2g}")
    times = best(
        {
            "compiled": compiled,
            "total": total,
            "python": python,
            "numpy": numpy_blocks,
            "filterpy": with_filterpy,
            "padasip": with_padasip,
        },
        rounds=5,
    )
    each = {name: t / (n if name in ("compiled", "total") else few) for name, t in times.items()}
    figures = {
        "rls_in_compiled_loop_us": 1e6 * each["compiled"],
        "rtls_in_compiled_loop_us": 1e6 * each["total"],
        "rtls_over_rls": each["total"] / each["compiled"],
        "rls_from_python_us": 1e6 * each["python"],
    }
    for name in ("numpy", "filterpy", "padasip"):
        figures[f"rls_{name}_over_compiled"] = each[name] / each["compiled"]
        figures[f"rls_{name}_over_python"] = each[name] / each["python"]
    return figures


def _stacked(s: Array, omega: Array, alpha: Array) -> Array:
    """Return the whole matrix [E V] (6 N, 16), by numpy alone."""
    n = len(s)
    A = np.zeros((n, 6, 16))
    A[:, :, :6] = np.eye(6)
    sx, sy, sz = s.T
    wx, wy, wz = omega.T
    ax, ay, az = alpha.T
    V = A[:, :, 6:]
    V[:, 0, 0], V[:, 1, 0], V[:, 2, 0] = sx, sy, sz
    W = np.zeros((n, 3, 3))
    W[:, 0, 1], W[:, 0, 2] = -wz, wy
    W[:, 1, 0], W[:, 1, 2] = wz, -wx
    W[:, 2, 0], W[:, 2, 1] = -wy, wx
    Al = np.zeros((n, 3, 3))
    Al[:, 0, 1], Al[:, 0, 2] = -az, ay
    Al[:, 1, 0], Al[:, 1, 2] = az, -ax
    Al[:, 2, 0], Al[:, 2, 1] = -ay, ax
    V[:, :3, 1:4] = Al + W @ W
    V[:, 3, 2], V[:, 3, 3] = sz, -sy
    V[:, 4, 1], V[:, 4, 3] = -sz, sx
    V[:, 5, 1], V[:, 5, 2] = sy, -sx

    def tensor_times(x: Array, y: Array, z: Array) -> Array:
        B = np.zeros((n, 3, 6))
        B[:, 0, 0], B[:, 0, 1], B[:, 0, 2] = x, y, z
        B[:, 1, 1], B[:, 1, 3], B[:, 1, 4] = x, y, z
        B[:, 2, 2], B[:, 2, 4], B[:, 2, 5] = x, y, z
        return B

    V[:, 3:, 4:] = tensor_times(ax, ay, az) + W @ tensor_times(wx, wy, wz)
    return A.reshape(-1, 16)


def _least_squares(wrench: Array, s: Array, omega: Array, alpha: Array) -> Array:
    """Solve by least squares, as code without this library does."""
    return np.linalg.lstsq(_stacked(s, omega, alpha), wrench.reshape(-1), rcond=None)[0]


def _normal_equations(wrench: Array, s: Array, omega: Array, alpha: Array) -> Array:
    """Solve the normal equations, from the whole matrix."""
    A = _stacked(s, omega, alpha)
    return np.linalg.solve(A.T @ A, A.T @ wrench.reshape(-1))


def _chunked(wrench: Array, s: Array, omega: Array, alpha: Array) -> Array:
    found = identify(wrench, s, omega, alpha)
    return np.concatenate([found.offsets, found.phi])


_BATCH = {"chunked": _chunked, "stacked": _least_squares, "normal": _normal_equations}


def _memory_mb(name: str) -> float:
    """Return VmRSS, the memory in use, or VmHWM, the most since the last reset; Linux only."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return float(line.split()[1]) / 1024.0
    raise SystemExit(f"/proc/self/status has no {name}")


def _measured(name: str, n: int, answer: Any) -> None:
    """Return time, peak memory beyond the data, and the estimate, in a separate process."""
    solve = _BATCH[name]
    solve(*samples(1000))
    data = samples(n)
    Path("/proc/self/clear_refs").write_text("5")  # This resets VmHWM.
    before = _memory_mb("VmRSS")
    start = time.thread_time()
    theta = solve(*data)
    seconds = time.thread_time() - start
    answer.send((seconds, _memory_mb("VmHWM") - before, theta))


def batch(n: int) -> dict[str, float]:
    context = multiprocessing.get_context("spawn")
    runs: dict[str, list[tuple[float, float, Array]]] = {name: [] for name in _BATCH}
    for _ in range(3):
        for name, results in runs.items():
            receive, send = context.Pipe(duplex=False)
            process = context.Process(target=_measured, args=(name, n, send))
            process.start()
            results.append(receive.recv())
            process.join()
    for results in runs.values():
        np.testing.assert_allclose(results[0][2], runs["chunked"][0][2], atol=1e-8)
    seconds = {name: min(result[0] for result in results) for name, results in runs.items()}
    peak = {name: max(result[1] for result in results) for name, results in runs.items()}
    return {
        "batch_samples": float(n),
        "batch_s": seconds["chunked"],
        "batch_lstsq_over_ours": seconds["stacked"] / seconds["chunked"],
        "batch_normal_equations_over_ours": seconds["normal"] / seconds["chunked"],
        "batch_extra_mb": peak["chunked"],
        "batch_lstsq_extra_mb": peak["stacked"],
        "batch_normal_equations_extra_mb": peak["normal"],
    }


def consistent_load() -> dict[str, float]:
    import cvxpy

    # Few noisy samples of a rod: the result of least squares is physically impossible.
    rod = phi_from_mass_com_inertia(1.1, [0.0, 0.0, 0.2], np.diag([0.02, 0.02, 1e-5]))
    _, s, omega, alpha = samples(60, seed=3)
    rng = np.random.default_rng(3)
    wrench = non_contact_wrench(s, omega, alpha, rod) + 3 * NOISE * rng.normal(size=(60, 6))
    equations = SecondMoments(NOISE)
    equations.add_samples(wrench, s, omega, alpha)
    gram, right = (part / 60 for part in equations.normal_equations())
    theta = np.linalg.solve(gram, right)
    if is_physically_consistent(theta[6:]):
        raise SystemExit("the example is consistent already: there is nothing to solve")
    basis = [pseudo_inertia(unit) for unit in np.eye(10)]
    root = np.linalg.cholesky(gram).T
    target = np.linalg.solve(root.T, right)
    x = cvxpy.Variable(16)
    J = sum(x[6 + k] * basis[k] for k in range(10))
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(root @ x - target)), [J >> 0])

    def ours() -> Array:
        return consistent_least_squares(gram, right, theta)

    def theirs() -> Array:
        problem.solve(solver="CLARABEL")
        return x.value

    def fresh() -> Array:
        y = cvxpy.Variable(16)
        cone = sum(y[6 + k] * basis[k] for k in range(10)) >> 0
        cost = cvxpy.sum_squares(root @ y - target)
        cvxpy.Problem(cvxpy.Minimize(cost), [cone]).solve(solver="CLARABEL")
        return y.value

    def excess(theta: Array) -> float:
        return float(theta @ gram @ theta - 2 * right @ theta)

    difference = abs(excess(ours()) - excess(theirs()))
    if difference > 1e-4 * abs(excess(ours())):
        raise SystemExit(f"cvxpy finds another minimum: {difference:.2g}")
    # Times between turns of cvxpy, with cold caches, and in sequence.
    times = best({"ours": ours, "again": theirs, "fresh": fresh}, rounds=50)
    alone = best({"ours": ours}, rounds=50)
    return {
        "consistent_alone_ms": 1e3 * alone["ours"],
        "consistent_ms": 1e3 * times["ours"],
        "consistent_cvxpy_again_over_ours": times["again"] / times["ours"],
        "consistent_cvxpy_fresh_over_ours": times["fresh"] / times["ours"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--samples", type=int, default=1_000_000, help="samples of the batch")
    arguments = parser.parse_args()
    figures: dict[str, float] = {"cores": float(os.cpu_count() or 0)}
    parts: list[Callable[[], dict[str, float]]] = [
        wrench_of_a_load,
        recursive_update,
        consistent_load,
        lambda: batch(arguments.samples),
    ]
    for part in parts:
        figures |= part()
    for name, figure in figures.items():
        print(f"{name:45s} {figure:12.4g}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
