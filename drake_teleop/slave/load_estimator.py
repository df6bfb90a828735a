"""The estimator of Fig. 2: recursive, for the load and the offsets, in the loop.

The same kernels work on logs (`drake_teleop.load.recursive`, `recursive_tls`). It sees the sensor's
samples only. There is no choice of instrumental variables: instruments would be the accelerations
of the encoders' readings, and a sample has the readings alone.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.load.recursive import RecursiveEstimator, RecursiveLeastSquares
from drake_teleop.load.recursive_tls import RecursiveTotalLeastSquares
from drake_teleop.quantities import choice, quantity


@dataclass
class LoadEstimatorConfig:
    """Recursive estimation with offsets, Eqs. (7)-(8)."""

    enabled: bool = False
    """Learn from every sample. Only in free motion: a contact wrench would be taken for load."""
    forgetting: float = quantity(1.0, "1", 0.9, 1.0, "forgetting factor a sample; 1 = none")
    method: str = choice(
        "rls", ("rls", "rtls"), "recursive least squares, or total: allows for noisy accelerations"
    )
    settled_bound: float = quantity(
        0.05, "1", 1e-6, 10.0, "predicted uncertainty that counts as settled, of a natural value"
    )


class LoadEstimator(LeafSystem):
    """Holds the load estimate and, when enabled, improves it with every sample.

    .. pydrake_system::

        name: LoadEstimator
        input_ports:
        - sample: the wrist sensor's sample
        output_ports:
        - load_estimate: (16,) Eq. (7), [offsets (6); phi (10)] in S about So
        - settled: (1,) 1 once every parameter is predicted to be known within the config's bound

    Args:
        config: whether to learn, how, and how fast to forget.
        noise_std: (6,) weights, 1 sigma of the wrench channels [N, N m].
        motion_std: (9,) 1 sigma of s [m/s^2], omega [rad/s] and alpha [rad/s^2], for "rtls". Only
            the ratios among all of them matter, so they may be those before a filter.
        period: sampling period [s].
        sample_size: length of the sample.
        initial: (16,) the estimate to start from.
    """

    def __init__(
        self,
        config: LoadEstimatorConfig,
        noise_std: NDArray[np.float64],
        motion_std: NDArray[np.float64],
        period: float,
        sample_size: int,
        initial: NDArray[np.float64],
    ) -> None:
        super().__init__()
        self._estimator = _estimator(config, noise_std, motion_std)
        start = np.asarray(initial, dtype=float)
        memory = self._estimator.initial_memory(start)
        self._shape = memory.shape
        self._sample = self.DeclareVectorInputPort("sample", sample_size)
        estimate = self.DeclareDiscreteState(start)
        self.DeclareDiscreteState(memory.ravel())
        self.DeclareStateOutputPort("load_estimate", estimate)
        self.DeclareVectorOutputPort("settled", 1, self._settled, {self.xd_ticket()})
        if config.enabled:
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        sample = self._sample.Eval(context)
        if sample[15] > 0.0:  # saturated: the wrench is not the load's
            return
        estimate, memory = (discrete_state.get_mutable_value(i) for i in (0, 1))
        self._estimator.update_into(estimate, memory.reshape(self._shape), sample)

    def _settled(self, context: Context, output: BasicVector) -> None:
        estimate, memory = (context.get_discrete_state(i).value() for i in (0, 1))
        output[0] = self._estimator.settled_at(estimate, memory.reshape(self._shape))


def _estimator(
    config: LoadEstimatorConfig, noise_std: NDArray[np.float64], motion_std: NDArray[np.float64]
) -> RecursiveEstimator:
    options = {"forgetting": config.forgetting, "bound": config.settled_bound}
    if config.method == "rtls":
        return RecursiveTotalLeastSquares(noise_std, motion_std, **options)
    return RecursiveLeastSquares(noise_std, **options)
