"""
Every passivity method over one network
=======================================

In one degree of freedom, the hand swings freely, presses on a wall of 5.1 kN/m, holds and retracts,
over a round trip of 100 ms with jitter and loss. Blue: displayed force; grey: contact force times
the force scale.
"""

import matplotlib.pyplot as plt

from drake_teleop.common.style import BLUE, GREY
from drake_teleop.lab.comparison.one_dof import REFERENCE_ONE_DOF, measures_of_run, run_one_dof
from drake_teleop.station.channel.network import PRESETS
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig

columns = 3
figure, panels = plt.subplots(3, columns, figsize=(9, 6), sharex=True, sharey=True)
for axes, method in zip(panels.flat, METHODS, strict=True):
    run = run_one_dof(REFERENCE_ONE_DOF, PassivityConfig(method=method), PRESETS["internet"])
    found = measures_of_run(run, REFERENCE_ONE_DOF)
    axes.plot(run.t, REFERENCE_ONE_DOF.force_scale * run.wall_force, color=GREY, linewidth=0.8)
    axes.plot(run.t, run.hand_force, color=BLUE, linewidth=0.8)
    axes.set_title(f"{method}: {'stable' if found.stable else 'unstable'}")
    axes.set_ylim(-6, 3)
figure.supxlabel("t [s]", fontsize="medium")
figure.supylabel("force at the hand [N]", fontsize="medium")
