"""Handling of SIGINT and SIGTERM where C code would lose the KeyboardInterrupt.

C code that calls Python can drop an exception, e.g. llvmlite in a callback of the compiler and
imports in that of a weak reference, or replace it, e.g. rclpy in the constructor of a message.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

INTERRUPTED = threading.Event()
"""Set from the first signal on, until the command ends; an endless loop checks it."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def install_handlers() -> None:
    """Handle SIGINT, unless it is ignored, and SIGTERM by a KeyboardInterrupt and `INTERRUPTED`."""
    for number in _SIGNALS:
        if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def _interrupt(number: int, _frame: Any) -> None:
    INTERRUPTED.set()
    raise KeyboardInterrupt(*["SIGTERM"] * (number == signal.SIGTERM))


@contextmanager
def delayed_signals() -> Iterator[None]:
    """Handle SIGINT and SIGTERM at the end of the context; also a decorator."""
    received: list[int] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        for number in filter(signal.getsignal, _SIGNALS):  # those that Python handles
            handlers[number] = signal.signal(number, lambda n, _: received.append(n))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for first in received[:1]:
            signal.raise_signal(first)
