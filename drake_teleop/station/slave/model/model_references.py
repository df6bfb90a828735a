"""Files that a robot model references, and access rules, because models may be untrusted.

Only files inside the model's folder and its packages are read, after resolving symbolic links.
Packages are `package_paths`, ROS packages (package.xml) around the model and the installed Python
package around it. Include cycles are errors; number and size of files are limited.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from pydrake.multibody.parsing import PackageMap

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.texts import read_yaml

# Limits for all files together (repeated includes count again), and bytes of one text file.
_MAX_MODEL_FILES, _MAX_MODEL_BYTES, _MAX_TEXT_FILE_BYTES = 2000, 500_000_000, 50_000_000
_MAX_PATH_LENGTH = 4096
_MAX_INCLUDE_DEPTH = 20  # largest depth of nested includes
_XML_SUFFIXES = (".urdf", ".sdf", ".xml")
_MESH_AND_IMAGE_SUFFIXES = {".obj", ".glb", ".bin", ".stl", ".vtk", ".png", ".jpg", ".jpeg"}
_MESH_AND_IMAGE_SUFFIXES |= {".ktx2", ".dae"}
PACKAGE_FOLDER_SETTINGS = "--package-path, or package_paths in slave or master.leader"
"""Places where users name the folders of packages, for messages."""
MESHES_NOT_FOUND_FAULT = f"meshes were not found ({PACKAGE_FOLDER_SETTINGS})"
MESHES_UNREADABLE_FAULT = "meshes cannot be read (convert them to .obj or .stl)"
_ROS_MANIFEST_NAME = "package.xml"
_FILE_ATTRIBUTE_REGEX = re.compile(r"(file|filename|uri|url|file(right|left|up|down|front|back))\Z")
_FILE_ELEMENT_TAG_PATTERN = re.compile(r"(\{.*\}|drake:)?(file|filename|uri|url|\w*_map|sdf)\Z")
_FOLDER_ATTRIBUTES = ("meshdir", "texturedir", "assetdir")  # search folders of MJCF
_MTL_REFERENCE_PATTERN = re.compile(
    rb"^[ \t]*(?:map_\w+|bump|disp|decal|norm|refl)[ \t]+(.*)$", re.M
)
_OBJ_REFERENCE_PATTERN = re.compile(rb"^[ \t]*mtllib[ \t]+(.*)$", re.M)


class ModelFiles:
    """Access to the files that a model may read; `packages` are folders by package name."""

    def __init__(self, model: Path, package_paths: tuple[Path, ...]) -> None:
        self._model, self._folder = model, model.resolve().parent
        self._total = 0, 0
        _check_num_files_and_size(1, model.stat().st_size, model)
        self.packages: dict[str, Path] = {}
        for folder in package_paths:
            if not folder.is_dir():
                remedy = f"correct {PACKAGE_FOLDER_SETTINGS}"
                what = f"the package folder {folder} does not exist"
                raise DrakeTeleopError(what, where=str(model), remedy=remedy)
        inner = [each for folder in package_paths for each in sorted(folder.glob("*"))]
        for folder in (*package_paths, *inner):
            if folder.is_dir():
                self.packages.setdefault(folder.name, folder.resolve())
        around = [self._folder, *self._folder.parents]
        own = [folder for folder in around if os.path.isfile(folder / _ROS_MANIFEST_NAME)]
        text = model.read_bytes().decode("utf-8", errors="replace")
        for name in set(re.findall(r"(?:package|model)://([^/\s\"'<]+)", text)):
            beside = [each for each in around if os.path.isfile(each / name / _ROS_MANIFEST_NAME)]
            inside = [self._folder] if os.path.isdir(self._folder / name) else []
            named = [each for each in own if each.name == name]
            for folder in (*(each / name for each in inside), *named, *(e / name for e in beside)):
                if folder.resolve() == folder:  # neither a link nor ".."
                    self.packages.setdefault(name, folder)
        own += filter(_is_installed_python_package, around)
        self._roots = {self._folder, *own, *(folder.resolve() for folder in package_paths)}
        self.sizes: dict[Path, tuple[int, int]] = {}  # number and bytes of files, by file
        self._bases = {""}

    def merge_packages_with_map(self, known: PackageMap) -> None:
        """Add `packages` to Drake's map `known`, and its packages to them, without drake_models."""
        known.Remove("drake_models")
        for name, folder in self.packages.items():
            if known.Contains(name):  # the model's package replaces Drake's
                known.Remove(name)
            known.Add(name, str(folder))
        self.packages = {n: Path(known.GetPath(n)).resolve() for n in known.GetPackageNames()}

    def find_file(self, address: str, folder: Path | None = None) -> Path | None:
        """Return the existing file or folder at an address, or None.

        The address begins with package://, model:// or file://, or is a path relative to `folder`,
        by default the model's folder.
        """
        match = re.match(r"(?:package|model)://([^/]+)/?(.*)", address, re.S)
        if match:
            base = self.packages.get(match[1])
            path = None if base is None else base / match[2]
        else:
            path = (folder or self._folder) / address.removeprefix("file://")
        return next(iter(_existing_raw_and_normalized_paths(path)), None)

    def may_read_file(self, path: Path) -> bool:
        roots = (*self._roots, *self.packages.values())
        return any(path.resolve().is_relative_to(root) for root in roots)

    def file_access_fault(self, path: Path, kind: str) -> str:
        """Return why a file of `kind`, such as meshes, must not be read, or an empty text."""
        if not self.may_read_file(path):
            where = f"{kind} in {path.resolve().parent}"
            what = f"{where} are outside the model's folder and its packages"
            return f"{what} (name their folder: {PACKAGE_FOLDER_SETTINGS})"
        try:
            self.check_referenced_files(path)
        except DrakeTeleopError as error:
            return str(error)
        return ""

    def check_referenced_files(self, path: Path) -> None:
        """Raise DrakeTeleopError if a file references forbidden, missing, or too large files.

        Meshes of links in the model file itself are not checked, because unusable ones are removed.
        """
        folders = 0
        while folders < len(self._bases):  # MJCF folders also apply to files seen before
            folders = len(self._bases)
            self.sizes.clear()
            files, size = self._count_files_and_bytes(path, ())
        self._total = self._total[0] + files, self._total[1] + size
        _check_num_files_and_size(*self._total, self._model)

    def _count_files_and_bytes(self, path: Path, includers: tuple[Path, ...]) -> tuple[int, int]:
        real, where = path.resolve(), str(includers[-1] if includers else self._model)
        if not self.may_read_file(real):
            what = f"references {real}, which is outside the model's folder and its packages"
            remedy = f"move it there, or name its folder: {PACKAGE_FOLDER_SETTINGS}"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        if real in includers or len(includers) > _MAX_INCLUDE_DEPTH:
            what = "includes itself" if real in includers else "is nested too deeply"
            what = f"{what} through {path.name}"
            raise DrakeTeleopError(what, where=where, remedy="remove this reference")
        if real not in self.sizes:
            if not (real.is_file() or real.is_dir()):
                what = f"references {path}, which does not exist"
                raise DrakeTeleopError(what, where=where, remedy="correct the path or add the file")
            files, size = 1, real.stat().st_size
            _check_num_files_and_size(files, size, path)
            for named in list(self._referenced_files(real)):
                more = self._count_files_and_bytes(named, (*includers, real))
                files, size = files + more[0], size + more[1]
                _check_num_files_and_size(files, size, path)
            self.sizes[real] = files, size
        return self.sizes[real]

    def mesh_files(self) -> Iterator[Path]:
        """Yield readable meshes with textures, after `check_referenced_files` found the files."""
        texts = [path for path in self.sizes if path.suffix.lower() in _XML_SUFFIXES]
        for mesh in [m for path in texts for m in self._referenced_files(path, with_meshes=True)]:
            if not self.file_access_fault(mesh, "meshes"):
                yield from filter(os.path.isfile, self.sizes)

    def _referenced_files(self, path: Path, *, with_meshes: bool = False) -> Iterator[Path]:
        tops = [path.parent, self._folder]
        if path.suffix.lower() == ".sdf" and path != self._model.resolve():
            tops.append(Path.cwd())  # Drake resolves nested includes from here
        if path.is_dir() or path.suffix.lower() == ".config":  # Gazebo: names of files in it
            tops = [path if path.is_dir() else path.parent]
        folders = {top / base for top in tops for base in self._bases}
        try:
            for address in _all_addresses(path) if with_meshes else self._addresses_in_file(path):
                if len(address) > _MAX_PATH_LENGTH and path.suffix.lower() not in (".obj", ".mtl"):
                    limit = f"(at most {_MAX_PATH_LENGTH})"  # Drake aborts on it
                    what = f"references a file by an address of {len(address)} characters {limit}"
                    raise DrakeTeleopError(what, where=str(path), remedy="shorten the address")
                named = {self.find_file(address, folder) for folder in folders}
                found = set[Path]().union(*map(_existing_raw_and_normalized_paths, named))
                yield from found - {path.parent}
        except OSError as error:
            raise DrakeTeleopError(f"cannot be read ({error.strerror})", where=str(path)) from None

    def _addresses_in_file(self, path: Path) -> Iterator[str]:
        kind = path.suffix.lower()
        if path.is_dir():  # Gazebo model folder
            names = "model.config", "manifest.xml"
            yield from (name for name in names if (path / name).is_file())
        elif kind in (*_XML_SUFFIXES, ".config"):
            root = read_xml(path)
            self._bases |= {e.get(n, "") for e in root.iter("compiler") for n in _FOLDER_ATTRIBUTES}
            if self._model.suffix.lower() == ".xml":  # `MeshLibrary` checks the assets
                yield from (e.get("file", "") for e in root.iter("include"))
                return
            meshes = path != self._model.resolve() or kind == ".xml"
            yield from _addresses_in_xml(root, with_meshes=meshes)
        elif kind in (".yaml", ".yml"):
            yield from addresses_in_directives(read_yaml(path, tagged=True))
        elif kind in (".gltf", ".glb"):
            yield from _addresses_in_gltf(path)
        elif kind in (".obj", ".mtl"):
            pattern = _OBJ_REFERENCE_PATTERN if kind == ".obj" else _MTL_REFERENCE_PATTERN
            for line in pattern.findall(path.read_bytes()):
                words = line.decode("utf-8", errors="surrogateescape").split()
                yield from {*words, *(" ".join(words[k:]) for k in range(len(words)))}


