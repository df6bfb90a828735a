"""Stiffness and damping of a contact from force, depth and speed.

Over successive stretches of the displacement into the contact,

    change of force = k displacement + b change of speed

is solved by least squares with forgetting.
"""

from __future__ import annotations

from drake_teleop.common.compiled import njit

NUM_SUMS = 5  #: length of the sums of a contact, zero at the start
# Relative increase of the squared speed changes: where speed and displacement are proportional, the
# fit then assigns the force to stiffness.
_RIDGE = 0.05


@njit(cache=True)
def update_fit(sums, force_change, displacement, speed_change, keep):
    """Add a stretch to the sums and return the present estimate.

    Args:
        sums: (NUM_SUMS,) updated: products of displacement, speed change and force change.
        force_change: [N].
        displacement: displacement into the contact [m], not 0.
        speed_change: change of the speed into it [m/s].
        keep: share of the old sums that is kept, 0 to 1.

    Returns:
        stiffness [N/m] and damping [N s/m], neither below 0.
    """
    for i in range(NUM_SUMS):
        sums[i] *= keep
    sums[0] += displacement * displacement
    sums[1] += displacement * speed_change
    sums[2] += speed_change * speed_change
    sums[3] += force_change * displacement
    sums[4] += force_change * speed_change
    square = (1.0 + _RIDGE) * sums[2]
    determinant = sums[0] * square - sums[1] * sums[1]
    damping = sums[0] * sums[4] - sums[1] * sums[3]
    if not damping > 0.0:  # below, the determinant is not 0
        return max(sums[3] / sums[0], 0.0), 0.0
    return max(square * sums[3] - sums[1] * sums[4], 0.0) / determinant, damping / determinant


@njit(cache=True)
def smooth_slip(displayed, component, explained, share, max_slip):
    """Return the rendered force along a mean direction that friction has tilted [N].

    A slip changes the component by up to f^2 / |w|, although the contact force is the same. A step
    of up to that size which depth and speed do not explain is rendered gradually (S3).

    Args:
        displayed: previous result [N].
        component: present component along the mean, not negative [N].
        explained: change that depth and speed explain [N].
        share: share of the remaining change that is rendered now.
        max_slip: f^2 / |w|, with the largest recent friction [N].
    """
    displayed += explained
    displayed += min(share, 1.0) * (component - displayed)
    return min(max(displayed, component - max_slip, 0.0), component + max_slip)


@njit(cache=True)
def slip_change(force_change, largest_change, max_slip):
    """Return the part of a stretch's force change that friction explains [N].

    It is the part outside the range between stiffness 0 and the largest one, bounded by `max_slip`.

    Args:
        force_change: [N].
        largest_change: change by the largest stiffness, with the sign of the displacement [N].
        max_slip: as in `smooth_slip` [N].
    """
    rest = force_change - min(max(force_change, min(largest_change, 0.0)), max(largest_change, 0.0))
    return min(max(rest, -max_slip), max_slip)
