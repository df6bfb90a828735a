"""Trials of settings for given hands, walls and network: a hand swings, presses and holds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.optimize import bisect

from drake_teleop.common.errors import DrakeTeleopError, suggest_name
from drake_teleop.common.numeric import Array, to_float
from drake_teleop.lab.analysis.analyze import axis_with_grip, sampling_of_scenario
from drake_teleop.lab.analysis.cut_loop import count_unstable_multipliers, cut_loop
from drake_teleop.lab.analysis.one_axis import AxisParameters, OneAxis
from drake_teleop.lab.analysis.task_direction import OneAxisFromScenario, check_can_press
from drake_teleop.lab.comparison import one_dof
from drake_teleop.lab.comparison.one_dof import OneDof, Task
from drake_teleop.lab.comparison.whole_station import measures_of_press, press_scenario
from drake_teleop.lab.studies.design import FactorValues
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import PRESETS, mean_delay
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.master.data_sheets import FIGURES
from drake_teleop.station.master.phantom import PEAK_FORCE_N
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.oscillation import MAX_FORCE_RIPPLE_RMS_AT_REST_N as MAX_REST_FORCE_N
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.passivity.tdpa import charged_tdpa_config
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

MAX_RELATIVE_FORCE_ERROR = 0.1
"""Largest accepted error of the rendered force, as a share of the scaled contact force."""
MAX_SEARCH_FORCE_ERROR = 0.075
"""Smaller limit for settings that `tune` chooses, as a margin for other seeds and walls."""
ONE_AXIS_SEARCH_MEASURES = ["gamma_limit", "linear_limit", "share"]
PRESS_MEASURES = ["rests", "rest_force_N", "share", "free_force_N", "contact_N", "threshold_N"]
_PRESS_SETTLE_TIME_S, _REST_WINDOW_S = 1.5, 0.8  # from the press to the window of rest; its length
_HAND_SETTLE_TIME_S = 0.1  # s, from the end of the swing until the hand is at rest
_MAX_PRESS_DEPTH_M = 0.02
_PEAK_FORCE_SHARE = 0.6  # share of the device's peak force that is used
_FILTER_DELAY_TIMES_CUTOFF_HZ = 0.416  # of the 4th-order Butterworth filter
_MIN_GAMMA, _LOG_GAMMA_RESOLUTION = 0.05, 0.03  # smallest gamma; resolution of its logarithm
_TESTED_GAMMAS = np.geomspace(_MIN_GAMMA, 200.0, 160)
_MIN_WALL_N_M, _MAX_WALL_N_M = 100.0, 60e3  # N/m, range of the leaf's model
_NUM_TESTED_WALL_STIFFNESSES = 4  # from the softest to the stiffest
_MAX_STEP_S = 2e-3  # longer than the events' period; else tiny steps precede the events
METHOD_NAME_OF_USER_SETTINGS = "as given"
"""Name in place of a method: passivity and scales of the user's scenario."""


@dataclass(frozen=True)
class TaskRequirements:
    """Stability margin and sensor bandwidth that a task requires."""

    loop_gain_margin: float  #: factor of the loop gain that must still be stable
    min_low_pass_hz: float  #: lowest bandwidth of the sensor; a lower one delays the contact force


REQUIREMENTS_OF_TASK = {
    "press": TaskRequirements(1.1, 50.0),
    "touch": TaskRequirements(1.1, 100.0),
    "insert": TaskRequirements(1.5, 50.0),
}
"""Requirements by task. A peg between two walls doubles the stiffness: a larger margin."""


@dataclass(frozen=True)
class OperatingRange:
    """Hands, walls and task for which settings must meet the requirements."""

    hands: tuple[str, ...]  #: names of all grips from the softest to the firmest
    walls: tuple[float, float]  #: lowest and highest stiffness [N/m]
    task: str  #: key of `REQUIREMENTS_OF_TASK`

    @property
    def corners(self) -> list[tuple[str, float]]:
        """Pairs of softest or firmest grip and wall [N/m]: stiffest wall first, then softest."""
        hands = dict.fromkeys((self.hands[0], self.hands[-1]))
        return [(hand, wall) for wall in self.walls[::-1] for hand in hands]

    @property
    def tested_parts(self) -> list[tuple[float, list[str], list[float]]]:
        """Parts of the test, each with its own seed: (factor of gamma, grips, walls [N/m])."""
        low, high = self.walls
        margin, hands = self.requirements.loop_gain_margin, list(self.hands)
        walls = np.geomspace(high, low, _NUM_TESTED_WALL_STIFFNESSES if low < high else 1).tolist()
        # The softest grip fails first: it is tested twice.
        parts = [(margin, part, walls) for part in (hands[:1], hands[:1], hands[1:]) if part]
        return [*parts, (1.0, [*dict.fromkeys((hands[0], hands[-1]))], [high])]

    @property
    def requirements(self) -> TaskRequirements:
        return REQUIREMENTS_OF_TASK[self.task]


