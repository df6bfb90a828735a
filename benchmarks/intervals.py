"""How often do the stated 95 % intervals contain the true load, for noise of any colour?

`python benchmarks/intervals.py [--json FILE] [--seeds N]` identifies the same load N times (500)
from the same motion with new noise of six colours. For each of the 16 parameters it prints how
often
the interval of `uncertainty.confidence_intervals` contains the truth. With 500 seeds the standard
error of this share is 1 %. Records that do not excite some parameters follow, in the same noise: it
prints how often each of these parameters was called identified.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter

from drake_teleop.load.batch.uncertainty import confidence_intervals
from drake_teleop.load.identification import PARAMETER_NAMES, Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.regressor import non_contact_wrench

Array = NDArray[np.float64]

TOOL = phi_from_mass_com_inertia(
    3.13,
    [0.004, -0.003, 0.085],
    [[0.012, 0.0002, -0.0004], [0.0002, 0.0115, 0.0003], [-0.0004, 0.0003, 0.0045]],
)
OFFSETS = np.array([9.1, -1.0, 10.0, 0.43, -0.69, -0.16])
TRUTH = np.concatenate([OFFSETS, TOOL])
NOISE = np.array([0.25, 0.25, 0.25, 0.012, 0.012, 0.012])
"""Standard deviations of the wrench channels [N, N m]: the wrist sensor of the shipped station."""

COLOURS: dict[str, tuple[float, str, float]] = {
    "white, 1 kHz": (1e3, "ar", 0.0),
    "AR(1) 0.5, 1 kHz": (1e3, "ar", 0.5),
    "AR(1) 0.9, 1 kHz": (1e3, "ar", 0.9),
    "AR(1) 0.95, 1 kHz": (1e3, "ar", 0.95),
    "low-pass 30 Hz, 1 kHz": (1e3, "low-pass", 30.0),
    "low-pass 500 Hz, 8 kHz": (8e3, "low-pass", 500.0),
}
"""Name -> (rate [Hz], kind, coefficient or cut-off of a Butterworth filter of 4th order [Hz])."""

SECONDS = 10.0


def coloured_noise(rng: np.random.Generator, samples: int, colour: str) -> Array:
    """Return stationary noise (samples, 6) of unit variance and one of `COLOURS`."""
    rate, kind, number = COLOURS[colour]
    if kind == "ar":
        b, a = np.array([np.sqrt(1.0 - number**2)]), np.array([1.0, -number])
    else:
        b, a = butter(4, number, fs=rate)
        impulse = lfilter(b, a, np.eye(1, 4000)[0])
        b = b / np.sqrt(impulse @ impulse)
    start = 1000  # after this, the filters have no effect of their start
    return np.asarray(lfilter(b, a, rng.normal(size=(start + samples, 6)), axis=0))[start:]


def motion(rate: float, seconds: float = SECONDS, seed: int = 0) -> tuple[Array, Array, Array]:
    """Return (s, omega, alpha), (N, 3) each, for sines of 0.1 to 1 Hz in all angles.

    The angles are 1 rad, together 5 to 20 rad/s^2; So accelerates by 2 m/s^2.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate
    w = 2.0 * np.pi * np.array([0.1, 0.3, 0.7, 1.0])
    size = np.array([0.8, 0.5, 0.25, 0.2])
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 4))
    wave = np.sin(t[:, None, None] * w + phase)
    r, p, _ = (wave[:, :3] @ size).T
    rates = np.cos(t[:, None, None] * w + phase[:3]) @ (size * w)
    dr, dp, dy = rates.T
    omega = np.stack(
        [
            dr - dy * np.sin(p),
            dp * np.cos(r) + dy * np.sin(r) * np.cos(p),
            -dp * np.sin(r) + dy * np.cos(r) * np.cos(p),
        ],
        axis=1,
    )
    up = np.stack([-np.sin(p), np.sin(r) * np.cos(p), np.cos(r) * np.cos(p)], axis=1)
    return 9.81 * up + 2.0 * wave[:, 3:, 3], omega, np.gradient(omega, 1.0 / rate, axis=0)


