"""Steps of a station that has to be in time while its tool bounces."""

from __future__ import annotations

import math
import weakref
from typing import Any

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

_NOTHING = EventStatus.DidNothing()
# s: for so long after a step that was too long, all are short.
_STAYS_SHORT = 4e-3


def take_short_steps_in_contact(simulator: Simulator, shortest: float) -> None:
    """Lets error control ask for no shorter steps, and not ask again for a while where it did.

    A step that error control rejects takes time and leads nowhere; where a tool bounces that would
    be two of five. After one all steps are the shortest that it may ask for, and 4 ms later it is
    asked again.

    Args:
        simulator: of a station, with an integrator that has error control.
        shortest: step that error control may ask for [s]; the integrator's longest if that is
            shorter.
    """
    integrator = simulator.get_mutable_integrator()
    longest = integrator.get_maximum_step_size()
    shortest = min(shortest, longest)
    integrator.set_requested_minimum_step_size(shortest)
    integrator.set_throw_on_minimum_step_size_violation(False)
    # What the simulator calls must not keep it alive.
    station: Any = weakref.ref(simulator)
    rejected, until = 0, math.inf

    def after_step(context: Context) -> EventStatus:
        nonlocal rejected, until
        integrator = station().get_mutable_integrator()
        number = integrator.get_num_step_shrinkages_from_error_control()
        if number != rejected:
            rejected, until = number, context.get_time() + _STAYS_SHORT
            integrator.set_maximum_step_size(shortest)
            integrator.set_fixed_step_mode(True)
        elif context.get_time() >= until:
            until = math.inf
            integrator.set_maximum_step_size(longest)
            integrator.set_fixed_step_mode(False)
        return _NOTHING

    simulator.set_monitor(after_step)
