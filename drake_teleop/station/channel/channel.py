"""Channel between master and slave: settings, and a compiled step of network and both ends."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteStateIndex

from drake_teleop.common.blocks import are_valid_port_values
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import apply_matrix, copy_into, matrix_at, transposed, vector_at
from drake_teleop.station.channel import network
from drake_teleop.station.channel.network import PRESETS, NetworkConfig
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import methods, safe_state
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.passivity.packet import dot_of_group, pose_difference_into
from drake_teleop.station.stepped_block import SteppedBlock

_NETWORK_NAMES = ("custom", *PRESETS)
#: Smallest default and largest timeout [s].
MIN_TIMEOUT_S, MAX_TIMEOUT_S = 0.1, 1.0
_TIMEOUT_TO_SILENCE_RATIO = 1.5  # default timeout over the longest silence of a minute


@settings
@dataclass
class Channel(NetworkConfig):
    """Settings of the network between master and slave: a preset, or `custom` with its fields."""

    network: str = choice("custom", _NETWORK_NAMES, "network preset; custom: use the other fields")
    backward: NetworkConfig | None = plain(None, "slave-to-master network; null: as for commands")
    timeout: float | None = quantity(
        None, "s", 1e-3, MAX_TIMEOUT_S,
        "time without packets before master or slave enters its safe state; null: 1.5 times the "
        "longest such time in a minute of this network, at least 0.1 s",
    )  # fmt: skip

    def networks_of_directions(self, where: str = "channel") -> tuple[NetworkConfig, NetworkConfig]:
        """Return the networks of both directions: forward (master to slave) and backward."""
        names = [entry.name for entry in dataclasses.fields(NetworkConfig)]
        own = NetworkConfig(**{name: getattr(self, name) for name in names})
        if self.network == "custom":
            return own, own if self.backward is None else self.backward
        odd = [name for name in names if getattr(own, name) != getattr(NetworkConfig(), name)]
        odd += [] if self.backward is None else ["backward"]
        if odd:
            what = f"preset '{self.network}' cannot be combined with {', '.join(odd)}"
            remedy = "remove these fields, or set network: custom"
            raise DrakeTeleopError(what, where=f"{where}.network", remedy=remedy)
        return PRESETS[self.network], PRESETS[self.network]

    def timeout_s(self, period: float) -> float:
        """Return the time without packets before the safe state [s], for steps of `period` [s]."""
        if self.timeout is not None:
            return self.timeout
        lines = enumerate(self.networks_of_directions())
        longest = max(network.longest_silence(line, k, period) for k, line in lines)
        return min(max(_TIMEOUT_TO_SILENCE_RATIO * longest, MIN_TIMEOUT_S), MAX_TIMEOUT_S)


# State of both ends in one array.
_MONITOR_STATE_SIZES = safe_state.MASTER_MONITOR_SIZE, safe_state.SLAVE_MONITOR_SIZE
_STATE_SIZE_OF_BOTH_ENDS = 2 + 2 * (8 + 6 + slots.MEMORY_SIZE) + sum(_MONITOR_STATE_SIZES)
_state_slots = slots.SlotAllocator(_STATE_SIZE_OF_BOTH_ENDS)
_STEP_COUNT_INDEX = _state_slots.number()
# Last finite commanded pose (7); 1 if the newest one is not finite.
_MASTER_POSE_AND_INVALID_FLAG_SLICE = _state_slots.vector(8)
_SLAVE_POSE_AND_INVALID_FLAG_SLICE = _state_slots.vector(8)  # the same of the slave's pose
_RENDERED_HAND_WRENCH_SLICE = _state_slots.vector(6)  # wrench rendered since the last step
_LAST_VALID_SLAVE_WRENCH_SLICE = _state_slots.vector(6)  # slave's wrench at the last step
_TIME_SINCE_INVALID_WRENCH_INDEX = _state_slots.number()  # time since the last invalid wrench [s]
_MASTER_MONITOR_SLICE, _SLAVE_MONITOR_SLICE = map(_state_slots.vector, _MONITOR_STATE_SIZES)
MASTER_METHOD_MEMORY_SLICE = _state_slots.vector(slots.MEMORY_SIZE)
SLAVE_METHOD_MEMORY_SLICE = _state_slots.vector(slots.MEMORY_SIZE)
# Transformation of a wrench at the hand to the world: R_WB by rows, scales of motion.
_R_WB_SLICE, _MOTION_SCALES_SLICE = slice(0, 9), slice(9, 11)
# Recorded values, see `ports` of `TeleopChannel`.
NUM_PORTS_VALUES = 8
_ports_slots = slots.SlotAllocator(NUM_PORTS_VALUES)
_WORK_OF_HAND_WRENCH, _WORK_OF_SLAVE_WRENCH = map(_ports_slots.vector, (2, 2))
_SILENCE_TIMES_OF_ENDS, _WORK_ALONG_COMMAND = map(_ports_slots.vector, (2, 2))
# Received values at the master.
_received_slots = slots.SlotAllocator(7)
_RECEIVED_WRENCH_SLICE, _RECEIVED_CONTACT_FLAG_SLICE = map(_received_slots.vector, (6, 1))
_ZERO_LOAD_WRENCH = np.zeros(6)


def pack_parameters_and_mapping(
    passivity: PassivityConfig, R_WB: Array, scales: Array, force_scale: float
) -> tuple[Array, Array]:
    """Return the method's parameters; R_WB (9) and slave over master motion (2) in one array."""
    # A scale of zero transfers no energy; any unit is valid.
    scales, force_scale = np.where(scales > 0.0, scales, 1.0), force_scale or 1.0
    parameters = methods.method_parameters(passivity, list(force_scale / scales), list(scales))
    return parameters, np.concatenate([R_WB.ravel(), scales])