def coverage(colour: str, seeds: int, seconds: float = SECONDS) -> dict[str, Array]:
    """Return statistics of the intervals in `seeds` noises of this colour.

    Returns:
        "coverage": (16,) shares of intervals that contain the truth; "identified": (16,) shares of
        records in which the parameter was called identified; "z": (16,) mean squared error over
        stated variance; "degrees": (16,) medians of the degrees of freedom.
    """
    s, omega, alpha = motion(COLOURS[colour][0], seconds)
    ideal = OFFSETS + non_contact_wrench(s, omega, alpha, TOOL)
    held, identified, z, degrees = (np.zeros((seeds, 16)) for _ in range(4))
    for seed in range(seeds):
        rng = np.random.default_rng([seed, list(COLOURS).index(colour)])
        noise = NOISE * coloured_noise(rng, len(s), colour)
        result = identify(ideal + noise, s, omega, alpha, noise=NOISE)
        low, high = confidence_intervals(result)
        held[seed] = (low <= TRUTH) & (high >= TRUTH)
        identified[seed] = result.identifiable
        error = np.concatenate([result.offsets, result.phi]) - TRUTH
        z[seed] = (error / result.standard_deviations) ** 2
        degrees[seed] = result.degrees_of_freedom
    return {
        "coverage": held.mean(axis=0),
        "identified": identified.mean(axis=0),
        "z": z.mean(axis=0),
        "degrees": np.median(degrees, axis=0),
    }


def unexcited_records() -> dict[str, tuple[tuple[Array, Array, Array], tuple[str, ...]]]:
    """Return name -> (motion, parameters that it does not excite)."""
    inertia = PARAMETER_NAMES[10:]
    up = np.random.default_rng(1).normal(size=(24, 3))
    poses = 9.81 * up / np.linalg.norm(up, axis=1, keepdims=True)
    still = np.zeros((2400, 3))
    t = np.arange(2400) / 100.0
    angle, turning = np.cos(t), np.array([0.0, 1.0, 0.0])
    swing = 9.81 * np.stack([np.sin(angle), 0.0 * t, np.cos(angle)], axis=1)
    one_axis = swing, np.outer(-np.sin(t), turning), np.outer(-np.cos(t), turning)
    slow = swing, np.outer(-0.01 * np.sin(t), turning), np.outer(-0.01 * np.cos(t), turning)
    one_pose = np.tile([0.0, 0.0, 9.81], (2400, 1)), still, still
    return {
        "24 poses": ((np.repeat(poses, 100, axis=0), still, still), inertia),
        "one axis": (one_axis, ("I_xx", "I_xz", "I_zz")),
        "one axis, slow": (slow, inertia),
        "one pose": (one_pose, PARAMETER_NAMES[6:]),
    }


def false_verdicts(name: str, seeds: int) -> dict[str, int]:
    """Return how often unexcited parameters were called identified, in `seeds` records.

    Returns:
        parameter without excitation -> count; AR(1) noise of 0.9.
    """
    (s, omega, alpha), unknown = unexcited_records()[name]
    ideal = OFFSETS + non_contact_wrench(s, omega, alpha, TOOL)
    counts = dict.fromkeys(unknown, 0)
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        noise = NOISE * coloured_noise(rng, len(s), "AR(1) 0.9, 1 kHz")
        result: Identification = identify(ideal + noise, s, omega, alpha, noise=NOISE)
        for parameter in unknown:
            counts[parameter] += bool(result.identifiable[PARAMETER_NAMES.index(parameter)])
    return counts


def main(arguments: list[str] | None = None) -> int:
    """Run and print the study; return 0 if every share is within 90-98 %, 1 otherwise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--seeds", type=int, default=500, help="records for each colour")
    options = parser.parse_args(arguments)
    shares = {colour: coverage(colour, options.seeds) for colour in COLOURS}
    verdicts = {name: false_verdicts(name, options.seeds) for name in unexcited_records()}
    every = np.array([shares[colour]["coverage"] for colour in COLOURS])
    if options.json:
        study = {c: {k: v.tolist() for k, v in r.items()} for c, r in shares.items()}
        found = {"seeds": options.seeds, "colours": study, "called identified": verdicts}
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    print(f"Coverage of nominal 95 % intervals [%], {options.seeds} seeds, {SECONDS:.0f} s")
    print("parameter " + "".join(f"{name:>24}" for name in COLOURS))
    for i, name in enumerate(PARAMETER_NAMES):
        print(f"{name:<10}" + "".join(f"{100.0 * share:24.1f}" for share in every[:, i]))
    print(f"smallest {100.0 * every.min():.1f}, largest {100.0 * every.max():.1f}")
    print(f"\nCalled identified without excitation, of {options.seeds} (AR(1) 0.9)")
    for name, counts in verdicts.items():
        print(f"{name:<16}" + ", ".join(f"{p} {n}" for p, n in counts.items()))
    quiet = not any(n for counts in verdicts.values() for n in counts.values())
    return 0 if every.min() >= 0.90 and every.max() <= 0.98 and quiet else 1


if __name__ == "__main__":
    sys.exit(main())
