"""Reproduction of the paper's Figs. 6 to 8, with a report."""
