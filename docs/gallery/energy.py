"""
A network creates energy
========================

Energy that hand and wall put into a station, without a passivity method and with `ledger`, over a
round trip of 50 ms. Below zero, the station has delivered more energy than it received.
"""

import matplotlib.pyplot as plt

from drake_teleop.lab.comparison.one_dof import AT_HAND, AT_SLAVE, REFERENCE_ONE_DOF, run_one_dof
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.methods import PassivityConfig

figure, panels = plt.subplots(1, 2, figsize=(8.5, 3.2))
for axes, method in zip(panels, ("none", "ledger"), strict=True):
    run = run_one_dof(REFERENCE_ONE_DOF, PassivityConfig(method=method), NetworkConfig(delay=0.025))
    hand, wall = run.input_energies[:, AT_HAND], run.input_energies[:, AT_SLAVE]
    axes.plot(run.t, hand, label="hand")
    axes.plot(run.t, wall, label="wall")
    axes.plot(run.t, run.start_energy + hand + wall, "k", label="both, and the start")
    axes.set(title=method, xlabel="t [s]", ylabel="energy put in [J]")
    print(f"{method:6}: least energy {run.least_energy_sum(AT_SLAVE):8.3f} J")
panels[0].legend()
