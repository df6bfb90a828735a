"""Signals that a station records: name, components, units, meaning."""

from __future__ import annotations

from collections.abc import Collection

from drake_teleop.station.result import Signal

#: Name of the station's log sink; its rows are the output ports in one vector.
LOG_BLOCK_NAME = "log"


def _make_signal(name: str, components: str, units: str, description: str) -> Signal:
    unit = tuple(units.split(","))
    return Signal(name, tuple(components.split()), unit[0] if len(unit) == 1 else unit, description)


#: Attribute of a station, for units in the log: indices of sliding joints of slave (key False) and
#: master (key True).
SLIDING_JOINTS_ATTRIBUTE = "sliding_joints"
#: Prefix of the pose signals of moving bodies of the surroundings.
MOVING_BODY_POSE_PREFIX = "pose_of_"

_WRENCH_COMPONENTS = ("f_x f_y f_z tau_x tau_y tau_z", "N,N,N,N m,N m,N m")
_POSE_COMPONENTS = ("q_w q_x q_y q_z p_x p_y p_z", "1,1,1,1,m,m,m")
_TWIST_COMPONENTS = ("v_x v_y v_z omega_x omega_y omega_z", "m/s,m/s,m/s,rad/s,rad/s,rad/s")
_LOAD_ESTIMATE_COMPONENTS = (
    "fo_x fo_y fo_z tauo_x tauo_y tauo_z m mc_x mc_y mc_z I_xx I_xy I_xz I_yy I_yz I_zz",
    "N,N,N,N m,N m,N m,kg,kg m,kg m,kg m" + ",kg m^2" * 6,
)
_CHANNEL_ENERGY_AND_SILENCE_COMPONENTS = (
    "hand hand_rotation slave slave_rotation master_silent slave_silent command command_rotation",
    "J,J,J,J,s,s,J,J",
)


def _signals_by_name(num_joints: int, sliding: Collection[int] = ()) -> dict[str, Signal]:
    numbers = range(1, num_joints + 1)
    names = " ".join(f"joint_{i}" for i in numbers)
    units = ["m" if k in sliding else "rad" for k in range(num_joints)]
    forces = ["N" if k in sliding else "N m" for k in range(num_joints)]
    angles, torques = (names, ",".join(units)), (names, ",".join(forces))
    state_names = " ".join(f"{letter}_{i}" for letter in "qv" for i in numbers)
    state = (state_names, ",".join([*units, *(f"{unit}/s" for unit in units)]))
    rows = (
        ("measured_wrench_S", _WRENCH_COMPONENTS, "sensor's wrench, Eq. (1), at sample_time"),
        ("specific_force_S", ("s_x s_y s_z", "m/s^2"), "a - g at So, at sample_time"),
        ("angular_velocity_S", ("omega_x omega_y omega_z", "rad/s"), "omega at sample_time"),
        ("angular_acceleration_S", ("alpha_x alpha_y alpha_z", "rad/s^2"), "alpha at sample_time"),
        ("saturated", ("saturated", "1"),
         "1 if a channel of the sensor was saturated at sample_time; above 1 for a while after a"
         " lost reading"),
        ("joint_position", angles, "encoder readings of the slave, at sample_time"),
        ("sample_time", ("t", "s"),
         "time of the wrist sensor's sample in this row; other signals are of t"),
        ("load_estimate", _LOAD_ESTIMATE_COMPONENTS, "offsets and phi, Eq. (7)"),
        ("slave_state", state, "true joint positions and velocities, at t"),
        ("joint_torque", torques, "motor torques of the slave"),
        ("load_state", ("state", "1"),
         "state of the load estimate: 0 learning, 1 settled, 2 disturbed, 3 another load"),
        ("true_contact_wrench_W", _WRENCH_COMPONENTS, "contact wrench on the tool about Wo, in W"),
        ("sheet_state", ("z v_z", "m,m/s"), "deflection of the sheet spring's end, upwards"),
        ("intent", _POSE_COMPONENTS, "intended pose of the stylus, X_BE"),
        ("hand_wrench_E", _WRENCH_COMPONENTS, "wrench of the hand on the stylus at Eo, in B"),
        ("master_state", state, "joint positions and velocities of the device"),
        ("pose_master", _POSE_COMPONENTS, "pose X_BE of the stylus"),
        ("twist_master", _TWIST_COMPONENTS, "twist of the stylus in the device's base"),
        ("pose_command", _POSE_COMPONENTS, "setpoint of the slave, X_WS"),
        ("joint_command", angles, "setpoints of the joints"),
        ("ik_status", ("status", "1"), "IkStatus of the inverse kinematics, 0 = OK"),
        ("scaled_wrench_S", _WRENCH_COMPONENTS, "F' of Fig. 2, before the scale to the master"),
        ("contact_wrench_S", _WRENCH_COMPONENTS, "Eq. (13), calculated contact wrench"),
        ("fault", ("fault", "1"), "fault of sample or load estimate, 0 = none"),
        ("force_to_master", _WRENCH_COMPONENTS,
         "wrench that the device displays, within its limits"),
        ("fault_at_hand", ("fault", "1"), "fault of the wrench command at the device, 0 = none"),
        ("task_state", ("phase outcome noticed threshold trust", "1,1,1,N,1"),
         "state of the operator's task: phase; 1 done, -1 given up; 1 while contact is detected;"
         " smallest detected force at the hand; share of approach_speed (docs/operator.md)"),
        ("pose_received", _POSE_COMPONENTS, "setpoint X_WS of the slave after the channel"),
        ("ports", _CHANNEL_ENERGY_AND_SILENCE_COMPONENTS,
         "energy into the channel at its ends, in the master's power units; time since the last"
         " packet at each end; energy of the slave's wrench along the command"),
        ("contact", ("contact", "1"), "1 while the slave's detector reports contact"),
        ("contact_at_hand", ("contact", "1"), "contact flag after the channel, at the master"),
    )  # fmt: skip
    return {name: _make_signal(name, *parts, description) for name, parts, description in rows}


#: All signals in the order of the log, for an arm with six joints.
SIGNALS = _signals_by_name(6)


def signal_with_size(name: str, size: int, sliding: Collection[int] = ()) -> Signal:
    """Return the description of a recorded signal with `size` components.

    `sliding` contains the indices of joints with positions in m and forces in N.
    """
    if name.startswith(MOVING_BODY_POSE_PREFIX):
        body = name.removeprefix(MOVING_BODY_POSE_PREFIX)
        return _make_signal(name, *_POSE_COMPONENTS, f"pose of the body {body} in W, at t")
    if size == len(SIGNALS[name].components) and not sliding:
        return SIGNALS[name]
    num_joints = size // 2 if name in ("slave_state", "master_state") else size
    return _signals_by_name(num_joints, sliding)[name]
