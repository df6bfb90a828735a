"""Energy ledger in six degrees of freedom: contact is one wrench, with friction across it.

Both ends are stepped separately with constructed packets.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drake_teleop.station.passivity.ledger import (
    _MODEL_FRICTION_AT_HAND,
    _MODEL_FRICTION_AT_SLAVE,
    _UNMODELLED_FRICTION,
    LedgerConfig,
)
from drake_teleop.station.passivity.ledger_slave import (
    _CONTACT_DAMPING,
    _CONTACT_STIFFNESS,
    _LAST_SPEED_INTO_WALL,
    _RENDERED_FORCE,
    CONTACT_DIRECTION,
    ENCODER_STEP,
    FILTERED_OWN_VELOCITY,
    IN_CONTACT_FLAG,
    PACKET_CONTACT_STIFFNESS,
    PACKET_LEDGER_LEVEL,
    PACKET_ROUND_TRIP,
    _is_wall_removed,
    update_contact_direction,
    wrench_component_along,
)
from drake_teleop.station.passivity.memory import (
    DISSIPATED_ENERGY,
    LOAD_WRENCH,
    SENT_ENERGY,
    STORED_ENERGY,
    WRENCH_LIMIT,
)
from drake_teleop.station.passivity.methods import (
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    slave_step,
    step_addresses,
)
from drake_teleop.station.passivity.packet import (
    MAX_HAND_WRENCH_RATES,
    PACKET_LOAD_WRENCH,
    PACKET_NUMBER,
    PACKET_SIZE,
    POSE,
    WRENCH,
)

T = 1e-3
START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
RICH = PassivityConfig(
    method="ledger", ledger=LedgerConfig(initial=[2.0, 2.0], drag=[0.0, 0.0]), torque_limit=1.0
)


class Hand:
    """Master's end with its last received packet."""

    def __init__(self, wrench: np.ndarray, stiffness: float, **own: list[float]) -> None:
        ledger = dataclasses.replace(RICH.ledger, **own)
        self.p = method_parameters(dataclasses.replace(RICH, ledger=ledger))
        self.memory = initial_method_memory("ledger", self.p, START)
        self.memory[STORED_ENERGY] = 0.2  # more than it uses, and below its limit in contact
        self.pose, self.felt, self.packet = START.copy(), np.zeros(6), np.zeros(PACKET_SIZE)
        self.packet[POSE], self.packet[WRENCH] = START, wrench
        self.packet[PACKET_CONTACT_STIFFNESS], self.packet[PACKET_ROUND_TRIP] = stiffness / 1.1, 0.1

    def step(self, dx: np.ndarray | None = None) -> np.ndarray:
        """Move by dx (6,), translation and small rotation; return the rendered wrench."""
        dx = np.zeros(6) if dx is None else np.asarray(dx)
        self.pose[4:] += dx[:3]
        self.pose[1:4] += 0.5 * dx[3:]
        self.packet[PACKET_NUMBER] += 1.0
        self.sent, still = np.zeros(PACKET_SIZE), np.zeros(6)
        master_step(
            step_addresses("ledger"), self.packet, True, self.pose, dx / T, dx, still,
            self.p[WRENCH_LIMIT], T, self.p, self.memory, self.felt, self.sent,
        )  # fmt: skip
        return self.felt.copy()

    def rest(self, steps: int) -> np.ndarray:
        """Return the rendered wrench after a number of steps at rest."""
        for _ in range(steps):
            felt = self.step()
        return felt


def test_contact_far_from_the_reference_is_one_spring():
    """The depth is that of the contact point for translation and rotation, with the torque."""
    arm, k = np.array([0.0, 0.1, 0.0]), 200.0
    normal = np.array([0.0, 0.0, 1.0, *np.cross(arm, [0.0, 0.0, 1.0])])
    component_along = 1.0 + (0.1 / 0.1) ** 2  # of `normal`, where a torque is a force at 0.1 m
    depth = 1e-3
    for way in ([0, 0, -depth, 0, 0, 0], [0, 0, 0, -depth / 0.1, 0, 0]):
        hand = Hand(2.0 * normal, k * component_along)
        np.testing.assert_allclose(hand.rest(2500), 2.0 * normal, atol=1e-9)
        for _ in range(50):
            hand.step(np.array(way) / 50)
        np.testing.assert_allclose(hand.rest(50), (2.0 + k * depth) * normal, rtol=0.01, atol=1e-4)


