"""Single-threaded BLAS."""

from __future__ import annotations

from contextlib import AbstractContextManager


def one_blas_thread() -> AbstractContextManager[object]:
    """Limit BLAS to one thread; several change the last digits of sums."""
    import scipy.linalg  # noqa: F401, what comes in later would have its threads
    from threadpoolctl import threadpool_limits

    limits: AbstractContextManager[object] = threadpool_limits(1)
    return limits
