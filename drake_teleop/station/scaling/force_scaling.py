"""Scaling of contact wrench and load wrench, slave to master (Figs. 2 and 4 of the paper)."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
import weakref
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common import vectors
from drake_teleop.common.blocks import NO_EXTRA_SLOTS, Fault, are_valid_port_values
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import apply_matrix, matrix_as_tuple, scale_vector, vector_at
from drake_teleop.load import compensation, regressor
from drake_teleop.load.compensation import add_excess_weight_into, scaled_wrench_into
from drake_teleop.station.slave.arm import (
    ArmModel,
    acceleration_from_specific_force_into,
    forward_kinematics,
)

#: Scales of the contact wrench alone, Eq. (13); see `blend_scales_at`.
_CONTACT_ONLY_SCALES = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
_NUM_BLENDED_SCALES = 6
_JOINT_ANGLE_SLICE = slice(regressor.FIRST_JOINT_INDEX, regressor.SAMPLE_TIME_INDEX)

#: Largest valid age of a sample, and of a time stamp in the future [s].
MAX_SAMPLE_AGE_S = 0.05
_NO_FAULT, _STALE_SAMPLE_FAULT, _BAD_READING_FAULT, _BAD_JOINTS_FAULT, _BAD_LOAD_FAULT = map(
    int, (Fault.NONE, Fault.OLD_SAMPLE, Fault.BAD_READING, Fault.SLAVE_JOINTS, Fault.INVALID_LOAD)
)


class Scales(NamedTuple):
    """Scales of the wrench: sigma of a body's inertia, weight of its weight, gamma of contact."""

    sigma_gripper: float
    sigma_object: float
    gamma: float
    weight_gripper: float
    weight_object: float

    @property
    def load_scales(self) -> tuple[float, float, float, float]:
        return self.sigma_gripper, self.sigma_object, self.weight_gripper, self.weight_object


@settings
@dataclass
class ForceScalingConfig:
    """Kept shares of load and object (sigma, eta), and scales of contact and rendered wrench."""

    sigma: float = quantity(1.0, "1", 0.0, 100.0, "kept share of the load's weight and inertia")
    gamma: float = quantity(1.0, "1", 0.0, 100.0, "scale of the contact wrench")
    eta: float | None = quantity(
        None, "1", 0.0, 1.0, "kept share of the object's wrench, Eq. (14); needs sigma 0, gamma 1"
    )
    gripper_phi: list[float] | None = quantity(
        *(None, "kg, kg m, kg m^2", -1e3, 1e3, "phi of the gripper alone; null: all is gripper"),
        length=10,
    )
    force_scale: float = quantity(1 / 17.5, "1", 0.0, 100.0, "rendered wrench over slave's wrench")
    sigma_weight: float | None = quantity(
        None, "1", 0.0, 100.0, "kept share of the load's weight; null: value of sigma"
    )
    sigma_inertia: float | None = quantity(
        None, "1", 0.0, 100.0, "kept share of the load's inertia; null: value of sigma"
    )

    def scales(self, where: str = "force_scaling") -> Scales:
        if self.gripper_phi is not None and self.gripper_phi[0] < 0.0:
            what = f"a mass of {self.gripper_phi[0]:g} kg is negative"
            remedy = "give phi as of `identify`: [m, m cx, m cy, m cz, Ixx, ...]"
            raise DrakeTeleopError(what, where=f"{where}.gripper_phi", remedy=remedy)
        separate = self.sigma_weight, self.sigma_inertia
        if self.eta is None:
            sigmas = self.sigma, self.sigma, *separate
            weights, inertias = compensation.weight_scales_and_inertia_scales(*sigmas)
            return Scales(*inertias, self.gamma, *weights)
        alone = self.sigma == 0 and self.gamma == 1 and separate == (None, None)
        if not alone or self.gripper_phi is None:
            what = "eta scales the object alone: it requires gripper_phi and excludes other scales"
            required = "set sigma: 0, gamma: 1 and gripper_phi (section V of the paper)"
            remedy = f"{required}, and leave sigma_weight and sigma_inertia out"
            raise DrakeTeleopError(what, where=f"{where}.eta", remedy=remedy)
        gripper, grasped, gamma = compensation.scales_from_eta(self.eta)
        return Scales(gripper, grasped, gamma, gripper, grasped)


