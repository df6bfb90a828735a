"""
Another haptic device
=====================

The same hand with four devices, by name. Each has the mass, friction, peak force and workspace of
its data sheet. Their swings differ; a flat top means that the device is at its stop.
"""

import matplotlib.pyplot as plt

import drake_teleop as dt

figure, axes = plt.subplots(figsize=(7, 3.5))
for model in ("phantom_premium_15", "geomagic_touch", "omega_6", "virtuose_6d"):
    scenario = dt.LoadScenario("contact_transition")
    scenario.master.model = model
    result = dt.run_scenario(scenario, progress=False).result
    axes.plot(result.t, 1e3 * result["pose_master"][:, 6], label=model)
axes.set(xlabel="t [s]", ylabel="height of the grip [mm]")
axes.legend(ncols=2)
