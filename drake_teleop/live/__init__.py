"""Live drives: a running station, driven from the browser or by a haptic device."""
