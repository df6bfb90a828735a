"""Experiments with a station."""
