"""Memory layout of a contact detector.

Sample count, held |a|^2 and |alpha|^2, flag, samples below `leave`, statistics (3), previous z (6),
mean of F_c (6), cumulative sum S (6), sum of all e (6), ring of the last WINDOW sums.
"""

from __future__ import annotations

WINDOW = 128
"""Longest sum of the likelihood ratio [samples], a power of two."""
LENGTHS = WINDOW.bit_length()
"""Number of sums: over 1, 2, 4 ... WINDOW samples."""

COUNT, HELD_A, HELD_ALPHA, FLAG, QUIET_FOR, FIRST_STATISTIC = 0, 1, 2, 3, 4, 5
Z, MEAN, SUM, TOTAL, RING = 8, 14, 20, 26, 32
SIZE = RING + 6 * WINDOW
"""Length of the memory of `detection_update`."""
