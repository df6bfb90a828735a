"""Start posture of an arm whose tool points down, chosen among random postures.

The start is the posture with the largest reachable cube among those with the best
`posture_scores`. Frame A is S, rotated so that z_A is the axis of S along the tool.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, ProximityProperties
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, SpatialInertia

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.new_station.random_postures import (
    NUM_RANDOM_POSTURES,
    Postures,
    StartRegion,
    least_joint_margins,
    posture_scores,
    postures_at,
    random_postures,
    select_suitable_postures,
    sensor_degrees_of_freedom,
)
from drake_teleop.load.inertia import transform_phi
from drake_teleop.station.environment.environment import AddFreeJoint, Environment, NewInstance
from drake_teleop.station.slave.arm import (
    ROTATION_COLUMN,
    TRANSLATION_COLUMN,
    ArmModel,
    holding_torque,
)
from drake_teleop.station.slave.home import R_WS_HOME, solve_start_posture
from drake_teleop.station.slave.inverse_kinematics import IkStatus, has_closed_form
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.posture_shapes import MIN_OVERLAP_M, PostureShapes, overlap_warnings

WALL_EDGES_M = (0.4, 0.25, 0.15)  #: edges of the walls that are tried, the first preferred
_TRIAL_WALL_NAME_BY_EDGE_M = {edge: f"wall of {edge:g} m" for edge in WALL_EDGES_M}
#: Rotation R_SA from each axis of S to z.
R_SA_BY_AXIS = {
    "z": RotationMatrix(),
    "x": RotationMatrix.MakeYRotation(np.pi / 2),
    "-x": RotationMatrix.MakeYRotation(-np.pi / 2),
    "y": RotationMatrix.MakeXRotation(-np.pi / 2),
    "-y": RotationMatrix.MakeXRotation(np.pi / 2),
    "-z": RotationMatrix.MakeXRotation(np.pi),
}
_CUBE_HALF_EDGES_M = (0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3)  # half edges of tested cubes [m]
# Numbers of solved postures, of good ones with a tested cube, and of tested cubes otherwise; of
# postures whose shapes are checked if all solved ones overlap.
_NUM_SOLVED_POSTURES, _NUM_BEST_STARTS, _MAX_TESTED_CUBES, _NUM_OVERLAP_CHECKS = 40, 12, 60, 500
_ACCEPTED_SCORE_LOSS_FOR_LARGER_CUBE = 0.3  # largest disadvantage of a start with a larger cube
_TOOL_YAWS_DEG = (0.0, 90.0, -90.0, 180.0)  # tested rotations of the tool about z_W [deg]
_MAX_POSITION_ERROR_TO_DISPLACEMENT_RATIO = 0.1  # position error over displacement, below six dof
# Smallest distance to a limit over half the range, and largest torque at rest over its limit: the
# identification before a run uses 80 % of both.
_MIN_START_JOINT_MARGIN, MAX_HOLDING_TORQUE_USE = 0.22, 0.7
MIN_LOAD_SHARE_HELD_BY_MOTORS = 0.05  #: Share of the load that weak motors must hold at rest.
_SUFFICIENT_START_JOINT_MARGIN = 0.1  # sufficient distance to a joint limit, over half the range
_MAX_JOINT_CHANGE_IN_CUBE = 2.0  # largest joint displacement to a corner of the cube [rad, m]
_SUFFICIENT_CUBE_HALF_EDGE_M = 0.15  # sufficient half edge of the cube [m]
_LOWEST_POINTS_HEIGHT_TOLERANCE_M = 1e-4  # these points share the contact
# Vertical extent of the space above and below the tool's lowest point that wall and motion need.
_SPACE_ABOVE_TOOL_POINT_M, _SPACE_BELOW_TOOL_POINT_M = 0.015, 0.16
_MAX_WALL_EDGE_TO_REACH_RATIO = 0.6  # largest edge of a wall, over the reach
# Cost of overlaps and of shapes below the base plane [1/m], of any overlap, of each smaller wall.
_OVERLAP_COST_PER_M, _COST_OF_ANY_OVERLAP, _COST_OF_SMALLER_WALL = 30.0, 1.0, 0.1
_COST_OF_TILTED_TOOL, MIN_COS_OF_TOOL_DOWN = 1.0, 0.9999  # the cosine of 0.8 degrees


class StartPlace(NamedTuple):
    """Start posture of an arm whose tool points down.

    Attributes:
        pose: (7,) start pose X_WS [qw qx qy qz px py pz] [-, m].
        is_set_by_position: True if `slave.position` alone defines this start.
        q: (n,) joint positions at the start [rad, m].
        cube_half_m: half edge of the reachable cube around the start [m].
        joint_margin: smallest distance of a joint to its limit, over half the joint's range.
        posture_score: result of `posture_scores` minus costs of overlaps and wall.
        wall_edge_m: edge of the wall that fits below the tool [m].
        moves_only_vertically: True if only motion up and down by `cube_half_m` is reachable.
    """

    pose: Array
    is_set_by_position: bool
    q: Array
    cube_half_m: float
    joint_margin: float
    posture_score: float = 0.0
    wall_edge_m: float = WALL_EDGES_M[0]
    moves_only_vertically: bool = False
    has_overlaps: bool = False

    @property
    def reachable_text(self) -> str:
        directions = "up and down" if self.moves_only_vertically else "in all directions"
        return f"{1e3 * self.cube_half_m:g} mm {directions}"

    @property
    def position(self) -> Array:
        """Position p_WS (3,) of the sensor [m]."""
        return self.pose[4:]

    @property
    def home(self) -> list[float]:
        """Joint positions for `slave.home`; empty if `slave.position` is sufficient."""
        return [] if self.is_set_by_position else (np.round(self.q, 4) + 0.0).tolist()


class TrialWalls(Environment):
    """Free bodies, a wall of each size, that are placed below the tool to find overlaps."""

    @property
    def slip_speed(self) -> float:
        return 1e-3

    def AddTo(self, plant: MultibodyPlant) -> None:
        for edge, name in _TRIAL_WALL_NAME_BY_EDGE_M.items():
            inertia = SpatialInertia.SolidBoxWithMass(1.0, edge, edge, edge)
            body = plant.AddRigidBody(name, NewInstance(plant, name), inertia)
            AddFreeJoint(plant, body, RigidTransform([0.0, 0.0, -100.0]))
            shape = Box(edge, edge, _SPACE_ABOVE_TOOL_POINT_M + _SPACE_BELOW_TOOL_POINT_M)
            X_BG, properties = RigidTransform(), ProximityProperties()
            plant.RegisterCollisionGeometry(body, X_BG, shape, name, properties)


def find_start_place(
    arm: ArmModel, shapes: PostureShapes | None = None, *, plane: float = 0.0, axis: str = "z"
) -> StartPlace:
    """Find a start posture of the arm at which the tool points down.

    Args:
        shapes: shapes of the arm and of `TrialWalls`; None: overlaps are not examined.
        plane: height of the base plane, below which the arm has no joints [m].
        axis: axis of S that points down, one of `R_SA_BY_AXIS`.
    """
    pointed = _arm_with_frame_A(arm, axis)
    length = 0.0 if shapes is None else extent_beyond_sensor(shapes, shapes.tool_bodies, axis)
    postures, region = select_suitable_postures(random_postures(pointed), plane, length)
    has_six_dof = len(postures.q) > 0 and sensor_degrees_of_freedom(pointed, postures) == 6
    found = list[StartPlace]()
    for rows in _iter_posture_rows_by_score(pointed, postures, region, shapes):
        solved = _solve_starts(pointed, postures[rows[:_NUM_SOLVED_POSTURES]], region, has_six_dof)
        found += [_with_largest_fitting_wall(shapes, place, region) for place in solved]
        if not all(place.has_overlaps for place in found):
            break
    found.sort(key=lambda place: place.posture_score, reverse=True)
    least_score = found[0].posture_score - _ACCEPTED_SCORE_LOSS_FOR_LARGER_CUBE if found else 0.0
    good = [place for place in found if place.posture_score > least_score]
    best = None
    for places, vertical in ((good[:_NUM_BEST_STARTS], False), (found, False), (found, True)):
        if best is None or best.cube_half_m == 0.0:
            tested = places[:_MAX_TESTED_CUBES]
            cubes = [_with_reachable_cube(pointed, each, has_six_dof, vertical) for each in tested]
            best = max(cubes, key=_start_place_sort_key, default=None)
    if best is None or best.cube_half_m == 0.0:
        causes = ", ".join(f"in {count} {name}" for name, count in region.removed_counts if count)
        what = (
            f"no posture found in which {axis}_S points down and the arm can move in all directions"
            f" (of {NUM_RANDOM_POSTURES} random postures, {causes}; {len(postures.q)} are left on"
            " the best side)"
        )
        slides, ranges = arm.sliding_joints, arm.upper - arm.lower
        k = min(range(arm.num_joints), key=lambda j: (j in slides, ranges[j]))
        limits = f"{arm.joint_names[k]}: {arm.lower[k]:.3g} to {arm.upper[k]:.3g} rad or m"
        remedy = f"check joint limits ({limits}) and the orientation of sensor_frame"
        raise DrakeTeleopError(what, where="new", remedy=remedy)
    pose = best.pose if axis == "z" else arm.pose(best.q)
    return best._replace(pose=pose, is_set_by_position=best.is_set_by_position and axis == "z")


def _arm_with_frame_A(arm: ArmModel, axis: str) -> ArmModel:
    R_SA = R_SA_BY_AXIS[axis].matrix()
    turned = arm.with_load(transform_phi(arm.phi_load, R_SA.T, np.zeros(3)))
    R_JS = turned.table[-1, ROTATION_COLUMN:TRANSLATION_COLUMN]
    R_JS[:] = (R_JS.reshape(3, 3) @ R_SA).ravel()
    return turned


def _select_rows_far_from_limits_or_all(arm: ArmModel, q: Array) -> NDArray[np.intp]:
    # Far from joint limits and, with decreasing load, held by the motors; otherwise all rows.
    roomy = least_joint_margins(arm, q) > _MIN_START_JOINT_MARGIN
    for share in (1.0, MIN_LOAD_SHARE_HELD_BY_MOTORS):
        loaded = arm.with_load(share * arm.phi_load)
        torques = np.array([holding_torque(loaded, each) for each in q]).reshape(q.shape)
        strong = (np.abs(torques) < MAX_HOLDING_TORQUE_USE * arm.effort_limit).all(axis=1)
        if (roomy & strong).any():
            return np.flatnonzero(roomy & strong)
    return np.flatnonzero(roomy) if roomy.any() else np.arange(len(q))


def _iter_posture_rows_by_score(
    arm: ArmModel, postures: Postures, region: StartRegion, shapes: PostureShapes | None
) -> Iterator[NDArray[np.intp]]:
    if not len(postures.q):
        return
    order = np.argsort(posture_scores(arm, postures, region))[::-1]
    usable = order[np.isin(order, _select_rows_far_from_limits_or_all(arm, postures.q))]
    yield usable
    if shapes is None:
        return
    for rows in (usable, order):
        few = rows[:: len(rows) // _NUM_OVERLAP_CHECKS + 1]
        clear = np.ones(len(few), dtype=bool)
        for k, row in enumerate(few):
            shapes.move_to(postures.q[row])
            clear[k] = not overlap_warnings(shapes, slave_only=True)
        yield few[clear]


def _solve_starts(
    arm: ArmModel, postures: Postures, region: StartRegion, has_six_dof: bool
) -> Iterator[StartPlace]:
    if has_six_dof:
        pairs = zip(postures.q, postures.p_WS, strict=True)
        solved = [s for q, p_WS in pairs for s in _starts_at_position_rounded_to_cm(arm, q, p_WS)]
    else:  # position and orientation are coupled
        solved = [s for k in range(len(postures.q)) for s in _starts_below_6_dof(arm, postures, k)]
    if not solved:
        return
    rows = _select_rows_far_from_limits_or_all(arm, np.array([q for q, _, _ in solved]))
    solved = [solved[k] for k in rows]
    exact = postures_at(arm, np.array([q for q, _, _ in solved]))
    merits, rooms = posture_scores(arm, exact, region), least_joint_margins(arm, exact.q)
    merits -= _COST_OF_TILTED_TOOL * (exact.R_WS[:, 2, 2] > -MIN_COS_OF_TOOL_DOWN)
    for (q, pose, by_position), merit, room in zip(solved, merits, rooms, strict=True):
        yield StartPlace(pose, by_position, q, 0.0, float(room), float(merit))


def _starts_below_6_dof(
    arm: ArmModel, postures: Postures, row: int
) -> Iterator[tuple[Array, Array, bool]]:
    # The posture, and that after the smallest rotation of its tool to downwards, if reachable.
    R_WA, q = postures.R_WS[row], postures.q[row]
    yield q, arm.pose(q), False
    K = np.cross(np.cross(R_WA[:, 2], [0.0, 0.0, -1.0]), np.eye(3)).T
    R_WA = (np.eye(3) + K + K @ K / (1.0 - R_WA[2, 2])) @ R_WA
    pose = np.array([*RotationMatrix(R_WA).ToQuaternion().wxyz(), *postures.p_WS[row]])
    found, status = find_posture(arm, pose, q)
    if status == IkStatus.OK:
        yield found, pose, False


def _starts_at_position_rounded_to_cm(
    arm: ArmModel, q: Array, position: Array
) -> Iterator[tuple[Array, Array, bool]]:
    # Joint positions near q, their pose, and whether `slave.position` specifies them.
    position = np.round(position, 2)
    for yaw_deg in _TOOL_YAWS_DEG:
        R_WA = RotationMatrix.MakeZRotation(np.radians(yaw_deg)) @ R_WS_HOME
        pose = np.array([*R_WA.ToQuaternion().wxyz(), *position])
        if yaw_deg == 0.0 or has_closed_form(arm):
            usual, status = solve_start_posture(arm, position, R_WA)
            if status == IkStatus.OK:
                yield usual, pose, yaw_deg == 0.0
        if not has_closed_form(arm):
            found, status = find_posture(arm, pose, q)
            if status == IkStatus.OK:
                yield found, pose, False


def _with_largest_fitting_wall(
    shapes: PostureShapes | None, place: StartPlace, region: StartRegion
) -> StartPlace:
    # Overlaps reduce the score; without `shapes` wall and score are unchanged.
    if shapes is None:
        return place
    shapes.move_to(place.q)
    p_WB = lowest_tool_point(shapes)
    p_WB[2] += (_SPACE_ABOVE_TOOL_POINT_M - _SPACE_BELOW_TOOL_POINT_M) / 2.0
    walls = [shapes.plant.GetBodyByName(name) for name in _TRIAL_WALL_NAME_BY_EDGE_M.values()]
    for wall in walls:
        shapes.plant.SetFreeBodyPose(shapes.context, wall, RigidTransform(p_WB))
    depths = {wall.index(): 0.0 for wall in walls}
    lowest = shapes.points_on_bodies_W(shapes.moving_slave_bodies())[:, 2].min(initial=np.inf)
    cost, overlaps = max(region.plane_height - lowest, 0.0), False
    for first, second, distance in shapes.overlaps():
        pair = {first.index(), second.index()}
        if indices := pair & depths.keys():
            if not pair & shapes.tool_bodies:
                depths[indices.pop()] -= distance
        else:
            cost -= distance
            overlaps |= distance < -MIN_OVERLAP_M
    large = sum(edge > _MAX_WALL_EDGE_TO_REACH_RATIO * region.reach for edge in WALL_EDGES_M[:-1])
    free = (k for k, depth in enumerate(depths.values()) if k >= large and depth == 0.0)
    rank = next(free, len(walls) - 1)
    cost += depths[walls[rank].index()]
    score = place.posture_score - _OVERLAP_COST_PER_M * cost - _COST_OF_ANY_OVERLAP * overlaps
    return place._replace(
        posture_score=score - _COST_OF_SMALLER_WALL * (rank - large),
        wall_edge_m=WALL_EDGES_M[rank],
        has_overlaps=overlaps,
    )


def lowest_tool_point(shapes: PostureShapes) -> Array:
    """Return the tool's lowest point p_W (3,) [m]; of a tool without shapes, its centre of mass."""
    points = shapes.points_on_bodies_W(shapes.tool_bodies)
    if not len(points):
        phi = shapes.arm.phi_load
        points = (shapes.X_WS @ (phi[1:4] / phi[0]))[np.newaxis]
    lowest = points[points[:, 2] < points[:, 2].min() + _LOWEST_POINTS_HEIGHT_TOLERANCE_M]
    return np.array([*lowest[:, :2].mean(axis=0), lowest[:, 2].min()])


