"""Slave's end of method "ledger": steps S1 to S6 of docs/theory.md, "The energy ledger"."""

from __future__ import annotations

import math

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import contact_fit
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.contact_fit import force_without_slip_steps, update_contact_fit
from drake_teleop.station.passivity.packet import dot_of_group, length_of_group, move_pose_into

# docs/theory.md, "The energy ledger", lists the purpose of each constant.
#: For translation and rotation: angle that equals a unit length, torque that equals a unit force.
ANGLE_PER_LENGTH, TORQUE_PER_FORCE = (1.0, 10.0), (1.0, 0.01)
UNUSED_SLAVE_RESERVE_SHARE = 0.03  #: share of the slave's reserve that is never used
SLAVE_RESERVE_SHARE_AT_MASTER = 0.7  #: of the slave's reserve, which the master may hold in contact
_MIN_SLAVE_RESERVE_SHARE_KEPT_AT_SLAVE = 0.05
_SERVO_STIFFNESS_FACTOR, _SERVO_DAMPING_FACTOR, SLAVE_MASS_FACTOR = 1.15, 0.9, 1.05
_MAX_SLAVE_ENERGY_TO_RESERVE_RATIO = 4.0  # in multiples of the reserve
_SLAVE_MEASUREMENT_FILTER_S = 3e-3
_MAX_SLAVE_REST_SPEED_M_PER_S = 0.05  # m/s
_ENERGY_SEND_RATE_AT_REST, _ENERGY_SEND_RATE = 5.0, 50.0  # 1/s
_STORED_DELAY_MAXIMUM_DECAY_S = 5.0
_MIN_STIFFNESS_AT_HAND, _MAX_STIFFNESS_AT_HAND = 300.0, 1200.0  # N/m
_ASSUMED_PRESS_SPEED_M_PER_S = 0.06  # m/s
_MIN_FIT_SAMPLE_LENGTH_M, _MIN_FAST_FIT_SAMPLE_LENGTH_M = 2e-4, 2e-3
_MIN_FIT_SPAN_M, _MAX_FIT_SPAN_M = 1e-3, 1e-2
_FASTER_FORGETTING_SPEED_M_PER_S = 0.15  # m/s
_STIFFNESS_SHARE_FILTER_S, _STIFFNESS_SHARE_DEADBAND = 0.02, 0.1
_MIN_FORCE_DROP_AT_WALL_REMOVAL_N = 0.3
_CONTACT_DIRECTION_FILTER_S = 3.0
_SLIP_FORCE_FADE_S, _FRICTION_DECAY_S = 0.6, 1.0
_STIFFNESS_GAIN_RISE_S, _STIFFNESS_GAIN_FALL_S = 0.5, 1.0
_MIN_STIFFNESS_GAIN, _MAX_STIFFNESS_GAIN = 0.1, 10.0
_COMMAND_FILTER_S, _MAX_COMMAND_ACCELERATION, _STOPPING_SPEED_FACTOR = 0.01, 30.0, 0.7  # s, m/s^2
_MAX_SILENCE_WITH_FEEDFORWARD_S = 0.02
_MAX_SILENCE_FOR_GAIN_ROUND_TRIPS, _MAX_SILENCE_FOR_GAIN_S = 0.5, 0.06
_MOTOR_ENERGY_PREDICTION_HORIZON_S = 4e-3
_MAX_SLAVE_FORCE_WITHOUT_HAND_ENERGY_N = 5.0
_SLAVE_STANDSTILL_SPEED, _MAX_SLAVE_DECELERATION = 2e-3, 20.0  # m/s, m/s^2

# Fields of the slave's packet: k_c, damping b, round trip. Of both packets: level of the sender's
# ledger. Of the master's packet: number of the newest packet from the slave.
_METHOD_PACKET_INDICES = range(fields.METHOD_VALUES.start, fields.METHOD_VALUES.stop)
PACKET_CONTACT_STIFFNESS, PACKET_CONTACT_DAMPING, PACKET_ROUND_TRIP = _METHOD_PACKET_INDICES[:3]
NEWEST_SLAVE_PACKET, PACKET_LEDGER_LEVEL = _METHOD_PACKET_INDICES[-1], fields.SENDER_ENERGY

