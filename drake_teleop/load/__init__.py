"""Inertial load of a wrist force/torque sensor: identification, and removal from the wrench."""
