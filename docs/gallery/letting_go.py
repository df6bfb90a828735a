"""
The hand lets go while it presses
=================================

The device without a hand receives a force that is one round trip (100 ms) old. Every method except
`none` fades the part of it that would accelerate the device.
"""

import matplotlib.pyplot as plt
import numpy as np

from drake_teleop.lab.comparison.one_dof import OneDof, Task, operator_intent, run_one_dof
from drake_teleop.station.channel.network import PRESETS
from drake_teleop.station.passivity.methods import PassivityConfig

model, gone = OneDof(), 3000  # grip and servo of the station; ms
task = Task(0.1, 0.6, 0.7, 1.5, release_start=9.0, release_end=10.0, end=4.0, rest_window=0.1)
intent = operator_intent(task)
grip = np.tile([model.hand_mass, model.hand_damping, model.hand_stiffness], (len(intent), 1))
grip[gone:] = 0.0
figure, axes = plt.subplots(figsize=(7, 3.5))
for method in ("none", "tdpa", "charged_tdpa", "ledger"):
    passivity = PassivityConfig(method=method)
    run = run_one_dof(model, passivity, PRESETS["internet"], intent=intent, grip=grip)
    axes.plot(
        run.t - run.t[gone], 1e3 * (run.master_position - run.master_position[gone]), label=method
    )
axes.set(xlabel="t after letting go [s]", ylabel="way of the device [mm]")
axes.set(xlim=(-0.2, 0.8), ylim=(-120, 20))
axes.legend()
