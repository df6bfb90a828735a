"""Accelerometer compared with the pose's positions."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.vectors import cross_matrix
from drake_teleop.logs.check.finding import Finding
from drake_teleop.logs.check.fitting import fit_with_offset
from drake_teleop.logs.check.log_data import LogData
from drake_teleop.logs.read.alignment import low_pass, resample
from drake_teleop.logs.read.description import Description

_CUTOFF = 3.0
_SHIFT, _KNOWN, _SURE = 0.02, 0.01, 5.0
_UNITS = {"mm": 1e-3, "m": 1e3}
_NEAR, _SAME = (0.7, 1.43), 0.15
_FAR = 50.0


def position_finding(description: Description, data: LogData, lag: float) -> list[Finding]:
    """Return a finding for positions in another unit, or of another point than So.

    In S, a_P = k (a_S + alpha x r + omega x (omega x r)) with the unit k and the point r.
    """
    imu, pose = description.imu, description.pose
    if imu is None or pose is None or imu.specific_force is None or pose.position is None:
        return []
    if imu.automatic or pose.automatic:
        return []
    sensed = data.thin(description)
    posed = data.thin(description.model_copy(update={"imu": None}))
    if sensed.gravity is None or posed.gravity is None:
        return []
    # Both logs begin with the wrench, so that their times are on one clock.
    t = sensed.t[(sensed.t + lag <= sensed.t[-1]) & (sensed.t + lag >= sensed.t[0])]
    t = t[(t >= posed.t[0]) & (t <= posed.t[-1])]
    g = resample(t, posed.t, posed.gravity)
    by_pose = resample(t, posed.t, posed.specific_force) + g
    s, omega, alpha = (resample(t + lag, sensed.t, x) for x in sensed.motion)
    turning = np.stack([cross_matrix(w) @ cross_matrix(w) for w in omega])
    turning += np.stack([cross_matrix(x) for x in alpha])
    columns = np.concatenate([(s + g)[:, :, None], turning], axis=2)
    columns, by_pose = (low_pass(x, sensed.dt, _CUTOFF) for x in (columns, by_pose))
    inner = slice(len(t) // 50, len(t) - len(t) // 50)
    fit = fit_with_offset(columns[inner], by_pose[inner], 2.0 * _CUTOFF * float(t[-1] - t[0]))
    if fit is None or abs(fit.x[0]) <= _SURE * fit.deviations[0]:
        return []
    k = float(fit.x[0])
    unit = position_unit(pose.position.unit, 1.0 / k, float(fit.deviations[0]) / k**2)
    if unit is not None:
        return [unit]
    shift, sure = fit.x[1:] / k, float(np.linalg.norm(fit.deviations[1:]))
    size = float(np.linalg.norm(shift))
    if abs(k - 1.0) > _SAME or sure > _KNOWN or size < max(_SHIFT, _SURE * sure):
        return []
    place = np.round(shift + np.array(pose.position_in_sensor), 4) + 0.0
    return [
        Finding(
            "pose frame",
            f"the pose's origin is {1e3 * size:.0f} mm (+- {1e3 * sure:.2g}) from the"
            f" accelerometer; if that is where the description says, set pose.position_in_sensor:"
            f" {place.tolist()}, else imu.position: {(0.0 - place).tolist()}",
        )
    ]


def position_unit(now: str, kappa: float, deviation: float) -> Finding | None:
    """Return a finding for positions in another unit; `kappa`: their acceleration's inverse ratio."""
    if not abs(kappa) > _SURE * deviation:
        return None
    text = f"the acceleration by the position is {1.0 / kappa:.3g} times what is felt: it is not in"
    for unit, ratio in _UNITS.items():
        if unit != now and _NEAR[0] < kappa / ratio < _NEAR[1]:
            return Finding("units", f"{text} {now}; set pose.position.unit: {unit}")
    if 1.0 / _FAR < abs(kappa) < _FAR:  # noise or another error
        return None
    return Finding(
        "units",
        f"{text} {' or '.join(_UNITS)}, the units that a description knows; convert the columns of"
        " pose.position",
    )
