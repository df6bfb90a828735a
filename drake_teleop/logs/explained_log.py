"""Search for causes of a misfit in a log, and the load that results with these causes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load.identification import Identification, worth_stating
from drake_teleop.logs.cause_lines import with_lines
from drake_teleop.logs.causes.cause import Cause
from drake_teleop.logs.causes.explain import Explanation, explain
from drake_teleop.logs.causes.instants import Instants, instants
from drake_teleop.logs.check.corrections import Finding
from drake_teleop.logs.pose_motion.estimate import PoseEstimate
from drake_teleop.logs.pose_motion.splines import PoseSplines, passed
from drake_teleop.logs.read.alignment import undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.gravity import log_instants
from drake_teleop.logs.read.rotations import rotation_matrices

_MARGIN_KNOTS = 2.0  # knots, at either end
_MIN_ROWS = 100
_MAX_DEVIATION_RATIO = 1.5  # ratio of block to stated deviations that widens the intervals
_BANDWIDTH_HZ = 25.0  # Hz, bandwidth of block means


def explain_log(log: Log, delay_s: float, found: PoseEstimate | None = None) -> Explanation | None:
    """Search for causes why a rigid load does not explain the wrench; None for a short log.

    `delay_s` is the delay of the motion behind the wrench [s], `found` the motion by splines.
    """

    def with_delay(more: float) -> Instants:
        late = delay_s + more
        if found is not None:
            return _spline_instants(log, found, late)
        return log_instants(undelayed(log, late))

    data = with_delay(0.0)
    if data.used.sum() < _MIN_ROWS:
        return None
    why = explain(data, with_delay, log.free)
    if log.described is None:
        return why
    causes = with_lines(why.causes, log, by_pose=found is not None)
    return replace(why, causes=causes)


def _spline_instants(log: Log, found: PoseEstimate, late: float) -> Instants:
    assert log.posed is not None
    splines, gravity = found.splines, log.posed.gravity_W
    middle = np.mean(log.posed.poses.position, axis=0)

    def motion(t: Array) -> tuple[Array, ...]:
        q = splines.quaternion(t + late)
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        p = splines.position(t + late) - middle
        return *splines.motion(t + late, gravity), rotation_matrices(q, "quaternion_wxyz"), p

    stamps, margin = splines.poses.t, _MARGIN_KNOTS * splines.spacing
    at = log.t + late
    lost = (at < stamps[0] + margin) | (at > stamps[-1] - margin)
    lost |= (log.t < log.t[0] + margin) | (log.t > log.t[-1] - margin)
    if log.bridged is not None:
        lost |= log.bridged
    return instants(log.t, log.wrench, motion, gravity, lost, _acceleration_noise(splines))


def _acceleration_noise(splines: PoseSplines) -> float:
    f = np.linspace(0.0, _BANDWIDTH_HZ, 500)
    share = passed(f, splines.spacing)
    if splines.imu_rows is not None:
        share = share * splines.imu_rows.share(f)[0]
    power = 2.0 * splines.noise()[0] ** 2 / splines.rate * share * (2.0 * np.pi * f) ** 4
    return float(np.sqrt(np.trapezoid(power, f)))


def explained_load(load: Identification, why: Explanation) -> Identification:
    """Return the load of the model with causes; without any, `load` with wider intervals."""
    load = _explained_load(load, why)
    if why.state.data.gravity_W is not None:
        return load
    extra = np.zeros(16)
    extra[10:] = why.state.data.alpha_noise_share * np.abs(load.phi[[4, 7, 9]]).max()
    covariance = load.covariance + np.diag(extra**2)
    known = load.identifiable & worth_stating(np.sqrt(np.diag(covariance)), load.phi)
    return replace(load, covariance=covariance, identifiable=known)


def _explained_load(load: Identification, why: Explanation) -> Identification:
    if not why.causes and not why.given:
        if why.explained or not load.identifiable.any():
            return load
        stated = np.sqrt(np.diag(load.covariance))
        ratio = np.maximum(1.0, why.deviations / np.maximum(stated, 1e-300))
        ratio = np.where(load.identifiable, ratio, 1.0)
        if np.sqrt(np.mean(ratio[load.identifiable] ** 2)) < _MAX_DEVIATION_RATIO:
            return load
        wide = load.covariance * np.where(np.eye(16) > 0, ratio**2, np.outer(ratio, ratio))
        known = load.identifiable & worth_stating(np.sqrt(np.diag(wide)), load.phi)
        return replace(load, covariance=wide, identifiable=known)
    deviations = np.sqrt(np.diag(why.covariance))
    identifiable = worth_stating(deviations, why.theta[6:])
    if why.causes and why.causes[0].name == "no load":
        identifiable = np.repeat([True, False], [6, 10])
    if why.several_gains:
        identifiable = np.zeros(16, bool)
    return replace(
        load,
        phi=why.theta[6:],
        offsets=why.theta[:6],
        covariance=why.covariance,
        identifiable=identifiable,
        residual_rms=why.state.rows.rms(why.state.fit.residual),
        weight_removed=any(cause.name == "weight removed" for cause in why.causes)
        or "weight" in why.given,
        prior_dominated=np.zeros(16, bool),
        degrees_of_freedom=np.full(16, np.inf),
        method="generalised least squares with named causes",
    )


def named_frame(why: Explanation, finding: Finding) -> tuple[Cause, ...]:
    """Return the causes, with `finding` instead of "pose frame" and "sensor rotation".

    Only if these are the only extensions of the model.
    """
    if why.state.model.parts and set(why.state.model.parts) <= {"frame", "rotation"}:
        kept = [x for x in why.causes if x.name not in ("pose frame", "sensor rotation")]
        return (Cause(finding.name, finding.message), *kept)
    return why.causes


def removed_note(why: Explanation) -> str:
    """Return a note about the weight that the robot removes (`wrench.weight: removed`), or ""."""
    if "weight" not in why.given or why.removed_weight is None:
        return ""
    mass, moment = float(why.removed_weight[0]), why.removed_weight[1:]
    deviation = float(np.sqrt(why.state.extension("weight")[1][0, 0]))
    com = ", ".join(f"{1e3 * x / mass:.3g}" for x in moment) if mass else "0, 0, 0"
    return (
        f"the weight that is removed from the wrench is that of {mass:.4g} kg"
        f" (+- {1.96 * deviation:.2g}) at [{com}] mm in S"
    )
