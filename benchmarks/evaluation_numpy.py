"""B of an arm with geometric errors, written by hand in vectorised numpy: a rival, no part of it.

What an engineer writes who has no generated code: homogeneous transforms of all rows at once by
`matmul`, then every column by the cross product of its axis and the lever arm.  For the effects
base_frame, joint_offset, link_geometry and marker_position of one marker.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.model.manipulator import Model

Array = NDArray[np.float64]
CHUNK = 4096  # rows at a time: the quickest of 1024 to 65 536


def exponential(r: Array) -> tuple[Array, Array]:
    """exp([r]×) and its left Jacobian J, d exp([r]×)·v = [J dr]× exp([r]×) v; both (3, 3)."""
    angle = np.linalg.norm(r)
    K = skew(r)
    if angle < 1e-8:
        return np.eye(3) + K, np.eye(3) + 0.5 * K
    a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
    c = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + a * K + b * K @ K, np.eye(3) + b * K + c * K @ K


def skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class NumpyRegressor:
    """`B(q, x)`: (n, 3, parameters) of the model's marker position, in the model's order."""

    def __init__(self, model: Model) -> None:
        self.chain = model.chain
        self.column = {name: k for k, name in enumerate(model.names)}
        (self.marker,) = model.cell.tool.markers

    def _of(self, x: Array, where: str, keys: tuple[str, ...]) -> tuple[Array, list[int]]:
        columns = [self.column[f"{where}.{key}"] for key in keys]
        return x[columns], columns

    def __call__(self, q: Array, x: Array) -> Array:
        B = np.empty((len(q), 3, len(x)))
        for first in range(0, len(q), CHUNK):
            rows = slice(first, first + CHUNK)
            self._block(q[rows], x, B[rows])
        return B

    def _block(self, q: Array, x: Array, B: Array) -> None:
        chain, n = self.chain, len(q)
        placements = [joint.placement for joint in chain.joints[1:]] + [chain.flange_placement]
        shift, base = self._of(x, "base", ("x", "y", "z"))
        turn, base_turn = self._of(x, "base", ("rx", "ry", "rz"))
        R0, J0 = exponential(turn)
        R = np.broadcast_to(R0 @ chain.joints[0].placement[:3, :3], (n, 3, 3))
        o = np.broadcast_to(R0 @ chain.joints[0].placement[:3, 3] + shift, (n, 3))
        turned = []  # columns, axes (n, 3, k) in the tracker's frame, and a point (n, 3) on them
        for i, joint in enumerate(chain.joints):
            (offset,), column = self._of(x, f"joint{i + 1}", ("offset",))
            axis = joint.axis
            turned.append((column, (R @ axis)[..., None], o))
            K = skew(axis)
            angle = (q[:, i] + offset)[:, None, None]
            R = R @ (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K))
            o = o + R @ placements[i][:3, 3]
            R = R @ placements[i][:3, :3]
            d, columns = self._of(x, f"link{i + 1}", ("dx", "dy", "dz"))
            r, columns_r = self._of(x, f"link{i + 1}", ("rx", "ry", "rz"))
            Rr, Jr = exponential(r)
            B[..., columns] = R
            o = o + R @ d
            turned.append((columns_r, R @ Jr, o))
            R = R @ Rr
        m, columns = self._of(x, f"marker:{self.marker}", ("x", "y", "z"))
        B[..., columns] = R
        p = o + R @ m
        B[..., base] = np.eye(3)
        B[..., base_turn] = np.cross(J0.T, (p - shift)[:, None, :]).transpose(0, 2, 1)
        for columns, axes, centre in turned:
            lever = (p - centre)[..., None]
            B[..., columns] = np.cross(axes, lever, axis=1)