# Parameters, in the master's power units.
_parameter_slots = slots.own_parameters()
INITIAL_LEDGER_ENERGY, SLAVE_RESERVE, MASTER_RESERVE = map(_parameter_slots.vector, [2] * 3)
DRAG_WRENCH, CONTACT_THRESHOLD, ENCODER_STEP = map(_parameter_slots.vector, [2] * 3)
NORM_WEIGHTS_SLICE = _parameter_slots.vector(2)  #: of squared force and torque in a wrench's norm
# Memory. Filtered velocity; 1 in contact; mean contact wrench and its direction; servo model.
_memory_slots = slots.own_memory()
FILTERED_OWN_VELOCITY, IN_CONTACT_FLAG = _memory_slots.vector(6), _memory_slots.number()
MEAN_CONTACT_WRENCH, CONTACT_DIRECTION = map(_memory_slots.vector, (6, 6))
SERVO_MODEL_POSE, _SERVO_MODEL_TWIST = map(_memory_slots.vector, (7, 6))
_MOTOR_WRENCH_SLICE = _memory_slots.vector(6)
_AVAILABLE_MOTOR_ENERGY, _ENERGY_IN_CONTACT = map(_memory_slots.vector, (2, 2))  # A, Q
# k and b of the contact; rho and its goal; c - 1; depth of the slave in the wall.
_CONTACT_STIFFNESS, _CONTACT_DAMPING = _memory_slots.numbers(2)
_STIFFNESS_SHARE, _STIFFNESS_SHARE_GOAL = _memory_slots.numbers(2)
_STIFFNESS_GAIN_MINUS_ONE, _SLAVE_WALL_DEPTH = _memory_slots.numbers(2)
# Fit of k and b: filtered force; force and speed at the start of the sample; its length and the
# lag of its filter; length of the fit and its sums.
_FILTERED_FORCE, _SAMPLE_START_FORCE, _SAMPLE_START_SPEED = _memory_slots.numbers(3)
_FIT_SAMPLE_LENGTH, _DISPLACEMENT_FILTER_LAG, _FIT_SPAN = _memory_slots.numbers(3)
_FIT_SUM_SLICE = _memory_slots.vector(contact_fit.NUM_CONTACT_FIT_SUMS)
# Present and longest time without packets, longest round trip, period [s].
_SILENCE_TIME, _LONGEST_SILENCE, _LONGEST_ROUND_TRIP, _PERIOD = _memory_slots.numbers(4)
_CONTACT_WRENCH, _FILTERED_LOAD_WRENCH = map(_memory_slots.vector, (6, 6))
# Rendered force along n; last speed into the wall; largest friction.
_RENDERED_FORCE, _LAST_SPEED_INTO_WALL, _MAX_FRICTION_FORCE = _memory_slots.numbers(3)


@njit(cache=True)
def filter_own_velocity(twist, new_weight, memory):
    """Low-pass filter the velocity of this end; `new_weight` is the weight of `twist` (6,)."""
    velocity = memory[FILTERED_OWN_VELOCITY]
    for i in range(6):
        velocity[i] += new_weight * (twist[i] - velocity[i])


@njit(cache=True)
def is_in_contact(wrench, p):
    threshold = p[CONTACT_THRESHOLD]
    return length_of_group(wrench, 0) > threshold[0] or length_of_group(wrench, 1) > threshold[1]


@njit(cache=True)
def wrench_component_along(a, b, p):
    """Return the component [N] of wrench `a` (6,) along `b` (6,) of weighted norm 1."""
    weights = p[NORM_WEIGHTS_SLICE]
    return weights[0] * dot_of_group(a, b, 0) + weights[1] * dot_of_group(a, b, 1)


