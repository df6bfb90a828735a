"""Frequency responses of the nonlinear station, measured with a multi-sine motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis.one_axis import Complex
from drake_teleop.lab.analysis.task_direction import TaskDirection
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig, Sine
from drake_teleop.station.scenario import Scenario, check_scenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import jacobian
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.station import MakeTeleopStation

_NUM_PHASE_SETS = 300  # number of random phase sets; the one with the lowest peak is used


@dataclass(frozen=True)
class MultiSine:
    """Intended motion of the operator: a sum of sines with random phases and a low peak."""

    lowest: float = 0.5  #: Hz
    highest: float = 31.0  #: Hz
    lines: int = 16  #: largest number of frequencies
    velocity: float = 0.04  #: amplitude at each frequency [m/s] or [rad/s]
    period: float = 2.0  #: s; all frequencies are odd multiples of its inverse
    periods: int = 3  #: number of recorded periods
    settle: float = 1.5  #: s, for fading in and transients
    seed: int = 0  #: seed of the random phases

    def odd_multiples_of_base_rate(self) -> NDArray[np.int64]:
        """Return odd integers (n,); the motion's frequencies are these multiples of 1 / period."""
        spaced = np.geomspace(self.lowest * self.period, self.highest * self.period, self.lines)
        odd: NDArray[np.int64] = np.unique(2 * np.floor((spaced - 1) / 2 + 1e-9).astype(int) + 1)
        return odd[odd > 0]

    def sines_along(self, direction: Array, start: float) -> list[Sine]:
        """Return one `Sine` per frequency along `direction` (6,) in the master's base B.

        `direction`: translation, rotation. The sines begin at `start` [s].
        """
        frequencies = self.odd_multiples_of_base_rate() / self.period
        amplitudes = self.velocity / (2 * np.pi * frequencies)
        phases = self._phases_with_lowest_peak()
        duration = self.settle + self.period * self.periods + self.settle
        return [
            Sine(
                t_start=start,
                duration=duration,
                ramp=0.5 * self.settle,
                frequency=float(frequency),
                phase=float(phase),
                translation=list(amplitude * direction[:3]),
                rotation=list(amplitude * direction[3:]),
            )
            for frequency, amplitude, phase in zip(frequencies, amplitudes, phases, strict=True)
        ]

    def _phases_with_lowest_peak(self) -> Array:
        k = self.odd_multiples_of_base_rate()
        draws = np.random.default_rng(self.seed).uniform(0.0, 2 * np.pi, (_NUM_PHASE_SETS, len(k)))
        u = np.arange(8 * k[-1]) / (8 * k[-1])
        angle = 2 * np.pi * np.outer(u, k)
        peaks = [np.abs(np.cos(angle + draw).sum(axis=1)).max() for draw in draws]
        return draws[int(np.argmin(peaks))]


@dataclass(frozen=True, eq=False)
class StationResponse:
    """Spectra of the station's signals along a direction, measured or predicted.

    Signals: `hand_force`, of the hand on the stylus [N]; `hand_velocity` [m/s]; `displayed_force`,
    of the device on the hand [N]; `tool_velocity`, of the tip [m/s].
    """

    omega: Array  #: (n,) [rad/s]
    spectra: dict[str, Complex]  #: signal -> (periods, n); predicted: (1, n), for a unit force
    force_scale: float

    def response(self, output: str, input_: str) -> Complex:
        return self.spectra[output].mean(axis=0) / self.spectra[input_].mean(axis=0)

    def coherence(self, output: str, input_: str) -> Array:
        """Return the coherence (n,): fraction of the output's power that is linear in the input."""
        y, x = self.spectra[output], self.spectra[input_]
        cross = np.abs((y * x.conj()).sum(axis=0)) ** 2
        power = (np.abs(y) ** 2).sum(axis=0) * (np.abs(x) ** 2).sum(axis=0)
        return cross / power

    def apparent_mass(self) -> float:
        """Return displayed tool mass over force scale [kg]; delays must be far below 0.1 s."""
        low = self.omega <= 2 * np.pi * 10.0
        if (count := np.count_nonzero(low)) < 3:
            what = f"{count} frequencies are below 10 Hz (the fit of a mass needs 3)"
            remedy = "lower `lowest` or lengthen `period` of the MultiSine"
            raise DrakeTeleopError(what, where="MultiSine", remedy=remedy)
        omega = self.omega[low]
        displayed = -self.response("displayed_force", "tool_velocity")[low] / self.force_scale
        # The force noise is about equal at all lines, so that the weights are the accelerations.
        acceleration = omega * np.abs(self.spectra["tool_velocity"].mean(axis=0))[low]
        mass = (displayed / (1j * omega)).real
        return float(np.polyfit((omega / omega[-1]) ** 2, mass, 1, w=acceleration)[1])


def measure_frequency_response(
    scenario: Scenario,
    task: TaskDirection,
    excitation: MultiSine,
    *,
    load_estimate: Array | None = None,
    approach: Sequence[MinimumJerk] = (),
) -> StationResponse:
    """Simulate the station with a multi-sine motion of the operator; return the spectra.

    `approach` contains motions to the operating point before the multi-sine.
    """
    check_scenario(scenario)
    rate, period = scenario.rates.hand_hz, excitation.period
    steps = round(period * rate)
    if abs(steps - period * rate) > 1e-6:
        what = f"{period:g} s are not a whole number of the hand's periods at {rate:g} Hz"
        remedy = f"choose a multiple of {1 / rate:g} s"
        raise DrakeTeleopError(what, where="MultiSine.period", remedy=remedy)
    start = max((move.t_start + move.duration for move in approach), default=0.0)
    intent: list[MinimumJerk | Sine] = [*approach, *excitation.sines_along(task.hand, start)]
    drawing = replace(
        scenario,
        operator=OperatorConfig(grip=scenario.operator.grip, intent=intent),
        simulation__settle=start + excitation.settle,
        simulation__duration=period * excitation.periods,
        rates__log_hz=rate,
        load_estimator=scenario.load_estimator if load_estimate is None else LoadEstimatorConfig(),
        contact_detection=None,
    )
    diagram = MakeTeleopStation(drawing, load_estimate=load_estimate)
    result = simulate(diagram, drawing.simulation, progress=False)
    arm, states = NominalSlave(scenario.slave).arm, result["slave_state"]
    n = arm.num_joints
    J, twists = np.empty((6, n)), np.empty((len(states), 6))
    for state, twist in zip(states, twists, strict=True):
        jacobian(arm.table, np.ascontiguousarray(state[:n]), J)
        twist[:] = J @ state[n:]
    signals = {
        "hand_force": result["hand_wrench_E"] @ task.hand,
        "hand_velocity": result["twist_master"] @ task.hand,
        "displayed_force": result["force_to_master"] @ task.hand,
        "tool_velocity": twists @ task.tool,
    }
    odd_multiples = excitation.odd_multiples_of_base_rate()
    spectra: dict[str, Complex] = {}
    for name, signal in signals.items():
        periods = signal[: steps * excitation.periods].reshape(-1, steps)
        spectra[name] = np.fft.rfft(periods)[:, odd_multiples] * (2 / steps)
    omega = np.asarray(2 * np.pi / period * odd_multiples, dtype=float)
    return StationResponse(omega, spectra, scenario.force_scaling.force_scale)
