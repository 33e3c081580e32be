"""Clusters of correlated sets of repeats, stacked by size, and what a likelihood takes from them.

Linear algebra runs on whole stacks; clusters whose covariances are equal enter by their moments.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from elastocal.identification.linear_solver import least_norm
from elastocal.identification.noise_structure import SharedEffect, Structure
from elastocal.identification.weighted_problem import WhitenedBlocks
from elastocal.units import Array, IntArray

MOST_NUMBERS = 4_000_000  # in a temporary array of a stack


@dataclass(frozen=True)
class Moments:
    """Σ_g b_gi b_gjᵀ (n, n, p + 1, p + 1) of clusters with one V, b_gi row i of [B e − B x0] (p,).

    All that a restricted likelihood takes from clusters whose covariances are equal, however many
    they are; about x0, their least squares, nothing cancels.
    """

    x0: Array
    pairs: Array

    @classmethod
    def of(cls, B: Array, e: Array) -> Moments:
        n, p = B.shape[1:]
        flat = B.reshape(-1, p)
        x0 = least_norm(flat.T @ flat, flat.T @ e.ravel())
        rows = np.concatenate([B, (e - B @ x0)[:, :, None]], axis=2).transpose(1, 0, 2)
        pairs = np.empty((n, n, p + 1, p + 1))
        for i, first in enumerate(rows):
            for j, second in enumerate(rows[: i + 1]):
                pairs[i, j] = first.T @ second
                pairs[j, i] = pairs[i, j].T
        return cls(x0, pairs)

    def whitened(self, root: Array) -> Moments:
        """Those of the rows R⁻¹b; `root` is R⁻¹ (n, n)."""
        half = np.tensordot(root, self.pairs, 1)
        return replace(self, pairs=np.tensordot(root, half, (1, 1)).swapaxes(0, 1))

    def of_residual(self, x: Array) -> tuple[Array, Array]:
        """Σ_g b_gi z_gj (n, n, p) and Σ_g z_gi z_gj (n, n), z = e − Bx."""
        y = np.append(self.x0 - x, 1.0)
        with_rows = self.pairs @ y
        return with_rows[:, :, :-1], with_rows @ y


@dataclass(frozen=True)
class Stack:
    """G clusters of n rows each: B (G, n, p), e (G, n) and V = Σ_l θ[index[g, l]] part[g, l].

    `index` (G, L) into the K variances, `part` (G, L, n, n); unused places of a cluster hold
    index 0 and a zero part.
    """

    sets: IntArray  # (G, sets per cluster)
    B: Array
    e: Array
    index: IntArray
    part: Array
    K: int
    moments: Moments | None = None  # where all clusters have one V and these are fewer numbers

    @cached_property
    def uniform(self) -> bool:
        """Whether all clusters have the same variances at the same places."""
        return bool((self.index == self.index[0]).all())

    @cached_property
    def pairs(self) -> IntArray:
        """Place (G·L·L,) of each pair of a cluster's variances in a flat (K, K) matrix."""
        return (self.index[:, :, None] * self.K + self.index[:, None, :]).ravel()

    @cached_property
    def gather(self) -> sparse.csr_array:
        """(K, G·L): sums per variance what is given per cluster and place."""
        flat = self.index.ravel()
        ones = np.ones(len(flat))
        return sparse.csr_array((ones, (flat, np.arange(len(flat)))), shape=(self.K, len(flat)))

    def under(self, theta: Array) -> Whitened:
        """Whitened by V at θ (K,).  Raises LinAlgError where that is not positive definite."""
        return (Whitened if self.moments is None else WhitenedAlike)(self, theta)