def coordinates_along_axis(
    shapes: PostureShapes, bodies: Collection[BodyIndex], axis: str
) -> Array:
    """Return the coordinate (k,) along an axis of S, from So [m], of each point of the bodies."""
    points = shapes.X_WS.inverse() @ shapes.points_on_bodies_W(bodies).T
    along: Array = R_SA_BY_AXIS[axis].matrix()[:, 2] @ points
    return along


def extent_beyond_sensor(shapes: PostureShapes, bodies: Collection[BodyIndex], axis: str) -> float:
    """Return how far bodies extend beyond So along an axis of S [m], at least 0."""
    return float(coordinates_along_axis(shapes, bodies, axis).max(initial=0.0))


def _start_place_sort_key(place: StartPlace) -> tuple[float, float, bool, float]:
    enough_room = min(place.joint_margin, _SUFFICIENT_START_JOINT_MARGIN)
    enough_space = min(place.cube_half_m, _SUFFICIENT_CUBE_HALF_EDGE_M)
    return enough_room, enough_space, place.is_set_by_position, place.cube_half_m


def _with_reachable_cube(
    arm: ArmModel, place: StartPlace, has_six_dof: bool, vertical: bool
) -> StartPlace:
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    if vertical or not has_six_dof:
        signs = np.vstack([np.eye(3), -np.eye(3)])
    if vertical:
        signs = signs[[2, 5]]
    largest = 0.0
    for half in _CUBE_HALF_EDGES_M:
        if not all(_can_reach_cube_corner(arm, place, half * each, has_six_dof) for each in signs):
            break
        largest = half
    room = place.joint_margin if largest else 0.0
    return place._replace(cube_half_m=largest, joint_margin=room, moves_only_vertically=vertical)


