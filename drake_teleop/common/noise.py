"""Random numbers without hidden state: hashes of a key and a counter."""

from __future__ import annotations

import math

import numpy as np

from drake_teleop.common.compiled import njit


@njit(cache=True)
def random_bits(key, counter):
    """Return 53 random bits (np.uint64) of a key (np.uint64) and counter (splitmix64, 2014)."""
    z = key + np.uint64(counter + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (z ^ (z >> np.uint64(31))) >> np.uint64(11)


@njit(cache=True)
def random_normal(key, counter):
    """Return a standard normal number (Box and Muller); arguments as for `random_bits`."""
    u = (float(random_bits(key, 2 * counter)) + 1.0) * 2.0**-53
    angle = 2.0 * math.pi * float(random_bits(key, 2 * counter + 1)) * 2.0**-53
    return math.sqrt(-2.0 * math.log(u)) * math.cos(angle)
