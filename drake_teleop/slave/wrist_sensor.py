"""The wrist sensor: force, torque and acceleration in one housing, and the arm's encoders.

The numbers of the default sensor are those of the JR3 85M35A3-I40-D 200N12 of the paper (sources
in the README of the models). The truth is rigid-body mechanics: the wrench that the sensor exerts
on the tool is V phi of the tool minus what the environment exerts on it (Eqs. 1, 2), the
acceleration is the specific force a - g of the origin of S. Each sample then passes

    offset + noise -> saturation -> quantisation (converter) -> low-pass filter (digital)

The angular velocity is not measured by the JR3: it is the difference of two encoder readings
through the arm's Jacobian, put through the same filter so that it stays aligned with the rest.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydrake.common import RandomDistribution
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)
from pydrake.systems.primitives import Demultiplexer, RandomSource

from drake_teleop.environment.contact import contact_wrench
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.quantities import quantity
from drake_teleop.slave.arm import MOTION_SIZE, ArmModel, sensor_motion

_CHANNELS = 15
_SAMPLE = 16
#: Samples that share one event of the noise source: an event at 8 kHz costs 5 us, mostly its own.
NOISE_BLOCK = 32
_SECTIONS = 2  # second-order sections of the fourth-order low-pass
_FILTER = _CHANNELS * _SECTIONS * 2


def sample_parts(num_joints: int) -> dict[str, int]:
    """The parts of a sample, in the order of the output port `sample`, with their sizes."""
    return {
        "measured_wrench_S": 6,
        "specific_force_S": 3,
        "angular_velocity_S": 3,
        "angular_acceleration_S": 3,
        "saturated": 1,
        "joint_position": num_joints,
    }


@dataclass
class WristSensorConfig:
    """A sampled force/torque and acceleration sensor; the defaults are the paper's JR3."""

    ideal: bool = False
    """The truth at the sampling instant: no noise, offset, quantisation, filter or range."""
    bandwidth_hz: float = quantity(500.0, "Hz", 1.0, 1e5, "4th-order Butterworth low-pass")
    force_noise: float = quantity(0.25, "N", 0.0, 100.0, "1 sigma, full band before the filter")
    torque_noise: float = quantity(0.012, "N m", 0.0, 10.0, "1 sigma, full band before the filter")
    acceleration_noise: float = quantity(0.06, "m/s^2", 0.0, 100.0, "1 sigma, full band")
    angular_acceleration_noise: float = quantity(1.5, "rad/s^2", 0.0, 1e3, "1 sigma, full band")
    force_range: list[float] = quantity([200.0, 200.0, 400.0], "N", 1.0, 1e5, "fx, fy, fz")
    torque_range: list[float] = quantity([12.0, 12.0, 12.0], "N m", 0.01, 1e4, "about So")
    acceleration_range: float = quantity(50.0, "m/s^2", 1.0, 1e4, "specific force")
    angular_acceleration_range: float = quantity(500.0, "rad/s^2", 1.0, 1e5, "each axis")
    resolution: float = quantity(2.5e-4, "1", 0.0, 0.1, "quantum as a fraction of the range")
    offset: list[float] = quantity(
        [6.2, -3.9, 8.1, 0.31, -0.42, 0.12], "N, N m", -100.0, 100.0, "offset, Eq. (7)"
    )
    encoder_resolution: float = quantity(1.745e-5, "rad", 0.0, 0.1, "resolver step, 0.001 deg")

    def noise_std(self) -> NDArray[np.float64]:
        """The 12 standard deviations [N, N m, m/s^2, rad/s^2] before the filter."""
        return np.repeat(
            [
                self.force_noise,
                self.torque_noise,
                self.acceleration_noise,
                self.angular_acceleration_noise,
            ],
            3,
        )

    def wrench_std(self) -> NDArray[np.float64]:
        """(6,) weights for an estimator: noise and quantisation, never quite zero [N, N m]."""
        quantum = self.resolution * self.ranges()[:6]
        return np.maximum(np.hypot(self.noise_std()[:6], quantum / np.sqrt(12)), 1e-6)

    def motion_std(self) -> NDArray[np.float64]:
        """(9,) noise and quantisation of s [m/s^2], omega [rad/s], alpha [rad/s^2].

        Before the filter, as the wrench's. Nothing for omega: the rounding of the encoders is
        differentiated, and the filter takes its high frequencies away; what is left is small.
        """
        quantum = self.resolution * self.ranges()[6:]
        std = np.hypot(self.noise_std()[6:], quantum / np.sqrt(12))
        return np.concatenate([std[:3], np.zeros(3), std[3:]])

    def ranges(self) -> NDArray[np.float64]:
        """The 12 ranges in the order of the noise."""
        return np.concatenate(
            [
                self.force_range,
                self.torque_range,
                np.full(3, self.acceleration_range),
                np.full(3, self.angular_acceleration_range),
            ]
        )


