"""Stability and transparency of a station, from closed forms and from the Diagram itself."""
