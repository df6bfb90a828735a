"""Does any method deliver energy that it did not receive, over random networks and ports?

`python benchmarks/passivity.py [--json FILE] [--networks N] [--seconds S]` runs both ends of every
method over N (10 000) random networks of 10 s at 500 Hz: delay up to 300 ms, jitter up to 100 %,
loss up to 50 % or in bursts with up to 95 %, reordering, and duplicates. The device saturates in
half of them. The motion of both ends is random in six degrees of freedom with bounded acceleration.
The wrenches are random and often push along the motion, so that they are active. It prints for each
method the least energy of the channel, for two pairs. The methods can observe f_k (x_k - x_(k-1));
the true port of a held wrench is f_(k-1) (x_k - x_(k-1)). Baselines in the same run: no method,
wave variables that hold the last sample, and the two-layer tank without its margin. Methods without
a bound, and `charged_tdpa`, run over every tenth network.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_teleop.station.channel.network import NetworkConfig, newest_packets
from drake_teleop.station.passivity import methods, two_layer, wave
from drake_teleop.station.passivity.memory import (
    COMMAND,
    COMMAND_POSE,
    DISSIPATED_ENERGY,
    RECEIVED_ENERGY,
    SENT_ENERGY,
    SERVO_D,
    SERVO_K,
    STORED_ENERGY,
    WRENCH_LIMIT,
    own_memory,
)
from drake_teleop.station.passivity.methods import (
    METHODS,
    PassivityConfig,
    initial_method_memory,
    method_parameters,
)
from drake_teleop.station.passivity.packet import (
    METHOD_VALUES,
    PACKET_SIZE,
    WRENCH,
    dot_of_group,
    limit_group,
    move_pose_into,
    pose_difference_into,
)

Array = NDArray[np.float64]

PERIOD = 2e-3
ACCELERATION = np.array([20.0, 200.0])  # bounds of |x''| at both ends [m/s^2, rad/s^2]
WRENCH_SIZE = np.array([6.0, 0.1])  # [N, N m]
POSE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

# Figures of `_run` for each group: least energy at either pair, excess of the displayed wrench over
# f_e, least energy in the tank of an end.
BACKWARD, TRUE, STRONGER, TANK, FIGURES = range(5)
WAVE_HOLD = "wave_hold"  # implemented here, not in the package
_OWN_STEPS = (0, 0, 0)
_STEP = own_memory().vector(6)
# These run over every network, the others over every tenth: methods without a bound fail soon, and
# `charged_tdpa` has the ledger of `tdpa`.
EVERY = ("wave", "tdpa", "two_layer", "pspm")


def random_motion(rng: np.random.Generator, steps: int) -> tuple[Array, Array]:
    """Return increments (steps, 6) and poses (steps, 7) of a motion of bounded acceleration.

    The acceleration changes at random about ten times a second, and a spring and a damper keep the
    motion within about 0.5 m and 1 rad.
    """
    push = rng.normal(size=(steps, 6)) * np.repeat(ACCELERATION, 3)
    changes = rng.random((steps, 6)) < 10.0 * PERIOD
    changes[0] = True
    last = np.maximum.accumulate(np.where(changes, np.arange(steps)[:, None], 0), axis=0)
    dx, pose = np.zeros((steps, 6)), np.zeros((steps, 7))
    _move(np.take_along_axis(push, last, axis=0), ACCELERATION, PERIOD, dx, pose)
    return dx, pose


@njit
def _move(push, most, T, dx, pose):
    x, v, a, now = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(7)
    now[0] = 1.0
    for k in range(len(push)):
        for g in range(2):
            rate = 6.0 if g == 0 else 14.0
            for i in range(3 * g, 3 * g + 3):
                a[i] = push[k, i] - rate * rate * x[i] - 2.0 * rate * v[i]
            limit_group(a, g, 0.999 * most[g])
        for i in range(6):
            v[i] += a[i] * T
            x[i] += v[i] * T
            dx[k, i] = v[i] * T
        move_pose_into(now, dx[k], now)
        pose[k] = now


def random_wrench(rng: np.random.Generator, steps: int) -> Array:
    """Return a wrench (steps, 6) that changes about five times a second and is often zero."""
    value = rng.normal(size=(steps, 6)) * np.repeat(WRENCH_SIZE, 3) * (rng.random((steps, 6)) < 0.7)
    changes = rng.random((steps, 6)) < 5.0 * PERIOD
    last = np.maximum.accumulate(np.where(changes, np.arange(steps)[:, None], 0), axis=0)
    return np.take_along_axis(value, last, axis=0)


@njit
def _push(wrenches, motion, active, out):
    """Write wrenches plus `active` times a wrench along the motion (N, 6) to `out` (N, 6)."""
    for k in range(len(out)):
        for g in range(2):
            push = active * WRENCH_SIZE[g] / (_size(motion[k], g) + 1e-9)
            for i in range(3 * g, 3 * g + 3):
                out[k, i] = wrenches[k, i] + push * motion[k, i]


@njit
def _size(a, g):
    return math.sqrt(dot_of_group(a, a, g))


@njit
def _run(steps, at_motor, p, memories, newest, motion, poses, wrenches, T, sent, figures):
    """Write the least energies of one method over one network to `figures` (2, FIGURES).

    `motion` (2, N, 6) and `poses` (2, N, 7) are those of both ends, `wrenches` (N, 6) those of the
    contact. The slave's port is that of wrench and command, or (`at_motor`) that of its servo.
    """
    hand, felt = np.zeros(6), np.zeros(6)
    wrench, before, motor, pull = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    command, old, moved, nothing = np.zeros(13), np.zeros(7), np.zeros(6), np.zeros(PACKET_SIZE)
    twists, energy, work = np.zeros((2, 6)), np.zeros((2, 2)), np.zeros((2, 2))
    start = memories[:, STORED_ENERGY].copy()
    old[0], rate, slots = 1.0, 1.0 / T, sent.shape[1]
    figures[:] = 0.0
    for k in range(newest.shape[1]):
        for i in range(6):
            twists[0, i], twists[1, i] = motion[0, k, i] * rate, motion[1, k, i] * rate
            before[i] = wrench[i]
        f_e = wrenches[k]
        for end in range(2):
            now = newest[1 - end, k]
            received = nothing if now < 0 else sent[1 - end, now % slots]
            fresh = now >= 0 and (k == 0 or now != newest[1 - end, k - 1])
            if end == 0:
                _master(steps, received, fresh, poses[0, k], twists[0], motion[0, k], hand,
                        p[WRENCH_LIMIT], T, p, memories[0], wrench, sent[0, k % slots])  # fmt: skip
                felt[:] = received[WRENCH]
            else:
                _slave(steps, received, fresh, poses[1, k], twists[1], motion[1, k], f_e, T, p,
                       memories[1], command, sent[1, k % slots])  # fmt: skip
        for g in range(2):
            work[0, g] += dot_of_group(before, motion[0, k], g)
        if at_motor:
            for g in range(2):
                work[1, g] += dot_of_group(motor, motion[1, k], g)
            # The force of the slave's servo from now until the next step.
            pose_difference_into(command, poses[1, k], pull)
            for i in range(6):
                motor[i] = p[SERVO_K][i // 3] * pull[i] - p[SERVO_D][i // 3] * twists[1, i]
        else:
            pose_difference_into(command, old, moved)
            old[:] = command[:7]
            for g in range(2):
                energy[0, g] += dot_of_group(f_e, moved, g) - dot_of_group(wrench, motion[0, k], g)
                work[1, g] -= dot_of_group(motor, moved, g)
            motor[:] = f_e
        for g in range(2):
            energy[1, g] = -work[0, g] - work[1, g]
            for end in range(2):
                books = memories[end, RECEIVED_ENERGY][g] - memories[end, SENT_ENERGY][g]
                tank = start[end, g] + books - memories[end, DISSIPATED_ENERGY][g] - work[end, g]
                figures[g, TANK] = min(figures[g, TANK], tank)
            figures[g, BACKWARD] = min(figures[g, BACKWARD], energy[0, g])
            figures[g, TRUE] = min(figures[g, TRUE], energy[1, g])
            stronger = _size(wrench, g) - _size(felt, g)
            figures[g, STRONGER] = max(figures[g, STRONGER], stronger)


@njit
def _master(steps, received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    if steps != _OWN_STEPS:
        methods.master_step(
            steps, received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet
        )
        return
    for i in range(6):
        b = p[wave.WAVE_IMPEDANCE][i // 3]  # impedance of the line
        wrench[i] = math.sqrt(2.0 * b) * received[METHOD_VALUES][i] - b * dx[i] / T
    for g in range(2):
        limit_group(wrench, g, limits[g])
    for i in range(6):
        b = p[wave.WAVE_IMPEDANCE][i // 3]
        packet[METHOD_VALUES][i] = (b * dx[i] / T - wrench[i]) / math.sqrt(2.0 * b)


@njit
def _slave(steps, received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    if steps != _OWN_STEPS:
        methods.slave_step(
            steps, received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet
        )
        return
    step = memory[_STEP]
    for i in range(6):
        b, u = p[wave.WAVE_IMPEDANCE][i // 3], received[METHOD_VALUES][i]
        step[i] = T * (math.sqrt(2.0 * b) * u + wrench[i]) / b
        packet[METHOD_VALUES][i] = u + math.sqrt(2.0 / b) * wrench[i]
    move_pose_into(memory[COMMAND_POSE], step, memory[COMMAND_POSE])
    command[:] = memory[COMMAND]


def cases() -> dict[str, tuple[str, Array]]:
    """Return name -> (method, its parameters with a device that does not saturate)."""
    # A soft servo, no damper that fills the tanks, and limits only by the tanks: energy is scarce.
    soft: dict[str, Any] = {
        "servo_stiffness": [300.0, 5.0],
        "servo_damping": [0.0, 0.0],
        "two_layer": two_layer.TwoLayerConfig(damper=[0.0, 0.0], drain_rate=1e6),
    }
    found = {}
    for name in METHODS:
        found[name] = name, method_parameters(PassivityConfig(method=name, **soft))
    tank = PassivityConfig(method="two_layer", **soft)
    found["two_layer_no_margin"] = "two_layer", method_parameters(tank)
    found["two_layer_no_margin"][1][two_layer.MAX_PORT_ACCELERATION] = 0.0
    found["wave_hold"] = WAVE_HOLD, method_parameters(PassivityConfig(method="wave"))
    return found


def random_network(rng: np.random.Generator) -> NetworkConfig:
    """Return a network within the ranges of the study."""
    bursts = rng.random() < 0.5
    burst_loss = float(rng.uniform(0.5, 0.95))
    return NetworkConfig(
        delay=float(rng.uniform(0.0, 0.3)),
        jitter=float(rng.uniform(0.0, 1.0)),
        distribution=str(rng.choice(["uniform", "normal", "gamma"])),
        loss=float(rng.uniform(0.0, 0.5 * (burst_loss if bursts else 1.0))),
        burst=float(rng.uniform(0.01, 0.5)) if bursts else 0.0,
        burst_loss=burst_loss if bursts else 1.0,
        duplicate=float(rng.uniform(0.0, 0.5)),
    )


def _some_networks(job: tuple[int, int, int]) -> tuple[dict[str, Any], dict[str, float]]:
    """Return least figures over the networks first..last-1, and CPU time [s], by method."""
    first, last, steps = job
    every = cases()
    least = {name: np.full((2, FIGURES), np.inf) for name in every}
    seconds = dict.fromkeys(every, 0.0)
    figures = np.zeros((2, FIGURES))
    # A few motions and wrenches in all combinations: drawing new ones would take most of the time.
    rng = np.random.default_rng(0)
    motions = [random_motion(rng, steps) for _ in range(32)]
    wrenches = [random_wrench(rng, steps) for _ in range(32)]
    wrench = np.zeros((steps, 6))
    for seed in range(first, last):
        rng = np.random.default_rng(seed)
        network = random_network(rng)
        newest = np.stack([newest_packets(network, seed, way, steps, PERIOD) for way in range(2)])
        # In a step, the master comes before the slave.
        newest[1] = np.minimum(newest[1], np.arange(steps) - 1)
        # Only as many packets as are in use, so that they stay in the cache.
        sent = np.zeros((2, int((np.arange(steps) - newest).max()) + 1, PACKET_SIZE))
        ends = [motions[rng.integers(32)] for _ in range(2)]
        motion, poses = (np.stack(parts) for parts in zip(*ends, strict=True))
        passive, active = wrenches[rng.integers(32)], rng.uniform(-1.0, 1.0)
        _push(passive, motion[rng.integers(2)], active, wrench)
        saturates = rng.random() < 0.5
        for name, (method, p) in every.items():
            if name not in EVERY and seed % 10:
                continue
            p = p.copy()
            if saturates:
                p[WRENCH_LIMIT] = 0.5, 0.01
            own = method == WAVE_HOLD
            step_addresses = _OWN_STEPS if own else methods.step_addresses(method)
            start = initial_method_memory("none" if own else method, p, POSE)
            initial = start[STORED_ENERGY]
            memories = np.stack([start, start])
            at_motors = not own and METHODS[method].balance_at_motors
            began = time.thread_time()
            _run(
                step_addresses, at_motors, p, memories, newest, motion, poses,
                wrench, PERIOD, sent, figures,
            )  # fmt: skip
            seconds[name] += time.thread_time() - began
            figures[:, STRONGER] *= -1.0
            figures[:, TRUE] += 2.0 * initial  # a tank at each end
            least[name] = np.minimum(least[name], figures)
    return least, seconds


def study(networks: int, seconds: float = 10.0, processes: int = 2) -> dict[str, dict[str, float]]:
    """Run every method over the networks.

    Returns:
        Name -> "energy": least energy of the channel at the backward pair [J] (0 for methods at the
        motor's port, which do not bound it); "true_energy": at the true port of held wrenches, with
        the start energy of the tanks [J]; "tank": least energy of an end's tank, by the work at its
        port, for methods with tanks [J]; "stronger": excess of the displayed wrench over the
        received
        one [N, N m]; "us": CPU time of both ends per step, with the random ports [us]. All are the
        worst over networks and over translation and rotation.
    """
    steps, share = round(seconds / PERIOD), max(1, -(-networks // (8 * processes)))
    jobs = [(i, min(i + share, networks), steps) for i in range(0, networks, share)]
    _some_networks((0, 1, 10))  # compiles, before the processes fork
    if processes > 1:
        with multiprocessing.get_context("fork").Pool(processes) as pool:
            parts = pool.map(_some_networks, jobs, chunksize=1)
    else:
        parts = [_some_networks(job) for job in jobs]
    result = {}
    for name in parts[0][0]:
        worst = np.min([least[name] for least, _ in parts], axis=(0, 1))
        ran = networks if name in EVERY else -(-networks // 10)
        spent = sum(seconds[name] for _, seconds in parts)
        result[name] = {
            "energy": float(worst[BACKWARD]),
            "true_energy": float(worst[TRUE]),
            "tank": float(worst[TANK]),
            "stronger": float(-worst[STRONGER]),
            "us": 1e6 * spent / (ran * steps),
        }
    return result


def main(arguments: list[str] | None = None) -> int:
    """Run and print the study; return 0 if the bounds hold and the baselines break them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--networks", type=int, default=10_000, help="number of networks (default: 10000)"
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="simulated time of each [s]")
    options = parser.parse_args(arguments)
    began = time.monotonic()
    result = study(options.networks, options.seconds)
    took = time.monotonic() - began
    if options.json:
        found = {"networks": options.networks, "wall_s": took, "methods": result}
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    print(f"Least energy over {options.networks} networks x {options.seconds:g} s, {took:.0f} s")
    print(f"{'method':<22}{'backward':>11}{'true port':>11}{'tank [J]':>11}{'us/step':>9}")
    for name, figures in result.items():
        print(
            f"{name:<22}{figures['energy']:11.1e}{figures['true_energy']:11.1e}"
            f"{figures['tank']:11.1e}{figures['us']:9.2f}"
        )
    return 0 if holds(result) else 1


def holds(result: dict[str, dict[str, float]]) -> bool:
    """Return whether the methods keep their bounds and the baselines do not."""
    return (
        result["tdpa"]["energy"] >= -1e-9
        and result["charged_tdpa"]["energy"] >= -1e-9
        and result["wave"]["energy"] >= -1e-9
        and result["tdpa"]["stronger"] <= 1e-12
        and result["two_layer"]["true_energy"] >= -1e-9
        and result["two_layer"]["tank"] >= -1e-9
        and result["two_layer_no_margin"]["tank"] < -1e-4
        and result["none"]["energy"] < -1.0
        and result["wave_hold"]["energy"] < -1.0
    )


if __name__ == "__main__":
    sys.exit(main())
