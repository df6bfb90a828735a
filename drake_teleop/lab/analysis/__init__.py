"""Stability and transparency of a station, from formulas and the linearised Drake Diagram."""
