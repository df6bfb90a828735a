"""Inertial load of a wrist force/torque sensor: model, identification and removal from the wrench."""