def test_friction_follows_the_hand_and_equals_the_measurement_at_rest():
    """Delayed friction would push a hand that has reversed."""
    wrench = np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    hand = Hand(wrench, 200.0)
    hand.rest(1500)
    hand.packet[WRENCH][1] = -0.6  # slides, as the hand did earlier
    assert abs(hand.rest(20)[1]) < 0.1
    for sign in (1.0, -1.0):
        for _ in range(20):
            felt = hand.step([0.0, sign * 5e-5, 0.0, 0.0, 0.0, 0.0])
        assert felt[1] == pytest.approx(-sign * 0.6, rel=0.3)
        assert felt[2] == pytest.approx(3.0, rel=0.1)
    np.testing.assert_allclose(hand.rest(7000)[:3], [0.0, -0.6, 3.0], atol=0.01)
    hand.packet[POSE][6] = -0.1  # the hand is far out again, before the slave's packets arrive
    np.testing.assert_allclose(hand.rest(400), np.zeros(6), atol=1e-9)
    still = hand.step([0.0, 5e-5, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(still, np.zeros(6), atol=1e-9, err_msg="nor where it moves there")


def test_friction_under_a_resting_hand_follows_the_measured_one_with_its_lag():
    """The model of the hand's stick acts at once; a constant packet replaces it within 2 s."""
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 200.0)
    hand.packet[PACKET_ROUND_TRIP] = 0.6
    hand.rest(1500)
    hand.packet[WRENCH][1] = -0.6
    for _ in range(20):
        held = hand.step([0.0, 5e-5, 0.0, 0.0, 0.0, 0.0])[1]
    hand.packet[WRENCH][1] = -0.3
    assert held == pytest.approx(-0.6, rel=0.1)
    assert -0.6 < hand.rest(50)[1] < -0.4
    assert hand.rest(2000)[1] == pytest.approx(-0.3, abs=0.01)


@pytest.mark.parametrize("way", [1e-3, -1e-3])
def test_rendered_wrench_is_the_measured_one_after_a_rotation_of_the_direction(way):
    """Friction tilts the first contact by 22 degrees, then it is gone."""
    hand = Hand(np.array([0.0, -1.2, 3.0, 0.0, 0.0, 0.0]), 200.0)
    hand.packet[PACKET_ROUND_TRIP] = 0.6
    hand.rest(1500)
    hand.packet[WRENCH][1] = 0.0
    for _ in range(20):
        hand.step([0.0, 0.0, way / 20, 0.0, 0.0, 0.0])
    hand.packet[POSE] = hand.pose
    felt = hand.rest(9000)
    assert felt[2] == pytest.approx(3.0, abs=0.03)
    assert abs(felt[1]) < 0.03


def test_brake_of_an_accelerated_hand_fades_with_its_speed():
    """0.5 N above 0.1 m/s, 0 below 0.05 m/s, with a ramp between."""
    hand = Hand(np.array([0.0, 0.0, 6.0, 0.0, 0.0, 0.0]), 200.0)
    hand.rest(1500)
    up = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    for k in range(120):
        hand.step(0.15 * T * up)
        if k == 100:
            hand.packet[WRENCH] = 0.0  # until then the contact pushed it out
    speeds = np.linspace(0.15, 0.03, 100)
    felt = np.array([hand.step(v * T * up)[2] for v in speeds])
    np.testing.assert_allclose(felt[speeds > 0.11], -0.5, rtol=1e-6)
    np.testing.assert_allclose(felt[speeds < 0.04], 0.0, atol=1e-9)
    assert np.abs(np.diff(felt)).max() < 0.03


@pytest.mark.parametrize("turns", [0.6e-3, -0.6e-3])
def test_friction_force_along_the_contact_is_removed(turns):
    """Contact 40 mm off, then on the other side; without it 2.6 and 3.4 N of 3 were rendered."""
    hand = Hand(np.array([0.0, -1.2, 3.0, 0.12, 0.0, 0.0]), 200.0)
    hand.packet[PACKET_ROUND_TRIP] = 0.6
    hand.rest(1500)
    hand.packet[WRENCH][:4] = [0.0, 0.0, 3.0, -0.12]
    for _ in range(20):
        hand.step([0.0, 0.0, 0.0, turns, 0.0, 0.0])
    hand.packet[POSE] = hand.pose
    felt = hand.rest(9000)
    assert felt[2] == pytest.approx(3.0, abs=0.05)  # up to the remaining rotation of the direction
    assert abs(felt[1]) < 0.05


def test_friction_opposes_a_hand_that_reverses_before_the_slave_does():
    """The slave slides 100 ms behind the hand, and meets the friction of its own motion."""
    hand, delay, speed = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 200.0), 100, 5e-5
    hand.rest(1500)
    ways = np.repeat([speed, -speed], [400, 60])  # short: the direction rotates to the friction
    for k, way in enumerate(ways):
        late = ways[k - delay] if k >= delay else 0.0
        hand.packet[POSE][5] += late
        hand.packet[WRENCH][1] = -0.6 * np.sign(late)
        felt = hand.step([0.0, way, 0.0, 0.0, 0.0, 0.0])
        if k == 399:
            assert felt[1] == pytest.approx(-0.6, rel=0.15)
    assert felt[1] > 0.4


