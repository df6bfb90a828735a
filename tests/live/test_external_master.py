"""Displayed wrench of a real haptic device."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from drake_teleop.live.hand import (
    _ALLOWED_SHARE_INDEX,
    _DISPLAY_STATE_SIZE,
    _FAULT_INDEX,
    ExternalMaster,
    MakeExternalMasterSide,
    _limit_device_wrench_into,
)
from drake_teleop.station.scenario import LoadScenario

PERIOD = 1e-3


@pytest.mark.parametrize("limits", [(10.0, 0.2), (3.0, 5.0)])
@pytest.mark.parametrize("wrench", [(0.0, 80.0, -60.0, 0.0, 4.0, 3.0), (0.3, 0, 0, 0, 0, 0.02)])
def test_force_and_torque_have_their_own_limits_and_slew_rates(limits, wrench):
    wrench, last, shown = np.array(wrench, float), np.zeros(_DISPLAY_STATE_SIZE), []
    for k in range(500):
        now, held = np.empty(_DISPLAY_STATE_SIZE), k < 400
        _limit_device_wrench_into(wrench, held, PERIOD, np.array(limits), last, now)
        shown.append(now)
        last = now
    for part, limit in zip((slice(0, 3), slice(3, 6)), limits, strict=True):
        sizes = np.linalg.norm([each[part] for each in shown], axis=1)
        size = np.linalg.norm(wrench[part])
        assert sizes[399] == pytest.approx(min(size, limit))
        np.testing.assert_allclose(shown[399][part], wrench[part] * sizes[399] / size)
        assert (sizes[:10] <= 4.0 * PERIOD * np.arange(1, 11) * limit + 1e-12).all()
        assert np.abs(np.diff(sizes)).max() <= 150.0 * PERIOD * limit + 1e-12
        assert sizes[407] == 0.0


@pytest.mark.parametrize("place", range(6))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_wrench_that_is_not_finite_is_a_fault_and_fades(place, value):
    last, now, wrench = np.zeros(_DISPLAY_STATE_SIZE), np.empty(_DISPLAY_STATE_SIZE), np.ones(6)
    last[0], last[_ALLOWED_SHARE_INDEX] = 2.0, 1.0
    wrench[place] = value
    _limit_device_wrench_into(wrench, True, PERIOD, np.array([4.0, 1.0]), last, now)
    assert now[_FAULT_INDEX] > 0.0
    assert now[_ALLOWED_SHARE_INDEX] == pytest.approx(0.98)
    np.testing.assert_allclose(now[:6], [2.0 - 0.15 * 4.0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("model", ["phantom_premium_15", "omega_6"])
def test_side_of_a_real_device_has_the_limits_of_the_device(model):
    scenario = LoadScenario("free_motion_force")
    scenario.master.model = model
    device = scenario.master.device(0.0, 0.0)
    side = MakeExternalMasterSide(scenario)
    limits = side.GetSubsystemByName("live_hand")._limits
    peaks = device.parameters.peak_force, max(device.parameters.peak_torque)
    np.testing.assert_array_equal(limits, peaks)
    assert limits[0] > 2.0 * limits[1]


def test_state_has_position_yaw_pitch_roll_and_twist_of_the_path():
    start, end = np.array([1.0, 0, 0, 0, 0.1, 0.2, 0.3]), [0.11, 0.18, 0.33]
    master = ExternalMaster(start, PERIOD, np.ones(2))
    context = master.CreateDefaultContext()
    context.SetTime(1.0)
    turn = RollPitchYaw(0.1, -0.2, 0.3)
    master.SetTarget(context, np.array([*turn.ToQuaternion().wxyz(), *end]))
    twist = master.GetOutputPort("twist_master").Eval(context)
    rotation = turn.ToRotationMatrix().ToAngleAxis()
    np.testing.assert_allclose(twist[:3], np.subtract(end, start[4:]) / 2e-3)
    np.testing.assert_allclose(twist[3:], rotation.angle() * rotation.axis() / 2e-3)
    context.SetTime(1.002)
    state = master.GetOutputPort("master_state").Eval(context)
    np.testing.assert_allclose(state, [*end, 0.3, -0.2, 0.1, *np.zeros(6)], atol=1e-12)
    assert not master.GetOutputPort("twist_master").Eval(context).any()
