"""
Grasping a heavy object
=======================

The tool holds 0.8 kg. With the load of the empty tool, the object's weight and inertia are
displayed; with the newly identified load they are not. The object is the difference of the two
loads, Eq. (14).
"""

import matplotlib.pyplot as plt
import numpy as np

import drake_teleop as dt
from drake_teleop.lab.identified_load import identified_load

empty = dt.LoadScenario("free_motion_force")
holding = dt.LoadScenario("free_motion_force")
holding.slave.payload.mass = 0.8
loads = {
    name: identified_load(scenario, progress=False)
    for name, scenario in (("of the empty tool", empty), ("identified anew", holding))
}
figure, axes = plt.subplots(figsize=(7, 3.5))
for name, load in loads.items():
    station = dt.MakeTeleopStation(holding, load_estimate=load.estimate)
    result = dt.simulate(station, holding.simulation, progress=False)
    axes.plot(result.t, result["force_to_master"][:, 2], label=f"load {name}")
tool, total = (load.identification.phi for load in loads.values())
grasped = total - tool
print(f"grasped: {grasped[0]:.3f} kg at {np.round(1e3 * grasped[1:4] / grasped[0], 1)} mm")
axes.set(xlabel="t [s]", ylabel="force to the hand, vertical [N]")
axes.legend()
