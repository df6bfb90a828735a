"""Random numbers without a generator: a hash of key and counter, so that no state is hidden."""

from __future__ import annotations

import math

import numpy as np

from drake_teleop.common.compiled import njit


@njit(cache=True)
def random_bits(key, counter):
    """53 random bits, as a whole number: splitmix64 (Steele, Lea, Flood 2014) at any place.

    Args:
        key: np.uint64.
        counter: a whole number from 0.
    """
    z = key + np.uint64(counter + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (z ^ (z >> np.uint64(31))) >> np.uint64(11)


@njit(cache=True)
def random_normal(key, counter):
    """A normal number of mean 0 and variance 1 (Box and Muller), see `random_bits`."""
    u = (float(random_bits(key, 2 * counter)) + 1.0) * 2.0**-53
    angle = 2.0 * math.pi * float(random_bits(key, 2 * counter + 1)) * 2.0**-53
    return math.sqrt(-2.0 * math.log(u)) * math.cos(angle)
