"""The estimator of Fig. 2: recursive least squares for the load and the offsets, in the loop.

The same kernel works on logs (`drake_teleop.load.recursive`). It sees the sensor's samples only.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_teleop.load.recursive import RecursiveLeastSquares
from drake_teleop.quantities import quantity


@dataclass
class LoadEstimatorConfig:
    """Recursive least squares with offsets, Eqs. (7)-(8)."""

    enabled: bool = False
    """Learn from every sample. Only in free motion: a contact wrench would be taken for load."""
    forgetting: float = quantity(1.0, "1", 0.9, 1.0, "forgetting factor a sample; 1 = none")


class LoadEstimator(LeafSystem):
    """Holds the load estimate and, when enabled, improves it with every sample.

    .. pydrake_system::

        name: LoadEstimator
        input_ports:
        - sample: the wrist sensor's sample
        output_ports:
        - load_estimate: (16,) Eq. (7), [offsets (6); phi (10)] in S about So

    Args:
        config: whether to learn, and how fast to forget.
        noise_std: (6,) weights, 1 sigma of the wrench channels [N, N m].
        period: sampling period [s].
        sample_size: length of the sample.
        initial: (16,) the estimate to start from.
    """

    def __init__(
        self,
        config: LoadEstimatorConfig,
        noise_std: NDArray[np.float64],
        period: float,
        sample_size: int,
        initial: NDArray[np.float64],
    ) -> None:
        super().__init__()
        self._estimator = RecursiveLeastSquares(noise_std, config.forgetting)
        self._sample = self.DeclareVectorInputPort("sample", sample_size)
        estimate = self.DeclareDiscreteState(np.asarray(initial, dtype=float))
        self.DeclareDiscreteState(self._estimator.covariance.ravel())
        self.DeclareStateOutputPort("load_estimate", estimate)
        if config.enabled:
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        sample = self._sample.Eval(context)
        if sample[15] > 0.0:  # saturated: the wrench is not the load's
            return
        estimate, covariance = (discrete_state.get_mutable_value(i) for i in (0, 1))
        self._estimator.update_into(estimate, covariance.reshape(16, 16), sample)
