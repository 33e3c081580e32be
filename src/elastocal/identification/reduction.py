"""Which parameters the data determine: a minimal complete set, and what the rest combine with."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.manipulator.effects import effect_of
from elastocal.manipulator.parameter import Parameter

Array = NDArray[np.float64]

# Below this share of its own length a column lies in the span of the kept ones: B is exact
# to 1e-15, so this is a structural dependence and not rounding.
STRUCTURAL = 1e-7


@dataclass(frozen=True)
class Reduction:
    """`kept` and `dropped` parameter indices; `mixing` (kept, dropped) with B_D ≈ B_K · mixing.

    The data determine β_k = X_k + Σ_d mixing[k, d] X_d, the kept parameter with what it stands
    for.  `invisible` are dropped parameters that move no reading at all,
    `at_bound` those that a bounded fit holds at their bound.
    """

    kept: NDArray[np.int64]
    dropped: NDArray[np.int64]
    mixing: Array
    invisible: NDArray[np.int64]
    at_bound: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def terms(self, k: int, sizes: Array, std: float) -> dict[int, float]:
        """Parameters combined with kept parameter number k, and their factors.

        A dropped parameter counts where its typical deviation would shift the estimate by more
        than a tenth of its standard deviation `std`: less would not show in the interval.
        """
        row = self.mixing[k]
        return {
            int(d): float(row[j])
            for j, d in enumerate(self.dropped)
            if abs(row[j]) * sizes[d] > 0.1 * std
        }


def reduce(
    B: Array, sizes: Array, parameters: tuple[Parameter, ...], sigma: float, threshold: float
) -> Reduction:
    """Choose a minimal complete set of columns of the whitened B (rows, parameters), or of its R.

    Columns are scaled by typical size and by the noise `sigma` of a whitened row, so that the
    length of a column off the span of the kept ones counts how many standard deviations a
    typical deviation moves the data: a parameter below `threshold` is not worth a column (at 1
    the variance it would add equals the squared bias it would remove).  Pivoted QR in the order
    of the effects' ranks; `threshold` 0 keeps everything that is structurally independent.
    """
    # The triangular factor has the same geometry as B at any number of rows.
    R = linalg.qr(B * sizes, mode="r")[0][: B.shape[1]] / sigma
    length = np.linalg.norm(R, axis=0)
    visible = length > max(threshold, STRUCTURAL * length.max(initial=0.0), 1e-300)
    basis = np.zeros((len(R), 0))
    kept: list[int] = []
    for group in _groups(parameters):
        candidates = [c for c in group if visible[c]]
        if not candidates:
            continue
        off = R[:, candidates] - basis @ (basis.T @ R[:, candidates])
        off -= basis @ (basis.T @ off)  # twice is enough (Parlett)
        _, T, order = linalg.qr(off, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(T))
        for k, d in enumerate(diagonal):
            c = candidates[order[k]]
            if d > max(threshold, STRUCTURAL * length[c]):
                kept.append(c)
        chosen = R[:, kept]
        basis = linalg.qr(chosen, mode="economic")[0] if kept else basis
    kept.sort()
    dropped = [c for c in range(R.shape[1]) if c not in set(kept)]
    scaled = linalg.lstsq(R[:, kept], R[:, dropped])[0] if kept and dropped else None
    mixing = np.zeros((len(kept), len(dropped)))
    if scaled is not None:
        mixing = scaled * sizes[kept][:, None] / sizes[dropped][None, :]
    unseen = np.array([d for d in dropped if not visible[d]], dtype=np.int64)
    return Reduction(np.array(kept, dtype=np.int64), np.array(dropped, dtype=np.int64),
                     mixing, unseen)  # fmt: skip


def _groups(parameters: tuple[Parameter, ...]) -> list[list[int]]:
    """Indices of the parameters by rank: first what a user asks for by name; link geometry takes
    the rest."""
    ranks = [effect_of(p.effect).rank for p in parameters]
    return [[i for i, own in enumerate(ranks) if own == rank] for rank in sorted(set(ranks))]
