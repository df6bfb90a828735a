"""Compiled code that is older than what it was compiled from is thrown away.

numba keeps compiled functions in `__pycache__` and compiles one again when its own file changes,
but not when a function that it calls from another file does. In a checkout that is edited or
updated, it would go on with the old code, and say nothing.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


def discard_stale(package: Path, cache: Path) -> None:
    """Removes the indices of numba's cache below `cache` that are older than a source of `package`.

    Args:
        package: folder of the sources; those that compile anything count.
        cache: folder with numba's cached code at any depth.
    """
    indices = list(cache.rglob("*.nbi"))
    if not indices:
        return
    sources = [path for path in package.rglob("*.py") if b"njit" in path.read_bytes()]
    newest = max(path.stat().st_mtime for path in sources)
    for index in indices:
        # Another process may do the same now; a folder that cannot be written was never changed.
        with suppress(OSError):
            if index.stat().st_mtime < newest:
                index.unlink()
