"""Covariance of an M-estimate: from ψ and ψ′, never from the weights of its iteration.

With r_i = e_i/σ, Ψ(r) = ψ(|r|) r/|r| and u = r/|r| the derivative of an observation's score is

    J_i = ∂Ψ/∂r = ψ′(d_i) u uᵀ + (ψ(d_i)/d_i)(I − u uᵀ),      d_i = |r_i|,

eigenvalue ψ′ along the error and ψ/d across it (size − 1 times; for size 1 only ψ′).  Expanding
Σ B_iᵀ Ψ(e_i/σ) = 0 gives x̂ − x ≈ σ W⁻¹ Σ B_iᵀ Ψ_i, W = Σ B_iᵀ J_i B_i, and for errors that are
symmetric in direction E J = a I, E ΨΨᵀ = b I,

    cov x̂ = σ² (b/a²) (BᵀB)⁻¹        (Huber 1981, sections 7.6 and 7.10, per row; Maronna 1976)

The weights w_i = ψ/d solve the estimating equation; as inverse variances they would be wrong: a
weight is small because that residual came out large, not because its variance was known to be.
σ² (BᵀWB)⁻¹ with s² = Σ w e²/(rows − p) estimates E[ψd]/E[ψ/d] in place of b/a²: too little at the
normal (per row and for L1, nothing), several times too much with blunders, which s² counts.  And
variances e_i² taken one by one, as eq. (14) applied to each residual, hold almost nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from elastocal.errors import InsufficientDataError, require
from elastocal.identification.covariance.estimate import Covariance
from elastocal.identification.robust.estimate import RobustEstimate
from elastocal.identification.robust.loss import Absolute

Array = NDArray[np.float64]
Kind = Literal["H1", "H2", "H3"]

UNDETERMINED = (
    "the loss rejects so many observations that the rest do not determine the parameters' "
    "covariance; use a monotone loss such as huber, or look for the cause of the outliers"
)
EXACT = 1e-8  # scaled length below which an L1 fit passes through an observation


@dataclass(frozen=True)
class Curvature:
    """Eigenvalues of every J_i: `along` (n,) the error and `across` (n,) it."""

    along: Array
    across: Array


def curvature(found: RobustEstimate) -> Curvature:
    """ψ′ and ψ/d of every observation.

    ψ of L1 jumps at zero: for size 1 ψ′ = 2 f(0) is estimated from the density of the residuals
    there; for vectors ψ′ = 0 and ψ/d = 1/d suffice, without observations that are met exactly.
    """
    d, loss = found.distance, found.loss
    if not isinstance(loss, Absolute):
        return Curvature(loss.slope(d), loss.weight(d))
    if loss.size == 1:
        level = 2 * _density_at_zero(found.residual / found.scale, found.design.p)
        return Curvature(np.full_like(d, level), np.full_like(d, level))
    met = d < EXACT
    return Curvature(np.zeros_like(d), np.where(met, 0.0, 1 / np.where(met, 1.0, d)))


def asymptotic_covariance(found: RobustEstimate, kind: Kind = "H2") -> Covariance:
    """Covariance (p, p) of x̂; t intervals with the rows that keep a weight less p as dof.

    With â the mean eigenvalue of J_i, b̂ = Σψ²/(n·size − p), and Huber's small-sample factor
    k = 1 + (p/(n·size)) Var(eigenvalues)/â² (k = 1 for L1):

        H1   k² σ² (b̂/â²) (BᵀB)⁻¹,     H2   k σ² (b̂/â) W⁻¹,     H3   k⁻¹ σ² b̂ W⁻¹ BᵀB W⁻¹

    All three estimate the same for independent errors that know nothing of B.  Where the wrong
    observations are also leverage points, H1 credits x̂ with information that the loss has
    rejected and H3 charges it for them; H2 leaves them out of b̂/â and of W alike, and is the
    default.  Under dependence or unequal spread use `clustered.clustered_covariance`.

    Raises InputError for another kind, InsufficientDataError where W is not positive definite.
    """
    require(kind in ("H1", "H2", "H3"), f"kind is H1, H2 or H3; found '{kind}'")
    problem, shape = found.design, curvature(found)
    rows, p, size = len(problem.y), problem.p, problem.size
    a = _mean_eigenvalue(shape, size)
    if not a > 0:
        raise InsufficientDataError(UNDETERMINED)
    b = float((found.loss.psi(found.distance) ** 2).sum()) / (rows - p)
    k = 1.0
    if not isinstance(found.loss, Absolute):
        square = float((shape.along**2).sum() + (size - 1) * (shape.across**2).sum()) / rows
        k = 1 + p / rows * (square - a**2) / a**2
    variance = found.scale**2 * b
    if kind == "H1":
        inner = np.eye(p) * (k**2 * variance / a**2)
    else:
        inverse = inverse_of(information(found, shape).sum(axis=0))
        inner = k * variance / a * inverse if kind == "H2" else variance / k * inverse @ inverse
    P = problem.parameters(np.eye(p))
    dof = float(size * np.count_nonzero(found.weights) - p)
    text = f"asymptotic covariance {kind} of the {found.loss.name} estimate, from ψ and ψ′"
    return Covariance(kind, P @ inner @ P.T, np.full(p, dof), text)


def _mean_eigenvalue(shape: Curvature, size: int) -> float:
    return float(np.mean(shape.along + (size - 1) * shape.across)) / size


def information(
    found: RobustEstimate, shape: Curvature, group: NDArray[np.int64] | None = None
) -> Array:
    """Σ Q_iᵀ J_i Q_i (groups, p, p) per group code of the observations; one group by default."""
    problem = found.design
    size, p, n = problem.size, problem.p, problem.n
    codes = np.zeros(n, dtype=np.int64) if group is None else group
    order = np.argsort(codes, kind="stable")
    starts = np.flatnonzero(np.diff(codes[order], prepend=-1))
    Q3 = problem.Q.reshape(n, size, p)
    r = found.residual.reshape(n, size)
    u = r / np.maximum(np.linalg.norm(r, axis=1), np.finfo(float).tiny)[:, None]
    along = np.einsum("nij,ni->nj", Q3, u)
    total = np.zeros((len(starts), p, p))
    for g, chosen in enumerate(np.split(order, starts[1:])):
        rows = Q3[chosen].reshape(-1, p)
        across = np.repeat(shape.across[chosen], size)
        excess = shape.along[chosen] - shape.across[chosen]
        total[g] = (rows.T * across) @ rows + (along[chosen].T * excess) @ along[chosen]
    return total


def inverse_of(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix.

    Raises InsufficientDataError where it is not: the data left after rejection do not determine
    all parameters.
    """
    try:
        factor = linalg.cho_factor(matrix)
    except linalg.LinAlgError:
        raise InsufficientDataError(UNDETERMINED) from None
    return np.asarray(linalg.cho_solve(factor, np.eye(len(matrix))))


def _density_at_zero(r: Array, p: int) -> float:
    """f(0) of the errors by the Siddiqui quotient with Hall and Sheather's bandwidth.

    The p residuals that an L1 fit makes zero are left out (Koenker 2005, section 3.4).
    """
    kept = np.sort(r[np.argsort(np.abs(r))[p:]])
    h = len(kept) ** (-1 / 3) * stats.norm.isf(0.025) ** (2 / 3)
    h = min(h * (1.5 * stats.norm.pdf(0) ** 2) ** (1 / 3), 0.49)
    low, high = np.quantile(kept, [0.5 - h, 0.5 + h])
    return float(2 * h / max(high - low, np.finfo(float).tiny))
