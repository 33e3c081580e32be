"""Restricted likelihood of variances, its slope and information, and the estimate under them.

For e = B Δx + noise with V = Σ_k θ_k V_k (Patterson and Thompson 1971; Harville 1977):

    −2 ℓ_R = log|V| + log|BᵀV⁻¹B| + eᵀPe + (rows − p) log 2π,   P = V⁻¹ − V⁻¹BΦBᵀV⁻¹
    ∂ℓ/∂θ_k = ½ (eᵀP V_k P e − tr P V_k),   E[−∂²ℓ/∂θ_k∂θ_l] = ½ tr(P V_k P V_l)

with Φ = (BᵀV⁻¹B)⁻¹.  Repeats enter as cell means, and their scatter as Wishart terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.errors import InsufficientDataError
from elastocal.identification.variance.blocks import Stack
from elastocal.identification.variance.structure import Structure

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_TOLD = 1e-9  # of the information on θ_k that there would be if Δx were known


@dataclass(frozen=True)
class Whitened:
    """A stack under V = R Rᵀ: R⁻¹ (G, n, n), A_l = R⁻¹ V_l R⁻ᵀ (G, L, n, n), R⁻¹B, R⁻¹e, log|V|."""

    stack: Stack
    inverse: Array
    A: Array
    B: Array
    e: Array
    log_det: float


@dataclass(frozen=True)
class State:
    """Everything at one θ (K,): estimate Δx (p,), Φ (p, p), `log_likelihood`, and what it took."""

    theta: Array
    x: Array
    Phi: Array
    log_likelihood: float
    whitened: list[Whitened]
    inner: Array  # (repeated cells, size, size): inverse covariance of a single reading


@dataclass(frozen=True)
class Slope:
    """Score (K,), expected and observed information (K, K) of θ; `C` (K, p, p): BᵀV⁻¹V_kV⁻¹B.

    `told` (K,): whether the readings say anything of θ_k, which they do not where the parameters
    explain all that it could cause.
    """

    score: Array
    information: Array
    observed: Array
    C: Array
    told: Mask


def evaluate(structure: Structure, stacked: list[Stack], theta: Array) -> State:
    """State at θ.  Raises LinAlgError where V is not positive definite.

    InsufficientDataError where B has dependent columns.
    """
    cells = structure.cells
    p, size = cells.B.shape[2], cells.e.shape[1]
    whitened = [_whiten(stack, theta) for stack in stacked]
    normal = sum((np.tensordot(w.B, w.B, ((0, 1), (0, 1))) for w in whitened), np.zeros((p, p)))
    right = sum((np.tensordot(w.B, w.e, ((0, 1), (0, 1))) for w in whitened), np.zeros(p))
    try:
        factor = linalg.cholesky(normal, lower=True)
    except linalg.LinAlgError:
        raise InsufficientDataError(
            "the columns of B depend on each other under this noise model; measure more poses"
        ) from None
    x = linalg.cho_solve((factor, True), right)
    Phi = linalg.cho_solve((factor, True), np.eye(p))
    squares = sum(float(w.e.ravel() @ w.e.ravel()) for w in whitened) - float(right @ x)
    repeated = cells.dof > 0
    single = np.einsum("cl,clij->cij", theta[structure.index[repeated]], structure.matrix[repeated])
    inner = np.linalg.inv(single)
    log_det = np.linalg.slogdet(single)[1]
    within = float(cells.dof[repeated] @ log_det) + float(np.vdot(inner, cells.scatter[repeated]))
    rows = int(cells.repeats.sum()) * size
    total = (
        sum(w.log_det for w in whitened) + 2 * float(np.log(np.diag(factor)).sum()) + squares
        + within + cells.log_offset + (rows - p) * np.log(2 * np.pi)
    )  # fmt: skip
    return State(theta, x, Phi, -0.5 * total, whitened, inner)


def slope(structure: Structure, state: State) -> Slope:
    """Score and information of θ at a state."""
    K, p = len(state.theta), len(state.x)
    score, summed, D = np.zeros(K), np.zeros((K, p * p)), np.zeros((K, p))
    known = np.zeros(K)
    twice_expected, product = np.zeros(K * K), np.zeros(K * K)
    half = linalg.cholesky(state.Phi, lower=True)
    for w in state.whitened:
        G, L = w.stack.index.shape
        flat = w.stack.index.ravel()
        z = w.e - w.B @ state.x
        AB = w.A @ w.B[:, None]  # (G, L, n, p)
        Az = (w.A @ z[:, None, :, None])[..., 0]  # (G, L, n)
        if w.stack.uniform:
            whole = AB.transpose(1, 0, 2, 3).reshape(L, -1, p)
            np.add.at(summed, flat[:L], (w.B.reshape(-1, p).T @ whole).reshape(L, -1))
        else:
            summed += w.stack.gather @ (w.B.transpose(0, 2, 1)[:, None] @ AB).reshape(G * L, -1)
        D += w.stack.gather @ (Az @ w.B).reshape(-1, p)
        squares = (Az @ z[:, :, None])[..., 0]
        trace = np.trace(w.A, axis1=2, axis2=3)
        score += np.bincount(flat, 0.5 * (squares - trace).ravel(), K)
        spread, whole = (AB @ half).reshape(G, L, -1), w.A.reshape(G, L, -1)
        known += np.bincount(flat, 0.5 * (whole**2).sum(axis=2).ravel(), K)
        local = whole @ whole.transpose(0, 2, 1) - 2 * spread @ spread.transpose(0, 2, 1)
        twice_expected += np.bincount(w.stack.pairs, local.ravel(), K * K)
        product += np.bincount(w.stack.pairs, (Az @ Az.transpose(0, 2, 1)).ravel(), K * K)
    C = summed.reshape(K, p, p)
    score += 0.5 * summed @ state.Phi.ravel()
    rotated = (half.T @ C @ half).reshape(K, -1)
    information = 0.5 * (twice_expected.reshape(K, K) + rotated @ rotated.T)
    # −∂²ℓ/∂θ_k∂θ_l = eᵀP V_k P V_l P e − ½ tr(P V_k P V_l)
    Dh = D @ half
    observed = product.reshape(K, K) - Dh @ Dh.T - information
    _within(structure, state, score, information, observed)
    return Slope(score, information, observed, C, np.diag(information) > LEAST_TOLD * known)


def _within(
    structure: Structure, state: State, score: Array, information: Array, observed: Array
) -> None:
    """Add what the scatter of repeats says: Wishart terms of each cell."""
    cells, K = structure.cells, len(score)
    repeated = np.flatnonzero(cells.dof > 0)
    if not len(repeated):
        return
    dof, index = cells.dof[repeated], structure.index[repeated]
    n, L = index.shape
    S = state.inner[:, None] @ structure.matrix[repeated]  # (C, L, size, size)
    W = state.inner @ cells.scatter[repeated]
    flat = S.reshape(n, L, -1)
    other = S.transpose(0, 1, 3, 2).reshape(n, L, -1)
    squares = (flat @ W.transpose(0, 2, 1).reshape(n, -1, 1))[..., 0]
    trace = np.trace(S, axis1=2, axis2=3)
    score += np.bincount(index.ravel(), 0.5 * (squares - dof[:, None] * trace).ravel(), K)
    pairs = (index[:, :, None] * K + index[:, None, :]).ravel()
    expected = 0.5 * dof[:, None, None] * (flat @ other.transpose(0, 2, 1))
    product = flat @ (W[:, None] @ S).transpose(0, 1, 3, 2).reshape(n, L, -1).transpose(0, 2, 1)
    product = (product + product.transpose(0, 2, 1)) / 2
    information += np.bincount(pairs, expected.ravel(), K * K).reshape(K, K)
    observed += np.bincount(pairs, (product - expected).ravel(), K * K).reshape(K, K)


def _whiten(stack: Stack, theta: Array) -> Whitened:
    G, L, n, _ = stack.part.shape
    V = (theta[stack.index][:, None] @ stack.part.reshape(G, L, -1)).reshape(G, n, n)
    R = np.linalg.cholesky(V)
    inverse = np.linalg.inv(R)
    A = inverse[:, None] @ stack.part @ inverse.transpose(0, 2, 1)[:, None]
    e = (inverse @ stack.e[:, :, None])[..., 0]
    log_det = 2 * float(np.log(np.diagonal(R, axis1=1, axis2=2)).sum())
    return Whitened(stack, inverse, A, inverse @ stack.B, e, log_det)
