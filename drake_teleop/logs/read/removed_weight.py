"""The weight of a payload that the robot has subtracted from the wrench, added back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.causes.instants import free_delay
from drake_teleop.logs.read.alignment import resample
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.log_instants import log_instants


def weight_of(weight: NDArray[np.float64], gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 6) wrench of [m, m c] (4,) at rest in gravity (N, 3) in S, sign of Eq. (1)."""
    return np.hstack([-weight[0] * gravity, np.cross(weight[1:], -gravity)])


def restored(log: Log, weight: NDArray[np.float64], moved: Log) -> Log:
    """Add a weight back to the wrench.

    The robot's own pose, from which it has calculated the weight, belongs to the wrench's clock:
    the recorded orientation is taken at the delay of the motion behind the wrench.

    Args:
        log: the log.
        weight: (4,) [m, m c] in S [kg, kg m].
        moved: the same log with its motion and gravity.
    """
    assert moved.gravity is not None
    at = np.clip(log.t + free_delay(log_instants(moved)), moved.t[0], moved.t[-1])
    return replace(log, wrench=log.wrench + weight_of(weight, resample(at, moved.t, moved.gravity)))
