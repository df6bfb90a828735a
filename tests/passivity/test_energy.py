"""Every method outputs at most the energy of its input, for any network and motion.

Motion at both ends and wrenches are random, and so are networks: delay up to 300 ms, jitter, loss,
bursts, reordering, duplicates, and a saturated device. `benchmarks/passivity.py` is a larger
version.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "passivity.py"
    spec = importlib.util.spec_from_file_location("passivity_bench", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["passivity_bench"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def energies(bench: ModuleType) -> dict[str, dict[str, float]]:
    return bench.study(networks=14, seconds=4.0, processes=1)


@pytest.mark.slow
def test_tdpa_output_never_exceeds_input(energies):
    assert energies["tdpa"]["energy"] >= -1e-9
    assert energies["tdpa"]["stronger"] <= 1e-12, "the wrench became stronger"


@pytest.mark.slow
def test_energy_from_drag_is_released_once(energies):
    assert energies["charged_tdpa"]["energy"] >= -1e-9
    assert energies["charged_tdpa"]["stronger"] <= 0.28 + 1e-12, "stronger by more than the drag"
    assert energies["charged_tdpa"]["stronger"] > 0.2, "there should have been drag"


@pytest.mark.slow
def test_wave_output_is_the_received_energy(energies):
    assert energies["wave"]["energy"] >= -1e-9
    assert energies["wave_hold"]["energy"] < -1e-3, "held waves should have created energy"


@pytest.mark.slow
def test_a_tank_is_never_overdrawn_at_the_true_port_of_a_held_wrench(energies):
    assert energies["two_layer"]["true_energy"] >= -1e-9
    assert energies["two_layer"]["tank"] >= -1e-9
    assert energies["two_layer_no_margin"]["tank"] < -1e-5, "the margin should have mattered"


@pytest.mark.slow
def test_energy_is_created_without_a_method(energies):
    assert energies["none"]["energy"] < -1.0
