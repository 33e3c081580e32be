"""Gram matrices of whatever drives an entry of the chain, without forming its columns.

Columns of a driven group are C = E ∘ D: the entry's columns E (N, size, d), the same motion in
all readings of a visit, times the visit's drive D (d, k).  So

    CᵀV⁻¹C = Σ_blocks Σ_{v,w} D_vᵀ (E_vᵀV⁻¹E_w) D_w,
    HᵀC = Σ_v (H_vᵀE_v) D_v,   CᵀPr = Σ_v D_vᵀ E_vᵀu

and a search over thousands of drives costs a few products of matrices, all of them at once.
Where a drive is the same in all visits of a configuration, the sums over visits come first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.blocks import VisitPlaces
from elastocal.diagnosis.evidence import Spectrum, spectrum
from elastocal.diagnosis.projection import Projection

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EntrySums:
    """Of one entry under one noise: `local` (C, v, d, v, d), `H` (p, C, v, d), `b` (C, v, d).

    `flip` (C, v, d) and `h` (F, p) are of residuals that are flipped by `signs` (F, C).
    """

    local: Array
    H: Array
    b: Array
    signs: Array
    flip: Array
    h: Array

    @classmethod
    def of(
        cls, E: Array, places: VisitPlaces, at: Projection, signs: Array | None = None
    ) -> EntrySums:
        """E (C, m, d): the entry's packed columns, zero in rows that do not count."""
        C, m, d = E.shape
        v = places.one_hot.shape[2]
        wide = (places.one_hot[:, :, :, None] * E[:, :, None, :]).reshape(C, m, v * d)
        local = wide.transpose(0, 2, 1) @ (at.inverse @ wide)
        H = at.H.transpose(0, 2, 1) @ wide  # (C, p, v·d)
        b = np.einsum("cmk,cm->ck", wide, at.u)
        signs, u, h = _flipped(at, signs)
        flip = np.einsum("cmk,cm->ck", wide, u)
        return cls(
            local.reshape(C, v, d, v, d), H.transpose(1, 0, 2).reshape(-1, C, v, d),
            b.reshape(C, v, d), signs, flip.reshape(C, v, d), h,
        )  # fmt: skip

    @cached_property
    def _of_configurations(self) -> EntrySums:
        """The same for drives that do not differ within a configuration: v = 1."""
        return replace(
            self, local=self.local.sum(axis=(1, 3), keepdims=True),
            H=self.H.sum(axis=2, keepdims=True), b=self.b.sum(axis=1, keepdims=True),
            flip=self.flip.sum(axis=1, keepdims=True),
        )  # fmt: skip

    def driven(self, D: Array) -> Spectrum:
        """Spectrum of the groups with drives D (C, v, d, V, k), or (C, 1, d, V, k) where all
        visits of a configuration are driven alike."""
        if D.shape[1] < self.b.shape[1]:
            return self._of_configurations.driven(D)
        C, v, d, V, k = D.shape
        n = v * d
        flat = D.reshape(C, n, V * k)
        local = self.local.reshape(C, n, n)
        moved = local * flat if n == 1 else local @ flat
        Z = self.H.reshape(-1, C * n) @ flat.reshape(C * n, V * k)
        A = _each_with_each(flat.reshape(-1, V, k), moved.reshape(-1, V, k))
        A -= _each_with_each(Z.reshape(-1, V, k), Z.reshape(-1, V, k))
        b = self.b.ravel() @ flat.reshape(C * n, V * k)
        flips = np.zeros((len(self.signs), V * k))
        if len(flips):
            own = np.einsum("ci,cig->cg", self.flip.reshape(C, n), flat)
            flips = self.signs @ own - self.h @ Z
        return spectrum(A, b.reshape(V, k), flips.reshape(-1, V, k))


def _each_with_each(a: Array, b: Array) -> Array:
    """Σ_r a_rvk b_rvl (V, K, K) of a and b (R, V, K)."""
    return np.asarray(a.transpose(1, 2, 0) @ b.transpose(1, 0, 2))


def _flipped(at: Projection, signs: Array | None) -> tuple[Array, Array, Array]:
    """The signs (F, C), what they flip in a projected residual, Σ_c signs (Hᵀe)_c (F, p)."""
    if signs is None or not len(signs):
        return np.zeros((0, len(at.u))), np.zeros_like(at.u), np.zeros((0, at.H.shape[2]))
    u, h = at.spread
    return signs, u, signs @ h


def direct(C: Array, at: Projection, signs: Array | None = None) -> Spectrum:
    """Spectrum of one group of packed columns C (blocks, m, k), zero in rows that do not count.

    `signs` (F, blocks) are the flips that it holds.
    """
    k = C.shape[2]
    A = C.reshape(-1, k).T @ (at.inverse @ C).reshape(-1, k)
    Z = at.H.reshape(-1, at.H.shape[2]).T @ C.reshape(-1, k)
    b = np.einsum("cmk,cm->k", C, at.u)
    signs, u, h = _flipped(at, signs)
    flips = np.zeros((0, k))
    if len(signs):
        flips = signs @ np.einsum("cmk,cm->ck", C, u) - h @ Z
    return spectrum((A - Z.T @ Z)[None], b[None], flips[:, None, :])
