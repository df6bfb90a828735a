"""Blocks of the channel: a network, and the passivity method at its master's and slave's end."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, DiscreteStateIndex

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array
from drake_teleop.station.channel import channel as steps
from drake_teleop.station.channel import network
from drake_teleop.station.channel.channel import MIN_TIMEOUT_S, NUM_PORTS_VALUES
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity import methods
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.passivity.packet import PACKET_LOAD_WRENCH, PACKET_SIZE
from drake_teleop.station.stepped_block import SteppedBlock

_OPTIONAL_INPUT_PORT_NAMES = ("hand_wrench_E", "load_wrench_B", "saturated", "contact")


class NetworkChannel(SteppedBlock):
    """Network that sends one vector per period; a packet takes at least one period.

    .. pydrake_system::

        name: NetworkChannel
        input_ports:
        - packet: (N,) numbers to send
        output_ports:
        - received: (N + 1,) newest packet that has arrived, zeros before the first; 1 if it is new
        - arriving: (N + 1,) as `received`, one period earlier; direct feedthrough

    Connect `arriving` to a block with the same period and without direct feedthrough.

    Args:
        size: length N of the vector.
        period: time between packets [s].
        config: network settings; default: ideal network.
        seed: seed of the random numbers.
        direction: 0 or 1; each direction has its own random numbers.

    Raises:
        DrakeTeleopError: if `config.silence` is not "hold" and `size` is not the packet size of a
            passivity method.
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
            sizes = f"{PACKET_LOAD_WRENCH.start} or {PACKET_SIZE} numbers"
            what = f"'{config.silence}' requires packets of a passivity method ({sizes}), but size"
            what, remedy = f"{what} is {size}", "set silence: hold, or use a passivity method"
            raise DrakeTeleopError(what, where="NetworkChannel.silence", remedy=remedy)
        self._parameters = network.network_parameters(config, seed, direction, period, min_steps=1)
        parts = network.initial_network_state(self._parameters, np.zeros(size))
        state = [*parts, np.zeros(1), np.zeros(size + 1)]
        self._packet = self.DeclareVectorInputPort("packet", size)
        self._declare_step(state, len(state), period)
        self.DeclareStateOutputPort("received", DiscreteStateIndex(self._states[-1]))
        self._declare_output("arriving", 3, slice(0, size + 1))

    def _advance_states_and_outputs(self, context: Context, results: list[Array]) -> None:
        receiver, in_transit, count, received = results
        k, line = int(count[0]), (receiver, in_transit)
        network.send_packet(self._parameters, line, k, self._packet.Eval(context))
        _, fresh = network.receive_packet(self._parameters, line, k + 1, received[:-1])
        count[0], received[-1] = k + 1, fresh


class _PassivityEndBlock(SteppedBlock):
    __slots__ = ()

    def __init__(
        self,
        passivity: PassivityConfig,
        period: float,
        start: ArrayLike,
        *,
        R_WB: ArrayLike | None = None,
        scales: ArrayLike = (1.0, 1.0),
        force_scale: float = 1.0,
        timeout: float = MIN_TIMEOUT_S,
    ) -> None:
        super().__init__()
        start, scales = finite_array("start", start, 7), finite_array("scales", scales, 2)
        R = np.eye(3) if R_WB is None else finite_array("R_WB", R_WB, 3, 3)
        parameters, mapping = steps.pack_parameters_and_mapping(passivity, R, scales, force_scale)
        self._method = methods.step_addresses(passivity.method)
        self._constants = period, timeout, mapping, parameters
        ends = steps.initial_state_of_master_and_slave_ends(passivity.method, parameters, start)
        # Ends, command, port energies, rendered wrench and contact flag, packet.
        results = [ends, start, np.zeros(NUM_PORTS_VALUES), np.zeros(7), np.zeros(PACKET_SIZE)]
        self._received = self.DeclareVectorInputPort("received", PACKET_SIZE + 1)
        self._ports = [
            (self.DeclareVectorInputPort(name, size), name in _OPTIONAL_INPUT_PORT_NAMES)
            for name, size in self._INPUT_PORT_NAMES_AND_SIZES
        ]
        self._declare_step(results, 3, period)
        self._declare_output("packet", 4, slice(0, PACKET_SIZE))
        self._declare_output_of_own_end()

    def _evaluate_inputs_packet_fresh(self, context: Context) -> tuple[list[Array], Array, bool]:
        packet = self._received.Eval(context)
        inputs = []
        for port, is_optional in self._ports:
            is_missing = is_optional and not port.HasValue(context)
            inputs.append(np.zeros(port.size()) if is_missing else port.Eval(context))
        return inputs, np.ascontiguousarray(packet[:-1]), bool(packet[-1] > 0.5)


