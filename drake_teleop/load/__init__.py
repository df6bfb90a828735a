"""Inertial load of a wrist sensor: regressor, parameters, identification, elimination.

Functions that check arrays raise DrakeTeleopError for wrong shapes and for numbers that are not
finite.
"""
