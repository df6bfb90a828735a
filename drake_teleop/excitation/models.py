"""Reading robot models as they are found: meshes missing, base hanging free, packages elsewhere."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.excitation.model_check import WORLD, check_model, check_tree
from drake_teleop.silence import silent_stderr
from drake_teleop.texts import read_text, read_yaml

# Of meshes that Drake can use as collision shapes.
_READABLE = (".obj", ".gltf", ".vtk")
# Of a triangle in a binary STL file: normal, three corners, attributes.
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


@dataclass(frozen=True)
class ParsedModel:
    """What `ParseModel` found.

    Attributes:
        instance: the arm's.
        sensor_frame: S.
        efforts: torque limits by joint [N m]; Drake drops them where a URDF has no transmission.
        lost: which meshes are missing in the shape of which links; by what is wrong with them.
        assumptions: on what else is missing.
        folder: of converted meshes; Drake reads them when it needs them.
    """

    instance: ModelInstanceIndex
    sensor_frame: Frame
    efforts: dict[str, float]
    lost: dict[str, list[str]]
    assumptions: list[str]
    folder: TemporaryDirectory[str]


def ParseModel(
    plant: MultibodyPlant, path: Path, sensor_frame: str, package_paths: tuple[Path, ...] = ()
) -> ParsedModel:
    """Parses a model and welds its base to the world if it hangs on nothing.

    Args:
        plant: not finalized.
        path: a URDF or SDF, or anything else that Drake reads by its suffix.
        sensor_frame: name of the frame or link at which the sensor measures.
        package_paths: folders in which `package://` addresses are looked up.

    Raises:
        DrakeTeleopError: if the file cannot be read, has no such frame, or says what cannot be
            true of an arm, see `check_model`.
    """
    if not os.path.isfile(path):
        raise DrakeTeleopError("there is no such file", where=str(path))
    packages = _Packages(path, package_paths)
    parser = Parser(plant)
    for name, folder in packages.found.items():
        if parser.package_map().Contains(name):  # Drake's own, which theirs takes the place of
            parser.package_map().Remove(name)
        parser.package_map().Add(name, str(folder))
    kind = path.suffix.lower().removeprefix(".")
    efforts: dict[str, float] = {}
    lost: dict[str, list[str]] = {}
    assumptions: list[str] = []
    converted = TemporaryDirectory(prefix="drake_teleop_")
    root = _xml(path) if kind in ("urdf", "sdf") else None
    if kind == "yaml":
        read_yaml(path, tagged=True)  # Drake's parser overflows its stack over many brackets
    elif kind == "xml":
        read_text(path)  # or names cannot be said
    with drakes_errors_said(path):
        if root is None:
            with _drakes_errors_raised():
                instances = parser.AddModels(str(path))
        else:
            assumptions = check_model(root, str(path))
            lost = _without_lost_meshes(root, packages, Path(converted.name))
            efforts = _efforts(root)
            text = ElementTree.tostring(root, encoding="unicode")
            with _drakes_errors_raised():
                instances = parser.AddModelsFromString(text, kind)
    having = [i for i in instances if plant.HasFrameNamed(sensor_frame, i)]
    if len(having) != 1:
        frames = [
            plant.get_frame(index).name()
            for instance in instances
            for index in plant.GetFrameIndices(instance)
        ]
        # Drake's own, of joints.
        frames = [name for name in frames if not name.endswith(("_parent", "_child", "__model__"))]
        raise DrakeTeleopError(
            f"{len(having) or 'no'} frames are named {sensor_frame!r}",
            where=str(path),
            remedy=f"--sensor-frame with one of {', '.join(sorted(set(frames)))}",
        )
    frame = plant.GetFrameByName(sensor_frame, having[0])
    _weld_base(plant, frame, {} if root is None else _peculiar_joints(root), str(path))
    return ParsedModel(having[0], frame, efforts, lost, assumptions, converted)


@contextmanager
def drakes_errors_said(path: Path) -> Iterator[None]:
    """Makes one error, with the file, of what Drake raises over a model: at parsing or later."""
    try:
        yield
    except DrakeTeleopError:
        raise
    # SystemExit: a condition of Drake's; LookupError: of the containers of C++.
    except (RuntimeError, SystemExit, ValueError, LookupError) as error:
        reason = str(error).replace("<literal-string>", "")
        raise DrakeTeleopError(
            f"cannot be read as a robot ({reason.strip()})",
            where=str(path),
            remedy="give a URDF, SDF, MJCF or .dmd.yaml model, with --package-path for package://",
        ) from None


@contextmanager
def _drakes_errors_raised() -> Iterator[None]:
    """Raises RuntimeError for an error that Drake only logs, going on without what it cannot read.

    Its warnings are of elements that it does not know; they are not said.
    """
    errors: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            errors.append(record.getMessage())
        return False

    log = logging.getLogger("drake")
    log.addFilter(keep)
    try:
        with silent_stderr():  # where the parsers below it write some more
            yield
    finally:
        log.removeFilter(keep)
    if errors:
        raise RuntimeError(errors[0])


def _xml(path: Path) -> ElementTree.Element:
    """The root of an XML file, with names as they stand there: Drake knows its own by `drake:`.

    Drake's parser reads what is no XML too. That would be checked by nobody, so it is an error.
    """
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data

    def unread(name: str | None, *_: object) -> NoReturn:
        raise ValueError(f"the entity {name} is not in this file")

    parser.SkippedEntityHandler = parser.ExternalEntityRefHandler = unread
    try:
        parser.Parse(path.read_bytes(), True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last two of its encoding
        remedy = "give a URDF or SDF that other readers of XML take too"
        raise DrakeTeleopError(f"is not XML ({error})", where=str(path), remedy=remedy) from None


def _weld_base(plant: MultibodyPlant, frame: Frame, peculiar: dict[str, str], where: str) -> None:
    def name_of(body: RigidBody) -> str:
        is_world = body.index() == plant.world_body().index()
        return WORLD if is_world else body.scoped_name().get_full()

    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    # Once more, because `check_model` looks neither into other files nor beyond URDF and SDF.
    check_tree(
        ((each.name(), name_of(each.parent_body()), name_of(each.child_body())) for each in joints),
        where,
    )
    inboard = {joint.child_body().index(): joint for joint in joints}
    body, chain = frame.body(), list[str]()
    while body.index() in inboard:
        chain.append(inboard[body.index()].name())
        body = inboard[body.index()].parent_body()
    for name in (*chain, body.name()):
        if name in peculiar:
            raise DrakeTeleopError(
                f"{name} {peculiar[name]}",
                where=where,
                remedy="the arm up to the sensor has to be a chain of independent revolute joints",
            )
    if body.index() != plant.world_body().index():
        plant.WeldFrames(plant.world_frame(), body.body_frame())


def _peculiar_joints(root: ElementTree.Element) -> dict[str, str]:
    """Joints that move with another one, and links that float on another link: Drake ignores both.

    By the name of joint or link, what it does.
    """
    found = {}
    for joint in root.iter("joint"):
        if joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
            found[joint.get("name", "")] = "moves with another joint (mimic)"
        for parent, child in zip(joint.findall("parent"), joint.findall("child"), strict=False):
            if joint.get("type") == "floating" and parent.get("link") != "world":
                found[child.get("link", "")] = f"floats on {parent.get('link')}"
    return found


class _Packages:
    """Where the addresses of a model's meshes lead."""

    def __init__(self, model: Path, package_paths: tuple[Path, ...]) -> None:
        self._folder = model.resolve().parent
        self.found: dict[str, Path] = {}
        text = model.read_bytes().decode("utf-8", errors="replace")
        for name in set(re.findall(r"package://([^/\s\"'<]+)", text)):
            for folder in (*package_paths, self._folder, *self._folder.parents):
                for candidate in (folder / name, folder):
                    if os.path.isdir(candidate) and candidate.name == name:
                        self.found.setdefault(name, candidate.resolve())

    def file(self, address: str) -> Path | None:
        """The file at an address; None if it is not there."""
        match = re.match(r"(package|model)://([^/]+)/(.*)", address)
        if match:
            folder = self.found.get(match[2])
            path = None if folder is None else folder / match[3]
        else:
            path = self._folder / address.removeprefix("file://")
        return path if path is not None and os.path.isfile(path) else None


