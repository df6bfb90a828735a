"""`drake-teleop new DIR --arm FILE --sensor-frame NAME`: creation of a station with a custom arm.

The command finds a start pose with the tool down, chooses scales that match the device, writes a
commented scenario, and runs it: free motion, then contact with a wall.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder, whole_file
from drake_teleop.common.numeric import Array
from drake_teleop.common.texts import yaml_text
from drake_teleop.lab.run import run_command
from drake_teleop.station.master.data_sheets import FIGURES, LEADER, PHANTOM, Master
from drake_teleop.station.master.phantom import FORCE_LIMIT
from drake_teleop.station.scenario import LoadScenario, Rates
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.slave.arm import ROTATION, TRANSLATION, ArmModel, pose_into
from drake_teleop.station.slave.home import R_WS_HOME, tool_down
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.plant import ParseSlave, finalize, lowest_point
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.slave.tool import Ball, Tool

#: Half edge of the Phantom's workspace cube around the default start [m] (E).
_PHANTOM_HALF_M = 0.08
#: Placeholder for a missing tool [kg, m].
_TIP = Ball(radius=0.012, position=[0, 0, 0.1])
_PLACEHOLDER_TOOL = Tool(mass=1.0, com=[0.0, 0.0, 0.05], shapes=[_TIP])
_CUBE_HALVES_M = (0.3, 0.2, 0.15, 0.1, 0.075, 0.05, 0.03)  # half edges of tested cubes [m]
_NUM_POSTURES, _NUM_PLACES = 20_000, 24  # number of random postures and of examined places
_TOOL_YAWS_DEG = (0.0, 90.0, -90.0, 180.0)  # tested rotations of the tool about z_W [deg]
# URDF rpy of the rotation from z to another axis.
_RPY_ONTO_Z = {
    "x": "0 1.5708 0",
    "-x": "0 -1.5708 0",
    "y": "-1.5708 0 0",
    "-y": "1.5708 0 0",
    "-z": "3.1416 0 0",
}
_MAX_RELATIVE_ERROR = 0.1  # error of an arm with few joints, over displacement
_SUFFICIENT_MARGIN = 0.1  # sufficient distance to a joint limit, over half the range
_MIN_COS_TILT = np.cos(np.radians(40.0))  # largest tilt of z_S from vertical
_PREFERRED_POSITION = np.array([0.6, 0.0, 0.4])  # preferred position, in units of the reach
_MAX_SWING_M, _MAX_DEPTH_M = 0.04, 0.01  # largest amplitude of the slave, and depth in the wall
# Contact force [N] that the device displays in addition to 1.5 times the weight.
_CONTACT_FORCE_N = 30.0
# Stiffness of the wall, and largest displayed stiffness [N/m]. The paper's station is stable up to
# 680 N/m with medium grip.
_WALL_STIFFNESS, _MAX_DISPLAYED_STIFFNESS = 2000.0, 400.0
_SWING_HZ, _MAX_SPEED_USE = 1.0, 0.5  # of the swing [Hz]; largest share of the joint speed limits


class Place(NamedTuple):
    """Start of an arm with the tool down.

    Attributes:
        pose: (7,) start pose X_WS [qw qx qy qz px py pz] [-, m].
        by_position: True if the position is sufficient to specify the pose in a scenario.
        q: (n,) joint positions at the start [rad].
        half: half edge of the reachable cube around the start [m].
        room: smallest distance of a joint to its limit, over half the joint's range.
    """

    pose: Array
    by_position: bool
    q: Array
    half: float
    room: float

    @property
    def position(self) -> Array:
        """Position p_WS (3,) of the sensor [m]."""
        return self.pose[4:]

    @property
    def home(self) -> list[float]:
        """Joint positions for the field `slave.home`; empty if the position is sufficient."""
        return [] if self.by_position else (np.round(self.q, 4) + 0.0).tolist()


@dataclass(frozen=True)
class Plan:
    """Start, scales and motions of a new station.

    Args:
        tool_mass: mass beyond the sensor [kg].
        own_tool: True if the model contains the tool.
        swing: amplitude of the slave in free motion [m].
        lowest: (3,) position in W of the tool's lowest point at the start [m].
        axis_note: advice on unusual axes of the sensor frame.
    """

    joints: tuple[str, ...]
    tool_mass: float
    own_tool: bool
    place: Place
    translation_scale: float
    force_scale: float
    swing: float
    lowest: Array
    assumptions: tuple[str, ...]
    axis_note: str


def new_command(
    folder: Path,
    arm: Path,
    sensor_frame: str,
    *,
    package_paths: tuple[Path, ...] = (),
    tool: Path | None = None,
    device: str = PHANTOM,
    sensor: str | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Write `station.yaml` into a folder, run it into `first_run`, and return the summary.

    Args:
        tool: model file of the tool; None: the bodies beyond the sensor, or a placeholder.
        sensor: preset of the wrist sensor; None: the default sensor.

    Raises:
        DrakeTeleopError: for an unusable model, an arm that cannot point its tool down, an unknown
            name, or an existing station.
    """
    scenario = folder / "station.yaml"
    if scenario.exists():
        raise DrakeTeleopError(
            "already exists", where=str(scenario), remedy="edit it, or give another folder"
        )
    for kind, name, known in (
        ("device", device, (PHANTOM, *FIGURES)),
        ("sensor", sensor, (None, *PRESETS)),
    ):
        if name not in known:
            remedy = f"choose one of {', '.join(filter(None, known))}"
            if name == LEADER:
                remedy += "; add a leader arm to station.yaml afterwards, as master.leader"
            raise DrakeTeleopError(f"there is no {kind} {name!r}", where=f"--{kind}", remedy=remedy)
    plan = plan_station(arm, sensor_frame, package_paths, tool, device)
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    make_folder(folder)
    slave_data: dict[str, Any] = {"model": _relative_path(folder, arm)}
    if package_paths:
        slave_data["package_paths"] = [_relative_path(folder, path) for path in package_paths]
    slave_data["sensor_frame"] = sensor_frame
    tool_path = None if tool is None else _relative_path(folder, tool)
    try:
        text = _scenario_text(plan, slave_data, tool_path, device, sensor)
        with whole_file(scenario) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
            slave = LoadScenario(unfinished).slave
            read = [slave.path, *slave.packages, *(slave.files()[1:] if tool else ())]
            given = [path.resolve() for path in (arm, *package_paths, *([tool] if tool else ()))]
            if read != given or slave.sensor_frame != sensor_frame:
                raise DrakeTeleopError(
                    "does not describe the given models (their names cannot be written)",
                    where=str(scenario),
                )
    except BaseException:
        for each in made:
            with suppress(OSError):
                each.rmdir()
        raise
    if not quiet:
        _print(plan, scenario)
    return run_command(scenario, folder / "first_run", quiet=quiet)