@njit(cache=True)
def work_along(wrench, displacement):
    """Return wrench (6,) times displacement (6,): work [J]; for a unit wrench a length [m]."""
    return dot_of_group(wrench, displacement, 0) + dot_of_group(wrench, displacement, 1)


@njit(cache=True)
def update_contact_direction(wrench, round_trip, T, p, memory):
    """Update the contact's mean direction; return the component of `wrench` (6,) along it [N].

    The direction is a unit wrench. A much larger or opposite wrench replaces the mean at once.
    """
    mean, normal = memory[MEAN_CONTACT_WRENCH], memory[CONTACT_DIRECTION]
    rate = 1.0
    if memory[IN_CONTACT_FLAG] > 0.0:
        # A wrench far above the mean, which may be noise, replaces it at once.
        square = max(wrench_component_along(wrench, wrench, p), 1e-300)
        jump = 1.0 - 3.0 * math.sqrt(wrench_component_along(mean, mean, p) / square)
        rate = max(min(T / max(_CONTACT_DIRECTION_FILTER_S, 2.0 * round_trip), 1.0), jump)
        if not wrench_component_along(wrench, mean, p) > 0.0:  # another contact
            rate = 1.0
    for i in range(6):
        mean[i] += rate * (wrench[i] - mean[i])
    size = max(math.sqrt(wrench_component_along(mean, mean, p)), 1e-12)
    for i in range(6):
        normal[i] = mean[i] / size
    return wrench_component_along(wrench, normal, p)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    error, now, velocity = command[:6], memory[slots.COMMAND_POSE], memory[slots.COMMAND_TWIST]
    connected = fields.has_packet_arrived(received)
    memory[_PERIOD] = T
    memory[_SILENCE_TIME] = 0.0 if fresh else memory[_SILENCE_TIME] + T
    silence = memory[_SILENCE_TIME] if connected else 0.0
    kept = 1.0 - T / _STORED_DELAY_MAXIMUM_DECAY_S
    memory[_LONGEST_SILENCE] = max(memory[_LONGEST_SILENCE] * kept, silence)
    trip = (memory[slots.STEP_COUNT] - received[NEWEST_SLAVE_PACKET]) * T if connected else 0.0
    memory[_LONGEST_ROUND_TRIP] = max(memory[_LONGEST_ROUND_TRIP] * kept, trip, 0.0)
    filter_own_velocity(twist, min(T / _SLAVE_MEASUREMENT_FILTER_S, 1.0), memory)
    contact, load = memory[_CONTACT_WRENCH], memory[slots.LOAD_WRENCH]
    filtered = memory[_FILTERED_LOAD_WRENCH]
    for i in range(6):
        contact[i] = wrench[i] - load[i]
    in_contact = is_in_contact(contact, p)
    delay = memory[_LONGEST_ROUND_TRIP] + _servo_lag_s(p)
    share = min(T / delay, 1.0) if memory[slots.STEP_COUNT] > 0.0 else 1.0
    for i in range(6):
        filtered[i] += share * (load[i] - filtered[i])
    for g in range(2):
        _update_slave_energy(g, received, connected, in_contact, twist, dx, wrench, T, p, memory)
    _update_contact_fit_and_rendered_force(received, in_contact, dx, contact, T, p, memory)
    copy_into(memory, slots.LAST_PORT_WRENCH.start, wrench, 0, 6)
    error[:] = 0.0
    if connected:
        fields.pose_difference_into(received[fields.POSE], now, error)
    fields.pose_difference_into(now, pose, memory[_MOTOR_WRENCH_SLICE])
    _update_command_velocity(received, connected, T, p, memory, error)
    for i in range(6):
        error[i] = T * velocity[i]
    move_pose_into(now, error, now)
    _limit_command_to_motor_energy(now, pose, twist, p, memory)
    _advance_servo_model(received, connected, T, p, memory, error)
    copy_into(command, 0, memory, slots.COMMAND.start, 13)
    fields.fill_packet(memory[SERVO_MODEL_POSE], memory[_SERVO_MODEL_TWIST], contact, packet)
    if memory[IN_CONTACT_FLAG] > 0.0:
        normal = memory[CONTACT_DIRECTION]
        correction = memory[_RENDERED_FORCE] - wrench_component_along(contact, normal, p)
        for i in range(6):
            packet[fields.WRENCH][i] += correction * normal[i]
    copy_into(packet, fields.PACKET_LOAD_WRENCH.start, filtered, 0, 6)
    k, compliance = memory[_CONTACT_STIFFNESS], 0.0
    for g in range(2):
        size = length_of_group(memory[CONTACT_DIRECTION], g)
        compliance += size * size / (_SERVO_STIFFNESS_FACTOR * p[slots.SERVO_K][g])
        packet[fields.CUMULATIVE_ENERGY][g] = memory[slots.SENT_ENERGY][g]
        level = memory[slots.STORED_ENERGY][g] - memory[slots.RECEIVED_ENERGY][g]
        packet[PACKET_LEDGER_LEVEL][g] = level
    packet[PACKET_CONTACT_DAMPING] = memory[_CONTACT_DAMPING]
    packet[PACKET_ROUND_TRIP] = memory[_LONGEST_ROUND_TRIP]
    packet[PACKET_CONTACT_STIFFNESS] = memory[_STIFFNESS_SHARE] * k / (1.0 + k * compliance)


