"""The channel between master and slave: here a pure, constant delay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem


class DelayChannel(LeafSystem):
    """A line of packets, one a period; with no delay it passes its input straight through.

    .. pydrake_system::

        name: DelayChannel
        input_ports:
        - sent
        output_ports:
        - received

    Args:
        delay: one-way delay [s], rounded to whole periods.
        period: time between packets [s].
        neutral: (k,) what the receiver gets before the first packet arrives.
    """

    def __init__(self, delay: float, period: float, neutral: NDArray[np.float64]) -> None:
        super().__init__()
        size = len(neutral)
        self._packets = round(delay / period)
        self._sent = self.DeclareVectorInputPort("sent", size)
        if self._packets == 0:
            self.DeclareVectorOutputPort("received", size, self._pass_through)
            return
        self._size = size
        # A packet that leaves at step k lies in slot k modulo the number of packets on the line.
        line = self.DeclareDiscreteState(np.tile(neutral, self._packets))
        head = self.DeclareDiscreteState(1)
        received = self.DeclareDiscreteState(neutral)
        self._groups = (int(line), int(head), int(received))
        self.DeclareStateOutputPort("received", received)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _pass_through(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._sent.Eval(context))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        line, head, received = (discrete_state.get_mutable_value(i) for i in self._groups)
        slot = int(head[0])
        packet = slice(slot * self._size, (slot + 1) * self._size)
        received[:] = line[packet]
        line[packet] = self._sent.Eval(context)
        head[0] = (slot + 1) % self._packets