def list_model_files(model: Path, package_paths: tuple[Path, ...]) -> list[Path]:
    """Return the model file, included files and meshes; an empty list if there is no such file."""
    if not os.path.isfile(model):
        return []
    try:
        files = ModelFiles(model, package_paths)
        files.check_referenced_files(model)
    except (DrakeTeleopError, OSError):  # the parser raises it again
        return [model]
    return sorted({*filter(os.path.isfile, files.sizes), *files.mesh_files()})


def _is_installed_python_package(folder: Path) -> bool:
    return (
        os.path.isfile(folder / "__init__.py")
        and any(each.is_dir() for each in folder.parent.glob("*.dist-info"))
        and not Path(os.path.expanduser("~")).resolve().is_relative_to(folder)
    )


def _existing_raw_and_normalized_paths(path: Path | None) -> list[Path]:
    try:
        both = [] if path is None else [path, Path(os.path.normpath(path))]
        return [each for each in dict.fromkeys(both) if os.path.exists(each)]
    except ValueError:  # invalid file name
        return []


def _check_num_files_and_size(files: int, size: int, path: Path) -> None:
    is_text = files == 1 and path.suffix.lower() not in _MESH_AND_IMAGE_SUFFIXES
    most = _MAX_TEXT_FILE_BYTES if is_text else _MAX_MODEL_BYTES
    if files > _MAX_MODEL_FILES or size > most:
        limit = f"{_MAX_MODEL_FILES} files" if files > _MAX_MODEL_FILES else f"{most // 10**6} MB"
        what, remedy = f"the model exceeds the limit of {limit}", "remove or simplify parts"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)


