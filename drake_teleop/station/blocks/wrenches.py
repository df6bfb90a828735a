"""Blocks of load wrench and wrench scaling for double, AutoDiffXd and Expression."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import finite_array
from drake_teleop.load import compensation
from drake_teleop.load.compensation import add_excess_weight_into, scaled_wrench_into
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.station.scaling import force_scaling
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig, Scales

_GRAVITY_W_M_S2 = (0.0, 0.0, -9.81)
_MOTION_PORT_NAMES = ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")


def _compiled_or_python(function: Any, T: Any) -> Callable[..., None]:
    return function if T is float else function.py_func


def _zero_vector_of_type(T: Any, size: int) -> Any:
    return np.zeros(size) if T is float else np.full(size, T(0.0), dtype=object)


@TemplateSystem.define("NonContactWrench_")
def NonContactWrench_(T: Any) -> Any:
    class NonContactWrenchT(LeafSystem_[T]):
        """Block that outputs the wrench of a load's weight and inertia, Eq. (12).

        .. pydrake_system::

            name: NonContactWrench
            input_ports:
            - specific_force_S: (3,) a - g of the sensor's origin [m/s^2]
            - angular_velocity_S: (3,) [rad/s]
            - angular_acceleration_S: (3,) [rad/s^2]
            - load: (10,) inertial parameters phi; if unconnected, argument `phi`
            output_ports:
            - non_contact_wrench_S: (6,) wrench on the load [N, N m]

        Args:
            phi: (10,) inertial parameters of the load about So, in S.
        """

        __slots__ = NO_EXTRA_SLOTS

        def _construct(self, phi: ArrayLike | None = None, converter: Any = None) -> None:
            LeafSystem_[T].__init__(self, converter)
            self._phi = np.zeros(10) if phi is None else finite_array("phi", phi, 10)
            self._parameter = self.DeclareNumericParameter(BasicVector_[T](self._phi))
            self._motion = [self.DeclareVectorInputPort(name, 3) for name in _MOTION_PORT_NAMES]
            self._load = self.DeclareVectorInputPort("load", 10)
            inputs = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
            calculate = weak_callback(self._calc_non_contact_wrench)
            self.DeclareVectorOutputPort("non_contact_wrench_S", 6, calculate, inputs)

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            NonContactWrenchT._construct(self, other._phi, converter=converter)

        def _calc_non_contact_wrench(self, context: Any, output: Any) -> None:
            if self._load.HasValue(context):
                phi = self._load.Eval(context)
            else:
                phi = context.get_numeric_parameter(self._parameter).CopyToVector()
            wrench = _zero_vector_of_type(T, 6)
            motion = [port.Eval(context) for port in self._motion]
            _compiled_or_python(non_contact_wrench_into, T)(*motion, phi, wrench)
            output.SetFromVector(wrench)

    return NonContactWrenchT


NonContactWrench = NonContactWrench_[float]


@TemplateSystem.define("WrenchScaling_")
def WrenchScaling_(T: Any) -> Any:
    class WrenchScalingT(LeafSystem_[T]):
        """Block that outputs contact wrench F_c and the sum F' of scaled contact and load wrench.

        .. pydrake_system::

            name: WrenchScaling
            input_ports:
            - measured_wrench_S: (6,) wrench of the sensor on the load [N, N m]
            - specific_force_S: (3,) a - g of the sensor's origin [m/s^2]
            - angular_velocity_S: (3,) [rad/s]
            - angular_acceleration_S: (3,) [rad/s^2]
            - load_estimate: (16,) [offsets; phi]
            - R_WS: (9,) orientation of S by rows, for wrench_to_master, sigma_weight, sigma_inertia
            output_ports:
            - contact_wrench_S: (6,) F_c [N, N m]
            - scaled_wrench_S: (6,) F' [N, N m]
            - wrench_to_master: (6,) F_E_B = -force_scale F', in the master's base B [N, N m]

        Args:
            config: scales; by default sigma and gamma are 1.
            R_WB: (3, 3) orientation of the master's base B in world W.
            gravity_W: (3,) [m/s^2].
        """

        __slots__ = NO_EXTRA_SLOTS

        def _construct(
            self,
            config: ForceScalingConfig | None = None,
            R_WB: ArrayLike | None = None,
            gravity_W: ArrayLike = _GRAVITY_W_M_S2,
            converter: Any = None,
        ) -> None:
            LeafSystem_[T].__init__(self, converter)
            self._config = config = copy.deepcopy(config or ForceScalingConfig())
            self._R_WB = np.eye(3) if R_WB is None else finite_array("R_WB", R_WB, 3, 3)
            self._gravity_W, self._scales = finite_array("gravity_W", gravity_W, 3), config.scales()
            ports = [("measured_wrench_S", 6), *((name, 3) for name in _MOTION_PORT_NAMES)]
            ports += [("load_estimate", 16), ("R_WS", 9)]
            inputs = [self.DeclareVectorInputPort(*port) for port in ports]
            self._inputs, self._orientation = inputs[:-1], inputs[-1]
            tickets = {port.ticket() for port in inputs[:-1]}
            for name, calc, more in (
                ("contact_wrench_S", self._calc_contact_wrench, set()),
                ("scaled_wrench_S", self._calc_scaled_wrench, {self._orientation.ticket()}),
                ("wrench_to_master", self._calc_wrench_to_master, {self._orientation.ticket()}),
            ):
                self.DeclareVectorOutputPort(name, 6, weak_callback(calc), tickets | more)

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            WrenchScalingT._construct(self, other._config, other._R_WB, other._gravity_W, converter)

        def _scale_wrench(self, context: Any, scales: Scales) -> Any:
            measured, s, omega, alpha, estimate = (port.Eval(context) for port in self._inputs)
            given, wrench = self._config.gripper_phi, _zero_vector_of_type(T, 6)
            gripper = estimate[6:] if given is None else np.asarray(given)
            parts = gripper, estimate[6:] - gripper
            _compiled_or_python(scaled_wrench_into, T)(
                measured, estimate[:6], s, omega, alpha, *parts, *scales[:3], wrench
            )
            excess = [w - i for w, i in zip(scales[3:], scales[:2], strict=True)]
            if any(excess):
                if not self._orientation.HasValue(context):
                    where = "WrenchScaling: gravity in S"
                    raise compensation.unknown_gravity_error(where, "connect R_WS")
                gravity = self._evaluate_R_WS(context).T @ self._gravity_W
                _compiled_or_python(add_excess_weight_into, T)(gravity, *parts, *excess, wrench)
            return wrench

        def _evaluate_R_WS(self, context: Any) -> Any:
            return np.ascontiguousarray(self._orientation.Eval(context)).reshape(3, 3)

        def _calc_contact_wrench(self, context: Any, output: Any) -> None:
            output.SetFromVector(self._scale_wrench(context, Scales(0.0, 0.0, 1.0, 0.0, 0.0)))

        def _calc_scaled_wrench(self, context: Any, output: Any) -> None:
            output.SetFromVector(self._scale_wrench(context, self._scales))

        def _calc_wrench_to_master(self, context: Any, output: Any) -> None:
            if not self._orientation.HasValue(context):
                what = "the input port R_WS, the orientation of the sensor, is not connected"
                remedy = "connect a rotation matrix, by rows"
                raise DrakeTeleopError(what, where="WrenchScaling.wrench_to_master", remedy=remedy)
            wrench, k = _zero_vector_of_type(T, 6), self._config.force_scale
            scaled, R_WS = self._scale_wrench(context, self._scales), self._evaluate_R_WS(context)
            to_master_into = _compiled_or_python(force_scaling.wrench_to_master_into, T)
            to_master_into(scaled, R_WS, self._R_WB, k, k, wrench)
            output.SetFromVector(wrench)

    return WrenchScalingT


WrenchScaling = WrenchScaling_[float]