def butterworth_sections(cutoff_hz: float, rate_hz: float) -> NDArray[np.float64]:
    """Fourth-order Butterworth low-pass as two second-order sections, bilinear, prewarped.

    Args:
        cutoff_hz: -3 dB frequency [Hz], below half the rate.
        rate_hz: sampling rate [Hz].

    Returns:
        (2, 5) rows [b0, b1, b2, a1, a2], each of unit gain at zero frequency.
    """
    warped = np.tan(np.pi * cutoff_hz / rate_hz)
    sections = np.empty((_SECTIONS, 5))
    for row, angle in enumerate((np.pi / 8, 3 * np.pi / 8)):
        damping = 2 * np.cos(angle) * warped
        a0 = 1 + damping + warped**2
        sections[row] = (
            warped**2 / a0,
            2 * warped**2 / a0,
            warped**2 / a0,
            2 * (warped**2 - 1) / a0,
            (1 - damping + warped**2) / a0,
        )
    return sections


@njit(cache=True)
def true_sample(arm, phi, q, v, vdot, contact_W, motion, out):
    """Writes [f, tau, s, omega, alpha] of S into `out` (15,); `motion` (21,) is scratch.

    The wrench is Eqs. (1)-(2) minus `contact_W` (6,), the wrench of the environment on the tool
    about the world's origin, in W.
    """
    sensor_motion(arm, q, v, vdot, motion)
    out[6:15] = motion[:9]
    non_contact_wrench_into(out[6:9], out[9:12], out[12:15], phi, out[:6])
    # The contact wrench is about the world's origin; about So its moment is tau - p_WS x f.
    f, tau, p = contact_W[:3], contact_W[3:], motion[9:12]
    tx = tau[0] - (p[1] * f[2] - p[2] * f[1])
    ty = tau[1] - (p[2] * f[0] - p[0] * f[2])
    tz = tau[2] - (p[0] * f[1] - p[1] * f[0])
    for i in range(3):  # the columns of R_WS are the axes of S
        x, y, z = motion[12 + i], motion[15 + i], motion[18 + i]
        out[i] -= x * f[0] + y * f[1] + z * f[2]
        out[3 + i] -= x * tx + y * ty + z * tz


@njit(cache=True)
def _convert(truth, offset, noise, noise_std, limits, resolution, out):
    """The converter's 12 channels; returns 1.0 if one of them is saturated."""
    saturated = 0.0
    for i in range(12):
        value = truth[i if i < 9 else i + 3] + noise_std[i] * noise[i]
        if i < 6:
            value += offset[i]
        if abs(value) >= limits[i]:
            value = np.copysign(limits[i], value)
            saturated = 1.0
        quantum = resolution * limits[i]
        if quantum > 0.0:
            value = quantum * np.rint(value / quantum)
        out[i if i < 9 else i + 3] = value
    return saturated


@njit(cache=True)
def _low_pass(sections, raw, memory, out):
    """Transposed direct form II, channel by channel; `memory` (15, 2, 2) is updated."""
    for channel in range(raw.shape[0]):
        value = raw[channel]
        for k in range(sections.shape[0]):
            filtered = sections[k, 0] * value + memory[channel, k, 0]
            memory[channel, k, 0] = (
                sections[k, 1] * value - sections[k, 3] * filtered + memory[channel, k, 1]
            )
            memory[channel, k, 1] = sections[k, 2] * value - sections[k, 4] * filtered
            value = filtered
        out[channel] = value


@njit(cache=True)
def _settle(sections, raw, memory):
    """Puts the filter's memory where it would be after a long time at `raw`."""
    for channel in range(raw.shape[0]):
        for k in range(sections.shape[0]):
            value = raw[channel]
            memory[channel, k, 1] = (sections[k, 2] - sections[k, 4]) * value
            memory[channel, k, 0] = (
                sections[k, 1] - sections[k, 3] + sections[k, 2] - sections[k, 4]
            ) * value


@njit(cache=True)
def _angular_velocity_from_encoders(arm, q, resolution, period, last_q, work, out):
    """omega_S from two successive encoder readings; `last_q` becomes this reading."""
    n = q.shape[0]
    velocity, none, motion = work[:n], work[n : 2 * n], work[2 * n :]
    for i in range(n):
        reading = resolution * np.rint(q[i] / resolution) if resolution > 0.0 else q[i]
        velocity[i] = (reading - last_q[i]) / period
        last_q[i] = reading
        none[i] = 0.0
    sensor_motion(arm, last_q, velocity, none, motion)
    out[:] = motion[3:6]


