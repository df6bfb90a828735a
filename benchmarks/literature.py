"""Does the simulation reproduce published results on delay, detection and architectures?

`python benchmarks/literature.py [--only NAME ...] [--json FILE]`; each name is one publication:

mass           A delay increases the perceived mass: 10 % at 25 ms, 20 % at 50 ms, for a device that
               moves by the measured force (admittance), 6 kg, in a push with release. The figures
               come from a paraphrased copy of the article; the article itself was not available.
               Here: effort over speed at the end of a push, of such a device, and of the station's
               tool, whose inertia is a delayed force (impedance), for a constant force and for a
               half sine.
detection      arXiv 2505.08334: inertial sensors detect contacts in 3 to 39 ms, and up to 50 %
               sooner than a momentum observer. Here: `contact_transition`, the threshold on the
               calculated contact force, and an observer with the arm's true model, exact joint
               states and motor torques; both thresholds are 1.5 times the largest value of the
               same motion without contact.
architectures  Rodriguez-Seda, Lee and Spong, T-RO 25(6), 2009: round trips of 8 to 1088 ms, losses
               to 50 %; errors grow with both, with delay more than with loss, and no method is
               best everywhere. Here: all methods in one axis.
peg            Robotics 14(3), 2025: a delay of 100 ms increases the largest normal force of an
               insertion, not its time. Here: scenario `insert` with the simulated operator.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.comparison.one_dof import (
    OneDof,
    Task,
    measures_of_run,
    operator_intent,
    run_one_dof,
)
from drake_teleop.lab.identification import slave_arm
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.lab.reproduction.experiments import (
    detection_and_peaks_of_contact_run,
    simulate_contact,
)
from drake_teleop.lab.run import run_scenario
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.slave.arm import ArmModel, inverse_dynamics
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.task_measures import task_measures

Array = NDArray[np.float64]

_PUSH_S, _STEP_S = 0.3, 1e-4  # s, duration of a push (estimate); s
_GAIN = 50.0  # 1/s, gain of the momentum observer
_ROUND_TRIPS, _LOSSES = (0.008, 0.064, 0.256, 0.576, 1.088), (0.0, 0.25, 0.5)  # s; 1


def mass() -> dict[str, Any]:
    """Return the relative increase of the perceived mass by the delay [%]."""
    t = np.arange(0.0, _PUSH_S, _STEP_S)
    shapes = {"constant": np.ones_like(t), "half_sine": np.sin(np.pi * t / _PUSH_S)}
    axis, found = OneAxis(sigma=1.0), {}
    hand, device = axis.hand_mass, axis.device_mass
    tool = axis.force_scale * axis.displayed_tool_mass
    for (shape, force), delay in itertools.product(shapes.items(), (0.025, 0.05)):
        late = round(delay / _STEP_S)
        admittance = force.sum() / force[:-late].sum()
        a = np.zeros_like(t)
        for k in range(len(t)):
            a[k] = (force[k] - (tool * a[k - late] if k >= late else 0.0)) / (hand + device)
        # The hand does not perceive its own mass.
        impedance = (force.sum() / a.sum() - hand) / (device + tool)
        found[f"admittance_{shape}_{1e3 * delay:.0f}_ms_%"] = 100.0 * (admittance - 1.0)
        found[f"station_{shape}_{1e3 * delay:.0f}_ms_%"] = 100.0 * (impedance - 1.0)
    return found


def detection() -> dict[str, Any]:
    """Return delays from the touch [ms]."""
    scenario = replace(LoadScenario("contact_transition"), rates__log_hz=2000.0)
    estimate = identified_load(scenario, False).estimate
    run = simulate_contact(scenario, estimate, lambda name: lambda done, words="": None)
    values, arm = detection_and_peaks_of_contact_run(run), slave_arm(scenario)
    touched, free = (np.abs(residual(x.result, arm)) for x in (run.touched, run.free))
    t = run.touched.result.t
    start = t[np.argmax(run.in_contact)]
    beyond = (touched > 1.5 * free.max(axis=0)).any(axis=1) & (t >= start)
    seen = float(t[np.argmax(beyond)]) if beyond.any() else np.nan
    ours = 1e3 * (values["detected_s"] - values["true_s"])
    observer = 1e3 * (seen - float(start))
    return {"ours_ms": ours, "observer_ms": observer, "sooner_%": 100.0 * (1.0 - ours / observer)}


def residual(result: SimulationResult, arm: ArmModel) -> Array:
    """Return external torques (N, n) by the generalised momentum, over the motors' limits."""
    t, torque = result.t, result["joint_torque"]
    q, v = map(np.ascontiguousarray, np.split(result["slave_state"], 2, axis=1))
    dt, zero = float(t[1] - t[0]), np.zeros(q.shape[1])
    r, integral, rows, bias = zero.copy(), None, np.empty_like(q), zero.copy()
    for k in range(len(t)):
        momentum = mass_matrix(arm, q[k]) @ v[k]
        inverse_dynamics(arm.table, q[k], v[k], zero, bias)
        ahead, behind = (mass_matrix(arm, q[k] + sign * 1e-4 * v[k]) for sign in (1.0, -1.0))
        if integral is None:
            integral = momentum.copy()
        r = _GAIN * (momentum - integral)
        integral += dt * (torque[k] + (ahead - behind) @ v[k] / 2e-4 - bias + r)
        rows[k] = r / arm.effort_limit
    return rows


