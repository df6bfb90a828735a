"""Work at a port of the station, computed from recorded wrenches f and poses."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, float_array
from drake_teleop.station.passivity.packet import dot_of_group, pose_difference_into

#: Value of `pair` -> weight of f_k; the weight of f_(k-1) is the rest to 1.
NEW_WRENCH_SHARES = {"held": 0.0, "backward": 1.0, "mean": 0.5}


def port_work(wrench: Array, pose: Array, pair: str = "held") -> Array:
    """Return the cumulative work (N, 2) of a wrench on a moving body, translation and rotation [J].

    Args:
        wrench: (N, 6) [f; tau], in W [N, N m].
        pose: (N, 7) pose of the body [qw qx qy qz px py pz], in W, at the same instants.
        pair: wrench between k-1 and k: "held" f_(k-1), "backward" f_k, or the "mean" of both.
    """
    if pair not in NEW_WRENCH_SHARES:
        remedy = f"choose one of {', '.join(NEW_WRENCH_SHARES)}"
        raise DrakeTeleopError(f"'{pair}' is unknown", where="pair", remedy=remedy)
    wrench = np.ascontiguousarray(float_array("wrench", wrench))
    pose = np.ascontiguousarray(float_array("pose", pose))
    if wrench.ndim != 2 or wrench.shape[1] != 6 or pose.shape != (len(wrench), 7):
        what = f"expected shapes (N, 6) and (N, 7), found {wrench.shape} and {pose.shape}"
        remedy = "give one wrench and one pose for each of the N samples"
        raise DrakeTeleopError(what, where="wrench, pose", remedy=remedy)
    work = np.zeros((len(wrench), 2))
    _cumulative_work_into(wrench, pose, NEW_WRENCH_SHARES[pair], work)
    return work


@njit(cache=True)
def _cumulative_work_into(wrench, pose, new_wrench_share, work):
    dx, f = np.zeros(6), np.zeros(6)
    for k in range(1, len(wrench)):
        pose_difference_into(pose[k], pose[k - 1], dx)
        for i in range(6):
            f[i] = wrench[k - 1, i] + new_wrench_share * (wrench[k, i] - wrench[k - 1, i])
        for g in range(2):
            work[k, g] = work[k - 1, g] + dot_of_group(f, dx, g)
