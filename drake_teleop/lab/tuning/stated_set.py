"""Set of hands, walls and network for which a station is tuned."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError, suggest_name
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import PRESETS
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig
from drake_teleop.station.scenario import Scenario, replace

_MIN_WALL_N_M, _MAX_WALL_N_M = 100.0, 60e3  # N/m, range of the leaf's model
_NUM_TESTED_WALLS = 4  # from the softest to the stiffest
_MAX_STEP_S = 2e-3  # longer than the events' period; else tiny steps precede the events


@dataclass(frozen=True)
class TaskRequirements:
    """Requirements of a task.

    Args:
        loop_gain_margin: factor of the loop gain that must still be stable.
        min_low_pass_hz: lowest bandwidth of the sensor; a lower one delays the contact force.
    """

    loop_gain_margin: float
    min_low_pass_hz: float


REQUIREMENTS_OF_TASK = {
    "press": TaskRequirements(1.1, 50.0),
    "touch": TaskRequirements(1.1, 100.0),
    "insert": TaskRequirements(1.5, 50.0),
}
"""Tasks by name. A peg jams between two walls, which doubles the stiffness: a larger margin."""


@dataclass(frozen=True)
class StatedSet:
    """Hands, walls and task for which the settings must hold.

    Args:
        hands: names of all grips from the softest to the firmest.
        walls: lowest and highest stiffness [N/m].
        task: key of `REQUIREMENTS_OF_TASK`.
    """

    hands: tuple[str, ...]
    walls: tuple[float, float]
    task: str

    @property
    def corners(self) -> list[tuple[str, float]]:
        """Softest and firmest grip at the softest and stiffest wall; the stiffest wall first."""
        hands = dict.fromkeys((self.hands[0], self.hands[-1]))
        return [(hand, wall) for wall in self.walls[::-1] for hand in hands]

    @property
    def tested_parts(self) -> list[tuple[float, list[str], list[float]]]:
        """Factor of gamma, grips and walls of each part of the tests; each has its own seed.

        The softest grip fails first: it is tested twice. The last part has no margin.
        """
        low, high = self.walls
        margin, hands = self.requirements.loop_gain_margin, list(self.hands)
        walls = np.geomspace(high, low, _NUM_TESTED_WALLS if low < high else 1).tolist()
        parts = [(margin, part, walls) for part in (hands[:1], hands[:1], hands[1:]) if part]
        return [*parts, (1.0, [*dict.fromkeys((hands[0], hands[-1]))], [high])]

    @property
    def requirements(self) -> TaskRequirements:
        return REQUIREMENTS_OF_TASK[self.task]


def make_stated_set(hands: Sequence[str], walls: Sequence[float], task: str) -> StatedSet:
    """Return the set of these grips, walls [kN/m] and this task."""
    for what, names, known in (
        ("hands", hands, tuple(GRIP_IMPEDANCES)),
        ("task", (task,), tuple(REQUIREMENTS_OF_TASK)),
    ):
        for name in names:
            if name not in known:
                remedy = suggest_name(name, known, f"choose among {', '.join(known)}")
                raise DrakeTeleopError(f"'{name}' is unknown", where=what, remedy=remedy)
    if not hands:
        raise DrakeTeleopError("no grip is given", where="hands", remedy="give light, for instance")
    if not walls:
        remedy = "give kN/m, such as 0.5,20"
        raise DrakeTeleopError("no wall stiffness is given", where="walls", remedy=remedy)
    for wall in walls:
        if not _MIN_WALL_N_M <= 1e3 * wall <= _MAX_WALL_N_M:
            limits = f"{_MIN_WALL_N_M / 1e3:g} to {_MAX_WALL_N_M / 1e3:g} kN/m"
            what = f"{wall:g} kN/m is outside {limits}"
            raise DrakeTeleopError(what, where="walls", remedy="give stiffnesses in kN/m")
    grips = list(GRIP_IMPEDANCES)
    places = sorted(map(grips.index, hands))
    between = tuple(grips[places[0] : places[-1] + 1])
    return StatedSet(between, (1e3 * min(walls), 1e3 * max(walls)), task)


def without_task_and_method(scenario: Scenario, network: str | None) -> Scenario:
    """Return the scenario with sigma 0, without environment, task and method.

    `network` is a preset; None keeps the scenario's network.
    """
    if network is not None and network not in PRESETS:
        remedy = suggest_name(network, tuple(PRESETS), f"choose among {', '.join(PRESETS)}")
        raise DrakeTeleopError(f"'{network}' is unknown", where="network", remedy=remedy)
    if network is not None:
        scenario = replace(scenario, channel=Channel(network=network))
    if scenario.has_no_network_or_passivity:
        what = "the scenario has neither network nor passivity method"
        what += ", which the energy balances of the runs need"
        remedy = f"choose among {', '.join(name for name in PRESETS if name != 'ideal')}"
        raise DrakeTeleopError(what, where="network", remedy=remedy)
    force_scale = scenario.force_scaling.force_scale
    simulation = dataclasses.replace(scenario.simulation, max_step=_MAX_STEP_S, end_with_task=False)
    return replace(
        scenario.without_environment(),
        simulation=simulation,
        passivity=PassivityConfig(),
        force_scaling=ForceScalingConfig(sigma=0.0, force_scale=force_scale),
        contact_detection=None,
        operator__intent=[],
        operator__task=None,
    )
