"""Blind experiments with people or simulated participants."""
