"""Block for one direction of a network: delay, jitter, loss and order of packets."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context, DiscreteStateIndex

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.channel import network
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.packet import PACKET_LOAD_WRENCH, PACKET_SIZE
from drake_teleop.station.stepped_block import SteppedBlock


class NetworkChannel(SteppedBlock):
    """Network that transmits a vector in every period; a packet takes at least one period.

    .. pydrake_system::

        name: NetworkChannel
        input_ports:
        - packet: (N,) numbers to send
        output_ports:
        - received: (N + 1,) newest packet that has arrived, zeros before the first; 1 if it is new
        - arriving: (N + 1,) value of `received` at the next period; depends on the input

    Connect `arriving` to a block that updates at the same instants and whose output is a state.

    Args:
        size: length N of the vector.
        period: time between packets [s].
        config: network settings; default: ideal network.
        seed: seed of the random numbers.
        direction: 0 or 1; each direction has its own random numbers.

    Raises:
        DrakeTeleopError: if `config.silence` requires packets of a passivity method, and `size`
            is not the length of such a packet.
    """

    __slots__ = ()

    def __init__(
        self,
        size: int,
        period: float,
        config: NetworkConfig | None = None,
        *,
        seed: int = 0,
        direction: int = 0,
    ) -> None:
        super().__init__()
        config = NetworkConfig() if config is None else config
        if config.silence != "hold" and size not in (PACKET_LOAD_WRENCH.start, PACKET_SIZE):
            raise DrakeTeleopError(
                f"'{config.silence}' requires packets of a passivity method"
                f" ({PACKET_LOAD_WRENCH.start} or {PACKET_SIZE} numbers), but size is {size}",
                where="NetworkChannel.silence",
                remedy="set silence: hold, or use a passivity method",
            )
        self._parameters = network.network_parameters(config, seed, direction, period, min_steps=1)
        parts = network.initial_network_state(self._parameters, np.zeros(size))
        state = [*parts, np.zeros(1), np.zeros(size + 1)]
        self._packet = self.DeclareVectorInputPort("packet", size)
        self._declare_step(state, len(state), period)
        self.DeclareStateOutputPort("received", DiscreteStateIndex(self._states[-1]))
        self._declare_output("arriving", 3, slice(0, size + 1))

    def _advance(self, context: Context, results: list[Array]) -> None:
        receiver, in_transit, count, received = results
        k, line = int(count[0]), (receiver, in_transit)
        network.send_packet(self._parameters, line, k, self._packet.Eval(context))
        _, fresh = network.receive_packet(self._parameters, line, k + 1, received[:-1])
        count[0], received[-1] = k + 1, fresh
