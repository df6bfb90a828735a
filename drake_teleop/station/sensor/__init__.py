"""Block "wrist sensor": readings, and estimated motion of the sensor frame S."""
