"""Meshes of a robot model, and the removal of unusable ones."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model_references import ModelFiles

# Suffixes of meshes that Drake accepts as collision shapes.
_READABLE_SUFFIXES = (".obj", ".gltf", ".vtk")
# Triangle of a binary STL file.
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def remove_unusable_meshes(
    root: ElementTree.Element, files: ModelFiles, folder: Path
) -> dict[str, list[str]]:
    """Remove shapes without a usable mesh; return the affected links by fault.

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
    """Return the fault of a shape's mesh; if none, make its path absolute."""
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
    """Write the convex hull of an STL file as OBJ; return None if it is degenerate."""
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
