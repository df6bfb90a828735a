"""What lets a station's memory go when nobody holds the station any more.

Two things keep a `LeafSystem` written in Python, and with it its whole Diagram, for ever: a bound
method that C++ calls (a circle that Python's collector cannot see; events, and later versions of
Drake, hold theirs weakly), and, in Python 3.11, a second `__dict__`, which a subclass of a bound
class has unless its `__slots__` name nothing. Each station would leave 2.5 MB behind.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

ONE_DICT: tuple[str, ...] = ()
"""The `__slots__` of a system: attributes live in the bound class's `__dict__`."""


def weak_callback(method: Any) -> Callable[..., None]:
    """A bound method for C++ to call that does not keep its system alive.

    Args:
        method: bound to a system; C++ calls it while the system lives, and not later.
    """
    system, function = weakref.ref(method.__self__), method.__func__

    def call(context: Any, output: Any) -> None:
        function(system(), context, output)

    return call
