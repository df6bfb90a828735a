"""Recorded logs: identification and elimination of the load, contact detection; no Drake needed."""
