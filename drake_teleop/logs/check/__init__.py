"""Checks of a log: suspicious properties and their remedies."""