def initial_state_of_master_and_slave_ends(method: str, parameters: Array, start: Array) -> Array:
    """Return the state of both channel ends before the first step, for slave pose X_WS `start`."""
    ends = np.zeros(_STATE_SIZE_OF_BOTH_ENDS)
    ends[_MASTER_POSE_AND_INVALID_FLAG_SLICE][:7] = start
    ends[_SLAVE_POSE_AND_INVALID_FLAG_SLICE][:7] = start
    ends[_TIME_SINCE_INVALID_WRENCH_INDEX] = safe_state.STOP_TIME_S
    ends[_MASTER_MONITOR_SLICE] = safe_state.initial_master_monitor()
    ends[_SLAVE_MONITOR_SLICE] = safe_state.initial_slave_monitor(start)
    memory = methods.initial_method_memory(method, parameters, start)
    ends[MASTER_METHOD_MEMORY_SLICE] = ends[SLAVE_METHOD_MEMORY_SLICE] = memory
    return ends


@njit(cache=True)
def step_channel(
    steps, pose_command, wrench_B, load_B, hand_B, slave_pose, saturated, contact, T, timeout,
    mapping, parameters, forward_parameters, backward_parameters, forward, backward, ends,
    pose_received, ports, wrench_received,
):  # fmt: skip
    """Run one step of both ends and of both directions of the network.

    Args:
        steps: result of `methods.step_addresses`.
        pose_command, wrench_B, load_B, hand_B, slave_pose, saturated, contact: inputs of
            `TeleopChannel`.
        T, timeout: time between steps, time without packets before the safe state [s].
        mapping: (11,) R_WB by rows; slave motion over master motion: translation, rotation.
        parameters, forward_parameters, backward_parameters: of the method and both networks.
        forward, backward, ends: states of both networks and of both ends, updated.
        pose_received: (7,) written: slave's command X_WS.
        ports: (8,) output port `ports` of `TeleopChannel`: energies updated, times written.
        wrench_received: (7,) written: F_E_B to render, and contact flag of the newest packet.
    """
    k = int(ends[_STEP_COUNT_INDEX])
    ends[_STEP_COUNT_INDEX] += 1.0
    received, packet = np.zeros(fields.PACKET_SIZE), np.empty(fields.PACKET_SIZE)
    _, fresh = network.receive_packet(backward_parameters, backward, k, received)
    step_master_end(
        steps, pose_command, hand_B, received, fresh, T, timeout, mapping, parameters, ends,
        ports[_WORK_OF_HAND_WRENCH], packet, wrench_received,
    )  # fmt: skip
    network.send_packet(forward_parameters, forward, k, packet)
    _, fresh = network.receive_packet(forward_parameters, forward, k + 1, received)
    step_slave_end(
        steps, wrench_B, load_B, slave_pose, saturated, contact, received, fresh, T, timeout,
        mapping, parameters, ends, pose_received, ports, packet,
    )  # fmt: skip
    network.send_packet(backward_parameters, backward, k, packet)
    ports[_SILENCE_TIMES_OF_ENDS][0] = ends[_MASTER_MONITOR_SLICE][safe_state.SILENCE_TIME_INDEX]
    ports[_SILENCE_TIMES_OF_ENDS][1] = ends[_SLAVE_MONITOR_SLICE][safe_state.SILENCE_TIME_INDEX]


