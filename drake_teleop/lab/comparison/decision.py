"""Decision table: for each method and network, the first applicable verdict of docs/delay.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drake_teleop.lab.comparison.one_dof import WRIST_TO_TIP_DISTANCE_M
from drake_teleop.station.oscillation import MAX_FORCE_RIPPLE_RMS_AT_REST_N

VERDICT_UNSTABLE, VERDICT_POSITION_ERROR = "unstable", "position error"
VERDICT_CHATTERS, VERDICT_LEAKS, VERDICT_HOLDS = "chatters", "leaks", "holds"
MAX_POSITION_ERROR_M, MIN_LEAKED_ENERGY_J = 5e-3, 1e-3  #: m; J


@dataclass(frozen=True)
class MethodResult:
    """Result of one method over one network."""

    verdict: str
    #: For each leaf, means in the hold of the force on the hand and the scaled contact force [N].
    force_pairs: tuple[tuple[float, float], ...] = ()
    motion_texts: tuple[str, ...] = ()  #: for each leaf, motion in the hold as text; stable: empty
    leaked_J: float | None = None  #: largest leaked energy of all runs [J]; None: unstable

    @property
    def verdict_text(self) -> str:
        if self.verdict != VERDICT_LEAKS or self.leaked_J is None:
            return self.verdict
        number, unit = (1e3 * self.leaked_J, "mJ") if self.leaked_J < 1.0 else (self.leaked_J, "J")
        return f"leaks {_format_two_significant_digits(number)} {unit}"

    @property
    def least_displayed_share_text(self) -> str:
        """Least displayed over scaled contact force of all sheet springs [%]; "" if unstable."""
        shares = [felt / pressed for felt, pressed in self.force_pairs if pressed > 0.0]
        return f"{min(shares):.0%}" if shares else ""


def decision_table(summary: Mapping[str, Any]) -> dict[tuple[str, str], MethodResult]:
    """Return the result of each (method, network) in a summary."""
    table = {}
    for row in summary["hands"]:
        key = row["method"], row["network"]
        runs = [run for run in summary["station"] if (run["method"], run["network"]) == key]
        table[key] = _summarise_runs_of_method(runs, row["leaked"])
    return table


def _summarise_runs_of_method(
    runs: Sequence[Mapping[str, Any]], leaked_J_in_release_and_taps: float
) -> MethodResult:
    if not all(run["stable"] for run in runs):
        motions = tuple(map(_describe_motion_in_hold, runs))
        return MethodResult(VERDICT_UNSTABLE, motion_texts=motions)
    leaked = max(leaked_J_in_release_and_taps, *(run["leaked"] for run in runs))
    forces = tuple((run["felt_force"], run["pressed_force"]) for run in runs)
    if max(run["left_behind"] for run in runs) > MAX_POSITION_ERROR_M:
        return MethodResult(VERDICT_POSITION_ERROR, forces, leaked_J=leaked)
    if max(run["fast_force"] for run in runs) > MAX_FORCE_RIPPLE_RMS_AT_REST_N:
        return MethodResult(VERDICT_CHATTERS, forces, leaked_J=leaked)
    verdict = VERDICT_LEAKS if leaked > MIN_LEAKED_ENERGY_J else VERDICT_HOLDS
    return MethodResult(verdict, forces, leaked_J=leaked)


def _describe_motion_in_hold(run: Mapping[str, Any]) -> str:
    if run["stable"]:
        return "at rest"
    if run["hunting"] is None:
        return "ended early"
    if WRIST_TO_TIP_DISTANCE_M * run["turning"] > run["hunting"]:
        return f"turns by {_format_two_significant_digits(1e3 * run['turning'])} mrad"
    return f"moves by {_format_two_significant_digits(1e3 * run['hunting'])} mm"


def _format_two_significant_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"
