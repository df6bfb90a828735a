"""Passivity method "wave": wave variables (Anderson and Spong 1989; Niemeyer and Slotine 1991).

docs/theory.md, (T33) to (T36). Packets contain the integral of the wave. The receiver filters it
and uses at most the received energy, so jitter and loss create no energy.
"""

import math
from dataclasses import dataclass

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.packet import dot_of_group, fill_packet, limit_group

# Parameters.
_parameter_slots = slots.own_parameters()
WAVE_IMPEDANCE = _parameter_slots.vector(2)
_WAVE_FILTER_TIME, _MATCHING_DAMPER_SHARE = _parameter_slots.numbers(2)
_MAX_SILENCE_BEFORE_HOLD, _POSE_DRIFT_CORRECTION_RATE = _parameter_slots.numbers(2)
# Memory: integrals of the output wave and of the sent wave; wave of this step; silence [s].
_memory_slots = slots.own_memory()
_FILTERED_WAVE_INTEGRAL, _SENT_WAVE_INTEGRAL, _FILTERED_WAVE = map(_memory_slots.vector, [6] * 3)
_SILENCE_TIME, _POSE_DRIFT = _memory_slots.number(), _memory_slots.vector(6)
# At the master: 1 from a missing packet until the wrench has caught up; newest packet number.
_IS_WRENCH_CATCHING_UP, _NEWEST_PACKET_NUMBER = _memory_slots.numbers(2)


@settings
@dataclass
class WaveConfig:
    """Parameters of the wave variables."""

    impedance: list[float] = quantity(
        [10.0, 0.05], "N s/m, N m s/rad", 1e-6, 1e6,
        "wave impedance b, for translation and rotation",
    )  # fmt: skip
    filter: float = quantity(
        0.003, "s", 0.0, 10.0, "time constant of the filter of the received wave, at both ends"
    )
    matching: float = quantity(
        1.0, "1", 0.0, 100.0, "damping at the slave's end divided by b; at 1 it reflects no wave"
    )
    patience: float = quantity(
        0.03, "s", 0.0, 10.0,
        "time without packets after which the slave keeps its command until the next packet",
    )  # fmt: skip
    drift_rate: float = quantity(
        2.0, "1/s", 0.0, 1e3, "rate of the pose drift correction, only while it takes no energy"
    )

    def pack_into(self, p: Array) -> None:
        p[WAVE_IMPEDANCE], p[_WAVE_FILTER_TIME] = self.impedance, self.filter
        p[_MATCHING_DAMPER_SHARE], p[_MAX_SILENCE_BEFORE_HOLD] = self.matching, self.patience
        p[_POSE_DRIFT_CORRECTION_RATE] = self.drift_rate


@njit(cache=True)
def _filter_received_wave(received, T, p, memory):
    ledger, played = memory[slots.STORED_ENERGY], memory[_FILTERED_WAVE_INTEGRAL]
    wave, integral = memory[_FILTERED_WAVE], received[fields.METHOD_VALUES]
    for g in range(2):
        ledger[g] += fields.count_newly_received_energy(g, received, memory)
        for i in range(3 * g, 3 * g + 3):
            wave[i] = integral[i] - played[i]
        left, store = dot_of_group(wave, wave, g), 2.0 * T * ledger[g]
        share = T / (T + p[_WAVE_FILTER_TIME])
        if share * left > (2.0 - share) * store:
            share = 2.0 * store / (left + store)
        for i in range(3 * g, 3 * g + 3):
            played[i] += share * wave[i]
            wave[i] *= share / T
        ledger[g] = max(ledger[g] - 0.5 * T * dot_of_group(wave, wave, g), 0.0)


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    wave, integral = memory[_FILTERED_WAVE], memory[_SENT_WAVE_INTEGRAL]
    _filter_received_wave(received, T, p, memory)
    catching_up, newest = memory[_IS_WRENCH_CATCHING_UP], received[fields.PACKET_NUMBER]
    if newest > memory[_NEWEST_PACKET_NUMBER] + 1.0:
        catching_up = 1.0
    memory[_IS_WRENCH_CATCHING_UP], memory[_NEWEST_PACKET_NUMBER] = 0.0 if fresh else 1.0, newest
    for g in range(2):
        b = p[WAVE_IMPEDANCE][g]
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = math.sqrt(2.0 * b) * wave[i] - b * dx[i] / T
            # The integral ignores the wrench limit, so that no momentum is missing on the line.
            integral[i] += (b * dx[i] - wrench[i] * T) / math.sqrt(2.0 * b)
        limit_group(wrench, g, limits[g])
        energy = 0.5 * T * dot_of_group(wave, wave, g)
        if catching_up > 0.0:
            most = fields.MAX_HAND_WRENCH_RATES[g] * T / p[slots.SLAVE_PER_MASTER_MOTION][g]
            if _limit_wrench_change(g, energy, dx, most, memory[slots.LAST_PORT_WRENCH], wrench):
                memory[_IS_WRENCH_CATCHING_UP] = 1.0
            limit_group(wrench, g, limits[g])
        # Shortening a wrench leaves more energy than the reflected wave has, so `left` is >= 0.
        left = energy - dot_of_group(wrench, dx, g)
        memory[slots.SENT_ENERGY][g] += max(left, 0.0)
    copy_into(packet, fields.METHOD_VALUES.start, memory, _SENT_WAVE_INTEGRAL.start, 6)
    copy_into(packet, fields.CUMULATIVE_ENERGY.start, memory, slots.SENT_ENERGY.start, 2)
    fill_packet(pose, twist, wrench, packet)


