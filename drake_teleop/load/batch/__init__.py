"""Estimators that determine the load from a whole record."""
