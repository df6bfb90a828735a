"""One degree of freedom of the station (long: its plant, task, figures): thousands of runs.

Hand and device are one mass on the hand's spring and damper, the slave is a mass behind a position
servo, the environment a stiff wall. Between them is the station's own channel,
`drake_teleop.station.channel.channel.channel_step`, with motion along x alone::

    (m_h + m_m) a = K_h (x_i - x) + B_h (v_i - v) - f_c tanh(v / v_c) + f    hand and device
    m_s a_s = K (x_cmd - x_s) - D v_s + f_w                                  slave and its servo,
                                                                             K = D k_p, D = m_s k_v
    f_w = -max(k_e (x_s - x_w) + b_e (v_s - v_w), 0) where x_s > x_w         wall
    f_e = k_f (gamma f_w - sigma m_t a_s)                                    what is sent back

The channel steps at 1 kHz; in between the forces of its ends are held and the masses take 20 steps
of integration. The operator moves freely, rests, presses on the wall, holds, lets go and rests,
or does as he is told; grip, wall and network may change on the way.

Four accounts are kept of what goes into the station between hand and environment, in the master's
power units, positive inwards [J]. What comes out of a passive one never exceeds what its stores
held at the start: the hand's account plus any one of the others never falls below -E_0 then::

    hand      -sum f_(k-1) (x_k - x_(k-1))      the held force, exact
    command    sum w_k (c_k - c_(k-1))          the wrench f_e that is sent, along the command; no
                                                physical port: its sign depends on the servo's lag
    motor     -integral k_f gamma f_m dx_s      the servo's force: the next one, less what moves
                                                and rubs (to half a step of the integration)
    actual     integral k_f gamma f_w dx_s      the wall's force; exact for a spring

The inertia that sigma leaves in f_e is no part of the environment, so the last two do without it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.noise import random_normal
from drake_teleop.common.vectors import put
from drake_teleop.lab.analysis.one_axis import Axis
from drake_teleop.station.channel import network
from drake_teleop.station.channel.channel import (
    MEMORY_M,
    MEMORY_S,
    PORTS,
    channel_step,
    initial_ends,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity import methods
from drake_teleop.station.passivity.memory import LEDGER
from drake_teleop.station.passivity.methods import AT_THE_MOTOR, PassivityConfig
from drake_teleop.station.passivity.packet import PACKET_SIZE

PERIOD = 1e-3  #: s, of the channel
_SUBSTEPS = 20
_FRICTION_SPEED = 5e-3  # m/s, below it the device's Coulomb friction fades
_SLAVES_FRICTION_SPEED = 1e-3  # m/s, likewise of the slave
HAND, COMMAND, MOTOR, ACTUAL = range(4)  #: of the accounts

_QUIET = 0.5e-3  # m, peak to peak at rest
TIP = 0.2  #: m, from the wrist to the tool's tip
_FREE, _DEPTH = -0.04, 0.02  # m, from the wall: where the operator rests, and how deep he presses


@dataclass(frozen=True)
class Task:
    """When the operator does what [s]: swings, rests, presses, holds, lets go, rests."""

    swing: float = 0.5
    swung: float = 3.0
    press: float = 5.5
    pressed: float = 6.5
    release: float = 11.5
    released: float = 12.5
    end: float = 17.0
    judged: float = 1.9  #: length of the windows in which the station has to be at rest


@dataclass(frozen=True, kw_only=True)
class OneDof(Axis):
    """`Axis` with a device that does not damp but rubs, and with what else is not ideal."""

    device_friction: float = 0.05  #: N, Coulomb
    slave_friction: float = 0.0  #: N, Coulomb, of the arm
    wall_damping: float = 0.0  #: N s/m
    motor_lag: float = 0.0  #: s, time constant of the motor's force
    master_resolution: float = 0.0  #: m, of the encoder; 0: exact
    slave_resolution: float = 0.0  #: m, likewise
    wrench_noise: float = 0.0  #: N, standard deviation of what the wrist measures
    believed_stiffness: float = 1.0  #: what the method is told of the servo, over what it is
    believed_damping: float = 1.0  #: likewise
    believed_mass: float = 1.0  #: likewise, of the slave


REFERENCE = OneDof(
    hand_mass=0.2,
    hand_damping=5.0,
    hand_stiffness=300.0,
    position_gain=58.5,
    velocity_gain=234.0,
)
"""What the figures of docs/delay.md, notebook 02 and benchmarks/README.md are of.

