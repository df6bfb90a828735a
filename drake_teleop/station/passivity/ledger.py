"""Master's end of method "ledger": steps M1 to M7 of docs/theory.md, "The energy ledger"."""

import math
from dataclasses import dataclass

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import ledger_slave as shared
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.ledger_slave import work_along, wrench_component_along
from drake_teleop.station.passivity.packet import dot_of_group, length_of_group, limit_group

# docs/theory.md, "The energy ledger", lists the purpose of each constant.
_HAND_VELOCITY_FILTER_S = 4e-3
_PREDICTED_TO_FITTED_STIFFNESS_RATIO = 1.1
_MAX_WALL_STIFFNESS, _MIN_WALL_STIFFNESS = 2500.0, 50.0  # N/m
_HAND_EXTRAPOLATION_PERIODS = 2.0
_HAND_OFFSET_DECAY_TIME_S = 0.3
_FRICTION_COEFFICIENT_FORGETTING_S = 1.0
_MIN_FRICTION_RELAXATION_S, _FRICTION_SLIP_SPEED = 0.1, 1e-3
_FRICTION_TORQUE_RELAXATION_S, _FRICTION_TORQUE_RELAXATION_ROUND_TRIPS = 0.6, 30.0
_ROTATION_FRICTION_STIFFNESS_FACTOR, _MAX_FRICTION_COEFFICIENT = 4.0, 1.0
_MIN_NORM_WEIGHT = 1e-12  # the metric of rotation is 0 where rotation is not transmitted
_MAX_PREDICTED_FORCE_EXCESS_N = 3.0
_MAX_LAST_WALL_FORCE_N = 10.0
_MAX_SAME_WALL_DISTANCE_M, _MIN_SAME_WALL_COSINE = 5e-3, 0.7
_MAX_FORGET_WALL_DEPTH_M, _FORGET_WALL_FORCE_N, _MIN_FORGET_WALL_DEPTH_M = 3e-3, 1.0, 1e-3
_MIN_WALL_IMPULSE_DEPTH_M, _MAX_MISSING_IMPULSE_NS = 0.3e-3, 0.03
_MIN_RESERVE_SHARE_TO_SEND_HAND_WORK = 0.5  # of the master's reserve
_UNUSED_MASTER_RESERVE_SHARE = 0.05  # of the master's reserve
_MAX_SPENT_SHARE_PER_S = 50.0  # 1/s
_RETREAT_DISTANCE_TO_ZERO_FORCE_M = 0.03
_LIMITED_WRENCH_RECOVERY_S = 0.1
_ASSUMED_HAND_ACCELERATION_M_PER_S2 = 5.0  # m/s^2
_FULL_DRAG_HAND_SPEED_M_PER_S = 0.02  # m/s
_DECAY_TIME_AT_HAND_REST_S = 0.1
_HAND_DEADBAND_WIDTH_ENCODER_STEPS = 1.1
# Shares of a reserve below and above which the drag begins and ends.
_DRAG_ON_LEVEL, _DRAG_OFF_LEVEL = 1.0 - shared.SLAVE_RESERVE_SHARE_AT_MASTER, 1.0 - 1e-9
_HAND_BRAKE_FORCE_N, _FULL_BRAKE_HAND_SPEED, _NO_BRAKE_HAND_SPEED = 0.5, 0.1, 0.05  # N, m/s, m/s