def _without_lost_meshes(
    root: ElementTree.Element, packages: _Packages, folder: Path
) -> dict[str, list[str]]:
    """Removes shapes whose mesh is missing or not readable, and makes the others' paths absolute.

    Instead of STL files, which Drake does not read, there stand their convex hulls.

    Returns:
        By what is wrong with a mesh, the links whose shape lacks it. What a link is seen with may
        stand for what it collides with.
    """
    lost: dict[str, list[str]] = {}
    for link in root.iter("link"):
        faults = {"collision": set[str](), "visual": set[str]()}
        for kind, of_kind in faults.items():
            for shape in link.findall(kind):
                if fault := _fault(shape, packages, folder):
                    link.remove(shape)
                    of_kind.add(fault)
        if link.find("collision") is not None:
            counting = faults["collision"]
        elif link.find("visual") is not None:
            counting = set()
        else:
            counting = faults["collision"] | faults["visual"]
        for fault in sorted(counting):
            lost.setdefault(fault, []).append(link.get("name", ""))
    return lost


def _fault(shape: ElementTree.Element, packages: _Packages, folder: Path) -> str | None:
    """What is wrong with the mesh of a shape; if nothing is, its path becomes absolute."""
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return None
    address = mesh.get("filename") or mesh.findtext("uri") or ""
    file = packages.file(address.strip())
    if file is None:
        return "meshes were not found (--package-path)"
    if file.suffix.lower() == ".stl":
        file = _hull_of_stl(file, folder)
    if file is None or file.suffix.lower() not in _READABLE:
        suffix = Path(address.strip()).suffix
        return f"{suffix} meshes cannot be read (convert them to .obj or .stl)"
    if mesh.get("filename"):
        mesh.set("filename", file.as_uri())
    else:
        mesh.find("uri").text = file.as_uri()  # type: ignore[union-attr]
    return None


