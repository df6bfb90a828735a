"""Passivity method "force_limit": limits force and torque at the hand to small values.

Without an energy balance, an unstable loop stays unstable, but its limit cycle is bounded.
"""

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.numeric import Array
from drake_teleop.station.passivity import none
from drake_teleop.station.passivity.memory import SLAVE_PER_MASTER_MOTION, own_parameters
from drake_teleop.station.passivity.packet import limit_group

_WRENCH_LIMIT_SLICE = own_parameters().vector(2)  # in the master's power units [N, N m]


@settings
@dataclass
class ForceLimitConfig:
    """Parameters of the passivity method "force_limit"."""

    force: float = quantity(1.0, "N", 0.0, 1e4, "largest force at the hand")
    torque: float = quantity(0.03, "N m", 0.0, 1e3, "largest torque at the hand")

    def pack_into(self, p: Array) -> None:
        p[_WRENCH_LIMIT_SLICE] = np.divide([self.force, self.torque], p[SLAVE_PER_MASTER_MOTION])


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    none.master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet)
    for g in range(2):
        limit_group(wrench, g, p[_WRENCH_LIMIT_SLICE][g])
