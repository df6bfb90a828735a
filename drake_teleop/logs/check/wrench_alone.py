"""Axes and units of a wrench, without one load for both force and torque.

Force is linear in the specific force in any axes. m c follows from force and from torque; the
ratio is that of their units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product

import numpy as np
from numpy.typing import NDArray

from drake_teleop.load.regressor import regressor
from drake_teleop.logs.check.edits import edit_field
from drake_teleop.logs.check.finding import Finding
from drake_teleop.logs.check.fitting import fit_with_offset
from drake_teleop.logs.pose_motion.read_off import nearest_permutation
from drake_teleop.logs.read.alignment import low_passed, measured, undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import UNITS, Description, Wrench

Array = NDArray[np.float64]
_CUTOFF = 3.0
_MOST = 3000
_KNOWN, _SURE = 0.05, 5.0
_OBLIQUE, _SPREAD = 5.0, 0.2
_MATCH, _FARTHEST, _NEAREST = 0.1, 1.5, 2e-4
_FAR, _PARALLEL = 20.0, 0.98
FORCES, TORQUES = ("N", "lbf"), ("N m", "N mm", "lbf in")


def wrench_findings(
    description: Description, log: Log, delays: tuple[float, ...] = (0.0,)
) -> tuple[list[Finding], Description]:
    """Return findings for unit or axes of the wrench, and the corrected description."""
    wrench = description.wrench
    if wrench is None or wrench.frame == "base" or log.static:
        return [], description
    independent = 2.0 * _CUTOFF * float(log.t[-1] - log.t[0])
    logs = [_smooth(undelayed(log, delay)) for delay in sorted({*delays})]
    fits = [_force_by_motion(log, independent) for log in logs]
    fit, smooth = min(zip(fits, logs, strict=True), key=lambda entry: entry[0][1])
    axes = _axes(description, wrench, *fit)
    if axes is not None:
        return [axes], description
    found = _unit(wrench, smooth, independent)
    return ([], description) if found is None else ([found[0]], found[1](description))


def _smooth(log: Log) -> Log:
    smooth = low_passed(log, _CUTOFF).only(measured(log, _CUTOFF))
    return smooth.only(slice(None, None, max(1, len(smooth) // _MOST)))


def _force_by_motion(log: Log, independent: float) -> tuple[Array, float]:
    """Return force over specific force (3, 3) and its deviation [kg]."""
    s, omega, alpha = log.motion
    squares = np.stack([omega[:, i] * omega[:, k] for i in range(3) for k in range(i, 3)], axis=1)
    columns = np.hstack([s, alpha, squares])
    fits = [fit_with_offset(columns[:, None], f[:, None], independent) for f in log.wrench[:, :3].T]
    known = [fit for fit in fits if fit is not None]
    if len(known) < 3:
        return np.eye(3), np.inf
    deviation = max(float(fit.deviations[:3].max()) for fit in known)
    return np.stack([fit.x[:3] for fit in known]), deviation


def _axes(description: Description, wrench: Wrench, M: Array, deviation: float) -> Finding | None:
    U, masses, Vt = np.linalg.svd(M)
    mass = float(masses.mean())
    if deviation >= _KNOWN * mass or masses[0] - masses[2] > _SPREAD * mass:
        return None
    Q = U @ Vt
    near = nearest_permutation(Q)
    oblique, angle = _angle(near.T @ Q), _angle(Q)
    if np.linalg.det(Q) < 0.0:
        mirrored = oblique < 2 * _OBLIQUE and _angle(-Q) > 45.0 and (near < 0.0).any()
        return mirrored_finding(wrench, near) if mirrored else None
    sure = np.degrees(_SURE * deviation / mass)
    if angle < max(_OBLIQUE, sure) or (description.imu is None and description.pose is not None):
        return None  # `against_frame` checks the frame of poses without an IMU.
    right_angled = oblique < _OBLIQUE
    old = np.array(wrench.frame) if isinstance(wrench.frame, tuple) else np.eye(3)
    frame = np.round((near if right_angled else Q).T @ old, 4) + 0.0
    return Finding(
        "swapped axes" if right_angled else "mounting",
        f"the axes of the wrench are turned by {angle:.1f} deg (+- {sure / _SURE:.2g}) against"
        f" those of the motion; set wrench.frame: {frame.tolist()}",
    )


def _angle(R: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0))))


def mirrored_finding(wrench: Wrench, near: Array) -> Finding:
    """Return the finding for mirrored axes, with the columns of wrong sign."""
    order, signs = np.abs(near).argmax(axis=1), near.sum(axis=1)
    text = "the axes of the wrench are those of the motion mirrored"
    columns = wrench.force.columns, wrench.torque.columns
    if (order == np.arange(3)).all() and all(len(x) == 3 for x in columns):
        named = [str(x[i]) for x in columns for i in np.flatnonzero(signs < 0.0)]
        return Finding(
            "swapped axes",
            f"{text}: column {' and column '.join(map(repr, named))} have the wrong sign; change it"
            " in the file, or where it is written",
        )
    rows = ", ".join(f"{'-' if signs[i] < 0 else ''}{'xyz'[k]}" for i, k in enumerate(order))
    return Finding(
        "swapped axes",
        f"{text}: its x, y, z are {rows} of S; put wrench.force.columns and wrench.torque.columns"
        " into this order, and the signs right in the file",
    )


def _unit(
    wrench: Wrench, log: Log, independent: float
) -> tuple[Finding, Callable[[Description], Description]] | None:
    V = regressor(*log.motion)
    force = fit_with_offset(V[:, :3, :4], log.wrench[:, :3], independent)
    torque = fit_with_offset(V[:, 3:, 1:], log.wrench[:, 3:], independent)
    if torque is None:
        torque = fit_with_offset(V[:, 3:, 1:4], log.wrench[:, 3:], independent)
    if force is None or torque is None or force.x[0] <= _SURE * force.deviations[0]:
        return None
    found = other_units(
        wrench,
        force.x[0],
        (force.x[1:4], torque.x[:3]),
        (_norm(force.deviations[1:4]), _norm(torque.deviations[:3])),
    )
    if found is None:
        return None
    finding, units = found

    def edited(description: Description) -> Description:
        for name, unit in units.items():
            description = edit_field(description, f"wrench.{name}.unit", unit)
        return description

    return finding, edited


def _norm(x: Array) -> float:
    return float(np.linalg.norm(x))


def other_units(
    wrench: Wrench, mass: float, moments: tuple[Array, Array], deviations: tuple[float, float]
) -> tuple[Finding, dict[str, str]] | None:
    """Return the finding, and the units of force and torque that make both centres of mass equal.

    Args:
        wrench: as described.
        mass: from the force, in the described unit [kg].
        moments: m c from the force, and from the torque [kg m].
        deviations: standard deviations of their lengths.
    """
    by_force, by_torque = moments
    size = _norm(by_torque)
    if size < _SURE * deviations[1]:
        return None
    now = {"force": wrench.force.unit, "torque": wrench.torque.unit}
    found = []
    for pair in product(FORCES, TORQUES):
        right = dict(zip(now, pair, strict=True))
        seen = {name: UNITS[now[name]] / UNITS[right[name]] for name in now}
        ratio = seen["torque"] / seen["force"]
        com = size / seen["torque"] / (mass / seen["force"])
        known = ratio * deviations[0] < _KNOWN * size and _NEAREST < com < _FARTHEST
        off = _norm(by_torque - ratio * by_force) / size
        if right != now and known and off < _MATCH:
            found.append((off, ratio, {k: unit for k, unit in right.items() if unit != now[k]}))
    if not found:
        unknown = _unknown_unit(now, both=(by_force, by_torque), deviation=deviations[0])
        return None if unknown is None else (unknown, {})
    _, ratio, units = min(found, key=lambda entry: entry[0])
    lines = " and ".join(f"wrench.{name}.unit: {unit}" for name, unit in units.items())
    finding = Finding(
        "units",
        f"the centre of mass is {ratio:.4g} times as far away by the torque as by the force: they"
        f" are not in {now['torque']} and {now['force']}; set {lines}",
    )
    return finding, units


def _unknown_unit(
    now: Mapping[str, str], both: tuple[Array, Array], deviation: float
) -> Finding | None:
    by_force, by_torque = both
    size, torque = _norm(by_force), _norm(by_torque)
    if deviation > _KNOWN * size or float(np.sum(by_force * by_torque)) < _PARALLEL * size * torque:
        return None
    if 1.0 / _FAR < torque / size < _FAR:
        return None
    return Finding(
        "units",
        f"the centre of mass is {torque / size:.4g} times as far away by the torque as by the"
        f" force: they are not in {now['torque']} and {now['force']}, nor in"
        f" {' or '.join(u for u in TORQUES if u != now['torque'])}; write the columns of"
        " wrench.force and wrench.torque in units that a description knows:"
        f" {', '.join((*FORCES, *TORQUES))}",
    )
