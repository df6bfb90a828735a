"""Estimation sample by sample, and what tells that the load has changed."""
