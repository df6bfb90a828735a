"""Recorded logs: identification, elimination and contact detection, without Drake."""
