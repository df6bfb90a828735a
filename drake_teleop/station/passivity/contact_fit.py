"""Stiffness and damping of a contact from force, depth and speed.

Over successive stretches of the displacement into the contact,

    change of force = k displacement + b change of speed

is solved by least squares with forgetting.
"""

from __future__ import annotations

from drake_teleop.common.compiled import njit

SUMS = 5  #: length of the sums of a contact, zero at the start
# Relative increase of the squared speed changes: where speed and displacement are proportional, the
# fit then assigns the force to stiffness.
_RIDGE = 0.05


@njit(cache=True)
def fit(sums, more, way, faster, keep):
    """Add a stretch to the sums and return the present estimate.

    Args:
        sums: (SUMS,) updated: of way^2, way faster, faster^2, more way, more faster.
        more: change of the force [N].
        way: displacement into the contact [m], not 0.
        faster: change of the speed into it [m/s].
        keep: share of the old sums that is kept, 0 to 1.

    Returns:
        stiffness [N/m] and damping [N s/m], neither below 0.
    """
    for i in range(SUMS):
        sums[i] *= keep
    sums[0] += way * way
    sums[1] += way * faster
    sums[2] += faster * faster
    sums[3] += more * way
    sums[4] += more * faster
    square = (1.0 + _RIDGE) * sums[2]
    determinant = sums[0] * square - sums[1] * sums[1]
    damping = sums[0] * sums[4] - sums[1] * sums[3]
    if not damping > 0.0:  # below, the determinant is not 0
        return max(sums[3] / sums[0], 0.0), 0.0
    return max(square * sums[3] - sums[1] * sums[4], 0.0) / determinant, damping / determinant


@njit(cache=True)
def steadied(push, size, explained, share, turned):
    """Return the rendered force along a mean direction that friction has tilted [N].

    A slip changes the component by up to f^2 / |w|, although the contact force is the same. A step
    of up to that size which depth and speed do not explain is rendered gradually (S3).

    Args:
        push: previous result [N].
        size: present component along the mean, not negative [N].
        explained: change that depth and speed explain [N].
        share: share of the remaining change that is rendered now.
        turned: f^2 / |w|, with the largest recent friction [N].
    """
    push += explained
    push += min(share, 1.0) * (size - push)
    return min(max(push, size - turned, 0.0), size + turned)


@njit(cache=True)
def slipped(more, most, turned):
    """Return the part of a stretch's force change that friction explains [N].

    It is the part outside the range from stiffness 0 to the largest stiffness, bounded by `turned`.

    Args:
        more: change of the force [N].
        most: change by the largest stiffness, with the sign of the displacement [N].
        turned: as in `steadied` [N].
    """
    rest = more - min(max(more, min(most, 0.0)), max(most, 0.0))
    return min(max(rest, -turned), turned)