def _can_reach_cube_corner(
    arm: ArmModel, place: StartPlace, displacement: Array, has_six_dof: bool
) -> bool:
    target = place.pose + np.append(np.zeros(4), displacement)
    q, status = find_posture(arm, target, place.q)
    if has_six_dof:
        return status == IkStatus.OK and bool(np.abs(q - place.q).max() < _MAX_JOINT_CHANGE_IN_CUBE)
    error = np.linalg.norm(arm.pose(q)[4:] - target[4:])
    return bool(error < _MAX_POSITION_ERROR_TO_DISPLACEMENT_RATIO * np.linalg.norm(displacement))


_MIN_COSINE_TOOL_TO_AXIS = 0.75  # smallest cosine of the angle between tool and axis
_ROUNDING_TOLERANCE_M = 1e-9
_MIN_DIRECTION_LENGTH_M = 0.02  # below, the offset of a centre of mass has no direction


def nearest_sensor_axis(direction: Array) -> str:
    """Return the axis of S nearest to a vector (3,) [m]; "" if it is short or between axes."""
    size = np.linalg.norm(direction)
    k = int(np.argmax(np.abs(direction)))
    if size < _MIN_DIRECTION_LENGTH_M or abs(direction[k]) < _MIN_COSINE_TOOL_TO_AXIS * size:
        return ""
    return ("-" if direction[k] < 0.0 else "") + "xyz"[k]


