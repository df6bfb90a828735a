"""IMU compared with the motion of the pose."""

from __future__ import annotations

import numpy as np

from drake_teleop.logs.check.edits import Edit, edit_field, pose_edits, tried
from drake_teleop.logs.check.finding import CLOCK, Finding
from drake_teleop.logs.check.load_fit import BELIEVABLE, DECISIVE, EXPLAINED
from drake_teleop.logs.check.log_data import LogData
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.mounting import Mounting, find_mounting


def against_pose(
    description: Description, data: LogData
) -> tuple[list[Finding], Mounting | None, Description]:
    """Return findings about the IMU, its mounting, and the corrected description."""

    def mounting(edited: Description) -> Mounting | None:
        pose_alone = edited.model_copy(update={"imu": None})
        return find_mounting(data.thin(edited), data.thin(pose_alone))

    given = mounting(description)
    if given is None:
        return [], None, description
    findings: list[Finding] = []
    if given.unexplained > EXPLAINED or given.mirrored or given.angle_deg > 10:
        better = [
            (found.unexplained, finding, edited, found)
            for finding, edited in pose_edits(description)
            if (found := tried(mounting, edited)) and not found.mirrored
        ]
        limit = min(BELIEVABLE, given.unexplained / DECISIVE)
        if given.mirrored:
            better = [entry for entry in better if entry[3].angle_deg < 10]
        elif given.angle_deg > 10 and given.unexplained < BELIEVABLE:
            # In a rotation about one axis an inverted orientation resembles a rotated IMU. An edit
            # that keeps the described mounting is the simpler explanation.
            better = [entry for entry in better if entry[3].angle_deg < 10]
            limit = min(BELIEVABLE, 1.5 * given.unexplained + 1e-4)
        best = min(better, key=lambda entry: entry[0], default=None)
        if best and best[0] < limit:
            findings.append(best[1])
            description, given = best[2], best[3]
    if given.unexplained > BELIEVABLE and not given.mirrored:
        return findings, given, description
    if abs(given.lag_s) > CLOCK or given.drift:
        finding, description = _imu_clock(description, given, data)
        findings.append(finding)
    if given.speed_ratio is not None and 40 < given.speed_ratio < 80:
        findings.append(
            Finding(
                "degrees",
                f"the gyroscope reads {given.speed_ratio:.3g} times the speed of the pose;"
                " set imu.angular_velocity.unit: deg/s",
            )
        )
        description = edit_field(description, "imu.angular_velocity.unit", "deg/s")
    if given.mirrored:
        findings.append(
            Finding(
                "swapped axes",
                "the axes of the IMU are those of the pose mirrored: two columns are exchanged or"
                " one has the wrong sign; correct imu.specific_force.columns",
            )
        )
    elif given.angle_deg > 10:
        assert description.imu is not None
        old = np.eye(3)
        if isinstance(description.imu.frame, tuple):
            old = np.array(description.imu.frame)
        frame = np.array(given.right_angled if given.is_right_angled else given.R_SI) @ old
        shown = np.round(frame, 4).tolist()
        kind = "swapped axes" if given.is_right_angled else "mounting"
        findings.append(
            Finding(
                kind,
                f"the IMU is turned by {given.angle_deg:.0f} deg against S; set imu.frame: {shown}"
                + ("" if given.is_right_angled else " (not a right-angled mounting)"),
            )
        )
        description = edit_field(description, "imu.frame", tuple(map(tuple, frame.tolist())))
    return findings, given, description


def _imu_clock(description: Description, found: Mounting, data: LogData) -> Edit:
    assert description.imu is not None and description.wrench is not None
    time = description.imu.time
    if not found.drift:
        offset = time.offset - found.lag_s
        finding = Finding(
            "clock",
            f"the clock of the IMU lags that of the pose by {found.lag_s:.3f} s;"
            f" set imu.time.offset: {offset:.3f}",
        )
        return finding, edit_field(description, "imu.time.offset", offset)
    start = data.start(description.imu, description) - data.start(description.wrench, description)
    scale = 1 / (1 + found.drift)
    lag = scale * (found.lag_middle_s + found.drift * (start - found.middle_s))
    offset, factor = time.offset - lag, scale * time.scale
    finding = Finding(
        "clock",
        f"the clock of the IMU lags that of the pose by {lag:.3f} s at its first row and by"
        f" {1e3 * found.drift:.3g} ms more each second ({found.lag_s:.3f} s is the best constant);"
        f" set imu.time.offset: {offset:.3f} and imu.time.scale: {factor:.6f}",
    )
    edited = edit_field(description, "imu.time.offset", offset)
    return finding, edit_field(edited, "imu.time.scale", factor)
