"""The true contact wrench on the tool, read from the plant's contact results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, LeafSystem


def contact_wrench(results: ContactResults, tool: BodyIndex, out: NDArray[np.float64]) -> None:
    """Sums the point contacts of one body.

    Args:
        results: the plant's contact results.
        tool: the body.
        out: (6,) written: wrench of the environment on the body, [f; tau] about the world's
            origin, in W [N, N m].
    """
    out[:] = 0.0
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        if tool not in (info.bodyA_index(), info.bodyB_index()):
            continue
        # contact_force() is the force on body B.
        force = info.contact_force() if info.bodyB_index() == tool else -info.contact_force()
        out[:3] += force
        out[3:] += np.cross(info.contact_point(), force)


class ToolContact(LeafSystem):
    """The true contact wrench for the log; no controller sees it.

    .. pydrake_system::

        name: ToolContact
        input_ports:
        - contact_results
        output_ports:
        - true_contact_wrench_W: on the tool, [f; tau] about the world's origin, in W
    """

    def __init__(self, tool: BodyIndex) -> None:
        super().__init__()
        self._tool = tool
        self._results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self.DeclareVectorOutputPort("true_contact_wrench_W", 6, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        contact_wrench(self._results.Eval(context), self._tool, output.get_mutable_value())
