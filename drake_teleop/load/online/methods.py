"""Recursive estimators by name, for the load estimator of a station."""

from __future__ import annotations

from drake_teleop.load.online.recursive import RecursiveEstimator, RecursiveLeastSquares
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares

METHODS: dict[str, type[RecursiveEstimator]] = {
    "rls": RecursiveLeastSquares,
    "rtls": RecursiveTotalLeastSquares,
}
"""Recursive estimators by name; add a line for a new one."""
