"""Start posture, tool, scales and motions of a new station, chosen for an arm and a device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.new_station import place as start
from drake_teleop.lab.new_station.random_postures import random_postures
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.master.data_sheets import FIGURES, PHANTOM_NAME
from drake_teleop.station.master.phantom import PEAK_FORCE_N
from drake_teleop.station.slave.arm import ArmModel, holding_torque
from drake_teleop.station.slave.model.model_repair import FRAME_REPLACES_SITE_TEXT
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.posture_shapes import PostureShapes, overlap_warnings
from drake_teleop.station.slave.slave_config import Ball, Slave, Tool

_DEFAULT_MASTER_WORKSPACE_HALF_EDGE_M = 0.08  # of the cube around the default start, estimate
# Stand-in for a missing tool: masses [kg], of which the arm holds the first with less than this
# share of its torques; centre of mass, length and radius of the ball [m]; free length of the rod.
_STAND_IN_TOOL_MASSES_KG = (1.0, 0.5, 0.2, 0.1, 0.05)
_MIN_TOOL_MASS_KG, _MIN_TOOL_LENGTH_M = 1e-6, 0.03  # of a tool in the model
_STAND_IN_COM_M, _STAND_IN_LENGTH_M, _STAND_IN_BALL_RADIUS_M = 0.05, 0.1, 0.012
_STAND_IN_FREE_LENGTH_M = 0.05
_STAND_IN_MASS_AND_MOMENT = _STAND_IN_TOOL_MASSES_KG[0] * np.array([1.0, 0.0, 0.0, _STAND_IN_COM_M])
_SUFFICIENT_POSTURE_SCORE = 1.5  # of a start, at which no further substitute axis is tried
_MIN_SLAVE_SWING_M, _MAX_SLAVE_SWING_M = 0.01, 0.04  # amplitude of the slave
_DISPLAYABLE_CONTACT_FORCE_N = 30.0  # in addition to 1.5 times the weight
# Stiffness of the wall, and largest displayed stiffness [N/m]. The paper's station is stable up to
# 680 N/m with medium grip.
_WALL_STIFFNESS_N_M, _MAX_DISPLAYED_STIFFNESS_N_M = 2000.0, 400.0
SWING_HZ, _MAX_JOINT_SPEED_USE = 1.0, 0.5  # Hz; largest share of the joint speed limits


@dataclass(frozen=True)
class StationPlan:
    """Start posture, scales and motions of a new station.

    Args:
        swing_amplitude_m: amplitude of the slave in free motion [m].
        base_plane_height: height z_W of the base plane [m].
        lowest_tool_point_W: (3,) position in W of the tool's lowest point at the start [m].
        wall: horizontal wall, 1.5 swing amplitudes below this point.
        tip_S: (3,) the same point in S [m]; empty if z_S points down.
        tool_axis_advice: advice on the sensor frame if another axis than z_S points down, else "".
        direction_at_start: such as "tool down", or "x_S down" if the tool cannot point down.
        weak_joints: names of joints whose torque limits cannot hold the arm.
    """

    stand_in_tool: Tool | None
    tool_mass_kg: float
    has_own_tool: bool
    place: start.StartPlace
    translation_scale: float
    force_scale: float
    swing_amplitude_m: float
    lowest_tool_point_W: Array
    wall: Wall
    tip_S: list[float]
    assumptions: tuple[str, ...]
    tool_axis_advice: str
    direction_at_start: str
    overlap_warnings: tuple[str, ...]
    base_plane_height: float
    weak_joints: tuple[str, ...]
    posture_shapes: PostureShapes


def plan_station(
    arm: Path,
    sensor_frame: str,
    package_paths: tuple[Path, ...] = (),
    tool: Path | None = None,
    device: str = PHANTOM_NAME,
) -> StationPlan:
    stand_in = _make_stand_in_tool("z", _STAND_IN_LENGTH_M)
    slave = Slave(
        model=str(arm),
        sensor_frame=sensor_frame,
        package_paths=[str(path) for path in package_paths],
        tool=stand_in if tool is None else Tool(model=str(tool)),
    )
    shapes = PostureShapes(slave, start.TrialWalls(), sticks=True)
    load = shapes.arm.phi_load[:4] - (_STAND_IN_MASS_AND_MOMENT if tool is None else 0.0)
    has_load, own_tool = load[0] > _MIN_TOOL_MASS_KG, False
    p_SScm_S = load[1:] / load[0] if has_load else np.zeros(3)
    tool_axis = start.sensor_axis_along_tool(shapes.arm, p_SScm_S)
    if tool is None and has_load and _has_tool_beyond_sensor_link(shapes, tool_axis):
        slave.tool, own_tool = None, True
        shapes = PostureShapes(slave, start.TrialWalls(), sticks=True)
    plane = find_base_plane_height(shapes)
    place, axis, shapes = _find_start_and_tool_axis(slave, shapes, plane, tool_axis)
    on_sensor = None if tool is not None else slave.tool
    is_along_tool = axis == tool_axis or on_sensor is not None
    is_site = f"{FRAME_REPLACES_SITE_TEXT} {sensor_frame}" in shapes.assumptions
    share = 1.0 if own_tool else start.MIN_LOAD_SHARE_HELD_BY_MOTORS if tool is None else 0.0
    model, weak_joints, texts = _with_infinite_limits_for_weak_joints(shapes.arm, place.q, share)
    if axis != tool_axis:
        posture = "posture" if on_sensor is None else "posture without overlaps"
        what = f"no {posture} was found in which {tool_axis}_S, away from the arm, points down"
        texts.append(f"{axis}_S points down at the start, because {what}")
    if on_sensor is not None:
        on_sensor.mass = _largest_holdable_tool_mass_kg(model, place.q)
    mass = float(model.phi_load[0]) if on_sensor is None else on_sensor.mass
    figures = FIGURES.get(device)
    room = _DEFAULT_MASTER_WORKSPACE_HALF_EDGE_M if figures is None else min(figures.size) / 2.0
    peak = PEAK_FORCE_N if figures is None else figures.peak_force
    translation_scale = _floor_to_two_significant_digits(min(place.cube_half_m / room, 1.0))
    by_force = peak / (1.5 * 9.81 * mass + _DISPLAYABLE_CONTACT_FORCE_N)
    by_stiffness = _MAX_DISPLAYED_STIFFNESS_N_M / (_WALL_STIFFNESS_N_M * translation_scale)
    shapes.move_to(place.q)
    lowest = start.lowest_tool_point(shapes)
    cosine = -(shapes.X_WS.rotation() @ start.R_SA_BY_AXIS[axis].matrix()[:, 2])[2]
    tilt = f"{np.degrees(np.arccos(min(cosine, 1.0))):.0f} degrees from downwards"
    direction = "down" if cosine > start.MIN_COS_OF_TOOL_DOWN else tilt
    swing = min(_MAX_SLAVE_SWING_M, place.cube_half_m / 2.0, room * translation_scale / 2.0)
    swing = min(swing, max(lowest[2] - plane, _MIN_SLAVE_SWING_M) / 2.0)
    swing *= min(1.0, _MAX_JOINT_SPEED_USE / _swing_to_joint_speed_ratio(model, place, swing))
    swing = _floor_to_two_significant_digits(swing)
    wall_position = lowest - [0.0, 0.0, 1.5 * swing]
    return StationPlan(
        stand_in_tool=on_sensor,
        tool_mass_kg=mass,
        has_own_tool=own_tool,
        place=place,
        translation_scale=translation_scale,
        force_scale=_floor_to_two_significant_digits(min(by_force, by_stiffness, 1.0)),
        swing_amplitude_m=swing,
        lowest_tool_point_W=lowest,
        wall=Wall(
            position=round_to_four_significant_digits(wall_position),
            size=[place.wall_edge_m, place.wall_edge_m],
            stiffness=_WALL_STIFFNESS_N_M,
        ),
        tip_S=[] if axis == "z" else (shapes.X_WS.inverse() @ lowest).tolist(),
        assumptions=(*shapes.assumptions, *texts),
        tool_axis_advice=start.tool_frame_advice(
            arm, sensor_frame, axis, is_along_tool=is_along_tool, is_site=is_site
        ),
        direction_at_start=f"{'tool' if is_along_tool else f'{axis}_S'} {direction}",
        overlap_warnings=tuple(overlap_warnings(shapes, slave_only=True)),
        base_plane_height=plane,
        weak_joints=weak_joints,
        posture_shapes=shapes,
    )


def _find_start_and_tool_axis(
    slave: Slave, shapes: PostureShapes, plane: float, tool_axis: str
) -> tuple[start.StartPlace, str, PostureShapes]:
    # The start, its axis of S that points down, and the shapes; a stand-in tool is set along that
    # axis. Substitutes of the tool's axis are tried only if no start is found with it, or, for a
    # stand-in tool, no start without overlaps.
    found: list[tuple[start.StartPlace, str, PostureShapes]] = []
    errors: list[DrakeTeleopError] = []
    is_stand_in = slave.tool is not None and not slave.tool.model
    substitutes = start.opposite_axis(tool_axis), *start.R_SA_BY_AXIS
    for axis in dict.fromkeys((tool_axis, *substitutes)):
        stand_in = _make_stand_in_tool(axis, _stand_in_tool_length_m(shapes, axis))
        if is_stand_in and slave.tool != stand_in:
            slave.tool = stand_in
            shapes = PostureShapes(slave, start.TrialWalls(), sticks=True)
        try:
            place = start.find_start_place(shapes.arm, shapes, plane=plane, axis=axis)
        except DrakeTeleopError as error:
            errors.append(error)
            continue
        found.append((place, axis, shapes))
        is_usable = not (is_stand_in and place.has_overlaps)
        if is_usable if axis == tool_axis else place.posture_score > _SUFFICIENT_POSTURE_SCORE:
            break
    if not found:
        raise errors[0]
    best = max(found, key=lambda each: each[0].posture_score)
    if is_stand_in:
        slave.tool = _make_stand_in_tool(best[1], _stand_in_tool_length_m(best[2], best[1]))
    return best


def _has_tool_beyond_sensor_link(shapes: PostureShapes, axis: str) -> bool:
    own_bodies = shapes.tool_bodies - {shapes.tool_body}
    link_bodies = shapes.bodies_welded_to_sensor() - shapes.tool_bodies
    link = start.coordinates_along_axis(shapes, link_bodies, axis)
    own_end = start.coordinates_along_axis(shapes, own_bodies, axis).max(initial=-np.inf)
    return bool(own_end > (link.max() if len(link) else 0.0) + _MIN_TOOL_LENGTH_M)


def find_base_plane_height(shapes: PostureShapes) -> float:
    """Return the height z_W of the base plane [m]: the lowest point of shapes fixed to the world.

    Without such shapes it is 0, or the first joint's height if lower. Below a hanging arm it is 0,
    or the sensor's lowest height in random postures if lower.
    """
    heights = shapes.points_on_bodies_W(shapes.anchored_slave_bodies())[:, 2]
    is_known = len(heights) > 0 and not shapes.has_sticks
    plane = heights.min() if is_known else min(shapes.arm.table[0, 11], 0.0)
    sensor_heights = random_postures(shapes.arm).p_WS[:, 2]
    hangs = np.median(sensor_heights) < plane
    return float(min(sensor_heights.min(), 0.0) if hangs else plane)


def _make_stand_in_tool(axis: str, length: float) -> Tool:
    along = start.R_SA_BY_AXIS[axis].matrix()[:, 2]
    ball = Ball(_STAND_IN_BALL_RADIUS_M, (np.round(length * along, 3) + 0.0).tolist())
    com = (_STAND_IN_COM_M * along).round(6).tolist()
    return Tool(mass=_STAND_IN_TOOL_MASSES_KG[0], com=com, shapes=[ball])


def _stand_in_tool_length_m(shapes: PostureShapes, axis: str) -> float:
    link_bodies = shapes.bodies_welded_to_sensor() - {shapes.tool_body}
    end = start.extent_beyond_sensor(shapes, link_bodies, axis)
    return max(_STAND_IN_LENGTH_M, float(np.ceil(100.0 * (end + _STAND_IN_FREE_LENGTH_M)) / 100.0))


def _with_infinite_limits_for_weak_joints(
    arm: ArmModel, q: Array, load_share: float
) -> tuple[ArmModel, tuple[str, ...], list[str]]:
    """Return the arm with infinite torque limits for weak joints, their names, and one text each.

    A weak joint's torque limit cannot hold the arm at q with `load_share` of its load.
    """
    torque = np.abs(holding_torque(arm.with_load(load_share * arm.phi_load), q))
    weak = torque > start.MAX_HOLDING_TORQUE_USE * arm.effort_limit
    names = tuple(np.array(arm.joint_names)[weak].tolist())
    texts = [
        f"no torque limit for {name}, as holding the arm takes {needed:.3g} of its {limit:.3g}"
        for name, limit, needed in zip(names, arm.effort_limit[weak], torque[weak], strict=True)
    ]
    return replace(arm, effort_limit=np.where(weak, np.inf, arm.effort_limit)), names, texts


def _largest_holdable_tool_mass_kg(arm: ArmModel, q: Array) -> float:
    phi = arm.phi_load
    for mass in _STAND_IN_TOOL_MASSES_KG:
        torque = holding_torque(arm.with_load(phi * mass / phi[0]), q)
        if np.abs(torque / arm.effort_limit).max() < start.MAX_HOLDING_TORQUE_USE:
            break
    return mass


def _swing_to_joint_speed_ratio(arm: ArmModel, place: start.StartPlace, swing_m: float) -> float:
    above = place.pose.copy()
    above[6] += swing_m
    displacement = np.abs(find_posture(arm, above, place.q)[0] - place.q)
    return float((2.0 * np.pi * SWING_HZ * displacement / arm.velocity_limit).max())


def _floor_to_two_significant_digits(value: float) -> float:
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.floor(value / unit + 1e-9) * unit:.12g}")


def round_to_four_significant_digits(values: Any) -> list[float]:
    return [float(f"{value:.4g}") for value in values]
