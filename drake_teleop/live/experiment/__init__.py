"""Blind experiments with people in the page of `drive`, and with simulated participants."""
