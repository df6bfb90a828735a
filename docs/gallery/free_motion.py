"""
Free motion: 100 N, and nothing is touched
==========================================

The paper's Fig. 6. A fast hand swings a tool of 3 kg; the wrist sensor reads its weight and
inertia. What is left of that once the identified load is taken away is noise.
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
