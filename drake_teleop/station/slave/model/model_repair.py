"""Repair of one model file: its purpose, the new text, reported changes and faults."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from difflib import get_close_matches
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError
from drake_teleop.station.slave.model.model_references import ModelFiles, read_xml

MISSING_SHAPES_TEXT = "shapes are missing of"
FRAME_REPLACES_SITE_TEXT = "a frame of the model in place of the site"
XACRO_REMEDY = "expand it first (`xacro FILE > arm.urdf`), and give the resulting URDF"
_MAX_LISTED_NAMES = 12  # names in one statement


class ModelPurpose(NamedTuple):
    """Use of a model: as arm, tool or surroundings.

    Attributes:
        sensor_name: frame, link or site of the sensor; empty for tools and surroundings.
        held_positions: angles or positions [rad, m] of joints that do not move.
        is_tool: the model is a tool, whose joints are all fixed.
        is_scene: the model is surroundings; unreadable shapes are faults.
        is_in_directives: another file adds the model; every link is kept.
        plant_has_shapes: the plant has a SceneGraph.
    """

    sensor_name: str = ""
    held_positions: dict[str, float] = {}  # noqa: RUF012  (never changed)
    is_tool: bool = False
    is_scene: bool = False
    is_in_directives: bool = False
    plant_has_shapes: bool = True


class ModelRepair:
    """State of the repair of one model file: new text, reported changes and faults.

    Attributes:
        folder: folder of converted meshes and of repaired copies of included files.
        text: XML for Drake's parser, with absolute mesh paths; empty without a repair.
        dependence_reasons: by joint or link name (in directives MODEL::NAME), text on the part that
            it mimics or floats on.
        auxiliary_bodies: names of massless bodies that the repair added.
    """

    def __init__(self, path: Path, files: ModelFiles, purpose: ModelPurpose, folder: Path) -> None:
        self.path, self.files, self.purpose, self.folder = path, files, purpose, folder
        self.text = ""
        self.dependence_reasons: dict[str, str] = {}
        self.auxiliary_bodies: set[str] = set()
        # Dictionaries keep the order and contain each text once.
        self._names: dict[str, dict[str, None]] = {}
        self._causes: dict[str, None] = {}
        self._assumptions_of_parts: list[str] = []

    @cached_property
    def root(self) -> Element:
        """Root element of the file, which the repair changes in place."""
        return read_xml(self.path)

    def repair_file(self, path: Path, repair: Callable[[ModelRepair], None]) -> ModelRepair:
        """Call `repair` for a file that this one includes; return its state, merge assumptions."""
        purpose = self.purpose._replace(is_in_directives=True)
        part = ModelRepair(path, self.files, purpose, self.folder)
        repair(part)
        self.auxiliary_bodies |= part.auxiliary_bodies
        self._assumptions_of_parts += part.assumptions
        return part

    def write_file(self, name: str, text: str) -> Path:
        """Write a new file, with a number before `name`, to `folder`; return its path."""
        path = self.folder / f"{len(list(self.folder.iterdir()))}_{name}"
        path.write_text(text, encoding="utf-8")
        return path

    def add_assumption(self, what: str, name: str) -> None:
        """Add an assumption, such as `no inertia of`, about the joint or link `name`."""
        self._names.setdefault(what, {})[name] = None

    def add_repair(self, what: str, name: str) -> None:
        """Add a repair as an assumption; in a scene add a fault, because contact may change."""
        if self.purpose.is_scene:
            self.add_fault(f"{what} {name}")
        else:
            self.add_assumption(what, name)

    def add_fault(self, cause: str) -> None:
        self._causes[cause] = None

    @property
    def assumptions(self) -> list[str]:
        """Texts about assumptions and repairs, one per kind with names; of included files last."""
        own = [f"{what} {join_names(names)}" for what, names in self._names.items()]
        return list(dict.fromkeys([*own, *self._assumptions_of_parts]))

    def describe_frame_fault(self, count: int, names: set[str]) -> tuple[str, str]:
        """Return fault and remedy for `count` frames of the sensor's name; propose near `names`."""
        name = self.purpose.sensor_name
        near = get_close_matches(name, sorted(names), n=_MAX_LISTED_NAMES, cutoff=0.0)
        remedy = f"name one of {', '.join(sorted(near))}" if near else "give a model that has links"
        return f"{count or 'no'} frames are named {name!r}", remedy

    def raise_faults(self) -> None:
        if not self._causes:
            return
        what, count = next(iter(self._causes)), len(self._causes)
        if count > 1:
            texts = [f"({k}) {cause}" for k, cause in enumerate(self._causes, start=1)]
            frame = f"{self.path}: the model has 1000 faults: ; and 1000 more"
            lengths = accumulate(len(f"{text}; ") for text in texts)
            shown = sum(length <= MAX_ERROR_LINE_LENGTH - len(frame) for length in lengths)
            texts[shown:] = [f"and {count - shown} more"] if shown < count else []
            what = f"the model has {count} faults: {'; '.join(texts)}"
        remedy = XACRO_REMEDY if any("${" in x or "$(" in x for x in self._causes) else ""
        raise DrakeTeleopError(what, where=str(self.path), remedy=remedy)


def join_names(names: Iterable[str]) -> str:
    """Return the names, separated by commas; after twelve, only the number of the others."""
    each = list(names)
    more = [f"and {len(each) - _MAX_LISTED_NAMES} more"] if len(each) > _MAX_LISTED_NAMES else []
    return ", ".join(each[:_MAX_LISTED_NAMES] + more)
