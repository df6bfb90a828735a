"""Two-port of the station between hand and environment, along one direction.

    [F_h; -V_s] = H [V_m; F_e]

F_h: force of the hand on the device; V_m: its velocity; F_e: force of the slave on the
environment; V_s: its velocity. The station absorbs the power F_h V_m - F_e V_s. Two-ports are
arrays (..., 2, 2), frequencies first; s in rad/s, impedances in N s/m, delays one way in s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.one_axis import (
    Complex,
    OneAxis,
    device_impedance,
    servo_admittance,
    servo_response,
)

if TYPE_CHECKING:
    import control


def two_port(h11: ArrayLike, h12: ArrayLike, h21: ArrayLike, h22: ArrayLike) -> Complex:
    """Return matrices (..., 2, 2) of four entries that broadcast."""
    entries = np.broadcast_arrays(h11, h12, h21, h22)
    stacked = np.stack(entries, axis=-1).astype(complex, copy=False)
    return stacked.reshape(*stacked.shape[:-1], 2, 2)


def entries(H: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """Return the entries h11, h12, h21 and h22 of H."""
    return H[..., 0, 0], H[..., 0, 1], H[..., 1, 0], H[..., 1, 1]


def hybrid(axis: OneAxis, s: Complex, *, servo: tuple[Complex, Complex] | None = None) -> Complex:
    """Return the hybrid matrix H (..., 2, 2) of the position-force station at s [rad/s] (T51).

    `servo` replaces the axis' servo response C/(Z_s + C) and admittance 1/(Z_s + C).
    """
    response, slave_admittance = servo or (servo_response(axis, s), servo_admittance(axis, s))
    delay_factor = np.exp(-s * axis.delay)
    tool = axis.displayed_tool_mass * s
    slave = axis.position_scale * delay_factor * response
    return two_port(
        device_impedance(axis, s) + axis.force_scale * delay_factor * tool * slave,
        axis.force_scale * delay_factor * (axis.gamma - tool * slave_admittance),
        -slave,
        slave_admittance,
    )


def force_velocity_exchange(s: Complex, delay: ArrayLike) -> Complex:
    """Return the hybrid matrix H of a line that delays force and velocity by `delay` [s] (T53)."""
    delay_factor = np.exp(-s * np.asarray(delay))
    return two_port(0.0, delay_factor, -delay_factor, 0.0)


def wave_line(s: Complex, delay: ArrayLike, impedance: ArrayLike) -> Complex:
    """Return the hybrid matrix H of a delay line with wave variables and wave `impedance` (T53)."""
    delay_factor = np.exp(-s * np.asarray(delay))
    tanh = (1 - delay_factor**2) / (1 + delay_factor**2)
    sech = 2 * delay_factor / (1 + delay_factor**2)
    b = np.asarray(impedance)
    return two_port(b * tanh, sech, -sech, tanh / b)


class Channels(NamedTuple):
    """Transfer functions of a four-channel station (Lawrence 1993)."""

    c1: ArrayLike  #: velocity of the master, to the slave
    c2: ArrayLike  #: force of the environment, to the master
    c3: ArrayLike  #: force of the hand, to the slave
    c4: ArrayLike  #: velocity of the slave, to the master
    c5: ArrayLike = 0.0  #: local feedback of the environment's force
    c6: ArrayLike = 0.0  #: local feedback of the hand's force


def transparent_channels(
    master: Complex, slave: Complex, c5: ArrayLike = 0.0, c6: ArrayLike = 0.0
) -> Channels:
    """Return the channels that make a station without delay transparent (T39).

    `master`, `slave`: impedances with local control; `c5`, `c6`: local force feedback, above -1.
    """
    return Channels(slave, 1 + np.asarray(c6), 1 + np.asarray(c5), -master, c5, c6)


def four_channel(
    s: Complex, master: Complex, slave: Complex, channels: Channels, delay: ArrayLike = 0.0
) -> Complex:
    """Return the hybrid matrix H of the four-channel station; C1 to C4 are delayed (T39).

    `master` and `slave` are impedances with local control.
    """
    delay_factor = np.exp(-s * np.asarray(delay))
    c1, c2, c3, c4 = (delay_factor * np.asarray(c) for c in channels[:4])
    at_slave, at_master = 1 + np.asarray(channels.c5), 1 + np.asarray(channels.c6)
    determinant = at_master * slave - c3 * c4
    return (
        two_port(
            slave * master + c1 * c4,
            slave * c2 - c4 * at_slave,
            -c3 * master - at_master * c1,
            at_master * at_slave - c3 * c2,
        )
        / determinant[..., None, None]
    )


def impedance(H: Complex) -> Complex:
    """Return the impedance matrix Z of [F_h; F_e] = Z [V_m; -V_s]; raise an error if h22 is 0.

    Applied to Z, the function returns H.
    """
    h11, h12, h21, h22 = entries(H)
    _require_nonzero(h22, "impedance", "h22")
    return two_port(h11 - h12 * h21 / h22, h12 / h22, -h21 / h22, 1 / h22)


def admittance(H: Complex) -> Complex:
    """Return the admittance matrix Y of [V_m; -V_s] = Y [F_h; F_e]; raise an error if h11 is 0.

    Applied to Y, the function returns H.
    """
    h11, h12, h21, h22 = entries(H)
    _require_nonzero(h11, "admittance", "h11")
    return two_port(1 / h11, -h12 / h11, h21 / h11, h22 - h12 * h21 / h11)


def chain(H: Complex) -> Complex:
    """Return the chain matrix A of [F_h; V_m] = A [F_e; V_s]; raise an error if h21 is 0.

    The chain matrix of two-ports in series is the product of theirs.
    """
    h11, h12, h21, h22 = entries(H)
    _require_nonzero(h21, "chain", "h21")
    return two_port(h12 - h11 * h22 / h21, -h11 / h21, -h22 / h21, -1 / h21)


def scattering(H: Complex, reference: tuple[ArrayLike, ArrayLike] = (1.0, 1.0)) -> Complex:
    """Return the scattering matrix S, which maps the waves F + b V to F - b V (slave: V = -V_s).

    `reference`: b [N s/m] of both ports; it does not change whether the norm of S exceeds 1.
    """
    h11, h12, h21, h22 = entries(H)
    b1, b2 = np.asarray(reference[0]), np.asarray(reference[1])
    ratio = np.sqrt(b2 / b1)
    h11, h12, h21, h22 = h11 / b1, h12 * ratio, h21 * ratio, h22 * b2
    determinant = (1 + h11) * (1 + h22) - h12 * h21
    return (
        two_port(
            (h11 - 1) * (h22 + 1) - h12 * h21,
            2 * h12,
            -2 * h21,
            (1 + h11) * (1 - h22) + h12 * h21,
        )
        / determinant[..., None, None]
    )


def reference_impedances(axis: OneAxis) -> tuple[float, float]:
    """Return the reference impedances b [N s/m] of both ports for `scattering`.

    Master: hand damping; slave: hand damping / (k_f l_p). Scales of 0 raise DrakeTeleopError.
    """
    scale = axis.force_scale * axis.position_scale
    if scale == 0:
        raise DrakeTeleopError(
            "reference impedances need scales above 0",
            where="force_scale, translation_scale",
            remedy="set both above 0",
        )
    return axis.hand_damping, axis.hand_damping / scale


def power_ratio(axis: OneAxis) -> float:
    """Return the ratio k_f gamma / l_p of power at the hand to power at the slave."""
    return axis.force_scale * axis.gamma / axis.position_scale


def power_scaled(H: Complex, ratio: ArrayLike) -> Complex:
    """Return H with the slave's power multiplied by `ratio`; raise an error unless it is positive.

    With `power_ratio` this removes the gain or loss of power by the scales.
    """
    root = np.sqrt(np.asarray(ratio, dtype=float))
    if not np.all(root > 0):
        raise DrakeTeleopError("ratio of powers must be positive", where="ratio")
    h11, h12, h21, h22 = entries(H)
    return two_port(h11, h12 / root, h21 * root, h22)


def absorb(H: Complex, hand: ArrayLike = 0.0, environment: ArrayLike = 0.0) -> Complex:
    """Return H that includes parallel impedances [N s/m] of the hand and of the environment."""
    h11, h12, h21, h22 = entries(H)
    z = np.asarray(environment)
    reduction = 1 / (1 + h22 * z)
    felt = h11 + np.asarray(hand) - h12 * h21 * z * reduction
    return two_port(felt, h12 * reduction, h21 * reduction, h22 * reduction)


def transmitted_impedance(H: Complex, environment: ArrayLike) -> Complex:
    """Return the impedance Z_to displayed to the hand for that of the environment [N s/m] (T52)."""
    return absorb(H, environment=environment)[..., 0, 0]


def transfer_function(axis: OneAxis) -> control.TransferFunction:
    """Return the hybrid matrix H without its delay as a python-control object.

    h11 and h12 have no state space if the device has mass, or if the tool mass is displayed behind
    an ideal servo.
    """
    import control

    kv, kp = (0.0, 1.0) if axis.ideal_servo else (axis.velocity_gain, axis.position_gain)
    # An ideal servo has response 1 and admittance 0.
    servo = np.array([1.0]) if axis.ideal_servo else np.array([1.0, kv, kv * kp])
    response = 1.0 if axis.ideal_servo else kv * kp
    slave_admittance = np.array([0.0] if axis.ideal_servo else [1 / axis.slave_mass, 0.0])
    device = np.array([axis.device_mass, axis.device_damping])
    tool = np.array([axis.displayed_tool_mass, 0.0])
    felt = axis.force_scale * axis.position_scale * response
    h11 = np.polyadd(np.polymul(device, servo), felt * tool)
    h12 = axis.force_scale * np.polysub(axis.gamma * servo, np.polymul(tool, slave_admittance))
    h21 = np.array([-axis.position_scale * response])
    return control.tf([[h11, h12], [h21, slave_admittance]], [[servo, servo], [servo, servo]])


def to_frd(H: Complex, omega: NDArray[np.float64]) -> control.FRD:
    """Return a two-port (n, 2, 2) or impedance (n,) at omega (n,) [rad/s] as `control.FRD`."""
    import control

    return control.FRD(H if H.ndim == 1 else np.moveaxis(H, 0, -1), omega)


def from_control(system: control.lti.LTI, omega: NDArray[np.float64] | None = None) -> Complex:
    """Return the response of a python-control object: (n, outputs, inputs), or (n,) if scalar.

    `omega` (n,) [rad/s] is optional for an FRD; otherwise its absence raises DrakeTeleopError.
    """
    if omega is None:
        omega = getattr(system, "omega", None)
    if omega is None:
        raise DrakeTeleopError("no frequencies", where="omega", remedy="pass omega [rad/s]")
    sampled = system.isdtime(strict=True)
    points = np.exp(1j * omega * system.dt) if sampled else 1j * omega
    response = np.moveaxis(system(points, squeeze=False), -1, 0)
    return response[:, 0, 0] if response.shape[1:] == (1, 1) else response


def _require_nonzero(entry: Complex, matrix: str, name: str) -> None:
    if not np.all(entry):
        raise DrakeTeleopError(
            f"no {matrix} matrix where {name} is zero", remedy="use another form of the two-port"
        )
