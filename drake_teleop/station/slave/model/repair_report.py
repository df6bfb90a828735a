"""Result of the repair of a model's text: new text, reported changes, and faults."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError

_MAX_JOINED_NAMES = 12  # names in one statement


class RepairedModel(NamedTuple):
    """Model text without the elements that Drake rejects or reads wrongly.

    Attributes:
        text: XML for Drake's parser, with absolute mesh paths.
        assumptions: one text per kind of repair, with the names of changed links or joints.
        effort_limits: torque or force limits [N m, N] by joint; joints without an entry have none.
        dependence_reasons: by name, why mimic joints or floating links depend on others.
        auxiliary_bodies: names of massless bodies, added between several joints of one body.
    """

    text: str
    assumptions: list[str]
    effort_limits: dict[str, float]
    dependence_reasons: dict[str, str] = {}  # noqa: RUF012  (never changed)
    auxiliary_bodies: frozenset[str] = frozenset()


def merge_repaired_models(text: str, models: list[RepairedModel]) -> RepairedModel:
    """Return one model with this text and what the repairs of all `models` report."""
    return RepairedModel(
        text,
        list(dict.fromkeys(line for each in models for line in each.assumptions)),
        {n: x for each in models for n, x in each.effort_limits.items()},
        {name: why for each in models for name, why in each.dependence_reasons.items()},
        frozenset(name for each in models for name in each.auxiliary_bodies),
    )


class RepairReport:
    """Collection of repairs of a model, and of faults that cannot be repaired.

    With `strict`, a repair that changes contact with the tool is a fault.
    """

    def __init__(self, *, strict: bool = False) -> None:
        self._strict = strict
        # Dictionaries keep the order and contain each text once.
        self._names: dict[str, dict[str, None]] = {}
        self._causes: dict[str, None] = {}

    def state_assumption(self, what: str, name: str) -> None:
        """Add an assumption, such as `no inertia of`, about the joint or link `name`."""
        self._names.setdefault(what, {})[name] = None

    def state_repair(self, what: str, name: str) -> None:
        """Add a repair as an assumption, or with `strict` as a fault."""
        if self._strict:
            self.add_fault(f"{what} {name}")
        else:
            self.state_assumption(what, name)

    def add_fault(self, cause: str) -> None:
        self._causes[cause] = None

    @property
    def assumptions(self) -> list[str]:
        """Texts about assumptions and repairs: one of each kind, with names."""
        return [f"{what} {join_names(names)}" for what, names in self._names.items()]

    def raise_faults(self, file: Path) -> None:
        """Raise one DrakeTeleopError about all faults, if there are any."""
        causes = list(self._causes)
        if len(causes) == 1:
            raise DrakeTeleopError(causes[0], where=str(file))
        room = MAX_ERROR_LINE_LENGTH - len(f"{file}: the model has 1000 faults: ; and 1000 more")
        texts = list[str]()
        for k, cause in enumerate(causes, start=1):
            texts.append(f"({k}) {cause}")
            room -= len(f"{texts[-1]}; ")
            if room < 0:
                texts[-1] = f"and {len(causes) - k + 1} more"
                break
        if causes:
            what = f"the model has {len(causes)} faults: {'; '.join(texts)}"
            raise DrakeTeleopError(what, where=str(file))


def describe_frame_fault(count: int, name: str, known: set[str]) -> tuple[str, str]:
    """Return fault and remedy if `count` frames, not one, have the sensor frame's `name`."""
    near = get_close_matches(name, sorted(known), n=_MAX_JOINED_NAMES, cutoff=0.0)
    remedy = f"name one of {', '.join(sorted(near))}" if near else "give a model that has links"
    return f"{count or 'no'} frames are named {name!r}", remedy


def join_names(names: Iterable[str]) -> str:
    """Return the names as text, of more than twelve the first twelve and the number of others."""
    each = list(names)
    more = [f"and {len(each) - _MAX_JOINED_NAMES} more"] if len(each) > _MAX_JOINED_NAMES else []
    return ", ".join(each[:_MAX_JOINED_NAMES] + more)
