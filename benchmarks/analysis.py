"""Does the stability analysis agree with simulations, and how long does it take?

`python benchmarks/analysis.py [--json FILE]` prints

* the round trip at which a simulation of one axis becomes unstable, by bisection, and the delay
  margin of the sampled loop. Cases are three grips at four environments, with sigma 0 and 1, and
  free motion with a light grip. The simulation is independent of the analysis: it has events,
  queues of packets and Runge-Kutta steps. Baseline: the delay margin of the continuous loop;
* the time of five maps of 100 x 100 cells, with distortion and boundary. Baseline: eigenvalues of
  the closed loop with its registers, for a sample of the cells;
* the time of one axis at 1000 frequencies with all tests.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_teleop.lab.analysis import (
    absolute_stability,
    two_port,
)
from drake_teleop.lab.analysis.cut_loop import cut_loop, delay_margin, loop_response
from drake_teleop.lab.analysis.maps import StabilityMap, stability_map
from drake_teleop.lab.analysis.one_axis import (
    OneAxis,
    device_impedance,
    environment_impedance,
    hand_impedance,
)
from drake_teleop.lab.analysis.period_map import (
    RECEIVED_FORCE,
    SAMPLED_FORCE,
    Sampling,
    one_way_delay_in_hand_periods,
    sampled_two_port,
    transition_matrix_of_cut_loop,
)
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.sensor.sensor_chain import butterworth_sections

Array = NDArray[np.float64]

JR3 = Sampling(low_pass_hz=500.0)
#: Environments that the hand presses with each grip: [N/m], [N s/m].
WALLS = {
    "light": ((1e3, 0.0), (1.5e3, 0.0), (2e3, 10.0), (5.1e3, 0.0)),
    "medium": ((2e3, 0.0), (5.1e3, 0.0), (7e3, 20.0), (1e4, 0.0)),
    "firm": ((5.1e3, 0.0), (1.4e4, 0.0), (2e4, 50.0), (3e4, 0.0)),
}
#: Environments in which `analyse` puts the tool.
WALL_RANGE = absolute_stability.ImpedanceRange((0.0, 0.0), (0.0, 50.0), (0.0, 5.1e3))
WITHIN = 2e-3  # [s] between simulated and computed margin
N = 100  # cells of a map in each direction
CELLS = 40  # cells of a map for the baseline

SECONDS = 20.0  # s, duration of a simulation, whose first and last windows are compared
WINDOW = 2.0
LONGEST = 0.3  # [s] one way; a loop that is stable up to this delay counts as stable for any delay


def simulate(
    axis: OneAxis, sampling: Sampling, start: Array, duration: float, substeps: int = 4
) -> Array:
    """Return (N, 5) x_m, v_m, x_s, v_s and displayed force per hand period, from `start` (4,)."""
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
        master, slave, servo, force, every, 1 / tick_hz,
        one_way_delay_in_hand_periods(axis, sampling), sections, substeps, start, out,
    )  # fmt: skip
    return out


@njit
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


@njit
def _advance(x, v, push, stiffness, damping, duration, substeps):
    """Solve x'' = push - stiffness x - damping x' by classical Runge-Kutta steps."""
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
    """Return the growth of a perturbation [1/s] from the largest positions in two windows."""
    x = np.abs(simulate(axis, sampling, np.array([0.0, 0.1, 0.0, 0.0]), SECONDS, 1)[:, 0])
    window = int(WINDOW * sampling.hand_hz)
    first, last = x[window : 2 * window], x[-window:]
    if not np.isfinite(x).all():
        return math.inf
    between = len(x) - window + int(last.argmax()) - window - int(first.argmax())
    return math.log(max(last.max(), 1e-300) / max(first.max(), 1e-300)) * sampling.hand_hz / between


def simulated_margin(axis: OneAxis, sampling: Sampling, longest: float = LONGEST) -> float:
    """Return the round trip [s], in whole periods, at which the simulation begins to grow."""

    def grows(steps: int) -> bool:
        return simulated_growth(replace(axis, delay=steps / sampling.hand_hz), sampling) > 0

    low, high = 0, int(longest * sampling.hand_hz)
    if grows(0):
        return 0.0
    if not grows(high):
        return math.inf
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if grows(middle) else (middle, high)
    return (low + high) / sampling.hand_hz


