"""Places of the values in the memory and parameter vectors of one end of the channel.

Both are plain float64 vectors, so that they fit a Drake discrete state and a compiled loop. A
method names its own places at the head of its file with `own_memory` and `own_parameters`.
"""

from __future__ import annotations

MEMORY = 160  #: length of the memory of one end
PARAMETERS = 26  #: length of the parameters, packed by `methods.parameters`


class Slots:
    """Allocator of named places in a vector, one after the other.

    Args:
        size: length of the vector.
        first: first place.
    """

    def __init__(self, size: int, first: int = 0) -> None:
        self._size, self._next = size, first

    def number(self) -> int:
        return self.vector(1).start

    def vector(self, length: int) -> slice:
        """Return the place of a vector; ``array[place]`` is a view of it.

        Raises:
            IndexError: if the vector does not fit.
        """
        first, self._next = self._next, self._next + length
        if self._next > self._size:
            raise IndexError(f"{self._next} numbers do not fit into {self._size}")
        return slice(first, self._next)

    def rest(self) -> slice:
        return self.vector(self._size - self._next)


_memory = Slots(MEMORY)
STEPS = _memory.number()  #: steps so far: the number of the next packet
LEDGER = _memory.vector(2)  #: energy that this end may still give out, for each group [J]
RECEIVED = _memory.vector(2)  #: the other end's counter of energy, as accounted so far [J]
SENT = _memory.vector(2)  #: this end's counter of energy, as sent [J]
LOST = _memory.vector(2)  #: energy that the method took out of the loop here [J]
HELD = _memory.vector(6)  #: the wrench at this port since the last step
OF_LOAD = _memory.vector(6)  #: of the slave's wrench now, what its load's weight and inertia are
COMMAND = _memory.vector(13)  #: the slave's command since the last step, X_WS and its twist
#: At the slave, for how long from now on its command stays where it is: a new channel fills [s].
FILLS = _memory.number()
HAND_VELOCITY = _memory.vector(6)  #: at the master, filtered, see `retreat`
PACKET = _memory.vector(38)  #: the last packet that was sent, see `packet`
_OWN = _memory.rest()
_command = Slots(COMMAND.stop, COMMAND.start)
COMMAND_POSE, COMMAND_TWIST = _command.vector(7), _command.rest()

_parameters = Slots(PARAMETERS)
#: What the device can display, in the master's power units [N, N m].
LIMIT = _parameters.vector(2)
#: Of the slave's servo, in the master's power units [N/m, N m/rad].
STIFFNESS = _parameters.vector(2)
#: Of the slave's servo, likewise [N s/m, N m s/rad].
DAMPING = _parameters.vector(2)
#: Of the slave where it is moved, in the master's power units [kg, kg m^2].
MASS = _parameters.vector(2)
#: A wrench at the hand over one in the master's power units, of force and torque.
MOTION_SCALE = _parameters.vector(2)
#: Speed of the hand along the wrench at which that begins to fade, in the slave's [m/s, rad/s].
RETREAT = _parameters.vector(2)
_METHOD = _parameters.rest()


def own_memory() -> Slots:
    """Return an allocator for the method's own part of the memory, zero at the start."""
    return Slots(MEMORY, _OWN.start)


def own_parameters() -> Slots:
    """Return an allocator for the method's own part of the parameters."""
    return Slots(PARAMETERS, _METHOD.start)
