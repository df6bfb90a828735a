"""Blocks whose model is known to a share of the wrench: how they are whitened."""

from __future__ import annotations

import numpy as np
from load_cases import TOOL

from drake_teleop.load.online.change import whitening_matrix
from drake_teleop.load.regressor import non_contact_wrench


def test_a_share_of_force_and_torque_is_not_known():
    """Of a block of any length: of |f|; for torques of |tau|, and of |f| at the centre of mass."""
    motion = np.array([1.0, -2.0, 9.0, 0.5, 2.0, -1.0, 20.0, -10.0, 60.0])
    wrench = non_contact_wrench(*np.split(motion, 3), TOOL)
    f, tau = np.sum(wrench[:3] ** 2), np.sum(wrench[3:] ** 2)
    arm = np.sum((TOOL[1:4] / TOOL[0]) ** 2)
    assert wrench[5] ** 2 > 0.05 * tau
    expected = 0.02**2 * np.repeat([f, tau + arm * f], 3)
    root = whitening_matrix(motion, TOOL, np.zeros(15), 0.02**2, 3)
    np.testing.assert_allclose(root, np.diag(expected**-0.5), rtol=1e-9)
