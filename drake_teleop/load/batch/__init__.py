"""Estimation from a whole record."""
