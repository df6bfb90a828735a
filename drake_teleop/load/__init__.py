"""Inertial load of a wrist force/torque sensor: model, identification and removal from the wrench.

Functions that check arrays raise DrakeTeleopError for wrong shapes and for numbers that are not
finite.
"""
