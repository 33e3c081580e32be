"""Rotation vectors from unit quaternions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation_vector(quaternion: Array) -> Array:
    """Axis times angle in [0, π], (n, 3) rad, of quaternions (n, 4) as w, x, y, z, not zero.

    Scale and sign of a quaternion do not matter.
    """
    # q and -q are the same rotation; w >= 0 is the one of at most half a turn.
    q = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(sine, q[:, 0])
    # angle / sine tends to 2 / w as the angle vanishes.
    small = sine < 1e-150
    factor = np.where(small, 2.0 / np.where(small, q[:, 0], 1.0), 0.0)
    np.divide(angle, sine, out=factor, where=~small)
    return q[:, 1:] * factor[:, None]