def test_noise_of_a_light_contact_is_no_large_friction():
    """0.5 N across 0.2 N is not a coefficient of friction of 2.5."""
    hand = Hand(np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]), 200.0)
    hand.rest(1500)
    for k in range(20):
        hand.packet[WRENCH][1] = 0.5 * (-1) ** k
        hand.step()
    hand.packet[WRENCH][:3] = 0.0, 0.0, 3.0
    felt = [hand.step([0.0, 1e-4, 0.0, 0.0, 0.0, 0.0]) for _ in range(40)]
    assert 2.0 < np.abs(np.array(felt)[:, 1]).max() <= 3.0


def test_friction_stays_across_the_direction_as_it_turns():
    """The contact is beside So, the hand moves in all axes, and no limit is active."""
    rng = np.random.default_rng(4)
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.2, 0.0, 0.0]), 0.0)
    hand.rest(100)
    hand.packet[WRENCH] += [1.0, -0.5, 0.0, 0.0, 0.1, 0.05]
    for _ in range(200):
        hand.packet[POSE][4:] += 1e-6 * rng.normal(size=3)
        felt = hand.step(rng.normal(size=6) * np.repeat([1e-6, 1e-5], 3))
        normal = hand.memory[CONTACT_DIRECTION]
        for friction in (_MODEL_FRICTION_AT_HAND, _MODEL_FRICTION_AT_SLAVE, _UNMODELLED_FRICTION):
            assert abs(wrench_component_along(hand.memory[friction], normal, hand.p)) < 1e-12
        pressed = wrench_component_along(hand.packet[WRENCH], normal, hand.p)
        assert wrench_component_along(felt, normal, hand.p) == pytest.approx(pressed, abs=1e-9)
    assert np.linalg.norm(felt[:2]) > 0.4


@pytest.mark.parametrize(("round_trip", "lag"), [(0.01, 0.6), (0.1, 3.0), (0.3, 9.0)])
def test_torque_across_the_contact_is_a_stiffer_spring_with_a_longer_lag(round_trip, lag):
    """A tip 0.2 m from So: 2500 N/m there are 100 N m/rad. The direction rotates within 3 s."""
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 200.0)
    hand.packet[PACKET_ROUND_TRIP] = round_trip
    hand.rest(1500)
    hand.packet[WRENCH][5] = 0.05
    rendered = hand.rest(300)[5]
    expected = sum(1.0 - np.exp(-0.3 / each) for each in (3.0, lag))
    assert rendered / 0.05 == pytest.approx(expected, rel=0.08)
    for _ in range(10):
        hand.step([0.0, 0.0, 0.0, 0.0, 0.0, 2e-5])
    assert hand.step()[5] - rendered == pytest.approx(-100.0 * 2e-4, rel=0.1)


