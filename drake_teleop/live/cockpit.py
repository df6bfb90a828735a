"""Forces, energy, contact and warnings that the browser page displays."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from drake_teleop.common.blocks import FAULT_WARNINGS, Fault
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.lab.identification import slave_arm
from drake_teleop.live.inputs import INPUT_RANGES, Inputs
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.inverse_kinematics import IkStatus

#: Contact force at the slave that the page shows as contact [N]; noise and motion remain below.
MIN_CONTACT_FORCE_N = 2.0
_WARNING_SHARE_OF_LIMIT = 0.999
_HAND_FORCE_FOR_WARNING_N = 59.0  # N; the limit of a hand is 60 N
_PACKET_SILENCE_FOR_WARNING_S = 0.05  # s


@njit(cache=True)
def min_and_max_norm_into(vectors, origins, out):
    """Write smallest and largest norm of vectors[k, :3] - origins[k, :3] to `out` (2,)."""
    least, most = math.inf, 0.0
    for row in range(len(vectors)):
        square = 0.0
        for k in range(3):
            square += (vectors[row, k] - origins[row, k]) ** 2
        least, most = min(least, square), max(most, square)
    out[0], out[1] = math.sqrt(least), math.sqrt(most)


@njit(cache=True)
def _add_hand_and_contact_work(arm_table, t, states, contact_S, hand_E, twist_E, last_row, energy):
    # `energy` [J]: of hand on stylus, of tool on contacts. `last_row`: its t, p_WS, R_WS.
    R_WS, p_WS = np.empty((3, 3)), np.empty(3)
    for row in range(len(t)):
        forward_kinematics(arm_table, states[row, : arm_table.shape[0] - 1], R_WS, p_WS)
        if not math.isnan(last_row[0]):
            power = 0.0
            for i in range(6):
                power += hand_E[row, i] * twist_E[row, i]
            energy[0] += (t[row] - last_row[0]) * power
            for i in range(3):
                a, b, turn = (i + 1) % 3, (i + 2) % 3, 0.0
                for k in range(3):  # half the sum of the axes' cross products from row to row
                    turn += 0.5 * last_row[4 + 3 * a + k] * R_WS[b, k]
                    turn -= 0.5 * last_row[4 + 3 * b + k] * R_WS[a, k]
                for k in range(3):
                    work = contact_S[row, k] * (p_WS[i] - last_row[1 + i])
                    energy[1] += R_WS[i, k] * (work + contact_S[row, 3 + k] * turn)
        last_row[0] = t[row]
        last_row[1:4], last_row[4:] = p_WS, R_WS.ravel()


class PageValueCalculator:
    """Calculator of the values that the page displays, from new rows of the log."""

    def __init__(self, scenario: Scenario) -> None:
        arm = slave_arm(scenario)
        self._table, n = arm.table, arm.num_joints
        self._limits = (
            ("speed", "slave_state", slice(n, None), _WARNING_SHARE_OF_LIMIT * arm.velocity_limit),
            ("torque", "joint_torque", slice(None), _WARNING_SHARE_OF_LIMIT * arm.effort_limit),
        )
        self._peak_force = scenario.master.device(0.0, 0.0).parameters.peak_force
        self._energy = np.zeros(2)
        self._last_row = np.full(13, np.nan)
        self._forces = np.zeros((3, 2))

    def page_values(self, rows: dict[str, Array], inputs: Inputs) -> dict[str, Any]:
        """Return the page's values for new rows (at least one); non-finite numbers become 0."""
        zeros = np.zeros((len(rows["t"]), 6))
        contact_S = rows.get("contact_wrench_S", zeros)
        measured, contact, rendered = self._forces
        min_and_max_norm_into(rows["measured_wrench_S"], rows["load_estimate"], measured)
        min_and_max_norm_into(contact_S, zeros, contact)
        min_and_max_norm_into(rows["force_to_master"], zeros, rendered)
        touches = rows["contact"].any() if "contact" in rows else contact[1] > MIN_CONTACT_FORCE_N
        self._forces[:2] *= inputs.force_scales["force_scale"]
        t, states, hand, twist = (
            rows[name] for name in ("t", "slave_state", "hand_wrench_E", "twist_master")
        )
        _add_hand_and_contact_work(
            self._table, t, states, contact_S, hand, twist, self._last_row, self._energy
        )
        return {
            "f": [_round_or_zero_if_not_finite(pair, 4) for pair in self._forces],
            "contact": bool(touches),
            "energy": _round_or_zero_if_not_finite(self._energy, 5),
            "words": list(dict.fromkeys(self._warning_texts(rows, inputs))),
            "t": round(float(self._last_row[0]), 3),
            "tool": _round_or_zero_if_not_finite(self._last_row[1:4], 5),
            "stylus": _round_or_zero_if_not_finite(rows["pose_master"][-1, 4:], 5),
        }

    def _warning_texts(self, rows: dict[str, Array], inputs: Inputs) -> Iterator[str]:
        for name in ("fault", "fault_at_hand"):
            if name in rows and rows[name].any():
                faults = set(rows[name][:, 0]) - {0.0}
                yield from (FAULT_WARNINGS[Fault(int(fault))] for fault in sorted(faults))
        if rows["ik_status"].max() >= IkStatus.OUT_OF_REACH:
            yield "the arm cannot reach the position of the hand"
        if rows["saturated"].max() > 0:
            yield "the wrist sensor is saturated"
        if self._forces[2, 1] >= _WARNING_SHARE_OF_LIMIT * self._peak_force:
            yield f"the device renders its largest force, {self._peak_force:g} N"
        wrench, hand = rows["hand_wrench_E"], np.empty(2)
        min_and_max_norm_into(wrench, np.zeros_like(wrench), hand)
        if hand[1] > _HAND_FORCE_FOR_WARNING_N:
            yield "the simulated hand pulls with its largest force"
        for quantity, name, part, limits in self._limits:
            at_limit = (np.abs(rows[name][:, part]) >= limits).any(axis=0)
            if at_limit.any():
                joints = [str(k + 1) for k in np.flatnonzero(at_limit)]
                yield f"joint {', '.join(joints)} at the limit of its {quantity}"
        if "ports" in rows and rows["ports"][:, 4:6].max() > _PACKET_SILENCE_FOR_WARNING_S:
            yield "the network delivers no packets"
        if any(abs(getattr(inputs, name)) == INPUT_RANGES[name][1] for name in ("x", "y", "z")):
            yield "the hand is at the edge of its box, 0.3 m wide"


def _round_or_zero_if_not_finite(values: Array, digits: int) -> list[float]:
    return [round(x, digits) if math.isfinite(x) else 0.0 for x in values.tolist()]
