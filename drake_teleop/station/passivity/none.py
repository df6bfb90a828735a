"""Passivity method "none": passes on pose and wrench (within the force limit), as a baseline."""

from __future__ import annotations

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.packet import fill_packet, has_packet_arrived, limit_group


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    copy_into(wrench, 0, received, fields.WRENCH.start, 6)
    for g in range(2):
        limit_group(wrench, g, limits[g])
    fill_packet(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    if has_packet_arrived(received):
        copy_into(memory, slots.COMMAND_POSE.start, received, fields.POSE.start, 7)
        copy_into(memory, slots.COMMAND_TWIST.start, received, fields.VELOCITY.start, 6)
    copy_into(command, 0, memory, slots.COMMAND.start, 13)
    copy_into(memory, slots.LAST_PORT_WRENCH.start, wrench, 0, 6)
    fill_packet(pose, twist, wrench, packet)
