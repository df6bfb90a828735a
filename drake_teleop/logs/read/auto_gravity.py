"""Direction of gravity for `gravity: auto`, from the weight in all orientations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.causes.candidates import part
from drake_teleop.logs.causes.explain import explain
from drake_teleop.logs.read.alignment import undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import STANDARD_GRAVITY, Description
from drake_teleop.logs.read.log_instants import log_instants

_MAX_DEVIATION_DEG = 2.0


def describe_gravity(
    description: Description, source: str, read: Callable[[Description], Log]
) -> tuple[Description, tuple[str, ...]]:
    """Replace `gravity: auto` by a vector of standard magnitude; return notes.

    Raises an error if the direction is undetermined.
    """
    start = description.model_copy(update={"gravity": tuple(description.gravity_W.tolist())})
    log, deviation = read(start), np.inf
    explanation = explain(
        log_instants(log), lambda delay_s: log_instants(undelayed(log, delay_s)), ("gravity",)
    )
    if explanation.theta[6] > 0.0:
        change, covariance = part(explanation.state, "gravity")
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