@njit(cache=True)
def _limit_wrench_change(g, energy, dx, max_change, last_wrench, wrench):
    size = 0.0
    for i in range(3 * g, 3 * g + 3):
        size += (wrench[i] - last_wrench[i]) ** 2
    if size <= max_change * max_change:
        return False
    share = max_change / math.sqrt(size)
    now, last = energy - dot_of_group(wrench, dx, g), energy - dot_of_group(last_wrench, dx, g)
    if (1.0 - share) * last + share * now < 0.0:
        share = last / (last - now) if now > 0.0 else 1.0
    for i in range(3 * g, 3 * g + 3):
        wrench[i] = last_wrench[i] + share * (wrench[i] - last_wrench[i])
    return True


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    now, step = memory[slots.COMMAND_POSE], memory[slots.COMMAND_TWIST]
    memory[_SILENCE_TIME] = 0.0 if fresh else memory[_SILENCE_TIME] + T
    if memory[slots.CHANNEL_FILL_TIME_LEFT] > 0.0:
        memory[slots.CHANNEL_FILL_TIME_LEFT] -= T
        step[:] = 0.0
        _reflect_wave_while_channel_fills(received, wrench, T, p, memory)
    elif memory[_SILENCE_TIME] <= p[_MAX_SILENCE_BEFORE_HOLD]:
        _apply_and_reflect_wave(received, wrench, T, p, memory)
        if fields.has_packet_arrived(received):
            _correct_pose_drift(received, wrench, T, p, memory)
        fields.move_pose_into(now, step, now)
        for i in range(6):
            step[i] /= T
    else:
        step[:] = 0.0
        _reflect_wave_during_silence(wrench, T, p, memory)
    copy_into(packet, fields.METHOD_VALUES.start, memory, _SENT_WAVE_INTEGRAL.start, 6)
    copy_into(packet, fields.CUMULATIVE_ENERGY.start, memory, slots.SENT_ENERGY.start, 2)
    copy_into(command, 0, memory, slots.COMMAND.start, 13)
    copy_into(memory, slots.LAST_PORT_WRENCH.start, wrench, 0, 6)
    fill_packet(pose, twist, wrench, packet)


@njit(cache=True)
def _apply_and_reflect_wave(received, wrench, T, p, memory):
    wave, step = memory[_FILTERED_WAVE], memory[slots.COMMAND_TWIST]
    integral = memory[_SENT_WAVE_INTEGRAL]
    _filter_received_wave(received, T, p, memory)
    for g in range(2):
        b, damper = p[WAVE_IMPEDANCE][g], p[_MATCHING_DAMPER_SHARE] * p[WAVE_IMPEDANCE][g]
        for i in range(3 * g, 3 * g + 3):
            step[i] = T * (math.sqrt(2.0 * b) * wave[i] + wrench[i]) / (b + damper)
            integral[i] += T * wave[i] + math.sqrt(2.0 / b) * (T * wrench[i] - damper * step[i])
        damped = damper * dot_of_group(step, step, g) / T
        left = 0.5 * T * dot_of_group(wave, wave, g) + dot_of_group(wrench, step, g) - damped
        memory[slots.DISSIPATED_ENERGY][g] += damped
        memory[slots.SENT_ENERGY][g] += max(left, 0.0)


@njit(cache=True)
def _reflect_wave_during_silence(wrench, T, p, memory):
    wave, ledger = memory[_FILTERED_WAVE], memory[slots.STORED_ENERGY]
    played, integral = memory[_FILTERED_WAVE_INTEGRAL], memory[_SENT_WAVE_INTEGRAL]
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            wave[i] = -wrench[i] / math.sqrt(2.0 * p[WAVE_IMPEDANCE][g])
        energy = 0.5 * T * dot_of_group(wave, wave, g)
        if energy <= ledger[g]:
            ledger[g] -= energy
            memory[slots.SENT_ENERGY][g] += energy
            for i in range(3 * g, 3 * g + 3):
                played[i] += T * wave[i]
                integral[i] -= T * wave[i]


@njit(cache=True)
def _reflect_wave_while_channel_fills(received, wrench, T, p, memory):
    wave, accounted = memory[_FILTERED_WAVE], memory[slots.RECEIVED_ENERGY]
    ledger, played = memory[slots.STORED_ENERGY], memory[_FILTERED_WAVE_INTEGRAL]
    integral = memory[_SENT_WAVE_INTEGRAL]
    for g in range(2):
        accounted[g] = max(accounted[g], received[fields.CUMULATIVE_ENERGY][g])
        for i in range(3 * g, 3 * g + 3):
            wave[i] = -wrench[i] / math.sqrt(2.0 * p[WAVE_IMPEDANCE][g])
            integral[i] -= T * wave[i]
            played[i] = received[fields.METHOD_VALUES][i] - p[_WAVE_FILTER_TIME] * wave[i]
        memory[slots.SENT_ENERGY][g] += 0.5 * T * dot_of_group(wave, wave, g)
        ledger[g] = 0.5 * (T + p[_WAVE_FILTER_TIME]) * dot_of_group(wave, wave, g)


@njit(cache=True)
def _correct_pose_drift(received, wrench, T, p, memory):
    drift, step = memory[_POSE_DRIFT], memory[slots.COMMAND_TWIST]
    fields.pose_difference_into(received[fields.POSE], memory[slots.COMMAND_POSE], drift)
    for g in range(2):
        if dot_of_group(wrench, drift, g) >= 0.0:
            for i in range(3 * g, 3 * g + 3):
                step[i] += min(T * p[_POSE_DRIFT_CORRECTION_RATE], 1.0) * drift[i]
