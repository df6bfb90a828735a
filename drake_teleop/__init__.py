"""Bilateral teleoperation with non-contact force scaling, on Drake."""

from drake_teleop._version import __version__
from drake_teleop.errors import DrakeTeleopError

__all__ = ["DrakeTeleopError", "__version__"]
