"""The certifiable criteria of one scenario as cones, exactly.

With matrix variables U ⪰ V = M⁻¹ and J ⪯ (V_II)⁻¹, both linear matrix inequalities in the weights
by Schur complements, every criterion is linear or has a standard cone:

    [M  Q; Qᵀ U] ⪰ 0   (Q spans the targets, U ⪰ QᵀVQ)      M ⪰ E_Iᵀ J E_I   (E_I picks I)

    test_pose, A, c, I    tr(C U)                           D, O1    exp(−log det J / k)
    G                     max_t tr(C_t U)                   E, O3    1/u with J = u 1
                                                            O5       (tr X⁻¹)² with X² ⪯ J

Sources: Boyd & Vandenberghe, Convex Optimization (2004), ch. 7.5; Ben-Tal & Nemirovski, Lectures
on Modern Convex Optimization (2001), ch. 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from elastocal.design.criteria.base import Array, IntArray
from elastocal.design.criteria.determinant import DeterminantCriterion
from elastocal.design.criteria.eigenvalue import EigenvalueCriterion
from elastocal.design.criteria.o5 import FifthObservability
from elastocal.design.criteria.prediction_maximum import GCriterion
from elastocal.design.criteria.scenarios import ScenarioCriterion
from elastocal.design.criteria.trace import TraceCriterion
from elastocal.errors import InputError

# Eigenvalues of Σ C_t below this part of the largest do not count as directions of the targets.
LOST = 1e-12


@dataclass(frozen=True)
class Cone:
    """Φ_s in units of its first value, as a cvxpy expression, and the constraints behind it.

    `tangent` gives, at M (p, p) of the solution, v and G (p, p) by its multipliers with
    Φ_s(M') ≥ v²/⟨G, M'⟩ for all M'; None where Φ_s is smooth and its own gradient does.
    """

    value: Any
    constraints: list[Any]
    tangent: Callable[[Array], tuple[float, Array]] | None = None


def cone_of(
    cp: ModuleType, criterion: ScenarioCriterion, s: int, M: Any, root: Array, unit: float
) -> Cone:
    """Φ_s/`unit` for the expression M (p, p) of the information root·M_s·rootᵀ.

    Raises InputError for a criterion that has no such form.
    """
    if isinstance(criterion, TraceCriterion):
        return _targets(cp, criterion.C[s][None], M, root, unit)
    if isinstance(criterion, GCriterion) and criterion.order == np.inf:
        A = criterion.A[s]
        return _targets(cp, A.transpose(0, 2, 1) @ A, M, root, unit)
    if isinstance(criterion, DeterminantCriterion):
        return _determinant(cp, criterion.interest, M, root)
    if isinstance(criterion, FifthObservability):
        return _fifth(cp, criterion.interest, M, root, unit)
    if isinstance(criterion, EigenvalueCriterion) and criterion.order == np.inf:
        return _eigenvalue(cp, criterion.interest, M, root, unit)
    raise InputError(f"criterion {criterion.name} has no conic form here: choose another method")


def _targets(cp: ModuleType, C: Array, M: Any, root: Array, unit: float) -> Cone:
    """max_t tr(C_t V), C (T, p, p)."""
    turned = root @ C @ root.T / unit
    size, Q = np.linalg.eigh(turned.sum(axis=0))
    Q = Q[:, size > LOST * size[-1]]
    q = Q.shape[1]
    U = cp.Variable((q, q), symmetric=True)
    largest = cp.Variable()
    limit = (Q.T @ turned @ Q).reshape(len(C), -1) @ cp.vec(U, order="C") <= largest

    def tangent(information: Array) -> tuple[float, Array]:
        """Of Σ_t μ_t tr(C_t V) ≤ max_t tr(C_t V), Σ μ_t = 1."""
        mu = np.maximum(limit.dual_value, 0.0)
        mean, V = np.tensordot(mu / mu.sum(), C, 1), np.linalg.inv(information)
        return float(np.sum(mean * V)), V @ mean @ V

    kinked = tangent if len(C) > 1 else None
    return Cone(largest, [cp.bmat([[M, Q], [Q.T, U]]) >> 0, limit], kinked)


def _determinant(cp: ModuleType, interest: IntArray, M: Any, root: Array) -> Cone:
    """det(V_II)^{1/k}, J in the basis where V_II starts as the identity."""
    K = root.T[interest]
    K = np.linalg.solve(np.linalg.cholesky(K @ K.T), K)
    J = cp.Variable((len(K), len(K)), symmetric=True)
    return Cone(cp.exp(-cp.log_det(J) / len(K)), [M - K.T @ J @ K >> 0])


def _fifth(cp: ModuleType, interest: IntArray, M: Any, root: Array, unit: float) -> Cone:
    """(tr V_II^{1/2})² with X² ⪯ J by [J X; X 1] ⪰ 0."""
    K = root.T[interest] / np.sqrt(unit)
    k = len(K)
    J, X = cp.Variable((k, k), symmetric=True), cp.Variable((k, k), symmetric=True)
    below = [M - K.T @ J @ K >> 0, cp.bmat([[J, X], [X, np.eye(k)]]) >> 0]
    return Cone(cp.square(cp.matrix_frac(np.eye(k), X)), below)


def _eigenvalue(cp: ModuleType, interest: IntArray, M: Any, root: Array, unit: float) -> Cone:
    """λ_max(V_II) = 1/u."""
    K = root.T[interest] / np.sqrt(unit)
    u = cp.Variable(nonneg=True)
    above = M - u * (K.T @ K) >> 0

    def tangent(information: Array) -> tuple[float, Array]:
        """M' ⪰ u' E_IᵀE_I, u' = 1/λ_max(V'_II), times Z ⪰ 0 is ⟨Z, M'⟩ ≥ tr(Z_II)/λ_max(V'_II)."""
        size, U = np.linalg.eigh(root.T @ above.dual_value @ root)
        Z = (U * np.maximum(size, 0.0)) @ U.T
        V = np.linalg.inv(information)[np.ix_(interest, interest)]
        largest = float(np.linalg.eigvalsh(V)[-1])
        return largest, Z * largest**2 / np.trace(Z[np.ix_(interest, interest)])

    return Cone(cp.inv_pos(u), [above], tangent)
