"""Joint values as a controller may count them, and which of these fit the nominal arm.

A controller's c become the model's q by signs, offsets, an exchange of columns, and a coupling of
neighbouring joints (Fanuc displays joint 3 against the floor), as `[joints]` of a mapping has it:

    q = (1 + κ E_{j,j±1}) (D P c + o),  D a matrix of signs, P an exchange of two columns.

All these q are tried at once.  With G_i m + t_i the nominal place of a marker m, the readings p_i
fit where A p_i + s = G_i m + t_i has a solution: linear in A (3, 3), s and m.  Of such an A, det
says whether the frame of the readings is mirrored and by what scale they are too short.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from elastocal.model.chain import Chain
from elastocal.text import listed
from elastocal.units import Array, IntArray

MOST_SIGNS = 7  # joints of which every choice of signs is tried; of more, up to two
TURNS = (90, -90, 180)
UNSKEWED = 1.25  # largest over smallest singular value of an A that may be a rotation and a scale
TOGETHER = 2**18  # rows at a time
RCOND = 1e-12


@dataclass(frozen=True)
class JointMap:
    """q = c · matrixᵀ + offset (joints,), of so many `mistakes` in `words`; of two that do the same
    (half a turn of joint 4 and a sign of joint 5) an offset counts a little more."""

    matrix: Array
    offset: Array
    words: tuple[str, ...]
    mistakes: float

    def of(self, c: Array) -> Array:
        return c @ self.matrix.T + self.offset

    def after(self, first: JointMap) -> JointMap:
        """This map of what `first` gives."""
        return JointMap(
            self.matrix @ first.matrix, self.matrix @ first.offset + self.offset,
            first.words + self.words, first.mistakes + self.mistakes,
        )  # fmt: skip


def joint_maps(chain: Chain) -> list[JointMap]:
    """Single mistakes, all signs with each coupling, and pairs of the others."""
    n = chain.n_joints
    none = JointMap(np.eye(n), np.zeros(n), (), 0)
    signs, couplings, others = list(_signs(n)), list(_couplings(chain)), list(_others(chain))
    found = [none, *signs, *couplings, *others]
    found += [coupling.after(sign) for sign in signs for coupling in couplings]
    found += [b.after(a) for a, b in combinations(couplings, 2)]
    found += [b.after(a) for a, b in combinations(others, 2)]
    single = [sign for sign in signs if sign.mistakes == 1]
    found += [b.after(a) for a in others for b in (*single, *couplings)]
    return found


def _signs(n: int) -> Iterator[JointMap]:
    for k in range(1, (n if n <= MOST_SIGNS else 2) + 1):
        for turned in combinations(range(n), k):
            D = np.eye(n)
            D[turned, turned] = -1.0
            names = listed([str(j + 1) for j in turned])
            joints = "joint" if k == 1 else "joints"
            words = f"with the sign of {joints} {names} turned round"
            yield JointMap(D, np.zeros(n), (words,), k)


def _couplings(chain: Chain) -> Iterator[JointMap]:
    n = chain.n_joints
    for j in range(1, n):
        for factor in (1.0, -1.0) if chain.kinds[j] == chain.kinds[j - 1] else ():
            C = np.eye(n)
            C[j, j - 1] = factor
            words = f"with coupling {{ joint = {j + 1}, of = {j}, factor = {factor:g} }}"
            yield JointMap(C, np.zeros(n), (words,), 1)


def _others(chain: Chain) -> Iterator[JointMap]:
    n = chain.n_joints
    turning = np.array([kind == "revolute" for kind in chain.kinds])
    for factor, words in ((np.pi / 180, "degrees read as radians"),
                          (180 / np.pi, "radians read as degrees")):  # fmt: skip
        unit = np.diag(np.where(turning, factor, 1.0))
        yield JointMap(unit, np.zeros(n), (f"if joints were {words}",), 1)
    for j in np.flatnonzero(turning):
        for degrees in TURNS:
            offset = np.radians(degrees) * (np.arange(n) == j)
            yield JointMap(np.eye(n), offset, (f"with offset_deg {degrees} at joint {j + 1}",), 1.1)
    for first, second in combinations(range(n), 2):
        order = np.arange(n)
        order[[first, second]] = second, first
        words = f"with the columns of joints {first + 1} and {second + 1} exchanged"
        yield JointMap(np.eye(n)[order], np.zeros(n), (words,), 1)


@dataclass(frozen=True)
class LinearFits:
    """Of K joint tables: A (K, 3, 3), and the rms (K,) in m that is left in each component,
    infinite where A is no rotation with a scale."""

    matrix: Array
    left: Array

    @property
    def determinant(self) -> Array:
        return np.linalg.det(self.matrix)

    @property
    def scale(self) -> Array:
        """By what the readings (K,) are to be multiplied."""
        return np.cbrt(np.abs(self.determinant))


def linear_fits(flange: Array, points: Array, marker: IntArray) -> LinearFits:
    """Fits of readings `points` (n, 3) of `marker` (n,) or (K, n) to flanges (K, n, 4, 4)."""
    marker = np.broadcast_to(marker, flange.shape[:2])
    markers = int(marker.max()) + 1
    step = max(TOGETHER // max(flange.shape[1], 1), 1)
    # Rows are components of a reading, one after the other; A and s are the same for all tables
    # and are fitted along by an orthonormal basis.
    Q, R = np.linalg.qr(np.hstack([points - points.mean(axis=0), np.ones((len(points), 1))]))
    back = np.linalg.pinv(R)[:3]
    parts = []
    for k in range(0, len(flange), step):
        T, own = flange[k : k + step], marker[k : k + step, :, None] == np.arange(markers)
        G = (T[..., :3, None, :3] * own[:, :, None, :, None]).reshape(*T.shape[:2], 3, -1)
        parts.append(_linear_fits(np.concatenate([G, T[..., :3, 3:]], axis=3), Q, back))
    return LinearFits(*(np.concatenate(some) for some in zip(*parts, strict=True)))


def _linear_fits(G: Array, Q: Array, back: Array) -> tuple[Array, Array]:
    along = np.einsum("na,knrm->karm", Q, G)
    off = (G - np.einsum("na,karm->knrm", Q, along)).reshape(len(G), -1, G.shape[3])
    X, y = off[..., :-1], off[..., -1:]
    Xt = X.transpose(0, 2, 1)
    m = -np.linalg.pinv(Xt @ X, rcond=RCOND, hermitian=True) @ (Xt @ y)
    left = np.sqrt(((X @ m + y) ** 2).mean(axis=(1, 2)))
    A = back @ (along[..., -1] + np.einsum("karm,km->kar", along[..., :-1], m[..., 0]))
    size = np.linalg.svd(A, compute_uv=False)
    left[~(size[:, 0] <= UNSKEWED * size[:, -1])] = np.inf
    return A, left
