"""Weight of a payload that the robot has subtracted from the wrench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.causes.delay import free_delay
from drake_teleop.logs.read.alignment import resample
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.log_instants import log_instants


def weight_wrench(weight: NDArray[np.float64], gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N, 6) wrench of [m, m c] at rest in gravity (N, 3) in S, Eq. (1)."""
    return np.hstack([-weight[0] * gravity, np.cross(weight[1:], -gravity)])


def restore_weight(log: Log, weight: NDArray[np.float64], motion_log: Log) -> Log:
    """Return the log with the weight of [m, m c] (4,) in S [kg, kg m] added to its wrench.

    The robot's own pose has the wrench's clock, so the orientation in `motion_log`, the same log
    with motion, is evaluated at the delay.
    """
    assert motion_log.gravity is not None
    at = np.clip(log.t + free_delay(log_instants(motion_log)), motion_log.t[0], motion_log.t[-1])
    return replace(
        log,
        wrench=log.wrench + weight_wrench(weight, resample(at, motion_log.t, motion_log.gravity)),
    )
