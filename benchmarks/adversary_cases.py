"""Cases of `adversary.py`: a case is a row of numbers from 0 to 1.

`DRAWS` defines the quantity of each number, so that all are drawn and changed in the same way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.comparison.one_dof import PERIOD_S, REFERENCE_ONE_DOF
from drake_teleop.station.channel import network
from drake_teleop.station.channel.network import NetworkConfig

Array = NDArray[np.float64]
Draw = Callable[[float], Any]

STEPS = 12000
TIME = PERIOD_S * np.arange(STEPS, dtype=np.float64)
FREE = -0.04  # m, start position of the hand
LIGHT, FIRM = (0.1, 2.0, 50.0), (0.5, 20.0, 700.0)  # kg, N s/m, N/m
LONGEST = 4000  # longest delay of a packet in periods


def _even(low: float, high: float) -> Draw:
    return lambda u: low + u * (high - low)


def _log(low: float, high: float) -> Draw:
    return lambda u: low * (high / low) ** u


def _one_of(*choices: str) -> Draw:
    return lambda u: choices[int(u * len(choices))]


def _often(share: float, draw: Draw) -> Draw:
    """Return a map of a number to a value in `share` of all cases, and to zero in the others."""
    return lambda u: draw(u / share) if u < share else 0.0


# Quantity -> map of a number from 0 to 1 to its value [SI].
DRAWS: dict[str, Draw] = {
    "round_trip": _log(1e-3, 2.6),
    "share_forward": _even(0.1, 0.9),
    "jitter": _often(0.8, _even(0.0, 1.0)),  # as `NetworkConfig.jitter`
    "distribution": _one_of("uniform", "normal", "gamma"),
    "order": _one_of("kept", "lost"),
    "loss": _often(0.6, _even(0.0, 0.5)),
    "burst": _often(0.6, _log(0.005, 0.4)),
    "outage": _often(0.4, _log(0.05, 1.0)),
    "silent_way": _one_of("both", "forward", "backward"),
    "delay_change": _one_of("none", "steps", "swings"),
    "delay_by": _log(0.002, 0.4),
    "delay_pace": _log(0.05, 3.0),
    "timeout": _log(0.05, 1.0),
    "grip": _even(0.0, 1.0),  # share of the way from a light to a firm grip
    "later_grip": _even(0.0, 1.0),
    "regrip": _even(1.0, 18.0),  # time of the change; after the end: never
    "wall": _one_of("stands", "stands", "stands", "vanishes", "jumps", "swings"),
    "wall_stiffness": _log(500.0, 5e4),
    "wall_reach": _even(0.002, 0.03),
    "wall_pace": _log(0.15, 4.0),
    "motion": _one_of("presses", "taps", "circles"),
    "frequency": _even(0.7, 3.0),
    "amplitude": _even(0.01, 0.06),
    "centre": _even(-0.7, 0.5),  # amplitude beyond the wall
    "until": _even(3.5, 6.5),
    "depth": _even(-0.02, 0.03),  # share of the hold
    "hold": _even(1.5, 3.0),
    "end": _one_of("lets go", "lets go", "jumps away", "holds on"),
    "seed": lambda u: int(u * 2**31),
    # Only with `--imperfect`.
    "configured_stiffness_ratio": _even(0.8, 1.2),
    "configured_damping_ratio": _even(0.8, 1.2),
    "motor_lag": _often(0.5, _even(0.0, 3e-3)),
    "resolution": _often(0.5, _even(0.0, 30e-6)),
    "noise": _often(0.5, _even(0.0, 0.5)),
}


def coordinates(path: tuple[int, ...], seed: int) -> Array:
    """Return the numbers from 0 to 1 of the case with this name; see the module."""
    u = np.random.default_rng([seed, path[0]]).random(len(DRAWS))
    for change in path[1:]:
        rng = np.random.default_rng([seed, path[0], change])
        moved = rng.random(len(u)) < 0.2
        moved[rng.integers(len(u))] = True
        near = np.abs(u + rng.normal(0.0, 0.15, len(u)))
        near = np.where(near > 1.0, 2.0 - near, near)
        new = np.where(rng.random(len(u)) < 0.6, near, rng.random(len(u)))
        u = np.where(moved, np.clip(new, 0.0, 1.0 - 1e-9), u)
    return u


def case_of(path: tuple[int, ...], seed: int) -> dict[str, Any]:
    """Return the values of the case with this name, by the names of `DRAWS`."""
    return {
        name: draw(u)
        for (name, draw), u in zip(DRAWS.items(), coordinates(path, seed).tolist(), strict=True)
    }


def smooth(start: float, length: float) -> Array:
    """Return a ramp (N,) from 0 to 1 within `length` [s]."""
    u = np.clip((TIME - start) / length, 0.0, 1.0)
    return u**3 * (10.0 + u * (6.0 * u - 15.0))


def let_go_at(case: dict[str, Any]) -> float:
    """Return the time at which the hold ends [s]."""
    return float(case["until"] + 0.5 + case["hold"])


def intent(case: dict[str, Any]) -> Array:
    """Return the intended motion (N, 2): it moves, holds, and lets go, jumps away or holds on."""
    turn = 2 * np.pi * case["frequency"] * TIME
    wave = {
        "presses": np.clip(1.5 * np.sin(turn / 8), -1.0, 1.0),
        "taps": np.sin(turn),
        "circles": 1.5 * np.sin(turn / 3 + 1.0),
    }[case["motion"]]
    begun, over = smooth(0.5, 0.5), smooth(case["until"], 0.5)
    leaving = smooth(let_go_at(case), 0.15) * (case["end"] == "jumps away")
    x = FREE + begun * (1 - over) * (case["amplitude"] * (case["centre"] + wave) - FREE)
    x += (over - leaving) * (case["depth"] - FREE)
    return np.stack([x, np.gradient(x, PERIOD_S)], axis=1)


def grip(case: dict[str, Any]) -> Array:
    """Return the hand's parameters (N, 3), zero after it has let go."""
    firm = case["grip"] + smooth(case["regrip"], 0.1) * (case["later_grip"] - case["grip"])
    hand = np.array(LIGHT) * (np.array(FIRM) / LIGHT) ** firm[:, None]
    if case["end"] == "lets go":
        hand[let_go_at(case) <= TIME] = 0.0
    return hand


