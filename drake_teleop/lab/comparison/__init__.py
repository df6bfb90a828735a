"""Comparison of passivity methods over networks with delay."""
