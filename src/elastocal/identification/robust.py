"""Robust fits by name, by reweighting.

An observation of `size` whitened rows (x, y, z of a tracker reading) is right or wrong as a whole:
Huber's loss sees the length d = |e_i|/σ of its scaled residual, and its rows share one weight ψ/d,

    ρ(d) = d²/2 up to c, c d − c²/2 beyond,    ψ = ρ′ = min(d, c)        (Huber 1964)

    huber   c of 95 % efficiency
    l1      c near 0, the least sum of Euclidean lengths

The weights solve Σ B_iᵀ Ψ(e_i/σ) = 0, Ψ(r) = ψ(|r|) r/|r|; they are no inverse variances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse, special

from elastocal.errors import ElastocalError, InputError, InsufficientDataError
from elastocal.identification.covariance import Covariance, cluster_robust, orthogonal
from elastocal.identification.least_squares import Problem
from elastocal.identification.options import LEVEL, Intervals, MethodResult
from elastocal.identification.outliers import median_scale
from elastocal.identification.residuals import held_out_residual
from elastocal.identification.solve import Solution
from elastocal.units import Array, BoolArray, IntArray

# c of Huber's loss by the rows of an observation, 1 to 6: 95 % efficient.  Under normal noise d
# follows χ(size), and with J = ∂Ψ/∂r symmetry gives E J = a·I and E ΨΨᵀ = b·I,
#
#     a = E[ψ′/size + (1 − 1/size) ψ(d)/d],    b = E ψ²/size,    efficiency a²/b
#
# (Huber 1981, section 7.6, for size 1; Maronna 1976 for vectors), found by quadrature.

HUBER = (1.344997509, 1.501141084, 1.627987920, 1.731072513, 1.812018420, 1.869337729)
L1 = 1e-4  # far below any standard deviation
TOLERANCE = 1e-11  # of the step |B δx| in units of the scale
MAX_ITER = 5000


@dataclass(frozen=True)
class RobustEstimate:
    """x = V z (p,) of y (rows,) ≈ B x, B x = Q z with orthonormal Q, so that the parameters' units
    do not matter; residual (rows,), scale σ, and c of the loss."""

    Q: Array
    V: Array
    residual: Array
    size: int
    c: float
    z: Array
    scale: float
    converged: bool

    @property
    def x(self) -> Array:
        return self.V @ self.z

    @property
    def distance(self) -> Array:
        """|e_i|/σ (n,)."""
        return lengths(self.residual, self.size) / self.scale

    def rho(self, d: Array) -> float:
        """Σ ρ."""
        return float(np.where(d <= self.c, d**2 / 2, self.c * (d - self.c / 2)).sum())

    @property
    def weights(self) -> Array:
        """ψ(d)/d (n,)."""
        return weights_of(self.distance, self.c)

    @property
    def smooth_c(self) -> float:
        """c of a loss that is as good and has a curvature to be estimated.

        ψ of l1 jumps at zero: a share of the residuals there tells its slope, that of Hall and
        Sheather's bandwidth, without the p residuals that the fit makes zero (Koenker 2005, section
        3.4).
        """
        kept = np.sort(self.distance)[len(self.z) // self.size :]
        h = len(kept) ** (-1 / 3) * special.ndtri(0.975) ** (2 / 3) * (1.5 / (2 * np.pi)) ** (1 / 3)
        return max(self.c, float(np.quantile(kept, min(2 * h, 0.98)))) if self.c == L1 else self.c


def lengths(residual: Array, size: int) -> Array:
    """|e_i| (n,) of each observation."""
    return np.linalg.norm(residual.reshape(-1, size), axis=1)


def weights_of(d: Array, c: float) -> Array:
    return c / np.maximum(d, c)


def huber(B: Array, y: Array, size: int, c: float | None = None) -> RobustEstimate:
    """M-estimate of y (n·size,) ≈ B x, from least squares on, σ the MAD about zero of every
    residual anew (Huber 1981, section 7.8), no less than rounding of y lets it be; by default of
    95 % efficiency.

    It has one solution, and resists errors in y but not at leverage points.
    """
    factors, c = orthogonal(B), HUBER[size - 1] if c is None else c
    Q, z, converged = factors.Q, factors.Q.T @ y, False
    floor = float(np.finfo(float).eps * np.sqrt(np.mean(y**2)) + np.finfo(float).tiny)
    r = y - Q @ z
    scale = max(median_scale(lengths(r, size), size), floor)
    for _ in range(MAX_ITER):
        weighted = Q.T * np.repeat(weights_of(lengths(r, size) / scale, c), size)
        step = linalg.solve(weighted @ Q, weighted @ r, assume_a="pos")
        z, before = z + step, scale
        r = y - Q @ z
        scale = max(median_scale(lengths(r, size), size), floor)
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)  # no more digits in z
        same = abs(scale - before) <= TOLERANCE * scale
        if converged := bool((moved <= TOLERANCE * scale or still) and same):
            break
    return RobustEstimate(Q, factors.V, r, size, c, z, scale, converged)


def least_absolute(B: Array, y: Array, size: int) -> RobustEstimate:
    return huber(B, y, size, L1)


# Covariance of an M-estimate: from ψ and ψ′, never from the weights of its iteration.
#
# With r_i = e_i/σ and u = r/|r| the derivative of an observation's score is
#
#     J_i = ∂Ψ/∂r = ψ′(d_i) u uᵀ + (ψ(d_i)/d_i)(I − u uᵀ),      d_i = |r_i|,
#
# eigenvalue ψ′ along the error and ψ/d across it (size − 1 times; for size 1 only ψ′).  For errors
# that are symmetric in direction E J = a I, E ΨΨᵀ = b I, and expanding Σ B_iᵀ Ψ(e_i/σ) = 0 gives
#
#     x̂ − x ≈ (BᵀB)⁻¹ Bᵀ (σ/a) Ψ,    cov x̂ = σ² (b/a²) (BᵀB)⁻¹
#
# (Huber 1981, sections 7.6 and 7.10, per row; Maronna 1976): that of least squares whose residuals
# are (σ/a) Ψ.  The weights ψ/d as inverse variances would be wrong: a weight is small because that
# residual came out large, not because its variance was known to be.


def covariance_of(found: RobustEstimate, B: Array, cluster: IntArray | None = None) -> Covariance:
    """Covariance (p, p) of x̂ of y ≈ B x.

    Of independent readings Huber's H1, k² σ² (b̂/â²) (BᵀB)⁻¹, with b̂ = Σψ²/(n·size − p) and his
    small-sample factor k = 1 + (p/(n·size)) Var(eigenvalues)/â²; t intervals with rows less p as
    dof.  Under any dependence within a `cluster` (n,), such as a configuration, CR3 of (σ/a) Ψ.

    Raises InsufficientDataError where nearly all readings lie far from the fit, or a cluster alone
    determines a combination of the parameters.
    """
    rows, p, size, d = len(found.residual), len(found.z), found.size, found.distance
    c = found.smooth_c
    along, across, psi = (d <= c).astype(float), weights_of(d, c), np.minimum(d, c)
    a = float(np.mean(along + (size - 1) * across)) / size
    if not a > 0:
        raise InsufficientDataError(
            "so many readings lie far from the fit that its covariance cannot be determined; use "
            "the default method, or look for the cause of the outliers"
        )
    if cluster is not None:
        pseudo = np.repeat(across, size) * found.residual / a
        return cluster_robust(B, pseudo, np.repeat(cluster, size), "CR3")
    square = float((along**2).sum() + (size - 1) * (across**2).sum()) / rows
    k = 1 + p / rows * (square - a**2) / a**2
    variance = (k * found.scale / a) ** 2 * float(psi @ psi) / (rows - p)
    name = "l1" if found.c == L1 else "huber"
    text = f"asymptotic covariance H1 of the {name} estimate, from ψ and ψ′"
    return Covariance("H1", variance * found.V @ found.V.T, np.full(p, float(rows - p)), text)


# Robust fit of the nonlinear model: linear robust steps on the exact B.

METHODS = {"huber": huber, "l1": least_absolute}
SETTLED = 1e-5  # |B δx| in units of the scale at which the steps have converged
MOST_MOVES = 40


def robust_result(
    method: str, every: Solution, sound: Solution, good: BoolArray, intervals: str
) -> MethodResult:
    """The robust fit of all readings in the parameters that the `good` ones (N,) determine.

    Minimises Σ ρ(|W (y − h(X))_i|/σ) over X[kept] by damped Gauss–Newton steps: each is the robust
    linear fit of the whitened residual to the whitened B at X, halved until Σ ρ at its σ falls.

    Whitening by a covariance that couples observations (deflections that share an unloaded
    reading) mixes them: a bad reading then also shows in those whitened after it.

    Raises InputError for a large table, other intervals and dependent columns, ElastocalError where
    the start has poses without equilibrium.
    """
    problem, kept, x, steps = every.problem, sound.reduction.kept, sound.fit.x.copy(), 0
    if problem.large:
        raise InputError(
            f"the method {method} takes no table of this size; use the default "
            "method, which excludes outliers"
        )
    if intervals not in ("auto", "cr3"):
        raise InputError(
            f"the method {method} has intervals of its own: 'auto' for independent readings, "
            "'cr3' where readings of a configuration depend on each other"
        )
    observed, weights = problem.observations, problem.weights
    while True:
        at = problem.model.regressor(observed.table, x, kept, observed)
        B, e = weights.apply(at.B), weights.apply(at.residual)
        found = METHODS[method](B, e, observed.size)
        converged = bool(np.linalg.norm(found.z) <= SETTLED * found.scale * np.sqrt(len(kept)))
        share = 0.0 if converged or steps == MOST_MOVES else _damping(problem, x, kept, e, found)
        if share == 0.0:
            break
        x[kept] += share * found.x
        steps += 1
    fit = replace(
        sound.fit, x=x, residual=at.residual, whitened=e, converged=converged, steps=steps,
        problem=problem, columns=kept, sizes=sound.sizes,
        reason=sound.fit.reason if converged else "the robust steps did not settle",
    )  # fmt: skip
    # Only for predicting left-out configurations do ψ(d)/d stand in as weights.
    root = np.sqrt(np.repeat(np.minimum(found.weights, 1e6), observed.size))
    whiten = sparse.csr_array(sparse.diags_array(root))
    if weights.whiten is not None:
        whiten = sparse.csr_array(whiten @ weights.whiten)
    heldout = held_out_residual(
        fit.B, at.residual, replace(weights, whiten=whiten), observed.configuration, observed.size
    )
    problem = replace(problem, x0=sound.problem.x0)
    solution = replace(sound, problem=problem, fit=fit, held=heldout)
    cluster = None if intervals == "auto" else observed.configuration
    covariance = covariance_of(found, B, cluster)
    ends = covariance.interval(x[kept], LEVEL)
    return MethodResult(method, solution, Intervals(covariance, ends), None, good)


def _damping(
    problem: Problem, x: Array, kept: IntArray, e: Array, found: RobustEstimate
) -> float:  # fmt: skip
    """Largest of 1, ½, ¼, … of the step that lowers Σ ρ at its scale; 0 where none does."""
    size, observed = found.size, problem.observations
    before = found.rho(lengths(e, size) / found.scale)
    for share in 0.5 ** np.arange(20):
        trial = x.copy()
        trial[kept] += share * found.x
        try:
            residual = observed.value - problem.model.predict(observed.table, trial, observed)
        except ElastocalError:
            continue
        d = lengths(problem.weights.apply(residual), size) / found.scale
        if np.isfinite(d).all() and found.rho(d) <= before * (1 + 1e-12):
            return float(share)
    return 0.0
