"""What an identification knows: intervals, determined combinations, priors, predicted wrenches.

Standard deviations and degrees of freedom come with the `Identification`; how they are made honest
in coloured noise is said in the docstring of `identification`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array
from drake_teleop.load.identification import (
    Identification,
)

_MANY_DEGREES = 1e6  # beyond, Student's t is the normal distribution to six digits


def intervals(load: Identification, level: float = 0.95) -> tuple[Array, Array]:
    """(16,) lower and (16,) upper ends of the intervals of [offsets; phi] [SI].

    Student's t with the degrees of freedom of each variance: variances that were estimated from few
    independent stretches of noise scatter themselves, and 1.96 standard deviations would hold
    less often than stated. Undetermined parameters have (-inf, inf).

    Args:
        load: the identification.
        level: share of the records in which an interval is to hold the truth.

    Raises:
        DrakeTeleopError: if the level is not within (0, 1).
    """
    if not 0.0 < level < 1.0:
        raise DrakeTeleopError(f"{level} is not within (0, 1)", where="level")
    degrees = np.minimum(load.degrees_of_freedom, _MANY_DEGREES)
    half = stdtrit(degrees, 0.5 + 0.5 * level) * load.standard_deviations
    theta = np.concatenate([load.offsets, load.phi])
    return theta - half, theta + half


def prior_dominated(
    standard_deviations: ArrayLike, prior_std: ArrayLike, share: float = 0.5
) -> NDArray[np.bool_]:
    """Which parameters are still mostly the prior's, for `Identification.prior_dominated`.

    An estimate with a Gaussian prior is the mean of data and prior weighted by their information;
    the prior's weight is the square of (posterior / prior standard deviation). From a share of 0.5
    on, the prior has a quarter of the weight or more, and the data alone would be less certain than
    0.58 of the prior.

    Args:
        standard_deviations: (n,) of the estimate.
        prior_std: (n,) of the prior; inf for none.
        share: of the prior's standard deviation from which on it dominates.

    Returns:
        (n,) bools.

    Raises:
        DrakeTeleopError: if the shapes differ or a standard deviation of the prior is not positive.
    """
    deviations, prior = np.asarray(standard_deviations), np.asarray(prior_std)
    if deviations.shape != prior.shape or not (prior > 0.0).all():
        raise DrakeTeleopError(
            f"takes positive numbers, one for each of {deviations.shape} parameters",
            where="prior_std",
        )
    return np.asarray(deviations >= share * prior)
