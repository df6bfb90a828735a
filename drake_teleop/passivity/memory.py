"""What every method remembers at one end of the channel, and where its parameters lie.

Both are plain float64 vectors, so that they fit a Drake discrete state and a compiled loop.
"""

from __future__ import annotations

# Memory (MEMORY,) of one end.
STEPS = 0  #: steps so far: the number of the next packet
LEDGER = 1  #: (2,) energy that this end may still give out, for each group [J]
RECEIVED = 3  #: (2,) the other end's counter of energy, as accounted so far [J]
SENT = 5  #: (2,) this end's counter of energy, as sent [J]
LOST = 7  #: (2,) energy that the method took out of the loop here [J]
HELD = 9  #: (6,) the wrench at this port since the last step
COMMAND = 15  #: (13,) the slave's command [pose 7; twist 6] since the last step
PACKET = 28  #: (32,) the last packet that was sent
OWN = 60  #: here begins what one method alone remembers
MEMORY = 92

# Parameters (PARAMETERS,), packed by `methods.parameters`.
LIMIT = 0  #: (2,) what the device can display, in the master's power units [N, N m]
STIFFNESS = 2  #: (2,) of the slave's servo, in the master's power units [N/m, N m/rad]
DAMPING = 4  #: (2,) of the slave's servo, likewise [N s/m, N m s/rad]
METHOD = 6  #: here begin the parameters of the method that was chosen
PARAMETERS = 22
