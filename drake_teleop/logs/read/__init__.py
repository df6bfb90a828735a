"""Readers that convert log files of other software into one table."""
