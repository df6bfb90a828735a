"""Integration steps of a station in real time while its tool bounces."""

from __future__ import annotations

import math
import weakref
from typing import Any

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

_NOTHING = EventStatus.DidNothing()
# Duration of short steps after a rejected one [s].
_STAYS_SHORT = 4e-3


def take_short_steps_in_contact(simulator: Simulator, shortest: float) -> None:
    """Bound the steps of error control from below, and keep them short after a rejection.

    A bouncing tool makes error control reject two of five steps, which takes time. It resumes 4 ms
    after a rejection.

    Args:
        simulator: of a station, whose integrator has error control.
        shortest: step of error control [s]; at most the integrator's longest.
    """
    integrator = simulator.get_mutable_integrator()
    longest = integrator.get_maximum_step_size()
    shortest = min(shortest, longest)
    integrator.set_requested_minimum_step_size(shortest)
    integrator.set_throw_on_minimum_step_size_violation(False)
    # The monitor must not keep the simulator alive.
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