class PassivityAtMaster(_PassivityEndBlock):
    """Block of a passivity method's end at the master: renders a wrench, sends pose and energy.

    .. pydrake_system::

        name: PassivityAtMaster
        input_ports:
        - received: (39,) newest packet from the slave; 1 if it is new
        - pose_command: (7,) commanded pose X_WS, after kinematic scaling
        - hand_wrench_E: (6,) wrench of the hand on the stylus at E, in B; 0 if unconnected
        output_ports:
        - packet: (38,) for the slave
        - wrench_to_master: (6,) F_E_B, [f; tau] to render on the stylus at E, in B [N, N m]

    Args:
        passivity: method and parameters, equal at both ends.
        period: time between packets [s].
        start: (7,) pose X_WS [qw qx qy qz px py pz] of the slave at the start.
        R_WB: (3, 3) orientation of the master's base B in world W.
        scales: (2,) slave motion over master motion: translation, rotation.
        force_scale: force at the master over force at the slave.
        timeout: time without packets before an end fades the wrench or stops the slave [s].
    """

    __slots__ = ()
    _INPUT_PORT_NAMES_AND_SIZES = (("pose_command", 7), ("hand_wrench_E", 6))

    def _declare_output_of_own_end(self) -> None:
        self._declare_output("wrench_to_master", 3, slice(0, 6))

    def _advance_states_and_outputs(self, context: Context, results: list[Array]) -> None:
        ends, _, port_energies, wrench, packet = results
        inputs, *received = self._evaluate_inputs_packet_fresh(context)
        states = *self._constants, ends, port_energies[:2], packet, wrench
        steps.step_master_end(self._method, *inputs, *received, *states)


class PassivityAtSlave(_PassivityEndBlock):
    """Block of a passivity method's end at the slave: commands a pose, sends wrench and energy.

    .. pydrake_system::

        name: PassivityAtSlave
        input_ports:
        - received: (39,) newest packet from the master; 1 if it is new
        - wrench_B: (6,) F_E_B to render at the hand, output of `ForceScaling` [N, N m]
        - load_wrench_B: (6,) part of wrench_B from the load, for method `ledger`; 0 if unconnected
        - pose_slave: (7,) actual X_WS of the slave
        - saturated: (1,) 1 to send the last valid wrench instead; 0 if unconnected
        - contact: (1,) flag of a contact detector; 0 if unconnected
        output_ports:
        - packet: (38,) for the master
        - pose_to_slave: (7,) X_WS to follow

    Arguments as for `PassivityAtMaster`.
    """

    __slots__ = ()
    _INPUT_PORT_NAMES_AND_SIZES = (
        *(("wrench_B", 6), ("load_wrench_B", 6), ("pose_slave", 7)),
        *(("saturated", 1), ("contact", 1)),
    )

    def _declare_output_of_own_end(self) -> None:
        self.DeclareStateOutputPort("pose_to_slave", DiscreteStateIndex(self._states[1]))

    def _advance_states_and_outputs(self, context: Context, results: list[Array]) -> None:
        ends, pose, port_energies, _, packet = results
        (*values, saturated, contact), *received = self._evaluate_inputs_packet_fresh(context)
        flags = bool(saturated[0] > 0.5), float(contact[0])
        states = *self._constants, ends, pose, port_energies, packet
        steps.step_slave_end(self._method, *values, *flags, *received, *states)
