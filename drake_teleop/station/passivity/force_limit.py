"""Local force limit: what is felt never exceeds a force that the hand can hold by itself.

It keeps no account of energy. A loop that is unstable stays so, but its limit cycle is no stronger
than the limit, and it ends where the hand and the device's friction take more than the limited
wrench can give. This is the ceiling that safety standards ask for, whatever the other end says.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity
from drake_teleop.common.vectors import put
from drake_teleop.station.passivity import none
from drake_teleop.station.passivity.memory import HELD, MOTION_SCALE, own_parameters
from drake_teleop.station.passivity.packet import limit

_OWN_LIMIT = own_parameters().vector(2)  # in the master's power units [N, N m]


@settings
@dataclass
class ForceLimitConfig:
    """Parameters of the local force limit."""

    force: float = quantity(1.0, "N", 0.0, 1e4, "largest force at the hand")
    torque: float = quantity(0.03, "N m", 0.0, 1e3, "largest torque at the hand")

    def pack_into(self, p: NDArray[np.float64]) -> None:
        """Writes the values to where the steps read them."""
        p[_OWN_LIMIT] = np.divide([self.force, self.torque], p[MOTION_SCALE])


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    none.master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet)
    for g in range(2):
        limit(wrench, g, p[_OWN_LIMIT][g])
    put(memory, HELD.start, wrench, 0, 6)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    none.slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet)
