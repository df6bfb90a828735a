"""Live drives of a running station, from the browser or by a haptic device."""