@njit(cache=True)
def sample_into(arm, phi, state, vdot, contact_W, constants, memory, work, sample):
    """One sample of the sensor; `memory` and `sample` (16 + n,) are updated.

    `state` is [q; v]; `constants` comes from `pack_constants`; `memory` is [samples taken, last
    encoder readings (n), filter (15 x 2 x 2), the noise of this block of samples (32 x 12)];
    `work` is scratch.
    """
    n = vdot.shape[0]
    q, v = state[:n], state[n:]
    offset, noise_std, limits = constants[:6], constants[6:18], constants[18:30]
    sections = constants[30:40].reshape(_SECTIONS, 5)
    resolution, encoder_resolution, period = constants[40], constants[41], constants[42]
    last_q = memory[1 : 1 + n]
    filter_memory = memory[1 + n : 1 + n + _FILTER].reshape(_CHANNELS, _SECTIONS, 2)
    first = 1 + n + _FILTER + 12 * (int(memory[0]) % NOISE_BLOCK)
    noise = memory[first : first + 12]
    truth, raw, rest = work[:15], work[15:30], work[30 : 30 + 2 * n + MOTION_SIZE]
    true_sample(arm, phi, q, v, vdot, contact_W, rest[:MOTION_SIZE], truth)
    saturated = _convert(truth, offset, noise, noise_std, limits, resolution, raw)
    starts = memory[0] == 0.0
    if starts:
        last_q[:] = q - period * v
    _angular_velocity_from_encoders(arm, q, encoder_resolution, period, last_q, rest, raw[9:12])
    if starts:
        _settle(sections, raw, filter_memory)
    memory[0] += 1.0
    _low_pass(sections, raw, filter_memory, sample[:15])
    sample[15] = saturated
    sample[16:] = last_q


def pack_constants(config: WristSensorConfig, period: float) -> NDArray[np.float64]:
    """What `sample_into` needs to know, in one array: passing ten costs a microsecond."""
    return np.concatenate(
        [
            config.offset,
            config.noise_std(),
            config.ranges(),
            butterworth_sections(config.bandwidth_hz, 1 / period).ravel(),
            [config.resolution, config.encoder_resolution, period],
        ]
    )


