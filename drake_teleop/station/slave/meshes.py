"""The meshes of a robot model, and what to do without them."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model_references import ModelFiles

# Of meshes that Drake can use as collision shapes.
_READABLE = (".obj", ".gltf", ".vtk")
# Of a triangle in a binary STL file: normal, three corners, attributes.
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def without_lost_meshes(
    root: ElementTree.Element, files: ModelFiles, folder: Path
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
                if fault := _fault(shape, files, folder):
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


def _fault(shape: ElementTree.Element, files: ModelFiles, folder: Path) -> str | None:
    """What is wrong with the mesh of a shape; if nothing is, its path becomes absolute."""
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
        file = _hull_of_stl(file, folder)
    if file is None or file.suffix.lower() not in _READABLE:
        suffix = Path(address.strip()).suffix
        return f"{suffix} meshes cannot be read (convert them to .obj or .stl)"
    if mesh.get("filename"):
        mesh.set("filename", f"file://{file.resolve()}")  # Drake takes %20 as it is
    else:
        mesh.find("uri").text = f"file://{file.resolve()}"  # type: ignore[union-attr]
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
