"""Estimation at the slave from its wrist sensor: load and contact."""
