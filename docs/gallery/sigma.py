"""
The same contact, with the whole tool, half of it and none
==========================================================

Sigma is the share of the tool that is left in what the hand feels.
"""

import matplotlib.pyplot as plt

import drake_teleop as dt

load = dt.identify_load(dt.LoadScenario("identification"))
figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for sigma in (1.0, 0.5, 0.0):
    scenario = dt.LoadScenario("contact_transition")
    scenario.force_scaling.sigma = sigma
    station = dt.MakeTeleopStation(scenario, load_estimate=load.estimate)
    result = dt.simulate(station, scenario.simulation)
    axes.plot(result.t, result["force_to_master"][:, 2], label=f"sigma = {sigma:g}")
axes.set(xlabel="t [s]", ylabel="force to the hand, vertical [N]")
axes.legend()
