"""
Contacts in a robot's log
=========================

In a second record of the same gripper, a person pushes it three times. The load's wrench is
eliminated; contact is detected where the remaining wrench exceeds the noise floor of free motion.
"""

import tempfile
from pathlib import Path

import drake_teleop as dt
from drake_teleop.logs.pictures import draw_detection
from drake_teleop.logs.processing import detect_log
from drake_teleop.logs.sample import sample_log_command

folder = Path(tempfile.mkdtemp())
sample_log_command(folder, quiet=True)
load = dt.identify_log(folder / "free.yaml").identification
found = detect_log(folder / "touched.yaml", load, free=folder / "free.yaml")
figure = draw_detection(found)
