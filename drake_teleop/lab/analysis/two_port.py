"""The station as a two-port between hand and environment, along one direction.

    [F_h; -V_s] = H [V_m; F_e]

with the force F_h of the hand on the device, the velocity V_m of the device, the force F_e of the
slave on the environment and the slave's velocity V_s, so that F_h V_m - F_e V_s is the power that
the station takes up. A two-port is an array (..., 2, 2) over whatever its entries were computed
for, frequencies first. A delay is e^(-s T) throughout, never a rational approximation. Parameters
of `OneAxis` may be arrays that broadcast with s.
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
    """The matrices (..., 2, 2) of four entries that broadcast."""
    entries = np.broadcast_arrays(h11, h12, h21, h22)
    stacked = np.stack(entries, axis=-1).astype(complex, copy=False)
    return stacked.reshape(*stacked.shape[:-1], 2, 2)


def entries(H: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """h11, h12, h21, h22, each (...,)."""
    return H[..., 0, 0], H[..., 0, 1], H[..., 1, 0], H[..., 1, 1]


def hybrid(axis: OneAxis, s: Complex, *, servo: tuple[Complex, Complex] | None = None) -> Complex:
    """H of the position-force station, (..., 2, 2).

    The device's motion is the slave's command, l_p e^(-sT) V_m; what the elimination leaves of the
    wrist's force, gamma F_e + M s V_s, is felt times k_f e^(-sT).

    Args:
        axis: the station; the hand and the environment are not part of it.
        s: [rad/s].
        servo: C/(Z_s + C) and 1/(Z_s + C) at s, of another servo than the axis's own.
    """
    response, give = servo or (servo_response(axis, s), servo_admittance(axis, s))
    late = np.exp(-s * axis.delay)
    tool = axis.felt_tool_mass * s
    slave = axis.position_scale * late * response
    return two_port(
        device_impedance(axis, s) + axis.force_scale * late * tool * slave,
        axis.force_scale * late * (axis.gamma - tool * give),
        -slave,
        give,
    )


def force_velocity_exchange(s: Complex, delay: ArrayLike) -> Complex:
    """Force and velocity sent as they are, each arriving `delay` [s] later."""
    late = np.exp(-s * np.asarray(delay))
    return two_port(0.0, late, -late, 0.0)


def wave_line(s: Complex, delay: ArrayLike, impedance: ArrayLike) -> Complex:
    """A delay between wave variables: u = (b V + F) / sqrt(2 b) forth, w = (b V - F) / ... back.

    Args:
        s: [rad/s].
        delay: one way [s].
        impedance: b of the line [N s/m].
    """
    late = np.exp(-s * np.asarray(delay))
    tanh, sech = (1 - late**2) / (1 + late**2), 2 * late / (1 + late**2)
    b = np.asarray(impedance)
    return two_port(b * tanh, sech, -sech, tanh / b)


class Channels(NamedTuple):
    """C1 to C6 of a four-channel station (Lawrence 1993), numbers or arrays over s."""

    c1: ArrayLike  #: master's velocity to slave
    c2: ArrayLike  #: force of the environment to master
    c3: ArrayLike  #: force of the hand to slave
    c4: ArrayLike  #: slave's velocity to master
    c5: ArrayLike = 0.0  #: force of the environment at the slave itself
    c6: ArrayLike = 0.0  #: force of the hand at the master itself


def transparent_channels(
    master: Complex, slave: Complex, c5: ArrayLike = 0.0, c6: ArrayLike = 0.0
) -> Channels:
    """The channels that make a station without delay ideal: what is felt is the environment.

    Args:
        master: Z_cm = Z_m + C_m, device and its local control [N s/m].
        slave: Z_cs = Z_s + C_s.
        c5, c6: local force feedback, greater than -1.
    """
    return Channels(slave, 1 + np.asarray(c6), 1 + np.asarray(c5), -master, c5, c6)


def four_channel(
    s: Complex, master: Complex, slave: Complex, channels: Channels, delay: ArrayLike = 0.0
) -> Complex:
    """H of the four-channel station.

        (1 + C6) F_h = Z_cm V_m + C4 e^(-sT) V_s + C2 e^(-sT) F_e
        Z_cs V_s = C1 e^(-sT) V_m + C3 e^(-sT) F_h - (1 + C5) F_e

    Args:
        s: [rad/s].
        master, slave: Z_cm, Z_cs, see `transparent_channels`.
        channels: C1 to C6.
        delay: one way [s].
    """
    late = np.exp(-s * np.asarray(delay))
    c1, c2, c3, c4 = (late * np.asarray(c) for c in channels[:4])
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
    """Z of [F_h; F_e] = Z [V_m; -V_s]; the same formula makes H of Z.

    Raises:
        DrakeTeleopError: if h22 is 0 somewhere, as with an ideal servo.
    """
    h11, h12, h21, h22 = entries(H)
    _must_not_vanish(h22, "impedance", "h22")
    return two_port(h11 - h12 * h21 / h22, h12 / h22, -h21 / h22, 1 / h22)


def admittance(H: Complex) -> Complex:
    """Y of [V_m; -V_s] = Y [F_h; F_e]; the same formula makes H of Y.

    Raises:
        DrakeTeleopError: if h11 is 0 somewhere.
    """
    h11, h12, h21, h22 = entries(H)
    _must_not_vanish(h11, "admittance", "h11")
    return two_port(1 / h11, -h12 / h11, h21 / h11, h22 - h12 * h21 / h11)


def chain(H: Complex) -> Complex:
    """A of [F_h; V_m] = A [F_e; V_s]: the chain of two stations is the product of theirs.

    Raises:
        DrakeTeleopError: if h21 is 0 somewhere: the slave does not follow.
    """
    h11, h12, h21, h22 = entries(H)
    _must_not_vanish(h21, "chain", "h21")
    return two_port(h12 - h11 * h22 / h21, -h11 / h21, -h22 / h21, -1 / h21)


def hybrid_of_chain(A: Complex) -> Complex:
    """H of the chain matrix A.

    Raises:
        DrakeTeleopError: if its last entry is 0 somewhere.
    """
    a11, a12, a21, a22 = entries(A)
    _must_not_vanish(a22, "hybrid", "the chain's last entry")
    return two_port(a12 / a22, a11 - a12 * a21 / a22, -1 / a22, a21 / a22)


def scattering(H: Complex, reference: tuple[ArrayLike, ArrayLike] = (1.0, 1.0)) -> Complex:
    """S from the waves F + b V to the waves F - b V of the ports, with -V_s at the slave's.

    Args:
        H: (..., 2, 2).
        reference: impedances b of the two ports [N s/m], which broadcast with the entries. Whether
            the norm of S exceeds 1 does not depend on them, by how much does.
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
    """For `scattering`: the damping of the hand, and what it is seen through the scales [N s/m].

    Raises:
        DrakeTeleopError: if one of the scales is 0.
    """
    scale = axis.force_scale * axis.position_scale
    if scale == 0:
        raise DrakeTeleopError(
            "nothing is seen through a scale of 0",
            where="force_scale, translation_scale",
            remedy="set both above 0",
        )
    return axis.hand_damping, axis.hand_damping / scale


