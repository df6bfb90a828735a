"""Transfer of a station's state to another station, by block names."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from pydrake.systems import framework
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, DiscreteValues, System

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.station.wiring import export_outputs

#: Blocks whose parameters change during a live session.
_BLOCKS_WITH_CHANGEABLE_PARAMETERS = ("live_hand", "force_scaling", "channel")


def copy_station_state(
    old: Diagram, old_context: Context, new: Diagram, new_context: Context, excluded: set[str]
) -> None:
    """Copy time, states and changeable parameters, except of blocks with names in `excluded`."""
    new_context.SetTime(old_context.get_time())
    sources = dict(_blocks_by_path(old))
    for path, block in _blocks_by_path(new):
        source, names = sources.get(path), path.split("/")
        if source is None or type(source) is not type(block) or excluded & set(names):
            continue
        _copy_block_state(
            source.GetMyContextFromRoot(old_context),
            block.GetMyMutableContextFromRoot(new_context),
            names[-1] in _BLOCKS_WITH_CHANGEABLE_PARAMETERS,
        )


def _blocks_by_path(diagram: Diagram, path: str = "") -> Iterator[tuple[str, System]]:
    for system in diagram.GetSystems():
        name = f"{path}/{system.get_name()}"
        if isinstance(system, Diagram):
            yield from _blocks_by_path(system, name)
        else:
            yield name, system


def _copy_block_state(source: Context, target: Context, with_parameters: bool) -> None:
    if source.num_continuous_states() == target.num_continuous_states() > 0:
        target.SetContinuousState(source.get_continuous_state_vector().CopyToVector())
    groups = source.num_discrete_state_groups()
    if groups == target.num_discrete_state_groups():
        for k in range(groups):
            values = source.get_discrete_state(k).value()
            if values.size == target.get_discrete_state(k).size():
                target.SetDiscreteState(k, values)
    if with_parameters:
        for k in range(source.num_numeric_parameter_groups()):
            values = source.get_numeric_parameter(k).value()
            target.get_mutable_numeric_parameter(k).SetFromVector(values)
        for k in range(source.num_abstract_parameters()):
            target.get_mutable_abstract_parameter(k).SetFrom(source.get_abstract_parameter(k))


@njit(cache=True)
def _new_wrench_weight(start_and_duration, time):
    u = min(max((time - start_and_duration[0]) / start_and_duration[1], 0.0), 1.0)
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


@njit(cache=True)
def _blend_and_limit_wrench_into(wrench, old_wrench, weight, max_force, out):
    for i in range(6):
        out[i] = weight * wrench[i] + (1.0 - weight) * old_wrench[i] if weight < 1.0 else wrench[i]
    force = _force_norm(out)
    if force > max_force:
        for i in range(6):
            out[i] *= max_force / force


@njit(cache=True)
def _force_norm(wrench):
    return math.sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2)


def build_master_side(
    builder: DiagramBuilder, master: System, inner_side: System, period: float, cross_fade: bool
) -> Diagram:
    """Build a side from `master` and the clutch of `inner_side`; `cross_fade`: blend wrenches."""
    wrench = master.GetInputPort("wrench_command")
    if cross_fade:
        block = builder.AddNamedSystem("cross_fade", CrossFade(period))
        builder.Connect(block.get_output_port(), wrench)
        wrench = block.get_input_port()
    builder.ExportInput(wrench, "wrench_command")
    builder.ExportInput(inner_side.GetInputPort("clutch"), "clutch")
    names = [master.get_output_port(index).get_name() for index in range(master.num_output_ports())]
    export_outputs(builder, master, *names)
    return builder.Build()


class CrossFade(framework.LeafSystem):
    """Cross-fade from the rendered wrench of a previous station.

    .. pydrake_system::

        name: CrossFade
        input_ports:
        - wrench: (6,) F_E_B of the new station [N, N m]
        output_ports:
        - felt: (6,) rendered wrench
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, period: float) -> None:
        super().__init__()
        # Start [s], length [s], previous rendered wrench (6,).
        self._change = self.DeclareNumericParameter(framework.BasicVector(8))
        # Weight of the new wrench, and force limit [N]. They are discrete, since the integrator
        # would evaluate a function of time several times in each step.
        self._state = int(self.DeclareDiscreteState([1.0, math.inf]))
        self._wrench = self.DeclareVectorInputPort("wrench", 6)
        inputs = {self._wrench.ticket(), self.xd_ticket(), self.pn_ticket()}
        self.DeclareVectorOutputPort("felt", 6, weak_callback(self._calc_wrench), inputs)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_fade_weight_and_max_force)

    def StartFade(self, context: Context, start: float, duration: float, rendered: Array) -> None:
        """Cross-fade from the wrench `rendered` (6,), from time `start` [s] for `duration` [s]."""
        change = np.concatenate([[start, duration], rendered])
        context.get_mutable_numeric_parameter(self._change).SetFromVector(change)
        context.get_mutable_discrete_state(self._state)[0] = 0.0

    def LimitForce(self, context: Context, max_force: float) -> None:
        """Limit the force to `max_force` [N] until the new force is smaller."""
        context.get_mutable_discrete_state(self._state)[1] = max_force

    def force_above_limit(self, context: Context) -> float:
        """Return the force [N] by which `LimitForce` reduces the wrench; 0 during a cross-fade."""
        weight, max_force = context.get_discrete_state(self._state).value()
        force = _force_norm(self._wrench.Eval(context))
        return max(force - max_force, 0.0) if weight == 1.0 else 0.0

    def _update_fade_weight_and_max_force(self, context: Context, state: DiscreteValues) -> None:
        weight, max_force = state.value(self._state)
        if weight < 1.0:
            change = context.get_numeric_parameter(self._change).value()
            state.get_mutable_value(self._state)[0] = _new_wrench_weight(change, context.get_time())
        elif max_force < math.inf and _force_norm(self._wrench.Eval(context)) <= max_force:
            state.get_mutable_value(self._state)[1] = math.inf

    def _calc_wrench(self, context: Context, output: framework.BasicVector) -> None:
        weight, max_force = context.get_discrete_state(self._state).value()
        wrench = self._wrench.Eval(context)
        if weight == 1.0 and max_force == math.inf:  # the usual case, in half the time
            output.SetFromVector(wrench)
            return
        before = context.get_numeric_parameter(self._change).value()[2:]
        _blend_and_limit_wrench_into(wrench, before, weight, max_force, output.get_mutable_value())
