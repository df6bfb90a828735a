"""What the page shows of a station that runs: forces, energy, contact, and what is not right."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop._compiled import njit
from drake_teleop.fault import MEANINGS, Fault
from drake_teleop.identification import slave_arm
from drake_teleop.live.inputs import RANGES, Inputs
from drake_teleop.scenario import Scenario
from drake_teleop.slave.arm import forward_kinematics
from drake_teleop.slave.inverse_kinematics import IkStatus

Array = NDArray[np.float64]

#: A calculated contact force at the slave that is a contact [N]; above what noise and motion leave.
CONTACT = 2.0
_AT_LIMIT = 0.999
_HAND_PULLS = 59.0  # N of the 60 that a hand can
_SILENT = 0.05  # s


@njit(cache=True)
def _go_on(table, t, states, contact_S, hand_E, twist, before, energy):
    """Adds the work of some rows to `energy` (2,), as of `Cockpit.frame` [J].

    `before` (4,) is the time and p_WS of the row before them, nan if there is none; then of the
    last of them.
    """
    R_WS, p_WS = np.empty((3, 3)), np.empty(3)
    for row in range(len(t)):
        forward_kinematics(table, states[row, : table.shape[0] - 1], R_WS, p_WS)
        if not math.isnan(before[0]):
            power = 0.0
            for i in range(6):
                power += hand_E[row, i] * twist[row, i]
            energy[0] += (t[row] - before[0]) * power
            for i in range(3):
                for k in range(3):
                    energy[1] += R_WS[i, k] * contact_S[row, k] * (p_WS[i] - before[1 + i])
        before[0] = t[row]
        before[1:] = p_WS


class Cockpit:
    """Makes frames for the page out of the rows of the log.

    Args:
        scenario: of the station.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._arm = slave_arm(scenario)
        self._peak = scenario.master.device(0.0, 0.0).peak_force
        self._joints = self._arm.num_joints
        self._energy = np.zeros(2)
        self._before = np.full(4, np.nan)  # t, p_WS of the last row
        self._forces = np.zeros((3, 2))

    def frame(self, rows: dict[str, Array], inputs: Inputs) -> dict[str, Any]:
        """Numbers of the newest rows, for JSON: every one of them is finite.

        Args:
            rows: as `Session.news` gives them.
            inputs: that hold.

        Returns:
            "t" [s]; "f": least and largest measured, contact and felt force, all at the hand [N];
            "contact"; "energy": of the hand into the device, of the tool into what it touches [J];
            "tool" and "stylus" [m]; "words": what is clipped or in a safe state.
        """
        scale = inputs.scales["force_scale"]
        offset = rows["load_estimate"][:, :3]
        measured = np.linalg.norm(rows["measured_wrench_S"][:, :3] - offset, axis=1)
        contact_S = rows.get("contact_wrench_S", np.zeros((len(measured), 6)))
        contact = np.linalg.norm(contact_S[:, :3], axis=1)
        felt = np.linalg.norm(rows["force_to_master"][:, :3], axis=1)
        if len(measured):
            curves = np.stack([scale * measured, scale * contact, felt])
            self._forces = np.stack([curves.min(axis=1), curves.max(axis=1)], axis=1)
            _go_on(
                self._arm.table,
                rows["t"],
                rows["slave_state"],
                contact_S,
                rows["hand_wrench_E"],
                rows["twist_master"],
                self._before,
                self._energy,
            )
        noticed = (
            rows["contact"][:, 0].any() if "contact" in rows else contact.max(initial=0.0) > CONTACT
        )
        frame = {
            "f": _numbers(self._forces, 4),
            "contact": bool(noticed),
            "energy": _numbers(self._energy, 5),
            "words": list(self._words(rows, inputs)) if len(measured) else [],
        }
        if not math.isnan(self._before[0]):
            frame |= {
                "t": round(float(self._before[0]), 3),
                "tool": _numbers(self._before[1:], 5),
            }
        if len(measured):
            frame["stylus"] = _numbers(rows["pose_master"][-1, 4:], 5)
        return frame

    def _words(self, rows: dict[str, Array], inputs: Inputs) -> list[str]:
        words = []
        for name in ("fault", "fault_at_hand"):
            faults = set(rows[name][:, 0]) - {0.0} if name in rows else set()
            words += [MEANINGS[Fault(int(fault))] for fault in sorted(faults)]
        if (rows["ik_status"] >= IkStatus.OUT_OF_REACH).any():
            words.append("the arm cannot get where the hand wants it")
        if (rows["saturated"] > 0).any():
            words.append("the wrist sensor is saturated")
        if self._forces[2, 1] >= _AT_LIMIT * self._peak:
            words.append(f"the device gives all that it can, {self._peak:g} N")
        if np.linalg.norm(rows["hand_wrench_E"][:, :3], axis=1).max() > _HAND_PULLS:
            words.append("the hand pulls as hard as it can")
        n = self._joints
        for what, used, limit in (
            ("speed", rows["slave_state"][:, n:], self._arm.velocity_limit),
            ("torque", rows["joint_torque"], self._arm.effort_limit),
        ):
            full = np.flatnonzero((np.abs(used) >= _AT_LIMIT * limit).any(axis=0)) + 1
            if len(full):
                words.append(f"joint {', '.join(map(str, full))} at the limit of its {what}")
        if "ports" in rows and (rows["ports"][:, 4:6] > _SILENT).any():
            words.append("the network is silent")
        edge = [name for name in ("x", "y", "z") if abs(getattr(inputs, name)) == RANGES[name][1]]
        if edge:
            words.append("the hand is as far out as it may go")
        return list(dict.fromkeys(words))


def _numbers(values: Array, digits: int) -> Any:
    """Rounded, for JSON; what is not finite is 0 (and a fault, which has its words)."""
    return np.round(np.nan_to_num(values, posinf=0.0, neginf=0.0), digits).tolist()
