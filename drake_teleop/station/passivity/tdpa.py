"""Passivity methods "tdpa" and "charged_tdpa": time-domain passivity approach (TDPA) with delay.

docs/theory.md, (T31), (T32), (T44). `charged_tdpa` adds a drag on the hand, whose energy is stored
(Franken et al. 2011), and a filter of the slave's wrench.
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
from drake_teleop.station.passivity.packet import dot_of_group, length_of_group, limit_group

# Share of the hand's input kept until the reserve is full; all of it would starve a soft wall.
_UNSENT_HAND_ENERGY_SHARE = 0.5
# Onset and end of a wrench that needs no delay filter: slower than hand and servo [s].
_WRENCH_ONSET_TIME_CONSTANT_S = 0.1
_CONTACT_END_WRENCH_RATIO = 0.1  # a wrench below this share of the filtered one ends
_WRENCH_SHARE_AT_ONSET_END = 0.98  # share at which a quick onset is complete
# Travel over which the contact stiffness is averaged [m, rad], and speed below which the drag fades
# [m/s, rad/s], for translation and rotation.
_STIFFNESS_AVERAGING_TRAVEL_M_RAD = (1e-3, 1e-2)
_FULL_DRAG_HAND_SPEED = (0.02, 0.2)

# In the packet: number of the master's newest packet; the slave's ledger.
_NEWEST_MASTER_PACKET_NUMBER = fields.METHOD_VALUES.start
_PACKET_SLAVE_ENERGY = fields.SENDER_ENERGY

# Parameters; reserve, drag and stiffness in the master's power units.
_parameter_slots = slots.own_parameters()
_WRENCH_RELEASE_TIME, _LEDGER_DRAIN_RATE, _COMMAND_DRIFT_RATE = _parameter_slots.numbers(3)
_TARGET_RESERVE, _DRAG_WRENCH, _HAND_STIFFNESS = map(_parameter_slots.vector, [2] * 3)
_MAX_COMMAND_SPEED = _parameter_slots.vector(2)
# Memory of the master: withheld share of the wrench, kept energy.
_master_memory_slots = slots.own_memory()
_WITHHELD_WRENCH_SHARE, _MASTER_RESERVED_ENERGY = map(_master_memory_slots.vector, (2, 2))
# Memory of the slave: work in and out at the actual and the commanded motion; withheld motion;
# filtered wrench; contact stiffness; number of the packet that completed a quick onset.
_slave_memory_slots = slots.own_memory()
_SLAVE_WORK_IN, _SLAVE_WORK_OUT = map(_slave_memory_slots.vector, (2, 2))
_COMMAND_WORK_IN, _COMMAND_WORK_OUT = map(_slave_memory_slots.vector, (2, 2))
_WITHHELD_COMMAND_MOTION, _FILTERED_SLAVE_WRENCH = map(_slave_memory_slots.vector, (6, 6))
_CONTACT_STIFFNESS_ESTIMATE, _QUICK_ONSET_PACKET_NUMBER = map(_slave_memory_slots.vector, (2, 2))
_LAST_COMMAND_POSE = _slave_memory_slots.vector(7)  # the command of the last step


@settings
@dataclass
class TdpaConfig:
    """Parameters of the time-domain passivity approach (TDPA)."""

    release: float = quantity(
        0.02, "s", 0.0, 10.0,
        "time in which a reduced wrench returns to its full value (force-jump filter)",
    )  # fmt: skip
    drain_rate: float = quantity(
        200.0, "1/s", 0.0, 1e6, "share of the stored energy that the wrench may use in a second"
    )
    drift_rate: float = quantity(
        20.0, "1/s", 0.0, 1e3,
        "rate at which the command returns to the received one, within the available energy",
    )  # fmt: skip
    speed: list[float] = quantity(
        [1.0, 10.0], "m/s, rad/s", 1e-3, 1e3,
        "largest speed of the slave's command; bounds the energy that an impact may create",
    )  # fmt: skip
    reserve: list[float] = quantity(
        [2e-3, 1e-4], "J", 0.0, 1e3, "energy of the hand's work that the master keeps"
    )
    drag: list[float] = quantity(
        [0.0, 0.0], "N, N m", 0.0, 10.0, "drag on the hand while an end has less than `reserve`"
    )
    hand_stiffness: list[float] = quantity(
        [0.0, 0.0], "N/m, N m/rad", 0.0, 1e5,
        "stiffness of the hand for the filter of the returned wrench; 0: no filter",
    )  # fmt: skip

    def pack_into(self, p: Array) -> None:
        p[_WRENCH_RELEASE_TIME], p[_LEDGER_DRAIN_RATE] = self.release, self.drain_rate
        p[_COMMAND_DRIFT_RATE], p[_MAX_COMMAND_SPEED] = self.drift_rate, self.speed
        p[_TARGET_RESERVE] = self.reserve
        scales = p[slots.SLAVE_PER_MASTER_MOTION]
        p[_DRAG_WRENCH] = np.divide(self.drag, scales)
        p[_HAND_STIFFNESS] = np.divide(self.hand_stiffness, np.square(scales))


def charged_tdpa_config() -> TdpaConfig:
    """Return the default parameters of `charged_tdpa`, for a hand of medium stiffness."""
    return TdpaConfig(reserve=[0.06, 1e-3], drag=[0.28, 3e-3], hand_stiffness=[300.0, 1.5])


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    drain = min(T * p[_LEDGER_DRAIN_RATE], 1.0)
    release = T / p[_WRENCH_RELEASE_TIME] if p[_WRENCH_RELEASE_TIME] > 0.0 else 1.0
    copy_into(wrench, 0, received, fields.WRENCH.start, 6)
    ledger, kept = memory[slots.STORED_ENERGY], memory[_MASTER_RESERVED_ENERGY]
    withheld = memory[_WITHHELD_WRENCH_SHARE]
    for g in range(2):
        ledger[g] += fields.count_newly_received_energy(g, received, memory)
        limit_group(wrench, g, limits[g])
        share = min(1.0, 1.0 - withheld[g] + release)
        work_on_hand = dot_of_group(wrench, dx, g)
        stored = ledger[g] + kept[g]
        if share * work_on_hand > drain * stored:
            max_decrease = fields.MAX_HAND_WRENCH_RATES[g] * T / p[slots.SLAVE_PER_MASTER_MOTION][g]
            least = length_of_group(memory[slots.LAST_PORT_WRENCH], g) - max_decrease
            by_rates = max(drain * stored / work_on_hand, least / length_of_group(wrench, g))
            share = min(share, by_rates, stored / work_on_hand)
        withheld[g] = 1.0 - share
        memory[slots.DISSIPATED_ENERGY][g] += (1.0 - share) * work_on_hand
        fields.scale_group(wrench, g, share)
        _add_hand_drag(g, received[_PACKET_SLAVE_ENERGY][g], dx, limits, T, p, memory, wrench)
        _subtract_hand_work_of_group(g, dot_of_group(wrench, dx, g), p, memory)
        if p[_DRAG_WRENCH][g] > 0.0:
            surplus = min(max(ledger[g] + kept[g] - p[_TARGET_RESERVE][g], 0.0), ledger[g])
            ledger[g] -= surplus
            memory[slots.SENT_ENERGY][g] += surplus
        packet[fields.CUMULATIVE_ENERGY][g] = memory[slots.SENT_ENERGY][g]
    fields.fill_packet(pose, twist, wrench, packet)
    packet[_NEWEST_MASTER_PACKET_NUMBER] = received[fields.PACKET_NUMBER]


@njit(cache=True)
def _add_hand_drag(g, slave_ledger, dx, limits, T, p, memory, wrench):
    drag = p[_DRAG_WRENCH][g]
    level = memory[slots.STORED_ENERGY][g] + memory[_MASTER_RESERVED_ENERGY][g]
    if drag > 0.0 and min(level, slave_ledger) < p[_TARGET_RESERVE][g]:
        damping = drag / max(length_of_group(dx, g), _FULL_DRAG_HAND_SPEED[g] * T)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] -= damping * dx[i]
        limit_group(wrench, g, limits[g])


@njit(cache=True)
def _subtract_hand_work_of_group(g, work_on_hand, p, memory):
    ledger, kept = memory[slots.STORED_ENERGY], memory[_MASTER_RESERVED_ENERGY]
    if work_on_hand > 0.0:
        more = min(ledger[g] - work_on_hand, 0.0)
        ledger[g] = max(ledger[g] - work_on_hand, 0.0)
    else:
        missing = max(p[_TARGET_RESERVE][g] - kept[g], 0.0)
        more = min(-_UNSENT_HAND_ENERGY_SHARE * work_on_hand, missing)
        memory[slots.SENT_ENERGY][g] -= work_on_hand + more
    kept[g] = max(kept[g] + more, 0.0)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    copy_into(memory, _LAST_COMMAND_POSE.start, memory, slots.COMMAND_POSE.start, 7)
    for g in range(2):
        fields.count_newly_received_energy(g, received, memory)
        work = dot_of_group(wrench, dx, g)
        memory[_SLAVE_WORK_IN][g] += max(work, 0.0)
        memory[_SLAVE_WORK_OUT][g] += max(-work, 0.0)
    if fields.has_packet_arrived(received):
        _advance_command_within_energy(received, wrench, T, p, memory)
    for g in range(2):
        available = _available_slave_energy_of_group(memory, g)
        credit = min(memory[_SLAVE_WORK_IN][g], memory[_COMMAND_WORK_IN][g]) + min(available, 0.0)
        # Output beyond the received energy is compensated before energy is sent.
        memory[slots.SENT_ENERGY][g] = max(memory[slots.SENT_ENERGY][g], credit)
        memory[slots.STORED_ENERGY][g] = available
        packet[fields.CUMULATIVE_ENERGY][g] = memory[slots.SENT_ENERGY][g]
        packet[_PACKET_SLAVE_ENERGY][g] = memory[slots.STORED_ENERGY][g]
        _filter_returned_wrench_of_group(g, received, dx, wrench, T, p, memory)
    copy_into(command, 0, memory, slots.COMMAND.start, 13)
    copy_into(memory, slots.LAST_PORT_WRENCH.start, wrench, 0, 6)
    fields.fill_packet(pose, twist, memory[_FILTERED_SLAVE_WRENCH], packet)


@njit(cache=True)
def _filter_returned_wrench_of_group(g, received, dx, wrench, T, p, memory):
    filtered, hand = memory[_FILTERED_SLAVE_WRENCH], p[_HAND_STIFFNESS][g]
    rate, onset, gain = 1.0, 0.0, 0.0
    if hand > 0.0:
        gain = max(_estimate_contact_stiffness_of_group(g, dx, wrench, T, memory), 0.0) / hand
        # The servo's lag counts as delay.
        round_trip = max(memory[slots.STEP_COUNT] - received[_NEWEST_MASTER_PACKET_NUMBER], 1.0) * T
        lag = round_trip + p[slots.SERVO_D][g] / p[slots.SERVO_K][g]
        size, filtered_size = length_of_group(wrench, g), length_of_group(filtered, g)
        onset_rate = min(T / _WRENCH_ONSET_TIME_CONSTANT_S, 1.0)
        rate = min(T / (lag * (1.0 + math.e * gain)), 1.0)
        if size < _CONTACT_END_WRENCH_RATIO * filtered_size:
            rate = max(rate, onset_rate)
        else:
            if filtered_size * (1.0 + gain) < _WRENCH_SHARE_AT_ONSET_END * size:
                onset = onset_rate
                memory[_QUICK_ONSET_PACKET_NUMBER][g] = memory[slots.STEP_COUNT]
            awaited = received[_NEWEST_MASTER_PACKET_NUMBER] < memory[_QUICK_ONSET_PACKET_NUMBER][g]
            if lag > _WRENCH_ONSET_TIME_CONSTANT_S and awaited:
                rate = 0.0
    for i in range(3 * g, 3 * g + 3):
        now = filtered[i]
        filtered[i] += rate * (wrench[i] - now) + onset * (wrench[i] / (1.0 + gain) - now)


@njit(cache=True)
def _estimate_contact_stiffness_of_group(g, dx, wrench, T, memory):
    size, stiffness = length_of_group(dx, g), memory[_CONTACT_STIFFNESS_ESTIMATE]
    if size > _STIFFNESS_AVERAGING_TRAVEL_M_RAD[g] * T:
        change = dot_of_group(wrench, dx, g) - dot_of_group(memory[slots.LAST_PORT_WRENCH], dx, g)
        forget = min(size / _STIFFNESS_AVERAGING_TRAVEL_M_RAD[g], 1.0)
        stiffness[g] += forget * (-change / (size * size) - stiffness[g])
    return stiffness[g]


@njit(cache=True)
def _available_slave_energy_of_group(memory, g):
    used = max(memory[_SLAVE_WORK_OUT][g], memory[_COMMAND_WORK_OUT][g])
    return memory[slots.RECEIVED_ENERGY][g] - used


@njit(cache=True)
def _advance_command_within_energy(received, wrench, T, p, memory):
    now, withheld = memory[slots.COMMAND_POSE], memory[_WITHHELD_COMMAND_MOTION]
    step = memory[slots.COMMAND_TWIST]
    remaining_share = 1.0 - min(T * p[_COMMAND_DRIFT_RATE], 1.0)
    fields.pose_difference_into(received[fields.POSE], now, step)
    for i in range(6):
        step[i] -= remaining_share * withheld[i]
    for g in range(2):
        limit_group(step, g, p[_MAX_COMMAND_SPEED][g] * T)
        pressing = -dot_of_group(wrench, step, g)
        available = max(_available_slave_energy_of_group(memory, g), 0.0)
        if pressing > available:
            fields.scale_group(step, g, available / pressing)
            memory[slots.DISSIPATED_ENERGY][g] += pressing - available
            pressing = available
        memory[_COMMAND_WORK_OUT][g] += max(pressing, 0.0)
        memory[_COMMAND_WORK_IN][g] += max(-pressing, 0.0)
    fields.move_pose_into(now, step, now)
    fields.pose_difference_into(received[fields.POSE], now, withheld)
    for i in range(6):
        step[i] /= T


@njit(cache=True)
def _add_command_work(command, sign, memory):
    step = np.empty(6)
    fields.pose_difference_into(command, memory[_LAST_COMMAND_POSE], step)
    for g in range(2):
        work = sign * dot_of_group(memory[slots.LAST_PORT_WRENCH], step, g)
        into = work if work * sign > 0.0 else 0.0
        memory[_COMMAND_WORK_IN][g] += into
        memory[_COMMAND_WORK_OUT][g] += into - work


@njit(cache=True)
def record_command(requested, command, pose, twist, p, memory):
    for i in range(7):
        if command[i] != requested[i]:
            _add_command_work(requested, -1.0, memory)
            _add_command_work(command, 1.0, memory)
            copy_into(memory, slots.COMMAND_POSE.start, command, 0, 7)
            return
