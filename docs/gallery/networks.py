"""
Networks: age of the newest packet
==================================

Age of the newest packet at the receiver, for three presets of a network, and for one of them with a
playout buffer, which makes a random delay constant.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from drake_teleop.station.channel.network import FORWARD, PRESETS, newest_packets

period, steps = 1e-3, np.arange(3000)
networks = {name: PRESETS[name] for name in ("wan", "internet", "geostationary")}
networks["internet, playout 150 ms"] = replace(PRESETS["internet"], playout=0.15, redundant=True)
figure, axes = plt.subplots(figsize=(7, 3.5))
for name, network in networks.items():
    newest = newest_packets(network, 0, FORWARD, len(steps), period)
    age = np.where(newest >= 0, steps - newest, np.nan)
    axes.plot(steps * period, age, linewidth=0.8, label=name)
axes.set(xlabel="t [s]", ylabel="age of the newest packet [ms]", yscale="log", ylim=(10, 1000))
axes.legend(ncols=2)
