"""
One contact, three shares of the tool
=====================================

Sigma is the displayed share of the tool's weight and inertia. With sigma = 1 a contact is a small
notch in the swing; with sigma = 0 only the contact is displayed.
"""

import matplotlib.pyplot as plt

import drake_teleop as dt

scenario = dt.LoadScenario("contact_transition")
figure, axes = plt.subplots(figsize=(7, 3.5))
for sigma in (1.0, 0.5, 0.0):
    scenario.force_scaling.sigma = sigma
    result = dt.run_scenario(scenario, progress=False).result
    axes.plot(result.t, result["force_to_master"][:, 2], label=f"sigma = {sigma:g}")
axes.set(xlabel="t [s]", ylabel="force to the hand, vertical [N]")
axes.legend()
