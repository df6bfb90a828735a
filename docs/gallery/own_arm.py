"""
Your arm and tool
=================

The same hand with another arm (:download:`arm.urdf </gallery/arm.urdf>`) and another tool, a block
of 1.8 kg. Their load is identified before the run.
"""

import matplotlib.pyplot as plt

import drake_teleop as dt
from drake_teleop.station.slave.slave_config import Tool

scenario = dt.LoadScenario("free_motion_force")
scenario.slave.model = "arm.urdf"
scenario.slave.tool = Tool(mass=1.8, com=[0.01, 0.0, 0.08])
run = dt.run_scenario(scenario, progress=False)
print(run.identification)

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4.2), sharex=True)
above.plot(run.result.t, run.result["measured_wrench_S"][:, 2])
above.set(ylabel="measured $f_z$ [N]")
below.plot(run.result.t, run.result["contact_wrench_S"][:, :3], label=["x", "y", "z"])
below.set(ylabel="contact force [N]", xlabel="t [s]", ylim=(-5, 5))
below.legend(ncols=3)