def power_ratio(axis: OneAxis) -> float:
    """k_f gamma / l_p: how much of the slave's power its scales let through to the hand."""
    return axis.force_scale * axis.gamma / axis.position_scale


def power_scaled(H: Complex, ratio: ArrayLike) -> Complex:
    """H with the slave's power counted `ratio` times.

    A station that scales motion or force takes up or gives away power for ever by the scales
    alone, however it is built; with `ratio` = k_f gamma / l_p that is not held against it.

    Raises:
        DrakeTeleopError: if the ratio is not positive.
    """
    root = np.sqrt(np.asarray(ratio, dtype=float))
    if not np.all(root > 0):
        raise DrakeTeleopError("ratio of powers must be positive", where="ratio")
    h11, h12, h21, h22 = entries(H)
    return two_port(h11, h12 / root, h21 * root, h22)


def absorb(H: Complex, hand: ArrayLike = 0.0, environment: ArrayLike = 0.0) -> Complex:
    """H with a part of the hand's and of the environment's impedance taken into the station.

    What is left outside is Z_h - `hand` and Z_e - `environment`.

    Args:
        H: (..., 2, 2).
        hand, environment: [N s/m], (...,).
    """
    h11, h12, h21, h22 = entries(H)
    z = np.asarray(environment)
    give = 1 / (1 + h22 * z)
    felt = h11 + np.asarray(hand) - h12 * h21 * z * give
    return two_port(felt, h12 * give, h21 * give, h22 * give)