def read_xml(path: Path) -> Element:
    """Return the root element of an XML file, with `drake:` prefixes unchanged.

    A DrakeTeleopError is raised for malformed XML, which Drake reads but these checks cannot.
    """
    builder, parser = TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data

    def reject_undefined_entity(name: str | None, *_: object) -> NoReturn:
        raise ValueError(f"the entity {name} is not defined in this file")

    parser.SkippedEntityHandler = parser.ExternalEntityRefHandler = reject_undefined_entity
    try:
        parser.Parse(path.read_bytes().lstrip(), True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last two: invalid encoding
        remedy = "give a model of well-formed XML"
        raise DrakeTeleopError(f"is not XML ({error})", where=str(path), remedy=remedy) from None


def _all_addresses(path: Path) -> Iterator[str]:
    for address in _addresses_in_xml(read_xml(path), with_meshes=True):
        yield from {address, re.split(r"[/\\]", address)[-1]}  # the name alone: strippath of MJCF


def _addresses_in_xml(root: Element, *, with_meshes: bool) -> Iterator[str]:
    for element in root.iter():
        if element.tag in ("plugin", "script"):
            continue
        if element.tag != "mesh" or with_meshes:
            yield from (x for n, x in element.items() if _FILE_ATTRIBUTE_REGEX.match(n) and x)
            texts = (e.text for e in element if _FILE_ELEMENT_TAG_PATTERN.match(e.tag))
            yield from (text.strip() for text in texts if text and text.strip())


def addresses_in_directives(data: Any) -> Iterator[str]:
    """Yield the addresses of the files that model directives (YAML data) add."""
    directives = data.get("directives") if isinstance(data, dict) else None
    for each in directives if isinstance(directives, list) else []:
        for kind in ("add_model", "add_directives"):
            added = each.get(kind) if isinstance(each, dict) else None
            if isinstance(added, dict) and isinstance(added.get("file"), str):
                yield added["file"]


def _addresses_in_gltf(path: Path) -> list[str]:
    found: list[str] = []

    def collect_uris(fields: list[tuple[str, Any]]) -> None:
        for name, value in fields:  # includes duplicate names
            if name == "uri" and isinstance(value, str) and not value.startswith("data:"):
                found.extend({value, unquote(value)})

    data = path.read_bytes()
    if path.suffix.lower() == ".glb":
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    try:
        json.loads(data, object_pairs_hook=collect_uris)
    except (ValueError, RecursionError) as error:
        what = f"is not a glTF file ({error})"
        raise DrakeTeleopError(what, where=str(path), remedy="export it again") from None
    return found
