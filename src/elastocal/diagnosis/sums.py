"""Gram matrices of whatever drives an entry of the chain, without forming its columns.

Columns of a driven group are C = E ∘ D: the entry's columns E (N, size, d), the same motion in
all readings of a visit, times the visit's drive D (d, k).  So

    CᵀV⁻¹C = Σ_blocks Σ_{v,w} D_vᵀ (E_vᵀV⁻¹E_w) D_w,
    HᵀC = Σ_v (H_vᵀE_v) D_v,   CᵀPr = Σ_v D_vᵀ E_vᵀu

and a search over thousands of drives costs a few small products each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.blocks import Blocks
from elastocal.diagnosis.evidence import Spectrum, spectrum
from elastocal.diagnosis.noise import Projection

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

PIECE = 4_000_000  # numbers held at a time
FEW = 4


@dataclass(frozen=True)
class VisitPlaces:
    """Where visits stand in the blocks: `one_hot` (C, m, v), and an observation of each visit,
    `example` (C, v), −1 where a block has fewer visits."""

    one_hot: Array
    example: Labels

    @classmethod
    def of(cls, blocks: Blocks) -> VisitPlaces:
        member = blocks.member
        visit = np.concatenate([blocks.visit, [-1]])[member]
        local = np.full(visit.shape, -1)
        most = 1
        for c, row in enumerate(visit):
            known, first, inverse = np.unique(row, return_index=True, return_inverse=True)
            order = np.argsort(np.argsort(np.where(known < 0, len(row), first)))
            local[c] = np.where(row < 0, -1, order[inverse])
            most = max(most, int(local[c].max()) + 1)
        one_hot = (local[:, :, None] == np.arange(most)).astype(float)
        example = np.full((len(member), most), -1, dtype=np.int64)
        for v in range(most):
            there = one_hot[:, :, v].any(axis=1)
            example[there, v] = member[there, one_hot[there, :, v].argmax(axis=1)]
        return cls(np.repeat(one_hot, blocks.size, axis=1), example)

    def gather(self, values: Array) -> Array:
        """Per observation (N, …) → per visit (C, v, …), zero where there is none."""
        out = values[np.maximum(self.example, 0)]
        out[self.example < 0] = 0.0
        return out


@dataclass(frozen=True)
class EntrySums:
    """Of one entry under one noise: `local` (C, v, d, v, d), `H` (p, C, v, d), `b` (C, v, d).

    `flip` (C, v, d) and `h` (C, p) are of residuals whose signs may be flipped.
    """

    local: Array
    H: Array
    b: Array
    flip: Array
    h: Array

    @classmethod
    def of(cls, E: Array, places: VisitPlaces, at: Projection) -> EntrySums:
        """E (C, m, d): the entry's packed columns, zero in rows that do not count."""
        C, m, d = E.shape
        v = places.one_hot.shape[2]
        wide = (places.one_hot[:, :, :, None] * E[:, :, None, :]).reshape(C, m, v * d)
        local = wide.transpose(0, 2, 1) @ (at.inverse @ wide)
        H = at.H.transpose(0, 2, 1) @ wide  # (C, p, v·d)
        b = np.einsum("cmk,cm->ck", wide, at.u)
        flip = np.einsum("cmk,cm->ck", wide, at.spread[0])
        return cls(
            local.reshape(C, v, d, v, d), H.transpose(1, 0, 2).reshape(-1, C, v, d),
            b.reshape(C, v, d), flip.reshape(C, v, d), at.spread[1],
        )  # fmt: skip

    def driven(self, D: Array) -> Spectrum:
        """Spectrum of the groups with drives D (V, C, v, d, k)."""
        V, C, v, d, k = D.shape
        each = max(1, PIECE // (C * v * d * k * max(k, v * d)))
        return Spectrum.joined([self._driven(D[i : i + each]) for i in range(0, V, each)])

    def _driven(self, D: Array) -> Spectrum:
        V, C, v, d, k = D.shape
        flat = D.reshape(V, C, v * d, k)
        local = self.local.reshape(C, v * d, v * d)
        moved = _times(local, flat)
        A = flat.reshape(V, -1, k).transpose(0, 2, 1) @ moved.reshape(V, -1, k)
        Z = self.H.reshape(len(self.H), -1) @ flat.reshape(V, -1, k)
        A = A - Z.transpose(0, 2, 1) @ Z
        b = np.einsum("gcik,ci->gk", flat, self.b.reshape(C, -1))
        parts = np.einsum("gcik,ci->cgk", flat, self.flip.reshape(C, -1))
        return spectrum(A, b, parts - np.tensordot(self.h, Z, (1, 1)))


def _times(local: Array, flat: Array) -> Array:
    """local (C, n, n) times flat (V, C, n, k), matrix by matrix."""
    n = local.shape[1]
    if n > FEW:
        return np.asarray(local[None] @ flat)
    # Millions of tiny products: sums over their few entries are faster than calls for each.
    moved = np.empty_like(flat)
    for i in range(n):
        moved[:, :, i] = sum(local[:, i, j, None] * flat[:, :, j] for j in range(n))
    return moved


def direct(C: Array, at: Projection) -> Spectrum:
    """Spectrum of one group of packed columns C (blocks, m, k), zero in rows that do not count."""
    k = C.shape[2]
    A = C.reshape(-1, k).T @ (at.inverse @ C).reshape(-1, k)
    Z = at.H.reshape(-1, at.H.shape[2]).T @ C.reshape(-1, k)
    u, h = at.spread
    b = np.einsum("cmk,cm->k", C, at.u)
    parts = np.einsum("cmk,cm->ck", C, u) - h @ Z
    return spectrum((A - Z.T @ Z)[None], b[None], parts[:, None, :])