# Memory. The first places are those of `ledger_slave`, up to `CONTACT_DIRECTION`.
_memory_slots = slots.own_memory()
_memory_slots.vector(shared.CONTACT_DIRECTION.stop - shared.FILTERED_OWN_VELOCITY.start)
# Pose difference of hand and slave at the onset of contact. Remembered wall: direction into it,
# stiffness (0: no wall), depth of the hand in it, missing impulse of the slave in it.
_HAND_OFFSET_AT_CONTACT_ONSET, _DIRECTION_INTO_WALL = map(_memory_slots.vector, (6, 6))
_WALL_STIFFNESS, _HAND_WALL_DEPTH, _MISSING_WALL_IMPULSE = _memory_slots.numbers(3)
# Modelled friction at the motion of the hand and of the slave; measured minus modelled friction.
_MODEL_FRICTION_AT_HAND, _MODEL_FRICTION_AT_SLAVE = map(_memory_slots.vector, (6, 6))
_UNMODELLED_FRICTION, _FRICTION_COEFFICIENT = map(_memory_slots.vector, (6, 2))
_HAND_RETREAT_DISTANCE_INDEX = _memory_slots.number()  # out of the wall since the last rest
_LAST_SLAVE_POSE, _SLAVE_DISPLACEMENT = map(_memory_slots.vector, (7, 6))
# Work on the hand since its last rest; withheld share of the wrench.
_WORK_ON_HAND_SINCE_REST, _WITHHELD_WRENCH_SHARE = map(_memory_slots.vector, (2, 2))
_DRAG_ACTIVE_SLICE = _memory_slots.vector(2)
_HAND_MOTION_IN_DEADBAND, _HAND_STEP_BEYOND_DEADBAND = map(_memory_slots.vector, (6, 6))
# Number of the newest packet; 1 while the wrench cross-fades; wrench before the energy limit.
_LAST_RECEIVED_PACKET_NUMBER = _memory_slots.number()
_IS_WRENCH_CROSS_FADING = _memory_slots.vector(2)
_LAST_UNLIMITED_WRENCH_SLICE = _memory_slots.vector(6)


@settings
@dataclass
class LedgerConfig:
    """Parameters of the passivity method "ledger"."""

    initial: list[float] = quantity(
        [0.12, 0.011], "J", 0.0, 1e3,
        "energy E_0 of both ends together at the start; `drag` on the hand then fills the reserves",
    )  # fmt: skip
    reserve: list[float] = quantity(
        [0.1, 0.01], "J", 1e-9, 1e3,
        "energy reserve of the slave; bounds its kinetic energy and so its speed",
    )  # fmt: skip
    hand_reserve: list[float] = quantity(
        [0.02, 1e-3], "J", 1e-9, 1e3, "energy that the master keeps, to push the hand"
    )
    drag: list[float] = quantity(
        [0.28, 5e-3], "N, N m", 0.0, 10.0, "drag on the hand until both reserves are full"
    )
    touch: list[float] = quantity(
        [0.01, 1e-3], "N, N m", 0.0, 1e3, "smallest wrench at the hand that counts as contact"
    )
    encoder_step: list[float] | None = quantity(
        None, "m, rad", 0.0, 0.1,
        "position and rotation step of the device's encoders; null: as in the device's data sheet",
        length=2,
    )  # fmt: skip

    def pack_into(self, p: Array) -> None:
        p[shared.INITIAL_LEDGER_ENERGY] = self.initial
        p[shared.SLAVE_RESERVE], p[shared.MASTER_RESERVE] = self.reserve, self.hand_reserve
        scales = p[slots.SLAVE_PER_MASTER_MOTION]
        p[shared.DRAG_WRENCH], p[shared.CONTACT_THRESHOLD] = self.drag / scales, self.touch / scales
        p[shared.ENCODER_STEP] = np.multiply(self.encoder_step or [0.0, 0.0], scales)
        p[shared.NORM_WEIGHTS_SLICE] = (shared.ANGLE_PER_LENGTH * scales / scales[0]) ** 2


def initialize(p: Array, memory: Array) -> None:
    """Store this end's half of the initial energy; start its servo model at the command."""
    memory[slots.STORED_ENERGY] = p[shared.INITIAL_LEDGER_ENERGY] / 2.0
    memory[shared.SERVO_MODEL_POSE] = memory[slots.COMMAND_POSE]


