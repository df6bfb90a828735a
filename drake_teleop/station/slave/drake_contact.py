"""Contact wrench on the tool from Drake's contact results, for all shapes and contact models."""

from __future__ import annotations

from collections.abc import Container

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from drake_teleop.common.blocks import ONE_DICT, weak_callback
from drake_teleop.common.numeric import Array
from drake_teleop.station.environment.environment import Environment
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.plant_dynamics import add_force_to_wrench
from drake_teleop.station.slave.slave_config import Slave


def contact_wrench_W(
    results: ContactResults, bodies: Container[int], shapes: Container[int]
) -> Array:
    """Return the wrench (6,) of all contacts on the tool, about the world's origin, in W [N, N m].

    `bodies`: indices of the tool's bodies; `shapes`: identifiers of its collision shapes.
    """
    wrench_W = np.zeros(6)
    for k in range(results.num_point_pair_contacts()):
        contact = results.point_pair_contact_info(k)
        if int(contact.bodyB_index()) in bodies:  # the contact force acts on B
            add_force_to_wrench(wrench_W, contact.contact_point(), contact.contact_force())
        elif int(contact.bodyA_index()) in bodies:
            add_force_to_wrench(wrench_W, contact.contact_point(), -contact.contact_force())
    for k in range(results.num_hydroelastic_contacts()):
        area = results.hydroelastic_contact_info(k)
        surface, F_Ac_W = area.contact_surface(), area.F_Ac_W()  # acts on the body of M
        first, second = surface.id_M().get_value(), surface.id_N().get_value()
        sign = float(first in shapes) - float(second in shapes)
        if sign != 0.0:
            add_force_to_wrench(wrench_W, surface.centroid(), sign * F_Ac_W.translational())
            wrench_W[3:] += sign * F_Ac_W.rotational()
    return wrench_W


class DrakeContact(LeafSystem):
    """Block that outputs the contact wrench on the tool from the plant's contact results."""

    __slots__ = ONE_DICT

    def __init__(self, bodies: Container[int], shapes: Container[int]) -> None:
        super().__init__()
        self._tool_ids = bodies, shapes
        results = Value[ContactResults]()
        self._contacts = self.DeclareAbstractInputPort("contact_results", results)
        self.DeclareVectorOutputPort("true_contact_wrench_W", 6, weak_callback(self._calc_wrench))

    def _calc_wrench(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(contact_wrench_W(self._contacts.Eval(context), *self._tool_ids))


class ContactPlantCopy:
    """Copy of the slave's plant that computes contact at any state, beside the simulated plant."""

    def __init__(self, config: Slave, environment: Environment | None, q_start: Array) -> None:
        builder = DiagramBuilder()
        self._slave = AddSlavePlant(builder, config, environment, q_start)
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = self._slave.plant.GetMyMutableContextFromRoot(self._root)

    def wrench_W(self, x: Array, state: Array) -> Array:
        """Return the contact wrench (6,) on the tool, about the world's origin, in W.

        x is [q, leaf deflection, v, deflection rate]; `state` is the plant's [q; v], empty without
        other moving bodies.
        """
        plant, context, contact = self._slave.plant, self._context, self._slave.contact
        half = len(x) // 2
        if len(state):
            plant.SetPositionsAndVelocities(context, state)
        leaf = contact.leaf_instance, slice(half - 1, half)
        for instance, own in ((self._slave.instance, slice(half - 1)), leaf):
            if instance is not None:
                plant.SetPositions(context, instance, x[:half][own])
                plant.SetVelocities(context, instance, x[half:][own])
        results = plant.get_contact_results_output_port().Eval(context)
        return contact_wrench_W(results, contact.tool_bodies, contact.tool_shapes)
