"""The block of Fig. 2 and the rules of its scales."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station.scaling.force_scaling import ForceScaling, ForceScalingConfig
from drake_teleop.station.slave.arm import acceleration_from_specific_force_into
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave

GRIPPER = [2.0, 0.01, -0.02, 0.15, 0.02, 0.0, 0.0, 0.02, 0.0, 0.01]


@pytest.fixture(scope="module")
def arm():
    return AddSlavePlant(DiagramBuilder(), Slave(), None).arm


def outputs(
    config: ForceScalingConfig, arm, contact=(0.0,) * 6, scales: dict[str, float] | None = None
) -> dict[str, np.ndarray]:
    """Return the block's outputs for one sample of a load that moves in contact.

    Given `scales` are set while it runs.
    """
    rng = np.random.default_rng(3)
    motion, offsets = rng.normal(size=(3, 3)) * 5, rng.normal(size=6)
    measured = non_contact_wrench(*motion, arm.phi_load) + offsets + contact
    block = ForceScaling(config, arm, np.eye(3))
    context = block.CreateDefaultContext()
    sample = np.concatenate([measured, *motion, [0.0], Q, [0.0]])
    block.GetInputPort("sample").FixValue(context, sample)
    block.GetInputPort("load_estimate").FixValue(context, np.concatenate([offsets, arm.phi_load]))
    if scales is not None:
        block.SetScales(context, **scales, duration=0.0)
    names = ("scaled_wrench_S", "contact_wrench_S", "non_contact_wrench_S")
    names += ("wrench_B", "load_wrench_B")
    found = {name: block.GetOutputPort(name).Eval(context) for name in names}
    both = block.GetOutputPort("scaled_contact_and_fault").Eval(context)
    np.testing.assert_array_equal(both[:6], found["scaled_wrench_S"])
    np.testing.assert_array_equal(both[6:12], found["contact_wrench_S"])
    assert both[12] == block.GetOutputPort("fault").Eval(context)[0] == 0.0
    found["of_gripper"] = non_contact_wrench(*motion, np.array(GRIPPER))
    return found


def test_four_cases_of_section_v_have_their_wrenches(arm):
    contact = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    for sigma in (0.0, 0.5, 1.0, 2.0):
        out = outputs(ForceScalingConfig(sigma=sigma), arm, contact)
        np.testing.assert_allclose(out["contact_wrench_S"], contact, atol=1e-12)
        expected = contact + sigma * out["non_contact_wrench_S"]
        np.testing.assert_allclose(out["scaled_wrench_S"], expected, atol=1e-12)


def test_gamma_scales_only_the_contact(arm):
    contact = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    out = outputs(ForceScalingConfig(sigma=0.0, gamma=3.0), arm, contact)
    np.testing.assert_allclose(out["scaled_wrench_S"], 3 * contact, atol=1e-12)


def test_eta_keeps_that_share_of_the_object(arm):
    config = ForceScalingConfig(sigma=0.0, eta=0.25, gripper_phi=GRIPPER)
    out = outputs(config, arm)
    total = out["non_contact_wrench_S"]
    none = outputs(ForceScalingConfig(sigma=0.0, eta=0.0, gripper_phi=GRIPPER), arm)
    whole = outputs(ForceScalingConfig(sigma=0.0, eta=1.0, gripper_phi=GRIPPER), arm)
    np.testing.assert_allclose(none["scaled_wrench_S"], 0.0, atol=1e-12)
    np.testing.assert_allclose(out["scaled_wrench_S"], 0.25 * whole["scaled_wrench_S"], atol=1e-12)
    assert np.abs(whole["scaled_wrench_S"] - total).max() > 1.0


def test_each_scale_that_is_set_while_running_scales_its_own_part(arm):
    contact = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    scales = dict(sigma_gripper=0.2, sigma_object=0.7, gamma=1.3, force_scale=0.05)
    config = ForceScalingConfig(sigma=0.5, gripper_phi=GRIPPER)
    out = outputs(config, arm, contact, scales)
    gripper = out["of_gripper"]
    expected = 1.3 * contact + 0.2 * gripper + 0.7 * (out["non_contact_wrench_S"] - gripper)
    np.testing.assert_allclose(out["scaled_wrench_S"], expected, atol=1e-12)
    length = np.linalg.norm(out["wrench_B"][:3])
    assert length == pytest.approx(0.05 * np.linalg.norm(expected[:3]))
    assert np.linalg.norm(gripper) > 1.0


Q = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0])


def weight_wrench(arm, phi) -> np.ndarray:
    """Return the wrench V(-g) phi in the pose of `outputs`."""
    gravity = np.empty(3)
    acceleration_from_specific_force_into(arm.table, Q, np.zeros(3), gravity)
    assert np.linalg.norm(gravity) == pytest.approx(9.81, rel=1e-3)
    return non_contact_wrench(-gravity, np.zeros(3), np.zeros(3), phi)


def test_weight_and_inertia_have_separate_scales(arm):
    contact = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    config = ForceScalingConfig(sigma=7.0, sigma_weight=0.3, sigma_inertia=0.8, gamma=3.0)
    out = outputs(config, arm, contact)
    expected = 3.0 * contact + 0.8 * out["non_contact_wrench_S"]
    expected += (0.3 - 0.8) * weight_wrench(arm, arm.phi_load)
    np.testing.assert_allclose(out["scaled_wrench_S"], expected, atol=1e-12)
    rest = outputs(ForceScalingConfig(sigma=0.0, gamma=3.0), arm, contact)["wrench_B"]
    np.testing.assert_allclose(out["load_wrench_B"], out["wrench_B"] - rest, atol=1e-12)


def test_weight_that_is_set_while_running_is_that_of_both_parts(arm):
    scales = dict(sigma_gripper=0.2, sigma_object=0.7, gamma=1.0, force_scale=0.05)
    config = ForceScalingConfig(gripper_phi=GRIPPER)
    same, apart = (
        outputs(config, arm, scales=scales | more)["scaled_wrench_S"]
        for more in ({}, {"sigma_weight": 1.5})
    )
    gripper = weight_wrench(arm, np.array(GRIPPER))
    thing = weight_wrench(arm, arm.phi_load) - gripper
    np.testing.assert_allclose(apart - same, 1.3 * gripper + 0.8 * thing, atol=1e-12)


def test_rendered_wrench_is_the_scaled_reaction(arm):
    out = outputs(ForceScalingConfig(sigma=1.0), arm)
    force_S, force_B = out["scaled_wrench_S"][:3], out["wrench_B"][:3]
    assert np.linalg.norm(force_B) == pytest.approx(np.linalg.norm(force_S) / 17.5)


def test_load_wrench_is_the_output_minus_the_contact(arm):
    contact = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    touched = outputs(ForceScalingConfig(sigma=0.0, gamma=3.0), arm, contact)
    assert not touched["load_wrench_B"].any()
    for sigma in (0.5, 2.0):
        out = outputs(ForceScalingConfig(sigma=sigma, gamma=3.0), arm, contact)
        rest = out["wrench_B"] - touched["wrench_B"]
        np.testing.assert_allclose(out["load_wrench_B"], rest, atol=1e-12)
        length = sigma * np.linalg.norm(out["non_contact_wrench_S"][:3]) / 17.5
        assert np.linalg.norm(rest[:3]) == pytest.approx(length)


@pytest.mark.parametrize(
    "config",
    [
        ForceScalingConfig(sigma=0.5, eta=0.5, gripper_phi=GRIPPER),
        ForceScalingConfig(sigma=0.0, gamma=2.0, eta=0.5, gripper_phi=GRIPPER),
        ForceScalingConfig(sigma=0.0, eta=0.5),
        ForceScalingConfig(sigma=0.0, eta=0.5, gripper_phi=GRIPPER, sigma_weight=0.0),
    ],
)
def test_eta_requires_sigma_0_gamma_1_and_a_gripper(config, arm):
    with pytest.raises(DrakeTeleopError, match=r"force_scaling\.eta"):
        ForceScaling(config, arm, np.eye(3))


@pytest.mark.parametrize(("age", "fault"), [(0.049, 0), (0.051, 1), (-0.049, 0), (-0.051, 1)])
def test_sample_too_old_or_from_the_future_is_a_fault(arm, age, fault):
    block = ForceScaling(ForceScalingConfig(), arm, np.eye(3))
    context = block.CreateDefaultContext()
    context.SetTime(3.0)
    sample = np.concatenate([np.zeros(16), Q, [3.0 - age]])
    block.GetInputPort("sample").FixValue(context, sample)
    block.GetInputPort("load_estimate").FixValue(context, np.zeros(16))
    assert block.GetOutputPort("fault").Eval(context)[0] == fault
    assert np.isnan(block.GetOutputPort("wrench_B").Eval(context)).all() == bool(fault)


@pytest.mark.parametrize("oldest", [0.05, 0.2])
def test_last_sample_of_a_stopped_sensor_becomes_too_old(arm, oldest):
    """The sample does not change, so that only the time does."""
    block = ForceScaling(ForceScalingConfig(), arm, np.eye(3), oldest=oldest)
    context = block.CreateDefaultContext()
    block.GetInputPort("sample").FixValue(context, np.concatenate([np.zeros(16), Q, [3.0]]))
    block.GetInputPort("load_estimate").FixValue(context, np.zeros(16))
    for age in (0.0, 0.9 * oldest, 1.1 * oldest, 10.0, 0.0):
        context.SetTime(3.0 + age)
        fault = age > oldest
        assert block.GetOutputPort("fault").Eval(context)[0] == fault
        assert block.GetOutputPort("scaled_contact_and_fault").Eval(context)[12] == fault
        for name in ("wrench_B", "load_wrench_B"):
            assert np.isnan(block.GetOutputPort(name).Eval(context)).all() == fault


def test_new_change_begins_with_the_present_scales(arm):
    block = ForceScaling(ForceScalingConfig(sigma=0.0, gamma=1.0), arm, np.eye(3))
    context = block.CreateDefaultContext()
    block.GetInputPort("load_estimate").FixValue(context, np.zeros(16))
    scales = dict(sigma_gripper=0.0, sigma_object=0.0, force_scale=1.0)
    found = []
    for time, gamma in ((0.0, 3.0), (0.5, 0.0), (1.0, None), (1.5, None)):
        context.SetTime(time)
        if gamma is not None:
            block.SetScales(context, **scales, gamma=gamma, duration=1.0)
        sample = np.concatenate([[2.0, 0, 0, 0, 0, 0], np.zeros(10), Q, [time]])
        block.GetInputPort("sample").FixValue(context, sample)
        found.append(block.GetOutputPort("scaled_wrench_S").Eval(context)[0])
    np.testing.assert_allclose(found, [2.0, 4.0, 2.0, 0.0], atol=1e-12)


def test_invalid_scales_are_rejected(arm):
    block = ForceScaling(ForceScalingConfig(), arm, np.eye(3))
    context = block.CreateDefaultContext()
    scales = dict(sigma_gripper=0.0, sigma_object=0.0, gamma=1.0, force_scale=np.nan)
    with pytest.raises(DrakeTeleopError, match="SetScales: force_scale: nan is"):
        block.SetScales(context, **scales)
