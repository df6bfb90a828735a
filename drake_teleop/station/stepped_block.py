"""Base class of blocks with one cached step per period."""

from __future__ import annotations

import weakref
from abc import abstractmethod
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem, ValueProducer

from drake_teleop.common.blocks import DoubleOnlySystem, weak_callback
from drake_teleop.common.numeric import Array


class SteppedBlock(DoubleOnlySystem, LeafSystem):
    """Block whose discrete states and outputs share one calculated step per period."""

    __slots__ = ()

    def _declare_step(self, results: list[Array], num_states: int, period: float) -> None:
        """Declare the discrete states and the `period` [s] of their step.

        `results` are initial arrays: first `num_states` states, then outputs.
        """
        # Integers are faster than Drake's own indices.
        self._states = [int(self.DeclareDiscreteState(part)) for part in results[:num_states]]
        producer = ValueProducer(
            allocate=lambda: AbstractValue.Make([np.array(part) for part in results]),
            calc=weak_callback(self._calc_step_results),
        )
        sources = {self.all_input_ports_ticket(), self.xd_ticket()}
        step = self.DeclareCacheEntry("step", producer, sources)
        self._step = step.cache_index()  # the entry itself would keep the block alive
        self._after_step = {step.ticket()}
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store_states_after_step)

    def _declare_output(self, name: str, result_index: int, part: slice) -> None:
        """Declare an output port with slice `part` of the step's array `results[result_index]`."""
        block: Any = weakref.ref(self)

        def copy_part(context: Context, output: Any) -> None:
            output.SetFromVector(block()._step_results(context)[result_index][part])

        self.DeclareVectorOutputPort(name, part.stop - part.start, copy_part, self._after_step)

    @abstractmethod
    def _advance_states_and_outputs(self, context: Context, results: list[Array]) -> None:
        """Advance the states `results[:num_states]` by a period; write the other, output arrays."""

    def _calc_step_results(self, context: Context, step: AbstractValue) -> None:
        results = step.get_mutable_value()
        for state, index in zip(results, self._states, strict=False):
            state[:] = context.get_discrete_state(index).value()
        self._advance_states_and_outputs(context, results)

    def _step_results(self, context: Context) -> list[Array]:
        results: list[Array] = self.get_cache_entry(self._step).Eval(context)
        return results

    def _store_states_after_step(self, context: Context, discrete_state: DiscreteValues) -> None:
        for state, index in zip(self._step_results(context), self._states, strict=False):
            discrete_state.set_value(index, state)
