"""Energy observers against closed forms and the methods' own ledgers."""

from __future__ import annotations

import numpy as np
import pytest
from test_methods import T, energy_balance, line, poses, run, wrenches

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.passivity.energy import port_work
from drake_teleop.station.passivity.memory import STORED_ENERGY, WRENCH_LIMIT
from drake_teleop.station.passivity.methods import (
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    step_addresses,
)
from drake_teleop.station.passivity.packet import PACKET_SIZE, POSE, SENDER_ENERGY


def test_work_of_a_held_wrench_is_exact_however_coarse_the_samples():
    """A constant force on a path, a constant torque on a rotation about its axis."""
    angle = np.linspace(0.0, 2.5, 6)
    pose = np.zeros((6, 7))
    pose[:, 0], pose[:, 3] = np.cos(angle / 2), np.sin(angle / 2)
    pose[:, 4:] = np.outer(np.linspace(0.0, 1.0, 6) ** 3, [0.3, -0.2, 0.1])
    wrench = np.tile([2.0, 1.0, 5.0, 0.0, 0.0, 0.4], (6, 1))
    for pair in ("held", "backward", "mean"):
        work = port_work(wrench, pose, pair)
        np.testing.assert_allclose(work[-1], [0.6 - 0.2 + 0.5, 0.4 * 2.5], rtol=1e-12)


def test_pairs_differ_by_the_work_of_a_step():
    """`mean` is exact for a sampled spring; the others differ by k dx^2 / 2."""
    x, k = np.array([0.0, 0.1, 0.15, 0.4]), 7.0
    pose, wrench = np.zeros((4, 7)), np.zeros((4, 6))
    pose[:, 0], pose[:, 4], wrench[:, 0] = 1.0, x, -k * x
    stored, step = 0.5 * k * x[-1] ** 2, 0.5 * k * np.sum(np.diff(x) ** 2)
    work = {pair: -port_work(wrench, pose, pair)[-1, 0] for pair in ("held", "mean", "backward")}
    np.testing.assert_allclose(work["mean"], stored)
    np.testing.assert_allclose(work["held"], stored - step)
    np.testing.assert_allclose(work["backward"], stored + step)


def test_tdpa_ledger_is_the_work_at_the_hand():
    rng = np.random.default_rng(5)
    master, f_e = poses(rng, 1200), wrenches(rng, 1200)
    config = PassivityConfig(method="tdpa", retreat=[1e3, 1e3])  # withheld energy is lost
    wrench, _, _, _, memory = run("tdpa", config, master, poses(rng, 1200), f_e, line(rng, 1200))
    hand, slave = energy_balance(memory[0]), energy_balance(memory[1])
    put_in = -port_work(wrench, master, "backward")[-1]
    # Input energy is sent, stored, or balanced by energy from the slave.
    kept = put_in - hand.sent + hand.received - hand.stored
    assert (kept >= -1e-12).all() and (kept <= [2e-3 + 1e-12, 1e-4 + 1e-12]).all()
    in_flight = (hand.sent - slave.received) + (slave.sent - hand.received)
    assert (in_flight >= 0.0).all() and (hand.lost > 0.0).any()


@pytest.mark.parametrize("short", [None, "master", "slave"])
def test_drag_acts_only_below_the_reserve(short):
    """Full drag against the motion, above the fading speed."""
    config = PassivityConfig(method="charged_tdpa")
    p, dx, wrench = method_parameters(config), np.zeros(6), np.zeros(6)
    dx[:3] = 1e-3 * np.array([2.0, -1.0, 2.0]) / 3
    memory = initial_method_memory("charged_tdpa", p, poses(np.random.default_rng(0), 1)[0])
    received, packet = np.zeros(PACKET_SIZE), np.zeros(PACKET_SIZE)
    received[POSE] = [1, 0, 0, 0, 0, 0, 0]
    received[SENDER_ENERGY] = 0.0 if short == "slave" else 1.0
    memory[STORED_ENERGY] = 0.0 if short == "master" else 1.0
    master_step(
        step_addresses("charged_tdpa"), received, True, received[POSE], dx / T, dx, np.zeros(6),
        p[WRENCH_LIMIT], T, p, memory, wrench, packet,
    )  # fmt: skip
    if short is None:
        np.testing.assert_array_equal(wrench, 0.0)
    else:
        drag = np.array(config.charged_tdpa.drag[0])
        np.testing.assert_allclose(wrench[:3], -drag * dx[:3] / 1e-3, rtol=1e-12)


def test_arrays_of_wrong_shape_are_rejected():
    with pytest.raises(DrakeTeleopError, match="pair: 'forward' is unknown"):
        port_work(np.zeros((3, 6)), np.zeros((3, 7)), "forward")
    with pytest.raises(DrakeTeleopError, match=r"expected shapes \(N, 6\) and \(N, 7\)"):
        port_work(np.zeros((3, 6)), np.zeros((2, 7)))
    for wrench in ([[1.0, 2.0], [3.0]], [["a"] * 6]):
        with pytest.raises(DrakeTeleopError, match="wrench: contains no real numbers"):
            port_work(wrench, np.zeros((1, 7)))
