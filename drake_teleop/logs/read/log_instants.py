"""Block means of a log."""

from __future__ import annotations

from drake_teleop.common.arrays import Array
from drake_teleop.logs.causes.instants import Instants, instants
from drake_teleop.logs.read.canonical import Log


def log_instants(log: Log) -> Instants:
    """Return block means of wrench and motion."""
    gravity = None
    motion: tuple[Array, ...] = log.motion
    if log.R_WS is not None and log.gravity_W is not None:
        gravity, motion = log.gravity_W, (*log.motion, log.R_WS)
    return instants(log.t, log.wrench, motion, gravity, log.bridged)