def make_operating_range(hands: Sequence[str], walls: Sequence[float], task: str) -> OperatingRange:
    """Return the required operating range: these grips, walls [kN/m] and task."""
    walls = [to_float("walls", wall) for wall in walls]
    _check_names_are_known("hands", hands, tuple(GRIP_IMPEDANCES))
    _check_names_are_known("task", [task], tuple(REQUIREMENTS_OF_TASK))
    for where, given, example in (("hands", hands, "light"), ("walls", walls, "0.5,20 (kN/m)")):
        if not given:
            raise DrakeTeleopError("is empty", where=where, remedy=f"give such as {example}")
    for wall in walls:
        if not _MIN_WALL_N_M <= 1e3 * wall <= _MAX_WALL_N_M:
            lowest, highest = _MIN_WALL_N_M / 1e3, _MAX_WALL_N_M / 1e3
            what = f"{wall:g} kN/m is outside {lowest:g} to {highest:g} kN/m"
            raise DrakeTeleopError(what, where="walls", remedy="give stiffnesses in kN/m")
    grips = list(GRIP_IMPEDANCES)
    places = list(map(grips.index, hands))
    between = tuple(grips[min(places) : max(places) + 1])
    return OperatingRange(between, (1e3 * min(walls), 1e3 * max(walls)), task)


def _check_names_are_known(where: str, names: Sequence[str], known: tuple[str, ...]) -> None:
    for name in names:
        if name not in known:
            remedy = suggest_name(name, known, f"choose among {', '.join(known)}")
            raise DrakeTeleopError(f"'{name}' is unknown", where=where, remedy=remedy)


def without_task_and_passivity_method(scenario: Scenario, network: str | None) -> Scenario:
    """Return the scenario without environment, task, passivity method and displayed load.

    `network` is a preset; None keeps the scenario's network.
    """
    if network is not None:
        _check_names_are_known("network", [network], tuple(PRESETS))
        scenario = replace(scenario, channel=Channel(network=network))
    scenario = replace(scenario, passivity=PassivityConfig())
    if scenario.has_no_network_or_passivity:  # the method "none" is among the candidates
        what = "the scenario has no network, which the energy balances of the runs need"
        remedy = f"choose among {', '.join(name for name in PRESETS if name != 'ideal')}"
        raise DrakeTeleopError(what, where="network", remedy=remedy)
    check_can_press(scenario)
    force_scale = scenario.force_scaling.force_scale
    simulation = dataclasses.replace(scenario.simulation, max_step=_MAX_STEP_S, end_with_task=False)
    return replace(
        scenario.without_environment(),
        simulation=simulation,
        force_scaling=ForceScalingConfig(sigma=0.0, force_scale=force_scale),
        contact_detection=None,
        load_estimator=LoadEstimatorConfig(),  # contact would count as load
        operator__intent=[],
        operator__task=None,
    )


@dataclass(frozen=True)
class TunedSettings:
    """Settings that `tune` chooses."""

    method: str
    gamma: float
    sigma_inertia: float
    low_pass_hz: float

    def passivity(self, operating_range: OperatingRange) -> PassivityConfig:
        """Return passivity settings; method charged_tdpa assumes the firmest grip of the range."""
        hand = GRIP_IMPEDANCES[operating_range.hands[-1]]
        stiffness = [hand.stiffness, hand.rotational_stiffness]
        known = dataclasses.replace(charged_tdpa_config(), hand_stiffness=stiffness)
        return PassivityConfig(method=self.method, charged_tdpa=known)

    def apply(self, base: Scenario, operating_range: OperatingRange) -> Scenario:
        sensor = base.wrist_sensor
        low_pass_hz = sensor.bandwidth_hz if sensor.ideal else self.low_pass_hz
        return replace(
            base,
            wrist_sensor__bandwidth_hz=low_pass_hz,
            force_scaling__sigma=0.0,
            force_scaling__eta=None,
            force_scaling__sigma_weight=0.0,
            force_scaling__sigma_inertia=self.sigma_inertia,
            force_scaling__gamma=self.gamma,
            passivity=self.passivity(operating_range),
        )


