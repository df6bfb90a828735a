"""Fields of scenarios: the source of help texts, references and schemas."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import drake_teleop
from drake_teleop.common.config import FieldInfo, check_all_field_values, fields_of
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.station.channel import network
from drake_teleop.station.master.data_sheets import FIGURES
from drake_teleop.station.operator.operator import OperatorConfig
from drake_teleop.station.operator.task import TASK_CLASSES
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, Simulation, replace
from drake_teleop.station.sensor import presets as sensors
from drake_teleop.station.slave.joint_control import POSITION_INTERFACE_PRESETS


def everything(block: type) -> Iterator[tuple[type, FieldInfo]]:
    """Yield the fields of a block and of all its inner blocks."""
    for entry in fields_of(block):
        yield block, entry
        for inner in entry.blocks:
            yield from everything(inner)


def named(config: object, name: str) -> FieldInfo:
    (entry,) = (entry for entry in fields_of(config) if entry.name == name)
    return entry


@pytest.mark.parametrize("root", [Scenario, Study])
def test_every_field_has_a_meaning(root: type) -> None:
    silent = [f"{block.__name__}.{entry.name}" for block, entry in everything(root)
              if not entry.meaning]  # fmt: skip
    assert silent == []


def test_a_quantity_has_unit_and_range() -> None:
    duration = named(Simulation, "duration")
    assert (duration.kind, duration.list_depth, duration.optional) == ("number", 0, False)
    assert (duration.unit, duration.default, duration.limits_or_choices) == (
        "s",
        1.0,
        "0.001 to 36000 s",
    )
    assert named(ForceScalingConfig, "sigma").limits_or_choices == "0 to 100"  # no unit
    assert named(Simulation, "integrator").limits_or_choices.startswith("runge_kutta3, ")


def test_lists_blocks_and_optional_fields() -> None:
    intent, task = named(OperatorConfig, "intent"), named(OperatorConfig, "task")
    assert (intent.kind, intent.list_depth, intent.limits_or_choices) == (
        "block",
        1,
        "MinimumJerk or Sine",
    )
    assert (task.blocks, task.list_depth, task.optional, task.default) == (
        TASK_CLASSES,
        0,
        True,
        None,
    )
    vectors = named(Factor, "vectors")
    assert (vectors.kind, vectors.list_depth, vectors.length) == ("number", 2, None)
    assert named(ForceScalingConfig, "eta").optional


VECTORS = {
    f"{block.__name__}.{entry.name}": (block, entry)
    for block, entry in everything(Scenario)
    if entry.unit and entry.list_depth == 1 and entry.default != []
}
LISTS = {
    f"{block.__name__}.{entry.name}": (block, entry)
    for block, entry in everything(Scenario)
    if entry.unit and entry.default in ([], {})
}


@pytest.mark.parametrize("place", sorted(VECTORS))
@pytest.mark.parametrize("surplus", [-1, 1])
def test_vector_of_another_length_raises(place: str, surplus: int) -> None:
    block, entry = VECTORS[place]
    assert entry.length is not None
    value = [max(entry.low, 0.0)] * (entry.length + surplus)
    with pytest.raises(DrakeTeleopError, match=rf"{entry.name}: .*{len(value)} number"):
        check_all_field_values(block(**{entry.name: value}), "scenario")


@pytest.mark.parametrize("place", sorted(LISTS))
def test_each_number_of_a_list_or_mapping_is_in_its_range(place: str) -> None:
    block, entry = LISTS[place]
    name = f"{entry.name}.j" if entry.is_mapping else entry.name
    for wrong in (np.nextafter(entry.low, -np.inf), np.nan):
        values = [entry.low, wrong]
        given = dict(zip("ij", values, strict=True)) if entry.is_mapping else values
        with pytest.raises(DrakeTeleopError, match=rf"{block.__name__}\.{name}: .* is outside"):
            block(**{entry.name: given})


def test_instance_gives_its_own_defaults() -> None:
    """One class is used at two places with different defaults."""
    charged = named(PassivityConfig, "charged_tdpa").default
    plain = named(PassivityConfig, "tdpa").default
    assert named(plain, "drag").default == [0.0, 0.0] != named(charged, "drag").default


def test_misspelt_field_raises_with_a_suggestion() -> None:
    scenario = Scenario()
    with pytest.raises(DrakeTeleopError, match=r"ForceScalingConfig\.sgima: .* mean 'sigma'"):
        scenario.force_scaling.sgima = 0.5
    with pytest.raises(DrakeTeleopError, match=r"slip: there is no .* mean 'slip_speed'"):
        replace(LoadScenario("contact_transition"), sheet_spring__slip=0.001)  # part of a name
    with pytest.raises(DrakeTeleopError, match="mean 'force_scaling'"):
        scenario.force_scalling = ForceScalingConfig()
    with pytest.raises(DrakeTeleopError, match=r"scenario:force_scaling\.sgima: .* 'sigma'"):
        replace(scenario, force_scaling__sgima=0.5)
    with pytest.raises(DrakeTeleopError, match=r"scenario:simulaton: .* mean 'simulation'"):
        replace(scenario, simulaton__seed=1)
    with pytest.raises(DrakeTeleopError, match="slot is None in this scenario"):
        replace(scenario, slot__depth=0.03)
    assert scenario == Scenario()


def test_every_mutable_dataclass_is_a_settings_class() -> None:
    forgotten = []
    for path in Path(drake_teleop.__file__).parent.rglob("*.py"):
        classes = re.findall(r"((?:^@.*\n)+)class ([A-Z]\w*)", path.read_text("utf-8"), re.M)
        forgotten += [name for marks, name in classes if marks == "@dataclass\n"]
    assert forgotten == []


def test_settings_can_be_copied_pickled_and_replaced() -> None:
    scenario = LoadScenario("contact_transition")
    for other in (copy.deepcopy(scenario), pickle.loads(pickle.dumps(scenario))):
        assert other == scenario
        other.force_scaling.sigma = 0.25
        other.simulation = dataclasses.replace(other.simulation, seed=3)
        assert other == replace(scenario, force_scaling__sigma=0.25, simulation__seed=3)


@pytest.mark.parametrize(
    "presets", [sensors.PRESETS, network.PRESETS, FIGURES, POSITION_INTERFACE_PRESETS]
)
def test_change_of_a_preset_does_not_change_the_shipped_one(presets) -> None:
    default = object()
    assert presets.get("unknown", default) is default and presets.get("unknown") is None
    for name, before in copy.deepcopy(dict(presets)).items():
        for changed in (presets[name], presets.get(name)):
            for field in dataclasses.fields(changed):
                value = getattr(changed, field.name)
                if isinstance(value, list):
                    value.append(0.5)
                elif isinstance(value, float):
                    object.__setattr__(changed, field.name, value + 0.5)
            assert changed != before and presets[name] == before


@pytest.mark.parametrize(
    "changes", [{}, {"force_scaling__sigma": 0.5}, {"slave": Scenario().slave, "slot": None}]
)
def test_change_of_a_replaced_scenario_does_not_change_the_first_one(changes) -> None:
    first = Scenario()
    for other in (replace(first, **changes), first.without_environment()):
        other.simulation.seed, other.wrist_sensor.offset[0] = 7, 1.0
        other.environment.append(None)
        assert first == Scenario() and other != first


def test_help_contains_units_ranges_and_meanings() -> None:
    text = Simulation.__doc__ or ""
    assert text.startswith("Duration and integrator of a simulation.")
    assert "    duration: logged time (0.001 to 36000 s; default 1)" in text.splitlines()
    assert "(runge_kutta3, runge_kutta2," in " ".join(text.split())
