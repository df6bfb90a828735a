"""Load, delay and pose frame from a wrench and noisy poses (docs/theory.md)."""
