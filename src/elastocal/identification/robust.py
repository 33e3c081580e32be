"""Robust fit of the nonlinear model, and covariances of M-estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, special

from elastocal.errors import ElastocalError, InsufficientDataError, require
from elastocal.identification.covariance import Covariance, SatterthwaiteSums
from elastocal.identification.least_squares import FitProblem
from elastocal.identification.robust_core import Absolute, RobustEstimate, huber, lengths
from elastocal.identification.robust_fits import SUBSETS, m_estimate, mm_estimate, student_t
from elastocal.units import Array

# Covariance of an M-estimate: from ψ and ψ′, never from the weights of its iteration.
#
# With r_i = e_i/σ, Ψ(r) = ψ(|r|) r/|r| and u = r/|r| the derivative of an observation's score is
#
#     J_i = ∂Ψ/∂r = ψ′(d_i) u uᵀ + (ψ(d_i)/d_i)(I − u uᵀ),      d_i = |r_i|,
#
# eigenvalue ψ′ along the error and ψ/d across it (size − 1 times; for size 1 only ψ′).  Expanding
# Σ B_iᵀ Ψ(e_i/σ) = 0 gives x̂ − x ≈ σ W⁻¹ Σ B_iᵀ Ψ_i, W = Σ B_iᵀ J_i B_i, and for errors that are
# symmetric in direction E J = a I, E ΨΨᵀ = b I,
#
#     cov x̂ = σ² (b/a²) (BᵀB)⁻¹        (Huber 1981, sections 7.6 and 7.10, per row; Maronna 1976)
#
# The weights w_i = ψ/d solve the estimating equation; as inverse variances they would be wrong: a
# weight is small because that residual came out large, not because its variance was known to be.
# σ² (BᵀWB)⁻¹ with s² = Σ w e²/(rows − p) estimates E[ψd]/E[ψ/d] in place of b/a²: too little at the
# normal (per row and for L1, nothing), several times too much with blunders, which s² counts.  And
# variances e_i² taken one by one, as eq. (14) applied to each residual, hold almost nothing.

UNDETERMINED = (
    "the loss rejects so many observations that the rest do not determine the parameters' "
    "covariance; use a monotone loss such as huber, or look for the cause of the outliers"
)
EXACT = 1e-8  # scaled length below which an L1 fit passes through an observation


def curvature(found: RobustEstimate) -> tuple[Array, Array]:
    """Eigenvalues of every J_i: ψ′ along the error (n,) and ψ/d across it (n,).

    ψ of L1 jumps at zero: for size 1 ψ′ = 2 f(0) is estimated from the density of the residuals
    there; for vectors ψ′ = 0 and ψ/d = 1/d suffice, without observations that are met exactly.
    """
    d, loss = found.distance, found.loss
    if not isinstance(loss, Absolute):
        return loss.slope(d), loss.weight(d)
    if loss.size == 1:
        level = np.full_like(d, 2 * _density_at_zero(found.residual / found.scale, found.design.p))
        return level, level
    met = d < EXACT
    return np.zeros_like(d), np.where(met, 0.0, 1 / np.where(met, 1.0, d))


def asymptotic_covariance(found: RobustEstimate) -> Covariance:
    """Covariance (p, p) of x̂; t intervals with the rows that keep a weight less p as dof.

    Huber's H2, k σ² (b̂/â) W⁻¹, with â the mean eigenvalue of J_i, b̂ = Σψ²/(n·size − p), and his
    small-sample factor k = 1 + (p/(n·size)) Var(eigenvalues)/â² (k = 1 for L1).

    His H1, k² σ² (b̂/â²) (BᵀB)⁻¹, and H3, k⁻¹ σ² b̂ W⁻¹ BᵀB W⁻¹, estimate the same for independent
    errors that know nothing of B.  Where the wrong observations are also leverage points, H1
    credits x̂ with information that the loss has rejected and H3 charges it for them; H2 leaves
    them out of b̂/â and of W alike.  Under dependence or unequal spread use `clustered_covariance`.

    Raises InsufficientDataError where W is not positive definite.
    """
    problem, (along, across) = found.design, curvature(found)
    rows, p, size = len(problem.y), problem.p, problem.size
    a = float(np.mean(along + (size - 1) * across)) / size
    if not a > 0:
        raise InsufficientDataError(UNDETERMINED)
    b = float((found.loss.psi(found.distance) ** 2).sum()) / (rows - p)
    k = 1.0
    if not isinstance(found.loss, Absolute):
        square = float((along**2).sum() + (size - 1) * (across**2).sum()) / rows
        k = 1 + p / rows * (square - a**2) / a**2
    variance = found.scale**2 * b
    inner = k * variance / a * inverse_of(information(found, along, across).sum(axis=0))
    P = problem.parameters(np.eye(p))
    dof = float(size * np.count_nonzero(found.weights) - p)
    text = f"asymptotic covariance H2 of the {found.loss.name} estimate, from ψ and ψ′"
    return Covariance("H2", P @ inner @ P.T, np.full(p, dof), text)


def information(
    found: RobustEstimate, along: Array, across: Array, group: NDArray[np.int64] | None = None
) -> Array:
    """Σ Q_iᵀ J_i Q_i (groups, p, p) per group code of the observations; one group by default.

    `along` and `across` (n,) are the eigenvalues of the J_i (`curvature`).
    """
    problem = found.design
    size, p, n = problem.size, problem.p, problem.n
    codes = np.zeros(n, dtype=np.int64) if group is None else group
    order = np.argsort(codes, kind="stable")
    starts = np.flatnonzero(np.diff(codes[order], prepend=-1))
    Q3 = problem.Q.reshape(n, size, p)
    r = found.residual.reshape(n, size)
    u = r / np.maximum(np.linalg.norm(r, axis=1), np.finfo(float).tiny)[:, None]
    toward = np.einsum("nij,ni->nj", Q3, u)
    total = np.zeros((len(starts), p, p))
    for g, chosen in enumerate(np.split(order, starts[1:])):
        rows = Q3[chosen].reshape(-1, p)
        excess = along[chosen] - across[chosen]
        total[g] = (rows.T * np.repeat(across[chosen], size)) @ rows
        total[g] += (toward[chosen].T * excess) @ toward[chosen]
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
    h = len(kept) ** (-1 / 3) * special.ndtri(0.975) ** (2 / 3)
    h = min(h * (1.5 / (2 * np.pi)) ** (1 / 3), 0.49)
    low, high = np.quantile(kept, [0.5 - h, 0.5 + h])
    return float(2 * h / max(high - low, np.finfo(float).tiny))


# Sandwich of the scores by cluster: errors that depend on each other within a configuration.


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
    W_g = information(found, *curvature(found), code)
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
    sums = SatterthwaiteSums(len(P))
    sums.add(np.einsum("gij,gij->gj", reach, m), linalg.cholesky(inverse) @ m)
    return sums.dof()


# Robust fit of the nonlinear model: linear robust steps on the exact B.

LossName = Literal["huber", "tukey", "l1", "student-t"]

SETTLED = 1e-7  # |B δx| in units of the scale at which the steps have converged
MAX_STEPS = 40
SEARCHES = 2  # steps whose S-estimate is searched by random subsets; later ones follow it


@dataclass(frozen=True)
class RobustFit:
    """x (parameters,), raw and whitened residual (rows,), and the robust estimate of the `linear`
    model at x, whose step is negligible."""

    x: Array
    residual: Array
    whitened: Array
    linear: RobustEstimate
    converged: bool
    steps: int


def robust_fit(problem: FitProblem, loss_name: LossName = "tukey", seed: int = 0) -> RobustFit:
    """Minimise Σ ρ(|W (y − h(X))_i|/σ) over X[columns] by damped Gauss–Newton steps.

    Each step is the robust linear fit of the whitened residual to the whitened B at X: "huber"
    (95 % efficient, σ by the median), "tukey" (MM-estimate), "l1", or "student-t" (ML, ν
    estimated); it is halved until Σ ρ at the step's σ falls.  The rows of an observation share a
    weight; `seed` fixes the search of the S-estimate.

    Whitening by a covariance that couples observations (deflections that share an unloaded
    reading) mixes them: a bad reading then also shows in those whitened after it.

    Raises InputError for an unknown loss, a problem with ties or bounds, or dependent columns;
    ElastocalError where the start has poses without equilibrium.
    """
    require(
        loss_name in get_args(LossName),
        f"the loss is one of {', '.join(get_args(LossName))}; found '{loss_name}'",
    )
    require(
        problem.tie is None and not problem.bounded,
        "a robust fit takes neither ties nor bounds: fit the reduced set of parameters, unbounded",
    )
    model, observed, columns = problem.model, problem.observations, problem.columns
    sizes = problem.sizes[columns]
    x, converged, steps = problem.x.copy(), False, 0

    def linearised(x: Array) -> tuple[Array, Array, Array]:
        at = model.regressor(observed.table, x, columns, observed)
        return problem.weights.apply(at.B), problem.weights.apply(at.residual), at.residual

    B, e, raw = linearised(x)
    while True:
        found = _step(B * sizes, e, loss_name, observed.size, seed, steps < SEARCHES)
        moved = float(np.linalg.norm(B @ (found.x * sizes)))
        converged = moved <= SETTLED * found.scale * np.sqrt(len(columns))
        if converged or steps == MAX_STEPS:
            break
        share = _damping(problem, x, found, sizes, e)
        if share == 0.0:
            break
        x[columns] += share * found.x * sizes
        B, e, raw = linearised(x)
        steps += 1
    linear = _step(B, e, loss_name, observed.size, seed, False)
    return RobustFit(x, raw, e, linear, converged, steps)


def _step(
    B: Array, e: Array, loss_name: LossName, size: int, seed: int, search: bool
) -> RobustEstimate:
    if loss_name == "huber":
        return m_estimate(B, e, huber(size), size=size)
    if loss_name == "l1":
        return m_estimate(B, e, Absolute(size), size=size)
    if loss_name == "student-t":
        return student_t(B, e, size=size)
    subsets = SUBSETS if search else 0
    return mm_estimate(B, e, size=size, seed=seed, subsets=subsets, start=np.zeros(B.shape[1]))


def _damping(problem: FitProblem, x: Array, found: RobustEstimate, sizes: Array, e: Array) -> float:
    """Largest of 1, ½, ¼, … of the step that lowers Σ ρ at its scale; 0 where none does."""
    size, observed = found.design.size, problem.observations
    before = float(found.loss.rho(lengths(e, size) / found.scale).sum())
    rounding = 1e-12 * before
    for k in range(20):
        share = 0.5**k
        trial = x.copy()
        trial[problem.columns] += share * found.x * sizes
        try:
            residual = observed.value - problem.model.predict(observed.table, trial, observed)
        except ElastocalError:
            continue
        d = lengths(problem.weights.apply(residual), size) / found.scale
        if np.isfinite(d).all() and float(found.loss.rho(d).sum()) <= before + rounding:
            return share
    return 0.0
