"""
A drive, and the network that changes in contact
================================================

A script moves the hand, as a mouse does in `drake-teleop drive`. The hand presses on the leaf. At
1.5 s the network becomes `internet` with a passivity method, at 2.5 s σ becomes 0.5.

.. image:: /figures/drive.webp
   :alt: A drive in the browser: free motion, a press on the leaf, and σ to 1 and back
"""

import matplotlib.pyplot as plt
import numpy as np

import drake_teleop as dt
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.live.inputs import METHODS, NETWORK_NAMES
from drake_teleop.live.scenarios import live_scenario
from drake_teleop.live.session import Session

scenario = live_scenario(dt.LoadScenario("contact_transition"))
session = Session(scenario, identified_load(scenario))
internet = {"network": NETWORK_NAMES.index("internet"), "method": list(METHODS).index("ledger")}
while session.ms < 3500:
    t = 1e-3 * session.ms
    wanted = {"z": round(-7500 * min(t, 1.0))}  # in steps of 10 um
    wanted |= (internet if t >= 1.5 else {}) | ({"sigma": 50} if t >= 2.5 else {})
    session.apply_inputs(session.inputs.with_changes(wanted))
    session.advance()  # 5 ms
log = session.log()
figure, (above, below) = plt.subplots(2, sharex=True, figsize=(7, 5))
above.plot(log.t, log["force_to_master"][:, 2], label="displayed")
above.set(ylabel="vertical force [N]")
below.plot(
    log.t, 1e3 * np.diff(log["pose_command"][:, 6], append=np.nan), label="step of the command"
)
below.set(xlabel="t [s]", ylabel="step in 1 ms [mm]")
for axes in (above, below):
    axes.axvline(1.5, ls=":")
    axes.legend()