def _hull_of_stl(path: Path, folder: Path) -> Path | None:
    """An OBJ file with the convex hull of an STL file's corners; None if they have none."""
    from scipy.spatial import ConvexHull, QhullError

    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * _TRIANGLE.itemsize:
        corners = np.frombuffer(data, _TRIANGLE, count, 84)["corners"].reshape(-1, 3)
    else:
        lines = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
        corners = np.array(lines, dtype=float).reshape(-1, 3)
    try:
        hull = ConvexHull(np.unique(corners.astype(float), axis=0))
    except (QhullError, ValueError):
        return None
    number = {vertex: k + 1 for k, vertex in enumerate(hull.vertices)}
    rows = ["v {:.9g} {:.9g} {:.9g}".format(*hull.points[vertex]) for vertex in hull.vertices]
    rows += ["f {} {} {}".format(*(number[k] for k in face)) for face in hull.simplices]
    target = folder / f"{len(list(folder.iterdir()))}_{path.stem}.obj"
    target.write_text("\n".join(rows) + "\n")
    return target


def _efforts(root: ElementTree.Element) -> dict[str, float]:
    """Torque limits of URDF joints."""
    limits = ((joint.get("name"), joint.find("limit")) for joint in root.findall("joint"))
    return {
        name: float(limit.get("effort", "0"))
        for name, limit in limits
        if name is not None and limit is not None
    }