def stacks(structure: Structure, shared: tuple[SharedEffect, ...]) -> list[Stack]:
    """The clusters of a structure: a configuration where effects are shared, else a set."""
    sets = structure.sets
    label = sets.configuration if shared or structure.faster else np.arange(len(sets))
    _, cluster, count = np.unique(label, return_inverse=True, return_counts=True)
    order = np.argsort(cluster, kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    found = []
    size, p = sets.e.shape[1], sets.B.shape[2]
    for m in np.unique(count):
        groups = np.flatnonzero(count == m)
        more = len(shared) + len(structure.faster)
        n, parts = int(m) * size, structure.index.shape[1] * int(m) + more
        step = max(1, MOST_NUMBERS // (parts * n * (n + p) + parts * p * p))
        for first in range(0, len(groups), step):
            members = order[starts[groups[first : first + step], None] + np.arange(m)]
            found += _by_pattern(_stack(structure, shared, members))
    return found


def _by_pattern(stack: Stack) -> list[Stack]:
    """The clusters of equal V together, with their moments, where those are few numbers; else the
    stack as it is."""
    G, n, p = stack.B.shape
    own = np.concatenate([stack.index, stack.part.reshape(G, -1)], axis=1)
    most = G // (n * (p + 1))
    if not most:
        return [stack]
    mixed = own @ np.sqrt(np.arange(1.0, own.shape[1] + 1))  # equal rows have equal sums
    if len(np.unique(np.round(mixed / np.abs(mixed).max(), 12))) > most:
        return [stack]
    _, pattern = np.unique(own, axis=0, return_inverse=True)
    if pattern.max() >= most:
        return [stack]
    found = []
    for code in range(int(pattern.max()) + 1):
        mine = pattern.ravel() == code
        B, e = stack.B[mine], stack.e[mine]
        found.append(
            replace(stack, sets=stack.sets[mine], B=B, e=e, index=stack.index[mine],
                    part=stack.part[mine], moments=Moments.of(B, e))
        )  # fmt: skip
    return found


def _stack(structure: Structure, shared: tuple[SharedEffect, ...], members: IntArray) -> Stack:
    sets = structure.sets
    G, m = members.shape
    size, p = sets.e.shape[1], sets.B.shape[2]
    index, part = _own(structure, members)
    n_own = len(structure.names)
    # What is left of a course has its variances, which are the last of the structure's.
    first = n_own - len(structure.faster)
    for k, effect in enumerate((*structure.faster, *shared), first):
        block = effect.product(members, effect, members)
        part = np.concatenate([part, block.reshape(G, 1, m * size, m * size)], axis=1)
        index = np.concatenate([index, np.full((G, 1), k)], axis=1)
    B = sets.B[members].reshape(G, m * size, p)
    e = sets.e[members].reshape(G, m * size)
    return Stack(members, B, e, index, part, n_own + len(shared))


def _own(structure: Structure, members: IntArray) -> tuple[IntArray, Array]:
    """Own variances of each cluster, each once: index (G, L) and part (G, L, n, n)."""
    G, m = members.shape
    size = structure.sets.e.shape[1]
    index = structure.index[members].reshape(G, -1)  # (G, m * L)
    if (index.reshape(G, m, -1) == index.reshape(G, m, -1)[:, :1]).all():
        place = np.tile(np.arange(index.shape[1] // m), m)[None].repeat(G, axis=0)
        distinct = index[:, : index.shape[1] // m]
    else:
        distinct, place = _distinct(index)
    L = distinct.shape[1]
    blocks = structure.mean_matrix[members]  # (G, m, L0, size, size)
    part = np.zeros((G, L, m, size, m, size))
    place = place.reshape(G, m, -1)
    g = np.arange(G)
    for k in range(m):
        for j in range(place.shape[2]):
            part[g, place[:, k, j], k, :, k, :] += blocks[:, k, j]
    return distinct, part.reshape(G, L, m * size, m * size)


def _distinct(index: IntArray) -> tuple[IntArray, IntArray]:
    """Different entries of each row (G, L), padded with 0, and where each entry stands in it."""
    rows = [np.unique(row, return_inverse=True) for row in index]
    L = max(len(values) for values, _ in rows)
    distinct = np.array([np.pad(values, (0, L - len(values))) for values, _ in rows])
    return distinct, np.array([place.ravel() for _, place in rows])


# A stack under a covariance.


@dataclass(frozen=True)
class ClusterSums:
    """Sums over clusters: BᵀV⁻¹V_kV⁻¹B (K, p, p), BᵀV⁻¹V_kV⁻¹z (K, p), zᵀV⁻¹V_kV⁻¹z (K,),
    tr V⁻¹V_k (K,), |A_k|² (K,), tr A_kA_l less twice that of its share in B (K, K), and
    zᵀV⁻¹V_kV⁻¹V_lV⁻¹z (K, K).
    """

    C: Array
    D: Array
    squares: Array
    trace: Array
    known: Array
    twice_expected: Array
    product: Array

    @classmethod
    def of(cls, whitened: list[Whitened], x: Array, Phi: Array) -> ClusterSums:
        """Over all stacks, at the estimate x (p,) with BᵀV⁻¹B = Φ⁻¹."""
        found = [w.sums(x, Phi) for w in whitened]
        return cls(*(np.sum([getattr(one, f.name) for one in found], axis=0) for f in fields(cls)))


def _added(index: IntArray, values: Array, n: int) -> Array:
    """Sums (n,) of the `values` that have each index."""
    return np.asarray(np.bincount(index, values.ravel(), n), dtype=np.float64)


class Whitened:
    """A stack under V = R Rᵀ: R⁻¹ (G, n, n), A_l = R⁻¹ V_l R⁻ᵀ (G, L, n, n), R⁻¹B, R⁻¹e, log|V|."""

    def __init__(self, stack: Stack, theta: Array) -> None:
        G, L, n, _ = stack.part.shape
        self.stack = stack
        V = (theta[stack.index][:, None] @ stack.part.reshape(G, L, -1)).reshape(G, n, n)
        self._blocks = WhitenedBlocks.of(V, stack.B, stack.e)
        self.log_det = self._blocks.log_det

    @cached_property
    def inverse(self) -> Array:
        return self._blocks.root

    @cached_property
    def B(self) -> Array:
        return self._blocks.B

    @cached_property
    def e(self) -> Array:
        return self._blocks.e

    @cached_property
    def A(self) -> Array:
        back = self.inverse.transpose(0, 2, 1)
        return np.asarray(self.inverse[:, None] @ self.stack.part @ back[:, None])

    def normal(self) -> tuple[Array, Array, float]:
        """BᵀV⁻¹B (p, p), BᵀV⁻¹e (p,) and eᵀV⁻¹e."""
        B, e = self.B.reshape(-1, self.B.shape[2]), self.e.ravel()
        return B.T @ B, B.T @ e, float(e @ e)

    def sums(self, x: Array, Phi: Array) -> ClusterSums:
        """What the score and the information of θ take from these clusters, z = e − Bx."""
        w, K, p = self, self.stack.K, len(x)
        G, L = w.stack.index.shape
        flat = w.stack.index.ravel()
        half = linalg.cholesky(Phi, lower=True)
        z = w.e - w.B @ x
        AB = w.A @ w.B[:, None]  # (G, L, n, p)
        Az = (w.A @ z[:, None, :, None])[..., 0]  # (G, L, n)
        C = np.zeros((K, p * p))
        if w.stack.uniform:
            whole = AB.transpose(1, 0, 2, 3).reshape(L, -1, p)
            np.add.at(C, flat[:L], (w.B.reshape(-1, p).T @ whole).reshape(L, -1))
        else:
            C += w.stack.gather @ (w.B.transpose(0, 2, 1)[:, None] @ AB).reshape(G * L, -1)
        squares = (Az @ z[:, :, None])[..., 0]
        trace, product = np.trace(w.A, axis1=2, axis2=3), Az @ Az.transpose(0, 2, 1)
        Bh, whole = w.B @ half, w.A.reshape(G, L, -1)
        AH = w.A @ (Bh @ Bh.transpose(0, 2, 1))[:, None]  # tr ΦBᵀA_kA_lB = tr A_kA_lH
        left = (w.A - 2 * AH).transpose(0, 1, 3, 2).reshape(G, L, -1)
        local = whole @ left.transpose(0, 2, 1)
        singly = [_added(flat, one, K) for one in (squares, trace, (whole**2).sum(axis=2))]
        both = [_added(w.stack.pairs, one, K * K).reshape(K, K) for one in (local, product)]
        D = w.stack.gather @ (Az @ w.B).reshape(-1, p)
        return ClusterSums(C.reshape(K, p, p), D, *singly, *both)

    def between(self, W: Array) -> Array:
        """Σ_kl W_kl BᵀV⁻¹V_kV⁻¹V_lV⁻¹B (p, p)."""
        index = self.stack.index
        AB = self.A @ self.B[:, None]  # (G, L, n, p)
        weight = W[index[:, :, None], index[:, None, :]]
        mixed = (weight @ AB.reshape(*index.shape, -1)).reshape(AB.shape)
        return np.tensordot(AB, mixed, ((0, 1, 2), (0, 1, 2)))


class WhitenedAlike(Whitened):
    """The same of clusters that have one V and their moments: R⁻¹ and A of one of them serve all.

    With M_ij the whitened moments, Σ_g B_gᵀ Q B_g = Σ_ij Q_ij M_ij.
    """

    def __init__(self, stack: Stack, theta: Array) -> None:
        assert stack.moments is not None
        n = stack.part.shape[2]
        self.stack = stack
        none = np.zeros((1, n, 0)), np.zeros((1, n))
        V = np.tensordot(theta[stack.index[0]], stack.part[0], 1)[None]
        self.root, _, _, log_det = WhitenedBlocks.of(V, *none)
        self.log_det = len(stack.index) * log_det
        self.moments = stack.moments.whitened(self.root[0])

    @cached_property
    def one(self) -> Array:
        """A_l (L, n, n) of each cluster."""
        return np.asarray(self.root[0] @ self.stack.part[0] @ self.root[0].T)

    @cached_property
    def inverse(self) -> Array:
        return np.broadcast_to(self.root, (len(self.stack.B), *self.root.shape[1:]))

    @cached_property
    def A(self) -> Array:
        return np.broadcast_to(self.one, (len(self.stack.B), *self.one.shape))

    @cached_property
    def B(self) -> Array:
        return np.asarray(self.root @ self.stack.B)

    @cached_property
    def e(self) -> Array:
        return np.asarray((self.root @ self.stack.e[..., None])[..., 0])

    def normal(self) -> tuple[Array, Array, float]:
        both = np.einsum("iipq->pq", self.moments.pairs)
        N, right, x0 = both[:-1, :-1], both[:-1, -1], self.moments.x0
        full = right + N @ x0
        return N, full, float(both[-1, -1] + x0 @ (right + full))

    def sums(self, x: Array, Phi: Array) -> ClusterSums:
        K, p, G = self.stack.K, len(x), len(self.stack.index)
        index, A = self.stack.index[0], self.one
        twice = A[:, None] @ A[None]
        rows, squares = self.moments.of_residual(x)
        shown = np.tensordot(self.moments.pairs[:, :, :-1, :-1], Phi, 2)
        C, D = np.zeros((K, p, p)), np.zeros((K, p))
        np.add.at(C, index, np.tensordot(A, self.moments.pairs[:, :, :-1, :-1], 2))
        np.add.at(D, index, np.tensordot(A, rows, 2))
        whole, pairs = A.reshape(len(A), -1), self.stack.pairs[: len(A) ** 2]
        expected = G * whole @ whole.T - 2 * np.tensordot(twice, shown, 2)
        own = np.tensordot(A, squares, 2), G * np.trace(A, axis1=1, axis2=2), G * (A**2).sum((1, 2))
        both = expected, np.tensordot(twice, squares, 2)
        return ClusterSums(
            C, D, *(_added(index, one, K) for one in own),
            *(_added(pairs, one, K * K).reshape(K, K) for one in both),
        )  # fmt: skip

    def between(self, W: Array) -> Array:
        index, A = self.stack.index[0], self.one
        mixed = np.tensordot(W[np.ix_(index, index)], A, 1)
        return np.tensordot((A @ mixed).sum(axis=0), self.moments.pairs[:, :, :-1, :-1], 2)
