"""The master side: the operator, the haptic device and the display of force on it."""