@njit(cache=True)
def step_master_end(
    steps, pose_command, hand_B, received, fresh, T, timeout, mapping, parameters, ends, work,
    packet, wrench_received,
):  # fmt: skip
    """Run one step of the master's end; other arguments are those of `step_channel`.

    `received` is the slave's newest packet, `fresh` True if it is new; `packet` is written. `work`
    (2,) increases by the hand's work in translation and rotation [J].
    """
    before, held = ends[_MASTER_POSE_AND_INVALID_FLAG_SLICE], ends[_RENDERED_HAND_WRENCH_SLICE]
    monitor, memory = ends[_MASTER_MONITOR_SLICE], ends[MASTER_METHOD_MEMORY_SLICE]
    dx, twist, hand, limits = np.empty(6), np.empty(6), np.empty(6), np.empty(2)
    valid = _update_pose_and_twist(pose_command, before, T, dx, twist)
    for g in range(2):
        work[g] -= dot_of_group(held, dx, g)
    hand[:] = 0.0
    if are_valid_port_values(hand_B):
        _rotate_and_scale_wrench_to_world_into(hand_B, mapping, hand)
    else:
        valid = False
    healthy = fresh and received[fields.SENDER_INPUTS_FINITE] > 0.5
    healthy = healthy and fields.are_vectors_finite((received,))
    fault = (fresh and not healthy) or not valid
    safe_state.master_wrench_limits_into(
        healthy, fault, T, timeout, parameters[slots.WRENCH_LIMIT], held, monitor, limits
    )
    methods.master_step(
        steps, received, fresh, before[:7], twist, dx, hand, limits, T, parameters, memory, held,
        packet,
    )  # fmt: skip
    if not valid:
        packet[fields.SENDER_INPUTS_FINITE] = 0.0
    _rotate_and_scale_wrench_to_master_into(held, mapping, wrench_received[_RECEIVED_WRENCH_SLICE])
    wrench_received[_RECEIVED_CONTACT_FLAG_SLICE] = received[fields.CONTACT_FLAG]


