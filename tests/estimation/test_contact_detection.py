"""Detector in the station: equal to that of logs, and delay until the hand."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import BasicVector, DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.identification import identification_scenario, identify_load, slave_arm
from drake_teleop.lab.run import is_in_contact
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.contact.detection import CONTACT_END_LEVEL, CUSUM_SLACK, ContactDetector
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.regressor import SATURATION_FLAG_INDEX, non_contact_wrench
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.estimation.contact_detection import (
    ContactDetection,
    ContactDetectionConfig,
)
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import accelerations_from_specific_forces
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.station import MakeTeleopStation

NOISE = np.repeat([0.1, 0.01], 3)
OFFSETS = np.array([5.0, -3.0, 2.0, 0.1, 0.2, 0.3])


@pytest.fixture(scope="module")
def arm():
    return AddSlavePlant(DiagramBuilder(), Slave(), None).arm


def floor() -> NoiseFloor:
    return NoiseFloor(
        NOISE,
        1e-6 * np.eye(16),
        np.full((6, 2), 0.01),
        np.eye(6),
        np.full(6, 0.2),
        free_maxima=np.array([5.0, 8.0, 6.0]),
    )


def test_settings_in_seconds_reach_the_detector_in_samples(arm):
    times = {"hold": 0.03, "drift_time": 2.0, "recovery": 0.007}
    config = ContactDetectionConfig(statistic="cusum", margin=1.5, **times)
    block = ContactDetection(config, floor(), arm, 1e-3)
    expected = CUSUM_SLACK, 1e-3 / 2.0, 1, 1.5 * 8.0, CONTACT_END_LEVEL, 30
    assert block._settings[1] == expected and block._recovery == 7


def test_saturated_sample_and_the_recovery_after_it_keep_the_flag(arm):
    block = ContactDetection(ContactDetectionConfig(recovery=3e-3), floor(), arm, 1e-3)
    context, sample, flags = block.CreateDefaultContext(), np.zeros(16 + 6 + 1), []
    block.GetInputPort("load_estimate").FixValue(context, np.zeros(16))
    for k in range(8):
        sample[0], sample[SATURATION_FLAG_INDEX] = (90.0, float(k == 1)) if k else (0.0, 0.0)
        block.GetInputPort("sample").FixValue(context, sample)
        context.SetDiscreteState(block.EvalUniquePeriodicDiscreteUpdate(context))
        flags.append(block.GetOutputPort("contact").Eval(context)[0])
    assert flags == [0, 0, 0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize("statistic", ["level", "glr"])
def test_block_equals_the_detector_of_logs(arm, statistic):
    """The load moves and is pushed; saturated and missing samples change nothing.

    The wrench drifts much faster than the detector follows.
    """
    rng, n = np.random.default_rng(4), 400
    s, omega, alpha = (5.0 * rng.normal(size=(n, 3)) for _ in range(3))
    wrench = OFFSETS + non_contact_wrench(s, omega, alpha, arm.phi_load)
    wrench += rng.normal(size=(n, 6)) * NOISE
    wrench[:, 2] += 5.0 * 1e-3 * np.arange(n)
    wrench[150:250, 1] -= 3.0
    saturated = np.zeros(n)
    saturated[200:220] = 1.0
    wrench[210, 0] = wrench[224, 0] = 1e5
    wrench[230, 0] = np.nan
    q = rng.normal(size=(n, 6))
    samples = np.column_stack([wrench, s, omega, alpha, saturated, q, np.zeros(n)])

    config = ContactDetectionConfig(
        statistic=statistic, margin=1.5, hold=0.05, drift_time=20.0, recovery=0.005
    )
    block = ContactDetection(config, floor(), arm, 1e-3)
    context = block.CreateDefaultContext()
    port = block.GetInputPort("sample").FixValue(context, samples[0])
    estimate = np.concatenate([OFFSETS, arm.phi_load])
    block.GetInputPort("load_estimate").FixValue(context, estimate)
    flags = []
    for sample in samples:
        port.GetMutableData().set_value(BasicVector(sample))
        context.SetDiscreteState(block.EvalUniquePeriodicDiscreteUpdate(context))
        flags.append(block.GetOutputPort("contact").Eval(context)[0] > 0)

    good = np.ones(n, bool)
    good[200:225] = good[230] = False
    wrench[230, 0] = 0.0  # not used
    contact = contact_wrench(wrench, OFFSETS, s, omega, alpha, arm.phi_load)
    detector = ContactDetector(
        floor(),
        1.5 * {"level": 5.0, "glr": 6.0}[statistic],
        statistic=statistic,
        hold=50,
        following=1e-3 / 20.0,
    )
    rows = (contact, s, omega, alpha, accelerations_from_specific_forces(arm, q, s))
    expected = detector.detect(*(x[good] for x in rows))
    assert expected.any() and not expected.all()
    np.testing.assert_array_equal(np.array(flags)[good], expected)
    assert all(flags[199:225])


@pytest.fixture(scope="module")
def identified():
    scenario = replace(
        LoadScenario("contact_transition"), contact_detection=ContactDetectionConfig()
    )
    found = identify_load(identification_scenario(scenario, 1))
    return scenario, found.estimate, found.noise_floor(slave_arm(scenario))


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.015, 0.05])
def test_contact_is_detected_and_reaches_the_hand_after_the_delay(identified, delay):
    scenario, estimate, noise_floor = identified
    scenario = replace(scenario, channel=Channel(delay=delay))
    station = MakeTeleopStation(scenario, load_estimate=estimate, noise_floor=noise_floor)
    result = simulate(station, scenario.simulation)
    touched, slave, hand = is_in_contact(result), result["contact"], result["contact_at_hand"]
    # In samples of 1 ms.
    assert 0 <= slave.argmax() - touched.argmax() <= 4
    assert np.count_nonzero(np.diff(slave[:, 0])) == 2
    late = hand.argmax() - slave.argmax()
    assert late == pytest.approx(1e3 * delay, abs=1)
    np.testing.assert_array_equal(hand[late:], slave[: len(slave) - late])


@pytest.mark.slow
def test_station_without_detector_has_no_contact_signal(identified):
    scenario, estimate, _ = identified
    plain = replace(scenario, contact_detection=None)
    station = MakeTeleopStation(plain, load_estimate=estimate)
    assert not station.HasSubsystemNamed("contact_detection")
    with pytest.raises(DrakeTeleopError, match=r"contact_detection: .*pass noise_floor"):
        MakeTeleopStation(scenario, load_estimate=estimate)
    unfitted = NoiseFloor(NOISE, np.zeros((16, 16)), np.zeros((6, 2)), np.eye(6), np.zeros(6))
    with pytest.raises(DrakeTeleopError, match="free_maxima"):
        MakeTeleopStation(scenario, load_estimate=estimate, noise_floor=unfitted)
