"""Block "haptic device": dynamics of haptic devices and leader arms, and force display."""
