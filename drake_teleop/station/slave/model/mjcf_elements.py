"""Elements of an MJCF file, with its includes, compiler settings and class defaults applied."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model.model_numbers import MAX_MODEL_VALUE_SI, parse_numbers
from drake_teleop.station.slave.model.model_references import read_xml
from drake_teleop.station.slave.model.model_repair import ModelRepair

_MAX_ELEMENT_NESTING_DEPTH = 150  # largest depth of nested elements
MIN_DIRECTION_LENGTH = 1e-9
"""Shortest vector that has a direction."""
_ORIENTATION_ATTRIBUTES = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
# A shorter list is completed by the last numbers of the default.
_PADDED_ATTRIBUTES = ("size", "gear", "gainprm", "biasprm", "friction")
_ACTUATOR_TAGS = {"general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder"}
_ACTUATOR_TAGS |= {"muscle", "adhesion", "dcmotor", "plugin"}
_MAIN_DEFAULT_CLASS = "main"  # name of the class at the top


class Attributes(dict[str, str]):
    """Attributes of one XML element, which faults in `model` call `label`."""

    def __init__(self, values: dict[str, str], label: str, model: ModelRepair) -> None:
        super().__init__(values)
        self.label, self._model = label, model

    def numbers(
        self, name: str, default: tuple[float, ...], max_magnitude: float = math.inf
    ) -> list[float]:
        """Return the numbers of attribute `name`; report invalid ones and return `default`."""
        values, fault = parse_numbers(self.get(name)), ""
        if not all(map(math.isfinite, values)):
            fault = "is not a list of numbers"
        elif max(map(abs, values), default=0.0) > max_magnitude:
            fault = f"exceeds {max_magnitude:g}"
        if fault:
            self._model.add_fault(f"{self.label}: {name} {self[name]!r} {fault}")
            return list(default)
        return [*values, *default[len(values) :]][: len(default)]

    def vector(self, name: str, default: tuple[float, ...]) -> Array:
        """Return the numbers in attribute `name`, or `default`; report a wrong count as a fault."""
        count, values = len(default), self.numbers(name, default)
        has_wrong_count = len(self.get(name, "").split()) not in (0, count)
        if has_wrong_count or max(map(abs, values)) > MAX_MODEL_VALUE_SI:
            what = f"{name} {self[name]!r} is not {count} numbers up to {MAX_MODEL_VALUE_SI:g}"
            self._model.add_fault(f"{self.label}: {what}")
            return np.array(default)
        return np.array(values)

    def number(self, name: str, default: float) -> float:
        return self.numbers(name, (default,))[0]

    @property
    def has_contact(self) -> bool:
        return any(self.number(name, 1.0) != 0.0 for name in ("contype", "conaffinity"))

    def read_range(self, name: str, flag: str, *, autolimits: bool) -> tuple[float, float] | None:
        """Return the limits (lower, upper) in attribute `name`, or None if they are switched off.

        Attribute `flag` switches them: true, false, or auto (the default): limits apply if they
        differ and `autolimits` of the compiler element is true.
        """
        lower, upper = self.numbers(name, (0.0, 0.0))
        limited = self.get(flag, "auto")
        if limited == "false" or (limited == "auto" and not (autolimits and lower != upper)):
            return None
        if lower > upper:
            self._model.add_fault(f"{self.label}: swap the ends of {name}, {lower:g} to {upper:g}")
        return lower, upper


class Mjcf:
    """Content of the MJCF file `model.path` with its includes, class defaults and settings."""

    def __init__(self, model: ModelRepair) -> None:
        self.model, self.root = model, model.root
        self._folders: dict[Element, Path] = {}  # of included elements
        if self.root.tag != "mujoco":
            what = f"does not contain a mujoco tag, but the root tag {self.root.tag}"
            raise DrakeTeleopError(what, where=str(model.path), remedy="give an MJCF file")
        self._insert_includes(self.root, model.path, {model.path.resolve()}, 0)
        self.compiler = Attributes({}, "compiler", model)
        for element in self.root.findall("compiler"):
            self.compiler.update(element.attrib)
        if self.compiler.get("coordinate", "local") != "local":
            what = "coordinate='global', which MuJoCo no longer reads either"
            self.model.add_fault(f"{what}; give local coordinates")
        self.autolimits = self.compiler.get("autolimits", "true") == "true"
        self._defaults: dict[str, dict[str, dict[str, str]]] = {_MAIN_DEFAULT_CLASS: {}}
        for element in self.root.findall("default"):
            self._add_defaults(element, _MAIN_DEFAULT_CLASS, self._defaults[_MAIN_DEFAULT_CLASS])

    def find_file(self, element: Element, name: str, folder: str) -> Path | None:
        """Return `folder`/`name` beside the main file or the file of `element`, or None."""
        places = [self.model.path.resolve().parent, self._folders.get(element)]
        find = self.model.files.find_file
        found = (find(name, place / folder) for place in places if place)
        return next((file for file in found if file is not None and not file.is_dir()), None)

    def elements_in(self, section: str) -> Iterator[Element]:
        """Yield the elements in all sections of this name, such as two `asset` sections."""
        for element in self.root.findall(section):
            yield from element

    def angle_in_rad(self, value: float) -> float:
        return math.radians(value) if self.compiler.get("angle", "degree") == "degree" else value

    def attributes_of(self, element: Element, childclass: str, label: str) -> Attributes:
        """Return an element's attributes, with defaults of its class, otherwise of `childclass`."""
        name = element.get("class") or childclass or _MAIN_DEFAULT_CLASS
        if name not in self._defaults:
            self.model.add_fault(f"{label}: the default class {name} is undefined")
            name = _MAIN_DEFAULT_CLASS
        kind = "actuator" if element.tag in _ACTUATOR_TAGS else element.tag
        defaults = self._defaults[name].get(kind, {})
        return Attributes(_merge_defaults(defaults, element.attrib), label, self.model)

    def read_pose(self, attributes: Attributes) -> RigidTransform:
        """Return an element's pose in its parent."""
        rotation = self._rotation_of_element(attributes)
        return RigidTransform(rotation, attributes.vector("pos", (0.0,) * 3))

    def _rotation_of_element(self, given: Attributes) -> RotationMatrix:
        if "quat" in given:
            quat = given.vector("quat", (1.0, 0.0, 0.0, 0.0))
            length = float(np.linalg.norm(quat))
            return RotationMatrix(Quaternion(quat / length)) if length else RotationMatrix()
        if "axisangle" in given:
            *axis, angle = given.vector("axisangle", (0.0, 0.0, 1.0, 0.0))
            return _rotation_about_axis(np.array(axis), self.angle_in_rad(angle))
        if "euler" in given:
            rotation = RotationMatrix()
            sequence = self.compiler.get("eulerseq", "xyz")
            for letter, angle in zip(sequence, given.vector("euler", (0.0,) * 3), strict=False):
                axis = np.eye(3)["xyz".find(letter.lower())]
                turn = _rotation_about_axis(axis, self.angle_in_rad(angle))
                rotation = rotation @ turn if letter.islower() else turn @ rotation
            return rotation
        if "xyaxes" in given:
            axes = given.vector("xyaxes", (1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
            z = np.cross(axes[:3], axes[3:])
            if np.linalg.norm(z) < MIN_DIRECTION_LENGTH:
                self.model.add_fault(f"{given.label}: its xyaxes are parallel")
                return RotationMatrix()
            columns = np.column_stack([axes[:3], np.cross(z, axes[:3]), z])
            return RotationMatrix(columns / np.linalg.norm(columns, axis=0))
        return smallest_rotation_of_z_to(given.vector("zaxis", (0.0, 0.0, 1.0)))

    def _insert_includes(self, element: Element, path: Path, seen: set[Path], depth: int) -> None:
        if depth > _MAX_ELEMENT_NESTING_DEPTH:
            what = f"its elements are nested more than {_MAX_ELEMENT_NESTING_DEPTH} deep"
            raise DrakeTeleopError(what, where=str(self.model.path))
        content = list[Element]()
        for child in element:
            if child.get("file"):
                self._folders[child] = path.resolve().parent
            if child.tag != "include":
                self._insert_includes(child, path, seen, depth + 1)
                content.append(child)
                continue
            name = child.get("file", "")
            file = self.find_file(child, name, "")
            if file is None:
                self.model.add_fault(f"the included file {name!r} was not found; correct its path")
            elif file.resolve() in seen:
                self.model.add_fault(f"{name} is included twice")
            else:
                seen.add(file.resolve())
                root = read_xml(file)
                self._insert_includes(root, file, seen, depth)
                content += root
        element[:] = content

    def _add_defaults(self, element: Element, name: str, values: dict[str, dict[str, str]]) -> None:
        self._defaults[name] = values
        for child in (each for each in element if each.tag != "default"):
            kind, own = child.tag, child.attrib
            if kind in _ACTUATOR_TAGS:
                kind, own = "actuator", {**own, "kind": child.tag}
            values[kind] = _merge_defaults(values.get(kind, {}), own)
        for child in element.findall("default"):
            self._add_defaults(child, child.get("class", ""), dict(values))


def _merge_defaults(defaults: dict[str, str], own: dict[str, str]) -> dict[str, str]:
    oriented = any(name in own for name in _ORIENTATION_ATTRIBUTES)
    merged = {k: v for k, v in defaults.items() if not (oriented and k in _ORIENTATION_ATTRIBUTES)}
    for name, text in own.items():
        words = text.split()
        rest = merged.get(name, "").split()[len(words) :] if name in _PADDED_ATTRIBUTES else []
        merged[name] = " ".join([*words, *rest]) if rest else text
    return merged


def _rotation_about_axis(axis: Array, angle: float) -> RotationMatrix:
    length = float(np.linalg.norm(axis))
    return RotationMatrix(AngleAxis(angle, axis / length)) if length else RotationMatrix()


def smallest_rotation_of_z_to(z: Array) -> RotationMatrix:
    axis = np.cross([0.0, 0.0, 1.0], z)
    sine = float(np.linalg.norm(axis))
    axis = axis if sine else np.array([1.0, 0.0, 0.0])
    return _rotation_about_axis(axis, math.atan2(sine, float(z[2])))