def architectures() -> dict[str, Any]:
    """Return position error of free motion [mm] and force error in the hold [%] by cell."""
    cells, model = {}, OneDof(hand_mass=0.2, hand_damping=5.0, hand_stiffness=300.0,
                              wall_stiffness=1000.0)  # fmt: skip
    for method, trip, loss in itertools.product(METHODS, _ROUND_TRIPS, _LOSSES):
        task = Task(release_start=8.5 + 3 * trip, release_end=9.5 + 3 * trip, end=12.0 + 5 * trip)
        run = run_one_dof(
            model,
            PassivityConfig(method=method),
            NetworkConfig(delay=trip / 2, loss=loss),
            timeout=2.0,
            intent=operator_intent(task),
        )
        of = measures_of_run(run, model, task)
        swing = (run.t > task.swing_start) & (run.t < task.swing_end)
        apart = np.sqrt(np.mean((run.master_position - run.slave_position)[swing] ** 2))
        error = 100.0 * abs(of.force_error) if of.stable else np.inf
        cells[method, trip, loss] = 1e3 * float(apart), float(error)
    rows = [
        {"method": m, "round_trip_s": trip, "loss": loss, "position_mm": x, "force_%": f}
        for (m, trip, loss), (x, f) in cells.items()
    ]
    by_delay = [cells[m, 1.088, 0.0][0] / cells[m, 0.008, 0.0][0] for m in METHODS]
    by_loss = [cells[m, 0.008, 0.5][0] / cells[m, 0.008, 0.0][0] for m in METHODS]
    stable = {
        m: sum(bool(np.isfinite(f)) for (n, *_), (_, f) in cells.items() if n == m) for m in METHODS
    }
    best = [
        min(METHODS, key=lambda m: (cells[m, trip, loss][1], cells[m, trip, loss][0]))
        for trip, loss in itertools.product(_ROUND_TRIPS, _LOSSES)
    ]
    return {
        "position_by_delay": float(np.median(by_delay)),
        "position_by_loss": float(np.median(by_loss)),
        "best_methods": len(set(best)),
        "stable_of_15": stable,
        "best": best,
        "rows": [row | {"force_%": None} if np.isinf(row["force_%"]) else row for row in rows],
    }


def peg(seeds: int = 2) -> dict[str, Any]:
    """Return medians with and without delay."""
    rows: dict[float, list[tuple[float, float, float]]] = {0.0: [], 0.1: []}
    for delay, seed in itertools.product(rows, range(seeds)):
        base = LoadScenario("insert")
        scenario = replace(
            base,
            simulation__seed=seed,
            channel=Channel(delay=delay / 2),
            passivity=PassivityConfig(method="ledger"),
            rates__sensor_hz=2000.0,
            rates__hand_hz=1000.0,
            rates__joint_control_hz=1000.0,
        )
        result = run_scenario(scenario, progress=False).result
        measures = task_measures(result, scenario)
        force = np.linalg.norm(result["true_contact_wrench_W"][:, :3], axis=1).max()
        rows[delay].append((float(force), measures["task_time_s"], measures["success"]))
    (f0, t0, s0), (f1, t1, s1) = (np.nanmedian(np.array(x, float), axis=0) for x in rows.values())
    return {
        "force_0_N": f0, "force_100_N": f1, "time_0_s": t0, "time_100_s": t1,
        "success_0": s0, "success_100": s1, "force_ratio": f1 / f0, "time_ratio": t1 / t0,
        "runs": seeds,
    }  # fmt: skip


PUBLICATIONS: dict[str, Callable[[], dict[str, Any]]] = {
    "mass": mass,
    "detection": detection,
    "architectures": architectures,
    "peg": peg,
}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PUBLICATIONS, default=list(PUBLICATIONS))
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    found = {}
    for name in options.only:
        found[name] = PUBLICATIONS[name]()
        for key, value in found[name].items():
            if key != "rows":
                print(f"{name}.{key:28} {value}", flush=True)
        if options.json:
            options.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
