"""Gravity of a log: direction for `gravity: auto`, and restoration of a removed weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.explain import explain
from drake_teleop.logs.causes.instants import Instants, free_delay, instants
from drake_teleop.logs.read.alignment import resample, undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.description_fields import STANDARD_GRAVITY


def log_instants(log: Log) -> Instants:
    """Return block means of a log's wrench and motion."""
    gravity = None
    motion: tuple[Array, ...] = log.motion
    if log.R_WS is not None and log.gravity_W is not None:
        gravity, motion = log.gravity_W, (*log.motion, log.R_WS)
    return instants(log.t, log.wrench, motion, gravity, log.bridged)


def weight_wrench(weight: Array, gravity: Array) -> Array:
    """Return the wrench (N, 6) of a weight [m, m c] at rest, for gravity (N, 3) in S, Eq. (1)."""
    return np.hstack([-weight[0] * gravity, np.cross(weight[1:], -gravity)])


def restore_weight(log: Log, weight: Array, motion_log: Log) -> Log:
    """Return the log with the wrench of a removed weight [m, m c] (4,) in S [kg, kg m] added.

    `motion_log` is the same log with motion, from which the delay is estimated and removed.
    """
    assert motion_log.gravity is not None
    at = np.clip(log.t + free_delay(log_instants(motion_log)), motion_log.t[0], motion_log.t[-1])
    return replace(
        log,
        wrench=log.wrench + weight_wrench(weight, resample(at, motion_log.t, motion_log.gravity)),
    )


_MAX_DEVIATION_DEG = 2.0


def describe_gravity(
    description: Description, source: str, read: Callable[[Description], Log]
) -> tuple[Description, tuple[str, ...]]:
    """Return the description with an estimate for `gravity: auto`, and notes.

    Raises:
        DrakeTeleopError: if the direction is undetermined.
    """
    start = description.model_copy(update={"gravity": tuple(description.gravity_W.tolist())})
    log, deviation = read(start), np.inf
    explanation = explain(
        log_instants(log), lambda delay_s: log_instants(undelayed(log, delay_s)), ("gravity",)
    )
    if explanation.theta[6] > 0.0:
        change, covariance = explanation.state.extension("gravity")
        estimated = description.gravity_W - change
        estimated *= STANDARD_GRAVITY / np.linalg.norm(estimated)
        across = np.eye(3) - np.outer(estimated, estimated) / STANDARD_GRAVITY**2
        spread = np.linalg.eigvalsh(across @ covariance @ across)[-1]
        deviation = float(np.degrees(np.sqrt(spread) / STANDARD_GRAVITY))
    if not deviation < _MAX_DEVIATION_DEG:
        raise DrakeTeleopError(
            "the data do not determine the direction of gravity",
            where=f"{source}:gravity",
            remedy="record the load in more orientations, touching nothing; or give the vector",
        )
    gravity = tuple((np.round(estimated, 4) + 0.0).tolist())
    note = (
        f"gravity found, standard deviation {deviation:.2g} deg; write it into the description as"
        f" gravity: {list(gravity)}"
    )
    return description.model_copy(update={"gravity": gravity}), (note,)
