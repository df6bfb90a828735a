"""Wrong types and shapes from Python raise one DrakeTeleopError, as from YAML."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import drake_teleop as dt
from drake_teleop.lab.analysis.linearization import linearize, linearize_station
from drake_teleop.lab.excitation.robot import RobotFromScenario
from drake_teleop.lab.identification import true_load
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.lab.studies.study import LoadStudy
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.normal_equations import NoiseStd
from drake_teleop.logs.read.canonical import Log
from drake_teleop.station.operator.operator import OperatorConfig
from drake_teleop.station.scenario import replace
from drake_teleop.station.simulation import simulate

N3, N6, N10 = np.ones((4, 3)), np.ones((4, 6)), np.ones(10)
NAME: Any = "free_motion_force"
HALF: Any = "half"
FOUND: Any = SimpleNamespace(estimate=np.ones(16))  # like the result of identify_load
LOADED: Any = {"load_estimate": np.ones(16)}


def scaled(**scales: Any) -> Any:
    kept = {"sigma_gripper": 0.0, "sigma_object": 0.0, "gamma": 1.0}
    return dt.scaled_wrench(N6, np.zeros(6), N3, N3, N3, N10, N10, **kept | scales)


def with_value(path: str, value: object) -> Callable[[], Any]:
    return lambda: replace(dt.Scenario(), **{path: value}).check()


#: Kind of mistake: the call, and the place in the message.
WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    # A word, list, tuple, array or flag in place of another kind, as from YAML.
    "a word for a number": (with_value("force_scaling__sigma", "half"), "force_scaling.sigma"),
    "a numeral": (with_value("force_scaling__sigma", "0.5"), "force_scaling.sigma"),
    "a list for a number": (with_value("force_scaling__eta", [0.5]), "force_scaling.eta"),
    "None for a number": (with_value("force_scaling__gamma", None), "force_scaling.gamma"),
    "a flag for a number": (with_value("simulation__duration", True), "simulation.duration"),
    "an array": (with_value("slave__position", np.ones(3)), "slave.position"),
    "a number for a vector": (with_value("slave__position", 0.4), "slave.position"),
    "a word in a vector": (with_value("slave__position", [0.5, "x", 0.4]), "slave.position[1]"),
    "a short vector": (with_value("slave__position", [0.5, 0.4]), "slave.position"),
    "a number for a flag": (with_value("wrist_sensor__ideal", 1), "wrist_sensor.ideal"),
    "a fraction for a seed": (with_value("simulation__seed", 0.5), "simulation.seed"),
    "a negative seed": (with_value("simulation__seed", -1), "simulation.seed"),
    "a number for a word": (with_value("operator__grip", 3), "operator.grip"),
    "a word for a block": (with_value("force_scaling", "half"), "force_scaling"),
    "a wrong block": (with_value("operator__task", dt.Scenario()), "operator.task"),
    "a word in a list of blocks": (with_value("operator__intent", ["up"]), "operator.intent[0]"),
    # A name or None in place of a scenario.
    "MakeTeleopStation": (lambda: dt.MakeTeleopStation(NAME), "scenario"),
    "MakeIdentificationStation": (lambda: dt.MakeIdentificationStation(NAME, NAME), "scenario"),
    "identify_load": (lambda: dt.identify_load(NAME), "scenario"),
    "run_scenario": (lambda: dt.run_scenario(NAME), "scenario"),
    "run_scenario of a path": (lambda: dt.run_scenario(Path("mine.yaml")), "scenario"),  # type: ignore[arg-type]
    "drive": (lambda: dt.drive(7), "scenario"),  # type: ignore[arg-type]
    "replace": (lambda: replace(NAME, simulation__seed=1), "scenario"),
    "LoadScenario": (lambda: dt.LoadScenario(dt.Scenario()), "scenario"),  # type: ignore[arg-type]
    "simulate": (lambda: simulate(NAME, NAME), "diagram"),
    "MakeMasterSide": (lambda: dt.MakeMasterSide(NAME), "scenario"),
    "MakeChannel": (lambda: dt.MakeChannel(NAME), "scenario"),
    "MakeSlaveSide": (lambda: dt.MakeSlaveSide(NAME), "scenario"),
    "identified_load": (lambda: identified_load(NAME), "scenario"),
    "RobotFromScenario": (lambda: RobotFromScenario(NAME), "scenario"),
    "linearize": (lambda: linearize(NAME), "scenario"),
    "linearize_station": (lambda: linearize_station(NAME), "scenario"),
    "LoadStudy": (lambda: LoadStudy(dt.Scenario()), "study"),  # type: ignore[arg-type]
    "a sine": (lambda: dt.Sine(frequency="high"), "Sine.frequency"),  # type: ignore[arg-type]
    "a step": (lambda: dt.MinimumJerk(duration=HALF), "MinimumJerk.duration"),
    "a block that is none": (lambda: replace(dt.Scenario(), description__x=1), "description.x"),
    # Loads and arrays.
    "a load of length 10": (lambda: station(load_estimate=N10), "load_estimate"),
    "a load in words": (lambda: station(load_estimate="heavy"), "load_estimate"),
    "a result for a load": (lambda: station(load_estimate=object()), "load_estimate"),
    "all that was identified": (lambda: station(load_estimate=FOUND), "load_estimate"),
    "a load that is NaN": (lambda: station(load_estimate=np.full(16, np.nan)), "load_estimate"),
    "a covariance": (lambda: station(load_covariance=N10, **LOADED), "load_covariance"),
    "a side": (lambda: station(master=NAME), "master"),
    "a trajectory": (lambda: identified(NAME), "trajectory"),
    "regressor": (lambda: dt.regressor(N3, N6, N3), "omega"),
    "non_contact_wrench": (lambda: dt.non_contact_wrench(N3, N3, N3, np.ones(16)), "phi"),
    "contact_wrench": (lambda: dt.contact_wrench(N6, HALF, N3, N3, N3, N10), "offsets"),
    "its load": (lambda: dt.contact_wrench(N6, np.zeros(6), N3, N3, N3, N3), "phi"),
    "scaled_wrench": (lambda: scaled(gamma=HALF), "gamma"),
    "a scale of None": (lambda: scaled(sigma_object=None), "sigma_object"),
    "identify": (lambda: dt.identify(N3, N3, N3, N3), "wrench"),
    "a delay": (lambda: dt.identify(N6, N3, N3, N3, delay_s=HALF), "delay_s"),
    "noise": (lambda: identify_batch(N6, N3, N3, N3, noise=HALF), "noise"),
    "two axes of noise": (lambda: NoiseStd(s=[0.1, 0.2]), "noise.s"),
    "noise in words": (lambda: NoiseStd(alpha=HALF), "noise.alpha"),
    "a table of walks": (lambda: NoiseStd(walk=N3), "noise.walk"),
    "negative noise": (lambda: NoiseStd(omega=-0.1), "noise.omega"),
    "a plant": (lambda: dt.AddWristSensor(None, 7, None), "AddWristSensor"),
    "a hand": (lambda: dt.tune("contact_transition", hands=("strong",)), "hands"),
    "a wall": (lambda: dt.tune("contact_transition", walls=(-1.0, 20.0)), "walls"),
    "a numeral for a wall": (lambda: dt.tune("contact_transition", walls=("0.5",)), "walls"),  # type: ignore[arg-type]
    "a task": (lambda: dt.tune("contact_transition", task="dance"), "task"),
    # Logs.
    "read_log": (lambda: dt.read_log(7), "log"),  # type: ignore[arg-type]
    "a filter": (lambda: dt.read_log("log.csv", bandwidth_hz=HALF), "bandwidth_hz"),
    "a log": (lambda: dt.identify_log({"wrench": 1}), "log"),  # type: ignore[arg-type]
    "a cut-off": (lambda: dt.identify_log("log.csv", cutoff_hz="30"), "cutoff_hz"),  # type: ignore[arg-type]
    "its size": (lambda: dt.eliminate_log("log.csv", "load.json", cutoff_hz=-3.0), "cutoff_hz"),
    "a time span": (lambda: eliminated(untouched_s=3.0), "untouched_s"),
    "words in it": (lambda: eliminated(untouched_s=("a", "b")), "untouched_s"),
    "a start": (lambda: eliminated(causal="delayed", causal_tare_s="1"), "causal_tare_s"),
    "a numeral for a scale": (lambda: scaled(gamma="1"), "gamma"),
    "numerals": (lambda: dt.regressor(N3.astype(str), N3, N3), "s"),  # type: ignore[arg-type]
    "bytes": (lambda: dt.non_contact_wrench(N3, N3, N3, N10.astype(bytes)), "phi"),
    "dates": (lambda: dt.regressor(N3.astype("M8[s]"), N3, N3), "s"),  # type: ignore[arg-type]
    "a method": (lambda: dt.identify_log("log.csv", method=7), "method"),  # type: ignore[arg-type]
    "a load's file": (lambda: dt.eliminate_log("log.csv", 7), "load"),  # type: ignore[arg-type]
    "Identification": (lambda: dt.Identification.load(7), "load"),  # type: ignore[arg-type]
    "a result": (lambda: dt.SimulationResult.read_parquet(7), "result"),  # type: ignore[arg-type]
    "signals": (lambda: dt.SimulationResult([0.0], {"a": [1.0]}, []), "signals"),
}  # fmt: skip


def station(**arguments: Any) -> Any:
    return dt.MakeTeleopStation(dt.Scenario(), **arguments)


def eliminated(**arguments: Any) -> Any:
    return dt.eliminate_log("log.csv", "load.json", **arguments)


def identified(trajectory: Any) -> Any:
    return dt.identify_load(dt.LoadScenario("identification"), trajectory=trajectory)


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_one_line_that_says_where(what: str) -> None:
    call, place = WRONG[what]
    with pytest.raises(dt.DrakeTeleopError) as caught:
        call()
    where = str(caught.value).split(": ")[0]
    assert where.removeprefix("scenario:") == place
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_every_public_function_is_tried() -> None:
    """A new public function fails here until it has a case."""
    functions = [name for name in dt.__all__ if callable(getattr(dt, name))]
    with open(__file__, encoding="utf-8") as file:
        text = file.read()
    untried = [name for name in functions if f"dt.{name}(" not in text]
    assert sorted(untried) == ["DrakeTeleopError", "Identification", "ScenarioNames", "simulate"]


def test_numbers_of_numpy_are_numbers() -> None:
    replace(
        dt.Scenario(),
        force_scaling__sigma=np.float32(0.5),
        simulation__seed=np.int64(3),
        slave__position=[np.float64(0.5), 0, 0.45],
    ).check()
    station(load_estimate=list(true_load(dt.Scenario())))


def test_values_are_checked_when_they_are_assigned() -> None:
    scenario = dt.Scenario()
    for block, name, value, says in (
        (scenario.passivity, "method", "legder", "'legder'; did you mean 'ledger'"),
        (scenario.force_scaling, "sigma", -3, "sigma: -3 is outside 0 to 100"),
        (scenario.slave, "position", [1.0], "has 1 numbers; give 3 numbers"),
        (scenario, "channel", "internet", "pass Channel(...) with fields delay"),
    ):
        before = getattr(block, name)
        with pytest.raises(dt.DrakeTeleopError) as error:
            setattr(block, name, value)
        assert says in str(error.value) and getattr(block, name) == before


def test_a_forgotten_simulation_is_named() -> None:
    scenario = replace(dt.Scenario(), force_scaling__sigma=1.0)
    with pytest.raises(dt.DrakeTeleopError, match=r"simulation: .*pass scenario\.simulation"):
        simulate(dt.MakeTeleopStation(scenario))


def test_a_printed_scenario_has_a_line_for_each_changed_field() -> None:
    scenario = dt.Scenario(operator=OperatorConfig(intent=[dt.Sine(frequency=2.0)]))
    scenario.slave.position[2] = 0.4
    assert str(scenario).splitlines() == [
        "Scenario",
        "  operator: OperatorConfig",
        "    intent[0]: Sine",
        "      frequency: 2",
        "  slave: Slave",
        "    position: [0.55, 0, 0.4]",
    ]


def test_a_printed_log_is_short() -> None:
    log = Log(0.1 * np.arange(4), 10.0 * N6, N3, N3, N3, notes=("a note",))
    assert str(log) == "Log log: 4 samples, 0 to 0.3 s, force up to 17.3 N\n  a note"
