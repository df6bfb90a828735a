"""Is what the analysis says of stability what a simulation does, and how long does it take?

`python benchmarks/analysis.py [--json] [--environments N]` bisects the round trip at which a
simulation of one axis becomes unstable, for N (4) environments and three grips in contact, and for
free motion with the tool felt, and compares it with the delay margin of the sampled loop. The
simulation knows nothing of the analysis: events, rings of packets, Runge-Kutta steps.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_teleop.analysis.one_axis import OneAxis
from drake_teleop.analysis.sampled_loop import (
    Sampling,
    delay_steps,
)
from drake_teleop.slave.wrist_sensor import butterworth_sections

Array = NDArray[np.float64]

SECONDS = 20.0  # of a simulation, which is compared with itself over its first and last windows
WINDOW = 2.0
LONGEST = 0.3  # [s] one way; stable up to there counts as stable for any delay


def simulate(
    axis: OneAxis, sampling: Sampling, start: Array, duration: float, substeps: int = 4
) -> Array:
    """(N, 5) x_m, v_m, x_s, v_s and felt force at every hand period, from `start` (4,)."""
    rates = np.array([sampling.hand_hz, sampling.joint_control_hz, sampling.sensor_hz])
    tick_hz = float(np.lcm.reduce(np.rint(rates).astype(np.int64)))
    every = np.rint(tick_hz / rates).astype(np.int64)
    sections = np.zeros((0, 5))
    if sampling.low_pass_hz is not None:
        sections = butterworth_sections(sampling.low_pass_hz, sampling.sensor_hz)
    mass = axis.hand_mass + axis.device_mass
    master = (mass, axis.device_damping, axis.hand_damping, axis.hand_stiffness)
    slave = (axis.slave_mass, axis.wall_stiffness, axis.wall_damping)
    servo = (axis.velocity_gain, axis.position_gain, axis.position_scale)
    estimate = axis.tool_mass + axis.mass_error
    force = (axis.tool_mass, estimate, axis.sigma, axis.gamma, axis.force_scale)
    out = np.zeros((round(duration * sampling.hand_hz), 5))
    _simulate(
        master, slave, servo, force, every, 1 / tick_hz, delay_steps(axis, sampling), sections,
        substeps, start, out,
    )  # fmt: skip
    return out


@njit(cache=True)
def _simulate(master, slave, servo, force, every, tick, delay, sections, substeps, start, out):
    mass, friction, hand_b, hand_k = master
    heavy, wall_k, wall_b = slave
    kv, kp, lp = servo
    tool, estimate, sigma, gamma, kf = force
    x, v, xs, vs = start
    pull = sample = 0.0
    memory, new_memory = np.zeros((2, 2)), np.zeros((2, 2))
    poses, wrenches = np.zeros(max(delay, 1)), np.zeros(max(delay, 1))
    received, k, i = 0.0, 0, 0
    while True:
        felt, command = sample, x
        if delay > 0:
            felt, command = wrenches[k % delay], received
        contact = wall_k * xs + wall_b * vs
        acceleration = pull - contact / heavy
        new = (x, v, pull, sample, received)
        if i % every[0] == 0:
            if k == out.shape[0]:
                return
            out[k] = x, v, xs, vs, felt
            if delay > 0:
                wrenches[k % delay], poses[k % delay] = sample, x
                received = poses[(k + 1) % delay]
            push = -hand_k * x - hand_b * v - felt
            new_x, new_v = _advance(
                x, v, push / mass, 0.0, friction / mass, every[0] * tick, substeps
            )
            k += 1
        else:
            new_x, new_v = x, v
        new_pull = new[2]
        if i % every[1] == 0:
            new_pull = kv * (kp * (lp * command - xs) - vs)
        new_sample = sample
        if i % every[2] == 0:
            measured = contact + tool * acceleration
            value = gamma * (measured - estimate * acceleration) + sigma * estimate * acceleration
            for s in range(sections.shape[0]):
                b0, b1, b2, a1, a2 = sections[s]
                filtered = b0 * value + memory[s, 0]
                new_memory[s, 0] = b1 * value - a1 * filtered + memory[s, 1]
                new_memory[s, 1] = b2 * value - a2 * filtered
                value = filtered
            memory[:] = new_memory
            new_sample = kf * value
        x, v, pull, sample = new_x, new_v, new_pull, new_sample
        xs, vs = _advance(xs, vs, pull, wall_k / heavy, wall_b / heavy, tick, substeps)
        i += 1


@njit(cache=True)
def _advance(x, v, push, stiffness, damping, duration, substeps):
    """x'' = push - stiffness x - damping x' by classical Runge-Kutta steps."""
    h = duration / substeps
    for _ in range(substeps):
        a1 = push - stiffness * x - damping * v
        v2 = v + 0.5 * h * a1
        a2 = push - stiffness * (x + 0.5 * h * v) - damping * v2
        v3 = v + 0.5 * h * a2
        a3 = push - stiffness * (x + 0.5 * h * v2) - damping * v3
        v4 = v + h * a3
        a4 = push - stiffness * (x + h * v3) - damping * v4
        x += h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
        v += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return x, v


def simulated_growth(axis: OneAxis, sampling: Sampling) -> float:
    """Growth of a perturbation [1/s], of the largest position in the second and last windows."""
    x = np.abs(simulate(axis, sampling, np.array([0.0, 0.1, 0.0, 0.0]), SECONDS, 1)[:, 0])
    window = int(WINDOW * sampling.hand_hz)
    first, last = x[window : 2 * window], x[-window:]
    if not np.isfinite(x).all():
        return math.inf
    between = len(x) - window + int(last.argmax()) - window - int(first.argmax())
    return math.log(max(last.max(), 1e-300) / max(first.max(), 1e-300)) * sampling.hand_hz / between


def simulated_margin(axis: OneAxis, sampling: Sampling) -> float:
    """Round trip [s] at which the simulation begins to grow, between two whole periods."""

    def grows(steps: int) -> bool:
        return simulated_growth(replace(axis, delay=steps / sampling.hand_hz), sampling) > 0

    low, high = 0, int(LONGEST * sampling.hand_hz)
    if grows(0):
        return 0.0
    if not grows(high):
        return math.inf
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if grows(middle) else (middle, high)
    return (low + high) / sampling.hand_hz
