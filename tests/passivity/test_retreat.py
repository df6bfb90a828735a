"""Released hand in contact, for all methods except `none`."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.lab.comparison.one_dof import (
    PERIOD_S,
    REFERENCE_ONE_DOF,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.memory import LAST_PORT_WRENCH, MEMORY_SIZE
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig, method_parameters
from drake_teleop.station.passivity.safe_state import fade_retreat_wrench

LET_GO = 9000


@pytest.mark.parametrize("delay", [0.05, 0.3])
@pytest.mark.parametrize("method", [name for name in METHODS if name != "none"])
def test_released_hand_stays_slow(method, delay):
    """Wall of 5.1 kN/m, about 4 N without delay; 1.3 and 4.4 m/s without the limit."""
    intent = operator_intent()[:11000]
    intent[intent[:, 0] > 0.0] *= 1.375
    grip = np.tile([0.2, 5.0, 300.0], (len(intent), 1))
    grip[LET_GO:] = 0.0
    run = run_one_dof(
        REFERENCE_ONE_DOF, PassivityConfig(method=method), NetworkConfig(delay=delay),
        intent=intent, grip=grip, timeout=1.0,
    )  # fmt: skip
    speed = np.abs(np.diff(run.master_position[LET_GO - 1 :])) / PERIOD_S
    assert speed.max() < 0.3


def test_only_wrench_along_a_fast_hand_fades():
    """Speed and wrench by group, at the hand's scale; the inertial part stays."""
    config = PassivityConfig(method="tdpa", slave_mass=[2.0, 0.5])
    p = method_parameters(config, motion_scale=[2.0, 1.0])
    given = np.array([3.0, 4.0, 0.0, 0.0, 0.0, 2.0])
    along = np.array([0.6, 0.8, 0.0, 0.0, 0.0, 1.0])

    def left(before: np.ndarray, now: np.ndarray) -> np.ndarray:
        memory, wrench = np.zeros(MEMORY_SIZE), given.copy()
        fade_retreat_wrench(before, 1.0, p, memory, wrench)  # a long step: no filtering
        wrench[:] = given
        fade_retreat_wrench(now, 1e-9, p, memory, wrench)
        np.testing.assert_array_equal(memory[LAST_PORT_WRENCH], wrench)
        return np.array([wrench[:3] @ along[:3], wrench[3:] @ along[3:]])

    for speed, share in ((-9.0, 1.0), (0.99, 1.0), (1.5, 0.5), (2.0, 0.0), (9.0, 0.0)):
        twist = speed * np.repeat([0.2, 1.0], 3) * along
        np.testing.assert_allclose(left(twist, twist), share * np.array([5.0, 2.0]), atol=1e-6)
    # Deceleration by 1 m/s^2 and 2 rad/s^2 within the filter's 4 ms displays a mass of 2 kg.
    fast, slower = 9.0 * along, 9.0 * along - 4e-3 * np.repeat([1.0, 2.0], 3) * along
    np.testing.assert_allclose(left(fast, slower), [2.0, 1.0], rtol=1e-5)


def test_wrench_is_unchanged_without_a_method():
    memory, wrench = np.zeros(MEMORY_SIZE), np.ones(6)
    fade_retreat_wrench(np.full(6, 50.0), 1.0, method_parameters(PassivityConfig()), memory, wrench)
    np.testing.assert_array_equal(wrench, np.ones(6))
