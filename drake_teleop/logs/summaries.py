"""Figures in the summaries of the commands `identify` and `eliminate` (docs/log-summaries.md)."""

from __future__ import annotations

from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load import identification
from drake_teleop.load.batch.uncertainty import confidence_intervals
from drake_teleop.load.identification import PARAMETER_NAMES, Identification
from drake_teleop.load.inertia import mass_com_inertia
from drake_teleop.logs.causes.cause import RecordPartWithLoad
from drake_teleop.logs.contact import noise_floor, summarize_contacts
from drake_teleop.logs.processing import EliminatedLog, IdentifiedLog


def summarize_log(
    path: Path, found: IdentifiedLog | EliminatedLog, cutoff_hz: float | None, delay_s: float
) -> dict[str, Any]:
    log = found.log
    unfiltered = log.static or cutoff_hz is None or cutoff_hz >= 0.5 / log.dt
    findings = [{"name": finding.name, "message": finding.message} for finding in found.findings]
    return {
        "log": str(path),
        "samples": len(log),
        "duration_s": 0.0 if log.static else float(log.t[-1] - log.t[0]),
        "rate_hz": 0.0 if log.static else 1 / log.dt,
        "cutoff_hz": None if unfiltered else cutoff_hz,
        "delay_s": delay_s,
        "delay_source": found.delay_source,
        "notes": [*log.notes, *(f"{f['name']}: {f['message']}" for f in findings)],
        "findings": findings,
    }


def summarize_record_part(part: RecordPartWithLoad) -> dict[str, Any]:
    mass, com, _ = mass_com_inertia(part.phi)
    deviations = np.sqrt(np.diag(part.covariance))[6:]
    com_std = identification.com_standard_deviations(part.phi, part.covariance)
    load = {"mass": mass, "mass_std": deviations[0], "com": com, "com_std": com_std}
    load |= {"phi": part.phi, "phi_std": deviations}
    return {"start_s": part.start_s, "stop_s": part.stop_s, **load}


def summarize_load(load: Identification) -> dict[str, Any]:
    deviations = load.standard_deviations
    return {
        "mass": load.mass,
        "mass_std": deviations[6],
        "com": load.com,
        "com_std": identification.com_standard_deviations(load.phi, load.covariance),
        "inertia_com": load.inertia_com,
        "phi": load.phi,
        "phi_std": deviations[6:],
        "phi_interval": np.stack(confidence_intervals(load), axis=1)[6:],
        "verdicts": dict(zip(PARAMETER_NAMES, load.verdicts, strict=True)),
        "identifiable": list(compress(PARAMETER_NAMES, load.identifiable)),
        "not_identifiable": list(compress(PARAMETER_NAMES, ~load.identifiable)),
        "physically_consistent": load.physically_consistent,
    }


def summarize_grasped_object(object_load: Identification) -> dict[str, Any]:
    margin, deviation = identification.consistency_margin(object_load)
    figures = summarize_load(object_load)
    for name in ("identifiable", "not_identifiable"):
        figures[name] = [entry for entry in figures[name] if entry in PARAMETER_NAMES[6:]]
    return figures | {"consistency_margin": margin, "consistency_margin_std": deviation}


def notes_on_grasped_object(object_load: Identification) -> list[str]:
    deviation = float(object_load.standard_deviations[6])
    if object_load.mass < identification.MIN_SIGNIFICANT_STDS * deviation < np.inf:
        excess = f"{object_load.mass:.4g} ± {deviation:.2g} kg"
        return [f"no object: the total mass exceeds the gripper's by {excess}"]
    if not object_load.identifiable[6:].all() or object_load.physically_consistent:
        return []
    margin, deviation = identification.consistency_margin(object_load)
    if margin < -identification.MIN_SIGNIFICANT_STDS * deviation:
        return [
            "the object's parameters are physically impossible; check that gripper and total were"
            " identified in the same sensor frame, with the same gripper"
        ]
    return ["the object's parameters are physically consistent only within their uncertainty"]


def summarize_wrenches(eliminated: EliminatedLog) -> dict[str, Any]:
    """Return RMS and peak of |force|, |torque| and each channel; ends and gaps are excluded."""
    figures: dict[str, Any] = {}
    for name, suffix, wrench in (
        ("raw", "rms", eliminated.measured),
        ("gravity_only", "rms", eliminated.gravity_only),
        ("residual", "rms", eliminated.contact),
        ("residual", "peak", eliminated.contact),
    ):
        keys = (f"{name}_{suffix}", f"{name}_torque_{suffix}", f"{name}_{suffix}_per_channel")
        figures |= dict.fromkeys(keys)
        if wrench is None:
            continue
        x = wrench[~eliminated.edge]
        parts = np.linalg.norm(x[:, :3], axis=1), np.linalg.norm(x[:, 3:], axis=1), x
        peaks = (np.abs(part).max(axis=0) for part in parts)
        rms = (np.sqrt(np.mean(part**2, axis=0)) for part in parts)
        figures |= zip(keys, peaks if suffix == "peak" else rms, strict=True)
    return figures


def summarize_detected_contact(found: EliminatedLog, causal_tare_s: float | None) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "noise_floor": found.noise_floor,
        "edge_s": 0.0 if found.log.static else float(found.edge.sum()) * found.log.dt,
        **dict.fromkeys(("threshold", "contacts", "in_contact", "causal")),
    }
    if found.detection is not None:
        figures["threshold"] = found.detection.threshold
        figures["contacts"] = summarize_contacts(found.log.t, found.contact, found.touched)
        figures["in_contact"] = found.touched.mean()
    if found.causal is not None:
        late, contact = (found.causal.contact[~found.edge], found.contact[~found.edge])

        def rms_of_wrench(name: str, wrench: Array) -> dict[str, float]:
            force, torque = np.sqrt(np.mean(wrench**2, axis=0).reshape(2, 3).sum(axis=1))
            return {f"{name}_rms": float(force), f"{name}_torque_rms": float(torque)}

        figures["causal"] = {
            "mode": found.causal.mode,
            "lag_s": found.causal.lag_s,
            "tare_s": causal_tare_s,
            "offsets": found.causal.offsets,
            **rms_of_wrench("residual", late),
            "noise_floor": noise_floor(late),
            **rms_of_wrench("difference", late - contact),
        }
    return figures


def shares_of_samples_above_force(eliminated: EliminatedLog, threshold: float) -> dict[str, Any]:
    """Return shares of samples with |F| > `threshold` [N], for three stages of load removal."""
    wrenches = {
        "raw": eliminated.measured - eliminated.measured[0],
        "gravity_only": eliminated.gravity_only,
        "eliminated": eliminated.contact,
    }

    def share_above(wrench: Array) -> float:
        return float((np.linalg.norm(wrench[~eliminated.edge, :3], axis=1) > threshold).mean())

    return {name: None if w is None else share_above(w) for name, w in wrenches.items()}