def wall(case: dict[str, Any]) -> Array:
    """Return position and stiffness (N, 2) of the wall."""
    rows = np.tile([0.0, case["wall_stiffness"]], (STEPS, 1))
    reach, pace = case["wall_reach"], case["wall_pace"]
    turns = (TIME / pace).astype(int)
    if case["wall"] == "vanishes":
        rows[turns % 2 == 1, 1] = 0.0
    elif case["wall"] == "jumps":
        levels = np.random.default_rng(case["seed"]).random(turns[-1] + 1)
        rows[:, 0] = -reach * levels[turns]
    elif case["wall"] == "swings":
        rows[:, 0] = -0.5 * reach * (1 - np.cos(2 * np.pi * TIME / pace))
    return rows


def silences(rng: np.random.Generator, t: Array, length: float, gap: float) -> NDArray[np.bool_]:
    """Return flags (N,) of outages: each lasts `length` [s], at a mean distance of `gap`."""
    starts = np.cumsum(length + rng.exponential(gap, 40))[:, None]
    return np.any((starts <= t) & (t < starts + length), axis=0)


def delays(case: dict[str, Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the delays (N,) of packets forward and backward in periods, -1 if lost."""
    rng, sent, found = np.random.default_rng(case["seed"]), np.arange(STEPS), []
    shares = {"forward": case["share_forward"], "backward": 1.0 - case["share_forward"]}
    for way, (name, share) in enumerate(shares.items()):
        line = NetworkConfig(
            delay=share * case["round_trip"],
            jitter=case["jitter"],
            distribution=case["distribution"],
            loss=case["loss"],
            burst=case["burst"],
        )
        p = network.network_parameters(line, case["seed"], way, PERIOD_S)
        travel = network.packet_delay_steps(p, STEPS)[:, 0]
        lost = travel < 0
        turns = TIME / case["delay_pace"]
        later = {
            "none": np.zeros(STEPS),
            "steps": rng.random(int(turns[-1]) + 1)[turns.astype(int)],
            "swings": 0.5 * (1 - np.cos(2 * np.pi * turns)),
        }[case["delay_change"]]
        travel += np.round(case["delay_by"] / PERIOD_S * later).astype(int)
        silent = silences(rng, TIME, case["outage"], 2.0)
        if case["silent_way"] in (name, "both"):
            lost |= silent
        arrival = np.where(lost, 0, sent + travel)
        if case["order"] == "kept":
            arrival = np.maximum.accumulate(arrival)
        found.append(np.where(lost, -1, np.clip(arrival - sent, 0, LONGEST)))
    return found[0], found[1]


def prepared(case: dict[str, Any], imperfect: bool) -> dict[str, Any]:
    """Return the arguments of `run_one_dof` except for the method."""
    model = REFERENCE_ONE_DOF
    if imperfect:
        # The mass is up to 20 % less than configured. It is not in `DRAWS`, so that cases keep
        # their names.
        mass = 1.0 - 0.2 * np.random.default_rng([case["seed"], 1]).random()
        model = dataclasses.replace(
            REFERENCE_ONE_DOF,
            configured_mass_ratio=1.0 / mass,
            master_resolution=case["resolution"],
            slave_resolution=case["resolution"] / 3,
            wrench_noise=case["noise"],
            **{
                k: case[k]
                for k in ("configured_stiffness_ratio", "configured_damping_ratio", "motor_lag")
            },
        )
    return {
        "model": model,
        "forward": NetworkConfig(),
        "seed": case["seed"],
        "timeout": case["timeout"],
        "intent": intent(case),
        "grip": grip(case),
        "wall": wall(case),
        "delays": delays(case),
    }