@njit(cache=True)
def _update_slave_energy(g, received, connected, in_contact, twist, dx, wrench, T, p, memory):
    # The wrench between two samples is unknown: the smaller of both works is credited.
    work = min(dot_of_group(wrench, dx, g), dot_of_group(memory[slots.LAST_PORT_WRENCH], dx, g))
    new = fields.count_newly_received_energy(g, received, memory)
    ledger, input_energy = memory[slots.STORED_ENERGY], memory[_ENERGY_IN_CONTACT]
    reserve = p[SLAVE_RESERVE][g]
    ledger[g] += new
    ledger[g] += work
    input_energy[g] = (input_energy[g] + work if in_contact else 0.0) + new
    speed = length_of_group(twist, g)
    kinetic = 0.5 * SLAVE_MASS_FACTOR * p[slots.SLAVE_MASS][g] * speed * speed
    # At rest in contact the hand needs the energy, otherwise motion needs it.
    keep, hold, rate = reserve, p[MASTER_RESERVE][g], _ENERGY_SEND_RATE
    free, returned = ledger[g] - kinetic, 0.0
    needed = missing = hold - received[PACKET_LEDGER_LEVEL][g]
    if in_contact and speed < _MAX_SLAVE_REST_SPEED_M_PER_S * ANGLE_PER_LENGTH[g]:
        keep, rate = (1.0 - SLAVE_RESERVE_SHARE_AT_MASTER) * reserve, _ENERGY_SEND_RATE_AT_REST
        needed += SLAVE_RESERVE_SHARE_AT_MASTER * reserve
        returned = min(free - _MIN_SLAVE_RESERVE_SHARE_KEPT_AT_SLAVE * reserve, missing)
    returned = max(returned, min(free - keep, needed), 0.0) * min(T * rate, 1.0)
    returned = returned if connected else 0.0
    lost = max(ledger[g] - returned - _MAX_SLAVE_ENERGY_TO_RESERVE_RATIO * reserve, 0.0)
    memory[slots.SENT_ENERGY][g] += returned
    memory[slots.DISSIPATED_ENERGY][g] += lost
    ledger[g] -= returned + lost
    memory[_AVAILABLE_MOTOR_ENERGY][g] = ledger[g] - kinetic


@njit(cache=True)
def _servo_lag_s(p):
    return 2.0 * math.sqrt(p[slots.SLAVE_MASS][0] / p[slots.SERVO_K][0])


