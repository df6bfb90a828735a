"""Least-squares fit of a contact's stiffness k and damping b, with forgetting.

Each displacement adds one equation: change of force = k displacement + b change of speed.
"""

from __future__ import annotations

from drake_teleop.common.compiled import njit

NUM_CONTACT_FIT_SUMS = 5  #: number of sums of the fit; all are 0 at the start
# Relative increase of the squared speed changes: where speed and displacement are proportional, the
# fit then assigns the force to stiffness.
_RELATIVE_RIDGE_PENALTY_OF_DAMPING = 0.05


@njit(cache=True)
def update_contact_fit(sums, force_change, displacement, speed_change, kept_weight):
    """Add one displacement [m] to the fit; return stiffness [N/m] and damping [N s/m], both >= 0.

    First, `sums` (NUM_CONTACT_FIT_SUMS,) are multiplied by `kept_weight`, 0 to 1.
    """
    for i in range(NUM_CONTACT_FIT_SUMS):
        sums[i] *= kept_weight
    sums[0] += displacement * displacement
    sums[1] += displacement * speed_change
    sums[2] += speed_change * speed_change
    sums[3] += force_change * displacement
    sums[4] += force_change * speed_change
    square = (1.0 + _RELATIVE_RIDGE_PENALTY_OF_DAMPING) * sums[2]
    determinant = sums[0] * square - sums[1] * sums[1]
    damping = sums[0] * sums[4] - sums[1] * sums[3]
    if not damping > 0.0:  # after this branch the determinant is not 0
        return max(sums[3] / sums[0], 0.0), 0.0
    return max(square * sums[3] - sums[1] * sums[4], 0.0) / determinant, damping / determinant


@njit(cache=True)
def force_without_slip_steps(rendered, measured, explained_change, removed_share, max_difference):
    """Return the contact force to render [N], without the steps that stick-slip friction causes.

    The last force, `rendered` [N], changes by `explained_change` [N] due to depth and speed. It
    then approaches `measured` [N] by `removed_share`, to at most `max_difference` [N].
    """
    rendered += explained_change
    rendered += min(removed_share, 1.0) * (measured - rendered)
    return min(max(rendered, measured - max_difference, 0.0), measured + max_difference)


@njit(cache=True)
def force_change_by_slip(force_change, elastic_change, max_change):
    """Return the part of a force change [N] that no elastic contact explains.

    An elastic contact causes 0 to `elastic_change`. The result is at most `max_change`.
    """
    elastic = min(max(force_change, min(elastic_change, 0.0)), max(elastic_change, 0.0))
    return min(max(force_change - elastic, -max_change), max_change)
