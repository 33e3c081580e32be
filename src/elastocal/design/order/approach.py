"""Approach of a pose from both sides, so that backlash and hysteresis show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError, require

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def approach_signs(q: Array, lower: Array, upper: Array, overshoot: float) -> IntArray:
    """Directions (N, 2, n) of the last motion of each joint: first upwards (+1), then down (−1).

    The arm starts that motion at q − sign · overshoot, for poses `q` (N, n), in rad or m.  A
    joint that would leave its limits [lower, upper] (n,) there comes from its other side both
    times.  Raises InputError where neither side has room.
    """
    require(overshoot > 0, f"the overshoot must be positive; found {overshoot:g}")
    below, above = q - overshoot >= lower, q + overshoot <= upper
    if not (below | above).all():
        i, j = (int(v) for v in np.argwhere(~(below | above))[0])
        raise InputError(
            f"pose {i + 1}: joint {j + 1} has no room on either side of {q[i, j]:.4g} for an "
            f"overshoot of {overshoot:g}; lower overshoot_deg in [design.motion], or widen its "
            "limits"
        )
    return np.stack([np.where(below, 1, -1), np.where(above, -1, 1)], axis=1)


def approach_points(q: Array, signs: IntArray, overshoot: float) -> Array:
    """Joint vectors (N, 2, n) at which the last motions of `approach_signs` start."""
    return np.asarray(q[:, None] - signs * overshoot)