def test_stick_slip_is_rendered_in_part():
    """Friction of +-0.6 N and +-0.12 N m that reverses three times a second, at a resting hand.

    Rendered in full and a round trip late, it would sustain the stick-slip of the slave.
    """
    hand, felt = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 200.0), []
    hand.rest(1000)
    for k in range(1400):
        hand.packet[WRENCH][1] = rubs = np.clip(np.sin(2 * np.pi * k / 350), -0.6, 0.6)
        hand.packet[WRENCH][3] = -0.2 * rubs
        felt.append(hand.step())
    assert (np.ptp(felt[700:], axis=0)[1:4] < [0.4, 0.07, 0.16]).all()


@pytest.mark.parametrize("turning", [False, True])
def test_sampled_friction_does_not_oscillate_with_a_light_hand(turning):
    """A sampled spring is active by k T / 2; over `lan` this oscillated at 58 Hz."""
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 200.0)
    axis, inertia, rubs = (4, 2e-4, 0.05) if turning else (1, 0.02, 0.5)
    hand.rest(1500)
    hand.packet[WRENCH][axis] = rubs
    shown = hand.rest(20)[axis]
    v, way = 0.02 * rubs / (inertia * 360.0), []
    for _ in range(400):
        a = (hand.felt[axis] - shown) / inertia
        dx = np.zeros(6)
        dx[axis] = v * T + 0.5 * a * T**2
        v += a * T
        hand.step(dx)
        way.append(dx[axis])
    assert np.ptp(way[-100:]) < 0.1 * np.ptp(way[:50])


def test_friction_ignores_motion_along_the_contact():
    """Contact 40 mm off: motion and rotation along n render only the wall."""
    normal = np.array([0.0, 0.0, 1.0, 0.04, 0.0, 0.0])
    way = 2e-5 * np.array([0.0, 0.0, 1.0, 0.04 / 0.1**2, 0.0, 0.0])
    felt = []
    for rubs in (0.6, 0.0):
        hand = Hand(3.0 * normal, 200.0)
        hand.rest(1500)
        hand.packet[WRENCH][1], hand.packet[WRENCH][4] = rubs, 0.05 * rubs
        hand.rest(20)
        hand.packet[WRENCH] = 3.0 * normal
        shown = hand.rest(20)
        felt.append(np.array([hand.step(way) for _ in range(40)]) - shown)
    np.testing.assert_allclose(felt[0][:, 2], felt[1][:, 2], atol=0.01)
    np.testing.assert_allclose(felt[0][:, 3], felt[1][:, 3], atol=1e-3)
    assert abs(felt[1][-1, 2]) > 0.1, "the wall is felt"


def test_released_hand_receives_at_most_its_ledger():
    """R_m + 0.7 R_s in contact plus the drag, although the wall follows with 3 N."""
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 200.0)
    hand.rest(1000)
    got = 0.0
    for _ in range(1500):
        held, way = hand.felt[2], 6e-5
        hand.packet[POSE][6] += way
        hand.step([0.0, 0.0, way, 0.0, 0.0, 0.0])
        got += held * way
    assert 0.06 < got <= 0.02 + 0.7 * 0.1


@pytest.mark.parametrize("known", [0.0, 3e-5])
def test_an_empty_ledger_is_not_drained_by_the_steps_of_an_encoder(known):
    """A hand that oscillates by one encoder step needs a force on the inward step as well."""
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 0.0, encoder_step=[known, 0.0])
    got, step = 0.0, 3e-5
    hand.memory[STORED_ENERGY] = 0.0
    for k in range(600):
        way = step * ((k % 20 == 10) - float(k % 20 == 0))
        got += hand.felt[2] * way
        hand.step([0.0, 0.0, way, 0.0, 0.0, 0.0])
        assert hand.memory[STORED_ENERGY][0] == pytest.approx(-got)
    assert got <= 0.0


@pytest.mark.parametrize("axis", [0, 2, 4])
def test_hand_at_the_border_of_two_encoder_steps_receives_a_constant_force(axis):
    """The reading oscillates by one step at rest, or after motion in either direction."""
    step = 5.5e-5 if axis < 3 else 2e-4  # one step in a millisecond is not a fast hand
    changes = {}
    for known in (step, 0.0):
        steps = [known, 0.0] if axis < 3 else [0.0, known]
        hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 800.0, encoder_step=steps)
        hand.rest(1500)
        hand.packet[WRENCH][0], hand.packet[WRENCH][4] = 0.4, 0.02  # friction
        hand.rest(200)
        for way in (0.0, 7.0, -4.0):
            dx = np.zeros(6)
            dx[axis] = way * step
            hand.step(dx)
            dx[axis] = step
            felt = [hand.step(dx * (-1.0) ** k)[axis] for k in range(200)]
            changes.setdefault(known, []).append(np.abs(np.diff(felt[100:], 2)).max())
    assert max(changes[step]) < 0.02 * min(changes[0.0])


