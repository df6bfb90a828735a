"""Block "haptic device": dynamics of devices and leader arms, and their force display."""
