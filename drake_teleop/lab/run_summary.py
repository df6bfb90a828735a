"""Summary and overview picture of a run; docs/running.md lists the summary's fields."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.numeric import Array, check_nonzero_load, contact_spans
from drake_teleop.common.vectors import (
    conjugate_quaternion,
    quaternion_logarithm,
    quaternion_product,
)
from drake_teleop.lab.identification import sensor_samples, slave_arm
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.run_warnings import run_warnings
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.signals import MOVING_BODY_POSE_PREFIX
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.posture_shapes import start_overlap_texts
from drake_teleop.station.task_measures import task_failure, task_measures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Settling time of the sensor's filter after a contact [s].
FILTER_TAIL_S = 0.01


@dataclass(frozen=True, eq=False)
class ScenarioRun:
    """Scenario and results of one run; `identification` is the identified load, or None."""

    scenario: Scenario
    result: SimulationResult
    identification: Identification | None
    load_source: str
    real_time_factor: float


def is_in_contact(result: SimulationResult) -> NDArray[np.bool_]:
    """Return whether each sample (N,) is in contact; gaps below `FILTER_TAIL_S` are closed."""
    if "true_contact_wrench_W" not in result:
        return np.zeros(len(result.t), dtype=bool)
    touch = np.any(result["true_contact_wrench_W"] != 0, axis=1)
    return _since_contact_s(touch, result.t) + _until_contact_s(touch, result.t) < FILTER_TAIL_S


def summarise(run: ScenarioRun) -> dict[str, Any]:
    """Return the content of summary.json without the scenario's name."""
    result, arm = run.result, slave_arm(run.scenario)
    estimate = result["load_estimate"][-1]
    check_nonzero_load("load_estimate", estimate[6:])
    wrench, s, omega, alpha = sensor_samples(result)
    measured = wrench - estimate[:6]
    calculated = contact_wrench(wrench, estimate[:6], s, omega, alpha, estimate[6:])
    contact = is_in_contact(result)
    # The first bounce of a contact may be between two samples.
    free = _since_contact_s(contact, result.t) > FILTER_TAIL_S
    free &= _until_contact_s(contact, result.t) > FILTER_TAIL_S
    mass, com = _mass_and_com(estimate[6:])
    true_mass, true_com = _mass_and_com(arm.phi_load)
    n = arm.num_joints
    summary: dict[str, Any] = {
        "description": run.scenario.description,
        "seed": run.scenario.simulation.seed,
        "duration_s": round(float(result.t[-1]), 6),
        "samples": len(result.t),
        **_named_peak_norms("peak_measured", "", measured),
        **_named_peak_norms("peak_contact", "", calculated),
        **_named_peak_norms("residual", "_max", calculated[free]),
        "true_contact_s": [list(span) for span in contact_spans(result.t, contact)],
        "joint_speed_use": _largest_limit_use(result["slave_state"][:, n:], arm.velocity_limit),
        "joint_torque_use": _largest_limit_use(result["joint_torque"], arm.effort_limit),
        "mass_error_percent": 100 * abs(mass / true_mass - 1),
        "com_error_mm": 1e3 * float(np.linalg.norm(com - true_com)),
    }
    if "force_to_master" in result:
        summary |= _named_peak_norms("peak", "_to_master", result["force_to_master"])
    if "contact" in result:
        summary |= _detection_delays(result, contact_spans(result.t, contact))
    if beyond := _describe_unmodelled_contact(run.scenario):
        summary["contact_by"] = f"Drake's contact results (slower): {beyond}"
    summary |= _moving_body_displacements(result)
    if run.scenario.operator.task is not None:
        figures = task_measures(result, run.scenario)
        summary |= {name: None if np.isnan(x) else x for name, x in figures.items()}
        summary["failure"] = task_failure(result, run.scenario) or None
    _, assumed = start_overlap_texts(run.scenario.slave, run.scenario.surroundings)
    if assumed:
        summary["assumed"] = list(assumed)
    return summary | {"warnings": run_warnings(result, run.scenario, arm)}


def draw_overview(result: SimulationResult) -> Figure:
    """Draw wrenches, motion and force to the master over time."""
    signals = ("measured_wrench_S", "contact_wrench_S", "pose_command", "force_to_master")
    if "contact_wrench_S" not in result:
        signals = ("measured_wrench_S", "specific_force_S", "angular_velocity_S", "load_estimate")
    figure = result.plot(*signals, contact=is_in_contact(result))
    figure.align_ylabels()
    return figure


def _detection_delays(result: SimulationResult, spans: list[tuple[float, float]]) -> dict[str, Any]:
    t, summary = result.t, {}
    starts = [start for start, _ in spans]
    for name, key in (("contact", "contact_noticed_ms"), ("contact_at_hand", "contact_at_hand_ms")):
        flagged, delays = t[result[name][:, 0] > 0], list[float | None]()
        for start, end in itertools.pairwise([*starts, np.inf]):
            times = flagged[(flagged >= start) & (flagged < end)]
            delays.append(1e3 * float(times[0] - start) if len(times) else None)
        summary[key] = delays
    onsets = t[1:][np.diff(result["contact"][:, 0]) > 0]
    false = [x for x in onsets if not any(a <= x <= b + FILTER_TAIL_S for a, b in spans)]
    return summary | {"false_contacts": len(false)}


def _describe_unmodelled_contact(scenario: Scenario) -> str:
    if scenario.surroundings is None:
        return ""
    plant = AddSlavePlant(DiagramBuilder(), scenario.slave, scenario.surroundings)
    return plant.contact.drake_contact_reason


def _moving_body_displacements(result: SimulationResult) -> dict[str, dict[str, float]]:
    displacements, rotations = {}, {}
    for signal in (name for name in result.signals if name.startswith(MOVING_BODY_POSE_PREFIX)):
        name, first, last = signal.removeprefix(MOVING_BODY_POSE_PREFIX), *result[signal][[0, -1]]
        displacements[name] = 1e3 * float(np.linalg.norm(last[4:] - first[4:]))
        rotation = quaternion_product(tuple(last[:4]), conjugate_quaternion(tuple(first[:4])))
        rotations[name] = float(np.degrees(np.linalg.norm(quaternion_logarithm(rotation))))
    return {"moved_mm": displacements, "turned_deg": rotations} if displacements else {}


def _named_peak_norms(prefix: str, suffix: str, wrench: Array) -> dict[str, float | None]:
    names = (f"{prefix}_force{suffix}_N", f"{prefix}_torque{suffix}_Nm")
    if not len(wrench):
        return dict.fromkeys(names)
    norms = (np.linalg.norm(part, axis=1).max() for part in (wrench[:, :3], wrench[:, 3:]))
    return {name: float(norm) for name, norm in zip(names, norms, strict=True)}


def _since_contact_s(contact: NDArray[np.bool_], t: Array) -> Array:
    last = np.maximum.accumulate(np.where(contact, np.arange(len(t)), -1))
    return np.where(last < 0, np.inf, t - t[last])


def _until_contact_s(contact: NDArray[np.bool_], t: Array) -> Array:
    return _since_contact_s(contact[::-1], -t[::-1])[::-1]


def _mass_and_com(phi: Array) -> tuple[float, Array]:
    return float(phi[0]), phi[1:4] / phi[0]


def _largest_limit_use(values: Array, limit: Array) -> float:
    return float(np.max(np.abs(values) / limit))
