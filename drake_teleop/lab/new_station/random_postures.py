"""Random postures of an arm, and conditions on a start posture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.arm import (
    IS_PRISMATIC_COLUMN,
    ROTATION_COLUMN,
    TRANSLATION_COLUMN,
    ArmModel,
)
from drake_teleop.station.slave.numeric_inverse_kinematics import orientation_weight_m
from drake_teleop.station.slave.posture_shapes import random_posture_limits

NUM_RANDOM_POSTURES = 20_000
_MIN_COS_TOOL_TILT = np.cos(np.radians(40.0))  # largest tilt of the tool axis from vertical
# Distance of S from the vertical line through the first joint, and its height above that joint, in
# units of the reach.
_SENSOR_RADIUS_RANGE_OVER_REACH, _SENSOR_HEIGHT_RANGE_OVER_REACH = (0.35, 0.85), (-0.75, 0.8)
# Preferred radius, height of the tool's end above the base plane, and height above the first joint.
_PREFERRED_RADIUS_OVER_REACH = 0.6
_PREFERRED_TOOL_HEIGHT_OVER_REACH = 0.25
_MIN_PREFERRED_SENSOR_HEIGHT_OVER_REACH = -0.4
_MAX_SENSOR_COORDINATE_W_M = 1.9  # of S; a wall of a scenario is within 2 m
_MIN_TOOL_END_HEIGHT_M = 0.05  # height of the tool's end above the base plane, for motion and wall
_HALF_ANGLE_OF_SIDE_RAD, _NUM_EXAMINED_SIDES, _FRONT_POSTURE_COUNT_FACTOR = np.arccos(0.9), 24, 2.0
_MIN_JOINT_ORIGIN_HEIGHT_M = 0.03  # height of joint origins above the base plane
_MAX_RELATIVE_ZERO_SINGULAR_VALUE = 1e-9  # singular values that are 0, over the largest
_NEUTRAL_ELBOW_OFFSET_TO_REACH_RATIO = 0.03  # smaller offsets have no direction
_SUFFICIENT_JOINT_MARGIN, _SUFFICIENT_SINGULAR_VALUE, _SUFFICIENT_ELBOW_UP_SHARE = 0.3, 0.05, 0.7


@dataclass(frozen=True, eq=False)
class Postures:
    """Joint positions of k postures, and the frames of the arm in each.

    Attributes:
        q: (k, n) joint positions [rad, m].
        origins: (k, n, 3) origins of the joints, p_W [m].
        axes: (k, n, 3) axes of the joints, in W.
        R_WS: (k, 3, 3) orientation of the sensor.
        p_WS: (k, 3) position of the sensor [m].
    """

    q: Array
    origins: Array
    axes: Array
    R_WS: Array
    p_WS: Array

    def __getitem__(self, rows: NDArray[np.intp]) -> Postures:
        return Postures(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class StartRegion:
    """Region in which a start is searched.

    Attributes:
        tool_length: distance from So to the tool's end [m].
        first_joint_W: (3,) origin of the first joint, p_W [m].
        plane_height: height z_W of the base plane [m].
        reach: horizontal distance that the arm reaches from its first joint [m].
        can_joint_be_above_plane: (n,) True for joints (not the first) that can be above the plane.
        side_direction_rad: direction of the region about z_W, from x_W [rad].
        removed_counts: (condition, number of postures that it removed).
    """

    plane_height: float
    tool_length: float
    first_joint_W: Array
    reach: float
    can_joint_be_above_plane: NDArray[np.bool_]
    side_direction_rad: float = 0.0
    removed_counts: tuple[tuple[str, int], ...] = ()

    @property
    def preferred_position(self) -> Array:
        """Position p_WS (3,) [m] near which a start posture has the best score."""
        r, height = _PREFERRED_RADIUS_OVER_REACH * self.reach, self.plane_height + self.tool_length
        height = max(
            height + _PREFERRED_TOOL_HEIGHT_OVER_REACH * self.reach,
            float(self.first_joint_W[2]) + _MIN_PREFERRED_SENSOR_HEIGHT_OVER_REACH * self.reach,
        )
        direction = np.array([np.cos(self.side_direction_rad), np.sin(self.side_direction_rad)])
        return np.array([*(self.first_joint_W[:2] + r * direction), height])


def postures_at(arm: ArmModel, q: Array) -> Postures:
    R, p = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    origins, axes = [], []
    for row, angle in zip(arm.table, [*q.T, np.zeros(len(q))], strict=True):
        p = p + R @ row[TRANSLATION_COLUMN : TRANSLATION_COLUMN + 3]
        R = R @ row[ROTATION_COLUMN:TRANSLATION_COLUMN].reshape(3, 3)
        origins.append(p)
        axes.append(R[:, :, 2])
        if row[IS_PRISMATIC_COLUMN]:
            p = p + angle[:, None] * R[:, :, 2]
        else:
            c, s, zero = np.cos(angle), np.sin(angle), 0.0 * angle
            rows = c, -s, zero, s, c, zero, zero, zero, zero + 1.0
            R = R @ np.stack(rows, 1).reshape(-1, 3, 3)  # rotation about z
    return Postures(q, np.stack(origins[:-1], 1), np.stack(axes[:-1], 1), R, p)


def random_postures(arm: ArmModel) -> Postures:
    lower, upper = random_posture_limits(arm)
    random = np.random.default_rng(0)
    return postures_at(arm, random.uniform(lower, upper, (NUM_RANDOM_POSTURES, arm.num_joints)))


def select_suitable_postures(
    postures: Postures, plane: float, tool_length: float
) -> tuple[Postures, StartRegion]:
    """Return postures with the tool downwards, in reach and above the base plane, and their region.

    Only the horizontal direction from the first joint with most postures remains. `plane` is the
    height z_W of the base plane [m].
    """
    first = postures.origins[:, 0].mean(axis=0)
    from_first = postures.p_WS - first
    radius = np.hypot(from_first[:, 0], from_first[:, 1])
    reach = float(np.quantile(radius, 0.98))
    tool_height = postures.p_WS[:, 2] - plane - tool_length
    lowest_origin = plane + _MIN_JOINT_ORIGIN_HEIGHT_M
    raised = postures.origins[:, :, 2].max(axis=0) > lowest_origin
    raised[0] = False
    in_region = tool_height > _MIN_TOOL_END_HEIGHT_M
    for values, (low, high) in (
        (radius, _SENSOR_RADIUS_RANGE_OVER_REACH),
        (from_first[:, 2], _SENSOR_HEIGHT_RANGE_OVER_REACH),
    ):
        in_region &= (values / reach > low) & (values / reach < high)
    in_region &= (np.abs(postures.p_WS) < _MAX_SENSOR_COORDINATE_W_M).all(axis=1)
    points_down = postures.R_WS[:, 2, 2] < -_MIN_COS_TOOL_TILT
    above_plane: Any = (postures.origins[:, raised, 2] > lowest_origin).all(axis=1)
    rows, removed = np.arange(len(radius)), list[tuple[str, int]]()
    for name, met in (
        ("this axis is more than 40 degrees from downwards", points_down),
        ("S is too near to the first joint, too far, too low or too high", in_region),
        ("a joint is below the base plane", above_plane),
    ):
        removed.append((name, int((~met[rows]).sum())))
        rows = rows[met[rows]]
    angle = np.arctan2(from_first[rows, 1], from_first[rows, 0])
    sides = 2.0 * np.pi * np.arange(_NUM_EXAMINED_SIDES) / _NUM_EXAMINED_SIDES
    counts = np.array([float(_is_azimuth_on_side(angle, side).sum()) for side in sides])
    counts[0] *= _FRONT_POSTURE_COUNT_FACTOR
    side = float(sides[int(np.argmax(counts))])
    region = StartRegion(plane, tool_length, first, reach, raised, side, tuple(removed))
    return postures[rows[_is_azimuth_on_side(angle, side)]], region


def _is_azimuth_on_side(azimuth: Array, side_azimuth: float) -> NDArray[np.bool_]:
    return np.cos(azimuth - side_azimuth) > np.cos(_HALF_ANGLE_OF_SIDE_RAD)


def posture_scores(arm: ArmModel, postures: Postures, region: StartRegion) -> Array:
    """Return a score (k,) of each posture; the highest is the best.

    It rates joint limits, singularities, elbow, base plane and distance to the preferred position.
    """
    margin = np.minimum(least_joint_margins(arm, postures.q) / _SUFFICIENT_JOINT_MARGIN, 1.0)
    L = orientation_weight_m(arm)
    # Only as many singular values as the arm has degrees of freedom.
    rank = sensor_degrees_of_freedom(arm, postures)
    smallest = _jacobian_singular_values(arm, postures)[:, rank - 1]
    sigma = np.minimum(smallest / (_SUFFICIENT_SINGULAR_VALUE * L), 1.0)
    upward = upward_share_of_elbow_offset(postures, region.reach)
    elbow = np.minimum(upward, _SUFFICIENT_ELBOW_UP_SHARE) / _SUFFICIENT_ELBOW_UP_SHARE
    origins = postures.origins[:, region.can_joint_be_above_plane, 2]
    low = np.maximum(region.plane_height + _MIN_JOINT_ORIGIN_HEIGHT_M - origins, 0.0)
    away = np.linalg.norm(postures.p_WS - region.preferred_position, axis=1) / region.reach
    return margin + sigma + elbow - 30.0 * low.max(axis=1, initial=0.0) - 0.5 * away


def least_joint_margins(arm: ArmModel, q: Array) -> Array:
    """Return the least distance (k,) of joints to limits over half the range; 1 without limits."""
    limited = np.isfinite(arm.lower) & np.isfinite(arm.upper)
    lower, upper, inner = arm.lower[limited], arm.upper[limited], q[:, limited]
    shares = 2.0 * np.minimum(inner - lower, upper - inner) / (upper - lower)
    return shares.min(axis=1, initial=1.0)


def _jacobian_singular_values(arm: ArmModel, postures: Postures) -> Array:
    # Rotations are multiplied by `orientation_weight_m` [m].
    slides = (arm.table[:-1, IS_PRISMATIC_COLUMN] != 0.0)[:, None]
    arms = postures.p_WS[:, None] - postures.origins
    linear = np.where(slides, postures.axes, np.cross(postures.axes, arms))
    angular = np.where(slides, 0.0, orientation_weight_m(arm) * postures.axes)
    return np.linalg.svd(np.concatenate([linear, angular], 2), compute_uv=False)


def sensor_degrees_of_freedom(arm: ArmModel, postures: Postures) -> int:
    """Return the degrees of freedom of the sensor: the largest rank of the Jacobian."""
    few = postures[np.arange(0, len(postures.q), max(len(postures.q) // 50, 1))]
    values = _jacobian_singular_values(arm, few)
    return int((values > _MAX_RELATIVE_ZERO_SINGULAR_VALUE * values[:, :1]).sum(axis=1).max())


def upward_share_of_elbow_offset(postures: Postures, reach: float) -> Array:
    """Return the upward share (k,) of the elbow's offset from the line shoulder-wrist, -1 to 1.

    The elbow is the joint farthest from the line of the first and last joint. Small offsets give 1.
    """
    shoulder, wrist = postures.origins[:, 0], postures.origins[:, -1]
    along = wrist - shoulder
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    offsets = postures.origins - shoulder[:, None]
    offsets = offsets - (offsets * along[:, None]).sum(axis=2, keepdims=True) * along[:, None]
    sizes = np.linalg.norm(offsets, axis=2)
    rows, farthest = np.arange(len(sizes)), sizes.argmax(axis=1)
    size = sizes[rows, farthest]
    up: Array = offsets[rows, farthest, 2] / np.maximum(size, 1e-9)
    return np.where(size > _NEUTRAL_ELBOW_OFFSET_TO_REACH_RATIO * reach, up, 1.0)