@njit(cache=True)
def _update_max_stiffness_at_hand(received, T, p, memory):
    normal, fill_level = memory[CONTACT_DIRECTION], 0.0
    depth = _ASSUMED_PRESS_SPEED_M_PER_S * (memory[_LONGEST_ROUND_TRIP] + _servo_lag_s(p))
    base = math.inf
    for g in range(2):
        travel = ANGLE_PER_LENGTH[g] * length_of_group(normal, g) * depth
        reserve = p[MASTER_RESERVE][g]
        base = min(base, 2.0 * reserve / max(travel * travel, 1e-300))
        level = min(max(received[PACKET_LEDGER_LEVEL][g] / reserve, 0.0), 1.0)
        fill_level += p[NORM_WEIGHTS_SLICE][g] * dot_of_group(normal, normal, g) * level
    max_silence = _MAX_SILENCE_FOR_GAIN_ROUND_TRIPS * memory[_LONGEST_ROUND_TRIP]
    max_silence = min(max(_MAX_SILENCE_WITH_FEEDFORWARD_S, max_silence), _MAX_SILENCE_FOR_GAIN_S)
    goal = _MAX_STIFFNESS_GAIN * fill_level - 1.0
    if memory[_LONGEST_SILENCE] >= max_silence:
        goal = min(goal, 0.0)
    if memory[IN_CONTACT_FLAG] == 0.0:
        memory[_STIFFNESS_GAIN_MINUS_ONE] = 0.0
    else:
        change = max(goal, _MIN_STIFFNESS_GAIN - 1.0) - memory[_STIFFNESS_GAIN_MINUS_ONE]
        time_constant = _STIFFNESS_GAIN_RISE_S if change > 0.0 else _STIFFNESS_GAIN_FALL_S
        memory[_STIFFNESS_GAIN_MINUS_ONE] += T / time_constant * change
    gain = 1.0 + memory[_STIFFNESS_GAIN_MINUS_ONE]
    least = max(_MIN_STIFFNESS_AT_HAND, base) * min(gain, 1.0)
    return max(least, min(gain * base, _MAX_STIFFNESS_AT_HAND))


