"""Release of the memory of unreferenced stations.

A Python `LeafSystem` and its Diagram (2.5 MB) are never freed if C++ holds a bound method, or, in
Python 3.11, if a subclass has no empty `__slots__`.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

ONE_DICT: tuple[str, ...] = ()
"""`__slots__` of a system; its attributes are in the `__dict__` of the bound class."""


def weak_callback(method: Any) -> Callable[..., None]:
    """Return a callback for C++ that does not keep its system alive."""
    system, function = weakref.ref(method.__self__), method.__func__

    def call(context: Any, output: Any) -> None:
        function(system(), context, output)

    return call