def max_slave_speed(config: LedgerConfig, mass: Array) -> Array:
    """Return the largest speed (2,) of the slave that its energy reserve permits [m/s, rad/s].

    `mass` (2,) is the slave's mass and inertia in the master's power units [kg, kg m^2].
    """
    left = (1.0 - shared.UNUSED_SLAVE_RESERVE_SHARE) * np.asarray(config.reserve)
    return np.sqrt(2.0 * left / (shared.SLAVE_MASS_FACTOR * mass))


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    velocity, offset_to_slave = memory[shared.FILTERED_OWN_VELOCITY], wrench  # overwritten below
    _store_hand_step_beyond_deadband(dx, p, memory)
    steady = memory[_HAND_STEP_BEYOND_DEADBAND]
    for i in range(6):
        offset_to_slave[i] = steady[i] / T
    shared.filter_own_velocity(offset_to_slave, min(T / _HAND_VELOCITY_FILTER_S, 1.0), memory)
    memory[_HAND_WALL_DEPTH] += work_along(memory[_DIRECTION_INTO_WALL], steady)
    inside = memory[_WALL_STIFFNESS] > 0.0 and memory[_HAND_WALL_DEPTH] > 0.0
    for g in range(2):
        _update_master_energy(g, dx, inside or memory[shared.IN_CONTACT_FLAG] > 0.0, p, memory)
        memory[slots.STORED_ENERGY][g] += fields.count_newly_received_energy(g, received, memory)
    offset_to_slave[:] = 0.0
    if fields.has_packet_arrived(received):
        fields.pose_difference_into(pose, received[fields.POSE], offset_to_slave)
        for i in range(6):
            offset_to_slave[i] -= memory[_HAND_MOTION_IN_DEADBAND][i]
    _predict_contact_wrench_into(received, steady, T, p, memory, offset_to_slave, wrench)
    for i in range(6):
        wrench[i] += received[fields.PACKET_LOAD_WRENCH][i]
    newest = received[fields.PACKET_NUMBER]
    if newest > memory[_LAST_RECEIVED_PACKET_NUMBER] + 1.0:
        memory[_IS_WRENCH_CROSS_FADING] = 1.0
    memory[_LAST_RECEIVED_PACKET_NUMBER] = newest
    for g in range(2):
        _cross_fade_to_received_wrench_of_group(g, T, p, memory, wrench)
        limit_group(wrench, g, limits[g])
        _limit_group_wrench_to_stored_energy(g, dx, T, p, memory, wrench)
        level = p[shared.MASTER_RESERVE][g]
        if memory[shared.IN_CONTACT_FLAG] > 0.0:
            level += shared.SLAVE_RESERVE_SHARE_AT_MASTER * p[shared.SLAVE_RESERVE][g]
        surplus = max(memory[slots.STORED_ENERGY][g] - level, 0.0)
        memory[slots.SENT_ENERGY][g] += surplus
        memory[slots.STORED_ENERGY][g] -= surplus
        _add_hand_drag(g, received, dx, T, p, memory, wrench)
        limit_group(wrench, g, limits[g])
        packet[fields.CUMULATIVE_ENERGY][g] = memory[slots.SENT_ENERGY][g]
        packet[shared.PACKET_LEDGER_LEVEL][g] = memory[slots.STORED_ENERGY][g]
    fields.fill_packet(pose, velocity, wrench, packet)
    for i in range(6):
        steady[i] = -memory[_HAND_MOTION_IN_DEADBAND][i]
    fields.move_pose_into(packet[fields.POSE], steady, packet[fields.POSE])
    packet[shared.NEWEST_SLAVE_PACKET] = received[fields.PACKET_NUMBER]


@njit(cache=True)
def _store_hand_step_beyond_deadband(dx, p, memory):
    """Store the hand's displacement beyond the encoder dead band (docs/theory.md, M2)."""
    lost, steady = memory[_HAND_MOTION_IN_DEADBAND], memory[_HAND_STEP_BEYOND_DEADBAND]
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            lost[i] += dx[i]
        size = length_of_group(lost, g)
        width = _HAND_DEADBAND_WIDTH_ENCODER_STEPS * p[shared.ENCODER_STEP][g]
        share = 1.0 - width / size if size > width else 0.0
        for i in range(3 * g, 3 * g + 3):
            steady[i] = share * lost[i]
            lost[i] -= steady[i]


