"""Removal of unusable meshes of a robot model, and sticks in place of missing visuals."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import Capsule
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, Joint, RigidBody, WeldJoint

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model_references import ModelFiles

# Suffixes of meshes that Drake accepts as collision shapes.
_READABLE_SUFFIXES = (".obj", ".gltf", ".vtk")
# Triangle of a binary STL file.
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_STICK_RADIUS_M = 0.035
_STICK_COLOUR = np.array([0.62, 0.64, 0.67, 1.0])


def remove_unusable_meshes(
    root: ElementTree.Element, files: ModelFiles, folder: Path
) -> dict[str, list[str]]:
    """Remove shapes without a usable mesh; return the names of the affected links by fault.

    STL files become convex hulls, because Drake does not read STL; other paths become absolute.
    A lost visual is reported only for links without shapes, a lost collision shape only for links
    without a visual or with other collision shapes.
    """
    lost: dict[str, list[str]] = {}
    for link in root.iter("link"):
        faults = {"collision": set[str](), "visual": set[str]()}
        for kind, removed in faults.items():
            for shape in link.findall(kind):
                if fault := _mesh_fault(shape, files, folder):
                    link.remove(shape)
                    removed.add(fault)
        if link.find("collision") is not None:
            reported = faults["collision"]
        elif link.find("visual") is not None:
            reported = set()
        else:
            reported = faults["collision"] | faults["visual"]
        for fault in sorted(reported):
            lost.setdefault(fault, []).append(link.get("name", ""))
    return lost


def _mesh_fault(shape: ElementTree.Element, files: ModelFiles, folder: Path) -> str | None:
    """Return the fault of a shape's mesh as text; without a fault, make its path absolute."""
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return None
    address = mesh.get("filename") or mesh.findtext("uri") or ""
    file = files.file(address.strip())
    if file is None or not file.is_file():
        return "meshes were not found (--package-path, slave.package_paths)"
    try:
        files.check(file)
    except DrakeTeleopError as error:
        return str(error)
    if file.suffix.lower() == ".stl":
        file = _convert_stl_to_hull(file, folder)
    if file is None or file.suffix.lower() not in _READABLE_SUFFIXES:
        suffix = Path(address.strip()).suffix
        return f"{suffix} meshes cannot be read (convert them to .obj or .stl)"
    if mesh.get("filename"):
        mesh.set("filename", f"file://{file.resolve()}")  # Drake does not decode %20
    else:
        mesh.find("uri").text = f"file://{file.resolve()}"  # type: ignore[union-attr]
    return None


def _convert_stl_to_hull(path: Path, folder: Path) -> Path | None:
    """Write the convex hull of an STL file as OBJ; return None for a degenerate hull."""
    text = _hull_of_stl(path, path.stat().st_mtime_ns)
    if text is None:
        return None
    target = folder / f"{len(list(folder.iterdir()))}_{path.stem}.obj"
    target.write_text(text)
    return target


@lru_cache(maxsize=256)  # a station reads its model several times
def _hull_of_stl(path: Path, _: int) -> str | None:
    from scipy.spatial import ConvexHull, QhullError

    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * _TRIANGLE.itemsize:
        corners = np.frombuffer(data, _TRIANGLE, count, 84)["corners"].reshape(-1, 3)
    else:
        lines = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
        corners = np.array(lines, dtype=float).reshape(-1, 3)
    try:
        hull = ConvexHull(corners.astype(float))
    except (QhullError, ValueError):
        return None
    number = {vertex: k + 1 for k, vertex in enumerate(hull.vertices)}
    rows = ["v {:.9g} {:.9g} {:.9g}".format(*hull.points[vertex]) for vertex in hull.vertices]
    rows += ["f {} {} {}".format(*(number[k] for k in face)) for face in hull.simplices]
    return "\n".join(rows) + "\n"


def AddSkeleton(plant: MultibodyPlant, sensor_frame: Frame) -> None:
    """Add sticks to links without visuals, each from its joint to the next, or to S."""
    joints = map(plant.get_joint, plant.GetJointIndices())
    inboard = {joint.child_body().index(): joint for joint in joints}
    end, body = sensor_frame, sensor_frame.body()
    while body.index() in inboard:
        joint = inboard[body.index()]
        parent = joint.parent_body()
        on_world = parent.index() == plant.world_body().index()
        if not isinstance(joint, WeldJoint):
            _add_stick(plant, joint.frame_on_child(), _in_body(end, body, inboard), body)
            end = joint.frame_on_parent()
        elif on_world:
            _add_stick(plant, body.body_frame(), _in_body(end, body, inboard), body)
        body = parent


def _in_body(frame: Frame, body: RigidBody, inboard: dict[BodyIndex, Joint]) -> RigidTransform:
    """Return the pose X_BodyFrame of a frame on the body, or on a body welded to it."""
    pose, on = frame.GetFixedPoseInBodyFrame(), frame.body()
    while on.index() != body.index():
        weld = inboard[on.index()]
        X_FB = weld.X_FM() @ weld.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        pose = weld.frame_on_parent().GetFixedPoseInBodyFrame() @ X_FB @ pose
        on = weld.parent_body()
    return pose


def _add_stick(plant: MultibodyPlant, first: Frame, last: RigidTransform, body: RigidBody) -> None:
    if plant.GetVisualGeometriesForBody(body):
        return
    start = first.GetFixedPoseInBodyFrame().translation()
    way = last.translation() - start
    length = float(np.linalg.norm(way))
    along = way / length if length > _STICK_RADIUS_M else np.array([0.0, 0.0, 1.0])
    pose = RigidTransform(RotationMatrix.MakeFromOneVector(along, 2), start + way / 2)
    stick = Capsule(_STICK_RADIUS_M, max(length, 1e-3))
    plant.RegisterVisualGeometry(body, pose, stick, f"stick_of_{body.name()}", _STICK_COLOUR)