@njit(cache=True)
def wrench_to_master_into(wrench_S, R_WS, R_WB, force_scale, torque_scale, out):
    for base in (0, 3):
        scale = torque_scale if base == 3 else force_scale
        in_W = apply_matrix(matrix_as_tuple(R_WS), vector_at(wrench_S, base))
        in_B = scale_vector(-scale, apply_matrix(vectors.transposed(matrix_as_tuple(R_WB)), in_W))
        out[base], out[base + 1], out[base + 2] = in_B


@njit(cache=True)
def blend_scales_at(ramp, time, scales):
    """Write the scales at `time` [s], a minimum-jerk blend from old to new ones, to `scales` (6,).

    `ramp` (14,) contains old scales (6), new scales (6), start of the ramp [s], duration [s].
    Scales: sigma of gripper and object, gamma, force scale, weight scales of gripper and object.
    """
    u = min(max((time - ramp[12]) / ramp[13], 0.0), 1.0) if ramp[13] > 0.0 else 1.0
    share = u * u * u * (10.0 + u * (6.0 * u - 15.0))
    for i in range(_NUM_BLENDED_SCALES):
        # Exact at both ends, so that unchanged scales equal the configured ones.
        scales[i] = (1.0 - share) * ramp[i] + share * ramp[_NUM_BLENDED_SCALES + i]


@njit(cache=True)
def _scaled_wrench_into(sample, estimate, gripper, arm, scales, out):
    wrench, s = sample[regressor.WRENCH_SLICE], sample[regressor.SPECIFIC_FORCE_SLICE]
    omega = sample[regressor.ANGULAR_VELOCITY_SLICE]
    alpha = sample[regressor.ANGULAR_ACCELERATION_SLICE]
    phi_gripper, phi_object = gripper[6:], np.empty(10)
    for i in range(10):
        phi_object[i] = estimate[6 + i] - phi_gripper[i]
    scaled_wrench_into(
        wrench, estimate[:6], s, omega, alpha, phi_gripper, phi_object, scales[0], scales[1],
        scales[2], out,
    )  # fmt: skip
    excess_gripper, excess_object = scales[4] - scales[0], scales[5] - scales[1]
    if excess_gripper != 0.0 or excess_object != 0.0:
        gravity = np.empty(3)
        acceleration_from_specific_force_into(arm, sample[_JOINT_ANGLE_SLICE], np.zeros(3), gravity)
        add_excess_weight_into(gravity, phi_gripper, phi_object, excess_gripper, excess_object, out)


@njit(cache=True)
def find_sample_fault(sample, estimate, time, sample_limits):
    """Return the code (`Fault`) of the first fault in a sample and a load estimate at `time` [s].

    `sample_limits` (7,): largest wrench [N, N m] (6), largest age of a sample [s].
    """
    if not abs(time - sample[regressor.SAMPLE_TIME_INDEX]) <= sample_limits[6]:
        return _STALE_SAMPLE_FAULT
    reading = sample[regressor.SATURATION_FLAG_INDEX] < regressor.LOST_SAMPLE_FLAG_THRESHOLD
    reading = reading and are_valid_port_values(sample[regressor.MOTION_SLICE])
    for i in range(6):
        reading = reading and abs(sample[i]) <= sample_limits[i]
    if not reading:
        return _BAD_READING_FAULT
    if not are_valid_port_values(sample[_JOINT_ANGLE_SLICE]):
        return _BAD_JOINTS_FAULT
    return _NO_FAULT if are_valid_port_values(estimate) else _BAD_LOAD_FAULT


