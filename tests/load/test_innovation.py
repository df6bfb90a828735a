"""Whitening of block means with a relative model error of the wrench."""

from __future__ import annotations

import numpy as np
from load_cases import TOOL

from drake_teleop.load.online.change import whitening_matrix
from drake_teleop.load.regressor import non_contact_wrench


def test_whitening_includes_model_errors_of_force_and_torque():
    """Shares of |f| for forces; of |tau|, and of |f| at the centre of mass, for torques."""
    motion = np.array([1.0, -2.0, 9.0, 0.5, 2.0, -1.0, 20.0, -10.0, 60.0])
    wrench = non_contact_wrench(*np.split(motion, 3), TOOL)
    f, tau = np.sum(wrench[:3] ** 2), np.sum(wrench[3:] ** 2)
    arm = np.sum((TOOL[1:4] / TOOL[0]) ** 2)
    assert wrench[5] ** 2 > 0.05 * tau
    expected = 0.02**2 * np.repeat([f, tau + arm * f], 3)
    root = whitening_matrix(motion, TOOL, np.zeros(15), 0.02**2, 3)
    np.testing.assert_allclose(root, np.diag(expected**-0.5), rtol=1e-9)
