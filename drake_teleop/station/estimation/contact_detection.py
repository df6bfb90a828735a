"""Contact detection at the slave: the wrench minus the load's part exceeds a noise floor."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, are_valid_port_values
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import choice, quantity, settings
from drake_teleop.common.numeric import Array
from drake_teleop.load import regressor
from drake_teleop.load.compensation import scaled_wrench_into
from drake_teleop.load.contact.detection import CONTACT_INDEX, ContactDetector, update_contact_flag
from drake_teleop.load.contact.noise_floor import STATISTIC_NAMES, THRESHOLD_MARGIN, NoiseFloor
from drake_teleop.station.slave.arm import ArmModel, acceleration_from_specific_force_into


@settings
@dataclass
class ContactDetectionConfig:
    """Settings of the contact detector."""

    statistic: str = choice("glr", STATISTIC_NAMES, "statistic of the contact wrench for detection")
    margin: float = quantity(
        THRESHOLD_MARGIN, "1", 1.0, 10.0, "ratio of threshold to largest statistic in free motion"
    )
    hold: float = quantity(0.02, "s", 0.0, 1.0, "time below the threshold that ends a contact")
    drift_time: float = quantity(5.0, "s", 0.5, 1e4, "time constant that removes wrench drift")
    recovery: float = quantity(5e-3, "s", 0.0, 1.0, "pause of the detection after a saturation")


@njit(cache=True)
def _detect_contact_using_arm(memory, sample, estimate, arm, settings):
    s, acceleration = sample[regressor.SPECIFIC_FORCE_SLICE], np.empty(3)
    q = sample[regressor.FIRST_JOINT_INDEX : regressor.SAMPLE_TIME_INDEX]
    acceleration_from_specific_force_into(arm, q, s, acceleration)
    return update_contact_flag_with_sample(memory, sample, estimate, acceleration, settings)


@njit(cache=True)
def update_contact_flag_with_sample(memory, sample, estimate, acceleration, settings):
    """Update a contact detector's `memory` with a sensor sample; return whether there is contact.

    `estimate` (16,) is [offsets; phi], `acceleration` (3,) that of So in S [m/s^2].
    """
    valid = are_valid_port_values(sample) and are_valid_port_values(estimate)
    if not (valid and are_valid_port_values(acceleration)):
        return memory[CONTACT_INDEX] != 0.0
    contact = np.empty(6)
    s, omega = sample[regressor.SPECIFIC_FORCE_SLICE], sample[regressor.ANGULAR_VELOCITY_SLICE]
    alpha = sample[regressor.ANGULAR_ACCELERATION_SLICE]
    wrench, offset, phi = sample[regressor.WRENCH_SLICE], estimate[:6], estimate[6:]
    scaled_wrench_into(wrench, offset, s, omega, alpha, phi, np.zeros(10), 0.0, 0.0, 1.0, contact)
    return update_contact_flag(memory, contact, s, omega, alpha, acceleration, *settings)


class ContactDetection(LeafSystem):
    """Block that detects contact of the tool; `floor` is a noise floor fitted at the block's rate.

    The flag keeps its value while the wrist sensor is saturated and for `config.recovery` after.

    Ports as `blocks.ContactDetector`, with one input `sample` for all sensor signals.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self, config: ContactDetectionConfig, floor: NoiseFloor, arm: ArmModel | None, period: float
    ) -> None:
        super().__init__()
        threshold = floor.threshold(config.statistic, config.margin)
        hold, following = round(config.hold / period), period / config.drift_time
        self._settings = ContactDetector(
            floor, threshold, statistic=config.statistic, hold=hold, following=following
        ).settings
        self._sample = self._declare_sample_input_ports(arm)
        self._estimate = self.DeclareVectorInputPort("load_estimate", 16)
        self._flag = self.DeclareDiscreteState(1)
        self._memory = self.DeclareDiscreteState(ContactDetector.initial_memory())
        self._recovery = round(config.recovery / period)
        self._blind_samples = self.DeclareDiscreteState(1)  # remaining samples without detection
        self.DeclareStateOutputPort("contact", self._flag)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_contact_flag_state)

    def _declare_sample_input_ports(self, arm: ArmModel | None) -> Any:
        assert arm is not None
        self._arm = arm.table
        return self.DeclareVectorInputPort("sample", regressor.sample_size(arm.num_joints) + 1)

    def _update_and_get_contact_flag(
        self, context: Context, memory: Array, sample: Array, estimate: Array
    ) -> bool:
        return bool(_detect_contact_using_arm(memory, sample, estimate, self._arm, self._settings))

    def _update_contact_flag_state(self, context: Context, discrete_state: DiscreteValues) -> None:
        sample = self._sample.Eval(context)
        blind = discrete_state.get_mutable_value(self._blind_samples)
        if sample[regressor.SATURATION_FLAG_INDEX] > 0.5:
            blind[0] = self._recovery
            return
        if blind[0] > 0.0:
            blind[0] -= 1.0
            return
        memory = discrete_state.get_mutable_value(self._memory)
        estimate = self._estimate.Eval(context)
        flag = discrete_state.get_mutable_value(self._flag)
        flag[0] = self._update_and_get_contact_flag(context, memory, sample, estimate)
