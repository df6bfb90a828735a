"""Client of a haptic device: sends poses to the station and displays its forces at 1 kHz.

python -m drake_teleop.live.device_client virtual udp://127.0.0.1:PORT [--grip light]
python -m drake_teleop.live.device_client haply://localhost:10001 udp://127.0.0.1:PORT
"""

from __future__ import annotations

import argparse
import json
import math
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder, write_json
from drake_teleop.common.interruption import delayed_signals, install_interrupt_handlers
from drake_teleop.live import device_packets
from drake_teleop.live.device_guard import DeviceGuard, DeviceLimits
from drake_teleop.live.haply import HaplyDevice
from drake_teleop.robots.udp import host_and_port
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES

_CLIENT_PERIOD_S, _MAX_CLIENT_PERIOD_S = 1e-3, 0.1  # s
_MAX_STORED_FORCE_AGES = 100_000  # ticks
_SIMULATION_STEPS_PER_MS = 10  # per ms
_VIRTUAL_MASS_KG, _VIRTUAL_DAMPING_NS_M = 0.15, 0.5  # of the device [kg], [N s/m]
HandMotionFunction: TypeAlias = Callable[[float], tuple[Sequence[float], Sequence[float]]]
"""Function from time [s] to intended position [m] and velocity [m/s]."""


class HapticDevice(Protocol):
    """Interface of a haptic device."""

    @property
    def limits(self) -> DeviceLimits: ...

    def read(self) -> device_packets.DeviceState | None:
        """Return the next pose, without number and time; None if none arrives within 0.5 s."""

    def set_wrench(self, wrench: Sequence[float]) -> None:
        """Render the wrench [f; tau] in the device's base frame B [N, N m]."""

    def close(self) -> None:
        """Set zero force and disconnect the device."""


class DeviceClient:
    """Connection of a haptic device to a station.

    `force_ages_s`: for each displayed force, the age [s] of the position that caused it.
    """

    def __init__(self, device: HapticDevice, address: str, *, observe: bool = True) -> None:
        self.guard = DeviceGuard(device.limits, observe=observe)
        self.force_ages_s: deque[float] = deque(maxlen=_MAX_STORED_FORCE_AGES)
        self._device, self._number = device, 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(host_and_port(address))
        self._socket.setblocking(False)
        self._command: device_packets.ForceCommand | None = None
        self._last_tick: float | None = None

    def exchange_packets(
        self, clock: Callable[[], float] = time.perf_counter
    ) -> tuple[float, ...] | None:
        """Send the pose; limit, display and return the newest wrench (6,); None without a pose."""
        pose = self._device.read()
        now = clock()
        self._receive_force_commands()
        if pose is None:
            self._device.set_wrench((0.0,) * 6)
            self.guard.reset_force_and_motion()
            return None
        command = self._command
        age = now - command.t if command is not None else np.inf
        elapsed = _CLIENT_PERIOD_S if self._last_tick is None else now - self._last_tick
        period = min(max(elapsed, 1e-5), _MAX_CLIENT_PERIOD_S)
        self._last_tick = now
        commanded = (0.0,) * 6 if command is None else command.wrench
        wrench = self.guard.limit_wrench(pose.position, commanded, age, period)
        self._device.set_wrench(wrench)
        self._send_state(pose, now, age)
        return wrench

    def _receive_force_commands(self) -> None:
        while True:
            try:
                packet = self._socket.recv(device_packets.MAX_PACKET_BYTES + 1)
            except BlockingIOError:
                return
            except ConnectionError:  # the station is not started yet
                continue
            command = device_packets.unpack_force(packet)
            if command is None or command.number > self._number:
                continue
            if self._command is None or command.number >= self._command.number:
                self._command = command

    def _send_state(self, pose: device_packets.DeviceState, now: float, force_age: float) -> None:
        self._number += 1
        force_age_s = force_age if force_age < 1.0 else 0.0
        if force_age_s:
            self.force_ages_s.append(force_age_s)
        state = pose._replace(number=self._number, t=now, force_age_s=force_age_s)
        try:
            self._socket.send(device_packets.pack_state(state))
        except (BlockingIOError, ConnectionError):  # the next one is newer
            return

    def close(self) -> None:
        self._device.close()
        self._socket.close()


