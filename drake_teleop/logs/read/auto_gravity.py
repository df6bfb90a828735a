"""What `gravity: auto` stands for: the direction of gravity, from the weight in all poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.causes.explain import explain
from drake_teleop.logs.read.alignment import undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import STANDARD_GRAVITY, Description
from drake_teleop.logs.read.log_instants import log_instants

_LEAST_KNOWN_DEG = 2.0


def describe_gravity(
    description: Description, source: str, read: Callable[[Description], Log]
) -> tuple[Description, tuple[str, ...]]:
    """Replace `gravity: auto` by a vector of standard magnitude.

    Args:
        description: with `gravity: auto`.
        source: its file, for messages.
        read: reads a log as it is described.

    Returns:
        the description, and a note with the line to write.

    Raises:
        DrakeTeleopError: if the data do not determine the direction.
    """
    start = description.model_copy(update={"gravity": tuple(description.gravity_W.tolist())})
    log, deviation = read(start), np.inf
    why = explain(log_instants(log), lambda late: log_instants(undelayed(log, late)), ("gravity",))
    if why.theta[6] > 0.0:
        change, covariance = why.state.extension("gravity")
        true = description.gravity_W - change
        true *= STANDARD_GRAVITY / np.linalg.norm(true)
        across = np.eye(3) - np.outer(true, true) / STANDARD_GRAVITY**2
        spread = np.linalg.eigvalsh(across @ covariance @ across)[-1]
        deviation = float(np.degrees(np.sqrt(spread) / STANDARD_GRAVITY))
    if not deviation < _LEAST_KNOWN_DEG:
        raise DrakeTeleopError(
            "the data do not determine the direction of gravity",
            where=f"{source}:gravity",
            remedy="record the load in more orientations, touching nothing; or give the vector",
        )
    gravity = tuple((np.round(true, 4) + 0.0).tolist())
    note = (
        f"gravity found, standard deviation {deviation:.2g} deg; write it into the description as"
        f" gravity: {list(gravity)}"
    )
    return description.model_copy(update={"gravity": gravity}), (note,)
