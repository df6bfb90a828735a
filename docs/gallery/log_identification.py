"""
A load from a robot's log
=========================

The sample log is of an arm with a gripper. It has two clocks, lbf and degrees, and the opposite
sign of the wrench; its description states this. Identification gives the load on the sensor.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import drake_teleop as dt
from drake_teleop.logs.sample import sample_log_command

folder = Path(tempfile.mkdtemp())
sample_log_command(folder, quiet=True)
found = dt.identify_log(folder / "free.yaml")
print(found.identification)

figure, panels = plt.subplots(3, 1, figsize=(7, 5), sharex=True)
for k, axes in enumerate(panels):
    axes.plot(found.log.t, found.log.wrench[:, k], label="measured")
    axes.plot(found.log.t, found.predicted[:, k], "--", label="of the identified load")
    axes.set_ylabel(f"$f_{'xyz'[k]}$ [N]")
panels[0].legend(ncols=2)
panels[2].set_xlabel("t [s]")