def settings_of_point(values: FactorValues) -> TunedSettings:
    names = [entry.name for entry in dataclasses.fields(TunedSettings)]
    return TunedSettings(**{name: values[name] for name in names})  # type: ignore[arg-type]


@dataclass(frozen=True)
class StationPressTrial:
    """Function that a study runs: simulate a press on a wall by the whole station."""

    user_scenario: Scenario  #: with the user's passivity and scales
    base_scenario: Scenario  #: the same without environment, task and passivity method
    operating_range: OperatingRange
    load_estimate: Array  #: (16,) [offsets, phi]

    def __call__(self, values: FactorValues, seed: int) -> dict[str, float]:
        grip, wall = str(values["hand"]), float(values["wall"])  # type: ignore[arg-type]
        scenario = self.user_scenario
        if values["method"] != METHOD_NAME_OF_USER_SETTINGS:
            scenario = settings_of_point(values).apply(self.base_scenario, self.operating_range)
        scenario = replace(scenario, operator__grip=grip, simulation__seed=seed)
        channel, passivity = self.base_scenario.channel, scenario.passivity
        task = short_press_task(sum(map(mean_delay, channel.networks_of_directions())))
        depth = renderable_press_depth(self.base_scenario, grip)
        setup, _ = press_scenario(scenario, channel, passivity, wall, task=task, depth=depth)
        station = MakeTeleopStation(setup, load_estimate=self.load_estimate)
        try:
            result = simulate(station, setup.simulation, progress=False)
        except DrakeTeleopError:  # it left its joint ranges
            return dict.fromkeys(PRESS_MEASURES, 0.0) | {"threshold_N": np.inf}
        found = measures_of_press(result, setup, task)
        hold = task.is_held(result.t)
        scaling = scenario.force_scaling
        gain = scaling.force_scale * scaling.scales().gamma
        free = (result.t >= task.swing_end + _HAND_SETTLE_TIME_S) & (result.t < task.press_start)
        force, period = result["force_to_master"], result.t[1] - result.t[0]
        forces = (force[hold, :3] @ scenario.kinematic_scaling.R_WB[2], *force[free, :3].T)
        rest_force = max(rms_above_5_hz(f, period) for f in forces)
        share = found.rendered_share if np.isfinite(found.rendered_share) else 0.0
        human = self.base_scenario.operator.perception
        smallest = max(human.absolute_threshold, human.weber_fraction * found.free_force)
        return {
            "rests": float(found.stable),
            "rest_force_N": rest_force,
            "share": share,
            "free_force_N": found.free_force,
            "contact_N": abs(float(result["true_contact_wrench_W"][hold, 2].mean())),
            "threshold_N": (smallest + 2 * rest_force) / (gain * share) if share else np.inf,
        }


