"""One thread for BLAS: over several, sums differ in their last digits; optimisers find others."""

from __future__ import annotations

from contextlib import AbstractContextManager


def one_blas_thread() -> AbstractContextManager[object]:
    """While this lasts the results do not depend on how many cores there are.

    Matrices as small as ours gain nothing from more threads either.
    """
    import scipy.linalg  # noqa: F401, what comes in later would have its threads
    from threadpoolctl import threadpool_limits

    limits: AbstractContextManager[object] = threadpool_limits(1)
    return limits
