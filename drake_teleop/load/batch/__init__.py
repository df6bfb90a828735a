"""Estimators of the load from a whole record."""
