"""
Clean wrench for robot learning
===============================

A LeRobot dataset of five episodes at 30 frames a second. In one episode the wrench is turned by 90
degrees and negated. The command names it, and writes the contact wrench of all episodes.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import polars as pl

from drake_teleop.logs.dataset.dataset import dataset_command
from drake_teleop.logs.dataset.sample_dataset import write_sample_dataset

folder = Path(tempfile.mkdtemp())


def turned_and_negated(episode):
    x, y, z, tx, ty, tz = episode.wrench.T
    return episode._replace(wrench=np.stack([y, -x, -z, ty, -tx, -tz], axis=1))


write_sample_dataset(folder / "demo", faults={3: turned_and_negated})
summary = dataset_command(folder / "demo", folder / "out", identify=True)

table = pl.read_parquet(folder / "out/demo/data/chunk-000/file-000.parquet")
episode = table.filter(pl.col("episode_index") == 3)
figure, axes = plt.subplots(2, sharex=True)
for axis, name in zip(axes, ("observation.wrench", "observation.contact_wrench"), strict=True):
    axis.plot(episode["timestamp"], np.array(episode[name].to_list())[:, :3])
    axis.set_ylabel(f"{name}\n[N]")
axes[1].fill_between(
    episode["timestamp"], -15, 15, where=episode["observation.in_contact"], alpha=0.2
)
axes[1].set_xlabel("time [s]")
