"""Passivity method "four_channel": Lawrence's architecture with local force feedback.

docs/theory.md, (T39). There is no energy balance: any delay makes the channel active.
"""

from dataclasses import dataclass

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.packet import fill_packet, pose_difference_into

# Parameters; pairs are for translation and rotation.
_parameter_slots = slots.own_parameters()
_COUPLING_STIFFNESS, _COUPLING_DAMPING = map(_parameter_slots.vector, (2, 2))
_SLAVE_FEEDBACK_GAIN, _HAND_FEEDBACK_GAIN = _parameter_slots.numbers(2)
_DEFLECTION_OR_SHIFT_SLICE = slots.own_memory().vector(6)


@settings
@dataclass
class FourChannelConfig:
    """Parameters of the four-channel architecture."""

    stiffness: list[float] = quantity(
        [100.0, 1.0], "N/m, N m/rad", 0.0, 1e6,
        "spring between the hand and the received pose of the slave (C_m)",
    )  # fmt: skip
    damping: list[float] = quantity(
        [10.0, 0.05], "N s/m, N m s/rad", 0.0, 1e6, "damper between hand and received slave pose"
    )
    slave_feedback: float = quantity(
        0.0, "1", -1.0, 10.0,
        "local gain C5 of the contact force at the slave; the received hand force has C3 = 1 + C5",
    )  # fmt: skip
    hand_feedback: float = quantity(
        0.0, "1", -1.0, 10.0,
        "local gain C6 of the hand force at the master; the received contact force: C2 = 1 + C6",
    )  # fmt: skip

    def pack_into(self, p: Array) -> None:
        p[_COUPLING_STIFFNESS], p[_COUPLING_DAMPING] = self.stiffness, self.damping
        p[_SLAVE_FEEDBACK_GAIN], p[_HAND_FEEDBACK_GAIN] = self.slave_feedback, self.hand_feedback


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    difference = memory[_DEFLECTION_OR_SHIFT_SLICE]
    difference[:] = 0.0
    connected = fields.has_packet_arrived(received)
    if connected:
        pose_difference_into(received[fields.POSE], pose, difference)
    for i in range(6):
        g, gain = i // 3, p[_HAND_FEEDBACK_GAIN]
        wrench[i] = (1.0 + gain) * received[fields.WRENCH][i] + gain * hand[i]
        if connected:
            wrench[i] += p[_COUPLING_STIFFNESS][g] * difference[i]
            wrench[i] += p[_COUPLING_DAMPING][g] * (received[fields.VELOCITY][i] - twist[i])
    for g in range(2):
        fields.limit_group(wrench, g, limits[g])
    fill_packet(pose, twist, hand, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    if fields.has_packet_arrived(received):
        shift = memory[_DEFLECTION_OR_SHIFT_SLICE]
        for i in range(6):
            g, gain = i // 3, p[_SLAVE_FEEDBACK_GAIN]
            force = (1.0 + gain) * received[fields.WRENCH][i] + gain * wrench[i]
            force += p[slots.SERVO_D][g] * received[fields.VELOCITY][i]
            shift[i] = force / p[slots.SERVO_K][g]
        fields.move_pose_into(received[fields.POSE], shift, memory[slots.COMMAND_POSE])
        copy_into(memory, slots.COMMAND_TWIST.start, received, fields.VELOCITY.start, 6)
    copy_into(command, 0, memory, slots.COMMAND.start, 13)
    copy_into(memory, slots.LAST_PORT_WRENCH.start, wrench, 0, 6)
    fill_packet(pose, twist, wrench, packet)
