"""Does the best (sigma_weight, sigma_inertia) move if accelerated masses are perceived as half?

`python benchmarks/half_mass.py [--swings 40] [--json FILE]`: a hand swings the paper's device and
tool, and a contact force begins. A model of perception (`station.operator.perception`) decides
whether the operator notices it. The figure is the smallest noticed contact force at the tool [N]
in random swings, mean and 95 % interval of the mean. It is given for shares of weight and inertia,
and for an operator who perceives all or half of the rendered inertial force. Another figure is the
ratio of the masses that acceleration and weight indicate: 1 is consistent.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.station.operator.perception import (
    CONTACT_NOTICED_INDEX,
    Perception,
    perceive_contact,
)

Array = NDArray[np.float64]

SHARES = (0.0, 0.25, 0.5, 1.0)
PERCEIVED = {"fully": 1.0, "by half": 0.5}
_SCALE, _TOOL, _DEVICE, _DAMPING, _G = 1 / 17.5, 3.13, 0.15, 0.5, 9.81
_END, _TOUCH, _WITHIN, _RISE = 4.0, 3.0, 0.3, 0.02  # s


def swing(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    """Return velocity and acceleration (N, 3) of a hand."""
    w = 2 * np.pi * rng.uniform(0.3, 1.5, (3, 3))
    phase, size = rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(0.02, 0.1, (3, 3))
    angle = t[:, None, None] * w + phase
    return (size * np.sin(angle)).sum(axis=2), (size * w * np.cos(angle)).sum(axis=2)


def noticed(t: Array, v: Array, free: Array, contact: float) -> bool:
    """Return whether a contact force [N, at the tool] against the motion is noticed in time."""
    way = v[np.searchsorted(t, _TOUCH)]
    rise = np.clip((t - _TOUCH) / _RISE, 0.0, 1.0)[:, None]
    force = free + _SCALE * contact * rise * way / np.linalg.norm(way)
    seen = perceive_contact(t, force, v, Perception(), 0.0)[:, CONTACT_NOTICED_INDEX]
    return bool(seen[(t >= _TOUCH) & (t < _TOUCH + _WITHIN)].any())


def smallest(t: Array, v: Array, a: Array, weight: float, inertia: float) -> float:
    """Return the smallest noticed contact force at the tool [N]."""
    free = _DEVICE * a + _DAMPING * v + _SCALE * _TOOL * inertia * a
    free[:, 2] += _SCALE * _TOOL * weight * _G
    low, high = 0.05, 50.0
    while high / low > 1.03:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if noticed(t, v, free, middle) else (middle, high)
    return high


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--swings", type=int, default=40)
    parser.add_argument("--json", type=Path, help="file for the figures")
    asked = parser.parse_args()
    t = np.arange(round(_END * 500)) / 500
    swings = [swing(np.random.default_rng([k, 31]), t) for k in range(asked.swings)]
    rows: list[dict[str, Any]] = []
    for name, perceived in PERCEIVED.items():
        for weight in SHARES:
            for inertia in SHARES:
                forces = [smallest(t, v, a, weight, perceived * inertia) for v, a in swings]
                half = 1.96 * np.std(forces, ddof=1) / np.sqrt(len(forces))
                ratio = perceived * inertia / weight if weight else None
                rows.append({
                    "perceived": name, "sigma_weight": weight, "sigma_inertia": inertia,
                    "smallest_N": float(np.mean(forces)), "half_width_N": float(half),
                    "mass_ratio": ratio,
                })  # fmt: skip
                print(f"{name:8} weight {weight:4} inertia {inertia:4}: {np.mean(forces):.2f} "
                      f"+- {half:.2f} N, mass ratio {ratio}", flush=True)  # fmt: skip
    best = {
        name: min((r for r in rows if r["perceived"] == name), key=lambda r: r["smallest_N"])
        for name in PERCEIVED
    }
    if asked.json:
        figures = {"rows": rows, "best": best}
        asked.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
