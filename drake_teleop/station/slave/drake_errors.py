"""Conversion of Drake's errors about model files to DrakeTeleopErrors."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError, silent_stderr

# Expected kind of file, and the remedy for missing packages.
ROBOT_ERROR_TEXTS = "robot", "with --package-path for package://"
SCENE_ERROR_TEXTS = "scene", "its package:// addresses in folders around it"
# Places in Drake's source and in repaired texts, which the user does not have.
_DRAKE_SOURCE_PREFIX_PATTERN = re.compile(r"Failure at \S+ in \w+(\(\))?: ")
_PLACE_IN_REPAIRED_TEXT_PATTERN = re.compile(r"<(literal|data)-string>(\.\w+)?(:\d+)*:? ?")
_REPAIRED_FILE_PATTERN = r"(file://)?{folder}/\d+_([^\s:'\"]*)(:\d+)*"
_NUM_SEPARATOR_CHARS = 30  # " ... " and separators of the error line


@contextmanager
def translate_drake_errors(
    path: Path, expected: tuple[str, str] = ROBOT_ERROR_TEXTS, folder: str = ""
) -> Iterator[None]:
    """Convert Drake's exceptions about a model to a DrakeTeleopError with the model's file.

    Messages name the original files instead of repaired copies in `folder`.
    """
    try:
        yield
    except DrakeTeleopError:
        raise
    # SystemExit: failed condition in Drake; LookupError: from C++ containers.
    except (RuntimeError, SystemExit, ValueError, LookupError) as error:
        reason = _DRAKE_SOURCE_PREFIX_PATTERN.sub("", " ".join(str(error).split()))
        reason = _PLACE_IN_REPAIRED_TEXT_PATTERN.sub("", reason)
        if folder:
            reason = re.sub(_REPAIRED_FILE_PATTERN.format(folder=re.escape(folder)), r"\2", reason)
        what = f"cannot be read as a {expected[0]}"
        remedy = f"give a URDF, SDF, MJCF or .dmd.yaml model, {expected[1]}"
        room = MAX_ERROR_LINE_LENGTH - _NUM_SEPARATOR_CHARS - len(f"{path}{what}{remedy}")
        if len(reason) > room:
            reason = f"{reason[:room]} ..."
        raise DrakeTeleopError(what, where=str(path), remedy=f"{remedy} ({reason})") from None


@contextmanager
def raise_logged_errors() -> Iterator[None]:
    """Raise RuntimeError if Drake logs an error, or a warning about an inertia."""
    errors: list[str] = []

    def collect_error_message(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        if record.levelno >= logging.ERROR or "inertia" in message:
            errors.append(" ".join(message.split()))
        return False

    log = logging.getLogger("drake")
    log.addFilter(collect_error_message)
    try:
        with silent_stderr():  # the parsers below Drake write to stderr
            yield
    finally:
        log.removeFilter(collect_error_message)
    if errors:
        raise RuntimeError("; ".join(dict.fromkeys(errors)))
