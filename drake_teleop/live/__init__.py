"""Live sessions with a simulated station, driven from the browser or by a haptic device."""
