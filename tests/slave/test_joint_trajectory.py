"""One delayed period of an excitation trajectory, at rest before and after."""

from __future__ import annotations

import numpy as np

from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.slave.joint_commands import ExcitationCommand


def test_trajectory_rests_before_and_after_one_period():
    rng = np.random.default_rng(0)
    trajectory = FourierTrajectory(rng.normal(size=6), *rng.normal(size=(2, 6, 2)), 0.5)
    start, period = 1.25, trajectory.period
    block = ExcitationCommand(trajectory, start)
    context = block.CreateDefaultContext()
    for time, played in (
        (0.0, 0.0),
        (start, 0.0),
        (start + 0.3, 0.3),
        (start + 2 * period, period),
    ):
        context.SetTime(time)
        command = block.GetOutputPort("joint_command").Eval(context)
        np.testing.assert_allclose(command, trajectory.evaluate(played)[0], atol=1e-12)
    assert np.abs(trajectory.evaluate(0.3)[0] - trajectory.evaluate(0.0)[0]).max() > 0.1
