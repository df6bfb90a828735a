"""Layout of the float64 vectors that contain memory and parameters of one end of the channel."""

from __future__ import annotations

MEMORY_SIZE = 180  #: length of the memory vector of one end
NUM_PARAMETERS = 26  #: length of the parameter vector, which `method_parameters` fills


class SlotAllocator:
    """Allocator of consecutive places in a vector of `size` numbers, from index `first`."""

    def __init__(self, size: int, first: int = 0) -> None:
        self._size, self._next = size, first

    def number(self) -> int:
        return self.vector(1).start

    def vector(self, length: int) -> slice:
        """Reserve `length` places and return their slice."""
        first, self._next = self._next, self._next + length
        if self._next > self._size:
            raise IndexError(
                f"a vector of size {self._size} has no index {self._next - 1}; increase it"
            )
        return slice(first, self._next)

    def rest(self) -> slice:
        return self.vector(self._size - self._next)


_memory = SlotAllocator(MEMORY_SIZE)
STEP_COUNT = _memory.number()  #: number of steps so far; also the number of the next packet
STORED_ENERGY = _memory.vector(2)  #: energy that this end may still release, by group [J]
RECEIVED_ENERGY = _memory.vector(2)  #: energy from the other end that is credited here [J]
SENT_ENERGY = _memory.vector(2)  #: this end's counter of sent energy [J]
DISSIPATED_ENERGY = _memory.vector(2)  #: energy that the method removed from the loop here [J]
HELD_WRENCH = _memory.vector(6)  #: wrench at this port since the last step
LOAD_WRENCH = _memory.vector(6)  #: part of the slave's wrench from its load's weight and inertia
COMMAND = _memory.vector(13)  #: slave's command since the last step: pose X_WS, twist
#: Remaining time in which the slave keeps its command while a new channel fills [s].
FILL_TIME = _memory.number()
HAND_VELOCITY = _memory.vector(6)  #: filtered twist at the master, see `retreat`
PACKET = _memory.vector(38)  #: last sent packet, see `packet`
_METHOD_MEMORY = _memory.rest()
_command = SlotAllocator(COMMAND.stop, COMMAND.start)
COMMAND_POSE, COMMAND_TWIST = _command.vector(7), _command.rest()

_parameters = SlotAllocator(NUM_PARAMETERS)
#: Largest force and torque at the hand, in the master's power units [N, N m].
WRENCH_LIMIT = _parameters.vector(2)
#: K of the slave's servo, in the master's power units [N/m, N m/rad].
STIFFNESS = _parameters.vector(2)
#: D of the slave's servo, in the master's power units [N s/m, N m s/rad].
DAMPING = _parameters.vector(2)
#: Mass of the slave at its tool, in the master's power units [kg, kg m^2].
MASS = _parameters.vector(2)
#: Factors from the master's power units to the wrench at the hand, for force and torque.
MOTION_SCALE = _parameters.vector(2)
#: Speed of the hand along the wrench at which the wrench starts to fade, scaled to slave motion
#: [m/s, rad/s].
MAX_RETREAT = _parameters.vector(2)
_METHOD_PARAMETERS = _parameters.rest()


def own_memory() -> SlotAllocator:
    """Return an allocator for a method's own part of the memory, which starts with zeros."""
    return SlotAllocator(MEMORY_SIZE, _METHOD_MEMORY.start)


def own_parameters() -> SlotAllocator:
    return SlotAllocator(NUM_PARAMETERS, _METHOD_PARAMETERS.start)
