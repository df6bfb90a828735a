"""
Contact: no threshold on the measured force finds it
====================================================

The paper's Fig. 8. The tool touches a sheet spring in the middle of a fast swing (shaded: true
contact of the simulation). The contact force is smaller than the inertial force around it.
"""

import matplotlib.pyplot as plt
import numpy as np

import drake_teleop as dt
from drake_teleop.common.style import shade_contact

result = dt.run_scenario(dt.LoadScenario("contact_transition"), progress=False).result
touched = np.linalg.norm(result["true_contact_wrench_W"], axis=1) > 0
figure, panels = plt.subplots(2, 1, figsize=(7, 4.2), sharex=True)
for axes, signal in zip(panels, ("measured_wrench_S", "contact_wrench_S"), strict=True):
    axes.plot(result.t, np.linalg.norm(result[signal][:, :3], axis=1))
    axes.set(ylabel=signal.replace("_wrench_S", " force [N]"))
    shade_contact(axes, result.t, touched)
panels[1].set(xlabel="t [s]")
