"""Picture of a new station at its start, from two sides."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]
from scipy.spatial import ConvexHull, QhullError

from drake_teleop.common.numeric import Array
from drake_teleop.common.style import BLACK, BLUE, GREEN, GREY, VERMILION, Picture, plot_style
from drake_teleop.lab.new_station.plan import StationPlan
from drake_teleop.lab.new_station.random_postures import postures_at
from drake_teleop.station.slave.model.model_repair import MISSING_SHAPES_TEXT
from drake_teleop.station.slave.posture_shapes import PostureShapes

_LINK_COLOURS = ((0.74, 0.77, 0.82), (0.52, 0.57, 0.65))
_BASE_COLOUR, _TOOL_COLOUR, _WALL_COLOUR = (0.36, 0.38, 0.42), (0.84, 0.37, 0.0), (0.78, 0.66, 0.5)
_WALL_THICKNESS_M = 0.1
_LIGHT_DIRECTION = np.array([0.35, -0.5, 0.8])
_VIEW_ANGLES_DEG = ((18.0, -60.0), (3.0, -90.0))  # elevation and azimuth from the tool
_NUM_DRAWN_CELLS_PER_WALL_EDGE = 8  # divisions of the wall in the picture
_EXTREME_POINT_SEARCH_DIRECTIONS = np.random.default_rng(0).normal(size=(250, 3))


def draw_start_posture(plan: StationPlan, title: str) -> Figure:
    shapes, wall = plan.posture_shapes, plan.wall
    triangles, colours = _arm_triangles_and_colours(shapes)
    faces = _box_triangles(np.array(wall.position), np.array([*wall.size, _WALL_THICKNESS_M]))
    triangles, colours = [*triangles, faces], [*colours, _shaded_colours(faces, _WALL_COLOUR)]
    surfaces, face_colours = np.concatenate(triangles), np.concatenate(colours)
    at_start = postures_at(shapes.arm, plan.place.q[np.newaxis])
    chain = np.vstack([at_start.origins[0], at_start.p_WS])
    points = np.vstack([surfaces.reshape(-1, 3), chain])
    lower, upper = points.min(axis=0), points.max(axis=0)
    with plot_style():
        figure = Picture(figsize=(10.0, 5.0), facecolor="white")
        figure.suptitle(f"{title}: start posture", x=0.02, ha="left", fontsize=11)
        x, y, _ = plan.lowest_tool_point_W - shapes.arm.table[0, 9:12]
        side = np.degrees(np.arctan2(y, x))
        for k, (elevation, azimuth) in enumerate(_VIEW_ANGLES_DEG):
            axes: Any = figure.add_subplot(1, 2, k + 1, projection="3d", proj_type="ortho")
            paint = {"facecolors": face_colours, "edgecolors": face_colours, "linewidths": 0.4}
            axes.add_collection3d(Poly3DCollection(surfaces, **paint))
            axes.plot(*chain.T, color=BLACK, linewidth=0.9, marker="o", markersize=2.5, zorder=9)
            _draw_base_plane_grid(axes, lower, upper, plan.base_plane_height)
            _draw_sensor_axes(axes, shapes, 0.12 * float(max(upper - lower)))
            axes.view_init(elevation, side + azimuth)
            _set_equal_axis_limits(axes, lower, upper, plan.base_plane_height)
        gap = 1e3 * (plan.lowest_tool_point_W[2] - wall.position[2])
        plane = round(plan.base_plane_height, 3) + 0.0  # not -0
        caption = f"tool (orange) {gap:.0f} mm above the wall; base plane: z_W = {plane:g} m; "
        caption += "axes of S: x red, y green, z blue; "
        is_incomplete = any(MISSING_SHAPES_TEXT in text for text in plan.assumptions)
        caption += "shapes of some links are missing" if is_incomplete else "meshes as convex hulls"
        caption += ", sticks replace them" if shapes.has_sticks else ""
        figure.supxlabel(caption, x=0.02, ha="left", fontsize=9, color=BLACK)
    return figure


def _arm_triangles_and_colours(shapes: PostureShapes) -> tuple[list[Array], list[Array]]:
    anchored, rank = shapes.anchored_slave_bodies(), 0
    triangles, colours = [], []
    for body in sorted(shapes.moving_slave_bodies() | anchored, key=int):
        hulls = shapes.hull_points_W(body, visual=True)
        if body in shapes.tool_bodies:
            colour = _TOOL_COLOUR
        elif body in anchored:
            colour = _BASE_COLOUR
        else:
            colour, rank = _LINK_COLOURS[rank % 2], rank + bool(hulls)
        for points in hulls:
            faces = _hull_triangles(points)
            triangles.append(faces)
            colours.append(_shaded_colours(faces, colour))
    return triangles, colours


def _hull_triangles(points: Array) -> Array:
    if len(points) > len(_EXTREME_POINT_SEARCH_DIRECTIONS):
        points = points[np.unique((points @ _EXTREME_POINT_SEARCH_DIRECTIONS.T).argmax(axis=0))]
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return np.zeros((0, 3, 3))
    triangles = hull.points[hull.simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inwards = (normals * hull.equations[:, :3]).sum(axis=1) < 0.0
    triangles[inwards] = triangles[inwards][:, ::-1]
    return np.asarray(triangles)


def _box_triangles(top_centre: Array, size: Array) -> Array:
    # Small triangles are better sorted by depth than large ones.
    corners = np.array(list(product((0.0, 1.0), repeat=3)))
    counts = [_NUM_DRAWN_CELLS_PER_WALL_EDGE, _NUM_DRAWN_CELLS_PER_WALL_EDGE, 2]
    cells = np.array(list(product(*map(range, counts)))) / counts
    unit = np.concatenate([_hull_triangles(cell + corners / counts) for cell in cells])
    is_face = np.isclose(unit, 0.0).all(axis=1) | np.isclose(unit, 1.0).all(axis=1)
    return top_centre + size * (unit[np.any(is_face, axis=1)] - np.array([0.5, 0.5, 1.0]))


def _shaded_colours(triangles: Array, colour: tuple[float, float, float]) -> Array:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    bright = 0.72 + 0.28 * (normals @ (_LIGHT_DIRECTION / np.linalg.norm(_LIGHT_DIRECTION)))
    return np.clip(np.outer(bright, colour), 0.0, 1.0)


def _draw_base_plane_grid(axes: Any, lower: Array, upper: Array, height: float) -> None:
    margin = 0.1 * float(max(upper - lower))
    x = np.linspace(lower[0] - margin, upper[0] + margin, 7)
    y = np.linspace(lower[1] - margin, upper[1] + margin, 7)
    lines = [[(a, y[0], height), (a, y[-1], height)] for a in x]
    lines += [[(x[0], b, height), (x[-1], b, height)] for b in y]
    axes.add_collection3d(Line3DCollection(lines, colors=GREY, linewidths=0.4, alpha=0.6))


def _draw_sensor_axes(axes: Any, shapes: PostureShapes, length: float) -> None:
    X_WS = shapes.X_WS
    start, ends = X_WS.translation(), X_WS.translation() + length * X_WS.rotation().matrix().T
    for end, colour in zip(ends, (VERMILION, GREEN, BLUE), strict=True):
        axes.plot(*np.array([start, end]).T, color=colour, linewidth=2.0, zorder=10)


def _set_equal_axis_limits(axes: Any, lower: Array, upper: Array, plane: float) -> None:
    lower = np.minimum(lower, [np.inf, np.inf, plane])
    middle, half = (lower + upper) / 2.0, 0.5 * float(max(upper - lower))
    for set_limits, m in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        set_limits(m - half, m + half)
    axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.15)
    axes.set_axis_off()