def plan_station(
    arm: Path,
    sensor_frame: str,
    package_paths: tuple[Path, ...] = (),
    tool: Path | None = None,
    device: str = PHANTOM,
) -> Plan:
    """Choose start, scales and motions for an arm and a device."""
    slave = Slave(
        model=str(arm),
        sensor_frame=sensor_frame,
        package_paths=[str(path) for path in package_paths],
        tool=_PLACEHOLDER_TOOL if tool is None else Tool(model=str(tool)),
    )
    model, assumptions = _read_arm(slave)
    own_tool = tool is None and float(model.phi_load[0]) > _PLACEHOLDER_TOOL.mass + 1e-6
    if own_tool:
        slave.tool = None
        model, assumptions = _read_arm(slave)
    place = find_place(model)
    slave.position, slave.home = place.position.tolist(), place.home
    figures = FIGURES.get(device)
    room = _PHANTOM_HALF_M if figures is None else min(figures.size) / 2.0
    peak = FORCE_LIMIT if figures is None else figures.peak_force
    mass = float(model.phi_load[0])
    translation_scale = _round_down(min(place.half / room, 1.0))
    force_scale = min(
        peak / (1.5 * 9.81 * mass + _CONTACT_FORCE_N),
        _MAX_DISPLAYED_STIFFNESS / (_WALL_STIFFNESS * translation_scale),
        1.0,
    )
    swing = min(_MAX_SWING_M, place.half / 2.0, room * translation_scale / 2.0)
    return Plan(
        joints=tuple(model.joint_names),
        tool_mass=mass,
        own_tool=own_tool,
        place=place,
        translation_scale=translation_scale,
        force_scale=_round_down(force_scale),
        swing=_round_down(swing * min(1.0, _MAX_SPEED_USE / _speed_use(model, place, swing))),
        lowest=lowest_point(slave),
        assumptions=tuple(assumptions),
        axis_note=_axis_advice(model),
    )


