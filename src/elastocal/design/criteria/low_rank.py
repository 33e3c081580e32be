"""What one more pose changes, from r × r matrices instead of p × p ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.factor import Factor

# Numbers of a chunk of candidates, small enough for the cache of one core.
CHUNK_NUMBERS = 100_000
# Relative accuracy that an update of Φ must keep; otherwise Φ is formed anew.
ACCURACY = 1e-10
# tr(H⁻¹) of M (see `factorise`) up to which the determinants of an update keep it.
WELL_CONDITIONED = 1e7


def trustworthy(factor: Factor) -> bool:
    """Whether M is regular enough for its inverse to be updated rather than formed anew."""
    return bool((factor.condition < WELL_CONDITIONED).all())


def doubtful(before: Array, after: Array, condition: Array) -> Array:
    """Whether so much of Φ is taken away that the difference has lost its digits.

    `after` = before − removed, where both are known to about ε · `condition` relative to
    `before` (measured: a third of it at most).
    """
    return np.asarray(after * ACCURACY < before * condition * np.finfo(float).eps / 3)


def whitened_rows(factor: Factor, blocks: Array) -> Iterator[tuple[slice, Array, Array]]:
    """W = B L⁻ᵀ (S, n, r, p) for slices of candidates, and I + W Wᵀ (S, n, r, r).

    With M = L Lᵀ: (M + BᵀB)⁻¹ = L⁻ᵀ [I − Wᵀ (I + W Wᵀ)⁻¹ W] L⁻¹ (Woodbury) and
    det(M + BᵀB) = det(M) det(I + W Wᵀ) (matrix determinant lemma).
    """
    scenarios, n, r, p = blocks.shape
    size = max(CHUNK_NUMBERS // (scenarios * r * p), 1)
    upper = factor.inverse.swapaxes(-1, -2)
    for start in range(0, n, size):
        part = slice(start, start + size)
        B = blocks[:, part]
        W = (B.reshape(scenarios, -1, p) @ upper).reshape(B.shape)
        yield part, W, np.eye(r) + W @ W.swapaxes(-1, -2)
