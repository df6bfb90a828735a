"""The channel: a pure delay of whole packets."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from drake_teleop.channel.delay import AddChannel

PERIOD = 1e-3


class Clock(LeafSystem):
    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorOutputPort("t", 2, self._calc)

    def _calc(self, context, output: BasicVector) -> None:
        output.SetFromVector([context.get_time(), 1.0])


@pytest.mark.parametrize("packets", [0, 1, 2, 37])
def test_what_is_received_was_sent_so_many_packets_ago(packets):
    builder = DiagramBuilder()
    clock = builder.AddSystem(Clock())
    neutral = np.array([-1.0, 0.0])
    received = AddChannel(
        builder, "channel", clock.get_output_port(), packets * PERIOD, PERIOD, neutral
    )
    log = LogVectorOutput(received, builder, PERIOD)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.1)
    record = log.FindLog(simulator.get_context())
    t, (sent, mark) = record.sample_times(), record.data()
    arrived = t > packets * PERIOD - 0.5 * PERIOD
    np.testing.assert_allclose(sent[arrived], t[arrived] - packets * PERIOD, atol=1e-9)
    np.testing.assert_array_equal(mark[arrived], 1.0)
    np.testing.assert_array_equal(sent[~arrived], -1.0)
    assert (~arrived).sum() == packets