def test_lost_motion_of_the_encoder_is_at_most_its_step():
    """A hand that moves on receives the force of its pose minus 1.1 steps of lost motion."""
    forces = []
    for step in (0.0, 5e-5):
        hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 800.0, encoder_step=[step, 0.0])
        hand.rest(1500)
        for _ in range(20):
            hand.step([0.0, 0.0, -5e-5, 0.0, 0.0, 0.0])
        forces.append(hand.rest(50)[2])
    assert forces[0] - forces[1] == pytest.approx(1.1 * 5e-5 * 800.0, rel=0.02)
    assert forces[0] - 3.0 == pytest.approx(20 * 5e-5 * 800.0, rel=0.02)


@pytest.mark.parametrize(("step", "axis"), [(5e-5, 4), (2e-4, 6)])
def test_slave_receives_the_pose_of_the_hand_without_flicker(step, axis):
    """The pose is constant while the reading oscillates, and follows a hand that moves on."""
    hand, dx = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 0.0, encoder_step=[step, 0.0]), 0.0
    sent = []
    for k in range(40):
        dx = np.zeros(6)
        dx[axis - 4] = step * (-1.0) ** k
        hand.step(dx)
        sent.append(hand.sent[POSE][axis])
    assert np.ptp(sent[1:]) < 1e-12
    for _ in range(10):
        hand.step(np.abs(dx))
    assert hand.pose[axis] - hand.sent[POSE][axis] == pytest.approx(1.1 * step, rel=1e-6)


@pytest.mark.parametrize("scale", [[1.0, 1.0], [3.0, 0.5]])
def test_encoder_step_is_scaled_like_the_motion_of_the_hand(scale):
    config = PassivityConfig(method="ledger", ledger=LedgerConfig(encoder_step=[5e-5, 2e-3]))
    step = method_parameters(config, motion_scale=scale)[ENCODER_STEP]
    np.testing.assert_allclose(step, np.multiply(scale, [5e-5, 2e-3]))


@pytest.mark.parametrize("known", [0.0, 3e-5, 3e-4])
def test_balance_counts_the_measured_motion_within_the_lost_motion(known):
    """A third of the reserve remains at this end: 3 N times each measured step."""
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 0.0, encoder_step=[known, 0.0])
    hand.rest(1500)
    start = hand.memory[STORED_ENERGY][0] = RICH.ledger.hand_reserve[0] / 3
    rng, work = np.random.default_rng(3), 0.0
    for _ in range(200):
        way = 3e-5 * rng.integers(-1, 2)
        work += hand.felt[2] * way
        hand.step([0.0, 0.0, way, 0.0, 0.0, 0.0])
        assert hand.memory[STORED_ENERGY][0] == pytest.approx(start - work)
        assert hand.felt[2] > 1.0


def test_energy_limit_counts_a_measured_step_within_the_lost_motion():
    """Energy of 0.3 mJ remains: a hand that a step of 50 um pushes back receives less at once."""
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 0.0, encoder_step=[5e-5, 0.0])
    full = hand.rest(1500)[2]
    hand.memory[STORED_ENERGY][0] = 0.05 * RICH.ledger.hand_reserve[0] + 3e-4
    assert hand.step([0.0, 0.0, 5e-5, 0.0, 0.0, 0.0])[2] < 0.1 * full


def test_wrench_cross_fades_after_missing_packets():
    hand = Hand(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]), 0.0)
    hand.rest(100)
    hand.packet[WRENCH][2] = 1.0
    assert hand.step()[2] == pytest.approx(1.0), "nothing is missing"
    hand.packet[WRENCH][2] = 3.0
    hand.packet[PACKET_NUMBER] += 3.0
    course = [hand.step()[2] for _ in range(10)]
    assert course[0] == pytest.approx(1.0 + MAX_HAND_WRENCH_RATES[0] * T)
    assert np.diff(course).max() <= MAX_HAND_WRENCH_RATES[0] * T + 1e-12 and course[
        -1
    ] == pytest.approx(3.0)