@njit(cache=True)
def _scaled_wrench_at_time_into(sample, estimate, gripper, scale_ramp, time, arm, out):
    scales = np.empty(_NUM_BLENDED_SCALES)
    blend_scales_at(scale_ramp, time, scales)
    _scaled_wrench_into(sample, estimate, gripper, arm, scales, out)


@njit(cache=True)
def _unscaled_contact_wrench_into(sample, estimate, gripper, _ramp, _time, arm, scales, out):
    _scaled_wrench_into(sample, estimate, gripper, arm, scales, out)


@njit(cache=True)
def _non_contact_wrench_into(sample, estimate, _gripper, _ramp, _time, out):
    motion = sample[regressor.MOTION_SLICE]
    regressor.non_contact_wrench_into(motion[:3], motion[3:6], motion[6:], estimate[6:], out)


@njit(cache=True)
def _sample_fault_into(sample, estimate, _gripper, _ramp, time, sample_limits, out):
    out[0] = find_sample_fault(sample, estimate, time, sample_limits)


@njit(cache=True, omits_reference_counting=True)
def _scaled_contact_and_fault_into(
    sample, estimate, gripper, scale_ramp, time, arm, contact_scales, sample_limits, out
):
    _scaled_wrench_at_time_into(sample, estimate, gripper, scale_ramp, time, arm, out[:6])
    _scaled_wrench_into(sample, estimate, gripper, arm, contact_scales, out[6:12])
    out[12] = find_sample_fault(sample, estimate, time, sample_limits)


@njit(cache=True)
def _rendered_wrench_into(
    sample, estimate, gripper, scale_ramp, time, arm, R_WB, sample_limits, gamma_factor, out
):
    if find_sample_fault(sample, estimate, time, sample_limits) != _NO_FAULT:
        out[:] = np.nan
        return
    scales, scaled_S, R_WS, p_WS = np.empty(6), np.empty(6), np.empty((3, 3)), np.empty(3)
    blend_scales_at(scale_ramp, time, scales)
    scales[2] *= gamma_factor
    _scaled_wrench_into(sample, estimate, gripper, arm, scales, scaled_S)
    forward_kinematics(arm, sample[_JOINT_ANGLE_SLICE], R_WS, p_WS)
    wrench_to_master_into(scaled_S, R_WS, R_WB, scales[3], scales[3], out)


