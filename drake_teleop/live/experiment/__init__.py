"""Blind perception experiments with people or simulated participants."""
