"""Removal of unusable shapes from a robot model, and sticks in place of missing visuals."""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import Capsule, Mesh
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, Joint, RigidBody, WeldJoint

from drake_teleop.common.errors import silent_stderr
from drake_teleop.station.slave.model.model_numbers import MAX_MODEL_VALUE_SI, parse_number
from drake_teleop.station.slave.model.model_references import PACKAGE_FOLDER_SETTINGS, ModelFiles
from drake_teleop.station.slave.model.triangles import convex_hull, obj_text, read_triangles

# Numbers of each dimension of a shape.
_NUM_VALUES_OF_SHAPE_SIZES = {
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
    "ellipsoid": {"a": 1, "b": 1, "c": 1},
    "mesh": {},
    "plane": {},
}
_SKELETON_STICK_RADIUS_M = 0.035
_SKELETON_COLOUR = np.array([0.62, 0.64, 0.67, 1.0])


def remove_unusable_shapes(
    root: ElementTree.Element, model: Path, files: ModelFiles, folder: Path | None
) -> dict[str, list[str]]:
    """Remove shapes that Drake cannot read; return the names of the affected links by fault.

    Addresses relative to the file `model` become absolute. STL meshes are converted to convex hulls
    in `folder`, because Drake does not read STL. Without `folder` all shapes are removed. A lost
    visual is reported only for links without shapes, a lost collision shape only for links without
    a visual or with other collision shapes.
    """
    lost: dict[str, list[str]] = {}
    for link in root.iter("link"):
        faults = {"collision": set[str](), "visual": set[str]()}
        for kind, removed in faults.items():
            for shape in link.findall(kind):
                fault = _shape_fault(shape) or _resolve_mesh_file(shape, model, files, folder)
                if fault:
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
        for shape in [*link.findall("collision"), *link.findall("visual")] if not folder else []:
            link.remove(shape)
    return lost


def _shape_fault(shape: ElementTree.Element) -> str | None:
    inner = shape.find("geometry/*")
    kind = "" if inner is None else inner.tag.removeprefix("drake:")
    if inner is None or kind not in _NUM_VALUES_OF_SHAPE_SIZES:
        return f"{kind or 'empty'} shapes cannot be read"
    sizes = {"radii": 3} if inner.find("radii") is not None else _NUM_VALUES_OF_SHAPE_SIZES[kind]
    for name, count in sizes.items():
        values = _numbers_in_text(inner.get(name) or inner.findtext(name))
        if len(values) != count or not all(0.0 < value <= MAX_MODEL_VALUE_SI for value in values):
            limits = f"not between 0 and {MAX_MODEL_VALUE_SI:g} m"
            return f"the {name} of a {kind} is incomplete or {limits}"
    scale = _numbers_in_text(inner.get("scale") or inner.findtext("scale"))
    valid = len(scale) in (0, 1, 3) and all(0.0 < abs(x) <= MAX_MODEL_VALUE_SI for x in scale)
    for place in (*shape.findall("origin"), *shape.findall("pose")):
        texts = place.get("xyz", "0 0 0"), place.get("rpy", "0 0 0"), place.text
        for text, counts in zip(texts, ((3,), (3,), (0, 6, 7)), strict=True):
            values = _numbers_in_text(text)
            valid &= len(values) in counts and all(abs(x) <= MAX_MODEL_VALUE_SI for x in values)
    return None if valid else "a pose or scale is no list of finite numbers"


def _numbers_in_text(text: str | None) -> list[float]:
    return [parse_number(word) for word in (text or "").split()]


def _resolve_mesh_file(
    shape: ElementTree.Element, model: Path, files: ModelFiles, folder: Path | None
) -> str | None:
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return None
    address = (mesh.get("filename") or mesh.findtext("uri") or "").strip()
    file = files.find_file(address, model.resolve().parent)
    if file is None or not file.is_file():
        return f"meshes were not found ({PACKAGE_FOLDER_SETTINGS})"
    if fault := files.file_access_fault(file, "meshes"):
        return fault
    suffix, written = file.suffix.lower(), file.stat().st_mtime_ns
    if suffix not in (".stl", ".obj", ".gltf", ".vtk"):
        return f"{Path(address).suffix} meshes cannot be read (convert them to .obj or .stl)"
    if (suffix == ".stl" or shape.tag == "collision") and not _is_mesh_readable(file, written):
        return f"{Path(address).suffix} meshes are empty or damaged"
    if suffix == ".stl" and folder is not None:
        target = folder / f"{len(list(folder.iterdir()))}_{file.stem}.obj"
        target.write_text(_obj_text_of_stl(file, written))
        file = target
    if mesh.get("filename"):
        mesh.set("filename", f"file://{file.resolve()}")  # Drake does not decode %20
    else:
        mesh.find("uri").text = f"file://{file.resolve()}"  # type: ignore[union-attr]
    return None


@lru_cache(maxsize=1024)
def _is_mesh_readable(path: Path, _: int) -> bool:  # the time: an edited file is read again
    try:
        if path.suffix.lower() not in (".gltf", ".vtk"):
            return len(read_triangles(path).faces) > 0
        with silent_stderr():
            return Mesh(str(path)).GetConvexHull().num_vertices() >= 3
    except (RuntimeError, ValueError):
        return False


@lru_cache(maxsize=1024)
def _obj_text_of_stl(path: Path, _: int) -> str:
    triangles = read_triangles(path)
    with suppress(ValueError):
        triangles = convex_hull(triangles.vertices)
    return obj_text(triangles)


def AddSkeleton(plant: MultibodyPlant, sensor_frame: Frame) -> None:
    """Add a stick as visual shape to links without visuals, from joint to joint or to S."""
    joints = map(plant.get_joint, plant.GetJointIndices())
    inboard = {joint.child_body().index(): joint for joint in joints}
    end, body = sensor_frame, sensor_frame.body()
    while body.index() in inboard:
        joint = inboard[body.index()]
        parent = joint.parent_body()
        on_world = parent.index() == plant.world_body().index()
        if not isinstance(joint, WeldJoint):
            _add_stick(plant, joint.frame_on_child(), _frame_pose_in_body(end, body, inboard), body)
            end = joint.frame_on_parent()
        elif on_world:
            _add_stick(plant, body.body_frame(), _frame_pose_in_body(end, body, inboard), body)
        body = parent


def _frame_pose_in_body(
    frame: Frame, body: RigidBody, inboard: dict[BodyIndex, Joint]
) -> RigidTransform:
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
    along = way / length if length > _SKELETON_STICK_RADIUS_M else np.array([0.0, 0.0, 1.0])
    pose = RigidTransform(RotationMatrix.MakeFromOneVector(along, 2), start + way / 2)
    stick = Capsule(_SKELETON_STICK_RADIUS_M, max(length, 1e-3))
    plant.RegisterVisualGeometry(body, pose, stick, f"stick_of_{body.name()}", _SKELETON_COLOUR)