def sensor_axis_along_tool(arm: ArmModel, p_SScm_S: Array) -> str:
    """Return the axis of S along the tool, with the sign away from the arm.

    It is nearest to the tool's centre of mass `p_SScm_S` [m]; if that is near So or oblique, to the
    last joint's axis. Away means from the point of that axis that is nearest to the joint before.
    """
    R = arm.table[-2:, ROTATION_COLUMN:TRANSLATION_COLUMN].reshape(2, 3, 3)
    p = arm.table[-2:, TRANSLATION_COLUMN : TRANSLATION_COLUMN + 3]
    R_JS, p_arm_S_J = R[1], p[1] + np.array([0.0, 0.0, R[0, :, 2] @ p[0]])
    axis = nearest_sensor_axis(p_SScm_S) or nearest_sensor_axis(R_JS[2]) or "z"
    along = R_SA_BY_AXIS[axis].matrix()[:, 2]
    is_behind = along @ (R_JS.T @ p_arm_S_J + p_SScm_S) < -_ROUNDING_TOLERANCE_M
    return opposite_axis(axis) if is_behind else axis


def opposite_axis(axis: str) -> str:
    return axis[1:] if axis.startswith("-") else f"-{axis}"


def tool_frame_advice(
    model: Path, frame: str, axis: str, *, is_along_tool: bool = True, is_site: bool = False
) -> str:
    """Return how to add a frame with z along `axis` of sensor frame or MJCF site; "" for z."""
    if axis == "z":
        return ""
    R_SA, name = R_SA_BY_AXIS[axis], f"{frame}_z_to_tool"
    angles = RollPitchYaw(R_SA).vector() + 0.0
    rpy = " ".join(f"{angle:.5g}" for angle in angles)
    degrees = ", ".join(f"{angle:.5g}" for angle in np.degrees(angles))
    quaternion = " ".join(f"{part:.5g}" for part in R_SA.ToQuaternion().wxyz().round(5) + 0.0)
    kind = model.suffix.lower()
    lines = {
        ".xml": f'<body name="{name}" quat="{quaternion}"/> in the body {frame}',
        ".sdf": f'<frame name="{name}" attached_to="{frame}"><pose>0 0 0 {rpy}</pose></frame>'
        f" in the model of {frame}",
        ".yaml": f"- add_frame: {{name: {name}, X_PF: {{base_frame: MODEL::{frame},"
        f" rotation: !Rpy {{deg: [{degrees}]}}}}}}",
        ".urdf": f'<link name="{name}"/><joint name="{name}_joint" type="fixed">'
        f'<parent link="{frame}"/><child link="{name}"/><origin rpy="{rpy}"/></joint>',
    }
    # MJCF and SDF files may include the file with the sensor frame.
    place = f" to {model.name}" if kind not in (".xml", ".sdf") else ""
    advice = f"add{place} {lines[kind]} and give --sensor-frame {name}"
    if is_site:  # force sensors at the site keep their body as load
        turned = f'<frame POSE><site name="{frame}" quat="{quaternion}"/></frame>'
        advice = f"write the site {frame} as {turned}, where POSE is its pos and orientation"
    what = f"the tool points along {axis}_S" if is_along_tool else f"{axis}_S points down"
    return (
        f"{what}, so the start is in slave.home and the contact point in"
        f" slave.tip; to use slave.position, or another direction of the tool, {advice}"
    )
