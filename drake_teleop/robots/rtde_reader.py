"""Child process of `rtde`: writes the samples of ur_rtde to a pipe.

ur_rtde blocks its caller, writes to stdout, and may abort the process.
"""

from __future__ import annotations

import os
import struct
import sys
import time

SAMPLE_FORMAT = struct.Struct("<16d")
"""Time of the controller [s], raw wrench (6), TCP pose (6), tool acceleration (3)."""
RTDE_VARIABLES = ("timestamp", "ft_raw_wrench", "actual_TCP_pose", "actual_tool_accelerometer")
_ROBOT_POLL_PERIOD_S, _MAX_ROBOT_SILENCE_S = 0.0002, 1.0


def write_samples_to_pipe(host: str, pipe: int) -> None:
    import rtde_receive

    robot = rtde_receive.RTDEReceiveInterface(host, -1.0, list(RTDE_VARIABLES))
    last, new = -1.0, time.monotonic()
    while robot.isConnected() and time.monotonic() - new < _MAX_ROBOT_SILENCE_S:
        t = robot.getTimestamp()
        wrench, pose = robot.getFtRawWrench(), robot.getActualTCPPose()
        acceleration = robot.getActualToolAccelerometer()
        if t == last or t != robot.getTimestamp():  # no new sample, or a mixture of two
            time.sleep(_ROBOT_POLL_PERIOD_S)
            continue
        last, new = t, time.monotonic()
        os.write(pipe, SAMPLE_FORMAT.pack(t, *wrench, *pose, *acceleration))


def main() -> None:
    try:
        write_samples_to_pipe(sys.argv[1], int(sys.argv[2]))
    finally:
        os._exit(0)  # ur_rtde takes a second to end
