"""
Clean wrench for robot learning
===============================

A dataset of five episodes at 30 frames per second, one table for each. In one episode the wrench is
rotated by 90 degrees and negated. The command names this fault and writes the contact wrench of all
episodes.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import polars as pl

from drake_teleop.logs.dataset.dataset import dataset_command
from drake_teleop.logs.sample import sample_episode

folder = Path(tempfile.mkdtemp())
(folder / "demo").mkdir()
names = ["timestamp", "x", "y", "z", "qw", "qx", "qy", "qz", "fx", "fy", "fz", "tx", "ty", "tz"]
for k in range(5):
    t, position, quaternion, wrench, *_ = sample_episode(k)
    if k == 3:
        wrench = wrench[:, [1, 0, 2, 4, 3, 5]] * [1, -1, -1, 1, -1, -1]
    frames = pl.DataFrame(np.column_stack([t, position, quaternion, wrench]), schema=names)
    frames.write_parquet(folder / f"demo/episode_{k}.parquet")
summary = dataset_command(folder / "demo", folder / "out", identify=True)

episode = pl.read_parquet(folder / "out/demo/episode_3.parquet")
contact = np.array(episode["observation.contact_wrench"].to_list())
figure, axes = plt.subplots(2, sharex=True)
axes[0].plot(t, episode.select("fx", "fy", "fz"))
axes[0].set_ylabel("recorded force [N]")
axes[1].plot(t, contact[:, :3])
axes[1].fill_between(t, -15, 15, where=episode["observation.in_contact"], alpha=0.2)
axes[1].set_xlabel("time [s]")
axes[1].set_ylabel("contact force [N]")