def sample_at_rest(arm: ArmModel, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The true sample (16 + n,) of the arm that rests at q (n,) [rad]: what stands before t = 0."""
    sample, still = np.zeros(_SAMPLE + len(q)), np.zeros(len(q))
    touching, motion = np.zeros(6), np.zeros(MOTION_SIZE)
    true_sample(arm.table, arm.phi_load, q, still, still, touching, motion, sample[:15])
    sample[16:] = q
    return sample


class WristSensor(LeafSystem):
    """Samples force, torque, acceleration and angular velocity of S at the sensor's rate.

    .. pydrake_system::

        name: WristSensor
        input_ports:
        - slave_state: [q; v] of the arm
        - slave_acceleration: vdot of the arm
        - noise: 12 standard normal numbers for each of NOISE_BLOCK samples
        - contact_results: the plant's (only with `contact`)
        output_ports:
        - sample: the parts of `sample_parts`, one after the other

    Args:
        arm: kinematics up to S, and the tool's true inertial parameters as its load (the plant's,
            not an estimate: this is the physics).
        tool: index of the tool's body in the plant.
        config: the sensor.
        period: sampling period [s].
        q_start: (n,) where the arm rests before the first sample [rad].
        contact: whether there is anything to touch.
    """

    def __init__(
        self,
        arm: ArmModel,
        tool: BodyIndex,
        config: WristSensorConfig,
        period: float,
        q_start: NDArray[np.float64],
        *,
        contact: bool,
    ) -> None:
        super().__init__()
        n = arm.num_joints
        self._arm, self._phi, self._tool = arm.table, arm.phi_load, tool
        self._constants = pack_constants(config, period)
        self._work, self._contact_W = np.zeros(30 + 2 * n + MOTION_SIZE), np.zeros(6)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        self._acceleration = self.DeclareVectorInputPort("slave_acceleration", n)
        self._noise = self.DeclareVectorInputPort("noise", 12 * NOISE_BLOCK)
        self._contact = None
        if contact:
            results = Value(ContactResults())
            self._contact = self.DeclareAbstractInputPort("contact_results", results)
        first = sample_at_rest(arm, q_start)
        first[:6] += config.offset
        self.DeclareStateOutputPort("sample", self.DeclareDiscreteState(first))
        self.DeclareDiscreteState(1 + n + _FILTER + 12 * NOISE_BLOCK)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    @property
    def offset(self) -> NDArray[np.float64]:
        """(6,) of force and torque [N, N m], a view: an offset may drift during a simulation."""
        return self._constants[:6]

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        memory = discrete_state.get_mutable_value(1)
        if memory[0] % NOISE_BLOCK == 0:
            memory[-12 * NOISE_BLOCK :] = self._noise.Eval(context)
        if self._contact is not None:
            contact_wrench(self._contact.Eval(context), self._tool, self._contact_W)
        sample_into(
            self._arm,
            self._phi,
            self._state.Eval(context),
            self._acceleration.Eval(context),
            self._contact_W,
            self._constants,
            memory,
            self._work,
            discrete_state.get_mutable_value(0),
        )


class IdealWristSensor(LeafSystem):
    """The truth, sampled: the wrench is the plant's own reaction force in the sensor's joint.

    .. pydrake_system::

        name: IdealWristSensor
        input_ports:
        - slave_state: [q; v] of the arm
        - slave_acceleration: vdot of the arm
        - reaction_forces: the plant's
        output_ports:
        - sample: the parts of `sample_parts`, one after the other

    Args:
        arm: kinematics up to S.
        plant: the plant, with the joint "sensor_weld" between S and the tool.
        period: sampling period [s].
        q_start: (n,) where the arm rests before the first sample [rad].
    """

    def __init__(
        self, arm: ArmModel, plant: MultibodyPlant, period: float, q_start: NDArray[np.float64]
    ) -> None:
        super().__init__()
        n = arm.num_joints
        self._arm, self._n, self._motion = arm.table, n, np.zeros(MOTION_SIZE)
        weld = plant.GetJointByName("sensor_weld")
        self._joint = list(plant.GetJointIndices()).index(weld.index())
        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        self._acceleration = self.DeclareVectorInputPort("slave_acceleration", n)
        forces = plant.get_reaction_forces_output_port().Allocate()
        self._reaction = self.DeclareAbstractInputPort("reaction_forces", forces)
        first = self.DeclareDiscreteState(sample_at_rest(arm, q_start))
        self.DeclareStateOutputPort("sample", first)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        sample, state = discrete_state.get_mutable_value(0), self._state.Eval(context)
        q, v = state[: self._n], state[self._n :]
        # On the child, the tool, in its frame, which is S: the sign of Eq. (1).
        F_Tool_S = self._reaction.Eval(context)[self._joint]
        sensor_motion(self._arm, q, v, self._acceleration.Eval(context), self._motion)
        sample[:3], sample[3:6] = F_Tool_S.translational(), F_Tool_S.rotational()
        sample[6:15], sample[16:] = self._motion[:9], q


def AddWristSensor(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    arm: ArmModel,
    config: WristSensorConfig,
    period: float,
    q_start: NDArray[np.float64],
    *,
    contact: bool,
) -> None:
    """Adds "wrist_sensor", its noise, and "sample_parts" with a port for every part of a sample.

    Args:
        builder: the diagram that holds the plant.
        plant: the plant, with the body "tool" on the joint "sensor_weld".
        arm: kinematics up to S, and the tool as its load.
        config: the sensor.
        period: sampling period [s].
        q_start: (n,) where the arm rests before the first sample [rad].
        contact: whether there is anything to touch.
    """
    sensor: LeafSystem
    if config.ideal:
        sensor = IdealWristSensor(arm, plant, period, q_start)
        builder.AddNamedSystem("wrist_sensor", sensor)
        builder.Connect(
            plant.get_reaction_forces_output_port(), sensor.GetInputPort("reaction_forces")
        )
    else:
        tool = plant.GetBodyByName("tool").index()
        sensor = WristSensor(arm, tool, config, period, q_start, contact=contact)
        builder.AddNamedSystem("wrist_sensor", sensor)
        noise = builder.AddNamedSystem(
            "wrist_sensor_noise",
            RandomSource(RandomDistribution.kGaussian, 12 * NOISE_BLOCK, NOISE_BLOCK * period),
        )
        builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
        if contact:
            builder.Connect(
                plant.get_contact_results_output_port(), sensor.GetInputPort("contact_results")
            )
    sizes = sample_parts(arm.num_joints)
    parts = builder.AddNamedSystem("sample_parts", Demultiplexer(list(sizes.values())))
    builder.Connect(sensor.GetOutputPort("sample"), parts.get_input_port())
