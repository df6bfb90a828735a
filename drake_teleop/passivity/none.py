"""No method: the wrench and the pose are passed on as they come.

Energy is created in the channel as soon as there is delay or loss. It is the baseline.
"""

from __future__ import annotations

from drake_teleop._compiled import njit
from drake_teleop.passivity.memory import COMMAND, HELD, LIMIT
from drake_teleop.passivity.packet import POSE, VELOCITY, WRENCH, arrived, fill, limit


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    for i in range(6):
        wrench[i] = received[WRENCH + i]
    for g in range(2):
        limit(wrench, g, p[LIMIT + g])
    memory[HELD : HELD + 6] = wrench
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    if arrived(received):
        memory[COMMAND : COMMAND + 7] = received[POSE : POSE + 7]
        memory[COMMAND + 7 : COMMAND + 13] = received[VELOCITY : VELOCITY + 6]
    command[:] = memory[COMMAND : COMMAND + 13]
    memory[HELD : HELD + 6] = wrench
    fill(pose, twist, wrench, packet)
