"""Is the link to a haptic device fast, safe when it is silent, and passive (virtual device)?

    python benchmarks/device.py [--seconds 10] [--drive] [--json FILE]

`link_`: a virtual device in another process at 1 kHz over UDP, and here a wall by the handlers of a
drive: time from taking a packet to sending the force, and the age of the force at the device.
Python's garbage collection waits, as in the server. `silent_`: the force at the device 50 ms after
the station falls silent. `leaf_` and `wall_`: the device's client with and without its passivity
observer in simulated time, at the leaf (291 N/m at the hand) and a wall of 6 kN/m. Forces are up to
five samples late, and as late as just measured. Figures are the least energy of the port [J], and
the oscillation of the resting hand [m]. `station_wall_`: likewise with the whole station, in
simulated time. `fuzz_`: random invalid messages. `--drive` adds the whole station in real time.
Baselines: the same without the observer; the share of time in which a process waited for a core.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from drake_teleop.lab.identified_load import identified_load
from drake_teleop.live.device_client import VirtualDevice, tapping_motion
from drake_teleop.live.device_guard import DeviceGuard, DeviceLimits
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.live.device_packets import DeviceState, pack_state, unpack_state
from drake_teleop.live.haply import parse_device_message
from drake_teleop.live.live import Live, without_garbage_collection
from drake_teleop.live.scenarios import live_scenario, with_task_space_device
from drake_teleop.live.session import Session
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.scenario import LoadScenario, replace

LEAF, WALL = 5100 / 17.5, 6000.0  # N/m at the hand
_TICK = 1e-3


def client(port: int, seconds: float, figures: Path, *more: str) -> subprocess.Popen[bytes]:
    """Start a virtual device in another process."""
    module = "drake_teleop.live.device_client"
    station = f"udp://127.0.0.1:{port}"
    line = [sys.executable, "-m", module, "virtual", station, "--seconds", str(seconds)]
    return subprocess.Popen([*line, "--json", str(figures), *more], stdout=subprocess.DEVNULL)


def waited() -> float:
    """Return the time that this thread has waited for a core [s]."""
    return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) * 1e-9


def linked(seconds: float) -> tuple[dict[str, float], np.ndarray]:
    """Return figures of the link at 1 kHz, and the ages of forces at the device in ticks."""
    with tempfile.TemporaryDirectory() as folder:
        link, told = DeviceLink("udp://127.0.0.1:0"), Path(folder) / "device.json"
        device = client(link.port, seconds, told, "--depth", "0.01", "--grip", "medium")
        spent: list[tuple[float, float]] = []
        behind: list[float] = []
        number = -1
        while device.poll() is None:
            began, cpu = time.perf_counter(), time.thread_time()
            state = link.receive_state(began)
            if state is None or state.number == number:
                time.sleep(5e-5)
                continue
            if number < 0:
                start, waited_before = began, waited()
            number = state.number
            link.send_wrench(
                np.array([0.0, 0.0, max(-WALL * state.position[2], 0.0), 0.0, 0.0, 0.0])
            )
            spent.append((time.perf_counter() - began, time.thread_time() - cpu))
            behind.append(state.force_age_s)
        lasted = time.perf_counter() - start
        found = json.loads(told.read_text())
        figures = {
            f"link_processing_{kind}{name}_ms": 1e3 * float(np.percentile(times, part))
            for kind, times in zip(("", "cpu_"), np.transpose(spent), strict=True)
            for name, part in (("p50", 50), ("p95", 95), ("p99", 99), ("max", 100))
        }
        figures |= {
            "link_packets_per_s": len(spent) / lasted,
            "link_lost_share": max(link.lost, 0) / max(number, 1),
            "link_share_waiting_for_a_core": (waited() - waited_before) / lasted,
            "link_force_behind_p50_ms": found["behind_p50_ms"],
            "link_force_behind_p99_ms": found["behind_p99_ms"],
            "link_energy_j": found["energy_j"],
            "link_largest_force_n": found["largest_force_n"],
        }
        link.close()
    return figures, np.ceil(np.array(behind[100:]) / _TICK)


def silent() -> dict[str, float]:
    """Return the largest force of a guard after 50 ms of silence, for any previous command [N]."""
    largest, random = 0.0, np.random.default_rng(0)
    for _ in range(200):
        guard = DeviceGuard(DeviceLimits(37.5))
        wrench, x = random.normal(0.0, 30.0, 6), np.zeros(3)
        for k in range(300):
            x = x + random.normal(0.0, 1e-4, 3)
            age = _TICK * max(k - 150, 0)
            force = guard.limit_wrench(x, wrench, age, _TICK)
            if age >= 0.05:
                largest = max(largest, float(np.abs(force).max()))
    return {"silent_50_ms_largest_n": largest}


def pressed(stiffness: float, grip: str, late: np.ndarray, *, observe: bool) -> tuple[float, float]:
    """Return the least energy of the port [J] and the oscillation of the hand at rest [m].

    Args:
        stiffness: of the wall [N/m].
        grip: of the virtual hand.
        late: ages of the forces in ticks, in a cycle.
        observe: whether the observer is on.
    """
    virtual, most = VirtualDevice(tapping_motion(0.02), grip), int(late.max())
    guard, heights = DeviceGuard(DeviceLimits(37.5), observe=observe), [0.01] * (most + 1)
    least, resting, newest = 0.0, [], 0
    for k in range(4000):
        heights.append(virtual.position[2])
        newest = max(newest, len(heights) - 1 - int(late[k % len(late)]))  # in order
        push = max(-stiffness * heights[newest], 0.0)
        force = guard.limit_wrench(virtual.position, (0.0, 0.0, push, 0.0, 0.0, 0.0), 0.0, _TICK)
        virtual.simulate_motion(force[:3], _TICK)
        least = min(least, virtual.energy)
        if 0.65 < (0.5 * _TICK * k) % 1.0 < 0.8 and k > 2000:
            resting.append(virtual.position[2])
    return least, float(np.ptp(resting))


def passive(measured: np.ndarray) -> dict[str, float]:
    """Return energy and rest at leaf and wall, with every grip, with and without the observer."""
    figures: dict[str, float] = {}
    delays = {f"{n}_late": np.array([n]) for n in (0, 1, 2, 5)} | {"as_measured": measured}
    for observe, word in ((True, "observed"), (False, "bare")):
        for name, late in delays.items():
            at_leaf = [pressed(LEAF, grip, late, observe=observe) for grip in GRIP_IMPEDANCES]
            at_wall = {grip: pressed(WALL, grip, late, observe=observe) for grip in GRIP_IMPEDANCES}
            figures[f"leaf_{name}_{word}_least_energy_j"] = min(energy for energy, _ in at_leaf)
            for grip, (_, moved) in at_wall.items():
                figures[f"wall_{name}_{word}_{grip}_moves_m"] = moved
    return figures


def in_station(grip: str, *, observe: bool) -> tuple[float, float]:
    """Return `pressed` with the whole station in simulated time: a force is 2 ms late.

    The wall and the tool's ball make 6 kN/m at the hand, for a rigid arm.
    """
    ball, scale = 4e5, 1 / 17.5
    scenario = live_scenario(with_task_space_device(LoadScenario("contact_transition")))
    felt = WALL / (scale * scenario.kinematic_scaling.translation_scale)
    wall = Wall(position=[0.55, 0.0, 0.247], stiffness=1 / (1 / felt - 1 / ball))
    scenario = replace(
        scenario, sheet_spring=None, environment=[wall], force_scaling__sigma=1.0,
        force_scaling__force_scale=scale,
    )  # fmt: skip
    session = Session(scenario, None, device=True)
    virtual = VirtualDevice(tapping_motion(0.02), grip)
    guard, start = DeviceGuard(DeviceLimits(37.5), observe=observe), virtual.position[2]
    wrench, least, resting = np.zeros(6), 0.0, []
    for k in range(800):
        place = {"z": 1e5 * (virtual.position[2] - start), "held": 1, "clutch": 1}
        session.apply_inputs(session.inputs.with_changes(place))
        session.advance(2)
        session.new_rows()
        for _ in range(2):
            force = guard.limit_wrench(virtual.position, tuple(wrench), 2e-3, _TICK)
            virtual.simulate_motion(force[:3], _TICK)
            least = min(least, virtual.energy)
        wrench = session.device_wrench()
        if k > 700:
            resting.append(virtual.position[2])
    return least, float(np.ptp(resting))


def fuzzed(count: int = 10_000) -> dict[str, float]:
    """Return the number of non-finite values after random packets and texts of each kind."""
    random, wrong, refused = np.random.default_rng(1), 0, 0
    good = pack_state(DeviceState(1, 0.0, (0.01, 0.0, 0.0)))
    place = {"cursor_position": {"x": 0.1, "y": 0.2, "z": 0.3}}
    said = json.dumps({"inverse3": [{"device_id": "a", "state": place}]})
    link = DeviceLink("udp://127.0.0.1:0")
    for k in range(count):
        packet = bytearray(good)
        for i in random.integers(0, len(packet), random.integers(1, 40)):
            packet[i] = random.integers(256)
        cut = bytes(packet[: random.integers(len(packet))] if k % 10 == 0 else packet)
        link._accept_or_refuse_packet(cut, "peer", 1e-3 * k)
        led = link.hand_inputs(1e-3 * k)
        wrong += not all(np.isfinite(value) for value in led.values())
        state = unpack_state(cut)
        refused += state is None
        text = list(said)
        for i in random.integers(0, len(text), random.integers(1, 8)):
            text[i] = chr(random.integers(1, 300))
        heard = parse_device_message("".join(text))
        wrong += heard is not None and not np.isfinite([*heard[1].position]).all()
    link.close()
    return {"fuzz_messages": 2.0 * count, "fuzz_not_finite": wrong, "fuzz_packets_refused": refused}


def driven(seconds: float) -> dict[str, float]:
    """Run the whole station with the device in real time, without a page."""
    scenario = live_scenario(with_task_space_device(LoadScenario("contact_transition")))
    load, clock = identified_load(scenario), time.perf_counter
    link = DeviceLink("udp://127.0.0.1:0")
    live = Live(scenario, load, None, lambda rows: {}, clock(), link)
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "device.json"
        device = client(link.port, seconds + 2.0, told, "--depth", "0.075", "--grip", "medium")
        while live.is_halted or link.is_device_silent(clock()):  # until it runs
            live.tick(clock)
            time.sleep(1e-3)
        live.join(1, clock())
        end, lost, late = clock() + seconds, live.pace.lost_time_s, []
        while clock() < end:
            if live.pace.time_to_next_slice(clock()) <= 0:
                late.append(-live.pace.time_to_next_slice(clock()))
            live.tick(clock)
            time.sleep(live.time_to_next_tick(clock()))
        figures = link.link_statistics()
        device.wait()
        found = json.loads(told.read_text())
        lost = live.pace.lost_time_s - lost
        live.close()
    return {
        "drive_factor": 1.0 - lost / seconds,
        "drive_slice_late_p99_ms": 1e3 * float(np.percentile(late, 99)),
        "drive_packets_late_p99_ms": figures["late_p99_ms"],
        "drive_force_behind_p50_ms": found["behind_p50_ms"],
        "drive_force_behind_p99_ms": found["behind_p99_ms"],
        "drive_energy_j": found["energy_j"],
        "drive_largest_force_n": found["largest_force_n"],
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--drive", action="store_true", help="run the whole station too")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with without_garbage_collection():  # as in the server
        figures, late = linked(options.seconds)
    figures |= silent() | passive(late) | fuzzed()
    for grip in GRIP_IMPEDANCES:
        for observe, word in ((True, "observed"), (False, "bare")):
            least, moved = in_station(grip, observe=observe)
            figures[f"station_wall_{word}_{grip}_least_energy_j"] = least
            figures[f"station_wall_{word}_{grip}_moves_m"] = moved
    if options.drive:
        figures |= driven(options.seconds)
    for name, value in figures.items():
        print(f"{name:44} {value:.4g}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
