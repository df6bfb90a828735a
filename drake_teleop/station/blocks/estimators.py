"""Blocks of load estimator and contact detector with one input port per sensor signal."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, LeafSystem

from drake_teleop.common.blocks import DoubleOnlySystem
from drake_teleop.common.numeric import Array, finite_array
from drake_teleop.load import regressor
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.station.estimation import contact_detection, load_estimator


class _SeparateSignalsAsSample:
    def __init__(self, system: LeafSystem) -> None:
        sizes = list(regressor.signal_sizes_of_sample(0).items())[:-1]
        self._ports = [system.DeclareVectorInputPort(*each) for each in sizes]

    def Eval(self, context: Context) -> Array:
        sample, first = np.zeros(regressor.FIRST_JOINT_INDEX), 0
        for port in self._ports:
            # Unconnected: `saturated` is 0.
            if port.size() > 1 or port.HasValue(context):
                sample[first : first + port.size()] = port.Eval(context)
            first += port.size()
        return sample


class LoadEstimator(DoubleOnlySystem, load_estimator.LoadEstimator):
    """Block that estimates load and sensor offsets from every sample of the wrist sensor.

    .. pydrake_system::

        name: LoadEstimator
        input_ports:
        - measured_wrench_S: (6,) wrench of the sensor on the load [N, N m]
        - specific_force_S: (3,) a - g of the sensor's origin [m/s^2]
        - angular_velocity_S: (3,) [rad/s]
        - angular_acceleration_S: (3,) [rad/s^2]
        - saturated: (1,) 1 while the wrench is invalid; 0 if unconnected
        output_ports:
        - load_estimate: (16,) [offsets; phi]
        - load_state: (1,) 0 learning, 1 settled, 2 disturbed, 3 load changed

    Args:
        noise_std: (6,) standard deviations of the wrench [N, N m].
        motion_std: (9,) standard deviations of specific force, angular velocity and angular
            acceleration, for `config.method` "rtls" and `config.watch`.
        period: sampling period [s].
        initial: (16,) initial estimate.
        config: settings; default: recursive least squares from the start.
    """

    __slots__ = ()

    def __init__(
        self,
        noise_std: ArrayLike,
        period: float,
        *,
        motion_std: ArrayLike | None = None,
        initial: ArrayLike | None = None,
        config: load_estimator.LoadEstimatorConfig | None = None,
    ) -> None:
        config = load_estimator.LoadEstimatorConfig(enabled=True) if config is None else config
        noise = finite_array("noise_std", noise_std, 6)
        motion = np.zeros(9) if motion_std is None else finite_array("motion_std", motion_std, 9)
        start = np.zeros(16) if initial is None else finite_array("initial", initial, 16)
        super().__init__(config, noise, motion, period, regressor.FIRST_JOINT_INDEX, start)

    def _declare_sample_input_ports(self, size: int) -> Any:
        return _SeparateSignalsAsSample(self)


class ContactDetector(DoubleOnlySystem, contact_detection.ContactDetection):
    """Block that detects contact in the measured wrench minus offsets and the load's wrench.

    .. pydrake_system::

        name: ContactDetector
        input_ports:
        - measured_wrench_S: (6,) wrench of the sensor on the load [N, N m]
        - specific_force_S: (3,) a - g of the sensor's origin [m/s^2]
        - angular_velocity_S: (3,) [rad/s]
        - angular_acceleration_S: (3,) [rad/s^2]
        - saturated: (1,) 1 while the wrench is invalid; 0 if unconnected
        - load_estimate: (16,) [offsets; phi]
        - R_WS: (9,) orientation of S, by rows
        output_ports:
        - contact: (1,) 1 in contact, else 0

    Args:
        floor: noise floor of the wrench, fitted to free motion sampled at this block's rate.
        period: sampling period [s].
        gravity_W: (3,) [m/s^2].
    """

    __slots__ = ()

    def __init__(
        self,
        floor: NoiseFloor,
        period: float,
        *,
        config: contact_detection.ContactDetectionConfig | None = None,
        gravity_W: ArrayLike = (0.0, 0.0, -9.81),
    ) -> None:
        config = contact_detection.ContactDetectionConfig() if config is None else config
        super().__init__(config, floor, None, period)
        self._gravity_W = finite_array("gravity_W", gravity_W, 3)
        self._orientation = self.DeclareVectorInputPort("R_WS", 9)

    def _declare_sample_input_ports(self, arm: Any) -> Any:
        return _SeparateSignalsAsSample(self)

    def _update_and_get_contact_flag(
        self, context: Context, memory: Array, sample: Array, estimate: Array
    ) -> bool:
        gravity = self._orientation.Eval(context).reshape(3, 3).T @ self._gravity_W
        acceleration = sample[regressor.SPECIFIC_FORCE_SLICE] + gravity
        update = contact_detection.update_contact_flag_with_sample
        return bool(update(memory, sample, estimate, acceleration, self._settings))