@njit(cache=True)
def _update_master_energy(g, dx, in_contact, p, memory):
    work, ledger = dot_of_group(memory[slots.LAST_PORT_WRENCH], dx, g), memory[slots.STORED_ENERGY]
    memory[_WORK_ON_HAND_SINCE_REST][g] = max(memory[_WORK_ON_HAND_SINCE_REST][g] + work, 0.0)
    sending_level = _MIN_RESERVE_SHARE_TO_SEND_HAND_WORK * p[shared.MASTER_RESERVE][g]
    if work < 0.0 and in_contact and ledger[g] > sending_level:
        memory[slots.SENT_ENERGY][g] -= work
    else:
        ledger[g] -= work


@njit(cache=True)
def _predict_contact_wrench_into(received, dx, T, p, memory, offset_to_slave, wrench):
    """Write the contact wrench predicted for the hand's pose (docs/theory.md, M2, M3) to `wrench`.

    `offset_to_slave` (6,) is the hand's pose minus the slave's pose [m, rad].
    """
    contact_wrench, normal = received[fields.WRENCH], memory[shared.CONTACT_DIRECTION]
    inward = memory[_DIRECTION_INTO_WALL]
    stiffness = received[shared.PACKET_CONTACT_STIFFNESS]
    k = min(_PREDICTED_TO_FITTED_STIFFNESS_RATIO * stiffness, _MAX_WALL_STIFFNESS)
    if not shared.is_in_contact(contact_wrench, p):
        if memory[shared.IN_CONTACT_FLAG] > 0.0:
            memory[_IS_WRENCH_CROSS_FADING][:] = 1.0
        memory[shared.IN_CONTACT_FLAG] = 0.0
        removal_depth = _FORGET_WALL_FORCE_N / max(memory[_WALL_STIFFNESS], 1.0)
        removal_depth = min(_MAX_FORGET_WALL_DEPTH_M, max(removal_depth, _MIN_FORGET_WALL_DEPTH_M))
        slave_depth = memory[_HAND_WALL_DEPTH] - work_along(inward, offset_to_slave)
        excess = slave_depth - _MIN_WALL_IMPULSE_DEPTH_M
        memory[_MISSING_WALL_IMPULSE] += T * memory[_WALL_STIFFNESS] * excess
        if excess <= 0.0:
            memory[_MISSING_WALL_IMPULSE] = 0.0
        if memory[_WALL_STIFFNESS] > 0.0 and stiffness == 0.0:
            memory[_WALL_STIFFNESS] = 0.0
            memory[_IS_WRENCH_CROSS_FADING][:] = memory[_WORK_ON_HAND_SINCE_REST][:] = 0.0
        if slave_depth > removal_depth or memory[_MISSING_WALL_IMPULSE] > _MAX_MISSING_IMPULSE_NS:
            memory[_WALL_STIFFNESS] = 0.0
        force = memory[_WALL_STIFFNESS] * max(memory[_HAND_WALL_DEPTH], 0.0)
        for i in range(6):
            wrench[i] = -min(force, _MAX_LAST_WALL_FORCE_N) * inward[i]
        return
    memory[_MISSING_WALL_IMPULSE] = 0.0
    offset, onset = memory[_HAND_OFFSET_AT_CONTACT_ONSET], memory[shared.IN_CONTACT_FLAG] == 0.0
    mean_wrench = memory[shared.MEAN_CONTACT_WRENCH]
    if onset or not wrench_component_along(contact_wrench, mean_wrench, p) > 0.0:
        memory[_IS_WRENCH_CROSS_FADING][:] = 1.0
    round_trip, damper = received[shared.PACKET_ROUND_TRIP], received[shared.PACKET_CONTACT_DAMPING]
    size = shared.update_contact_direction(contact_wrench, round_trip, T, p, memory)
    speed = work_along(normal, received[fields.VELOCITY])
    depth = max(size + damper * speed, 0.0) / max(k, _MIN_WALL_STIFFNESS)
    depth -= work_along(normal, offset_to_slave)
    if onset:
        aligned = -wrench_component_along(normal, inward, p) > _MIN_SAME_WALL_COSINE
        same = memory[_WALL_STIFFNESS] > 0.0 and aligned
        near = abs(depth - memory[_HAND_WALL_DEPTH]) < _MAX_SAME_WALL_DISTANCE_M
        if same and (near or memory[_HAND_WALL_DEPTH] < 0.0):
            offset[:] = 0.0
        else:
            copy_into(offset, 0, offset_to_slave, 0, 6)
        memory[shared.IN_CONTACT_FLAG] = 1.0
        memory[_FRICTION_COEFFICIENT] = memory[_HAND_RETREAT_DISTANCE_INDEX] = 0.0
        for friction in (_MODEL_FRICTION_AT_HAND, _MODEL_FRICTION_AT_SLAVE, _UNMODELLED_FRICTION):
            memory[friction] = 0.0
        copy_into(memory, _LAST_SLAVE_POSE.start, received, fields.POSE.start, 7)
    fade = 1.0 - min(T / _HAND_OFFSET_DECAY_TIME_S, 1.0)
    for i in range(6):
        offset[i] *= fade
        offset_to_slave[i] -= offset[i]
    hand_speed = work_along(normal, memory[shared.FILTERED_OWN_VELOCITY])
    penetration = work_along(normal, offset_to_slave) + _HAND_EXTRAPOLATION_PERIODS * T * hand_speed
    force = size
    if size > 0.0:
        change = k * penetration + damper * (hand_speed - speed)
        force = min(max(size - change, 0.0), 2.0 * size + _MAX_PREDICTED_FORCE_EXCESS_N)
    # A hand that was let go moves out of a soft wall without end, so its force fades.
    retreat = max(memory[_HAND_RETREAT_DISTANCE_INDEX] + work_along(normal, dx), 0.0)
    if abs(hand_speed) < _FULL_DRAG_HAND_SPEED_M_PER_S:
        retreat *= 1.0 - min(T / _DECAY_TIME_AT_HAND_REST_S, 1.0)
    memory[_HAND_RETREAT_DISTANCE_INDEX] = retreat
    force *= min(max(3.0 * (1.0 - retreat / _RETREAT_DISTANCE_TO_ZERO_FORCE_M), 0.0), 1.0)
    last = memory[_LAST_SLAVE_POSE]
    fields.pose_difference_into(received[fields.POSE], last, memory[_SLAVE_DISPLACEMENT])
    copy_into(last, 0, received, fields.POSE.start, 7)
    _render_friction(T, max(size, 1e-12), min(force, size), received, dx, p, memory, wrench)
    for i in range(6):
        wrench[i] += force * normal[i]
    if k > _MIN_WALL_STIFFNESS:
        memory[_WALL_STIFFNESS], memory[_HAND_WALL_DEPTH] = k, depth
        for i in range(6):
            inward[i] = -normal[i]