@pytest.mark.parametrize("shown", [0.25, 0.5, 4.0, 30.0])
@pytest.mark.parametrize("stiffness, step", [(1e3, 0.0), (1e3, -2e-4), (4e4, 3e-4), (1e3, 1e-5)])
@pytest.mark.parametrize("damping, speeds", [(0.0, (0.3, 0.0)), (20.0, (0.0, 0.1)), (9.0, (1, 1))])
def test_wall_is_removed_if_its_motion_does_not_explain_the_lost_force(
    shown, stiffness, step, damping, speeds
):
    memory = initial_method_memory("ledger", method_parameters(RICH), START)
    normal = np.array([0.6, 0.0, -0.8, 0.0, 0.0, 0.0])
    memory[CONTACT_DIRECTION], memory[FILTERED_OWN_VELOCITY] = normal, -speeds[0] * normal
    memory[_LAST_SPEED_INTO_WALL], memory[_RENDERED_FORCE] = speeds[1], shown
    memory[_CONTACT_STIFFNESS], memory[_CONTACT_DAMPING] = stiffness, damping
    explained = stiffness * abs(step) + damping * abs(speeds[1] - speeds[0])
    removed = _is_wall_removed(step * normal, memory)
    assert removed == (shown > max(0.3, 2.0 * explained))


def test_friction_that_changes_its_sign_does_not_soften_the_wall():
    """The tool slides back and forth on a wall of 200 N/m in contact."""
    p, packet, command = method_parameters(RICH), np.zeros(PACKET_SIZE), np.zeros(13)
    memory, received = initial_method_memory("ledger", p, START), np.zeros(PACKET_SIZE)
    pose, before = START.copy(), START.copy()
    received[POSE], received[PACKET_LEDGER_LEVEL] = START, 1.0
    for k in range(3000):
        t = k * T
        pose[4:] = 2e-3 * np.sin(40.0 * t), 0.0, -0.01 * min(t, 1.0) - 1e-4 * np.sin(31.0 * t)
        force = -200.0 * pose[6]
        dx = np.concatenate([pose[4:] - before[4:], np.zeros(3)])
        rub = -0.3 * force * np.sign(dx[0])
        wrench = np.array([rub, 0.0, force, 0.0, 0.2 * rub, 0.0])
        received[POSE] = pose
        received[POSE][6] -= 0.005
        received[PACKET_NUMBER] += 1.0
        slave_step(
            step_addresses("ledger"), received, True, pose, dx / T, dx, wrench, T, p, memory,
            command, packet,
        )  # fmt: skip
        before[:] = pose
    assert 180.0 < packet[PACKET_CONTACT_STIFFNESS] < 350.0, "too stiff is stable, too soft is not"


def test_slip_is_rendered_gradually_and_a_yielding_wall_at_once():
    """0.5 N of lateral force on a wall of 200 N/m disappear, and then 1 N of contact force.

    The mean of force and friction is not a normal, so that the slip is a step along it, by 0.3 N.
    """
    p, packet, command = method_parameters(RICH), np.zeros(PACKET_SIZE), np.zeros(13)
    memory, received = initial_method_memory("ledger", p, START), np.zeros(PACKET_SIZE)
    pose, received[POSE], received[PACKET_LEDGER_LEVEL] = START.copy(), START, 1.0
    hand, felt = Hand(np.zeros(6), 0.0), []
    for k in range(2600):
        depth = 2e-2 * min(k / 1000, 1.0)
        dx = np.array([0.0, 0.0, -2e-5 if k < 1000 else 0.0, 0.0, 0.0, 0.0])
        pose[6] += dx[2]
        rubs = 0.125 * 200.0 * depth if k < 2000 else 0.0
        force = 200.0 * depth - (k >= 2500)
        wrench = np.array([rubs, 0.0, force, 0.0, 0.1 * rubs, 0.0])
        received[PACKET_NUMBER] += 1.0
        slave_step(
            step_addresses("ledger"), received, True, pose, dx / T, dx, wrench, T, p, memory,
            command, packet,
        )  # fmt: skip
        for part in (WRENCH, PACKET_ROUND_TRIP):
            hand.packet[part] = packet[part]
        felt.append(hand.step()[2])
    assert felt[1999] == pytest.approx(4.0, abs=0.05)
    assert np.ptp(felt[1990:2500]) < 0.06
    assert felt[2505] == pytest.approx(3.0, abs=0.15)


