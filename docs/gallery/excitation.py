"""
Excitation trajectory for your arm
==================================

For any URDF or SDF of a serial arm, here :download:`arm.urdf </gallery/arm.urdf>`. The trajectory
excites all ten load parameters, respects the limits of joints and sensor, and begins and ends at
rest.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from drake_teleop.lab.excitation.excite import excite
from drake_teleop.lab.excitation.robot import RobotFromModel
from drake_teleop.station.sensor.presets import PRESETS

robot = RobotFromModel(
    Path("arm.urdf"), "sensor", PRESETS["ati_mini45"], acceleration=(10.0,), payload=1.5
)
print("assumed:", *robot.assumptions, sep="\n  ")
found = excite(robot, seconds=4, progress=False)
t = np.linspace(0, found.trajectory.period, 600)
figure, axes = plt.subplots(figsize=(7, 3.8))
axes.plot(t, found.trajectory.evaluate(t)[0], label=robot.arm.joint_names)
axes.set(xlabel="t [s]", ylabel="joint angles [rad]")
axes.set_title(f"condition number {found.values['kappa_w10']:.2f}")
axes.legend(ncols=3)