@njit(cache=True)
def _render_friction(T, slave_force, hand_force, received, dx, p, memory, wrench):
    """Write the friction to render at the hand into `wrench` (6,), docs/theory.md (T68).

    It is modelled friction at the hand plus (measured - modelled) friction at the slave.
    `slave_force` and `hand_force` are normal forces [N].
    """
    near, far = memory[_MODEL_FRICTION_AT_HAND], memory[_MODEL_FRICTION_AT_SLAVE]
    rest, normal = memory[_UNMODELLED_FRICTION], memory[shared.CONTACT_DIRECTION]
    slave_step, cone = memory[_SLAVE_DISPLACEMENT], memory[_FRICTION_COEFFICIENT]
    step, far_step = work_along(normal, dx), work_along(normal, slave_step)
    copy_into(wrench, 0, received, fields.WRENCH.start, 6)
    _remove_component_along_contact_direction(wrench, p, memory)
    round_trip = received[shared.PACKET_ROUND_TRIP]
    decay = min(T / max(_FRICTION_COEFFICIENT_FORGETTING_S, 3.0 * round_trip), 1.0)
    for g in range(2):
        metric = max(p[shared.NORM_WEIGHTS_SLICE][g], _MIN_NORM_WEIGHT)
        spring, largest = _friction_stiffness(g, p), _MAX_FRICTION_COEFFICIENT / math.sqrt(metric)
        ratio = length_of_group(wrench, g) / slave_force
        cone[g] = max(cone[g] * (1.0 - decay), min(ratio, largest))
        least = _MIN_FRICTION_RELAXATION_S
        lag = cone[g] * slave_force / (_MAX_WALL_STIFFNESS * _FRICTION_SLIP_SPEED)
        if g == 1:
            least = _FRICTION_TORQUE_RELAXATION_S
            lag = _FRICTION_TORQUE_RELAXATION_ROUND_TRIPS * round_trip
        share = T / max(lag, least)
        for i in range(3 * g, 3 * g + 3):
            inward = metric * normal[i]
            far[i] -= spring * (slave_step[i] - far_step * inward) + share * far[i]
            near[i] -= spring * (dx[i] - step * inward) + share * near[i]
            rest[i] += share * (wrench[i] - far[i] - rest[i])
    for friction in (near, far, rest):
        _remove_component_along_contact_direction(friction, p, memory)
    for g in range(2):
        limit_group(far, g, cone[g] * slave_force)
        limit_group(near, g, cone[g] * hand_force)
        metric = max(p[shared.NORM_WEIGHTS_SLICE][g], _MIN_NORM_WEIGHT)
        for i in range(3 * g, 3 * g + 3):
            across = dx[i] - step * metric * normal[i]
            wrench[i] = near[i] + rest[i] - _friction_stiffness(g, p) * across
    _remove_component_along_contact_direction(wrench, p, memory)
    for g in range(2):
        limit_group(wrench, g, cone[g] * hand_force)