@dataclass(frozen=True)
class OneAxisGammaSearch:
    """Study function: find the largest contact force share that is stable in the whole range."""

    base_scenario: Scenario
    operating_range: OperatingRange
    gamma_upper_bounds: dict[float, float]  #: low-pass [Hz] -> largest tried gamma

    def __call__(self, values: FactorValues, seed: int) -> dict[str, float]:
        settings = settings_of_point(values | {"gamma": 1.0})
        axis = OneAxisFromScenario(self.base_scenario, (0.0, 0.0, 1.0))
        axis = dataclasses.replace(axis, sigma=settings.sigma_inertia, wall_damping=0.0)
        linear = self._max_gamma_of_linear_model(axis, settings)
        cap = self.gamma_upper_bounds[settings.low_pass_hz]
        if settings.method == "none":
            cap = min(cap, linear)
        shares: dict[float, float] = {}

        def stability_sign(log_gamma: float) -> float:
            tried, found = dataclasses.replace(settings, gamma=float(np.exp(log_gamma))), []
            for corner in self.operating_range.corners:
                found.append(self.displayed_force_share(axis, tried, *corner, seed))
                if not is_force_share_accepted(found[-1], MAX_SEARCH_FORCE_ERROR):
                    return -1.0
            shares[tried.gamma] = min(found)
            return 1.0

        low, high = np.log(_MIN_GAMMA), np.log(max(cap, _MIN_GAMMA))
        if stability_sign(high) < 0 < stability_sign(low):
            bisect(stability_sign, low, high, xtol=_LOG_GAMMA_RESOLUTION)
        gamma = max(shares, default=0.0)
        return {"gamma_limit": gamma, "linear_limit": linear, "share": shares.get(gamma, 0.0)}

    def _max_gamma_of_linear_model(self, axis: OneAxis, settings: TunedSettings) -> float:
        sampling = sampling_of_scenario(self.base_scenario)
        if sampling.low_pass_hz is not None:
            sampling = dataclasses.replace(sampling, low_pass_hz=settings.low_pass_hz)
        stable = np.ones(len(_TESTED_GAMMAS), dtype=bool)
        for grip, wall in [*self.operating_range.corners, (self.operating_range.hands[0], 0.0)]:
            grid: dict[str, Any] = {"wall_stiffness": wall, "gamma": _TESTED_GAMMAS}
            held = dataclasses.replace(axis_with_grip(axis, grip), **grid)
            stable &= count_unstable_multipliers(cut_loop(held, sampling), axis.delay) == 0
        return float(_TESTED_GAMMAS[: int(np.argmin([*stable, False]))].max(initial=0.0))

    def displayed_force_share(
        self, axis: OneAxis, settings: TunedSettings, grip: str, wall: float, seed: int
    ) -> float:
        """Return displayed over scaled contact force in a one-axis run; 0: unstable or noisy."""
        forward, backward = self.base_scenario.channel.networks_of_directions()
        held = axis_with_grip(axis, grip)
        shown = {f.name: getattr(held, f.name) for f in dataclasses.fields(AxisParameters)}
        # With the slave's motion over its scale, the model is the same at this force scale.
        shown["force_scale"] *= held.position_scale
        model = OneDof(**shown | {"wall_stiffness": wall, "gamma": settings.gamma})
        ideal = self.base_scenario.wrist_sensor.ideal
        added = 0.0 if ideal else _FILTER_DELAY_TIMES_CUTOFF_HZ / settings.low_pass_hz
        task = short_press_task(mean_delay(forward) + mean_delay(backward))
        passivity, intent = settings.passivity(self.operating_range), one_dof.operator_intent(task)
        later = {name: getattr(backward, name) + added for name in ("delay", "playout")}
        filtered = dataclasses.replace(backward, **later)
        run = one_dof.run_one_dof(model, passivity, forward, filtered, seed=seed, intent=intent)
        found = one_dof.measures_of_run(run, model, task)
        noise = rms_above_5_hz(run.hand_force[task.is_held(run.t)], run.t[1] - run.t[0])
        return found.rendered_share if found.stable and noise <= MAX_REST_FORCE_N else 0.0


def is_force_share_accepted(share: float, max_error: float = MAX_RELATIVE_FORCE_ERROR) -> bool:
    return abs(share - 1.0) <= max_error


def short_press_task(round_trip: float) -> Task:
    """Return the times of a task (swing, rest, held press) for a round trip [s]."""
    pressed = 1.8 + 2 * round_trip
    release = pressed + _PRESS_SETTLE_TIME_S + _REST_WINDOW_S + 2 * round_trip
    return Task(
        swing_start=0.1,
        swing_end=0.8,
        press_start=pressed - 0.5,
        press_end=pressed,
        release_start=release,
        release_end=release + 0.1,
        end=release,
        rest_window=_REST_WINDOW_S,
    )


def renderable_press_depth(base: Scenario, grip: str) -> float:
    """Return the hand's target depth [m] in a wall, limited by the device's peak force."""
    sheet = base.master.figures or FIGURES.get(base.master.model)
    peak = PEAK_FORCE_N if sheet is None else sheet.peak_force
    return min(_MAX_PRESS_DEPTH_M, _PEAK_FORCE_SHARE * peak / GRIP_IMPEDANCES[grip].stiffness)


def rms_above_5_hz(x: Array, period: float) -> float:
    """Return the rms above 5 Hz of x (N,) minus its fitted parabola; inf if not finite."""
    if not np.isfinite(x).all() or len(x) < 4:
        return float("inf")
    t = np.linspace(-1.0, 1.0, len(x))
    # The cosine transform continues x evenly, so that slow motion stays below 5 Hz.
    spectrum = dct(x - np.polyval(np.polyfit(t, x, 2), t), norm="ortho")
    high = np.arange(len(x)) / (2 * len(x) * period) > 5.0
    return float(np.sqrt(np.sum(spectrum[high] ** 2) / len(x)))
