"""Orientations in every form of a log."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_teleop.common.rotations import (
    NUM_COLUMNS_BY_ROTATION_FORM,
    orthogonality_error,
    rotation_matrices,
)
from drake_teleop.logs.read.mounting import least_squares_with_deviations
from drake_teleop.logs.read.streams import OrientationColumns

VECTORS = np.vstack([np.zeros((1, 3)), 3 * np.random.default_rng(2).uniform(-1, 1, (50, 3))])


@pytest.mark.parametrize(
    "form", ["matrix", "quaternion_wxyz", "quaternion_xyzw", "rotation_vector"]
)
def test_all_rotation_forms_give_the_same_matrix(form: str) -> None:
    R = Rotation.from_rotvec(VECTORS)
    columns = {
        "matrix": R.as_matrix().reshape(-1, 9),
        "quaternion_wxyz": R.as_quat(scalar_first=True),
        "quaternion_xyzw": R.as_quat(),
        "rotation_vector": VECTORS,
    }
    np.testing.assert_allclose(rotation_matrices(columns[form], form), R.as_matrix(), atol=1e-12)


def test_solve_handles_a_zero_residual() -> None:
    exact = np.array([0.3, -2.0])
    x, deviations = least_squares_with_deviations(
        lambda x: np.outer(np.arange(60.0), [1, 1, 1]) * (x - exact).sum(), exact
    )
    np.testing.assert_array_equal(x, exact)
    assert np.isinf(deviations).all()  # only the sum is determined
    noise = np.random.default_rng(3).normal(size=(200, 3))
    x, _ = least_squares_with_deviations(
        lambda x: np.hstack([x[:1] - noise, np.full((200, 3), x[1])]), np.ones(2)
    )
    np.testing.assert_allclose(x, [noise.mean(), 0.0], atol=1e-9)  # one half has a zero residual


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("form", NUM_COLUMNS_BY_ROTATION_FORM)
def test_orientations_of_selected_rows_in_any_form_are_read(form: str, inverse: bool) -> None:
    turns = Rotation.from_rotvec(VECTORS[:5])
    columns = {
        "matrix": turns.as_matrix().reshape(-1, 9),
        "quaternion_wxyz": turns.as_quat()[:, [3, 0, 1, 2]],
        "quaternion_xyzw": turns.as_quat(),
        "rotation_vector": np.degrees(turns.as_rotvec()),
        "euler": turns.as_euler("ZYX", degrees=True),
    }[form]
    orientations = OrientationColumns(
        SimpleNamespace(unit_in_si=lambda unit: np.radians(1.0)),
        SimpleNamespace(columns=[], form=form, axes="ZYX", unit="deg", inverse=inverse),
        SimpleNamespace(finite_numbers=lambda *_: columns.copy()),
        5,
        "log.yaml:pose.orientation",
    )
    rows = np.array([3, 1])
    wanted = (turns.inv() if inverse else turns).as_matrix()[rows]
    np.testing.assert_allclose(orientations.rotations(rows), wanted, atol=1e-12)
    found = orientations.quaternions(rows)
    np.testing.assert_allclose(rotation_matrices(found, "quaternion_wxyz"), wanted, atol=1e-12)
    rows = np.array([0, 2, 3])  # increasing; written where later rows may still be unread
    wanted = (turns.inv() if inverse else turns).as_matrix()[rows]
    written = orientations.allocate_quaternions(len(rows))
    for k in range(len(rows)):
        written[k : k + 1] = orientations.quaternions(rows[k : k + 1])
    np.testing.assert_allclose(rotation_matrices(written, "quaternion_wxyz"), wanted, atol=1e-12)


def test_a_mirrored_matrix_is_no_rotation() -> None:
    R = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    errors = orthogonality_error(np.stack([R, R @ np.diag([1.0, 1.0, -1.0]), 1.01 * R]))
    np.testing.assert_allclose(errors, [0.0, 2.0, 1.01**2 - 1.0], atol=1e-12)
