"""
Free motion: 100 N without contact
==================================

The paper's Fig. 6. A fast hand swings a tool of 3 kg; the wrist sensor measures its weight and
inertia. After elimination of the identified load only noise remains.
"""

import matplotlib.pyplot as plt

import drake_teleop as dt

result = dt.run_scenario(dt.LoadScenario("free_motion_force"), progress=False).result
figure, (above, below) = plt.subplots(2, 1, figsize=(7, 4.2), sharex=True)
above.plot(result.t, result["measured_wrench_S"][:, 2])
above.set(ylabel="measured $f_z$ [N]")
below.plot(result.t, result["contact_wrench_S"][:, :3], label=["x", "y", "z"])
below.set(ylabel="contact force [N]", xlabel="t [s]", ylim=(-5, 5))
below.legend(ncols=3)
