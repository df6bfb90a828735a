"""Passivity method "pspm": passive set-position modulation, docs/theory.md, (T38).

A spring pulls each end to a set position, as near to the requested one as the energy permits
(Lee and Huang, T-RO 26(2), 2010).
"""

import math
from dataclasses import dataclass

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.packet import dot_of_group, fill_packet, pose_difference_into

# Parameters, for translation and rotation.
_parameter_slots = slots.own_parameters()
_INITIAL_ENERGY, _MAX_STORED_ENERGY = map(_parameter_slots.vector, (2, 2))
_SPRING_STIFFNESS, _HAND_DAMPING = map(_parameter_slots.vector, (2, 2))
# Memory: set position minus actual position; requested value of this difference.
_memory_slots = slots.own_memory()
_SPRING_DEFLECTION, _REQUESTED_SPRING_DEFLECTION = map(_memory_slots.vector, (6, 6))


@settings
@dataclass
class PspmConfig:
    """Parameters of the passive set-position modulation."""

    initial: list[float] = quantity([0.01, 2e-4], "J", 0.0, 1e3, "stored energy at the start")
    ceiling: list[float] = quantity(
        [0.015, 3e-4], "J", 0.0, 1e6,
        "largest stored energy of an end; the master sends any excess, the slave discards it",
    )  # fmt: skip
    stiffness: list[float] = quantity(
        [1000.0, 10.0], "N/m, N m/rad", 1e-6, 1e9, "K_h, spring between set position and hand"
    )
    damping: list[float] = quantity(
        [0.5, 0.005], "N s/m, N m s/rad", 0.0, 1e6, "B, damper at the hand"
    )

    def pack_into(self, p: Array) -> None:
        p[_INITIAL_ENERGY], p[_MAX_STORED_ENERGY] = self.initial, self.ceiling
        p[_SPRING_STIFFNESS], p[_HAND_DAMPING] = self.stiffness, self.damping


@njit(cache=True)
def initialize(p, memory):
    memory[slots.STORED_ENERGY] = p[_INITIAL_ENERGY]


@njit(cache=True)
def _modulate_set_position(received, g, stiffness, dx, last_square, is_master, p, memory, packet):
    offset, requested = memory[_SPRING_DEFLECTION], memory[_REQUESTED_SPRING_DEFLECTION]
    stored, required = dot_of_group(offset, offset, g), dot_of_group(requested, requested, g)
    damped = -dot_of_group(memory[slots.LAST_PORT_WRENCH], dx, g)
    damped -= 0.5 * stiffness * (stored - last_square)
    ledger = memory[slots.STORED_ENERGY]
    energy = ledger[g] + damped
    energy += fields.count_newly_received_energy(g, received, memory)
    available = stored + 2.0 * energy / stiffness
    share = 1.0 if required <= max(available, 0.0) else math.sqrt(max(available, 0.0) / required)
    for i in range(3 * g, 3 * g + 3):
        offset[i] = share * requested[i]
    energy -= 0.5 * stiffness * (dot_of_group(offset, offset, g) - stored)
    surplus = max(energy - p[_MAX_STORED_ENERGY][g], 0.0)
    if is_master:
        memory[slots.SENT_ENERGY][g] += surplus
    else:
        memory[slots.DISSIPATED_ENERGY][g] += surplus
    ledger[g] = energy - surplus
    packet[fields.CUMULATIVE_ENERGY][g] = memory[slots.SENT_ENERGY][g]


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    offset, requested = memory[_SPRING_DEFLECTION], memory[_REQUESTED_SPRING_DEFLECTION]
    received_wrench, K, B = received[fields.WRENCH], p[_SPRING_STIFFNESS], p[_HAND_DAMPING]
    for g in range(2):
        before = dot_of_group(offset, offset, g)
        for i in range(3 * g, 3 * g + 3):
            offset[i] -= dx[i]
            wrench[i] = received_wrench[i]
        fields.limit_group(wrench, g, limits[g])
        for i in range(3 * g, 3 * g + 3):
            requested[i] = wrench[i] / K[g]
        _modulate_set_position(received, g, K[g], dx, before, True, p, memory, packet)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = K[g] * offset[i] - B[g] * twist[i]
        fields.limit_group(wrench, g, limits[g])
    fill_packet(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    offset, requested = memory[_SPRING_DEFLECTION], memory[_REQUESTED_SPRING_DEFLECTION]
    now, held = memory[slots.COMMAND_POSE], memory[slots.LAST_PORT_WRENCH]
    K, D = p[slots.SERVO_K], p[slots.SERVO_D]
    before = dot_of_group(offset, offset, 0), dot_of_group(offset, offset, 1)
    pose_difference_into(now, pose, offset)
    copy_into(requested, 0, offset, 0, 6)
    if fields.has_packet_arrived(received):
        pose_difference_into(received[fields.POSE], pose, requested)
        copy_into(memory, slots.COMMAND_TWIST.start, received, fields.VELOCITY.start, 6)
    for g in range(2):
        _modulate_set_position(received, g, K[g], dx, before[g], False, p, memory, packet)
        for i in range(3 * g, 3 * g + 3):
            held[i] = K[g] * offset[i] - D[g] * twist[i]
    fields.move_pose_into(pose, offset, now)
    copy_into(command, 0, memory, slots.COMMAND.start, 13)
    fill_packet(pose, twist, wrench, packet)


@njit(cache=True)
def record_command(requested, command, pose, twist, p, memory):
    offset, other, held = memory[_SPRING_DEFLECTION], np.empty(6), memory[slots.LAST_PORT_WRENCH]
    K, D = p[slots.SERVO_K], p[slots.SERVO_D]
    pose_difference_into(command, pose, offset)
    pose_difference_into(requested, pose, other)
    for i in range(6):
        held[i] = K[i // 3] * offset[i] - D[i // 3] * twist[i]
    copy_into(memory, slots.COMMAND_POSE.start, command, 0, 7)
    for g in range(2):
        increase = dot_of_group(offset, offset, g) - dot_of_group(other, other, g)
        memory[slots.STORED_ENERGY][g] -= 0.5 * K[g] * increase
