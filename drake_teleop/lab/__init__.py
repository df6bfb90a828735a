"""Experiments that simulate or analyse a station."""
