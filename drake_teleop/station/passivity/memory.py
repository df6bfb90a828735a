"""Layout of the float64 vectors with memory and parameters of one end of the channel."""

from __future__ import annotations

MEMORY_SIZE = 200  #: length of the memory vector of one end
NUM_PARAMETERS = 28  #: length of the parameter vector, which `method_parameters` fills


class SlotAllocator:
    """Allocator of consecutive places in a vector of `size` numbers, from index `first`."""

    def __init__(self, size: int, first: int = 0) -> None:
        self._size, self._next = size, first

    def number(self) -> int:
        return self.vector(1).start

    def numbers(self, count: int) -> range:
        """Reserve `count` numbers of the vector; return their indices."""
        reserved = self.vector(count)
        return range(reserved.start, reserved.stop)

    def vector(self, length: int) -> slice:
        """Reserve `length` places and return their slice."""
        first, self._next = self._next, self._next + length
        if self._next > self._size:
            raise IndexError(
                f"SlotAllocator: {self._next} places are required, but the vector has {self._size};"
                " reserve fewer"
            )
        return slice(first, self._next)

    def rest(self) -> slice:
        return self.vector(self._size - self._next)


_memory_slots = SlotAllocator(MEMORY_SIZE)
STEP_COUNT = _memory_slots.number()  #: number of steps so far; also the number of the next packet
STORED_ENERGY = _memory_slots.vector(2)  #: energy that this end may still release, by group [J]
RECEIVED_ENERGY = _memory_slots.vector(2)  #: counter of energy received from the other end [J]
SENT_ENERGY = _memory_slots.vector(2)  #: this end's counter of sent energy [J]
DISSIPATED_ENERGY = _memory_slots.vector(2)  #: energy that the method dissipated at this end [J]
LAST_PORT_WRENCH = _memory_slots.vector(6)  #: wrench at this port since the last step
LOAD_WRENCH = _memory_slots.vector(6)  #: slave's wrench from its load's weight and inertia
COMMAND = _memory_slots.vector(13)  #: slave's command since the last step: pose X_WS, twist
#: Remaining time in which the slave keeps its command while a new channel fills [s].
CHANNEL_FILL_TIME_LEFT = _memory_slots.number()
FILTERED_HAND_VELOCITY = _memory_slots.vector(6)  #: filtered twist at the master, see `retreat`
LAST_HEALTHY_SENT_PACKET = _memory_slots.vector(38)  #: last sent packet, see `packet`
_METHOD_MEMORY_SLICE = _memory_slots.rest()
_command_slots = SlotAllocator(COMMAND.stop, COMMAND.start)
COMMAND_POSE, COMMAND_TWIST = _command_slots.vector(7), _command_slots.rest()

# Limit, servo and mass are in the master's power units.
_parameter_slots = SlotAllocator(NUM_PARAMETERS)
WRENCH_LIMIT = _parameter_slots.vector(2)  #: largest force and torque at the hand [N, N m]
SERVO_K = _parameter_slots.vector(2)  #: K of the slave's servo [N/m, N m/rad]
SERVO_D = _parameter_slots.vector(2)  #: D of the slave's servo [N s/m, N m s/rad]
SLAVE_MASS = _parameter_slots.vector(2)  #: mass of the slave at its tool [kg, kg m^2]
#: Factors from the master's power units to the wrench at the hand, for force and torque.
SLAVE_PER_MASTER_MOTION = _parameter_slots.vector(2)
#: Speed of the hand along the wrench at which the wrench starts to fade, scaled to slave motion
#: [m/s, rad/s].
FORCE_FADE_HAND_SPEED = _parameter_slots.vector(2)
_METHOD_PARAMETER_SLICE = _parameter_slots.rest()


def own_memory() -> SlotAllocator:
    """Return an allocator of the part of an end's memory for its method, 0 at the start."""
    return SlotAllocator(MEMORY_SIZE, _METHOD_MEMORY_SLICE.start)


def own_parameters() -> SlotAllocator:
    """Return an allocator of the part of the parameters for the method."""
    return SlotAllocator(NUM_PARAMETERS, _METHOD_PARAMETER_SLICE.start)
