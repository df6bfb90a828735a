"""Experiments that simulate or analyse stations."""
