"""What the figures of `drake-teleop analyze` say, in words."""

from __future__ import annotations

from typing import Any

import numpy as np


def verdict(figures: dict[str, Any]) -> list[str]:
    """The figures in words."""
    said = []
    if figures["method"] != "none":
        said.append(
            f"The method {figures['method']} is not linear: what follows is the station without it."
        )
    for point in figures["diagram"]:
        pace, hertz = point["decay_1_per_s"], point["frequency_Hz"]
        if pace is None:
            stable = "stable" if point["stable"] else "unstable"
            said.append(f"In the state '{point['point']}' one axis of the station is {stable}.")
            continue
        motion = f"at {hertz:.3g} Hz" if hertz > 0.01 else "without oscillation"
        said.append(
            f"In the state '{point['point']}', with the {figures['grip']} grip, the Diagram is "
            + (
                f"stable: what dies last halves every {1e3 * np.log(2) / pace:.3g} ms, {motion}."
                if point["stable"]
                else f"unstable: it doubles every {-1e3 * np.log(2) / pace:.3g} ms, {motion}."
            )
        )
    said += [
        _bears(row, figures["delay_s"])
        for row in figures["margins"]
        if row["grip"] == figures["grip"] and row["wall_N_per_m"] == figures["wall_N_per_m"]
    ]
    worst = max(figures["two_port"]["sampled"].values())
    if worst > 0.1:
        said.append(
            f"Along {figures['direction']} the station is not one axis: its two-port differs by up "
            f"to {100 * worst:.2g} % below 30 Hz, because a push turns hand and tool. Margins and "
            "maps, which are those of one axis, are rough there."
        )
    bounded = figures["bounded"]
    each = ", ".join(f"{grip} {_stiffness(K)}" for grip, K in bounded["each"].items())
    said.append(
        f"Walls are stable up to a stiffness that depends on the hand: {each}; for every hand "
        f"between the lightest and the firmest grip {_stiffness(bounded['grips'])}."
    )
    absolute = figures["absolute"]
    if absolute["absolutely_stable"]:
        said.append("It is absolutely stable: no passive hand and environment make it oscillate.")
    else:
        lacking = absolute["lacking_damping_Ns_per_m"]
        remedy = "no amount of" if lacking is None else f"{lacking:.3g} N s/m more"
        said.append(
            "It is not absolutely stable, as position-force stations behind a servo hardly ever "
            f"are: some passive hand and environment would oscillate; {remedy} damping of the "
            "device would prevent it. For hands and walls that there are, the limits above count."
        )
    free, wall = figures["transparency"]["free"], figures["transparency"]["wall"]
    felt, ideal = wall["felt"]["stiffness"], wall["ideal"]["stiffness"]
    said.append(
        f"In free motion the hand feels {1e3 * free['felt']['mass']:.3g} g, where device and "
        f"σ = {figures['axis']['sigma']:g} make {1e3 * free['ideal']['mass']:.3g} g; of the wall "
        f"it feels {felt:.3g} N/m of {ideal:.3g} N/m. A human could not tell the wall from the "
        f"ideal one up to {wall['unnoticed_to_Hz']:.2g} Hz; the slave follows up to "
        f"{figures['transparency']['tracking_bandwidth_Hz']:.3g} Hz."
    )
    return said


def _bears(row: dict[str, Any], delay: float) -> str:
    wall = f"a wall of {_stiffness(row['wall_N_per_m'])}"
    if not row["stable"]:
        return f"Before {wall} it is unstable with that grip."
    spare = None if row["round_trip_s"] is None else row["round_trip_s"] - 2 * delay
    longest = "any delay" if spare is None else f"{1e3 * spare:.3g} ms more round trip"
    more = "any gain" if row["gain"] is None else f"{row['gain']:.3g} times its gain"
    return f"Before {wall} it bears {longest}, and {more}."


def _stiffness(value: float | None) -> str:
    if value == 0:
        return "none"
    return "any stiffness" if value is None else f"{value / 1e3:.3g} kN/m"
