"""Recursive estimator of load and sensor offsets during a run (Fig. 2 of the paper)."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, are_valid_port_values, weak_callback
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.online import watched
from drake_teleop.load.online.change import change_detector_parameters
from drake_teleop.load.online.recursive_tls import METHODS
from drake_teleop.load.online.watched import STATE_INDEX, STATE_LEARNING
from drake_teleop.load.regressor import SATURATION_FLAG_INDEX

_SAMPLES_PER_SETTLING_CHECK = 16


@settings
@dataclass
class LoadEstimatorConfig:
    """Settings of the recursive estimation of load and offsets, Eqs. (7)-(8)."""

    enabled: bool = plain(
        False,
        "update with every sample; only for free motion: a contact wrench would count as load",
    )
    forgetting: float = quantity(1.0, "1", 0.9, 1.0, "forgetting factor per sample; 1 = none")
    method: str = choice("rls", (), "rls: least squares; rtls: total least squares", METHODS)
    settled_bound: float = quantity(
        0.05, "1", 1e-6, 10.0, "largest relative standard deviation of a settled load"
    )
    watch: bool = plain(False, "keep a settled or given load constant; detect its change")
    relative_wrench_error: float = quantity(
        0.0, "1", 0.0, 0.5, "relative wrench error by gains, cross-talk, delays; for `watch`"
    )

    def check(self, where: str) -> None:
        if self.enabled and self.watch and not METHODS[self.method].allows_for_noisy_motion:
            what = f"'{self.method}' ignores the noise of motion, so it detects no change of load"
            remedy = "set method: rtls, or watch: false"
            raise DrakeTeleopError(what, where=f"{where}.method", remedy=remedy)


class LoadEstimator(LeafSystem):
    """Block that outputs load and offsets: constant, estimated from all samples, or monitored.

    Ports as `blocks.LoadEstimator`, with one input `sample` for all sensor signals. Output
    load_state is an index into `load.online.watched.LOAD_STATE_NAMES`.

    Args:
        noise_std: (6,) standard deviations of the wrench channels, for weighting [N, N m].
        motion_std: (9,) standard deviations of specific force [m/s^2], angular velocity [rad/s] and
            angular acceleration [rad/s^2], for "rtls" and for `watch`.
        initial: (16,) initial estimate [offsets; phi], Eq. (7).
        covariance: (16, 16) covariance of `initial`; with it, monitoring begins at once.
        fallback: (10,) load parameters phi to use after a change of load; default: zeros.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self,
        config: LoadEstimatorConfig,
        noise_std: Array,
        motion_std: Array,
        period: float,
        sample_size: int,
        initial: Array,
        covariance: Array | None = None,
        fallback: ArrayLike | None = None,
    ) -> None:
        super().__init__()
        config.check("load_estimator")
        if config.watch and not config.enabled and covariance is None:
            what = "there is no load to monitor: none is estimated or given with a covariance"
            remedy = "set load_estimator.enabled, or pass load_estimate with load_covariance"
            raise DrakeTeleopError(what, where="load_estimator.watch", remedy=remedy)
        self._estimator = METHODS[config.method].for_noise(
            noise_std, motion_std, forgetting=config.forgetting, settled_std=config.settled_bound
        )
        start = np.asarray(initial, dtype=float)
        memory = self._estimator.initial_memory(start)
        self._shape, self._watches, self._period = memory.shape, config.watch, period
        self._sample = self._declare_sample_input_ports(sample_size)
        estimate = self.DeclareDiscreteState(start)
        self.DeclareDiscreteState(memory.ravel())
        self.DeclareStateOutputPort("load_estimate", estimate)
        calculate = weak_callback(self._calc_load_state)
        self.DeclareVectorOutputPort("load_state", 1, calculate, {self.xd_ticket()})
        if config.watch:
            monitor = np.zeros(watched.MEMORY_SIZE)
            if covariance is not None:
                monitor = watched.initial_monitor_memory(start, covariance)
            self.DeclareDiscreteState(monitor)
            noise, share = (noise_std, motion_std, period), config.relative_wrench_error
            change = change_detector_parameters(*noise, relative_wrench_error=share)
            safe = np.zeros(10) if fallback is None else np.array(fallback, dtype=float)
            self._watch_arguments = safe, period, *change
        if config.enabled or config.watch:
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._estimate_or_monitor_load)

    def _declare_sample_input_ports(self, size: int) -> Any:
        return self.DeclareVectorInputPort("sample", size)

    def _estimate_or_monitor_load(self, context: Context, discrete_state: DiscreteValues) -> None:
        sample = self._sample.Eval(context)
        # The wrench contains more than the load's, or the sample would spoil the memory for ever.
        if sample[SATURATION_FLAG_INDEX] > 0.0 or not are_valid_port_values(sample):
            return
        estimate = discrete_state.get_mutable_value(0)
        if self._read_code_of_load_state(discrete_state) != STATE_LEARNING:
            memory = discrete_state.get_mutable_value(2)
            watched.monitor_load(estimate, memory, sample, *self._watch_arguments)
            return
        memory = discrete_state.get_mutable_value(1).reshape(self._shape)
        self._estimator.update_into(estimate, memory, sample)
        step = round(context.get_time() / self._period)
        # The check for settling takes longer than the update.
        due = self._watches and step % _SAMPLES_PER_SETTLING_CHECK == 0
        if due and self._estimator.is_state_settled(estimate, memory):
            covariance = self._estimator.covariance_of(estimate, memory)
            discrete_state.set_value(2, watched.initial_monitor_memory(estimate, covariance))

    def _read_code_of_load_state(self, discrete_state: DiscreteValues) -> int:
        return int(discrete_state.value(2)[STATE_INDEX]) if self._watches else STATE_LEARNING

    def _calc_load_state(self, context: Context, output: BasicVector) -> None:
        state = context.get_discrete_state()
        output[0] = self._read_code_of_load_state(state)
        if not self._watches:
            estimate, memory = state.value(0), state.value(1)
            settled = self._estimator.is_state_settled(estimate, memory.reshape(self._shape))
            output[0] = watched.STATE_SETTLED if settled else STATE_LEARNING
