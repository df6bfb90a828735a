"""
The ledger while packets are lost
=================================

A third of all packets is lost, in bursts of 50 ms, over a round trip of 100 ms. The energy balance
of `ledger` remains correct, because its counters are cumulative: the next packet includes the
energy of all lost ones.
"""

import matplotlib.pyplot as plt

from drake_teleop.lab.comparison.one_dof import AT_HAND, AT_SLAVE, REFERENCE_ONE_DOF, run_one_dof
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.methods import PassivityConfig

lossy = NetworkConfig(delay=0.05, jitter=0.3, loss=0.33, burst=0.05, burst_loss=0.9)
run = run_one_dof(REFERENCE_ONE_DOF, PassivityConfig(method="ledger"), lossy)
figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4.5), sharex=True)
above.plot(run.t, REFERENCE_ONE_DOF.force_scale * run.wall_force, label="wall / 17.5", color="grey")
above.plot(run.t, run.hand_force, label="displayed")
above.set(ylabel="force at the hand [N]")
above.legend()
energy = run.start_energy + run.input_energies[:, AT_HAND] + run.input_energies[:, AT_SLAVE]
below.plot(run.t, 1e3 * energy, "k")
below.axhline(0, color="red", linewidth=0.8)
below.set(xlabel="t [s]", ylabel="left in the station [mJ]")
print(f"least: {1e3 * run.least_energy_sum(AT_SLAVE):.1f} mJ, never below zero")
