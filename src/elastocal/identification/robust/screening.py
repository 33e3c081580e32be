"""Tests of single readings and of groups against the fit to the readings held to be good."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from elastocal.identification.robust.design import Design, lengths
from elastocal.identification.robust.estimate import RobustEstimate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ABSORBED = 1e-6  # share of a group's error that must be left after the model has followed it
NOTHING = 1e-9  # share of a direction's information below which it is undetermined
ROUNDS = 30
SUSPECT = 0.01  # share of clean readings that the first set, from the robust fit, leaves out


@dataclass(frozen=True)
class GroupTest:
    """Two F-tests of a group: of one error `shift` (size,) common to its readings, and of any.

    `p_common` and `p_any` are their p-values (1 where untestable), `gain` what the more telling
    of the two takes off the rss beyond what noise would.  `common` says whether the shift
    explains at least half of what is wrong; if not, the readings err in different directions.
    """

    shift: Array
    p_common: float
    p_any: float
    gain: float
    common: bool

    @property
    def p_value(self) -> float:
        """The smaller of the two, for two tests."""
        return min(1.0, 2 * min(self.p_common, self.p_any))


class CleanFit:
    """Least squares on the `good` observations (n,), and tests of everything against it.

    `T` (n, size, p) are the rows of B in coordinates where those of the good ones are
    orthonormal, so that T_i T_jᵀ is the covariance of two predictions in units of σ²; directions
    that the good ones leave undetermined have none.  `e` (n, size) is y less its prediction.
    """

    def __init__(self, problem: Design, good: Mask) -> None:
        n, size, p = problem.n, problem.size, problem.p
        Q3 = problem.Q.reshape(n, size, p)
        Qg = Q3[good].reshape(-1, p)
        values, vectors = np.linalg.eigh(Qg.T @ Qg)
        known = values > NOTHING
        self.problem, self.good = problem, good
        self.to_z = vectors[:, known] / np.sqrt(values[known])
        self.T = Q3 @ self.to_z
        open_ = np.abs(Q3 @ vectors[:, ~known]).max(axis=(1, 2), initial=0.0)
        self.undetermined: Mask = open_ > np.sqrt(NOTHING)
        y = problem.y.reshape(n, size)
        fitted = np.einsum("nij,ni->j", self.T[good], y[good])
        self.z = self.to_z @ fitted
        self.e = y - self.T @ fitted
        self.rss = float((self.e[good] ** 2).sum())
        self.dof = int(good.sum()) * size - int(known.sum())

    @property
    def sigma(self) -> float:
        """Standard deviation of a whitened row."""
        return max(float(np.sqrt(self.rss / max(self.dof, 1))), self.problem.floor)

    def reading_p(self) -> Array:
        """p-value (n,) of every observation's error, as if it had been left out of the fit.

        A good one has eᵀ(I − H)⁻¹e, any other eᵀ(I + H)⁻¹e; both over size · s², s² without the
        observation, follow F.  1 where the others do not predict it.
        """
        size = self.problem.size
        H = self.T @ self.T.transpose(0, 2, 1)
        sign = np.where(self.good, -1.0, 1.0)[:, None, None]
        spread = np.eye(size) + sign * H
        alone = (np.linalg.eigvalsh(spread)[:, 0] < NOTHING) | self.undetermined
        spread[alone] = np.eye(size)
        drop = (self.e * np.linalg.solve(spread, self.e[..., None])[..., 0]).sum(axis=1)
        dof = self.dof - size * self.good
        floor = len(drop) * self.problem.floor**2
        rest = np.maximum(self.rss - np.where(self.good, drop, 0.0), floor)
        p = special.fdtrc(size, np.maximum(dof, 1), drop / size * np.maximum(dof, 1) / rest)
        return np.where(alone | (dof < 1), 1.0, p)

    def group_test(self, members: Mask) -> GroupTest | None:
        """Test the observations `members` (n,) together, whether good ones or not.

        With A = Σ T_iᵀT_i over the good ones less or plus the members, the model is fitted with
        them (rss₁), without them (rss₀), and with them and a common shift (rss₁ − gain):

            F_common = (gain/size)/((rss₁ − gain)/dof),   F_any = ((rss₁ − rss₀)/m)/(rss₀/dof₀)

        None where they touch what the others leave undetermined, or where the model's own
        parameters absorb a shift (the position of a marker that is itself fitted) and any error.
        """
        if (self.undetermined & members).any():
            return None
        size, n = self.problem.size, int(members.sum())
        floor = len(self.e) * self.problem.floor**2
        rss_with, dof_with, G, c = self._changed(members & ~self.good, 1.0)
        S, e = self.T[members].sum(axis=0), self.e[members].sum(axis=0)
        solved = np.linalg.solve(G, np.column_stack([S.T, c]))
        M = n * np.eye(size) - S @ solved[:, :size]
        shift, gain, p_common = np.zeros(size), 0.0, 1.0
        if dof_with > size and np.linalg.eigvalsh(M)[0] > ABSORBED * n:
            b = e - S @ solved[:, size]
            shift = np.linalg.solve(M, b)
            gain = float(b @ shift)
            F = gain / size * (dof_with - size) / max(rss_with - gain, floor)
            p_common = float(special.fdtrc(size, dof_with - size, F))
        excess, p_any = 0.0, 1.0
        rss_without, dof_without, G, _ = self._changed(members & self.good, -1.0)
        if dof_without > 0 and np.linalg.eigvalsh(G)[0] > ABSORBED:
            drop, s2 = max(rss_with - rss_without, 0.0), max(rss_without, floor) / dof_without
            p_any = float(special.fdtrc(n * size, dof_without, drop / (n * size) / s2))
            excess = drop - n * size * s2
        if p_common == p_any == 1.0:
            return None
        return GroupTest(shift, p_common, p_any, max(gain, excess), gain >= excess / 2)

    def _changed(self, members: Mask, sign: float) -> tuple[float, int, Array, Array]:
        """rss, dof, Σ TᵀT and Σ Tᵀe of the fit with `members` added (+1) or removed (−1)."""
        T, e = self.T[members], self.e[members]
        G = np.eye(self.T.shape[2]) + sign * np.einsum("nij,nik->jk", T, T)
        c = np.einsum("nij,ni->j", T, e)
        rss = self.rss + sign * float((e**2).sum())
        if np.linalg.eigvalsh(G)[0] > ABSORBED:
            rss -= float(c @ np.linalg.solve(G, c))
        return max(rss, 0.0), self.dof + int(sign) * e.size, G, c

    def move(self, members: Mask) -> Array:
        """Change (p,) of x̂ in its standard deviations if `members` were fitted along as read.

        Infinite where they touch what the good ones leave undetermined.
        """
        extra = members & ~self.good
        if (self.undetermined & extra).any():
            return np.full(self.problem.p, np.inf)
        Tx = self.T[extra]
        G = np.eye(self.T.shape[2]) + np.einsum("nij,nik->jk", Tx, Tx)
        moved = np.linalg.solve(G, np.einsum("nij,ni->j", Tx, self.e[extra]))
        P = self.problem.parameters(self.to_z)
        return P @ moved / (self.sigma * np.linalg.norm(P, axis=1))


def screened(found: RobustEstimate, active: Mask, limit: float) -> CleanFit:
    """The fit to the `active` observations (n,) whose own p-value is not below `limit`.

    Starts from those near the robust fit and repeats until the set stands; a set without a
    majority of the active ones cannot judge, and its predecessor stands.
    """
    size = found.design.size
    inside = lengths(found.residual, size) <= found.scale * stats.chi.isf(SUSPECT, size)
    good = active & inside
    if 2 * good.sum() <= active.sum():
        good = active
    fit = CleanFit(found.design, good)
    visited = {good.tobytes()}
    for _ in range(ROUNDS):
        good = active & (fit.reading_p() >= limit)
        if 2 * good.sum() <= active.sum() or good.tobytes() in visited:
            break
        visited.add(good.tobytes())
        fit = CleanFit(found.design, good)
    return fit
