"""Recursive estimators of the load, and detection of a changed load."""
