"""`drake-teleop analyze`: is a station stable, for whom, and how transparent is it?

Along one direction of the task, at rest. The two-port between hand and environment is that of the
Diagram itself, linearised; the closed form of one axis stands beside it. `summary.json` holds

============ ==================================================================================
scenario     its name, direction, grip, passivity method, delay_s (one way), wall_N_per_m (its
             leaf, or else the paper's 5.1 kN/m)
axis         the numbers of `analysis.one_axis.OneAxis`, and tool_coupling
diagram      list: operating point, states, stable, decay_1_per_s (of what dies last),
             frequency_Hz (of its oscillation); one_axis: the same of the sampled one-axis model
two_port     greatest deviation of the Diagram's H, hand's mass included, up to 30 Hz: closed_form
             with the exact delay, sampled with the station's rates as well
margins      list: grip, wall_N_per_m, stable, gain, phase_deg, round_trip_s (null: without bound)
absolute     absolutely_stable, least_parameter (>= 1 is stable) and at_Hz,
             lacking_damping_Ns_per_m, passive, scattering_norm
bounded      grips: stiffest wall [N/m] for every hand between the lightest and the firmest grip;
             each: for each grip alone, as it is; null: no wall is too stiff
transparency free and wall: mass_kg, damping_Ns_per_m, stiffness_N_per_m of what is felt and of the
             ideal; unnoticed_to_Hz; tracking_bandwidth_Hz; width_decades;
             smallest_stiffness_N_per_m
z_width      device's damping and rate; list: wall_damping, passive_N_per_m, stable_N_per_m
maps         list: x, y, stable (share of the map), boundary (places)
measured     in free motion, by multi-sine in the nonlinear simulation: frequency_Hz, felt_re,
             felt_im, coherence, greatest_error and greatest_error_deg against the linearisation
             (hand's mass included); null if free motion is unstable
verdict      sentences
============ ==================================================================================
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RollPitchYaw

from drake_teleop.analysis import absolute_stability, margins, sampled_wall, transparency
from drake_teleop.analysis.cut_loop import (
    cut_loop,
    delay_margin,
    dominant_multiplier,
    loop_response,
    unstable_multipliers,
)
from drake_teleop.analysis.frequency_response import MultiSine, measure_frequency_response
from drake_teleop.analysis.linearization import (
    AXES,
    MOST_STATES,
    Linearization,
    delays,
    hybrid_along,
    linearize,
)
from drake_teleop.analysis.maps import RATE, StabilityMap, stability_map
from drake_teleop.analysis.one_axis import Complex, OneAxis
from drake_teleop.analysis.period_map import Sampling
from drake_teleop.analysis.report import Curves, print_tables, write_report
from drake_teleop.analysis.sampled_loop import sampled_two_port
from drake_teleop.analysis.task_direction import TIP, TaskDirection, task_direction
from drake_teleop.analysis.two_port import (
    absorb,
    hybrid,
    power_ratio,
    power_scaled,
    reference_impedances,
    scattering,
    transmitted_impedance,
)
from drake_teleop.analysis.verdict import verdict
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.identification import slave_arm
from drake_teleop.operator.operator import GRIPS
from drake_teleop.pages.progress import Stage, progress_bars
from drake_teleop.passivity.methods import PassivityConfig
from drake_teleop.scenario import LoadScenario, Scenario, replace

Array = NDArray[np.float64]

DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
#: N/m, before which the margins are taken; the scenario's own leaf comes on top of them.
WALLS = (0.0, 1000.0, 5100.0, 20000.0)
BAND = 2 * np.pi * 30.0  #: rad/s, up to which models are compared
_OMEGA: Array = 2 * np.pi * np.geomspace(0.1, 300.0, 500)
_S: Complex = 1j * _OMEGA.astype(complex)
_PRESSED = 5e-3  # m, how deep the hand presses into the leaf
_FELT_BAND = 2 * np.pi * 5.0  # rad/s, up to which mass, damping and stiffness are fitted
_NOTHING = 1e-9  # a loop that is nowhere larger than this is none
_PIXELS = 80  # of a map, each way
_MULTI_SINE = MultiSine(lowest=0.6, period=1.5, settle=1.0)


def analyze_command(
    scenario: str, out: Path, *, direction: str = "z", quiet: bool = False
) -> dict[str, Any]:
    """Analyses a scenario; writes summary.json, report.html and its pictures.

    Args:
        scenario: the name of a shipped one, or a YAML file.
        out: the folder.
        direction: x, y or z of the world.
        quiet: no progress bars and no tables.

    Returns:
        The summary, see the top of this module.

    Raises:
        DrakeTeleopError: for a scenario that cannot be, or cannot be linearised.
    """
    setup = LoadScenario(scenario)
    out.mkdir(parents=True, exist_ok=True)  # before the work: a bad path costs no time
    with progress_bars(quiet) as stage:
        summary, curves = analyze(setup, direction, stage)
    summary = {"scenario": scenario, **summary}
    (out / "summary.json").write_text(
        json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8"
    )
    write_report(summary, curves, out)
    if not quiet:
        print_tables(summary, out)
    return summary


def analyze(scenario: Scenario, direction: str, stage: Stage) -> tuple[dict[str, Any], Curves]:
    """The figures of a scenario along x, y or z of the world, and its curves.

    A method of passivity in the channel is not linear: then the station is analysed without it.

    Raises:
        DrakeTeleopError: see `analyze_command`.
    """
    method = scenario.passivity.method
    linear = replace(scenario, passivity=PassivityConfig())
    estimate = np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])
    along = task_direction(linear, DIRECTIONS[direction])
    sampling = sampling_of(linear)
    wall = (5100.0, 0.0)
    if scenario.sheet_spring is not None:
        wall = (along.axis.wall_stiffness, along.axis.wall_damping)
    axis = dataclasses.replace(along.axis, wall_stiffness=0.0, wall_damping=0.0)
    contact = dataclasses.replace(axis, wall_stiffness=wall[0], wall_damping=wall[1])

    progress = stage("Linearise the Diagram")
    free = linearize(replace(linear, sheet_spring=None, slot=None), load_estimate=estimate)
    progress(0.5)
    points = [("free motion", free, axis)]
    if scenario.sheet_spring is not None:
        pressed = linearize(linear, load_estimate=estimate, displacement=pressing(linear))
        points.append(("on the leaf", pressed, contact))
    progress(1.0)

    progress = stage("Two-port, margins, transparency")
    with_hand = hybrid_along(held_elsewhere(free, linear, along), _OMEGA, along.hand, along.tool)
    H = absorb(with_hand, hand=-_S * axis.hand_mass)
    closed_form = hybrid(axis, _S)
    progress(0.3)
    figures: dict[str, Any] = {
        "direction": direction,
        "grip": scenario.operator.grip,
        "method": method,
        "delay_s": axis.delay,
        "wall_N_per_m": wall[0],
        "axis": dataclasses.asdict(axis) | {"tool_coupling": along.tool_coupling},
        "diagram": [
            diagram_figures(name, closed(system, linear), on_paper, sampling)
            for name, system, on_paper in points
        ],
        "two_port": deviations(with_hand, axis, sampling),
        "margins": margin_rows(axis, sampling, wall[0]),
        "absolute": absolute_figures(H, axis),
        "bounded": bounded_figures(H, axis, sampling),
        "transparency": transparency_figures(H, axis, wall),
        "z_width": z_width_figures(axis, sampling),
    }
    progress(1.0)
    maps = parameter_maps(axis, wall, sampling, stage)
    figures["maps"] = [
        {
            "title": title,
            "x": shown[scenario.operator.grip].x_name,
            "y": shown[scenario.operator.grip].y_name,
            "stable": {grip: float(one.stable.mean()) for grip, one in shown.items()},
            "boundary": {grip: one.boundary.tolist() for grip, one in shown.items()},
        }
        for title, shown in maps.items()
    ]
    figures["measured"] = None
    if figures["diagram"][0]["stable"]:
        measured = stage("Multi-sine in the nonlinear simulation")
        figures["measured"] = measured_figures(linear, along, held_elsewhere(free, linear, along))
        measured(1.0)
    figures = _plain(figures)
    figures["verdict"] = verdict(figures)
    nyquist = {}
    for grip in GRIPS:
        loop = cut_loop(held_by(contact, grip), sampling)
        nyquist[grip] = -loop_response(loop, _OMEGA, axis.delay)
    return figures, Curves(axis, _OMEGA, H, closed_form, wall, nyquist, maps)


def sampling_of(scenario: Scenario) -> Sampling:
    """The rates of a scenario."""
    rates, sensor = scenario.rates, scenario.wrist_sensor
    return Sampling(
        rates.hand_hz,
        rates.joint_control_hz,
        rates.sensor_hz,
        None if sensor.ideal else sensor.bandwidth_hz,
    )


def held_by(axis: OneAxis, grip: str) -> OneAxis:
    """The axis with another grip of the hand."""
    hand = GRIPS[grip]
    return dataclasses.replace(
        axis, hand_mass=hand.mass, hand_damping=hand.damping, hand_stiffness=hand.stiffness
    )


def pressing(scenario: Scenario) -> list[float]:
    """Displacement of the master [m], in B, at which the tip is 5 mm deep in the leaf.

    Raises:
        DrakeTeleopError: if the motion is not scaled to anything.
    """
    assert scenario.sheet_spring is not None
    scaling = scenario.kinematic_scaling
    if scaling.translation_scale == 0:
        raise DrakeTeleopError(
            "the slave does not move",
            where="kinematic_scaling.translation_scale",
            remedy="choose a scale above 0, or leave the sheet_spring out",
        )
    tip = np.array(scenario.slave.position) - [0.0, 0.0, TIP[2]]  # the tool points down
    way = np.array(scenario.sheet_spring.position) - [0.0, 0.0, _PRESSED] - tip
    R_WB = RollPitchYaw(scaling.alignment).ToRotationMatrix().matrix()
    return list(R_WB.T @ way / scaling.translation_scale)


def closed(system: Linearization, scenario: Scenario) -> Linearization:
    """All loops closed: the operator holds the stylus over the network."""
    return _network(system, scenario).close("operator_wrench", "hand_wrench")


def held_elsewhere(
    system: Linearization, scenario: Scenario, along: TaskDirection
) -> Linearization:
    """Closed but for the hand's grip along the direction, if that is an axis of B; else let go."""
    system = _network(system, scenario)
    (aligned,) = np.nonzero(np.abs(along.hand) > 1 - 1e-9)
    others = [axis for k, axis in enumerate(AXES) if len(aligned) and k != aligned[0]]
    return system.close(
        [f"operator_wrench.{axis}" for axis in others], [f"hand_wrench.{axis}" for axis in others]
    )


