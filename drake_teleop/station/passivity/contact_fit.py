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

    The last rendered force, `rendered` [N], changes by `explained_change` [N], caused by depth and
    speed. Then `removed_share` of its difference from the measured force [N] is removed; at most
    `max_difference` [N] remains.
    """
    rendered += explained_change
    rendered += min(removed_share, 1.0) * (measured - rendered)
    return min(max(rendered, measured - max_difference, 0.0), measured + max_difference)


@njit(cache=True)
def force_change_by_slip(force_change, largest_change, max_change):
    """Return the part of a force change [N] outside 0 to `largest_change`, limited to `max_change`.

    The largest stiffness causes `largest_change` [N]; slip may cause the rest.
    """
    rest = force_change - min(max(force_change, min(largest_change, 0.0)), max(largest_change, 0.0))
    return min(max(rest, -max_change), max_change)
