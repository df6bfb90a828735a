"""
Your block as the master
========================

Any Drake system can replace the master. This one moves the slave along a circle. The wrist sensor
measures the force that keeps 3.1 kg on the circle; the mean force is the sensor's offset.
"""

import matplotlib.pyplot as plt
import numpy as np
from pydrake.systems.framework import LeafSystem

import drake_teleop as dt


class CircleMaster(LeafSystem):
    """Master that commands a circle of the slave, 40 mm wide, once per second."""

    def __init__(self, start):
        super().__init__()
        self._start = np.array(start)
        self.DeclareVectorInputPort("wrench_command", 6)
        self.DeclareVectorOutputPort("pose_command", 7, self._pose, {self.time_ticket()})

    def _pose(self, context, output):
        angle = 2 * np.pi * context.get_time()
        offset = 0.02 * np.array([np.cos(angle) - 1, np.sin(angle), 0.0])
        output.SetFromVector([0.0, 1.0, 0.0, 0.0, *(self._start + offset)])


scenario = dt.LoadScenario("free_motion_force")
scenario.force_scaling.sigma = 1.0  # the tool is displayed completely, so that no load is needed
station = dt.MakeTeleopStation(scenario, master=CircleMaster(scenario.slave.position))
result = dt.simulate(station, scenario.simulation, progress=False)
figure, (left, right) = plt.subplots(1, 2, figsize=(7.5, 3.6))
left.plot(*1e3 * result["pose_command"][:, 4:6].T)
left.set(title="commanded [mm]", xlabel="x in W", ylabel="y in W", aspect="equal")
right.plot(*result["measured_wrench_S"][:, :2].T, linewidth=0.5)
right.set(title="wrist force, 3.1 kg on a circle [N]", xlabel="x in S", ylabel="y in S")
right.set_aspect("equal")