def transmitted_impedance(H: Complex, environment: ArrayLike) -> Complex:
    """Z_to = h11 - h12 h21 Z_e / (1 + h22 Z_e) [N s/m], what the hand feels of Z_e."""
    return absorb(H, environment=environment)[..., 0, 0]


def transfer_function(axis: OneAxis) -> control.TransferFunction:
    """H without its delay as a python-control object, 2 inputs and 2 outputs.

    h11 and h12 are improper where the device has mass or the tool is felt at an ideal servo: they
    have no state space.
    """
    import control

    kv, kp = (0.0, 1.0) if axis.ideal_servo else (axis.velocity_gain, axis.position_gain)
    # Of an ideal servo the response is 1 and the admittance 0.
    servo = np.array([1.0]) if axis.ideal_servo else np.array([1.0, kv, kv * kp])
    response = 1.0 if axis.ideal_servo else kv * kp
    give = np.array([0.0] if axis.ideal_servo else [1 / axis.slave_mass, 0.0])
    device = np.array([axis.device_mass, axis.device_damping])
    tool = np.array([axis.felt_tool_mass, 0.0])
    felt = axis.force_scale * axis.position_scale * response
    h11 = np.polyadd(np.polymul(device, servo), felt * tool)
    h12 = axis.force_scale * np.polysub(axis.gamma * servo, np.polymul(tool, give))
    h21 = np.array([-axis.position_scale * response])
    return control.tf([[h11, h12], [h21, give]], [[servo, servo], [servo, servo]])


def to_frd(H: Complex, omega: NDArray[np.float64]) -> control.FRD:
    """A response over frequency as a python-control object.

    Args:
        H: (n, 2, 2) two-port or (n,) impedance.
        omega: (n,) [rad/s].
    """
    import control

    return control.FRD(H if H.ndim == 1 else np.moveaxis(H, 0, -1), omega)


def from_control(system: control.lti.LTI, omega: NDArray[np.float64] | None = None) -> Complex:
    """The response of a python-control object: (n, outputs, inputs), or (n,) of a single one.

    Args:
        system: FRD, TransferFunction or StateSpace, continuous or sampled.
        omega: (n,) [rad/s]; None takes those that an FRD has.

    Raises:
        DrakeTeleopError: if there are no frequencies.
    """
    if omega is None:
        omega = getattr(system, "omega", None)
    if omega is None:
        raise DrakeTeleopError("no frequencies", where="omega", remedy="say at which to evaluate")
    sampled = system.isdtime(strict=True)
    points = np.exp(1j * omega * system.dt) if sampled else 1j * omega
    response = np.moveaxis(system(points, squeeze=False), -1, 0)
    return response[:, 0, 0] if response.shape[1:] == (1, 1) else response


def _must_not_vanish(entry: Complex, matrix: str, name: str) -> None:
    if not np.all(entry):
        raise DrakeTeleopError(
            f"no {matrix} matrix where {name} is zero", remedy="use another form of the two-port"
        )
