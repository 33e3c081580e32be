"""Between the levels of a joint whose compliance is known at levels alone."""

from __future__ import annotations

import numpy as np

from elastocal.manipulator.chain import Array


def share_of_levels(angle: Array, levels: Array) -> Array:
    """Shares (n, levels) of each level's compliance at joint values `angle` (n,), sum 1.

    Linear between neighbouring levels, the outermost one's beyond them.  A level stands for a
    gravity compensator's effect, which is a smooth function of the joint (Klimchik et al. 2013,
    section 5), so that neighbours say what lies between them.
    """
    order = np.argsort(levels)
    place = np.interp(angle, levels[order], np.arange(len(levels), dtype=float))
    low = np.minimum(place.astype(int), len(levels) - 1)
    high = np.minimum(low + 1, len(levels) - 1)
    share = np.zeros((len(angle), len(levels)))
    rows = np.arange(len(angle))
    share[rows, order[low]] += 1 - (place - low)
    share[rows, order[high]] += place - low
    return share