class VirtualDevice:
    """Simulated device in a moving hand; `energy`: work done against the rendered force [J]."""

    def __init__(self, hand_motion: HandMotionFunction, grip: str = "medium") -> None:
        held, self._hand = GRIP_IMPEDANCES[grip], hand_motion
        self._mass, self._k, self._d = _VIRTUAL_MASS_KG + held.mass, held.stiffness, held.damping
        self.position, self.velocity = list(map(float, hand_motion(0.0)[0])), [0.0, 0.0, 0.0]
        self.energy, self._t = 0.0, 0.0

    def simulate_motion(self, force: Sequence[float], seconds: float) -> None:
        """Simulate `seconds` under a constant rendered force (3,) [N]."""
        steps = max(math.ceil(seconds * 1e3 * _SIMULATION_STEPS_PER_MS - 1e-9), 1)
        h = seconds / steps
        for _ in range(steps):
            self._t += h
            at, speed = self._hand(self._t)
            for i in range(3):
                x, v = self.position[i], self.velocity[i]
                elastic, damped = self._k * (at[i] - x), self._d * (speed[i] - v)
                pull = force[i] - _VIRTUAL_DAMPING_NS_M * v + elastic + damped
                v += h * pull / self._mass
                self.velocity[i], self.position[i] = v, x + h * v
                self.energy -= force[i] * h * v


def tapping_motion(depth: float, *, hertz: float = 0.5) -> HandMotionFunction:
    """Return a hand motion that taps `hertz` times a second, from z = 10 mm to -`depth` [m]."""
    lift, hold = 0.01, 0.6

    def hand_motion(t: float) -> tuple[Sequence[float], Sequence[float]]:
        phase, way = (t * hertz) % 1.0, 0.5 * (1.0 - hold)
        if phase < way:
            s, rate = phase / way, 1.0
        elif phase < way + hold:
            s, rate = 1.0, 0.0
        else:
            s, rate = (1.0 - phase) / way, -1.0
        smooth, slope = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) * rate * hertz / way
        far = depth + lift
        return (0.0, 0.0, lift - far * smooth), (0.0, 0.0, -far * slope)

    return hand_motion


class RealTimeVirtualDevice:
    """Virtual device whose time is the computer's clock."""

    limits = DeviceLimits(force=10.0)

    def __init__(self, virtual: VirtualDevice) -> None:
        self.virtual = virtual
        self._wrench: Sequence[float] = (0.0,) * 6
        self._due = self._simulated_until = time.perf_counter()

    def read(self) -> device_packets.DeviceState:
        self._due += _CLIENT_PERIOD_S
        now = time.perf_counter()
        if self._due > now:
            time.sleep(self._due - now)
        now = time.perf_counter()
        if now - self._due > _MAX_CLIENT_PERIOD_S:  # missed ticks are skipped
            self._due = self._simulated_until = now
        self.virtual.simulate_motion(self._wrench[:3], max(now - self._simulated_until, 1e-6))
        self._simulated_until = now
        x, y, z = self.virtual.position
        return device_packets.DeviceState(0, 0.0, (x, y, z))

    def set_wrench(self, wrench: Sequence[float]) -> None:
        self._wrench = wrench

    def close(self) -> None: ...


def open_device(address: str, grip: str, depth: float) -> HapticDevice:
    """Return the device `virtual` (a hand with `grip` taps `depth` [m] deep) or haply://HOST:PORT."""
    if address == "virtual":
        return RealTimeVirtualDevice(VirtualDevice(tapping_motion(depth), grip))
    if address.startswith("haply://"):
        return HaplyDevice(address)
    remedy = "use virtual or haply://HOST:PORT"
    raise DrakeTeleopError("is not the address of a haptic device", where=address, remedy=remedy)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add = parser.add_argument
    add("device", help="haptic device: virtual, or haply://HOST:PORT")
    add("station", help="station: udp://127.0.0.1:PORT of `drake-teleop drive`")
    add("--grip", choices=[*GRIP_IMPEDANCES], default="medium", help="grip on the virtual device")
    add("--depth", type=float, default=0.08, help="tapping depth of the virtual device [m]")
    add("--seconds", type=float, default=math.inf, help="duration [s] (default: no limit)")
    add("--no-observer", action="store_true", help="disable the passivity observer")
    add("--json", type=Path, help="JSON file to write: force delay, largest force, energy")
    options = parser.parse_args(arguments)
    if options.json is not None:
        make_folder(options.json.parent)
    device = open_device(options.device, options.grip, options.depth)
    client = DeviceClient(device, options.station, observe=not options.no_observer)
    end, largest = time.perf_counter() + options.seconds, 0.0
    try:
        while time.perf_counter() < end:
            wrench = client.exchange_packets() or (0.0,) * 6
            largest = max(largest, float(np.linalg.norm(wrench[:3])))
    except KeyboardInterrupt:
        pass
    finally:
        with delayed_signals():  # the device would keep its last force
            client.close()
    behind = np.array(client.force_ages_s or [0.0])
    figures = {
        "behind_p50_ms": float(1e3 * np.median(behind)),
        "behind_p99_ms": float(1e3 * np.percentile(behind, 99)),
        "largest_force_n": largest,
        "energy_j": client.guard.energy,
        "slowed": client.guard.num_reduced_forces,
    }
    if options.json is not None:
        write_json(options.json, figures)
    print(json.dumps(figures))


if __name__ == "__main__":
    install_interrupt_handlers()
    try:
        main()
    except DrakeTeleopError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