@njit(cache=True)
def _update_contact_fit_and_rendered_force(received, in_contact, dx, wrench, T, p, memory):
    normal, velocity = memory[CONTACT_DIRECTION], memory[FILTERED_OWN_VELOCITY]
    k = memory[_CONTACT_STIFFNESS]
    if not in_contact:
        if memory[IN_CONTACT_FLAG] > 0.0 and _is_wall_removed(dx, memory):
            memory[_STIFFNESS_SHARE] = 0.0
        memory[IN_CONTACT_FLAG] = memory[_FILTERED_FORCE] = memory[_MAX_FRICTION_FORCE] = 0.0
        return
    size = update_contact_direction(wrench, memory[_LONGEST_ROUND_TRIP], T, p, memory)
    k_d = _update_max_stiffness_at_hand(received, T, p, memory)
    max_change = _estimate_max_force_change_by_slip(wrench, size, T, p, memory)
    inward, rate = -work_along(normal, dx), min(T / _SLAVE_MEASUREMENT_FILTER_S, 1.0)
    speed = -work_along(normal, velocity)
    if memory[_FILTERED_FORCE] == 0.0:
        # Start at the first sample in contact, because the step to it was partly outside.
        memory[_FILTERED_FORCE] = memory[_SAMPLE_START_FORCE] = memory[_RENDERED_FORCE] = size
        memory[_DISPLACEMENT_FILTER_LAG] = inward
        memory[_SAMPLE_START_SPEED] = memory[_LAST_SPEED_INTO_WALL] = speed
        memory[_FIT_SAMPLE_LENGTH] = memory[_FIT_SPAN] = 0.0
        memory[_STIFFNESS_SHARE] = memory[_STIFFNESS_SHARE_GOAL] = k_d / max(k, k_d)
    filtered_step = rate * (inward - memory[_DISPLACEMENT_FILTER_LAG])
    memory[_DISPLACEMENT_FILTER_LAG] += filtered_step - inward
    memory[_FIT_SAMPLE_LENGTH] += filtered_step
    memory[_FILTERED_FORCE] += rate * (size - memory[_FILTERED_FORCE])
    tip_speed = length_of_group(velocity, 1) / ANGLE_PER_LENGTH[1]
    slow = math.hypot(length_of_group(velocity, 0), tip_speed) < _FASTER_FORGETTING_SPEED_M_PER_S
    length_m = abs(memory[_FIT_SAMPLE_LENGTH])
    if length_m > (_MIN_FIT_SAMPLE_LENGTH_M if slow else _MIN_FAST_FIT_SAMPLE_LENGTH_M):
        memory[_FIT_SPAN] = min(memory[_FIT_SPAN] + length_m, _MAX_FIT_SPAN_M)
        keep = max(1.0 - length_m / max(memory[_FIT_SPAN], _MIN_FIT_SPAN_M), 0.0) if slow else 0.5
        speed_change = speed - memory[_SAMPLE_START_SPEED]
        stretch, damping = memory[_FIT_SAMPLE_LENGTH], memory[_CONTACT_DAMPING]
        change = memory[_FILTERED_FORCE] - memory[_SAMPLE_START_FORCE] - damping * speed_change
        largest = max(2.0 * k, _MIN_STIFFNESS_AT_HAND) * stretch
        change -= contact_fit.force_change_by_slip(change, largest, max_change)
        change += damping * speed_change
        k, damping = update_contact_fit(memory[_FIT_SUM_SLICE], change, stretch, speed_change, keep)
        memory[_CONTACT_STIFFNESS], memory[_CONTACT_DAMPING] = k, damping
        memory[_FIT_SAMPLE_LENGTH], memory[_SAMPLE_START_FORCE] = 0.0, memory[_FILTERED_FORCE]
        memory[_SAMPLE_START_SPEED] = speed
    if k > 1.0:  # N/m
        rate, goal = min(T / _STIFFNESS_SHARE_FILTER_S, 1.0), memory[_STIFFNESS_SHARE_GOAL]
        if abs(k_d / max(k, k_d) - goal) > _STIFFNESS_SHARE_DEADBAND * goal:
            goal = memory[_STIFFNESS_SHARE_GOAL] = k_d / max(k, k_d)
        memory[_STIFFNESS_SHARE] += rate * (goal - memory[_STIFFNESS_SHARE])
        depth = max(size - memory[_CONTACT_DAMPING] * speed, 0.0) / k
        if memory[IN_CONTACT_FLAG] == 0.0:
            memory[_SLAVE_WALL_DEPTH] = depth
        memory[_SLAVE_WALL_DEPTH] += inward + rate * (depth - memory[_SLAVE_WALL_DEPTH] - inward)
        memory[IN_CONTACT_FLAG] = 1.0
    explained = memory[_CONTACT_STIFFNESS] * inward
    explained += memory[_CONTACT_DAMPING] * (speed - memory[_LAST_SPEED_INTO_WALL])
    rate = T / _SLIP_FORCE_FADE_S + abs(inward) / _MIN_FIT_SPAN_M
    shown = force_without_slip_steps(memory[_RENDERED_FORCE], size, explained, rate, max_change)
    memory[_RENDERED_FORCE] = shown
    memory[_LAST_SPEED_INTO_WALL] = speed


@njit(cache=True)
def _is_wall_removed(dx, memory):
    normal = memory[CONTACT_DIRECTION]
    speed_change = work_along(normal, memory[FILTERED_OWN_VELOCITY]) + memory[_LAST_SPEED_INTO_WALL]
    explained = abs(memory[_CONTACT_STIFFNESS] * work_along(normal, dx))
    explained += abs(memory[_CONTACT_DAMPING] * speed_change)
    return memory[_RENDERED_FORCE] > max(_MIN_FORCE_DROP_AT_WALL_REMOVAL_N, 2.0 * explained)


