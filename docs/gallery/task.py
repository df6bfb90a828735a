"""
A simulated operator notices contact
====================================

The operator moves on until the displayed force indicates contact, with human delay and noise.
Before contact the force is that of the tool: with sigma = 1 the operator notices contact later.
"""

import matplotlib.pyplot as plt
import numpy as np

import drake_teleop as dt
from drake_teleop.station.task_measures import task_measures

figure, panels = plt.subplots(2, 1, figsize=(7, 4.4), sharex=True)
for axes, sigma in zip(panels, (0.0, 1.0), strict=True):
    scenario = dt.LoadScenario("touch")
    scenario.force_scaling.sigma = sigma
    result = dt.run_scenario(scenario, progress=False).result
    displayed = np.linalg.norm(result["force_to_master"][:, :3], axis=1)
    contact = np.linalg.norm(result["true_contact_wrench_W"][:, :3], axis=1)
    axes.plot(result.t, displayed, label="displayed")
    axes.plot(result.t, scenario.force_scaling.force_scale * contact, label="contact / 17.5")
    noticed = task_measures(result, scenario)["detection_time_s"]
    axes.set(title=f"sigma = {sigma:g}: noticed after {1e3 * noticed:.0f} ms", ylabel="force [N]")
panels[0].legend()
panels[1].set_xlabel("t [s]")
