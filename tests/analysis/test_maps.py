"""Stability maps: cells and boundaries against eigenvalues, and known features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from registers import growth_rate

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.cut_loop import cut_loop
from drake_teleop.lab.analysis.maps import StabilityMap, force_distortion, stability_map
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import Sampling
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES

JR3 = Sampling(low_pass_hz=500.0)
MEDIUM = OneAxis()
LIGHT = replace(
    MEDIUM,
    hand_mass=GRIP_IMPEDANCES["light"].mass,
    hand_damping=GRIP_IMPEDANCES["light"].damping,
    hand_stiffness=GRIP_IMPEDANCES["light"].stiffness,
)
FREE = {"wall_stiffness": 0.0, "wall_damping": 0.0}
SLOW_HAND = Sampling(hand_hz=500.0, low_pass_hz=500.0)
WHOLE = np.arange(0, 120, 4) * 2e-3  # whole periods of any hand here, in one direction [s]

MAPS = {
    "delay and stiffness": (
        MEDIUM, JR3, "delay", WHOLE[:12], "wall_stiffness", np.geomspace(300.0, 1e5, 30),
    ),
    "sigma and delay, contact": (
        MEDIUM, Sampling(), "sigma", np.linspace(0.0, 3.0, 30), "delay", WHOLE[:12],
    ),
    "sigma and delay, free": (
        replace(LIGHT, **FREE), SLOW_HAND, "sigma", np.linspace(0.0, 2.0, 30), "delay", WHOLE,
    ),
    "error of phi and sigma": (
        replace(MEDIUM, force_scale=1.0, **FREE), Sampling(),
        "mass_error", np.linspace(-1.0, 1.5, 30), "sigma", np.linspace(0.0, 0.6, 20),
    ),
    "rate and stiffness": (
        replace(MEDIUM, delay=8e-3), Sampling(),
        "rate", np.array([250.0, 500.0, 1000.0, 2000.0]),
        "wall_stiffness", np.geomspace(300.0, 1e5, 30),
    ),
}  # fmt: skip


LONG = "sigma and delay, contact"


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name == LONG)) for name in MAPS],
)
def drawn(request: pytest.FixtureRequest) -> tuple[OneAxis, Sampling, StabilityMap]:
    axis, sampling, *parameters = MAPS[request.param]
    return axis, sampling, stability_map(axis, sampling, *parameters)


def grows(axis: OneAxis, sampling: Sampling, **values: float) -> bool:
    """Return stability by eigenvalues of the closed loop with all registers."""
    rate = values.pop("rate", sampling.hand_hz)
    factor = rate / sampling.hand_hz
    faster = replace(
        sampling,
        hand_hz=rate,
        joint_control_hz=factor * sampling.joint_control_hz,
        sensor_hz=factor * sampling.sensor_hz,
    )
    return growth_rate(replace(axis, **values), faster) > 1e-6


@pytest.mark.slow
def test_cells_agree_with_eigenvalues(drawn) -> None:
    axis, sampling, found = drawn
    assert 0 < found.stable.sum() < found.stable.size
    rng = np.random.default_rng(1)
    for i, j in rng.integers((len(found.y), len(found.x)), size=(6, 2)):
        cell = {found.x_name: found.x[j], found.y_name: found.y[i]}
        assert grows(axis, sampling, **cell) == (found.num_unstable_multipliers[i, j] > 0), cell


@pytest.mark.slow
def test_stability_changes_within_1_percent_of_the_boundary(drawn) -> None:
    """The parameter other than delay varies by 1 %, at whole periods of delay."""
    axis, sampling, found = drawn
    x, y = found.boundary.T
    moved, fixed = (found.y_name, found.x) if found.x_name != "sigma" else (found.x_name, found.y)
    if found.x_name == "mass_error":
        moved, fixed = "mass_error", found.y
    other = y if moved == found.x_name else x
    points = found.boundary[np.isin(other, fixed)]
    assert len(points) > 3
    for point in np.random.default_rng(2).permutation(points)[:6]:
        values = dict(zip((found.x_name, found.y_name), map(float, point), strict=True))
        sides = [
            grows(axis, sampling, **{**values, moved: share * values[moved]})
            for share in (0.99, 1.01)
        ]
        assert sides[0] != sides[1], values


@pytest.mark.parametrize("hertz, rate, within", [(12.0, 2e3, 20.0), (480.0, 1.28e5, 1.0)])
def test_displayed_tool_causes_windows_of_instability_in_free_motion(
    hertz: float, rate: float, within: float
) -> None:
    """Light grip, ideal servo: m s^2 + b s + k + mu s^2 e^(-s RTT) = 0."""
    m, b, k = LIGHT.hand_mass + LIGHT.device_mass, LIGHT.hand_damping, LIGHT.hand_stiffness
    b, mu = b + LIGHT.device_damping, LIGHT.force_scale * LIGHT.tool_mass
    # |k - m w^2 + j b w| = mu w^2; the delays follow from the phase, with whole rotations.
    w = np.sqrt(np.roots([m**2 - mu**2, b**2 - 2 * k * m, k**2]).real)
    phase = np.angle(mu * w**2 / (k - m * w**2 + 1j * b * w))
    windows = np.sort(1e3 * (phase + 2 * np.pi * np.array([[1], [2]])) / w)
    np.testing.assert_allclose(windows, [[190, 339], [497, 789]], atol=1)

    axis = replace(LIGHT, **FREE, position_gain=2 * np.pi * hertz, velocity_gain=12 * np.pi * hertz)
    delays = np.linspace(0.0, 0.4, 200)
    found = stability_map(
        axis, Sampling(rate, rate, 4 * rate), "delay", delays, "sigma", np.array([0.0, 0.5, 1.0])
    )
    assert found.stable[0].all() and found.stable[1].all()
    edges = 2e3 * np.sort(found.boundary[found.boundary[:, 1] == 1.0, 0])
    np.testing.assert_allclose(edges.reshape(2, 2), windows, atol=within)


def test_displayed_tool_increases_the_delay_margin_in_contact() -> None:
    found = stability_map(
        MEDIUM, Sampling(), "delay", np.linspace(0, 0.05, 60), "sigma", np.array([0, 0.25, 0.5, 1])
    )
    margins = [found.boundary[found.boundary[:, 1] == sigma, 0] for sigma in found.y]
    assert [len(margin) for margin in margins] == [1, 1, 1, 1]
    assert (np.diff(np.concatenate(margins)) > 0).all()


@pytest.mark.parametrize("axis", [LIGHT, MEDIUM])
def test_overcompensation_is_bounded_by_the_moving_mass(axis: OneAxis) -> None:
    """(gamma - sigma) dm - sigma m_t < m / (k_f l_p) as servo and sampling become fast."""
    moving = axis.hand_mass + axis.device_mass
    sigma = np.array([0.0, 0.05, 0.1])
    off = []
    for hertz, rate in ((60.0, 1.6e4), (480.0, 1.28e5)):
        fast = replace(
            axis, **FREE, force_scale=0.5, position_scale=2.0,
            position_gain=2 * np.pi * hertz, velocity_gain=12 * np.pi * hertz,
        )  # fmt: skip
        sampling = Sampling(rate, rate, 4 * rate)
        found = stability_map(fast, sampling, "mass_error", np.linspace(0, 1, 50), "sigma", sigma)
        errors = found.boundary[np.isin(found.boundary[:, 1], sigma), 0]
        felt = (1 - sigma) * errors - sigma * axis.tool_mass
        off.append(np.abs(felt / moving - 1).max())
    assert off[0] < 0.05 and off[1] < 0.01


def test_distortion_is_that_of_the_continuous_station_at_high_rates() -> None:
    axis = replace(MEDIUM, sigma=0.5, mass_error=0.4, delay=5e-3, wall_damping=20.0)
    w = 2 * np.pi * np.array([0.5, 4.0])
    s, kv, kp = 1j * w, axis.velocity_gain, axis.position_gain
    Z_e, Z_s = axis.wall_stiffness / s + axis.wall_damping, axis.slave_mass * (s + kv)
    spring = axis.slave_mass * kv * kp / s
    M = axis.sigma * axis.tool_mass + (axis.sigma - axis.gamma) * axis.mass_error
    slave = spring / (spring + Z_s + Z_e)
    displayed = axis.force_scale * (axis.gamma * Z_e + M * s) * slave * np.exp(-2 * s * axis.delay)
    ideal = axis.force_scale * (axis.gamma * Z_e + axis.sigma * axis.tool_mass * s)
    own = (axis.hand_mass + axis.device_mass) * s + axis.hand_damping + axis.device_damping
    own = own + axis.hand_stiffness / s
    expected = np.abs((displayed - ideal) / (own + ideal)).max()
    fast = Sampling(1e5, 1e5, 4e5)
    assert force_distortion(axis, cut_loop(axis, fast), w) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "name, values, words",
    [
        ("stiffness", [1.0, 2.0], "wall_stiffness"),
        ("delay", [2.0, 1.0], "do not increase"),
        ("delay", [], "do not increase"),
        ("delay", [np.nan], "finite"),
        ("delay", [0.0, np.inf], "finite"),
    ],
)
def test_unknown_parameter_or_decreasing_values_raise(
    name: str, values: list[float], words: str
) -> None:
    with pytest.raises(DrakeTeleopError, match=words):
        stability_map(MEDIUM, Sampling(), name, values, "sigma", [0.0, 1.0])
