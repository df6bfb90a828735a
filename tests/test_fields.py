"""What help texts, references and schemas are made from: the list of a scenario's fields."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drake_teleop.fields import FieldInfo, fields_of
from drake_teleop.operator.operator import OperatorConfig
from drake_teleop.operator.task import KINDS
from drake_teleop.passivity.methods import PassivityConfig
from drake_teleop.scaling.force_scaling import ForceScalingConfig
from drake_teleop.scenario import Scenario, Simulation
from drake_teleop.studies.design import Factor, Study


def everything(block: type) -> Iterator[tuple[type, FieldInfo]]:
    """The fields of a block and of all blocks that may stand in it."""
    for entry in fields_of(block):
        yield block, entry
        for inner in entry.blocks:
            yield from everything(inner)


def named(config: object, name: str) -> FieldInfo:
    (entry,) = (entry for entry in fields_of(config) if entry.name == name)
    return entry


@pytest.mark.parametrize("root", [Scenario, Study])
def test_every_field_says_what_it_means(root: type) -> None:
    silent = [f"{block.__name__}.{entry.name}" for block, entry in everything(root)
              if not entry.meaning]  # fmt: skip
    assert silent == []


def test_a_quantity_has_unit_and_range() -> None:
    duration = named(Simulation, "duration")
    assert (duration.kind, duration.lists, duration.optional) == ("number", 0, False)
    assert (duration.unit, duration.default, duration.range) == ("s", 1.0, "0.001 to 36000 s")
    assert named(ForceScalingConfig, "sigma").range == "0 to 100"  # no unit
    assert named(Simulation, "integrator").range.startswith("runge_kutta3, ")


def test_lists_blocks_and_what_may_be_null() -> None:
    intent, task = named(OperatorConfig, "intent"), named(OperatorConfig, "task")
    assert (intent.kind, intent.lists, intent.range) == ("block", 1, "MinimumJerk or Sine")
    assert (task.blocks, task.lists, task.optional, task.default) == (KINDS, 0, True, None)
    vectors = named(Factor, "vectors")
    assert (vectors.kind, vectors.lists, vectors.length) == ("number", 2, None)
    assert named(ForceScalingConfig, "eta").optional


def test_an_instance_tells_its_own_defaults() -> None:
    """The same class stands at two places with other defaults."""
    charged = named(PassivityConfig, "charged_tdpa").default
    plain = named(PassivityConfig, "tdpa").default
    assert named(plain, "drag").default == [0.0, 0.0] != named(charged, "drag").default
