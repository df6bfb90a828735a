"""Handling of SIGINT and SIGTERM, also where C code would lose a KeyboardInterrupt."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import ContextDecorator, contextmanager
from typing import Any

INTERRUPTED_EVENT = threading.Event()
"""Set from the first signal on, until the command ends; an endless loop checks it."""


class _DelayedSignalState(threading.local):
    open_contexts, last_signal = 0, 0  # delayed_signals contexts, and the last signal in them


_DELAYED_SIGNAL_STATE = _DelayedSignalState()


def install_interrupt_handlers() -> None:
    """Let SIGTERM, and SIGINT unless ignored, set INTERRUPTED_EVENT and raise KeyboardInterrupt."""
    signal.signal(signal.SIGTERM, _handle_interrupt_signal)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _handle_interrupt_signal)


@contextmanager
def raise_interrupt_on_sigint() -> Iterator[None]:
    """Let SIGINT set INTERRUPTED_EVENT in this context, unless a custom handler is set."""
    before = signal.getsignal(signal.SIGINT)
    in_main_thread = threading.current_thread() is threading.main_thread()
    if before is not signal.default_int_handler or not in_main_thread:
        yield
        return
    signal.signal(signal.SIGINT, _handle_interrupt_signal)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        INTERRUPTED_EVENT.clear()


def _handle_interrupt_signal(signal_number: int, _frame: Any) -> None:
    INTERRUPTED_EVENT.set()
    if _DELAYED_SIGNAL_STATE.open_contexts:
        _DELAYED_SIGNAL_STATE.last_signal = signal_number
        return
    if signal_number == signal.SIGTERM:
        raise KeyboardInterrupt("SIGTERM")
    raise KeyboardInterrupt


class delayed_signals(ContextDecorator):
    """Context or decorator that delays the KeyboardInterrupt of a signal to the context's end."""

    def __enter__(self) -> None:
        _DELAYED_SIGNAL_STATE.open_contexts += 1

    def __exit__(self, *_: object) -> None:
        _DELAYED_SIGNAL_STATE.open_contexts -= 1
        if _DELAYED_SIGNAL_STATE.last_signal and not _DELAYED_SIGNAL_STATE.open_contexts:
            number, _DELAYED_SIGNAL_STATE.last_signal = _DELAYED_SIGNAL_STATE.last_signal, 0
            _handle_interrupt_signal(number, None)
