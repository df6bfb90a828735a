"""Exception for errors that users can fix, such as invalid scenarios or logs."""

from __future__ import annotations

import difflib
import importlib.util
import os
import reprlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

_ID_OF_FIRST_PROCESS_WITH_POLARS: list[int] = []  # PID of the process that first used polars

MAX_ERROR_LINE_LENGTH = 1000
"""Maximum length of an error line of the command line."""


class DrakeTeleopError(ValueError):
    """Error in the user's input, with a one-line message.

    Args:
        where: the place, as ``file:field`` or the name of a port.
        remedy: the action that fixes it.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        text = f"{where}: {what}" if where else what
        if remedy:
            text = f"{text}; {remedy}"
        super().__init__(to_one_line(text, MAX_ERROR_LINE_LENGTH - len("error: ")))


def to_one_line(text: str, max_length: int = MAX_ERROR_LINE_LENGTH) -> str:
    """Return the text as one printable line; of a long text the middle is replaced by "..."."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))
    if len(text) <= max_length:
        return text
    end = max_length // 3
    return f"{text[: max_length - end - 5]} ... {text[-end:]}"


def expect_type(kind: type | tuple[type, ...], value: Any, where: str, remedy: str = "") -> None:
    """Raise DrakeTeleopError unless the value of the argument named `where` has type `kind`."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        expected = " or ".join("None" if one is type(None) else one.__name__ for one in kinds)
        found = reprlib.repr(value)
        raise DrakeTeleopError(f"expected {expected}, found {found}", where=where, remedy=remedy)


@contextmanager
def wrap_read_errors(path: str | Path, remedy: str, what: str = "cannot be read") -> Iterator[None]:
    try:
        with silent_stderr():  # a panic in polars writes pages from another thread
            yield
    except BaseException as error:
        # The PanicException of polars is derived from BaseException only.
        panic = type(error).__name__ == "PanicException"
        if not (panic or isinstance(error, Exception)):
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        reason = "the file is damaged" if panic else reason
        raise DrakeTeleopError(f"{what}: {reason}", where=str(path), remedy=remedy) from error


def refuse_polars_in_forked_process() -> None:
    """Raise DrakeTeleopError in a process forked after the first call: polars would hang there."""
    _ID_OF_FIRST_PROCESS_WITH_POLARS.append(os.getpid())
    del _ID_OF_FIRST_PROCESS_WITH_POLARS[1:]
    if [os.getpid()] != _ID_OF_FIRST_PROCESS_WITH_POLARS:
        what = "would hang in this process, which was forked after polars was used"
        remedy = 'start processes by multiprocessing.get_context("spawn")'
        raise DrakeTeleopError(what, where="polars", remedy=remedy)


def suggest_name(name: object, names: Sequence[str], otherwise: str) -> str:
    """Return "did you mean 'x'?" with a name x that resembles `name`, else `otherwise`."""
    near = difflib.get_close_matches(str(name), names, n=1)
    near = near or [other for other in names if len(str(name)) > 2 and str(name) in other]
    return f"did you mean '{near[0]}'?" if near else otherwise


def remedy_to_install_extra(name: str) -> str:
    return f"install the extra `{name}`: pip install '.[{name}]' in the clone of this project"


def require_library(module: str, library: str, extra: str, where: str) -> None:
    if importlib.util.find_spec(module) is None:
        what = f"needs the library {library}, which is not installed"
        raise DrakeTeleopError(what, where=where, remedy=remedy_to_install_extra(extra))


def field_location(where: str, name: Any) -> str:
    """Return the place `where:name`, or `where.name` if `where` is itself a field."""
    return f"{where}.{name}" if ":" in where else f"{where}:{name}"


# stderr is global: two threads would restore it in the wrong order.
_STDERR_REDIRECTION_LOCK = RLock()


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Discard stderr in this context, also that of C and Rust code."""
    with _STDERR_REDIRECTION_LOCK:
        try:
            sys.stderr.flush()
            saved = os.dup(2)
        except (AttributeError, OSError, ValueError):  # no stderr
            yield
            return
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 2)
        os.close(null)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
