"""Contact detection by the operator, from the force u on the skin and the hand's velocity v.

A Kalman filter estimates mass m, damping b, friction c and offset u_0 of the force without contact,
m a + b v + c v / sqrt(|v|^2 + v_0^2) + u_0 (`docs/operator.md`). Contact is detected when u
differs from this force by more than the threshold.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, broadcast_to_rows, finite_array

# Standard deviations of [m, b, c, u_0 (3)]: random walk per sqrt(s), and initial; all estimates.
_FORCE_MODEL_DRIFT_STD_PER_SQRT_S = np.array([0.001, 0.01, 0.002, 0.005, 0.005, 0.005])
_INITIAL_FORCE_MODEL_STD = np.array([0.5, 2.0, 0.1, 0.5, 0.5, 0.5])
# Measurement noise of the filter, 0.1 N at 200 Hz, estimate.
_FORCE_NOISE_DENSITY_N_PER_SQRT_HZ = 0.007
_FRICTION_SMOOTHING_SPEED_M_PER_S = 0.01  # m/s, v_0, about the value of the device's friction
_FORCE_MODEL_SIZE = 6
_MAX_RELATIVE_TIME_STEP_DEVIATION = 0.1  # of a record, relative to the median step

# Memory: filtered u and v, now and one sample ago (12), held |u_expected|, number of samples,
# estimate [m, b, c, u_0 (3)], covariance of the estimate.
_MASKING_FORCE_INDEX, _SAMPLE_COUNT, _FORCE_MODEL_START_INDEX = 12, 13, 14
_COVARIANCE_START_INDEX = _FORCE_MODEL_START_INDEX + _FORCE_MODEL_SIZE
PERCEPTION_MEMORY_SIZE = _COVARIANCE_START_INDEX + _FORCE_MODEL_SIZE**2
"""Size of the memory of `update_perception_into`."""

EXCESS_FORCE_START_INDEX, DETECTION_THRESHOLD_INDEX, CONTACT_NOTICED_INDEX, OUTPUT_SIZE = 0, 3, 4, 5
"""Indices of the output of `update_perception_into`, and its size."""


@settings
@dataclass
class Perception:
    """Accuracy and delay of human vision and force perception; see docs/operator.md."""

    weber_fraction: float = quantity(0.1, "1", 0.0, 1.0, "just noticeable difference of a force")
    absolute_threshold: float = quantity(0.06, "N", 1e-3, 10.0, "smallest detectable force")
    masking_time: float = quantity(0.3, "s", 1e-3, 10.0, "decay time constant of masking")
    bandwidth_hz: float = quantity(20.0, "Hz", 1.0, 50.0, "bandwidth of perceived force and motion")
    reaction_time: float = quantity(0.16, "s", 0.0, 1.0, "time from a force to the hand's reaction")
    vision_delay: float = quantity(0.15, "s", 0.0, 1.0, "time from a seen motion to the reaction")
    vision_noise: float = quantity(
        0.5e-3, "m", 0.0, 0.1, "standard deviation of a perceived position, at the tool"
    )
    depth_error: float = quantity(2e-3, "m", 0.0, 0.1, "standard deviation of a perceived depth")
    aim_error: float = quantity(1e-3, "m", 0.0, 0.1, "standard deviation of perceived slot x and y")

    def packed_for_compiled_code(self, dt: float) -> Array:
        """Return Weber fraction, threshold [N], masking decay, low-pass gain per `dt` [s]."""
        fade = math.exp(-dt / self.masking_time)
        smooth = -math.expm1(-2 * math.pi * self.bandwidth_hz * dt)
        return np.array([self.weber_fraction, self.absolute_threshold, fade, smooth])


def initial_memory() -> Array:
    memory = np.zeros(PERCEPTION_MEMORY_SIZE)
    memory[_COVARIANCE_START_INDEX:] = np.diag(_INITIAL_FORCE_MODEL_STD**2).ravel()
    return memory


@njit(cache=True)
def update_perception_into(memory, parameters, dt, hand_mass, hand_force, velocity, attentive, out):
    """Update the operator's force perception by one step of `dt` [s].

    Args:
        memory: (PERCEPTION_MEMORY_SIZE,) from `initial_memory`, updated.
        hand_mass: mass of the hand, whose inertial force is not perceived [kg].
        hand_force, velocity: (3,) force of the hand on the stylus [N], stylus velocity [m/s].
        attentive: if false, detect no contact and only adapt the expected force.
        out: (5,) written: excess over the expected force (3) [N], threshold [N], 1 in contact.
    """
    weber, absolute, fade, smooth = parameters
    first = memory[_SAMPLE_COUNT] == 0.0
    for i in range(3):
        if first:
            memory[i], memory[3 + i] = -hand_force[i], velocity[i]
            memory[_FORCE_MODEL_START_INDEX + 3 + i] = -hand_force[i]
        memory[6 + i], memory[9 + i] = memory[i], memory[3 + i]
        memory[i] += smooth * (-hand_force[i] - memory[i])
        memory[3 + i] += smooth * (velocity[i] - memory[3 + i])
    memory[_SAMPLE_COUNT] += 1.0
    # Values midway between two samples, where the velocity difference gives the acceleration.
    speed = _FRICTION_SMOOTHING_SPEED_M_PER_S * _FRICTION_SMOOTHING_SPEED_M_PER_S
    for i in range(3):
        speed += 0.25 * (memory[3 + i] + memory[9 + i]) ** 2
    speed = math.sqrt(speed)
    theta = memory[_FORCE_MODEL_START_INDEX:_COVARIANCE_START_INDEX]
    expected_square = excess_square = 0.0
    rows, excess = np.zeros((3, _FORCE_MODEL_SIZE)), out[:3]
    for i in range(3):
        v = 0.5 * (memory[3 + i] + memory[9 + i])
        a = (memory[3 + i] - memory[9 + i]) / dt
        rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3 + i] = a, v, v / speed, 1.0
        felt = 0.5 * (memory[i] + memory[6 + i]) + hand_mass * a
        expected = 0.0
        for j in range(_FORCE_MODEL_SIZE):
            expected += rows[i, j] * theta[j]
        excess[i] = felt - expected
        expected_square += expected * expected
        excess_square += excess[i] * excess[i]
    masking = max(math.sqrt(expected_square), fade * memory[_MASKING_FORCE_INDEX])
    memory[_MASKING_FORCE_INDEX] = masking
    out[DETECTION_THRESHOLD_INDEX] = max(absolute, weber * masking)
    noticed = attentive and math.sqrt(excess_square) >= out[DETECTION_THRESHOLD_INDEX]
    out[CONTACT_NOTICED_INDEX] = 1.0 if noticed else 0.0
    if not noticed:
        P = memory[_COVARIANCE_START_INDEX:].reshape(_FORCE_MODEL_SIZE, _FORCE_MODEL_SIZE)
        _update_force_model_by_kalman_filter(theta, P, rows, excess, dt)


@njit(cache=True)
def _update_force_model_by_kalman_filter(theta, P, regressor, excess_force, dt):
    gain = np.empty(_FORCE_MODEL_SIZE)
    for j in range(_FORCE_MODEL_SIZE):
        P[j, j] += _FORCE_MODEL_DRIFT_STD_PER_SQRT_S[j] * _FORCE_MODEL_DRIFT_STD_PER_SQRT_S[j] * dt
    before = theta.copy()
    for i in range(3):
        noise, residual = _FORCE_NOISE_DENSITY_N_PER_SQRT_HZ, excess_force[i]
        variance = noise * noise / dt
        for j in range(_FORCE_MODEL_SIZE):
            residual -= regressor[i, j] * (theta[j] - before[j])
            gain[j] = 0.0
            for k in range(_FORCE_MODEL_SIZE):
                gain[j] += P[j, k] * regressor[i, k]
            variance += regressor[i, j] * gain[j]
        for j in range(_FORCE_MODEL_SIZE):
            theta[j] += gain[j] * residual / variance
            for k in range(_FORCE_MODEL_SIZE):
                P[j, k] -= gain[j] * gain[k] / variance


@njit(cache=True)
def _perceive_contact_of_recorded_motion(
    times, hand_force, velocity, parameters, dt, hand_mass, detection_start_s, memory, out
):
    for k in range(times.shape[0]):
        attentive = times[k] >= detection_start_s
        update_perception_into(
            memory, parameters, dt, hand_mass, hand_force[k], velocity[k], attentive, out[k]
        )


def perceive_contact(
    t: ArrayLike,
    hand_force: ArrayLike,
    velocity: ArrayLike,
    perception: Perception,
    hand_mass: float,
    attentive: float = 0.3,
) -> Array:
    """Return the operator's contact detection for a recorded motion, without reaction time.

    Args:
        t: (N,) evenly spaced times [s].
        hand_force, velocity: (N, 3) force of the hand [N] and velocity of the stylus [m/s].
        hand_mass: mass of the hand that moves with the stylus [kg].
        attentive: start time of detection [s]; before, only the expected force is adapted.

    Returns:
        (N, 5) excess over the expected force (3) [N], threshold [N], 1 while contact is detected.
    """
    _, (force, speed) = broadcast_to_rows(hand_force=(hand_force, 3), velocity=(velocity, 3))
    times = finite_array("t", t, len(force))
    steps, out = np.diff(times), np.empty((len(times), OUTPUT_SIZE))
    dt = float(np.median(steps)) if len(steps) else 0.0
    if dt <= 0.0 or np.abs(steps - dt).max() > _MAX_RELATIVE_TIME_STEP_DEVIATION * dt:
        remedy = "give two samples or more, with steps within 10 % of their median"
        raise DrakeTeleopError("times do not increase in even steps", where="t", remedy=remedy)
    parameters = perception.packed_for_compiled_code(dt)
    _perceive_contact_of_recorded_motion(
        times, force, speed, parameters, dt, hand_mass, attentive, initial_memory(), out
    )
    return out
