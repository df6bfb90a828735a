"""The channel between master and slave: here a pure, constant delay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
    OutputPort,
)


def AddChannel(
    builder: DiagramBuilder,
    name: str,
    sent: OutputPort,
    delay: float,
    period: float,
    neutral: NDArray[np.float64],
) -> OutputPort:
    """Adds a channel behind the port `sent` and returns the port of what is received.

    Without delay nothing stands between sender and receiver: the port itself is returned.

    Args:
        delay: one-way delay [s], rounded to whole periods.
        period: time between packets [s].
        neutral: (k,) what the receiver gets before the first packet arrives.
    """
    packets = round(delay / period)
    if packets == 0:
        return sent
    line = builder.AddNamedSystem(name, Delay(packets, period, neutral))
    builder.Connect(sent, line.get_input_port())
    return line.get_output_port()


class Delay(LeafSystem):
    """A line on which each packet, one a period, travels for a whole number of periods.

    .. pydrake_system::

        name: Delay
        input_ports:
        - sent
        output_ports:
        - received

    Args:
        packets: how many periods a packet travels, at least 1.
        period: time between packets [s].
        neutral: (k,) what the receiver gets before the first packet arrives.
    """

    def __init__(self, packets: int, period: float, neutral: NDArray[np.float64]) -> None:
        super().__init__()
        self._packets, self._size = packets, len(neutral)
        self._sent = self.DeclareVectorInputPort("sent", self._size)
        # A packet that leaves at step k lies in slot k modulo the number of packets on the line.
        # What is received at step k left at step k - packets: one period goes by in the state.
        line = self.DeclareDiscreteState(np.tile(neutral, packets))
        head = self.DeclareDiscreteState(1)
        received = self.DeclareDiscreteState(neutral)
        self._groups = (int(line), int(head), int(received))
        self.DeclareStateOutputPort("received", received)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        line, head, received = (discrete_state.get_mutable_value(i) for i in self._groups)
        slot = int(head[0])
        following = (slot + 1) % self._packets
        line[slot * self._size : (slot + 1) * self._size] = self._sent.Eval(context)
        received[:] = line[following * self._size : (following + 1) * self._size]
        head[0] = following
