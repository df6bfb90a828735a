"""Recorded logs: foreign columns, units, frames and clocks into one canonical table. No Drake."""