def _network(system: Linearization, scenario: Scenario) -> Linearization:
    forward, backward = delays(scenario)
    system = system.close("pose_command", "pose_received", forward)
    return system.close("wrench_B", "wrench_received", backward)


def diagram_figures(
    name: str, system: Linearization, axis: OneAxis, sampling: Sampling
) -> dict[str, Any]:
    """Whether an operating point is stable, and what of it dies last.

    Beyond a second or so of delay the Diagram's multipliers are too many; then one axis says it.
    """
    lines = sum(len(outputs) * periods for outputs, _, periods in system.loops)
    loop = cut_loop(axis, sampling)
    one_axis = _dying(complex(dominant_multiplier(loop, axis.delay)), float(loop.period))
    figures: dict[str, Any] = {
        "point": name,
        "states": len(system.A) + lines,
        "stable": one_axis["stable"],
        "decay_1_per_s": None,
        "frequency_Hz": None,
        "one_axis": one_axis,
    }
    if figures["states"] <= MOST_STATES:
        figures |= _dying(system.multipliers[0], system.dt)
    return figures


def _dying(multiplier: complex, period: float) -> dict[str, Any]:
    return {
        "stable": bool(abs(multiplier) < 1),
        "decay_1_per_s": float(-np.log(abs(multiplier)) / period),
        "frequency_Hz": float(abs(np.angle(multiplier)) / period / (2 * np.pi)),
    }


