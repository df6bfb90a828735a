"""Experiments: each one file; each is data, a picture and a table."""
