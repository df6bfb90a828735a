"""Passivity method "two_layer": control with an energy tank at each end; docs/theory.md, (T37).

Franken et al., T-RO 27(4), 2011. A wrench may use no more energy in a step than the tank contains.
"""

from dataclasses import dataclass

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.packet import dot_of_group, fill_packet, length_of_group

# Parameters; pairs are for translation and rotation.
_parameter_slots = slots.own_parameters()
_SEND_RATE, _MAX_TANK_DRAIN_RATE = _parameter_slots.numbers(2)
_INITIAL_TANK_ENERGY, _TARGET_TANK_LEVEL, _TANK_CAPACITY = map(_parameter_slots.vector, [2] * 3)
_DAMPING_PER_MISSING_ENERGY, MAX_PORT_ACCELERATION = map(_parameter_slots.vector, (2, 2))
_RESERVE_TANK_SHARE = 0.01  # share of the capacity
# Memory of the slave: wrench of the spring, wrench of the damper.
_memory_slots = slots.own_memory()
_SERVO_SPRING_WRENCH, _SERVO_DAMPER_WRENCH = map(_memory_slots.vector, (6, 6))


@settings
@dataclass
class TwoLayerConfig:
    """Parameters of the passivity method "two_layer"."""

    send_rate: float = quantity(5.0, "1/s", 0.0, 1e6, "share of a tank that is sent in a second")
    drain_rate: float = quantity(
        10.0, "1/s", 0.0, 1e6, "share of the master's tank that the wrench may use in a second"
    )
    initial: list[float] = quantity([0.01, 2e-4], "J", 0.0, 1e3, "energy of a tank at the start")
    level: list[float] = quantity(
        [0.01, 2e-4], "J", 0.0, 1e3,
        "level below which a damper on the hand fills the master's tank",
    )  # fmt: skip
    capacity: list[float] = quantity(
        [0.015, 3e-4], "J", 0.0, 1e6, "largest energy of a tank; any excess is discarded"
    )
    damper: list[float] = quantity(
        [500.0, 100.0], "N s/m/J, N m s/rad/J", 0.0, 1e6, "damping of the hand per missing energy"
    )
    acceleration: list[float] = quantity(
        [20.0, 200.0], "m/s^2, rad/s^2", 0.0, 1e6, "a_max, largest acceleration of either end"
    )

    def pack_into(self, p: Array) -> None:
        p[_SEND_RATE], p[_MAX_TANK_DRAIN_RATE] = self.send_rate, self.drain_rate
        p[_INITIAL_TANK_ENERGY], p[_TARGET_TANK_LEVEL] = self.initial, self.level
        p[_TANK_CAPACITY] = self.capacity
        p[_DAMPING_PER_MISSING_ENERGY], p[MAX_PORT_ACCELERATION] = self.damper, self.acceleration


@njit(cache=True)
def initialize(p, memory):
    memory[slots.STORED_ENERGY] = p[_INITIAL_TANK_ENERGY]


@njit(cache=True)
def _update_tank_and_send_energy(received, dx, T, p, memory, packet):
    ledger, sent_so_far = memory[slots.STORED_ENERGY], memory[slots.SENT_ENERGY]
    held, capacity = memory[slots.LAST_PORT_WRENCH], p[_TANK_CAPACITY]
    for g in range(2):
        level = ledger[g] - dot_of_group(held, dx, g)
        level += fields.count_newly_received_energy(g, received, memory)
        sent = min(T * p[_SEND_RATE], 1.0) * max(level - _RESERVE_TANK_SHARE * capacity[g], 0.0)
        level -= sent
        lost = max(level - capacity[g], 0.0)
        sent_so_far[g] += sent
        memory[slots.DISSIPATED_ENERGY][g] += lost
        ledger[g] = level - lost
        packet[fields.CUMULATIVE_ENERGY][g] = sent_so_far[g]


@njit(cache=True)
def _max_work_in_period_of_group(wrench, dx, g, acceleration, T):
    return dot_of_group(wrench, dx, g) + length_of_group(wrench, g) * acceleration * T * T