def deviations(with_hand: Complex, axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    """How far the Diagram's two-port is from the closed form, and from the sampled one.

    The hand's mass moves with the stylus and is compared as a part of the device.
    """
    compared = _OMEGA <= BAND
    heavy = dataclasses.replace(axis, device_mass=axis.device_mass + axis.hand_mass)

    def greatest(other: Complex) -> dict[str, float]:
        found = np.abs(with_hand[compared] - other).max(axis=0) / np.abs(other).max(axis=0)
        return {f"h{i + 1}{j + 1}": float(found[i, j]) for i in range(2) for j in range(2)}

    return {
        "closed_form": greatest(hybrid(heavy, _S[compared])),
        "sampled": greatest(sampled_two_port(heavy, sampling, _OMEGA[compared])),
    }


def margin_rows(axis: OneAxis, sampling: Sampling, own_wall: float) -> list[dict[str, Any]]:
    """Gain, phase and round trip of the sampled loop, for each grip before each wall."""
    rows = []
    omega = np.geomspace(1e-2, np.pi * sampling.hand_hz, 6000)
    for grip in GRIPS:
        for wall in sorted({*WALLS, own_wall}):
            held = dataclasses.replace(held_by(axis, grip), wall_stiffness=wall)
            loop = cut_loop(held, sampling)
            response = -loop_response(loop, omega, axis.delay)
            stable = bool(unstable_multipliers(loop, axis.delay) == 0)
            gain, phase = (np.inf, np.inf) if stable else (1.0, 0.0)
            if stable and np.abs(response).max() > _NOTHING:
                found = margins.margins_of_response(omega, response, sampled=True)
                gain, phase = float(found.gain), float(np.degrees(found.phase))
            rows.append(
                {
                    "grip": grip,
                    "wall_N_per_m": wall,
                    "stable": stable,
                    "gain": gain,
                    "phase_deg": phase,
                    "round_trip_s": float(delay_margin(loop)),
                }
            )
    return rows


def absolute_figures(H: Complex, axis: OneAxis) -> dict[str, Any]:
    """For anything passive at either end: Llewellyn; Raisbeck and scattering on scaled ports."""
    parameter = absolute_stability.llewellyn_parameter(H)
    worst = int(np.argmin(parameter))
    scaled = power_scaled(H, power_ratio(axis)) if power_ratio(axis) > 0 else H
    norm = absolute_stability.scattering_norm(scattering(scaled, reference_impedances(axis)))
    return {
        "absolutely_stable": bool(absolute_stability.absolutely_stable(H).all()),
        "least_parameter": float(parameter[worst]),
        "at_Hz": float(_OMEGA[worst] / (2 * np.pi)),
        "lacking_damping_Ns_per_m": float(absolute_stability.required_damping(H).max()),
        "passive": bool(absolute_stability.passive(scaled).all()),
        "scattering_norm": float(norm.max()),
    }


def bounded_figures(H: Complex, axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    """The stiffest wall before which hands are stable: all between two grips, and each alone."""
    hands = absolute_stability.range_of_grips()
    limit = float(absolute_stability.stiffness_limit(H, _OMEGA, hands).min())
    each = {grip: _stiffest(held_by(axis, grip), sampling) for grip in GRIPS}
    return {"grips": limit if min(each.values()) > 0 else 0.0, "each": each}


def _stiffest(axis: OneAxis, sampling: Sampling) -> float:
    """[N/m] up to which every wall is stable; 0 if free motion is not; inf beyond the grid."""
    tried = np.concatenate([[0.0], np.geomspace(10.0, 1e7, 1000)])
    walls: Any = {"wall_stiffness": tried, "wall_damping": 0.0}
    loop = cut_loop(dataclasses.replace(axis, **walls), sampling)
    (bad,) = np.nonzero(unstable_multipliers(loop, axis.delay))
    return float("inf") if len(bad) == 0 else float(tried[max(bad[0] - 1, 0)])


def transparency_figures(H: Complex, axis: OneAxis, wall: tuple[float, float]) -> dict[str, Any]:
    """What is felt in free motion and of the wall, next to what should be."""
    fitted = _OMEGA <= _FELT_BAND
    figures: dict[str, Any] = {}
    environments = {"free": np.zeros_like(_S), "wall": wall[1] + wall[0] / _S}
    for name, environment in environments.items():
        felt = transmitted_impedance(H, environment)
        ideal = transparency.ideal_impedance(axis, _S, environment)
        noticed = transparency.fidelity(felt, ideal).noticed
        first = int(np.argmax(noticed)) if noticed.any() else len(noticed)
        figures[name] = {
            which: transparency.apparent(impedance[fitted], _OMEGA[fitted])._asdict()
            for which, impedance in (("felt", felt), ("ideal", ideal))
        }
        figures[name]["unnoticed_to_Hz"] = float(_OMEGA[first - 1] / (2 * np.pi)) if first else 0.0
    follows = np.abs(H[:, 1, 0]) > axis.position_scale / np.sqrt(2)
    end = len(follows) if follows.all() else int(np.argmin(follows))
    figures["tracking_bandwidth_Hz"] = float(_OMEGA[max(end - 1, 0)] / (2 * np.pi))
    width = transparency.transmitted_width(H).decades
    figures["width_decades"] = {
        f"{hz:g} Hz": float(np.interp(2 * np.pi * hz, _OMEGA, width)) for hz in (1.0, 5.0, 10.0)
    }
    told = transparency.smallest_stiffness_change(H, _OMEGA, wall[0])
    figures["smallest_stiffness_N_per_m"] = {
        "on the master, 1 Hz": float(np.interp(2 * np.pi, _OMEGA, told)),
        "on the wall itself": transparency.WEBER_FRACTIONS["stiffness"].value * wall[0],
    }
    return figures


def z_width_figures(axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    """Virtual walls that the device itself could render at the hand's rate."""
    damping, period = np.linspace(0.0, 60.0, 31), 1 / sampling.hand_hz
    passive = sampled_wall.passive_stiffness(axis.device_damping, damping, period)
    stable = sampled_wall.stable_stiffness(
        axis.hand_mass + axis.device_mass,
        axis.hand_damping + axis.device_damping,
        damping,
        period,
        hand_stiffness=axis.hand_stiffness,
    )
    held = sampled_wall.passive_stiffness(axis.hand_damping + axis.device_damping, damping, period)
    return {
        "device_damping_Ns_per_m": axis.device_damping,
        "rate_Hz": sampling.hand_hz,
        "walls": [
            {
                "wall_damping_Ns_per_m": float(B),
                "passive_N_per_m": float(alone),
                "passive_in_the_hand_N_per_m": float(in_hand),
                "stable_in_the_hand_N_per_m": float(limit),
            }
            for B, alone, in_hand, limit in zip(damping, passive, held, stable, strict=True)
        ],
    }


def measured_figures(
    scenario: Scenario, along: TaskDirection, system: Linearization
) -> dict[str, Any]:
    """What the hand feels in free motion, simulated with all of the sensor's noise.

    The device's Coulomb friction is left out here too: what it does depends on the amplitude.
    """
    coulomb = dataclasses.replace(scenario.master.friction, coulomb=[0.0] * 6)
    smooth = replace(scenario, sheet_spring=None, slot=None, master__friction=coulomb)
    estimate = np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])
    if scenario.wrist_sensor.ideal:
        estimate[:6] = 0.0
    found = measure_frequency_response(smooth, along, _MULTI_SINE, load_estimate=estimate)
    # Of a force that is held for a period, the share of the frequency itself, as in the two-port.
    step = 1j * found.omega / scenario.rates.hand_hz
    held = found.response("hand_force", "hand_velocity") * -np.expm1(-step) / step
    # The hand's mass moves with the stylus and belongs to the hand.
    felt = held - 1j * found.omega * along.axis.hand_mass
    ratio = held / hybrid_along(system, found.omega, along.hand, along.tool)[:, 0, 0]
    return {
        "frequency_Hz": found.omega / (2 * np.pi),
        "felt_re": felt.real,
        "felt_im": felt.imag,
        "coherence": found.coherence("hand_velocity", "hand_force"),
        "greatest_error": np.abs(np.abs(ratio) - 1).max(),
        "greatest_error_deg": np.abs(np.angle(ratio, deg=True)).max(),
    }


def parameter_maps(
    axis: OneAxis, wall: tuple[float, float], sampling: Sampling, stage: Stage
) -> dict[str, dict[str, StabilityMap]]:
    """Title -> grip -> stability over two parameters."""
    touching = dataclasses.replace(axis, wall_stiffness=wall[0], wall_damping=wall[1])
    n, tool = _PIXELS, axis.tool_mass
    delay, sigma = np.linspace(0.0, 0.2, n), np.linspace(0.0, 2.0, n)
    walls = np.geomspace(100.0, 1e5, n)
    # The sensor's low-pass has to stay below half of its rate.
    slowest = 2.4 * (sampling.low_pass_hz or 0.0) * sampling.hand_hz / sampling.sensor_hz
    rate = np.geomspace(max(slowest, 100.0), 10e3, n)
    wanted: dict[str, tuple[Any, ...]] = {
        "Delay and stiffness of the wall": (touching, "delay", delay, "wall_stiffness", walls),
        "Delay and σ, in free motion": (axis, "delay", delay, "sigma", sigma),
        "Delay and σ, on the wall": (touching, "delay", delay, "sigma", sigma),
        "Error of the estimated mass and σ, in free motion": (
            *(axis, "mass_error", np.linspace(-0.9, 4.0, n) * tool, "sigma", sigma),
        ),
        "Rate and stiffness of the wall": (touching, RATE, rate, "wall_stiffness", walls),
    }
    progress, found = stage("Maps"), {}
    for done, (title, (base, *grid)) in enumerate(wanted.items()):
        found[title] = {grip: stability_map(held_by(base, grip), sampling, *grid) for grip in GRIPS}
        progress((done + 1) / len(wanted))
    return found


def _plain(value: Any) -> Any:
    """What JSON can say: no numpy, and None for what is not finite."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
