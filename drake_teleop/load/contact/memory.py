"""What a contact detector remembers, in one array.

Samples so far, held |a|^2 and |alpha|^2, flag, samples of quiet; statistics (3); z of the sample
before; mean of r; S; sum of all e; what it was after each of the last WINDOW samples, in a ring.
"""

from __future__ import annotations

WINDOW = 128
"""Longest sum of the likelihood ratio [samples], a power of two."""
LENGTHS = WINDOW.bit_length()
"""How many sums: of 1, 2, 4 ... WINDOW samples."""

COUNT, HELD_A, HELD_ALPHA, FLAG, QUIET_FOR, FIRST_STATISTIC = 0, 1, 2, 3, 4, 5
Z, MEAN, SUM, TOTAL, RING = 8, 14, 20, 26, 32
SIZE = RING + 6 * WINDOW
"""Of the memory of `detection_update`."""