class ForceScaling(LeafSystem):
    """Block that scales contact wrench and load wrench, and transforms their sum to the hand.

    F' = gamma F_c + V (sigma_gr phi_gr + sigma_obj phi_obj), with contact wrench F_c, regressor V;
    phi_gr is `config.gripper_phi` (null: the whole estimate), phi_obj the estimate minus phi_gr.

    .. pydrake_system::

        name: ForceScaling
        input_ports:
        - sample: sample of the wrist sensor, see `drake_teleop.load.regressor`
        - load_estimate: (16,) [offsets; phi], Eq. (7)
        output_ports:
        - scaled_wrench_S: scaled wrench F' of Fig. 2
        - contact_wrench_S: contact wrench F_c of Eq. (13)
        - fault: `Fault` code of sample or estimate, 0 without fault
        - scaled_contact_and_fault: the three above in one vector
        - non_contact_wrench_S: wrench of the load (weight and inertia), Eq. (12)
        - wrench_B: F_E_B to render: -force_scale F', in the master's base B; NaN during a fault
        - load_wrench_B: part of wrench_B from weight and inertia of the load

    Args:
        config: initial scales.
        R_WB: (3, 3) orientation of the master's base B in world W.
        largest_wrench: (6,) largest valid reading [N, N m]; None for no limit.
        oldest: largest valid age of a sample [s].
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self,
        config: ForceScalingConfig,
        arm: ArmModel,
        R_WB: Array,
        largest_wrench: Array | None = None,
        oldest: float = MAX_SAMPLE_AGE_S,
    ) -> None:
        super().__init__()
        largest = np.full(6, np.inf) if largest_wrench is None else largest_wrench
        sample_limits, phi = np.append(largest, oldest), config.gripper_phi
        self._gripper = None if phi is None else np.concatenate([np.zeros(6), phi])
        # Old and new scales, start and length of the change; see `blend_scales_at`.
        found = config.scales()
        scales = [*found[:3], config.force_scale, *found[3:]]
        self._change = self.DeclareNumericParameter(BasicVector([*scales, *scales, 0.0, 0.0]))
        sample_size = regressor.sample_size(arm.num_joints) + 1
        self._sample = self.DeclareVectorInputPort("sample", sample_size)
        self._estimate = self.DeclareVectorInputPort("load_estimate", 16)
        contact, rendered = (arm.table, _CONTACT_ONLY_SCALES), _rendered_wrench_into
        frames = arm.table, np.ascontiguousarray(R_WB), sample_limits
        for name, size, calculate_into, constants in (
            ("scaled_wrench_S", 6, _scaled_wrench_at_time_into, (arm.table,)),
            ("contact_wrench_S", 6, _unscaled_contact_wrench_into, contact),
            ("non_contact_wrench_S", 6, _non_contact_wrench_into, ()),
            ("wrench_B", 6, rendered, (*frames, 1.0)),
            ("load_wrench_B", 6, rendered, (*frames, 0.0)),
            ("fault", 1, _sample_fault_into, (sample_limits,)),
            ("scaled_contact_and_fault", 13, _scaled_contact_and_fault_into,
             (*contact, sample_limits)),
        ):  # fmt: skip
            self._declare_output(name, size, calculate_into, constants)

    def _declare_output(
        self, name: str, size: int, calculate_into: Any, constants: tuple[Any, ...]
    ) -> None:
        block: Any = weakref.ref(self)

        def calculate(context: Context, output: BasicVector) -> None:
            inputs = block()._evaluate_inputs(context)
            calculate_into(*inputs, *constants, output.get_mutable_value())

        # The output depends on time, because the last sample of a stopped sensor becomes too old.
        self.DeclareVectorOutputPort(name, size, calculate)

    def SetScales(
        self,
        context: Context,
        *,
        sigma_gripper: float,
        sigma_object: float,
        gamma: float,
        force_scale: float,
        sigma_weight: float | None = None,
        duration: float = 0.25,
    ) -> None:
        """Change the scales on a minimum-jerk ramp of `duration` [s] that starts now.

        `sigma_weight` scales the weight of both bodies; None: as their inertia.
        """
        both = sigma_gripper, sigma_object
        weights = both if sigma_weight is None else (sigma_weight, sigma_weight)
        requested = np.array([*both, gamma, force_scale, *weights, duration], dtype=float)
        names = "sigma_gripper sigma_object gamma force_scale sigma_weight sigma_weight duration"
        for name, value in zip(names.split(), requested, strict=True):
            if not 0.0 <= value < np.inf:
                what, remedy = f"{value:g} is negative or not finite", "give 0 or more"
                raise DrakeTeleopError(what, where=f"SetScales: {name}", remedy=remedy)
        parameter = context.get_mutable_numeric_parameter(self._change)
        now, start = np.empty(_NUM_BLENDED_SCALES), context.get_time()
        blend_scales_at(parameter.value(), start, now)
        parameter.SetFromVector(np.concatenate([now, requested[:-1], [start, requested[-1]]]))

    def _evaluate_inputs(self, context: Context) -> tuple[Any, ...]:
        sample, estimate = self._sample.Eval(context), self._estimate.Eval(context)
        gripper = estimate if self._gripper is None else self._gripper
        scale_ramp = context.get_numeric_parameter(self._change).value()
        return sample, estimate, gripper, scale_ramp, context.get_time()