def test_contact_is_independent_of_scales_and_an_opposite_one_is_new():
    """A contact of 18 N at a lever of 40 mm at the slave, in power units at three scales."""
    config = PassivityConfig(method="ledger")
    contact = np.array([0.0, 0.0, 18.0, 0.0, 0.7, 0.0])
    sizes = []
    for motion in ((1.0, 1.0), (1.0, 0.1), (0.5, 1.5)):
        p = method_parameters(config, motion_scale=motion)
        memory = initial_method_memory("ledger", p, START)
        wrench = contact / 17.5 / np.repeat(motion, 3)
        size = update_contact_direction(wrench, 0.01, 1e-3, p, memory)
        sizes.append(size * motion[0])
        memory[IN_CONTACT_FLAG] = 1.0
        turned = wrench * np.repeat([-1.0, 0.5], 3)
        assert update_contact_direction(turned, 0.01, 1e-3, p, memory) > 0.9 * size
        assert wrench_component_along(memory[CONTACT_DIRECTION], wrench, p) < 0.0
    np.testing.assert_allclose(sizes, np.hypot(18.0, 7.0) / 17.5, rtol=1e-12)


def test_weight_of_the_load_is_rendered_beside_a_contact():
    """A wall of 200 N/m: the balance is that of all forces, contact detection that of the wall.

    The force of an oscillating load is smoothed over a round trip and the servo's lag.
    """
    p, packet, command = method_parameters(RICH), np.zeros(PACKET_SIZE), np.zeros(13)
    memory, received = initial_method_memory("ledger", p, START), np.zeros(PACKET_SIZE)
    pose, received[POSE] = START.copy(), START
    load = np.array([0.2, 0.0, -1.8, 0.0, 0.05, 0.0])
    stored, depth = memory[STORED_ENERGY][0], 0.0
    for k in range(1000):
        dx = np.array([0.0, 0.0, -1e-5, 0.0, 0.0, 0.0])
        pose[6] += dx[2]
        contact = np.array([0.0, 0.0, max(depth := -pose[6] - 0.004, 0.0) * 200.0, 0.0, 0.0, 0.0])
        memory[LOAD_WRENCH] = load + 0.5 * np.sin(0.3 * k) * np.eye(6)[1]
        wrench = contact + memory[LOAD_WRENCH]
        received[PACKET_NUMBER] += 1.0
        slave_step(
            step_addresses("ledger"), received, True, pose, dx / T, dx, wrench, T, p, memory,
            command, packet,
        )  # fmt: skip
        np.testing.assert_allclose(packet[WRENCH], contact, atol=1e-15)
        np.testing.assert_allclose(packet[PACKET_LOAD_WRENCH], load, atol=0.15)
        assert k > 400 or not memory[IN_CONTACT_FLAG], "nothing is touched yet"
    np.testing.assert_allclose(
        memory[CONTACT_DIRECTION], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0], atol=1e-12
    )
    stiffness = packet[PACKET_CONTACT_STIFFNESS]
    assert stiffness == pytest.approx(200.0, rel=0.05)
    # Packets of this hand need no energy for the slave.
    books = (
        memory[STORED_ENERGY][0] + memory[SENT_ENERGY][0] + memory[DISSIPATED_ENERGY][0] - stored
    )
    assert books == pytest.approx(1.8 * 0.01 - 0.5 * 200.0 * depth**2, rel=3e-3)
    hand = Hand(packet[WRENCH], stiffness)
    hand.packet[PACKET_LOAD_WRENCH] = load
    np.testing.assert_allclose(hand.rest(2500), load + packet[WRENCH], atol=1e-9)
    for _ in range(50):
        hand.step([0.0, 0.0, -2e-5, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(hand.rest(50)[:3] - load[:3], [0, 0, 1.2 + 0.2], atol=0.01)