def find_place(arm: ArmModel, seed: int = 0) -> Place:
    """Find a start with the tool down and reachable space in all directions.

    Raises:
        DrakeTeleopError: if no such start is found.
    """
    random = np.random.default_rng(seed)
    postures = random.uniform(arm.lower, arm.upper, (_NUM_POSTURES, arm.num_joints))
    poses = np.empty((_NUM_POSTURES, 7))
    for q, pose in zip(postures, poses, strict=True):
        pose_into(arm.table, q, pose)
    x, y = poses[:, 1], poses[:, 2]
    down_z = 1.0 - 2.0 * (x * x + y * y)  # z_W of z_S
    down = down_z < -_MIN_COS_TILT
    reach = np.quantile(np.hypot(poses[:, 4], poses[:, 5]), 0.98)
    fit = np.flatnonzero(down & _is_in_front(poses[:, 4:], reach))
    distances = np.linalg.norm(poses[fit, 4:] - reach * _PREFERRED_POSITION, axis=1)
    if arm.num_joints < 6:  # position and orientation are coupled
        steepest = fit[np.argsort(down_z[fit])[:_NUM_PLACES]]
        found = [_place_of_short_arm(arm, postures[k], poses[k]) for k in steepest]
    else:
        looked_at = fit[np.argsort(distances)][:: max(len(fit) // _NUM_PLACES, 1)]
        found = [
            _place_with_cube(arm, np.round(poses[k, 4:], 2), yaw_deg)
            for yaw_deg in _TOOL_YAWS_DEG
            for k in looked_at
        ]
    best = max(found, key=_merit, default=None)
    if best is None or best.half == 0.0:
        raise DrakeTeleopError(
            "no posture found in which z_S points down and the arm can move in all directions",
            where="new",
            remedy=_axis_advice(arm) or "check joint limits and the orientation of sensor_frame",
        )
    return best


def _merit(place: Place) -> tuple[float, bool, float]:
    return min(place.room, _SUFFICIENT_MARGIN), place.by_position, place.half


def _axis_advice(arm: ArmModel) -> str:
    """Return advice if another axis of S than z is along the last joint."""
    n = arm.num_joints
    # Axis of the last joint in S, directed away from the joint.
    along = arm.table[n, ROTATION:TRANSLATION].reshape(3, 3)[2]
    along = along * (-1.0 if arm.table[n, TRANSLATION + 2] < 0.0 else 1.0)
    k = int(np.argmax(np.abs(along)))
    axis = ("-" if along[k] < 0.0 else "") + "xyz"[k]
    if axis not in _RPY_ONTO_Z:
        return ""
    return (
        f"z_S must point to the tool, but {axis}_S is along the last joint; if the tool is too, add"
        f' a link fixed to sensor_frame by <origin rpy="{_RPY_ONTO_Z[axis]}"/> and name that link'
    )


def _is_in_front(places: Array, reach: float) -> NDArray[np.bool_]:
    x, y, z = places.T / reach
    r = np.hypot(x, y)
    result: NDArray[np.bool_] = (r > 0.35) & (r < 0.85) & (x > 0.9 * r) & (z > 0.15) & (z < 0.8)
    return result


def _place_with_cube(arm: ArmModel, position: Array, yaw_deg: float) -> Place:
    """Return the start at a position, with the largest reachable cube."""
    R_WS = RotationMatrix.MakeZRotation(np.radians(yaw_deg)) @ R_WS_HOME
    w = R_WS.ToQuaternion().wxyz()
    q, status = tool_down(arm, position, R_WS)
    place = Place(np.array([*w, *position]), yaw_deg == 0.0, q, 0.0, _joint_margin(arm, q))
    if status != IkStatus.OK:
        return place._replace(room=0.0)
    for half in (half for half in _CUBE_HALVES_M if 2.0 * half <= np.hypot(*position[:2])):
        corners = (position + half * np.array(signs) for signs in product((-1.0, 1.0), repeat=3))
        if all(
            find_posture(arm, np.array([*w, *corner]), q)[1] == IkStatus.OK for corner in corners
        ):
            return place._replace(half=half)
    return place._replace(room=0.0)


def _place_of_short_arm(arm: ArmModel, q: Array, pose: Array) -> Place:
    reached = np.empty(7)

    def is_reachable(displacement: Array) -> bool:
        target = pose + np.append(np.zeros(4), displacement)
        pose_into(arm.table, find_posture(arm, target, q)[0], reached)
        return bool(
            np.linalg.norm(reached[4:] - target[4:])
            < _MAX_RELATIVE_ERROR * np.linalg.norm(displacement)
        )

    displacements = [sign * axis for axis in np.eye(3) for sign in (-1.0, 1.0)]
    halves = (h for h in _CUBE_HALVES_M if all(is_reachable(h * d) for d in displacements))
    return Place(pose, by_position=False, q=q, half=next(halves, 0.0), room=_joint_margin(arm, q))


def _joint_margin(arm: ArmModel, q: Array) -> float:
    return float((np.minimum(q - arm.lower, arm.upper - q) / (arm.upper - arm.lower)).min() * 2.0)


def _speed_use(arm: ArmModel, place: Place, swing: float) -> float:
    above = place.pose.copy()
    above[6] += swing
    displacement = np.abs(find_posture(arm, above, place.q)[0] - place.q)
    return float((2.0 * np.pi * _SWING_HZ * displacement / arm.velocity_limit).max())


def _read_arm(slave: Slave) -> tuple[ArmModel, list[str]]:
    plant = MultibodyPlant(0.0)
    parsed = ParseSlave(plant, slave)
    finalize(plant)
    arm, assumed = parsed.arm()
    return arm, [*parsed.assumptions, *assumed]


def _round_down(value: float) -> float:
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.floor(value / unit + 1e-9) * unit:.12g}")


def _relative_path(folder: Path, path: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _scenario_text(
    plan: Plan, slave: dict[str, Any], tool: str | None, device: str, sensor: str | None
) -> str:
    s, swing = plan.translation_scale, plan.swing
    x, y, z = plan.lowest
    down = 1.5 * swing + min(_MAX_DEPTH_M, swing / 4.0)
    if plan.place.by_position:
        slave["position"] = _round_row(plan.place.position)
    else:
        slave["home"] = plan.place.home
    comments = {
        "slave.position": "of the sensor at the start, tool down [m]",
        "slave.home": "joints at the start, tool down [rad, m]",
        "kinematic_scaling": f"the arm can move {1e3 * plan.place.half:g} mm in all directions",
        "force_scaling": "sigma 1 displays the whole load of the tool; force_scale: see analyze",
        "operator.intent": "of the hand: up and down, then down onto the wall",
        "rates": "of the device",
    }
    if tool is not None:
        slave["tool"] = {"model": tool}
    elif plan.own_tool:
        slave["tool"], comments["slave.tool"] = None, "the bodies of the model beyond the sensor"
    else:
        slave["tool"] = {"mass": _PLACEHOLDER_TOOL.mass, "com": _PLACEHOLDER_TOOL.com}
        slave["tool"] |= {"shapes": [{"_tag": "!Ball"} | vars(_PLACEHOLDER_TOOL.shapes[0])]}
        comments["slave.tool"] = "a placeholder: put model file or numbers of your tool here"
    swing_motion = {"_tag": "!Sine", "t_start": 0.2, "duration": 2.6, "ramp": 0.5}
    swing_motion |= {"frequency": _SWING_HZ, "translation": _round_row([0.0, 0.0, swing / s])}
    press_motion = {"_tag": "!MinimumJerk", "t_start": 3.2, "duration": 1.2}
    press_motion |= {"translation": _round_row([0.0, 0.0, -down / s])}
    wall_position = _round_row([x, y, z - 1.5 * swing])
    wall = {"_tag": "!Wall", "position": wall_position, "stiffness": _WALL_STIFFNESS}
    data = {
        "description": f"{Path(slave['model']).stem} commanded by {device}",
        "simulation": {"duration": 5.0, "settle": 0.8},
        **_device_rates(device),
        "slave": slave,
        "master": {"model": device},
        **({"wrist_sensor": {"preset": sensor}} if sensor else {}),
        "kinematic_scaling": {"translation_scale": s},
        "force_scaling": {"sigma": 0.0, "force_scale": plan.force_scale},
        "environment": [wall],
        "operator": {"grip": "medium", "intent": [swing_motion, press_motion]},
    }
    head = "Made by drake-teleop new. All fields and defaults: drake-teleop scenario station.yaml"
    return yaml_text(data, head=[head], comments=comments)


def _device_rates(device: str) -> dict[str, Any]:
    """Return the rates of a slow device for the scenario, as `analyze` requires."""
    own = Master(model=device).own_period(Rates().hand_hz)
    return {} if own is None else {"rates": dict.fromkeys(("hand_hz", "joint_control_hz"), 1 / own)}


def _round_row(values: Any) -> list[float]:
    return [float(f"{value:.4g}") for value in values]


def _print(plan: Plan, scenario: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"A station: {scenario}", title_justify="left", show_header=False)
    tool = "of the model" if plan.own_tool else "on the sensor"
    for name, value in (
        ("Joints", f"{len(plan.joints)}: {', '.join(plan.joints)}"),
        ("Tool", f"{plan.tool_mass:.4g} kg, {tool}"),
        ("Start", f"sensor at {_round_row(plan.place.position)} m, tool down"),
        ("Reachable around it", f"{1e3 * plan.place.half:g} mm in all directions"),
        ("Scales", f"motion {plan.translation_scale:g}, force {plan.force_scale:g}"),
    ):
        table.add_row(name, value)
    console = Console()
    console.print(table)
    notes = [f"note: {plan.axis_note}"] if plan.axis_note else []
    for line in [*notes, *(f"assumed: {assumed}" for assumed in plan.assumptions)]:
        console.print(line, highlight=False, markup=False)