Not the station's medium grip, and not its servo: this one is critically damped and softer, 207
instead of 502 kN/m, -3 dB at 12 instead of 14 Hz, 17 instead of 13 ms late.
"""


@dataclass(frozen=True)
class OneDofRun:
    """What happened; arrays (N,), one entry for each period.

    Args:
        t: time [s].
        master, slave: positions [m].
        command: position that the slave was told [m].
        felt: force on the hand [N].
        wall: force of the wall on the slave [N].
        energy: (N, 2) that hand and slave have put into the channel [J].
        silent: (N, 2) for how long hand and slave have heard nothing [s].
        accounts: (N, 4) what has gone in at `HAND`, `COMMAND`, `MOTOR` and `ACTUAL` motion so far
            [J], see the module.
        start_energy: E_0, what the method says that its stores hold at the start [J].
    """

    t: NDArray[np.float64]
    master: NDArray[np.float64]
    slave: NDArray[np.float64]
    command: NDArray[np.float64]
    felt: NDArray[np.float64]
    wall: NDArray[np.float64]
    energy: NDArray[np.float64]
    silent: NDArray[np.float64]
    accounts: NDArray[np.float64]
    start_energy: float

    def least(self, place: int) -> float:
        """The least that hand and one other place (`HAND`: the hand alone) have put in, and E_0.

        Not negative if the station is passive between the two [J].
        """
        other = 0.0 if place == HAND else self.accounts[:, place]
        return self.start_energy + float(np.nanmin(self.accounts[:, HAND] + other))


@dataclass(frozen=True)
class Figures:
    """A run in numbers.

    Args:
        stable: whether it comes to rest, holding the wall and after it: within 0.5 mm peak to peak
            about a parabola at the end of either. Of the whole station the orientation has to be at
            rest as well, within what moves the tool's tip by as much.
        hunting: that peak to peak, the larger of the two [m].
        turning: likewise of the orientation [rad]; 0 in one degree of freedom.
        felt_force: on the hand while holding, mean [N].
        chatter: its standard deviation [N].
        force_error: of the force felt against the scaled force of the wall, while holding [1]. It
            says nothing of how hard the slave presses.
        drift: of the slave against the master, 2 s after contact [m].
        free_force: felt in free motion, rms [N].
        rise_delay: from when the scaled force of the wall has reached half of the steady force
            felt to when the force felt has, so not negative [s]; NaN where it had before, by a
            drag that hides the rise, or where one of them never does.
        least_energy: the least that both ends together have put into the channel [J]; negative if
            it gave out more than it got.
    """

    stable: bool
    hunting: float
    turning: float
    felt_force: float
    chatter: float
    force_error: float
    drift: float
    free_force: float
    rise_delay: float
    least_energy: float


def run_one_dof(
    model: OneDof,
    passivity: PassivityConfig,
    forward: NetworkConfig,
    backward: NetworkConfig | None = None,
    *,
    seed: int = 0,
    timeout: float = 0.2,
    intent: NDArray[np.float64] | None = None,
    grip: NDArray[np.float64] | None = None,
    wall: NDArray[np.float64] | None = None,
    delays: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None,
) -> OneDofRun:
    """Simulates one run.

    Args:
        model: masses, hand, wall.
        passivity: the method.
        forward, backward: the network; backward None: as forward.
        seed, timeout: of the network; of the safe state [s].
        intent: (N, 2) position [m], velocity [m/s] intended at the periods; default: the task's.
        grip: (N, 3) mass [kg], damping [N s/m] and stiffness [N/m] of the hand at the periods,
            zeros where it has let go; default: the model's.
        wall: (N, 2) position [m] and stiffness [N/m] of the wall at the periods. In between it
            moves evenly and is as stiff as at their start. Default: the model's, at 0.
        delays: forward and backward, periods that the packet of each step travels and -1 where it
            is lost; in the place of the network's, `forward` and `backward` say the rest.

    Raises:
        DrakeTeleopError: for a network that cannot be.
    """
    scale = model.force_scale
    passivity = dataclasses.replace(
        passivity,
        servo_stiffness=[model.believed_stiffness * model.servo_stiffness] * 2,
        servo_damping=[model.believed_damping * model.servo_damping] * 2,
        slave_mass=[model.believed_mass * model.slave_mass] * 2,
    )
    p = methods.parameters(passivity, [scale, scale])
    intent = operators_intent() if intent is None else intent
    start = np.array([1.0, 0.0, 0.0, 0.0, intent[0, 0], 0.0, 0.0])
    # The block's command is that of the next step, here it is used at once.
    playout = forward.playout + PERIOD if forward.playout > 0 else 0.0
    forward_line = dataclasses.replace(forward, delay=forward.delay + PERIOD, playout=playout)
    there, back = (None, None) if delays is None else (delays[0] + (delays[0] >= 0), delays[1])
    lines = [
        network.parameters(line, seed, direction, PERIOD, least=1, delays=travels)
        for line, direction, travels in (
            (forward_line, network.FORWARD, there),
            (forward if backward is None else backward, network.BACKWARD, back),
        )
    ]
    states = [network.initial_state(line, np.zeros(PACKET_SIZE)) for line in lines]
    ends = initial_ends(passivity.method, p, start)
    stored = float(ends[MEMORY_M][LEDGER][0] + ends[MEMORY_S][LEDGER][0])
    numbers = (
        model.device_mass, model.device_friction, model.slave_mass, model.servo_stiffness,
        model.servo_damping, model.ideal_servo, model.slave_friction, model.motor_lag,
        model.tool_mass, model.wall_damping, scale, model.sigma, model.gamma,
        model.master_resolution, model.slave_resolution, model.wrench_noise, seed % 2**53,
    )  # fmt: skip
    own = (model.hand_mass, model.hand_damping, model.hand_stiffness), (0.0, model.wall_stiffness)
    given = intent, own[0] if grip is None else grip, own[1] if wall is None else wall
    course = [np.broadcast_to(part, (len(intent), np.shape(part)[-1])) for part in given]
    # These methods know the force of the slave's motor, which is therefore held over a period; for
    # the others the command is interpolated over it.
    held = passivity.method in AT_THE_MOTOR and not model.ideal_servo
    rows = _simulate(
        methods.steps_of(passivity.method), tuple(map(float, numbers)), held, p, *lines, *states,
        ends, start, timeout, np.concatenate(course, axis=1),
    )  # fmt: skip
    t = np.arange(len(intent), dtype=np.float64) * PERIOD
    master, slave, command, felt, pushed = rows.T[:5]
    rest = rows[:, 5:7], rows[:, 7:9], rows[:, 9:], stored
    return OneDofRun(t, master, slave, command, felt, pushed, *rest)


def operators_intent(task: Task = Task()) -> NDArray[np.float64]:
    """(N, 2) position [m] and velocity [m/s] that the operator intends; the wall is at 0."""
    t = np.arange(round(task.end / PERIOD), dtype=np.float64) * PERIOD
    x = np.full_like(t, _FREE)
    fade = np.minimum(_ramp(t, task.swing, 0.5), 1 - _ramp(t, task.swung - 0.5, 0.5))
    x += 0.03 * fade * np.sin(2 * np.pi * 1.5 * (t - task.swing))
    pressing = _ramp(t, task.press, task.pressed - task.press)
    releasing = _ramp(t, task.release, task.released - task.release)
    x += (_DEPTH - _FREE) * (pressing - releasing)
    return np.stack([x, np.gradient(x, PERIOD)], axis=1)


def _ramp(t: NDArray[np.float64], start: float, length: float) -> NDArray[np.float64]:
    u = np.clip((t - start) / length, 0.0, 1.0)
    return u**3 * (10.0 + u * (6.0 * u - 15.0))


def figures(run: OneDofRun, model: OneDof, task: Task = Task()) -> Figures:
    """The run in numbers."""
    return figures_of(
        t=run.t,
        master=run.master,
        slave=run.slave,
        felt=run.felt,
        pressed=model.force_scale * model.gamma * run.wall,
        energy=run.energy.sum(axis=1),
        task=task,
    )


def figures_of(
    *,
    t: NDArray[np.float64],
    master: NDArray[np.float64],
    slave: NDArray[np.float64],
    felt: NDArray[np.float64],
    pressed: NDArray[np.float64],
    energy: NDArray[np.float64],
    task: Task,
    turned: NDArray[np.float64] | None = None,
) -> Figures:
    """A run of the task in numbers; all arrays (N,), equidistant.

    Args:
        t: time [s].
        master, slave: positions in the direction in which is pressed [m].
        felt: force on the hand [N].
        pressed: force of the environment, scaled to the hand [N].
        energy: that both ends have put into the channel [J].
        task: when what happened.
        turned: (N, 3) rotation vector of the slave's tool since the start [rad], if it can turn.
    """
    dt = float(t[1] - t[0])

    def window(start: float, stop: float) -> slice:
        return slice(round(start / dt), round(stop / dt))

    hold = window(task.release - task.judged, task.release)
    rest = window(task.end - task.judged, task.end)
    hunting = max(_hunting(x[part]) for x in (master, slave) for part in (hold, rest))
    angles = () if turned is None else turned.T
    turning = max((_hunting(x[part]) for x in angles for part in (hold, rest)), default=0.0)
    steady, goal = float(felt[hold].mean()), float(pressed[hold].mean())
    after = min(round((task.released + 2.0) / dt), len(t) - 1)
    start = round(task.press / dt)
    return Figures(
        stable=bool(hunting < _QUIET and turning < _QUIET / TIP),
        hunting=hunting,
        turning=turning,
        felt_force=abs(steady),
        chatter=float(felt[hold].std()),
        force_error=steady / goal - 1 if goal != 0 else float("nan"),
        drift=float(slave[after] - master[after]),
        free_force=float(np.sqrt(np.mean(felt[window(task.swing, task.swung)] ** 2))),
        rise_delay=_rise_delay(felt[start:], pressed[start:], steady) * dt,
        least_energy=float(energy.min()),
    )


def _hunting(x: NDArray[np.float64]) -> float:
    """Peak to peak about the parabola that fits best; infinite if it is not finite."""
    if not np.isfinite(x).all():
        return float("inf")
    t = np.linspace(-1.0, 1.0, len(x))
    return float(np.ptp(x - np.polyval(np.polyfit(t, x, 2), t)))


def _rise_delay(felt: NDArray[np.float64], pressed: NDArray[np.float64], steady: float) -> float:
    """Samples from `pressed` to `felt`, both beyond half of `steady`; NaN if that tells nothing.

    One level for both: a method that shows half of the force would otherwise seem to show it before
    it is there.
    """
    level, sign = 0.5 * abs(steady), np.sign(steady)
    there, shown = pressed * sign > level, felt * sign > level
    start = int(np.argmax(there))
    if not there.any() or shown[max(start - 1, 0)] or not shown[start:].any():
        return float("nan")
    return float(np.argmax(shown[start:]))


@njit(cache=True)
def _simulate(
    steps, model, held, p, forward_line, backward_line, forward, backward, ends, start, timeout,
    course,
):  # fmt: skip
    """(N, 13) rows [master, slave, command, felt, wall, energy (2), silence (2), accounts (4)]."""
    device_mass, friction, slave_mass, K, D, ideal, slave_friction, lag = model[:8]
    tool_mass, wall_damping, scale, sigma, gamma = model[8:13]
    master_resolution, slave_resolution, noise, seed = model[13:]
    frame = np.zeros(11)
    frame[0] = frame[4] = frame[8] = frame[9] = frame[10] = 1.0
    pose_m, pose_s, received = start.copy(), start.copy(), start.copy()
    wrench, load, hand = np.zeros(6), np.zeros(6), np.zeros(6)
    felt, ports = np.zeros(7), np.zeros(PORTS)
    rows, accounts = np.empty((course.shape[0], 13)), np.zeros(4)
    x = x_s = x_before = start[4]
    v = v_s = a_s = motor = 0.0
    dt = PERIOD / _SUBSTEPS
    for k in range(course.shape[0]):
        mass, damping, stiffness = device_mass + course[k, 2], course[k, 3], course[k, 4]
        x_w, wall_stiffness, following = course[k, 5], course[k, 6], min(k + 1, len(course) - 1)
        v_w = (course[following, 5] - x_w) / PERIOD
        push = _push(wall_stiffness, wall_damping, x_s - x_w, v_s - v_w)
        wall = -max(push, 0.0)
        wrench[0] = scale * (gamma * wall - sigma * tool_mass * a_s)
        load[0] = -scale * sigma * tool_mass * a_s
        if noise > 0.0:
            wrench[0] += scale * noise * random_normal(np.uint64(seed), k)
        hand[0] = stiffness * (course[k, 0] - x) + damping * (course[k, 1] - v)
        pose_m[4], pose_s[4] = _read(x, master_resolution), _read(x_s, slave_resolution)
        accounts[HAND] -= felt[0] * (x - x_before)
        before, x_before = received[4], x
        # No literal False: for that the whole channel would be compiled once more.
        channel_step(
            steps, pose_m, wrench, load, hand, pose_s, np.bool_(False), 0.0, PERIOD, timeout,
            frame, p, forward_line, backward_line, forward, backward, ends, received, ports, felt,
        )  # fmt: skip
        command, accounts[COMMAND] = received[4], ports[6]
        put(rows[k], 0, (x, x_s, command, felt[0], wall, ports[0], ports[2]), 0, 7)
        put(rows[k], 7, ports, 4, 2)
        put(rows[k], 9, accounts, 0, 4)
        wanted = K * (command - x_s) - D * v_s
        for i in range(_SUBSTEPS):
            share = (i + 0.5) / _SUBSTEPS
            x_i = course[k, 0] + share * (course[following, 0] - course[k, 0])
            v_i = course[k, 1] + share * (course[following, 1] - course[k, 1])
            force = stiffness * (x_i - x) + damping * (v_i - v) + felt[0]
            v += dt / mass * (force - friction * np.tanh(v / _FRICTION_SPEED))
            x += dt * v
            x_then, v_then = x_s, v_s
            if ideal > 0.0:
                x_s = before + (i + 1.0) / _SUBSTEPS * (command - before)
                v_new = (command - before) / PERIOD
                a_s, v_s = (v_new - v_s) / PERIOD if i == 0 else a_s, v_new
            else:
                if not held:
                    wanted = K * (before + share * (command - before) - x_s) - D * v_s
                motor = motor + dt / lag * (wanted - motor) if lag > dt else wanted
                a_s = (motor - max(push, 0.0)) / slave_mass
                if slave_friction > 0.0:
                    a_s -= slave_friction / slave_mass * np.tanh(v_s / _SLAVES_FRICTION_SPEED)
                v_s += dt * a_s
                x_s += dt * v_s
            beyond = x_s - (x_w + (i + 1.0) / _SUBSTEPS * PERIOD * v_w)
            push_then, push = push, _push(wall_stiffness, wall_damping, beyond, v_s - v_w)
            work = -_mean_positive(push_then, push) * (x_s - x_then)
            accounts[ACTUAL] += scale * gamma * work
            # The speed's mean, with which the work of all forces is the gain of kinetic energy. An
            # ideal servo moves a slave without mass.
            if ideal == 0.0:
                work = -motor * 0.5 * (v_then + v_s) * dt
            accounts[MOTOR] += scale * gamma * work
        if not abs(x) + abs(x_s) < 1e3:
            rows[k + 1 :] = np.nan
            break
    return rows


@njit(cache=True)
def _read(x, resolution):
    """What an encoder makes of a position."""
    return np.round(x / resolution) * resolution if resolution > 0.0 else x


@njit(cache=True)
def _push(stiffness, damping, depth, speed):
    """What the wall pushes the slave out with, if it is positive [N]."""
    return stiffness * depth + (damping * speed if depth > 0.0 else 0.0)


@njit(cache=True)
def _mean_positive(a, b):
    """The mean of max(., 0) on the straight way from a to b."""
    if a >= 0.0 and b >= 0.0:
        return 0.5 * (a + b)
    if a <= 0.0 and b <= 0.0:
        return 0.0
    return 0.5 * max(a, b) ** 2 / abs(b - a)
