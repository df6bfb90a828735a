"""Result of the repair of a model's text: the text, statements, and causes of refusal."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from drake_teleop.common.errors import MAX_LINE_LENGTH, DrakeTeleopError

_MAX_NAMES = 12  # names in one statement


class RepairedModel(NamedTuple):
    """Model text without the elements that Drake rejects or reads wrongly.

    Attributes:
        text: XML for Drake's parser, with absolute mesh paths.
        assumptions: one text per kind of repair, with the names and numbers of what changed.
        effort_limits: torque or force limits [N m, N] by joint; joints without an entry have none.
        dependent: reasons why joints or links do not move independently, by name.
        auxiliary: massless bodies between several joints of one body, which the file does not have.
    """

    text: str
    assumptions: list[str]
    effort_limits: dict[str, float]
    dependent: dict[str, str] = {}  # noqa: RUF012  (never changed)
    auxiliary: frozenset[str] = frozenset()


class RepairReport:
    """Repairs by kind, and the faults that no repair removes.

    With `strict`, a repair that changes what the tool could touch is a fault.
    """

    def __init__(self, *, strict: bool = False) -> None:
        self._strict = strict
        # Dictionaries keep the order and contain each text once.
        self._names: dict[str, dict[str, None]] = {}
        self._causes: dict[str, None] = {}

    def state_assumption(self, what: str, name: str) -> None:
        """State an assumption, such as `no inertia of`, about the joint or link `name`."""
        self._names.setdefault(what, {})[name] = None

    def state_repair(self, what: str, name: str) -> None:
        """State a repair; with `strict` it is a fault."""
        if self._strict:
            self.add_fault(f"{what} {name}")
        else:
            self.state_assumption(what, name)

    def add_fault(self, cause: str) -> None:
        """Add a fault that cannot be repaired."""
        self._causes[cause] = None

    @property
    def assumptions(self) -> list[str]:
        """One text for each kind of repair."""
        return [f"{what} {join_names(names)}" for what, names in self._names.items()]

    def raise_faults(self, file: Path) -> None:
        """Raise one DrakeTeleopError with all faults, if there are any."""
        causes = list(self._causes)
        if len(causes) == 1:
            raise DrakeTeleopError(causes[0], where=str(file))
        room, texts = MAX_LINE_LENGTH - len(f"{file}: 1000 faults: ; and 1000 more"), list[str]()
        for k, cause in enumerate(causes, start=1):
            texts.append(f"({k}) {cause}")
            room -= len(f"{texts[-1]}; ")
            if room < 0:
                texts[-1] = f"and {len(causes) - k + 1} more"
                break
        if causes:
            raise DrakeTeleopError(f"{len(causes)} faults: {'; '.join(texts)}", where=str(file))


def join_names(names: Iterable[str]) -> str:
    """Return names in one text; only the first of many."""
    each = list(names)
    more = [f"and {len(each) - _MAX_NAMES} more"] if len(each) > _MAX_NAMES else []
    return ", ".join(each[:_MAX_NAMES] + more)
