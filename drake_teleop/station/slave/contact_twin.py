"""Drake's contact wrench in any state, from a second plant."""

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
    """Second copy of the plant, for contact between the states of the simulated one."""

    def __init__(self, config: Slave, environment: Environment | None, q_start: Array) -> None:
        builder = DiagramBuilder()
        self._slave = AddSlavePlant(builder, config, environment, q_start)
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = self._slave.plant.GetMyMutableContextFromRoot(self._root)

    def wrench_W(self, x: Array, state: Array) -> Array:
        """Return the contact wrench (6,) on the tool, about the world's origin, in W.

        x is [q, leaf deflection, v, its rate]; `state` is the plant's [q; v], empty without other
        moving bodies.
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
