"""Blind experiments with people in the page of `drive`, or with simulated participants."""