@njit(cache=True)
def _friction_stiffness(g, p):
    """Return the spring constant of the friction model for group `g` [N/m, N m/rad]."""
    factor = 1.0 if g == 0 else _ROTATION_FRICTION_STIFFNESS_FACTOR
    return factor * _MAX_WALL_STIFFNESS / max(p[shared.NORM_WEIGHTS_SLICE][g], _MIN_NORM_WEIGHT)


@njit(cache=True)
def _remove_component_along_contact_direction(wrench, p, memory):
    normal = memory[shared.CONTACT_DIRECTION]
    component = wrench_component_along(wrench, normal, p)
    for i in range(6):
        wrench[i] -= component * normal[i]


@njit(cache=True)
def _cross_fade_to_received_wrench_of_group(g, T, p, memory, wrench):
    last, fading = memory[_LAST_UNLIMITED_WRENCH_SLICE], memory[_IS_WRENCH_CROSS_FADING]
    for i in range(3 * g, 3 * g + 3):
        wrench[i] -= last[i]
    size = length_of_group(wrench, g)
    most = fields.MAX_HAND_WRENCH_RATES[g] * T / p[slots.SLAVE_PER_MASTER_MOTION][g]
    if fading[g] > 0.0 and size > most:
        fields.scale_group(wrench, g, most / size)
    else:
        fading[g] = 0.0
    for i in range(3 * g, 3 * g + 3):
        last[i] += wrench[i]
        wrench[i] = last[i]


