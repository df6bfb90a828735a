"""The recursive estimators that a station may learn its load with."""

from __future__ import annotations

from drake_teleop.load.online.recursive import RecursiveEstimator, RecursiveLeastSquares
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares

METHODS: dict[str, type[RecursiveEstimator]] = {
    "rls": RecursiveLeastSquares,
    "rtls": RecursiveTotalLeastSquares,
}
"""The estimators by name: a line here enters one."""
