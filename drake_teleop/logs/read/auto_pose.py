"""Estimates for `pose.position_in_sensor: auto` and `pose.rotation_in_sensor: auto`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description


def describe_pose_frame(
    description: Description, source: str, read: Callable[[Description], Log]
) -> tuple[Description, tuple[str, ...]]:
    """Replace `auto` in the pose frame by estimates from the wrench; return notes.

    Raises an error if the data do not determine a value.
    """
    from drake_teleop.logs.pose_motion.estimate import estimate_from_poses

    pose = description.pose
    assert pose is not None
    plain = {"position_in_sensor": (0.0, 0.0, 0.0), "rotation_in_sensor": None, "frame": "sensor"}
    alone = {"imu": None, "pose": pose.model_copy(update=plain)}
    log = read(description.model_copy(update=alone))
    assert log.posed is not None
    found = estimate_from_poses(
        log.t,
        log.wrench,
        log.posed.poses,
        log.posed.gravity_W,
        p_SoPo_S=None,
        R_SP=None,
        lost=log.bridged,
    )
    frame = found.frame
    changes: dict[str, Any] = {}
    notes: list[str] = []
    if pose.position_in_sensor == "auto":
        _require_determined(
            frame.position_known, f"{source}:pose.position_in_sensor", "the pose's origin along"
        )
        changes["position_in_sensor"] = tuple(frame.p_SoPo_S.tolist())
        deviation = 1e3 * float(frame.position_deviations.max())
        notes.append(_result_note("position_in_sensor", frame.p_SoPo_S, f"{deviation:.2g} mm"))
    if pose.rotation_in_sensor == "auto":
        _require_determined(
            frame.rotation_known, f"{source}:pose.rotation_in_sensor", "the pose's turn about"
        )
        changes["rotation_in_sensor"] = tuple(map(tuple, frame.R_SP.tolist()))
        deviation = float(frame.turn_deviations_deg.max())
        notes.append(_result_note("rotation_in_sensor", frame.R_SP, f"{deviation:.2g} deg"))
    return description.model_copy(update={"pose": pose.model_copy(update=changes)}), tuple(notes)


def _require_determined(known: Any, where: str, quantity: str) -> None:
    if not known.all():
        axes = ", ".join(a for a, deviation in zip("xyz", known, strict=True) if not deviation)
        raise DrakeTeleopError(
            f"the data do not determine {quantity} {axes}",
            where=where,
            remedy="turn the sensor faster, about more axes, touching nothing; or give it",
        )


def _result_note(name: str, value: Any, deviation: str) -> str:
    written = (np.round(value, 4) + 0.0).tolist()
    return (
        f"pose.{name} found, standard deviation {deviation}; write it into the description as"
        f" pose.{name}: {written}"
    )
