"""The load from a wrench and the poses of a frame near the sensor, which may be noisy."""