@njit(cache=True)
def step_slave_end(
    steps, wrench_B, load_B, slave_pose, saturated, contact, received, fresh, T, timeout, mapping,
    parameters, ends, pose_received, ports, packet,
):  # fmt: skip
    """Run one step of the slave's end; arguments as for `step_channel` and `step_master_end`."""
    before, held = ends[_SLAVE_POSE_AND_INVALID_FLAG_SLICE], ends[_LAST_VALID_SLAVE_WRENCH_SLICE]
    monitor, memory = ends[_SLAVE_MONITOR_SLICE], ends[SLAVE_METHOD_MEMORY_SLICE]
    work = ports[_WORK_OF_SLAVE_WRENCH]
    dx, twist, wrench = np.empty(6), np.empty(6), np.empty(6)
    command, left = np.empty(13), pose_received.copy()
    valid = _update_pose_and_twist(slave_pose, before, T, dx, twist)
    for g in range(2):
        work[g] += dot_of_group(held, dx, g)
    load = memory[slots.LOAD_WRENCH]
    if not (are_valid_port_values(wrench_B) and are_valid_port_values(load_B)):
        valid = False
        ends[_TIME_SINCE_INVALID_WRENCH_INDEX] = 0.0
    elif saturated:
        ends[_TIME_SINCE_INVALID_WRENCH_INDEX] = 0.0
    else:
        # Blend from the kept wrench to the measured one.
        _rotate_and_scale_wrench_to_world_into(wrench_B, mapping, wrench)
        share = T / max(safe_state.STOP_TIME_S - ends[_TIME_SINCE_INVALID_WRENCH_INDEX], T)
        for i in range(6):
            held[i] = (1.0 - share) * held[i] + share * wrench[i]
        _rotate_and_scale_wrench_to_world_into(load_B, mapping, wrench)
        for i in range(6):
            load[i] = (1.0 - share) * load[i] + share * wrench[i]
        ends[_TIME_SINCE_INVALID_WRENCH_INDEX] += T
    copy_into(wrench, 0, held, 0, 6)
    healthy = fresh and received[fields.SENDER_INPUTS_FINITE] > 0.5
    healthy = healthy and fields.are_vectors_finite((received,))
    methods.slave_step(
        steps, received, fresh, before[:7], twist, dx, wrench, T, parameters, memory, command,
        packet,
    )  # fmt: skip
    if not valid:
        packet[fields.SENDER_INPUTS_FINITE] = 0.0
    packet[fields.CONTACT_FLAG] = 1.0 if contact > 0.5 else 0.0
    fault, requested = (fresh and not healthy) or not valid, command[:7]
    safe_state.slave_command_into(healthy, fault, T, timeout, requested, monitor, pose_received)
    methods.record_command(steps, requested, pose_received, before[:7], twist, parameters, memory)
    pose_difference_into(pose_received, left, dx)
    for g in range(2):
        ports[_WORK_ALONG_COMMAND][g] += dot_of_group(held, dx, g)


@njit(cache=True)
def _update_pose_and_twist(pose, before, T, dx, twist):
    """Write the change `dx` (6,) of `pose` (7,) and the `twist` (6,); return if `pose` is valid.

    They are 0 at and after an invalid pose. `before` (8,), updated: last valid pose, invalid flag.
    """
    valid = are_valid_port_values(pose)
    if valid:
        pose_difference_into(pose, before, dx)
        copy_into(before, 0, pose, 0, 7)
    if not valid or before[7] > 0.0:
        dx[:] = 0.0
    for i in range(6):
        twist[i] = dx[i] / T
    before[7] = 0.0 if valid else 1.0
    return valid


@njit(cache=True)
def _rotate_and_scale_wrench_to_world_into(wrench_B, mapping, out):
    R_WB, scales = matrix_at(mapping, _R_WB_SLICE.start), mapping[_MOTION_SCALES_SLICE]
    for g in range(2):
        rotated = apply_matrix(R_WB, vector_at(wrench_B, 3 * g))
        for i in range(3):
            out[3 * g + i] = (rotated[i] + 0.0) / scales[g]  # 0, never -0


@njit(cache=True)
def _rotate_and_scale_wrench_to_master_into(wrench, mapping, out):
    R_BW, scales = transposed(matrix_at(mapping, _R_WB_SLICE.start)), mapping[_MOTION_SCALES_SLICE]
    for g in range(2):
        rotated = apply_matrix(R_BW, vector_at(wrench, 3 * g))
        for i in range(3):
            out[3 * g + i] = (rotated[i] + 0.0) * scales[g]  # 0, never -0


