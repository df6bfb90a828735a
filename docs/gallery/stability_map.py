"""
Map of stability
================

Round trip against the displayed share sigma of the tool, for a wall of 5.1 kN/m and the medium
grip. The blue line is the limit of stability. The colour is the error of the displayed force, 0.5
to 5 Hz.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import drake_teleop as dt
from drake_teleop.lab.analysis.maps import stability_map
from drake_teleop.lab.analysis.period_map import Sampling
from drake_teleop.lab.analysis.task_direction import OneAxisFromScenario

scenario = dt.LoadScenario("contact_transition")
scenario.operator.grip = "medium"
axis = OneAxisFromScenario(scenario, (0.0, 0.0, 1.0))
axis = replace(axis, wall_stiffness=5100.0, wall_damping=0.0)
round_trip, sigma = np.linspace(0.0, 0.12, 60), np.linspace(0.0, 1.5, 60)
found = stability_map(axis, Sampling(), "delay", round_trip / 2, "sigma", sigma)
figure, axes = plt.subplots(figsize=(6.5, 4))
shown = np.where(found.stable, found.distortion, np.nan)
colours = axes.pcolormesh(1e3 * round_trip, sigma, 100 * shown, cmap="cividis")
axes.plot(2e3 * found.boundary[:, 0], found.boundary[:, 1], ".", markersize=3)
figure.colorbar(colours, label="off by [%]")
axes.set(xlabel="round trip [ms]", ylabel="sigma", title="white: unstable")
