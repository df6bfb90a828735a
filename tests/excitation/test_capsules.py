"""Tight bounding capsules of shapes."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Box, Cylinder, GeometryId
from pydrake.geometry import Capsule as CapsuleShape

from drake_teleop.lab.excitation.collision import (
    MIN_CLEARANCE_M,
    Capsule,
    _exclude_coaxial_pairs,
    _min_capsule_pair_distance,
    bounding_capsule,
)


@pytest.mark.parametrize("long", [0, 1, 2])
def test_capsule_of_a_beam_is_parallel_to_it(long):
    size = np.full(3, 0.1)
    size[long] = 1.0
    capsule = bounding_capsule(Box(size))
    for corner in product(*[(-s / 2, s / 2) for s in size]):
        assert capsule.contains(Capsule(np.array([corner, corner]), 0.0))
    # The beam's edges are 0.071 m from its axis; a ball would need 0.505 m.
    assert 0.0707 <= capsule.radius < 0.15
    ends = np.delete(capsule.ends, long, axis=1)
    np.testing.assert_array_equal(ends, 0.0)
    assert np.abs(capsule.ends[:, long]).max() <= 0.5


def test_capsule_of_a_short_beam_has_minimum_volume():
    """Ends at 0.9 of the half length: 3 % less volume than at 1.0, 6 % less than at 0.8."""
    capsule = bounding_capsule(Box(0.1, 0.1, 0.3))
    np.testing.assert_allclose(np.abs(capsule.ends[:, 2]), 0.9 * 0.15)
    assert capsule.radius == pytest.approx(np.linalg.norm([0.05, 0.05, 0.015]))


def test_capsule_of_a_cylinder_is_tight():
    capsule = bounding_capsule(Cylinder(0.05, 0.8))
    assert 0.05 <= capsule.radius < 0.07
    assert np.ptp(capsule.ends[:, 2]) <= 0.8


def test_capsule_of_a_capsule_is_itself():
    capsule = bounding_capsule(CapsuleShape(0.05, 0.8))
    np.testing.assert_array_equal(capsule.ends, [[0.0, 0.0, -0.4], [0.0, 0.0, 0.4]])
    assert capsule.radius == 0.05


@pytest.mark.parametrize(("aside", "radius", "held"), [(0, 0.09, True), (0, 0.11, False),
                         (0.05, 0.04, True), (0.05, 0.06, False), (0.15, 0.0, False)])  # fmt: skip
def test_containment_of_capsules_includes_their_radius(aside, radius, held):
    ends = np.array([[0.0, 0.0, -0.2], [0.0, 0.0, 0.2]])
    assert Capsule(ends, 0.1).contains(Capsule(0.5 * ends + [0.0, aside, 0.0], radius)) is held


def test_minimum_distance_subtracts_the_quartile_of_the_excess():
    """Shapes near contact, capsules 0 to 100 mm nearer: the correction is 25 mm."""
    touching, far = np.linspace(-0.01, 0.004, 101), np.full(101, 0.2)
    nearer = touching - np.linspace(0.0, 0.1, 101)
    kept = _min_capsule_pair_distance(
        np.concatenate([touching, far]), np.concatenate([nearer, far])
    )
    assert kept == pytest.approx(MIN_CLEARANCE_M - 0.025)
    # Capsules remain free in 90 % of the free postures.
    free = np.linspace(0.06, 0.16, 101)
    assert _min_capsule_pair_distance(free, free - 0.07) == pytest.approx(0.0, abs=1e-12)


def test_only_near_shapes_at_a_constant_distance_are_measured_in_the_first_postures():
    shapes = [GeometryId.get_new_id() for _ in range(6)]
    steps = np.linspace(0.0, 0.01, 40)
    distances = {
        (shapes[0], shapes[1]): np.full(40, -0.02) + 0.05 * steps,  # coaxial, within 1 mm
        (shapes[2], shapes[3]): np.full(40, -0.02) + steps,  # overlaps, but moves
        (shapes[4], shapes[5]): np.full(40, 0.02),  # apart
    }
    before = {pair: of_pair.copy() for pair, of_pair in distances.items()}
    excluded = []
    _exclude_coaxial_pairs(SimpleNamespace(Apply=excluded.append), distances)
    coaxial, *others = distances
    assert len(excluded) == 1 and (distances[coaxial] == -0.02).all()
    for pair in others:
        np.testing.assert_array_equal(distances[pair], before[pair])
