"""Statements and causes of refusal that the repair of a model's text collects."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from drake_teleop.common.errors import LONGEST_LINE, DrakeTeleopError

_MAX_NAMES = 12  # names in one statement
_NUM_CHARS_OF_ERROR = LONGEST_LINE - 100  # leaves room for the file's name


class RepairReport:
    """Repairs by kind, and the faults that no repair removes.

    With `strict`, a repair that changes what the tool could touch is a fault.
    """

    def __init__(self, *, strict: bool = False) -> None:
        self._strict = strict
        self._names: dict[str, list[str]] = {}
        self.causes: list[str] = []

    def state(self, what: str, name: str) -> None:
        """State an assumption, such as `no inertia of`, about the joint or link `name`."""
        names = self._names.setdefault(what, [])
        if name not in names:
            names.append(name)

    def repair(self, what: str, name: str) -> None:
        """State a repair; with `strict` it is a fault."""
        if self._strict:
            self.refuse(f"{what} {name}")
        else:
            self.state(what, name)

    def refuse(self, cause: str) -> None:
        """Add a fault that cannot be repaired."""
        if cause not in self.causes:
            self.causes.append(cause)

    @property
    def assumptions(self) -> list[str]:
        """One text for each kind of repair."""
        return [f"{what} {listed(names)}" for what, names in self._names.items()]

    def raise_causes(self, file: Path) -> None:
        """Raise one DrakeTeleopError that lists all faults, if there are any."""
        if not self.causes:
            return
        kept, left = [self.causes[0]], _NUM_CHARS_OF_ERROR - len(self.causes[0])
        for cause in self.causes[1:]:
            left -= len(cause) + 10
            if left < 0:
                break
            kept.append(cause)
        count = len(self.causes)
        more = f"; and {count - len(kept)} more" if count > len(kept) else ""
        text = "; ".join(f"({k}) {cause}" for k, cause in enumerate(kept, start=1)) + more
        raise DrakeTeleopError(
            kept[0] if count == 1 else f"{count} faults: {text}", where=str(file)
        )


def listed(names: Iterable[str]) -> str:
    """Return names in one text; only the first of many."""
    each = list(names)
    more = [f"and {len(each) - _MAX_NAMES} more"] if len(each) > _MAX_NAMES else []
    return ", ".join(each[:_MAX_NAMES] + more)
