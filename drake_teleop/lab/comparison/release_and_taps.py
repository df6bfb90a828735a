"""Simulated hands: one lets go while it presses, the other taps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.lab.comparison import one_dof
from drake_teleop.lab.comparison.one_dof import PERIOD, OneDof, OneDofRun, Task
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import PRESETS
from drake_teleop.station.passivity.methods import PassivityConfig

TAP_RATES_HZ = (1.0, 1.5)  #: Hz
_NUM_TAPS, _TAP_AMPLITUDE_ABOUT_WALL_M = 8, 0.03  # number; m, amplitude about the wall's surface


@dataclass(frozen=True)
class ReleaseAndTaps:
    """Measures after the hand lets go (release) and while it taps, all >= 0."""

    release_force: float  #: mean force on the hand in the last 0.1 s before release [N]
    release_speed: float  #: largest speed of the device in the 2 s after release [m/s]
    release_way: float  #: largest displacement of the device in these 2 s [m]
    tap_shares: tuple[float, ...]  #: displayed impulse over the wall's, for each of `TAP_RATES_HZ`
    leaked: float  #: largest energy out between hand and actual motion, beyond the stores' [J]


def simulate_release_and_taps(method: str, network: str, seed: int = 0) -> ReleaseAndTaps:
    round_trip, model = 2 * PRESETS[network].delay, OneDof()

    def simulate_hand(intent: Array, grip: Array | None = None) -> OneDofRun:
        return one_dof.run_one_dof(
            model,
            PassivityConfig(method=method),
            PRESETS[network],
            seed=seed,
            timeout=Channel(network=network).timeout_s(PERIOD),
            intent=intent,
            grip=grip,
        )

    release_time = 3.0 + 3 * round_trip
    end = release_time + 2.0
    task = Task(0.1, 0.6, 0.7, 1.5, release_time + 10.0, release_time + 11.0, end, rest_window=0.1)
    pressing = one_dof.operator_intent(task)
    release_row = round(release_time / PERIOD)
    grip = np.tile([model.hand_mass, model.hand_damping, model.hand_stiffness], (len(pressing), 1))
    grip[release_row:] = 0.0
    released = simulate_hand(pressing, grip)
    after = released.master_position[release_row:]
    tapping = [simulate_hand(_intended_tap_motion(rate, round_trip)) for rate in TAP_RATES_HZ]
    scale = model.force_scale * model.gamma
    return ReleaseAndTaps(
        release_force=float(np.abs(released.hand_force[release_row - 100 : release_row]).mean()),
        release_speed=float(np.abs(np.diff(after)).max() / PERIOD),
        release_way=float(np.abs(after - after[0]).max()),
        tap_shares=tuple(
            _tap_impulse_share(found, scale, rate, 0.5 * round_trip)
            for found, rate in zip(tapping, TAP_RATES_HZ, strict=True)
        ),
        leaked=max(0.0, *(-run.least_energy_sum(one_dof.ACTUAL) for run in (released, *tapping))),
    )


def _intended_tap_motion(rate: float, round_trip: float) -> Array:
    t = np.arange(round((1.0 + _NUM_TAPS / rate + round_trip + 1.0) / PERIOD)) * PERIOD - 0.5
    moving = (t > 0.0) & (t < _NUM_TAPS / rate)
    x = np.where(moving, -_TAP_AMPLITUDE_ABOUT_WALL_M * np.sin(2 * np.pi * rate * t), 0.0)
    return np.stack([x, np.gradient(x, PERIOD)], axis=1)


def _tap_impulse_share(run: OneDofRun, scale: float, rate: float, one_way_delay_s: float) -> float:
    first = int(np.argmax(run.wall_force < 0.0))
    second = first + round(0.75 / rate / PERIOD)  # between first and second contact
    pressed = scale * run.wall_force[second:].sum()
    felt = run.hand_force[second + round(one_way_delay_s / PERIOD) :].sum()
    return float(max(felt / pressed, 0.0)) if pressed < 0.0 else 0.0
