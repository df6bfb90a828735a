"""The one exception family for what a user can mend: bad scenarios, bad logs, bad numbers."""

from __future__ import annotations

import difflib
import os
import reprlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from drake_teleop.common.silence import silent_stderr

_POLARS_USED_IN: list[int] = []  # the first process

LONGEST_LINE = 1000
"""Characters of a line that the command line says about an error."""


class DrakeTeleopError(ValueError):
    """Input that cannot be used. Its message is one line: what is wrong, where, and the remedy.

    The command line prints it as a single ``error:`` line and exits with status 2. Programming
    mistakes (a broken invariant, an argument that does not exist) stay ordinary exceptions.

    Args:
        what: what is wrong, in the user's words.
        where: the place, as ``file:field`` or the name of a port; empty if there is none.
        remedy: what to do about it; empty if it is obvious.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        text = f"{where}: {what}" if where else what
        if remedy:
            text = f"{text}; {remedy}"
        super().__init__(one_line(text, LONGEST_LINE - len("error: ")))


def one_line(text: str, longest: int = LONGEST_LINE) -> str:
    """The text in one line: without what a terminal would obey, and with its middle cut out."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))
    if len(text) <= longest:
        return text
    end = longest // 3
    return f"{text[: longest - end - 5]} ... {text[-end:]}"


def expect(kind: type | tuple[type, ...], value: Any, where: str, remedy: str = "") -> None:
    """Refuses an argument of another kind here, not as a traceback from far below.

    Raises:
        DrakeTeleopError: with the argument's name `where`, what was wanted and what was found.
    """
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or ".join("None" if one is type(None) else one.__name__ for one in kinds)
        found = reprlib.repr(value)
        raise DrakeTeleopError(f"expected {wanted}, found {found}", where=where, remedy=remedy)


@contextmanager
def reading(path: str | Path, remedy: str, what: str = "cannot be read") -> Iterator[None]:
    """Makes one error of whatever a damaged file leads to: zipfile, numpy and polars do not say.

    Args:
        path: of the file.
        remedy: for the error.
        what: for the error, before the first line of the reason.

    Raises:
        DrakeTeleopError: with what, the reason and the remedy.
    """
    try:
        with silent_stderr():  # where a panic in polars would say some pages, from another thread
            yield
    except BaseException as error:
        # Such a panic is no Exception, so that programs end by it.
        panic = type(error).__name__ == "PanicException"
        if not (panic or isinstance(error, Exception)):
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        reason = "it is damaged" if panic else reason
        raise DrakeTeleopError(f"{what}: {reason}", where=str(path), remedy=remedy) from error


def refuse_fork() -> None:
    """Call this before polars reads or writes, whose threads do not outlive a fork.

    Raises:
        DrakeTeleopError: in a process that was forked after another call; polars would hang.
    """
    _POLARS_USED_IN.append(os.getpid())
    del _POLARS_USED_IN[1:]
    if [os.getpid()] != _POLARS_USED_IN:
        raise DrakeTeleopError(
            "this process was forked after tables were read or written, and would hang",
            remedy='start processes by multiprocessing.get_context("spawn")',
        )


def meant(name: object, names: Sequence[str], otherwise: str) -> str:
    """The remedy for a name that is none of these: the one that is near, or else `otherwise`."""
    near = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean '{near[0]}'?" if near else otherwise


def install_extra(name: str) -> str:
    """Return the remedy for a library of an extra; no package index has this project."""
    return f"install the extra `{name}`: pip install '.[{name}]' in the clone of this project"


def inside(where: str, name: Any) -> str:
    """The place of a field inside a place: `file:field`, then `file:field.inner`."""
    return f"{where}.{name}" if ":" in where else f"{where}:{name}"
