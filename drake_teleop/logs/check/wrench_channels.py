"""Test whether a channel has the opposite sign, or only force or torque is in base axes."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.load.batch.uncertainty import WRENCH_CHANNEL_NAMES
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.pose_motion.splines import PoseSplines
from drake_teleop.logs.read.canonical import Log

_MAX_COMPARED_SAMPLES, _MAX_MISFIT_RATIO, _MAX_UNEXPLAINED_SHARE = 1000, 0.1, 0.01


def wrench_channel_finding(log: Log, splines: PoseSplines | None, delay_s: float) -> Finding | None:
    """Return a finding if a load explains the wrench only after one tested correction, else None.

    The delay of the log is removed; `splines` of its poses lag the wrench by `delay_s` [s].
    """
    few = log.select_rows(slice(None, None, 1 + len(log) // _MAX_COMPARED_SAMPLES))
    R_WS, names = few.R_WS, [*WRENCH_CHANNEL_NAMES]
    corrected = [*(few.wrench * (1.0 - 2.0 * np.eye(6)[:, None]))]
    if splines is not None:
        q = splines.quaternion(few.t + delay_s)
        R_WS = rotation_matrices(q / np.linalg.norm(q, axis=1, keepdims=True), "quaternion_wxyz")
    if R_WS is not None:
        in_S = np.einsum("nji,nkj->nki", R_WS, few.wrench.reshape(-1, 2, 3)).reshape(-1, 6)
        names += ["force", "torque"]
        corrected += [np.where(np.arange(6) // 3 == i, in_S, few.wrench) for i in (0, 1)]
    V = regressor(*few.motion)
    scale = np.linalg.norm(few.wrench.std(axis=0).reshape(2, 3), axis=1).repeat(3) + 1e-12
    V = ((V - V.mean(axis=0)) / scale[:, None]).reshape(-1, 10)

    def residual_share_and_mass(wrench: Array) -> tuple[float, float]:
        y = ((wrench - wrench.mean(axis=0)) / scale).ravel()
        phi = np.linalg.lstsq(V, y, rcond=1e-9)[0]
        return float(np.sum((y - V @ phi) ** 2) / (y @ y)), float(phi[0])

    limit = min(_MAX_MISFIT_RATIO * residual_share_and_mass(few.wrench)[0], _MAX_UNEXPLAINED_SHARE)
    found = {name: residual_share_and_mass(x) for name, x in zip(names, corrected, strict=True)}
    name = min(found, key=lambda x: found[x])
    if not (found[name][0] < limit and found[name][1] > 0.0):
        return None
    kind, text = "mixed axes", f"only the {name} is in base axes; record force and torque in S"
    if name in WRENCH_CHANNEL_NAMES:
        field = f"wrench.{'force' if name.startswith('f') else 'torque'}.scale"
        kind, text = "channel sign", f"{name} has the opposite sign; change its sign in {field}"
    return Finding(kind, f"payload not identifiable: {text}", values={"part": name})
