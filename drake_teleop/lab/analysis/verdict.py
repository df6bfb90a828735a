"""Verdict of `drake-teleop analyze`: the summary in short sentences."""

from __future__ import annotations

from typing import Any

import numpy as np


def verdict_sentences(figures: dict[str, Any]) -> list[str]:
    sentences = []
    if figures["method"] != "none":
        sentences += [
            f"The method {figures['method']} is not linear.",
            "The analysis is for the station without this method.",
        ]
    if "is not analysed" in figures["wall_is"]:
        sentences.append(f"The wall is {figures['wall_is']}.")
    sentences += [_stability_sentence(point, figures["grip"]) for point in figures["diagram"]]
    for row in figures["margins"]:
        if row["grip"] == figures["grip"] and row["wall_N_per_m"] == figures["wall_N_per_m"]:
            sentences += _margin_sentences(row, figures["delay_s"])
    worst = max(figures["two_port"]["sampled"].values())
    if worst > 0.1:
        sentences += [
            f"Along {figures['direction']} it is not one axis: contact rotates hand and tool.",
            f"Its two-port differs from one axis by up to {100 * worst:.2g} % below 30 Hz.",
            "Margins and maps assume one axis and are approximate here.",
        ]
    return sentences + _wall_sentences(figures) + _transparency_sentences(figures)


def _stability_sentence(point: dict[str, Any], grip: str) -> str:
    decay, hertz = point["decay_1_per_s"], point["frequency_Hz"]
    if decay is None:
        stable = "stable" if point["stable"] else "unstable"
        return f"In the state '{point['point']}' one axis of the station is {stable}."
    state = f"In the state '{point['point']}', {grip} grip, it is"
    motion = f"at {hertz:.3g} Hz" if hertz > 0.01 else "without oscillation"
    if point["stable"]:
        return f"{state} stable: motion halves every {1e3 * np.log(2) / decay:.3g} ms, {motion}."
    return f"{state} unstable: it doubles every {-1e3 * np.log(2) / decay:.3g} ms, {motion}."


def _margin_sentences(row: dict[str, Any], delay: float) -> list[str]:
    wall = f"a wall of {_stiffness_text(row['wall_N_per_m'])}"
    if not row["stable"]:
        return [f"At {wall} it is unstable with this grip."]
    reserve = None if row["round_trip_s"] is None else row["round_trip_s"] - 2 * delay
    longest = "any round trip" if reserve is None else f"{1e3 * reserve:.3g} ms more round trip"
    more = "any gain" if row["gain"] is None else f"{row['gain']:.3g} times its gain"
    return [f"At {wall} it stays stable with {longest}, or with {more}."]


def _wall_sentences(figures: dict[str, Any]) -> list[str]:
    bounded, absolute = figures["bounded"], figures["absolute"]
    each = ", ".join(f"{grip} {_stiffness_text(K)}" for grip, K in bounded["each"].items())
    every = _stiffness_text(bounded["grips"])
    sentences = [
        f"The stiffest stable wall depends on the grip: {each}.",
        f"For all hands between the lightest and the firmest grip it is {every}.",
        "These limits exclude Coulomb friction, which dissipates energy.",
    ]
    if absolute["absolutely_stable"]:
        return [
            *sentences,
            "It is absolutely stable: no passive hand and environment make it oscillate.",
        ]
    lacking = absolute["lacking_damping_Ns_per_m"]
    remedy = "No damping" if lacking is None else f"{lacking:.3g} N s/m more damping"
    return [
        *sentences,
        "It is not absolutely stable: with some passive hand and environment it would oscillate.",
        f"{remedy} of the device would prevent that.",
        "Position-force stations with a servo are rarely absolutely stable.",
        "For realistic hands and walls, the limits above apply.",
    ]


def _transparency_sentences(figures: dict[str, Any]) -> list[str]:
    free, wall = figures["transparency"]["free"], figures["transparency"]["wall"]
    felt, ideal = wall["felt"]["stiffness"], wall["ideal"]["stiffness"]
    sigma = f"σ = {figures['axis']['sigma']:g}"
    return [
        f"In free motion the displayed mass is {1e3 * free['felt']['mass']:.3g} g.",
        f"The ideal for device and {sigma} is {1e3 * free['ideal']['mass']:.3g} g.",
        f"At the wall the displayed stiffness is {felt:.3g} N/m; the ideal is {ideal:.3g} N/m.",
        f"A human cannot distinguish it from the ideal up to {wall['unnoticed_to_Hz']:.2g} Hz.",
        f"The slave follows up to {figures['transparency']['tracking_bandwidth_Hz']:.3g} Hz.",
    ]


def _stiffness_text(value: float | None) -> str:
    if value == 0:
        return "none"
    return "any stiffness" if value is None else f"{value / 1e3:.3g} kN/m"