@njit(cache=True)
def _estimate_max_force_change_by_slip(wrench, normal_force, T, p, memory):
    mean_wrench = memory[MEAN_CONTACT_WRENCH]
    mean = max(math.sqrt(wrench_component_along(mean_wrench, mean_wrench, p)), 1e-12)
    friction = math.sqrt(max(wrench_component_along(wrench, wrench, p) - normal_force**2, 0.0))
    largest = max(memory[_MAX_FRICTION_FORCE] * (1.0 - min(T / _FRICTION_DECAY_S, 1.0)), friction)
    memory[_MAX_FRICTION_FORCE] = largest
    return largest * min(largest / mean, 1.0)


@njit(cache=True)
def _update_command_velocity(received, connected, T, p, memory, error):
    velocity, feed = memory[slots.COMMAND_TWIST], received[fields.VELOCITY]
    normal, compliance, beyond_wall, inward_speed = memory[CONTACT_DIRECTION], 0.0, 0.0, 0.0
    if memory[IN_CONTACT_FLAG] > 0.0:
        beyond_wall = memory[_SLAVE_WALL_DEPTH] - work_along(normal, error)
        beyond_wall -= work_along(normal, memory[_MOTOR_WRENCH_SLICE])
        if beyond_wall > 0.0:
            compliance, inward_speed = 1.0 - memory[_STIFFNESS_SHARE], -work_along(normal, feed)
    feeds_forward = connected and memory[_SILENCE_TIME] < _MAX_SILENCE_WITH_FEEDFORWARD_S
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            error[i] += compliance * beyond_wall * p[NORM_WEIGHTS_SLICE][g] * normal[i]
        acceleration = _MAX_COMMAND_ACCELERATION * ANGLE_PER_LENGTH[g]
        distance, rate = length_of_group(error, g), 1.0 / _COMMAND_FILTER_S
        if distance > 0.0:
            rate = min(rate, _STOPPING_SPEED_FACTOR * math.sqrt(2.0 * acceleration / distance))
        for i in range(3 * g, 3 * g + 3):
            error[i] *= rate
            if feeds_forward:
                push = compliance * inward_speed * p[NORM_WEIGHTS_SLICE][g]
                error[i] += feed[i] + push * normal[i]
        unused, mass = UNUSED_SLAVE_RESERVE_SHARE * p[SLAVE_RESERVE][g], p[slots.SLAVE_MASS][g]
        available = max(memory[slots.STORED_ENERGY][g] - unused, 0.0)
        fields.limit_group(error, g, math.sqrt(2.0 * available / (SLAVE_MASS_FACTOR * mass)))
        for i in range(3 * g, 3 * g + 3):
            error[i] -= velocity[i]
        fields.limit_group(error, g, acceleration * T)
        for i in range(3 * g, 3 * g + 3):
            velocity[i] += error[i]


@njit(cache=True)
def _limit_command_to_motor_energy(command, pose, twist, p, memory):
    """Move the command (7,) towards `pose` until the motor energy suffices; return if it moved."""
    motor_wrench, changed = memory[_MOTOR_WRENCH_SLICE], False
    fields.pose_difference_into(command, pose, motor_wrench)
    for g in range(2):
        K = _SERVO_STIFFNESS_FACTOR * p[slots.SERVO_K][g]
        D = _SERVO_DAMPING_FACTOR * p[slots.SERVO_D][g]
        for i in range(3 * g, 3 * g + 3):
            motor_wrench[i] = K * motor_wrench[i] - D * twist[i]
        if _limit_group_motor_wrench_to_energy(g, D, twist, p, memory):
            changed = True
            velocity = memory[slots.COMMAND_TWIST]
            is_faster = length_of_group(velocity, g) > length_of_group(twist, g)
            if is_faster or dot_of_group(velocity, twist, g) < 0.0:
                for i in range(3 * g, 3 * g + 3):
                    velocity[i] = twist[i]
        for i in range(3 * g, 3 * g + 3):
            motor_wrench[i] = (motor_wrench[i] + D * twist[i]) / K
    if changed:
        move_pose_into(pose, motor_wrench, command)
    return changed


