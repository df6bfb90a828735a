"""Check of an arm's size, which shows wrong units."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.arm import PHI, TRANSLATION, ArmModel

_MIN_LENGTH_M, _MAX_LENGTH_M = 0.01, 50.0  # lengths of an arm [m]


def check_size(arm: ArmModel, where: str) -> None:
    """Raise DrakeTeleopError for an implausible arm length, or a mass far from its joint."""
    length = float(np.linalg.norm(arm.table[1:, TRANSLATION:PHI], axis=1).sum())
    remedy = "give lengths in m, and inertias in kg m^2"
    if 0.0 < length < _MIN_LENGTH_M or length > _MAX_LENGTH_M:
        what = f"from its first joint to the sensor it is {length:.3g} m long"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    for name, phi in zip((*arm.joint_names, "the sensor"), arm.table[:, PHI:], strict=True):
        # Root mean square distance of the mass from the joint's origin.
        distance = np.sqrt((phi[4] + phi[7] + phi[9]) / (2.0 * phi[0])) if phi[0] > 0.0 else 0.0
        if distance > _MAX_LENGTH_M:
            what = f"the mass moved by {name} is {distance:.3g} m away from it"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
