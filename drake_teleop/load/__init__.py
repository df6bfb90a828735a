"""Inertial load of a wrist sensor: regressor, parameters, identification and elimination.

Functions that check arrays raise DrakeTeleopError for wrong shapes and for numbers that are not
finite.
"""
