"""Suppression of messages of C++ and Rust libraries."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock

# stderr is global: two threads would restore it in the wrong order.
_lock = RLock()


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Redirect the file descriptor of stderr to nowhere."""
    with _lock:
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
