"""
Displayed impedance, by frequency
=================================

Impedance at the hand in free motion and on a wall, by the sampled model, for three values of sigma.
Dotted: ideal station.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import drake_teleop as dt
from drake_teleop.lab.analysis.period_map import Sampling, sampled_two_port
from drake_teleop.lab.analysis.task_direction import OneAxisFromScenario
from drake_teleop.lab.analysis.two_port import ideal_impedance, transmitted_impedance

axis = OneAxisFromScenario(dt.LoadScenario("contact_transition"), (0.0, 0.0, 1.0))
omega = 2 * np.pi * np.geomspace(0.5, 100, 300)
s = 1j * omega
figure, panels = plt.subplots(1, 2, figsize=(8.5, 3.4), sharey=True)
for axes, wall, title in zip(
    panels, (0 * s, 5100 / s), ("free motion", "wall of 5.1 kN/m"), strict=True
):
    for sigma, colour in ((0.0, "C0"), (0.5, "C2"), (1.0, "C1")):
        one = replace(axis, sigma=sigma)
        displayed = transmitted_impedance(sampled_two_port(one, Sampling(), omega), wall)
        axes.loglog(omega / (2 * np.pi), abs(displayed), color=colour, label=f"sigma = {sigma:g}")
        axes.loglog(omega / (2 * np.pi), abs(ideal_impedance(one, s, wall)), ":", color=colour)
    axes.set(title=title, xlabel="frequency [Hz]")
panels[0].set(ylabel="|Z| [N s/m]")
panels[0].legend()
