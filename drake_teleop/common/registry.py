"""Tables of named parts, such as estimators, to which scripts can add (docs/extend.md)."""

from __future__ import annotations

import copy
import os
import re
import reprlib
import sys
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from drake_teleop.common.errors import DrakeTeleopError, suggest_name

_Part = TypeVar("_Part")
_SCRIPTS_ENV = "DRAKE_TELEOP_REGISTER"  # paths, which the processes of a study inherit
REGISTRIES: dict[str, Registry[Any]] = {}
"""All tables by the kind of their parts, as far as their modules are imported."""


class Presets(dict[str, _Part]):
    """Settings by name; each access by name returns a copy."""

    def __getitem__(self, name: str) -> _Part:
        return copy.deepcopy(super().__getitem__(name))

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if dict.__contains__(self, name) else default


class Registry(dict[str, _Part]):
    """Parts of one kind by name; an unknown name raises DrakeTeleopError.

    Args:
        kind: name of the kind, such as "passivity method".
        shipped: parts of this package by name.
        part_type: class of the parts, or base class if the parts are classes; None: any.
    """

    def __init__(
        self, kind: str, shipped: Mapping[str, _Part], part_type: type | None = None
    ) -> None:
        super().__init__(shipped)
        self.kind, self.shipped, self._part_type = kind, tuple(shipped), part_type
        self._parts_are_classes = all(isinstance(part, type) for part in shipped.values())
        REGISTRIES[kind] = self

    def register(self, name: str, part: _Part | None = None) -> Any:
        """Add or replace a part, except shipped ones; without `part`, return a decorator for it."""
        if part is None:
            return partial(self.register, name)
        if not isinstance(name, str) or not re.fullmatch(r"[.\w][\w.-]*", name, re.ASCII):
            remedy = "use only letters, digits, _ . -, first a letter, digit, _ or ."
            raise DrakeTeleopError(f"{name!r} is not a valid name", where=self.kind, remedy=remedy)
        if name in self.shipped:
            what = f"'{name}' is the name of a shipped part"
            raise DrakeTeleopError(what, where=self.kind, remedy="use another name")
        self._check_part_type(name, part)
        self[name] = part
        return part

    def _check_part_type(self, name: str, part: Any) -> None:
        if self._part_type is None:
            return
        base, is_class = self._part_type, self._parts_are_classes
        is_subclass = isinstance(part, type) and issubclass(part, base)
        if not (is_subclass if is_class else isinstance(part, base)):
            kind = "a class derived from" if is_class else "an object of class"
            remedy = f"register {kind} {base.__name__} (docs/extend.md)"
            what = f"'{name}' is {reprlib.repr(part)}, not a valid part"
            raise DrakeTeleopError(what, where=self.kind, remedy=remedy)

    def remove(self, name: str) -> None:
        if name in self.shipped:
            what = f"'{name}' is a shipped part and cannot be removed"
            remedy = "remove only parts that you registered"
            raise DrakeTeleopError(what, where=self.kind, remedy=remedy)
        del self[self.check(name)]

    def check(self, name: Any, where: str = "", *others: str) -> str:
        """Return the name; raise DrakeTeleopError unless it is registered or in `others`."""
        if isinstance(name, str) and (name in others or name in self):
            return name
        names = (*others, *self)
        remedy = suggest_name(name, names, f"choose one of {', '.join(names)}, or register a part")
        raise DrakeTeleopError(f"there is no {self.kind} {name!r}", where=where, remedy=remedy)

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or (_import_env_scripts() and super().__contains__(name))

    def __missing__(self, name: str) -> _Part:
        return self[self.check(name)]


def register_from_script(script: Path) -> None:
    """Import a Python file that registers parts, here and in the processes of studies."""
    script = Path(os.path.abspath(script))
    if script.suffix != ".py" or "." in script.stem or not script.is_file():
        remedy = "give an existing file NAME.py, without another dot in NAME"
        raise DrakeTeleopError("is not a Python file", where=str(script), remedy=remedy)
    sys.path.append(str(script.parent))
    try:
        module = import_module(script.stem)
    except DrakeTeleopError:
        raise
    except Exception as error:
        what = f"cannot be imported: {type(error).__name__}: {error}"
        remedy = "correct the file; `python FILE` prints the traceback"
        raise DrakeTeleopError(what, where=str(script), remedy=remedy) from error
    if module.__file__ != str(script):
        what = f"has the name of the module {module.__file__ or script.stem}"
        raise DrakeTeleopError(what, where=str(script), remedy="rename the file")
    paths = os.environ.get(_SCRIPTS_ENV, "").split(os.pathsep)
    os.environ[_SCRIPTS_ENV] = os.pathsep.join(dict.fromkeys([*filter(None, paths), str(script)]))


def _import_env_scripts() -> bool:
    paths = [Path(path) for path in os.environ.get(_SCRIPTS_ENV, "").split(os.pathsep) if path]
    new = [path for path in paths if path.stem not in sys.modules]
    for path in new:
        register_from_script(path)
    return bool(new)
