"""
A gripper grasps an object
==========================

At 5 s the moving tool grasps 0.8 kg. The estimator distinguishes it from contact and identifies it.
"""

import matplotlib.pyplot as plt
import numpy as np

from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.online import change
from drake_teleop.load.regressor import non_contact_wrench

tool = phi_from_mass_com_inertia(3.13, [0, 0, 0.085], np.diag([12e-3, 11e-3, 4e-3]))
held = phi_from_mass_com_inertia(0.8, [0.04, 0, 0.16], np.diag([8e-4, 8e-4, 4e-4]))
rng, t, dt = np.random.default_rng(1), np.arange(0, 15, 1e-3), 1e-3
tilt = 0.4 * np.sin(np.outer(t, [4.0, 5.2]))
omega = np.zeros((len(t), 3))
omega[:, :2] = np.gradient(tilt, dt, axis=0)  # small rotations about x and y, slow ones about z
omega[:, 2] = 0.9 * np.sin(3.1 * t)
alpha = np.gradient(omega, dt, axis=0)
s = 9.81 * np.stack([-tilt[:, 1], tilt[:, 0], np.ones(len(t))], axis=1)
s += 2.0 * np.sin(np.outer(t, [3.0, 3.7, 2.3]))
free = non_contact_wrench(s, omega, alpha, tool)
noise = np.repeat([0.25, 0.012], 3)
known = identify_batch(free + noise * rng.normal(size=free.shape), s, omega, alpha).identification

wrench = free + (t > 5.0)[:, None] * non_contact_wrench(s, omega, alpha, held)
parameters = change.change_detector_parameters(noise, np.full(9, 1e-3), dt)
memory = change.initial_change_memory(np.concatenate([known.offsets, known.phi]), known.covariance)
measured = wrench + noise * rng.normal(size=free.shape)
states = change.detector_states_of_log(memory, parameters, measured, s, omega, alpha)
mass = change.identified_or_known_load(memory, known).mass
print(f"held: {mass - known.mass:.3f} kg")
figure, axes = plt.subplots(figsize=(7, 2.8))
axes.step(t, states)
axes.set_yticks(range(len(change.STATE_NAMES)), change.STATE_NAMES)
axes.set(xlabel="t [s]", title=f"the load counts as, in the end {mass:.3f} kg")