def held(grip: str, **fields: float) -> OneAxis:
    """Return the station's axis in this hand."""
    hand = GRIP_IMPEDANCES[grip]
    axis = OneAxis(hand_mass=hand.mass, hand_damping=hand.damping, hand_stiffness=hand.stiffness)
    return replace(axis, **fields)


def margin_rows() -> list[dict[str, Any]]:
    """Return simulated and computed margins."""
    cases: list[tuple[str, OneAxis, float]] = [
        (grip, held(grip, sigma=sigma, wall_stiffness=k, wall_damping=b), LONGEST)
        for sigma in (0.0, 1.0)
        for grip, walls in WALLS.items()
        for k, b in walls
    ]
    # The first window of instability ends at 161 ms one way.
    cases.append(("light", held("light", sigma=1.0, wall_stiffness=0.0), 0.13))
    rows = []
    for grip, axis, longest in cases:
        continuous = continuous_margin(axis)
        rows.append(
            {
                "grip": grip,
                "sigma": axis.sigma,
                "stiffness": axis.wall_stiffness,
                "damping": axis.wall_damping,
                "simulated": simulated_margin(axis, JR3, longest),
                "sampled": float(delay_margin(cut_loop(axis, JR3))),
                "continuous": continuous,
            }
        )
    return rows


def continuous_margin(axis: OneAxis) -> float:
    """Return the round trip [s] at which |L| = 1 reaches the limit; for stable axes."""
    omega = np.geomspace(0.1, 1e3, 200_000)
    s = 1j * omega
    wall, device = environment_impedance(axis, s), device_impedance(axis, s)
    felt = two_port.transmitted_impedance(two_port.hybrid_matrix(axis, s), wall) - device
    loop = -felt / (hand_impedance(axis, s) + device)
    crossed = np.diff(np.abs(loop) > 1)
    lags = np.angle(loop[1:][crossed]) % (2 * np.pi) / omega[1:][crossed]
    return float(lags.min(initial=math.inf))


def grows(axis: OneAxis, sampling: Sampling) -> bool:
    """Return whether the closed loop with its registers has an eigenvalue outside |z| = 1."""
    M, registers = (
        transition_matrix_of_cut_loop(axis, sampling),
        2 * one_way_delay_in_hand_periods(axis, sampling),
    )
    n = len(M) - 3
    closed = np.diag(np.ones(n + registers - 1), -1)
    closed[: n + 1] = 0.0
    closed[:n, :n] = M[:n, :n]
    if registers:
        closed[n, SAMPLED_FORCE] = 1.0
    closed[:n, n + registers - 1 if registers else SAMPLED_FORCE] += M[:n, RECEIVED_FORCE]
    return bool(np.abs(np.linalg.eigvals(closed)).max() > 1)


def off(row: dict[str, Any], name: str = "sampled") -> float:
    """Return the difference of a margin from the simulated one [s]."""
    return 0.0 if row[name] == row["simulated"] else abs(row[name] - row["simulated"])


def map_rows() -> list[dict[str, Any]]:
    """Return the times of maps, and the number of sampled cells that agree with eigenvalues."""
    free = {"wall_stiffness": 0.0}
    delay = np.arange(N) / 2e3  # whole periods, which the eigenvalues require
    stiffness, sigma = np.geomspace(100.0, 1e5, N), np.linspace(0.0, 2.0, N)
    maps = {
        "delay x stiffness": (OneAxis(), JR3, "delay", delay, "wall_stiffness", stiffness),
        "sigma x delay, contact": (OneAxis(), JR3, "sigma", sigma, "delay", delay),
        "sigma x delay, free": (held("light", **free), JR3, "sigma", sigma, "delay", 4 * delay),
        "error of phi x sigma": (
            replace(OneAxis(), force_scale=1.0, **free), JR3,
            "mass_error", np.linspace(-1.0, 1.0, N), "sigma", sigma / 2,
        ),
        "rate x stiffness": (
            OneAxis(), JR3, "rate", np.geomspace(300.0, 1e4, N), "wall_stiffness", stiffness,
        ),
    }  # fmt: skip
    rows = []
    for name, arguments in maps.items():
        found = stability_map(*arguments)
        ours = seconds(lambda: stability_map(*arguments), 3)  # noqa: B023
        began = time.thread_time()
        same = eigenvalues_agree(*arguments[:2], found)
        each = (time.thread_time() - began) / CELLS
        rows.append(
            {
                "map": name,
                "seconds": ours,
                "eigenvalues": each * N * N / ours,
                "same": same,
                "stable": float(found.stable.mean()),
                "boundary": len(found.boundary),
            }
        )
    return rows


