"""Stability and transparency of a station, from closed forms and the linearised Diagram."""
