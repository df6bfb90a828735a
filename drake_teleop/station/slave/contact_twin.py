"""Drake's contact in any state: the slave's plant and what there is to touch, once more."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.station.environment.environment import Environment
from drake_teleop.station.slave.drake_contact import contact_wrench_W
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave

Array = NDArray[np.float64]


class ContactTwin:
    """A plant of its own, which nothing moves.

    The simulated plant is in one state; the wrist sensor wants contact at instants between.

    Args:
        config: which slave.
        environment: what there is to touch.
        q_start: (n,) joint positions [rad].
    """

    def __init__(self, config: Slave, environment: Environment | None, q_start: Array) -> None:
        builder = DiagramBuilder()
        self._slave = AddSlavePlant(builder, config, environment, q_start)
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = self._slave.plant.GetMyMutableContextFromRoot(self._root)

    def wrench_W(self, x: Array, state: Array) -> Array:
        """(6,) what contacts exert on the tool, about the world's origin, in W.

        Args:
            x: [q, a leaf's deflection, v, its rate] of arm and leaf.
            state: [q; v] of the plant, for everything else that moves; empty if nothing does.
        """
        plant, context, contact = self._slave.plant, self._context, self._slave.contact
        half = len(x) // 2
        if len(state):
            plant.SetPositionsAndVelocities(context, state)
        arm, leaf = (self._slave.instance, slice(half - 1)), (contact.sheet, slice(half - 1, half))
        for instance, own in (arm, leaf):
            if instance is not None:
                plant.SetPositions(context, instance, x[:half][own])
                plant.SetVelocities(context, instance, x[half:][own])
        results = plant.get_contact_results_output_port().Eval(context)
        return contact_wrench_W(results, contact.bodies, contact.shapes)