@njit(cache=True)
def _limit_group_wrench_to_stored_energy(g, dx, T, p, memory, wrench):
    size, cost = length_of_group(wrench, g), 0.0
    if size > 0.0:
        displacement = dot_of_group(wrench, memory[shared.FILTERED_OWN_VELOCITY], g) / size * T
        cost = size * max(dot_of_group(wrench, dx, g) / size, displacement, 0.0)
        if displacement >= 0.0:
            cost += size * _ASSUMED_HAND_ACCELERATION_M_PER_S2 * shared.ANGLE_PER_LENGTH[g] * T * T
    unused = _UNUSED_MASTER_RESERVE_SHARE * p[shared.MASTER_RESERVE][g]
    most = min(T * _MAX_SPENT_SHARE_PER_S, 1.0) * max(memory[slots.STORED_ENERGY][g] - unused, 0.0)
    share = min(1.0, 1.0 - memory[_WITHHELD_WRENCH_SHARE][g] + T / _LIMITED_WRENCH_RECOVERY_S)
    if share * cost > most:
        share = most / cost
    memory[_WITHHELD_WRENCH_SHARE][g] = 1.0 - share
    if not cost > 0.0:
        share *= _max_braking_wrench_share(g, dx, T, p, memory)
    fields.scale_group(wrench, g, share)


@njit(cache=True)
def _max_braking_wrench_share(g, dx, T, p, memory):
    unused = _UNUSED_MASTER_RESERVE_SHARE * p[shared.MASTER_RESERVE][g]
    if memory[slots.STORED_ENERGY][g] >= unused:
        return 1.0
    velocity = memory[shared.FILTERED_OWN_VELOCITY]
    along, speed = dot_of_group(velocity, dx, g), length_of_group(velocity, g)
    return min(max(along, 0.0) / max(along, T * speed * speed, 1e-300), 1.0)


@njit(cache=True)
def _add_hand_drag(g, received, dx, T, p, memory, wrench):
    velocity, drag, active = memory[shared.FILTERED_OWN_VELOCITY], 0.0, memory[_DRAG_ACTIVE_SLICE]
    speed = length_of_group(velocity, g)
    own_level = memory[slots.STORED_ENERGY][g] / p[shared.MASTER_RESERVE][g]
    # Sent energy counts as arrived: its confirmation takes a round trip.
    slave_energy = received[shared.PACKET_LEDGER_LEVEL][g] + memory[slots.SENT_ENERGY][g]
    lowest = min(own_level, slave_energy / p[shared.SLAVE_RESERVE][g])
    in_contact = memory[shared.IN_CONTACT_FLAG] > 0.0
    if (in_contact and own_level < _DRAG_OFF_LEVEL) or (not in_contact and lowest < _DRAG_ON_LEVEL):
        active[g] = 1.0
    elif in_contact or lowest >= _DRAG_OFF_LEVEL:
        active[g] = 0.0
    if active[g] > 0.0:
        drag = p[shared.DRAG_WRENCH][g]
    full_drag_speed = _FULL_DRAG_HAND_SPEED_M_PER_S * shared.ANGLE_PER_LENGTH[g]
    if speed < full_drag_speed:
        memory[_WORK_ON_HAND_SINCE_REST][g] *= 1.0 - min(T / _DECAY_TIME_AT_HAND_REST_S, 1.0)
    if memory[_WORK_ON_HAND_SINCE_REST][g] > 0.0:
        excess = speed / shared.ANGLE_PER_LENGTH[g] - _NO_BRAKE_HAND_SPEED
        share = excess / (_FULL_BRAKE_HAND_SPEED - _NO_BRAKE_HAND_SPEED)
        drag = max(drag, _HAND_BRAKE_FORCE_N * shared.TORQUE_PER_FORCE[g] * min(share, 1.0))
    drag *= _max_braking_wrench_share(g, dx, T, p, memory)
    for i in range(3 * g, 3 * g + 3):
        wrench[i] -= drag * velocity[i] / max(speed, full_drag_speed)
