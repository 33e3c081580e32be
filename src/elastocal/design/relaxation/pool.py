"""All candidates with their information packed, priced at once by one matrix–vector product."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from elastocal.design.criteria.base import BATCH_NUMBERS, Array
from elastocal.design.problem import DesignProblem, IntArray
from elastocal.design.relaxation.restricted import Restricted
from elastocal.errors import InsufficientDataError

# Packed information larger than this (bytes) is not stored; pricing then goes through the blocks.
PACKED_BYTES = 1_500_000_000
# Smallest eigenvalue of the pool's information, scaled to unit diagonal, that counts as regular.
SINGULAR = 1e-13


class Pool:
    """The candidates of a problem.

    A_si = B_siᵀB_si is stored as its upper triangle with √2 off the diagonal, so that ⟨G, A_si⟩ is
    a dot product of p(p+1)/2 numbers, where the blocks would need r·p² operations.
    `fixed` (N,): the weights of groups whose share takes every candidate, 0 for others; `levels`:
    the groups that leave a choice.
    """

    def __init__(self, problem: DesignProblem) -> None:
        self.problem = problem
        S, N, _, p = problem.blocks.shape
        self.rows, self.columns = np.triu_indices(p)
        self._factor = np.where(self.rows == self.columns, 1.0, np.sqrt(2.0))
        fits = 8 * S * N * len(self.rows) <= PACKED_BYTES
        self._packed = self._pack() if fits else None
        size = np.bincount(problem.group, minlength=len(problem.shares))
        whole = size * problem.most == problem.shares
        self.fixed = np.where(whole[problem.group], float(problem.most), 0.0)
        self.levels = np.flatnonzero(~whole & (problem.shares > 0))

    def even(self) -> Array:
        """w (N,): each group's share spread evenly."""
        size = np.bincount(self.problem.group, minlength=len(self.problem.shares))
        return np.asarray((self.problem.shares / np.maximum(size, 1))[self.problem.group])

    @cached_property
    def root(self) -> Array:
        """R (S, p, p) with R M Rᵀ = 1 for the information M of even weights.

        Raises InsufficientDataError where that is singular, as then it is for any weights.
        """
        M = self.information(self.even())
        for s, M_s in enumerate(M):
            diagonal = np.diag(M_s)
            scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
            smallest = float(np.linalg.eigvalsh(M_s / np.outer(scale, scale))[0])
            if not smallest > SINGULAR * len(M_s):
                raise InsufficientDataError(
                    f"all {self.problem.n_candidates} candidate poses together leave some "
                    f"parameters undetermined (scenario {s + 1} of {len(M)}: smallest eigenvalue "
                    f"of the scaled information {smallest:.1e}): add prior knowledge, other poses "
                    "or loads, or fix parameters"
                )
        return np.asarray(np.linalg.inv(np.linalg.cholesky(M)))

    def scaled(self, weights: Array) -> Array:
        """w ≥ 0 (N,) with each group's sum brought to its share, 0 where a group has none."""
        problem = self.problem
        total = np.bincount(problem.group, weights, minlength=len(problem.shares))
        return weights * (problem.shares / np.where(total > 0.0, total, np.inf))[problem.group]

    def information(self, weights: Array) -> Array:
        """M (S, p, p) at weights (N,)."""
        used = np.flatnonzero(weights)
        if self._packed is None or len(used) * 4 < len(weights):
            return self.problem.information(weights)
        return self.problem.prior + self._unpack(weights @ self._packed)

    def sensitivity(self, G: Array) -> Array:
        """d (N,) = Σ_s ⟨G_s, A_si⟩, as `DesignProblem.sensitivity`."""
        if self._packed is None:
            return self.problem.sensitivity(G)
        triangles = G[:, self.rows, self.columns] * self._factor
        return np.asarray((self._packed @ triangles[:, :, None])[..., 0].sum(axis=0))

    def matrices(self, chosen: IntArray) -> Array:
        """A (S, k, p, p) of the candidates `chosen` (k,)."""
        B = self.problem.blocks[:, chosen]
        return np.asarray(B.transpose(0, 1, 3, 2) @ B)

    def restricted(self, chosen: IntArray) -> Restricted:
        """The problem with no other candidates than `chosen`, all of them free."""
        problem = self.problem
        level = np.searchsorted(self.levels, problem.group[chosen])
        base = problem.information(self.fixed)
        shares = problem.shares[self.levels]
        return Restricted(self.matrices(chosen), base, level, shares, problem.most)

    def margins(self, chosen: IntArray, d: Array) -> tuple[Array, Array]:
        """(N,) each: the least d that a level's share takes of `chosen`, largest first, and the
        next d, which must stay for a choice to be left; inf where weights are fixed."""
        problem = self.problem
        taken, following = np.full((2, len(problem.shares)), np.inf)
        for level in self.levels:
            of_level = np.sort(d[chosen[problem.group[chosen] == level]])[::-1]
            count = -(-int(problem.shares[level]) // problem.most)
            taken[level] = of_level[count - 1]
            following[level] = of_level[min(count, len(of_level) - 1)]
        return taken[problem.group], following[problem.group]

    def best(self, score: Array, counts: IntArray) -> IntArray:
        """Of each free level as many candidates as `counts` says, those of largest score (N,);
        none of score −inf."""
        found = []
        for level, count in zip(self.levels, counts, strict=True):
            of_level = np.flatnonzero(self.problem.group == level)
            rest = max(len(of_level) - count, 0)
            found.append(of_level[np.argpartition(score[of_level], rest)[rest:]])
        best = np.concatenate(found)
        return best[score[best] > -np.inf]

    def _pack(self) -> Array:
        S, N, _, p = self.problem.blocks.shape
        packed = np.empty((S, N, len(self.rows)))
        step = max(BATCH_NUMBERS // (S * p * p), 1)
        for start in range(0, N, step):
            A = self.matrices(np.arange(start, min(start + step, N)))
            packed[:, start : start + step] = A[..., self.rows, self.columns] * self._factor
        return packed

    def _unpack(self, packed: Array) -> Array:
        p = self.problem.blocks.shape[-1]
        M = np.empty((len(packed), p, p))
        M[:, self.rows, self.columns] = packed / self._factor
        M[:, self.columns, self.rows] = packed / self._factor
        return M
