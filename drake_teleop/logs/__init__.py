"""Recorded logs: identification and removal of the load, contact detection; no Drake needed."""
