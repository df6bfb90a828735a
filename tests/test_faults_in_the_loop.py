"""Faults in the running station: the force at the hand is limited, and they are reported.

The faults and the limits of the force are those of benchmarks/faults.py.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from drake_teleop.common.blocks import Fault
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.run_warnings import run_warnings
from drake_teleop.station.scenario import replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import GetBlock


def load_faults() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "faults.py"
    spec = importlib.util.spec_from_file_location("bench_faults", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_faults"] = module
    spec.loader.exec_module(module)
    return module


faults = load_faults()
faults.END = 0.95  # s, long enough to fade and to begin to resume


@pytest.fixture(scope="module")
def direct():
    return faults.Running("no channel")


@pytest.fixture(scope="module")
def two_layer():
    return faults.Running("two_layer")


ONE, SHORT, LONG = 5e-4, 0.02, 0.25  # s
NONE, STALE, READING, LOAD, WRENCH, HAND = (
    Fault.NONE, Fault.OLD_SAMPLE, Fault.BAD_READING, Fault.INVALID_LOAD,
    Fault.HAND_WRENCH, Fault.HAND_JOINTS,
)  # fmt: skip
CASES = [
    # station, kind, place, length, number, size: reported cause at the slave, at the hand
    ("direct", "nan", "sensor", ONE, 1, np.nan, READING, WRENCH),
    ("direct", "nan", "encoders", SHORT, 3, np.inf, READING, WRENCH),
    ("direct", "nan", "load", LONG, 5, np.nan, LOAD, WRENCH),
    ("direct", "nan", "device", LONG, 2, np.nan, NONE, HAND),
    ("direct", "spike", "sample", ONE, 2, 1e9, READING, WRENCH),
    ("direct", "spike", "wrench", SHORT, 0, -1e9, NONE, WRENCH),
    ("direct", "frozen", "sample", LONG, 0, 0.0, STALE, WRENCH),
    ("direct", "clock", "sample", SHORT, 0, -3.0, STALE, WRENCH),
    ("two_layer", "nan", "load", LONG, 5, np.nan, LOAD, NONE),
    ("two_layer", "spike", "pose", ONE, 5, 1e9, NONE, NONE),
    ("two_layer", "spike", "wrench", ONE, 1, 1e9, NONE, NONE),
    ("two_layer", "nan", "encoders", SHORT, 0, np.nan, READING, NONE),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind", "place", "length", "index", "size", "at", "hand"), CASES)
def test_a_fault_is_faded_and_named(name, kind, place, length, index, size, at, hand, request):
    running = request.getfixturevalue(name)
    fault = faults.Fault(kind, place, 0.62, length, index, size)
    result = running.run(fault)
    count = faults.Count()
    assert count.add(fault, result), count
    before = np.linalg.norm(result["force_to_master"][result.t < 0.62, :3], axis=1)
    assert before[-1] > 1.0, "nothing was felt that could step"
    assert set(result["fault"][:, 0]) == {0.0, float(at)}
    assert set(result["fault_at_hand"][:, 0]) == {0.0, float(hand)} | ({7.0} if hand else set())
    told = run_warnings(result, running.scenario, slave_arm(running.scenario))
    assert ("a fault: " in " ".join(told)) == bool(at or hand)


@pytest.mark.slow
def test_one_sample_of_1e9_newtons_is_not_in_the_filters(direct):
    """The sensor's offset causes it for one hand sample; filters are clean 0.5 ms later."""
    sensor = GetBlock(direct.station, "wrist_sensor")
    (tap,) = direct.taps["sensor"]
    offset, wrenches = np.array(sensor.offset), []
    for size in (0.0, 1e9):

        def change(x, time, size=size):
            sensor.offset[0] = offset[0] + (size if 0.62 <= time < 0.6205 else 0.0)

        # The fault has no kind: only `change` acts.
        tap.change = change
        result = direct.run(faults.Fault("", "", 0.62, ONE, 0, 0.0))
        tap.change = None
        wrenches.append(result["measured_wrench_S"][(result.t > 0.6215) & (result.t < 0.63), 0])
        assert bool(result["fault"].any()) == (size > 0.0)
    assert np.abs(wrenches[1] - wrenches[0]).max() < 0.6  # noise; later the hand has moved


def test_the_run_ends_with_one_line_if_the_scenario_says_so():
    scenario = replace(faults.pressing("no channel"), simulation__on_fault="stop")
    scenario = replace(scenario, simulation__duration=0.1)
    station, taps = faults.tapped_station(scenario)
    fault = faults.Fault("nan", "load", 0.03, 0.01, 5, np.nan)
    taps["load"][0].change = faults.change_of(fault, station)
    with pytest.raises(
        DrakeTeleopError,
        match=r"on_fault: the run stops at 0\.030 s by a fault: the load estimate is not finite",
    ):
        simulate(station, scenario.simulation, progress=False)
    taps["load"][0].change = None
    assert simulate(station, scenario.simulation, progress=False).t[-1] == pytest.approx(0.1)
