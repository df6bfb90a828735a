"""What a contact pushes with, over its depth and its speed: stiffness and damping together.

Of stretches of the way into it, each from the end of the last one,

    change of force = k way + b change of speed

by least squares that forget. A wall that damps would else be taken for a stiffer one on the way in
and for a softer one on the way out.
"""

from __future__ import annotations

from drake_teleop.common.compiled import njit

SUMS = 5  #: numbers to remember for each contact, all zeros at the start
# Added to the sum of the squared changes of speed. Where speed and way go together nothing tells
# the two apart, and what is found is stiffness.
_RIDGE = 0.05


@njit(cache=True)
def fit(sums, more, way, faster, keep):
    """Takes up a stretch, and returns what is found now.

    Args:
        sums: (SUMS,) changed: of way^2, way faster, faster^2, more way, more faster.
        more: change of the force [N] (or of a torque, [N m], likewise below).
        way: way into the contact [m], not 0.
        faster: change of the speed into it [m/s].
        keep: share of what was known that is kept, 0 to 1.

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
    if not damping > 0.0:  # and so the determinant is not 0 below
        return max(sums[3] / sums[0], 0.0), 0.0
    return max(square * sums[3] - sums[1] * sums[4], 0.0) / determinant, damping / determinant


@njit(cache=True)
def steadied(push, size, explained, share, turned):
    """What is shown along a mean direction that friction has tilted.

    A tip that is held sideways by f tilts the mean of its wrench w by f / |w| at most. Where it
    slips, what there is along the mean changes by f^2 / |w|, though nobody presses otherwise. So a
    step of up to that which depth and speed do not explain is shown gradually; the rest is at once.

    Args:
        push: what was shown [N].
        size: what there is along the mean now, not negative [N].
        explained: what it should have changed by [N].
        share: of the rest that is shown now.
        turned: f^2 / |w|, of the largest friction of late [N].
    """
    push += explained
    push += min(share, 1.0) * (size - push)
    return min(max(push, size - turned, 0.0), size + turned)


@njit(cache=True)
def slipped(more, most, turned):
    """What of a stretch's change of force friction explains, and so no stiffness.

    A tip that slips changes the force where there is hardly any way. What a stiffness from 0 to a
    certain one does not explain is friction's, up to what that can do.

    Args:
        more: change of the force [N].
        most: what the stiffest would have changed it by, with the sign of the way [N].
        turned: as in `steadied` [N].
    """
    rest = more - min(max(more, min(most, 0.0)), max(most, 0.0))
    return min(max(rest, -turned), turned)
