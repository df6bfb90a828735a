"""The child process of `rtde`: ur_rtde's samples into a pipe, for as long as a connection lasts.

In a process of its own because ur_rtde holds its caller up where it connects or ends, writes to
stdout, and may end the process if a robot answers what it does not expect. The loop says meanwhile
that nothing comes, and starts it anew. It imports nothing else.
"""

from __future__ import annotations

import os
import struct
import sys
import time

SAMPLE = struct.Struct("<16d")
"""Time of the controller [s]; raw wrench; pose of the TCP; acceleration that its tool measures."""
VARIABLES = ("timestamp", "ft_raw_wrench", "actual_TCP_pose", "actual_tool_accelerometer")
_POLL_S, _STILL_S = 0.0002, 1.0


def read(host: str, pipe: int) -> None:
    """Writes samples until the robot is gone, or says nothing new.

    Raises:
        RuntimeError: if nobody is there.
        BrokenPipeError: if nobody reads.
    """
    import rtde_receive

    robot = rtde_receive.RTDEReceiveInterface(host, -1.0, list(VARIABLES))
    last, new = -1.0, time.monotonic()
    while robot.isConnected() and time.monotonic() - new < _STILL_S:
        t = robot.getTimestamp()
        wrench, pose = robot.getFtRawWrench(), robot.getActualTCPPose()
        acceleration = robot.getActualToolAccelerometer()
        if t == last or t != robot.getTimestamp():  # nothing new, or of two samples
            time.sleep(_POLL_S)
            continue
        last, new = t, time.monotonic()
        os.write(pipe, SAMPLE.pack(t, *wrench, *pose, *acceleration))


def main() -> None:
    """HOST, and the number of the pipe."""
    try:
        read(sys.argv[1], int(sys.argv[2]))
    finally:
        os._exit(0)  # ur_rtde takes a second to end