class TeleopChannel(SteppedBlock):
    """Network with a passivity method at both ends; a packet takes at least one period.

    While the wrist sensor is saturated, the last valid wrench is used.

    Ports are those of `MakeChannel`, but the outputs to slave and master are pose_received and
    wrench_received; contact is always an input, 0 if unconnected. Only `ledger` uses load_wrench_B.
    `ports` (8,) contains work of hand (2) and slave's wrench (2) in translation and rotation [J];
    time without packets at master and slave (2) [s]; work of that wrench along the command (2) [J].

    Args:
        R_WB: (3, 3) orientation of the master's base B in world W.
        scales: (2,) slave motion over master motion: translation, rotation.
        force_scale: force at the master over contact force at the slave.
        start: (7,) pose X_WS of the slave at the start.
    """

    __slots__ = ()

    def __init__(
        self, channel: Channel, passivity: PassivityConfig, R_WB: Array, scales: Array,
        force_scale: float, start: Array, period: float, seed: int,
    ) -> None:  # fmt: skip
        super().__init__()
        # Forward, the slave reads the command one step later. Backward, the master takes its step
        # before the slave.
        lines = [
            network.network_parameters(line, seed, direction, period, min_steps=1)
            for direction, line in enumerate(channel.networks_of_directions())
        ]
        self._steps = methods.step_addresses(passivity.method)
        self._uses_load = methods.METHODS[passivity.method].needs_load_apart
        parameters, mapping = pack_parameters_and_mapping(passivity, R_WB, scales, force_scale)
        self._constants = (period, channel.timeout_s(period), mapping, parameters, *lines)
        self._pose = self.DeclareVectorInputPort("pose_command", 7)
        self._wrench = self.DeclareVectorInputPort("wrench_B", 6)
        self._hand = self.DeclareVectorInputPort("hand_wrench_E", 6)
        self._slave = self.DeclareVectorInputPort("pose_slave", 7)
        self._saturated = self.DeclareVectorInputPort("saturated", 1)
        self._contact = self.DeclareVectorInputPort("contact", 1)
        self._load = self.DeclareVectorInputPort("load_wrench_B", 6)
        ends = initial_state_of_master_and_slave_ends(passivity.method, parameters, start)
        size = fields.PACKET_SIZE if self._uses_load else fields.PACKET_LOAD_WRENCH.start
        initial = [network.initial_network_state(line, np.zeros(size)) for line in lines]
        receivers, in_transit = zip(*initial, strict=True)
        results = [*receivers, ends, np.array(start), np.zeros(NUM_PORTS_VALUES), np.zeros(7)]
        self._initial_arguments = (passivity.method, parameters)
        self._declare_step(results, len(results) - 1, period)
        # Packets in transit are abstract parameters, which a context clones. Drake would copy a
        # discrete state several times a step: 1.5 MB for `lunar`.
        sent = map(AbstractValue.Make, in_transit)
        self._in_transit = [self.DeclareAbstractParameter(packets) for packets in sent]
        for name, state in (("pose_received", 3), ("ports", 4)):
            self.DeclareStateOutputPort(name, DiscreteStateIndex(self._states[state]))
        self._declare_output("wrench_received", 5, _RECEIVED_WRENCH_SLICE)
        self._declare_output("contact_at_hand", 5, _RECEIVED_CONTACT_FLAG_SLICE)

    def Restart(self, context: Context, command: Array, slave: Array, fill_time_s: float) -> None:
        """Start this new channel in a running station at the slave's present command.

        `command` and `slave` (7,) are commanded and actual X_WS of the slave. Method `wave` keeps
        the command for `fill_time_s`, in which packets fill the channel.
        """
        ends = initial_state_of_master_and_slave_ends(*self._initial_arguments, command)
        ends[_SLAVE_POSE_AND_INVALID_FLAG_SLICE][:7] = slave
        ends[SLAVE_METHOD_MEMORY_SLICE][slots.CHANNEL_FILL_TIME_LEFT] = fill_time_s
        context.SetDiscreteState(self._states[2], ends)
        context.SetDiscreteState(self._states[3], command)

    def _advance_states_and_outputs(self, context: Context, results: list[Array]) -> None:
        # A repeated step with other inputs overwrites the same places.
        in_transit = [context.get_abstract_parameter(k).get_value() for k in self._in_transit]
        forward, backward = zip(results[:2], in_transit, strict=True)
        load = _ZERO_LOAD_WRENCH
        if self._uses_load and self._load.HasValue(context):  # its evaluation takes time
            load = self._load.Eval(context)
        hand_and_slave = self._hand.Eval(context), self._slave.Eval(context)
        inputs = self._pose.Eval(context), self._wrench.Eval(context), load, *hand_and_slave
        saturated = self._saturated.Eval(context)[0] > 0.5
        contact = self._contact.Eval(context)[0] if self._contact.HasValue(context) else 0.0
        states = *self._constants, forward, backward, *results[2:]
        step_channel(self._steps, *inputs, saturated, contact, *states)
