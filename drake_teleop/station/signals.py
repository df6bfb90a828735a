"""Signals that a station records: name, components, units, meaning."""

from __future__ import annotations

from drake_teleop.station.result import Signal

#: Name of the station's log sink; its rows are the output ports in one vector.
LOG_BLOCK_NAME = "log"


def _signal(name: str, components: str, units: str, description: str) -> Signal:
    unit = tuple(units.split(","))
    return Signal(name, tuple(components.split()), unit[0] if len(unit) == 1 else unit, description)


#: Prefix of the pose signals of moving bodies of the surroundings.
MOVING_BODY_POSE_PREFIX = "pose_of_"

_WRENCH_AXES_AND_UNITS = ("f_x f_y f_z tau_x tau_y tau_z", "N,N,N,N m,N m,N m")
_POSE_AXES_AND_UNITS = ("q_w q_x q_y q_z p_x p_y p_z", "1,1,1,1,m,m,m")
_TWIST_AXES_AND_UNITS = ("v_x v_y v_z omega_x omega_y omega_z", "m/s,m/s,m/s,rad/s,rad/s,rad/s")


def _state_components_and_units(joints: int) -> tuple[str, str]:
    names = [f"{letter}_{i + 1}" for letter in "qv" for i in range(joints)]
    return " ".join(names), ",".join(joints * ["rad"] + joints * ["rad/s"])


def _joint_names(joints: int) -> str:
    return " ".join(f"joint_{i + 1}" for i in range(joints))


_STATE_AXES, _STATE_UNITS = _state_components_and_units(6)
_JOINTS = _joint_names(6)
# Signals with one component per joint.
_JOINT_SIGNAL_NAMES = ("joint_position", "joint_torque", "joint_command")


#: All signals in the order of the log, for an arm with six joints.
SIGNALS = {
    signal.name: signal
    for signal in (
        _signal(
            "measured_wrench_S",
            *_WRENCH_AXES_AND_UNITS,
            "of the sensor, sign of Eq. (1), at sample_time",
        ),
        _signal("specific_force_S", "s_x s_y s_z", "m/s^2", "a - g at So, at sample_time"),
        _signal("angular_velocity_S", "omega_x omega_y omega_z", "rad/s", "of S, at sample_time"),
        _signal(
            "angular_acceleration_S", "alpha_x alpha_y alpha_z", "rad/s^2", "of S, at sample_time"
        ),
        _signal(
            "saturated",
            "saturated",
            "1",
            "1 if a channel of the sensor was saturated at sample_time; above 1 for a while after"
            " a lost reading",
        ),
        _signal("joint_position", _JOINTS, "rad", "encoder readings of the slave, at sample_time"),
        _signal(
            "sample_time",
            "t",
            "s",
            "time of the wrist sensor's sample in this row; other signals are of t",
        ),
        _signal(
            "load_estimate",
            "fo_x fo_y fo_z tauo_x tauo_y tauo_z m mc_x mc_y mc_z I_xx I_xy I_xz I_yy I_yz I_zz",
            "N,N,N,N m,N m,N m,kg,kg m,kg m,kg m" + ",kg m^2" * 6,
            "offsets and phi, Eq. (7)",
        ),
        _signal("slave_state", _STATE_AXES, _STATE_UNITS, "true joint angles and velocities, at t"),
        _signal("joint_torque", _JOINTS, "N m", "of the slave's motors"),
        _signal(
            "load_state",
            "state",
            "1",
            "of the monitored load: 0 learning, 1 settled, 2 disturbed, 3 another load",
        ),
        _signal(
            "true_contact_wrench_W",
            *_WRENCH_AXES_AND_UNITS,
            "environment on the tool, about Wo, in W",
        ),
        _signal("sheet_state", "z v_z", "m,m/s", "deflection of the sheet spring's end, upwards"),
        _signal("intent", *_POSE_AXES_AND_UNITS, "intended pose of the stylus, X_BE"),
        _signal("hand_wrench_E", *_WRENCH_AXES_AND_UNITS, "hand on the stylus at Eo, in B"),
        _signal(
            "master_state", _STATE_AXES, _STATE_UNITS, "joint angles and velocities of the device"
        ),
        _signal("pose_master", *_POSE_AXES_AND_UNITS, "of the stylus, X_BE"),
        _signal("twist_master", *_TWIST_AXES_AND_UNITS, "of the stylus in the device's base"),
        _signal("pose_command", *_POSE_AXES_AND_UNITS, "setpoint of the slave, X_WS"),
        _signal("joint_command", _JOINTS, "rad", "from the inverse kinematics"),
        _signal("ik_status", "status", "1", "of the inverse kinematics (IkStatus), 0 = OK"),
        _signal(
            "scaled_wrench_S",
            *_WRENCH_AXES_AND_UNITS,
            "F' of Fig. 2, before the scale to the master",
        ),
        _signal("contact_wrench_S", *_WRENCH_AXES_AND_UNITS, "Eq. (13), calculated contact wrench"),
        _signal("fault", "fault", "1", "of sample or load estimate, 0 = none"),
        _signal(
            "force_to_master",
            *_WRENCH_AXES_AND_UNITS,
            "wrench that the device displays, within its limits",
        ),
        _signal("fault_at_hand", "fault", "1", "of the wrench command at the device, 0 = none"),
        _signal(
            "task_state",
            "phase outcome noticed threshold trust",
            "1,1,1,N,1",
            "of the operator's task: phase; 1 done, -1 given up; 1 while contact is detected;"
            " smallest detected force at the hand; share of approach_speed (docs/operator.md)",
        ),
        _signal(
            "pose_received", *_POSE_AXES_AND_UNITS, "setpoint X_WS of the slave after the channel"
        ),
        _signal(
            "ports",
            "hand hand_rotation slave slave_rotation master_silent slave_silent"
            " command command_rotation",
            "J,J,J,J,s,s,J,J",
            "energy into the channel at its ends, in the master's power units; time since the last"
            " packet at each end; energy of the slave's wrench along the command",
        ),
        _signal("contact", "contact", "1", "1 while the slave's detector reports contact"),
        _signal("contact_at_hand", "contact", "1", "contact flag after the channel, at the master"),
    )
}


def signal_of(name: str, size: int) -> Signal:
    """Return the description of a signal with `size` components, for any number of joints."""
    if name.startswith(MOVING_BODY_POSE_PREFIX):
        return _signal(
            name,
            *_POSE_AXES_AND_UNITS,
            f"where the body {name.removeprefix(MOVING_BODY_POSE_PREFIX)} is, in W, at t",
        )
    signal = SIGNALS[name]
    if size == len(signal.components):
        return signal
    if name in _JOINT_SIGNAL_NAMES:
        return _signal(name, _joint_names(size), signal.units[0], signal.description)
    if name in ("slave_state", "master_state"):
        return _signal(name, *_state_components_and_units(size // 2), signal.description)
    return signal
