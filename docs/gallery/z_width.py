"""
Z-width: largest stiffness of a virtual wall
============================================

Virtual walls of a device at three rates: stable with a hand on it (full), and passive for any hand
(dashed). Passivity is sufficient for stability, not necessary.
"""

import matplotlib.pyplot as plt
import numpy as np

import drake_teleop as dt
from drake_teleop.lab.analysis.sampled_wall import passive_stiffness, stable_stiffness
from drake_teleop.lab.analysis.task_direction import OneAxisFromScenario

axis = OneAxisFromScenario(dt.LoadScenario("contact_transition"), (0.0, 0.0, 1.0))
mass, b = axis.hand_mass + axis.device_mass, axis.hand_damping + axis.device_damping
damping = np.linspace(0, 40, 161)  # of the wall
figure, axes = plt.subplots(figsize=(7, 3.8))
for rate, colour in ((500, "C0"), (1000, "C1"), (2000, "C2")):
    stable = stable_stiffness(mass, b, damping, 1 / rate, hand_stiffness=axis.hand_stiffness)
    axes.plot(damping, stable / 1e3, color=colour, label=f"{rate} Hz")
    axes.plot(damping, passive_stiffness(b, damping, 1 / rate) / 1e3, "--", color=colour)
axes.set(xlabel="damping of the wall [N s/m]", ylabel="stiffness of the wall [kN/m]")
axes.legend()