@njit(cache=True)
def _limit_group_motor_wrench_to_energy(g, damping, twist, p, memory):
    motor_wrench, velocity = memory[_MOTOR_WRENCH_SLICE], memory[FILTERED_OWN_VELOCITY]
    contact = memory[_CONTACT_WRENCH]
    size, speed = length_of_group(motor_wrench, g), length_of_group(twist, g)
    mass = SLAVE_MASS_FACTOR * p[slots.SLAVE_MASS][g]
    stands = length_of_group(velocity, g) < _SLAVE_STANDSTILL_SPEED * ANGLE_PER_LENGTH[g]
    margin = UNUSED_SLAVE_RESERVE_SHARE * p[SLAVE_RESERVE][g]
    balance = memory[_AVAILABLE_MOTOR_ENERGY][g]
    pushes = dot_of_group(motor_wrench, twist, g) > 0.0
    pushes = pushes or dot_of_group(motor_wrench, velocity, g) > 0.0
    changed = False
    pressed, available, permitted = length_of_group(contact, g), balance, 0.0
    if is_in_contact(contact, p) and dot_of_group(motor_wrench, contact, g) < 0.0:
        free = _MAX_SLAVE_FORCE_WITHOUT_HAND_ENERGY_N * TORQUE_PER_FORCE[g] * ANGLE_PER_LENGTH[g]
        spring = (1.0 + memory[_STIFFNESS_GAIN_MINUS_ONE]) * free * free
        spring /= 2.0 * max(memory[_CONTACT_STIFFNESS], 1.0)
        available = min(balance, min(p[SLAVE_RESERVE][g], spring) + memory[_ENERGY_IN_CONTACT][g])
        if stands or not pushes:
            # Delayed motors gain a little energy at standstill; with an empty balance they yield.
            permitted = pressed * min(max(balance / margin, 0.0), 1.0)
    if not pushes:
        permitted += mass * speed / _MOTOR_ENERGY_PREDICTION_HORIZON_S  # stops without a rebound
    reach = _MOTOR_ENERGY_PREDICTION_HORIZON_S * (speed + memory[_PERIOD] * size / mass)
    if size * reach > max(available - margin, permitted * reach):
        permitted_wrench = max(max(available - margin, 0.0) / reach, permitted)
        fields.scale_group(motor_wrench, g, permitted_wrench / size)
        changed = True
    if balance < margin and not stands:
        strongest = mass * _MAX_SLAVE_DECELERATION * ANGLE_PER_LENGTH[g] * (1.0 - balance / margin)
        brake = min(damping * speed, strongest)
        if -brake * speed < dot_of_group(motor_wrench, twist, g):
            for i in range(3 * g, 3 * g + 3):
                motor_wrench[i] = -brake * twist[i] / max(speed, 1e-12)
            changed = True
    return changed


@njit(cache=True)
def _advance_servo_model(received, connected, T, p, memory, error):
    model, velocity = memory[SERVO_MODEL_POSE], memory[_SERVO_MODEL_TWIST]
    error[:] = 0.0
    if connected:
        fields.pose_difference_into(received[fields.POSE], model, error)
    for i in range(6):
        mass = p[slots.SLAVE_MASS][i // 3]
        stiff, damped = p[slots.SERVO_K][i // 3] / mass, p[slots.SERVO_D][i // 3] / mass
        velocity[i] = (velocity[i] + T * stiff * error[i]) / (1.0 + T * damped + T * T * stiff)
        error[i] = T * velocity[i]
    move_pose_into(model, error, model)


@njit(cache=True)
def record_command(requested, command, pose, twist, p, memory):
    for i in range(7):
        if command[i] != requested[i]:
            if _limit_command_to_motor_energy(command, pose, twist, p, memory):
                copy_into(memory, slots.COMMAND_POSE.start, command, 0, 7)
            return