def eigenvalues_agree(axis: OneAxis, sampling: Sampling, found: StabilityMap) -> int:
    """Return the number of random cells whose stability equals that by eigenvalues."""
    rng, same = np.random.default_rng(1), 0
    for i, j in rng.integers(N, size=(CELLS, 2)):
        cell, rates = axis, sampling
        for name, value in ((found.x_name, found.x[j]), (found.y_name, found.y[i])):
            if name == "rate":
                rates = replace(rates, hand_hz=value, joint_control_hz=value, sensor_hz=4 * value)
            else:
                cell = replace(cell, **{name: float(value)})
        same += grows(cell, rates) != found.stable[i, j]
    return same


def seconds(call: Callable[[], Any], rounds: int) -> float:
    """Return the shortest of some thread times [s]."""
    times = []
    for _ in range(rounds):
        began = time.thread_time()
        call()
        times.append(time.thread_time() - began)
    return min(times)


def analyse(axis: OneAxis, omega: Array) -> None:
    """Analyse one axis: stability, passivity, bounded loads, margins, transparency, sampled."""
    s = 1j * omega
    H = two_port.hybrid_matrix(axis, s)
    wall = environment_impedance(axis, s)
    felt = two_port.transmitted_impedance(H, wall)
    two_port.is_difference_noticed(felt, two_port.ideal_impedance(axis, s, wall))
    two_port.fit_apparent_impedance(felt, omega)
    two_port.transmitted_z_width(H)
    scaled = two_port.scale_slave_power(H, two_port.power_ratio(axis))
    absolute_stability.llewellyn_criterion(H)
    absolute_stability.required_damping(H)
    absolute_stability.raisbeck_criterion(scaled)
    S = two_port.scattering_matrix(scaled)
    absolute_stability.scattering_norm(S)
    absolute_stability.structured_singular_value(S)
    hands, walls = absolute_stability.impedance_range_of_grips(), WALL_RANGE
    absolute_stability.stiffness_limit(H, omega, hands)
    absolute_stability.singular_value_in_ranges(H, omega, hands, walls)
    loop = cut_loop(axis, JR3)
    delay_margin(loop)
    loop_response(loop, omega, axis.delay)
    sampled_two_port(axis, JR3, omega)


def main(arguments: list[str] | None = None) -> int:
    """Run and print the comparisons; return 0 if `holds`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    axis = replace(OneAxis(), delay=10e-3)
    omega = 2 * np.pi * np.geomspace(0.1, 500.0, 1000)
    analyse(axis, omega)  # compiles
    result: dict[str, Any] = {"margins": margin_rows(), "maps": map_rows()}
    result["analysis"] = seconds(lambda: analyse(axis, omega), 50)
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")
    print_tables(result)
    return 0 if holds(result) else 1


def print_tables(result: dict[str, Any]) -> None:
    """Print the results of `main`."""
    print("delay margin, ms of round trip")
    print("grip    sigma  wall kN/m  N s/m  simulated  sampled  continuous")
    for row in result["margins"]:
        print(
            f"{row['grip']:<8}{row['sigma']:5.0f}{row['stiffness'] / 1e3:11.1f}"
            f"{row['damping']:7.0f}{1e3 * row['simulated']:11.1f}{1e3 * row['sampled']:9.1f}"
            f"{1e3 * row['continuous']:12.1f}"
        )
    print(f"largest difference {1e3 * max(map(off, result['margins'])):.2f} ms")
    print(f"\nmap of {N} x {N}          seconds  eigenvalues take  same    stable  boundary")
    for row in result["maps"]:
        print(
            f"{row['map']:<24}{row['seconds']:9.2f}{row['eigenvalues']:13.0f} x"
            f"{row['same']:7d}/{CELLS}{100 * row['stable']:7.0f} %{row['boundary']:8d}"
        )
    print(f"\none axis, 1000 frequencies: {1e3 * result['analysis']:.1f} ms")


def holds(result: dict[str, Any]) -> bool:
    """Return whether margins and maps agree and times are below their limits."""
    return (
        all(off(row) <= WITHIN for row in result["margins"])
        and all(row["same"] == CELLS and row["seconds"] <= 5.0 for row in result["maps"])
        and result["analysis"] <= 10e-3
    )


if __name__ == "__main__":
    sys.exit(main())
