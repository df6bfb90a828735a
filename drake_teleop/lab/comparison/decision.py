"""Which method for which network, in a word: a cell of the decision table for each.

The first of these that is so, of the whole station before all leaves, and for energy of the hands
(`hands`) as well::

    unstable      it does not come to rest, or the run ended early
    left behind   the slave is more than 5 mm from the master 2 s after contact
    leaks         more than 1 mJ came out between hand and actual motion that had not gone in and
                  was not stored at the start
    holds         none of it
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drake_teleop.lab.comparison.one_dof import TIP

UNSTABLE, BEHIND, LEAKS, HOLDS = "unstable", "left behind", "leaks", "holds"
FAR, LEAST = 5e-3, 1e-3  #: m; J


@dataclass(frozen=True)
class Cell:
    """What became of one method over one network.

    Args:
        verdict: one of the four words.
        forces: for each leaf, on average while holding it: on the hand, and the scaled force of the
            contact [N]; none if unstable.
        unrest: for each leaf, in words, how the hold is not at rest; none if it is before all.
        leaked: the most that came out in any run [J]; None if unstable.
    """

    verdict: str
    forces: tuple[tuple[float, float], ...] = ()
    unrest: tuple[str, ...] = ()
    leaked: float | None = None

    @property
    def words(self) -> str:
        """The verdict, with how much it leaks."""
        if self.verdict != LEAKS or self.leaked is None:
            return self.verdict
        number, unit = (1e3 * self.leaked, "mJ") if self.leaked < 1.0 else (self.leaked, "J")
        return f"leaks {_two_digits(number)} {unit}"

    @property
    def share(self) -> str:
        """How much of the contact's force is felt, of the leaf with the least; "" if unstable."""
        shares = [felt / pressed for felt, pressed in self.forces if pressed > 0.0]
        return f"{min(shares):.0%}" if shares else ""


def decide(summary: Mapping[str, Any]) -> dict[tuple[str, str], Cell]:
    """(method, network) -> cell, of the `station` and `hands` of a summary."""
    return {
        (row["method"], row["network"]): _cell(
            [
                run
                for run in summary["station"]
                if (run["method"], run["network"]) == (row["method"], row["network"])
            ],
            row["leaked"],
        )
        for row in summary["hands"]
    }


def _cell(runs: Sequence[Mapping[str, Any]], leaked_by_hands: float) -> Cell:
    """Of the runs of the station before its leaves."""
    if not all(run["stable"] for run in runs):
        return Cell(UNSTABLE, unrest=tuple(map(_unrest, runs)))
    leaked = max(leaked_by_hands, *(run["leaked"] for run in runs))
    forces = tuple((run["felt_force"], run["pressed_force"]) for run in runs)
    if max(run["left_behind"] for run in runs) > FAR:
        return Cell(BEHIND, forces, leaked=leaked)
    return Cell(LEAKS if leaked > LEAST else HOLDS, forces, leaked=leaked)


def _unrest(run: Mapping[str, Any]) -> str:
    """How a run is not at rest in its hold: by what is larger at the tool's tip."""
    if run["stable"]:
        return "at rest"
    if run["hunting"] is None:
        return "ended early"
    if TIP * run["turning"] > run["hunting"]:
        return f"turns by {_two_digits(1e3 * run['turning'])} mrad"
    return f"moves by {_two_digits(1e3 * run['hunting'])} mm"


def _two_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"
