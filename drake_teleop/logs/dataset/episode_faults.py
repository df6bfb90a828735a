"""Names and descriptions of the faults of an episode's wrench."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.dataset.episode_verdict import WrenchHypothesis
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS
from drake_teleop.logs.read.description_fields import FORCE_UNITS, SI_VALUE_OF_UNIT, TORQUE_UNITS

_SI_AND_OTHER_UNITS_OF_QUANTITIES = (
    ("force", "N", set(FORCE_UNITS) - {"N"}),
    ("torque", "N m", set(TORQUE_UNITS) - {"N m", "N mm"}),  # N mm equals mN m
)
_UNIT_FACTOR_TOLERANCE, _MIN_UNIT_FACTOR_ERROR = 0.04, 0.06
_MIN_WRENCH_ROTATION_DEG, _MIN_UNUSUAL_LAG_FRAMES, _MIN_SATURATED_FRAMES = 4.0, 0.6, 4


class EpisodeFault(NamedTuple):
    """Fault of an episode: name, text and value."""

    name: str
    message: str
    value: Any


def list_faults(
    hypothesis: WrenchHypothesis, usual_lag: float, usual_phi: Array, fps: float
) -> list[EpisodeFault]:
    """Return the faults of an episode that a hypothesis about its wrench implies.

    `usual_lag` [frames] is that of other episodes, `usual_phi` (10,) the usual load.
    """
    if hypothesis.phi is not None:
        mass = float(hypothesis.phi[0])
        text = f"the load is another one: {mass:.3g} kg instead of {usual_phi[0]:.3g} kg"
        return [EpisodeFault("tool changed", text, hypothesis.phi.tolist())]
    found = []
    if hypothesis.kind == "base":
        found.append(EpisodeFault("frame", "the wrench is in the axes of the base", "base"))
    if hypothesis.kind == "weight removed":
        text = "the robot has already removed the load's weight from the wrench"
        found.append(EpisodeFault("weight removed", text, None))
    same = np.allclose(*hypothesis.axes)
    found += _rotation_faults(hypothesis.axes[0], "the wrench" if same else "the force")
    found += [] if same else _rotation_faults(hypothesis.axes[1], "the torque")
    found += _unit_faults(hypothesis.gains)
    late = hypothesis.lag - usual_lag
    if abs(late) >= _MIN_UNUSUAL_LAG_FRAMES:
        side = "behind" if late > 0 else "ahead of"
        text = f"the motion is {abs(late):.1f} frames ({abs(late) / fps:.3f} s) {side} the wrench"
        found.append(EpisodeFault("lag", f"{text}, compared with the other episodes", late))
    return found


def _rotation_faults(M: Array, what: str) -> list[EpisodeFault]:
    from scipy.spatial.transform import Rotation

    single = np.flatnonzero(np.diag(M) < 0)
    if np.allclose(np.abs(M), np.eye(3)) and len(single) == 1:
        text = f"axis {'xyz'[single[0]]} of {what} is reversed"
        return [EpisodeFault("sign", text, np.diag(M).tolist())]
    found = []
    if np.linalg.det(M) < 0:
        found.append(EpisodeFault("sign", f"{what} is negated", -1))
        M = -M
    turn = Rotation.from_matrix(M).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(turn))
    if angle > _MIN_WRENCH_ROTATION_DEG:
        axis = ", ".join(f"{a:.2g}" for a in turn / angle)
        text = f"{what} is rotated by {angle:.3g} deg about [{axis}] of S"
        found.append(EpisodeFault("frame", text, M.tolist()))
    return found


def _unit_faults(gains: Array) -> list[EpisodeFault]:
    found = []
    for factor, (what, si, names) in zip(gains, _SI_AND_OTHER_UNITS_OF_QUANTITIES, strict=True):
        if abs(factor - 1.0) < _MIN_UNIT_FACTOR_ERROR:
            continue
        unit = min(names, key=lambda name: abs(np.log(factor * SI_VALUE_OF_UNIT[name])))
        near = abs(factor * SI_VALUE_OF_UNIT[unit] - 1.0) < _UNIT_FACTOR_TOLERANCE
        text = f"the {what} is {factor:.4g} times the value in {si}"
        found.append(EpisodeFault("unit", text + (f": its unit is {unit}" if near else ""), factor))
    return found


def saturation_faults(wrench: Array) -> list[EpisodeFault]:
    """Return a fault for wrench channels (N, 6) that are constant or stay at a range end, or []."""
    names = []
    for name, x in zip(WRENCH_COLUMNS, wrench.T, strict=True):
        if x.min() == x.max():
            return [EpisodeFault("dead channel", f"{name} is constant at {x[0]:.4g}", name)]
        starts = np.flatnonzero(np.diff(x, prepend=np.nan))
        lengths, values = np.diff(starts, append=len(x)), x[starts]
        ends = (values == x.max()) | (values == x.min())
        longest = int(lengths[ends].max())
        if longest >= max(_MIN_SATURATED_FRAMES, 2 * int(lengths[~ends].max(initial=0))):
            names.append(f"{name} for {longest} frames")
    if not names:
        return []
    text = f"channels stay at the end of their range: {', '.join(names)}"
    return [EpisodeFault("saturated", text, names)]
