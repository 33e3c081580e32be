"""Sandwich of the scores by cluster: errors that depend on each other within a configuration."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import InsufficientDataError, require
from elastocal.identification.covariance.estimate import Covariance
from elastocal.identification.robust.asymptotic import curvature, information, inverse_of
from elastocal.identification.robust.estimate import RobustEstimate

Array = NDArray[np.float64]


def clustered_covariance(found: RobustEstimate, cluster: ArrayLike) -> Covariance:
    """Covariance (p, p) of x̂ under any dependence within clusters, with t dofs (p,).

    `cluster` (n,) integer label of each observation, such as its configuration.  Leaving cluster
    g out moves x̂ by δ_g = σ (W − W_g)⁻¹ s_g to first order, with the scores s_g = Σ_{i∈g} B_iᵀΨ_i
    and W_g = Σ_{i∈g} B_iᵀ J_i B_i; the jackknife of these (CR3 of Bell and McCaffrey 2002 for the
    M-estimate's score),

        cov x̂ = (G − 1)/G Σ_g δ_g δ_gᵀ,

    needs no model of the dependence, and dividing by W − W_g undoes that a fit follows its own
    clusters.  dof are Satterthwaite's under independence, (tr T)²/tr T² with the quadratic form
    T of each parameter: few clusters, or few that see a parameter, have few.

    Raises InputError for labels of the wrong shape or a single cluster, InsufficientDataError
    where without one cluster the others do not determine every parameter.
    """
    labels = np.asarray(cluster)
    n = found.design.n
    require(
        labels.shape == (n,),
        f"cluster must hold one label per observation, ({n},); found {labels.shape}",
    )
    names, code = np.unique(labels, return_inverse=True)
    require(len(names) > 1, "a clustered covariance needs at least two clusters; found one")
    problem = found.design
    W_g = information(found, curvature(found), code)
    W = W_g.sum(axis=0)
    inverse = inverse_of(W)
    rest = W - W_g
    lowest = np.linalg.eigvalsh(rest)[:, 0]
    alone = np.flatnonzero(lowest <= 1e-9 * np.linalg.eigvalsh(W)[-1])
    if alone.size:
        raise InsufficientDataError(
            f"without cluster {names[alone[0]]} the others do not determine every parameter, so "
            "its scatter cannot be judged; measure more such configurations or fit fewer parameters"
        )
    psi = (problem.rows(found.weights) * found.residual / found.scale)[:, None] * problem.Q
    scores = np.zeros((len(names), problem.p))
    np.add.at(scores, np.repeat(code, problem.size), psi)
    moved = found.scale * np.linalg.solve(rest, scores[..., None])[..., 0]
    P = problem.parameters(np.eye(problem.p))
    shift = moved @ P.T
    share = (len(names) - 1) / len(names)
    text = f"jackknife of the {found.loss.name} scores over {len(names)} clusters"
    matrix = share * shift.T @ shift
    return Covariance("clustered", matrix, _satterthwaite(W_g, rest, inverse, P), text)


def _satterthwaite(W_g: Array, rest: Array, inverse: Array, P: Array) -> Array:
    """dof (p,) of Σ_g (p_jᵀ(W − W_g)⁻¹ s_g)² where cov(Ψ) is W's and residuals are projected."""
    reach = np.linalg.solve(rest, np.broadcast_to(P.T, rest.shape))  # (G, p, p), by parameter
    m = W_g @ reach
    # T = diag(own) − K with K_gh = m_gᵀ W⁻¹ m_h, never formed: there may be thousands of clusters.
    own = np.einsum("gij,gij->gj", reach, m)
    shared = np.einsum("gij,gij->gj", m, inverse @ m)
    product = inverse @ np.einsum("gij,gkj->jik", m, m)
    trace = (own - shared).sum(axis=0)
    square = (own**2 - 2 * own * shared).sum(axis=0) + np.einsum("jik,jki->j", product, product)
    return np.asarray(trace**2 / square)