@njit(cache=True)
def _limit_wrench_to_tank_energy(wrench, dx, g, acceleration, T, memory):
    cost = _max_work_in_period_of_group(wrench, dx, g, acceleration, T)
    level = max(memory[slots.STORED_ENERGY][g], 0.0)
    if cost > level:
        fields.scale_group(wrench, g, level / cost)


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    _update_tank_and_send_energy(received, dx, T, p, memory, packet)
    ledger, requested = memory[slots.STORED_ENERGY], received[fields.WRENCH]
    for g in range(2):
        damping = p[_DAMPING_PER_MISSING_ENERGY][g] * max(p[_TARGET_TANK_LEVEL][g] - ledger[g], 0.0)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = requested[i] - damping * twist[i]
        fields.limit_group(wrench, g, limits[g])
        work_on_hand = dot_of_group(wrench, dx, g)
        drainable = min(T * p[_MAX_TANK_DRAIN_RATE], 1.0) * max(ledger[g], 0.0)
        if work_on_hand > drainable:
            fields.scale_group(wrench, g, drainable / work_on_hand)
        _limit_wrench_to_tank_energy(wrench, dx, g, p[MAX_PORT_ACCELERATION][g], T, memory)
    fill_packet(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    spring, brake = memory[_SERVO_SPRING_WRENCH], memory[_SERVO_DAMPER_WRENCH]
    _update_tank_and_send_energy(received, dx, T, p, memory, packet)
    target = memory[slots.COMMAND_POSE]
    if fields.has_packet_arrived(received):
        target = received[fields.POSE]
    fields.pose_difference_into(target, pose, spring)
    motor_wrench, K, D = memory[slots.LAST_PORT_WRENCH], p[slots.SERVO_K], p[slots.SERVO_D]
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            spring[i] *= K[g]
            brake[i] = -D[g] * twist[i]
            motor_wrench[i] = spring[i] + brake[i]
        mass, own_acceleration = p[slots.SLAVE_MASS][g], p[MAX_PORT_ACCELERATION][g]
        # The spring is shortened first and leaves the reserve, so that an empty tank can brake.
        kept = _RESERVE_TANK_SHARE * p[_TANK_CAPACITY][g]
        available = max(memory[slots.STORED_ENERGY][g] - kept, 0.0)
        acceleration = own_acceleration + length_of_group(motor_wrench, g) / mass
        if _max_work_in_period_of_group(motor_wrench, dx, g, acceleration, T) > available:
            acceleration = own_acceleration + length_of_group(brake, g) / mass
            available -= _max_work_in_period_of_group(brake, dx, g, acceleration, T)
            acceleration = own_acceleration + length_of_group(spring, g) / mass
            cost = _max_work_in_period_of_group(spring, dx, g, acceleration, T)
            share = min(max(available / cost, 0.0), 1.0) if cost > 0.0 else 0.0
            for i in range(3 * g, 3 * g + 3):
                motor_wrench[i] = share * spring[i] + brake[i]
            acceleration = own_acceleration + length_of_group(motor_wrench, g) / mass
            _limit_wrench_to_tank_energy(motor_wrench, dx, g, acceleration, T, memory)
        for i in range(3 * g, 3 * g + 3):
            spring[i] = (motor_wrench[i] - brake[i]) / K[g]
    fields.move_pose_into(pose, spring, memory[slots.COMMAND_POSE])
    copy_into(memory, slots.COMMAND_TWIST.start, received, fields.VELOCITY.start, 6)
    copy_into(command, 0, memory, slots.COMMAND.start, 13)
    fill_packet(pose, twist, wrench, packet)


@njit(cache=True)
def record_command(requested, command, pose, twist, p, memory):
    spring, held = memory[_SERVO_SPRING_WRENCH], memory[slots.LAST_PORT_WRENCH]
    K, D = p[slots.SERVO_K], p[slots.SERVO_D]
    fields.pose_difference_into(command, pose, spring)
    for i in range(6):
        held[i] = K[i // 3] * spring[i] - D[i // 3] * twist[i]
