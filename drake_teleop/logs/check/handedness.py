"""Test whether poses are those of a left-handed frame, as Unity records them."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.rotations import signed_permutations
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check.against_load import MAX_VALID_RESIDUAL_SHARE
from drake_teleop.logs.pose_motion.splines import PoseSplines
from drake_teleop.logs.read.canonical import Log

_MAX_COMPARED_SAMPLES, _MAX_MISFIT_RATIO_OF_MIRRORED_POSES = 600, 0.25
_LEFT_HANDED_POSES_MESSAGE = (
    "payload not identifiable: the wrench fits the poses only if they are mirrored, as in a"
    " left-handed world (Unity, Unreal); negate y of the positions and x and z of the quaternions,"
    " and inspect the log again"
)


def left_handed_pose_finding(
    log: Log, splines: PoseSplines | None, delay_s: float
) -> Finding | None:
    """Return a finding if only a mirrored motion explains the wrench, else None.

    A mirrored motion explains [P f; -P tau] with a signed permutation P of determinant -1. All
    axes and signs of force, torque and gravity are tried. `splines` lag the wrench by `delay_s`.
    """
    few = log.select_rows(slice(None, None, 1 + len(log) // _MAX_COMPARED_SAMPLES))
    wrench = (few.wrench - few.wrench.mean(axis=0)).reshape(-1, 2, 3)
    scale = np.linalg.norm(wrench, axis=(0, 2)) + 1e-12
    kinds = [(P, torque_sign) for P in signed_permutations() for torque_sign in (1.0, -1.0)]
    right = np.stack([wrench @ P.T * [[1.0], [k]] / scale[:, None] for P, k in kinds], axis=-1)
    right = right.reshape(-1, len(kinds))
    # Two reversed axes and a reversed torque are more likely a mirror with a reversed wrench.
    is_mirrored = np.array([k < 0.0 and min(np.linalg.det(P), P.trace()) < 0.0 for P, k in kinds])
    least = {True: np.inf, False: np.inf}
    size = 9.81 if log.gravity is None else float(np.median(np.linalg.norm(log.gravity, axis=1)))
    for gravity_W in size * np.vstack([np.eye(3), -np.eye(3)]):
        s, *rotation = few.motion
        if splines is not None:
            s, *rotation, _ = splines.motion(few.t + delay_s, gravity_W)
        elif few.gravity is not None and few.R_WS is not None:
            s = s + few.gravity - gravity_W @ few.R_WS
        V = regressor(s, *rotation)
        V = ((V - V.mean(axis=0)) / scale.repeat(3)[:, None]).reshape(-1, 10)
        phi = np.linalg.lstsq(V, right, rcond=1e-9)[0]
        unexplained = np.sum((right - V @ phi) ** 2, axis=0) / 2.0
        for mirrored in least:
            valid = (is_mirrored == mirrored) & (phi[0] > 0.0)
            least[mirrored] = min(least[mirrored], unexplained[valid].min(initial=np.inf))
    limit = min(MAX_VALID_RESIDUAL_SHARE, _MAX_MISFIT_RATIO_OF_MIRRORED_POSES * least[False])
    return Finding("left-handed", _LEFT_HANDED_POSES_MESSAGE) if least[True] < limit else None
