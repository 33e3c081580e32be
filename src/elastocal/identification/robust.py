"""Robust fits: losses of a reading's whole length, by reweighting; L1 as a cone program."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, special

from elastocal.errors import ElastocalError, InsufficientDataError, require
from elastocal.identification.covariance import Covariance, SatterthwaiteSums, orthogonal
from elastocal.identification.least_squares import FitProblem
from elastocal.identification.trimmed import median_scale, trimmed_fit
from elastocal.units import Array, BoolArray, IntArray

# The linear model of every robust fit, in the coordinates of an orthonormal basis of B.


@dataclass(frozen=True)
class Design:
    """y (rows,) ≈ B (rows, p) x in n observations of `size` consecutive whitened rows.

    Solvers work with z = V⁻¹ x, where B x = Q z and Q (rows, p) is orthonormal: the units of the
    parameters and their scaling cannot matter.
    """

    y: Array
    size: int
    Q: Array
    V: Array

    @property
    def n(self) -> int:
        return len(self.y) // self.size

    @property
    def p(self) -> int:
        return self.Q.shape[1]

    @property
    def floor(self) -> float:
        """Smallest scale that rounding of y lets a residual have."""
        return float(np.finfo(float).eps * np.sqrt(np.mean(self.y**2)) + np.finfo(float).tiny)

    def rows(self, values: NDArray[Any]) -> NDArray[Any]:
        """What observations (n,) have, repeated for their rows (rows,)."""
        return np.repeat(values, self.size)

    def scale_of(self, length: Array) -> float:
        """The median's scale of residuals of `length` (n,)."""
        return max(median_scale(length, self.size), self.floor)


def design(B: Array, y: Array, size: int) -> Design:
    """B (n·size, p) and y (n·size,) in those coordinates; raises as `orthogonal`."""
    factors = orthogonal(B)
    return Design(y, size, factors.Q, factors.V)


def lengths(residual: Array, size: int) -> Array:
    """|e_i| (n,) of each observation; for size 1 its absolute value."""
    return np.abs(residual) if size == 1 else np.linalg.norm(residual.reshape(-1, size), axis=1)


# Losses ρ(d) of the length d = |e_i|/σ of an observation's scaled residual.
#
# An observation of `size` whitened rows (x, y, z of a tracker reading) is right or wrong as a
# whole: the loss sees its Mahalanobis length, and its rows share one weight.  For size 1 the
# length is |r| and these are the usual losses per row.


@dataclass(frozen=True)
class Loss:
    """ρ with ρ(0) = 0, `weight` ψ(d)/d with ψ = ρ′, and `slope` ψ′, elementwise of lengths d ≥ 0.

    The weight solves ψ's estimating equation; it is not an inverse variance.  `constant` is c, or ν
    of Student's t.
    """

    name: str
    size: int
    rho: Callable[[Array], Array]
    weight: Callable[[Array], Array]
    slope: Callable[[Array], Array]
    constant: float = np.inf

    def psi(self, d: Array) -> Array:
        return d * self.weight(d)


# Tuning constants by the rows of an observation, 1 to 6.
#
# Under normal noise the scaled length d follows χ(size).  With r = e/σ, Ψ(r) = ψ(|r|) r/|r| and
# J = ∂Ψ/∂r, symmetry gives E J = a·I and E ΨΨᵀ = b·I with
#
#     a = E[ψ′/size + (1 − 1/size) ψ(d)/d],    b = E ψ²/size
#
# and the efficiency a²/b (Huber 1981, section 7.6, for size 1; Maronna 1976 for vectors).  The
# constants of HUBER and TUKEY solve a²/b = 0.95, those of HALF solve E ρ = sup ρ/2, which gives an
# M-scale the breakdown point of one half (Rousseeuw and Yohai 1984): found by quadrature of the
# density of χ(size), to ten digits.  For size 1 they are the well-known 1.345, 4.685 and 1.548.

HUBER = (1.344997509, 1.501141084, 1.627987920, 1.731072513, 1.812018420, 1.869337729)
TUKEY = (4.685064949, 5.122986090, 5.490249208, 5.810315587, 6.096266469, 6.356216290)
HALF = (1.547644981, 2.660803393, 3.452881651, 4.096562166, 4.652023341, 5.147685250)


def huber(size: int = 1, c: float | None = None) -> Loss:
    """ρ = d²/2 up to c, c d − c²/2 beyond (Huber 1964); by default of 95 % efficiency."""
    c = HUBER[size - 1] if c is None else c
    return Loss(
        "huber", size,
        lambda d: np.where(d <= c, d**2 / 2, c * (d - c / 2)),
        lambda d: c / np.maximum(d, c),
        lambda d: (d <= c).astype(float), c,
    )  # fmt: skip


def bisquare(size: int = 1, c: float | None = None) -> Loss:
    """Tukey's ρ = c²/6 (1 − (1 − (d/c)²)³) up to c, c²/6 beyond (Beaton and Tukey 1974)."""
    c = TUKEY[size - 1] if c is None else c

    def inside(d: Array) -> Array:
        return np.maximum(1 - (d / c) ** 2, 0.0)

    return Loss(
        "tukey", size,
        lambda d: c**2 / 6 * (1 - inside(d) ** 3),
        lambda d: inside(d) ** 2,
        lambda d: inside(d) * (5 * inside(d) - 4), c,  # (1 − u²)(1 − 5u²), u = d/c
    )  # fmt: skip


def absolute(size: int = 1) -> Loss:
    """ρ = d: least absolute values, or the least sum of Euclidean lengths for size > 1."""
    return Loss(
        "l1", size, lambda d: d, lambda d: 1 / np.maximum(d, np.finfo(float).tiny), np.zeros_like
    )


def t_loss(size: int, nu: float) -> Loss:
    """−log density of the multivariate t: ρ = (ν + size)/2 · log(1 + d²/ν)."""
    return Loss(
        "student-t", size,
        lambda d: (nu + size) / 2 * np.log1p(d**2 / nu),
        lambda d: (nu + size) / (nu + d**2),
        lambda d: (nu + size) * (nu - d**2) / (nu + d**2) ** 2, nu,
    )  # fmt: skip


# Linear fits.


@dataclass(frozen=True)
class RobustEstimate:
    """x (p,) with Σ B_iᵀ Ψ(e_i/σ) = 0, its residual (rows,), scale σ and the loss.

    `weights` (n,) are ψ(d)/d of each observation, 1 for what counts in full and 0 for what is
    rejected (unbounded where an L1 fit meets an observation).  They are NOT inverse variances; for
    the covariance see `asymptotic_covariance`.
    """

    design: Design
    loss: Loss
    z: Array
    residual: Array
    scale: float
    converged: bool

    @property
    def x(self) -> Array:
        return self.design.V @ self.z

    @property
    def distance(self) -> Array:
        """|e_i|/σ (n,)."""
        return lengths(self.residual, self.design.size) / self.scale

    @property
    def weights(self) -> Array:
        return self.loss.weight(self.distance)


TOLERANCE = 1e-11  # of the step |B δx| in units of the scale
MAX_ITER = 2000
# The scale by lengths and weights (n,) and the scale so far.
Rescaled = Callable[[Array, Array, float], float]


def reweighted(
    problem: Design, loss: Loss, z: Array, scale: float, rescaled: Rescaled | None = None
) -> RobustEstimate:
    """Least squares reweighted by ψ(d)/d from z on; each step lowers Σ ρ at its scale (Huber 1981,
    section 7.8).  The `scale` is held, or `rescaled` says it anew after each step.

    Raises InsufficientDataError where the observations that keep a weight do not determine
    every parameter.
    """
    Q, size = problem.Q, problem.size
    r, converged = problem.y - Q @ z, False
    for _ in range(MAX_ITER):
        weights = loss.weight(lengths(r, size) / scale)
        weighted = Q.T * problem.rows(weights)
        try:
            factor = linalg.cho_factor(weighted @ Q, check_finite=False)
        except linalg.LinAlgError:
            raise InsufficientDataError(
                "the observations that the loss does not reject do not determine all parameters; "
                "measure more, or fit fewer parameters"
            ) from None
        step = linalg.cho_solve(factor, weighted @ r, check_finite=False)
        z, before = z + step, scale
        r = problem.y - Q @ z
        if rescaled is not None:
            scale = max(rescaled(lengths(r, size), weights, scale), problem.floor)
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)  # no more digits in z
        same = abs(scale - before) <= TOLERANCE * scale
        converged = bool((moved <= TOLERANCE * scale or still) and same)
        if converged:
            break
    return RobustEstimate(problem, loss, z, r, scale, converged)


def m_estimate(problem: Design, loss: Loss) -> RobustEstimate:
    """Solve Σ B_iᵀ Ψ(e_i/σ) = 0, e = y − B x, Ψ(r) = ψ(|r|) r/|r| (Huber 1981, chapter 7).

    σ is the MAD about zero of every residual anew; the start is least squares.  A monotone ψ has
    one solution and resists errors in y but not at leverage points; a redescending one finds the
    solution near the start, so bisquare belongs after a fit of the majority (`tukey`).
    """
    return reweighted(problem, loss, *_start(problem), lambda d, *_: problem.scale_of(d))


def _start(problem: Design) -> tuple[Array, float]:
    """Least squares, and the median's scale there."""
    z = problem.Q.T @ problem.y
    return z, problem.scale_of(lengths(problem.y - problem.Q @ z, problem.size))


def tukey(problem: Design, start: Array | None = None, seed: int = 0) -> RobustEstimate:
    """Tukey's bisquare with 95 % efficiency, reweighted from the fit of the majority.

    The start is z = `start` (p,), or the least trimmed squares of random subsets: then almost half
    of the observations, leverage points among them, may be wrong.  The bisquare of `HALF` makes the
    scale as small as it gets nearby, with Σ ρ(|e_i|/σ) = (n − p/size) sup ρ/2, and that of 95 %
    descends from there at this scale (Yohai 1987; for p/size Maronna and Yohai 2010).
    """
    size, c = problem.size, HALF[problem.size - 1]
    half, target = bisquare(size, c), c**2 / 12 * (problem.n - problem.p / size)
    z = trimmed_fit(problem.Q, problem.y, size, seed) if start is None else start
    scale = problem.scale_of(lengths(problem.y - problem.Q @ z, size))

    def rescaled(length: Array, _: Array, scale: float) -> float:
        return scale * float(np.sqrt(half.rho(length / scale).sum() / target))

    found = reweighted(problem, half, z, scale, rescaled)
    return reweighted(problem, bisquare(size), found.z, found.scale)


NU_RANGE = (1.0, 200.0)  # below 1 the likelihood may be unbounded; at 200 the t is normal


def student_t(problem: Design, nu: float | None = None) -> RobustEstimate:
    """ML of y_i = B_i x + e_i, e_i ~ t_ν(0, σ² I) of `size` components per observation.

    EM in the parameter-expanded form, which has the same fixed points and is faster (Kent, Tyler
    and Vardi 1994; Meng and van Dyk 1997):

        w_i = (ν + size)/(ν + |e_i|²/σ²),    Σ w_i B_iᵀ(y_i − B_i x) = 0,
        σ² = Σ w_i |e_i|²/(size Σ w_i)

    `nu` None maximises the profile likelihood over 1 ≤ ν ≤ 200.  σ is the scale of the t, not a
    standard deviation (which is σ √(ν/(ν−2))).  The start is least squares with the median's
    scale; for small ν with outliers at leverage points the likelihood has other maxima.
    """
    n, size, state = problem.n, problem.size, _start(problem)

    def estimate(nu: float) -> RobustEstimate:
        return reweighted(
            problem, t_loss(size, nu), *state,
            lambda length, w, _: float(np.sqrt(w @ length**2 / (size * w.sum()))),
        )  # fmt: skip

    def cost(log_nu: float) -> float:
        nonlocal state
        nu = float(np.exp(log_nu))
        found = estimate(nu)
        state = found.z, found.scale
        constant = special.gammaln(nu / 2) - special.gammaln((nu + size) / 2)
        constant += size * (np.log(nu) / 2 + np.log(found.scale))
        return float(n * constant + found.loss.rho(found.distance).sum())

    if nu is None:
        require(n > problem.p, "estimating ν needs more observations than parameters")
        options = {"xatol": 1e-7}
        best = optimize.minimize_scalar(
            cost, bounds=np.log(NU_RANGE), method="bounded", options=options
        )
        nu = float(np.exp(best.x))
    return estimate(nu)


OPTIMAL = 5e-6  # relative duality gap that counts as solved
ACCURATE = 1e-12  # asked of the cone solver, which ends where rounding allows no more


def least_absolute(problem: Design) -> RobustEstimate:
    """Minimise Σ |e_i|, from least squares on in units of its residual.

    The median's scale is only reported: x does not depend on it.
    """
    import cvxpy as cp

    z = problem.Q.T @ problem.y
    first = problem.y - problem.Q @ z
    unit = max(float(np.abs(first).mean()), problem.floor)
    dz, e = cp.Variable(problem.p), cp.Variable((problem.n, problem.size))
    left = cp.reshape(first / unit - problem.Q @ dz, e.shape, order="C")
    total = cp.sum(cp.abs(e)) if problem.size == 1 else cp.sum(cp.norm(e, 2, axis=1))
    solved = cp.Problem(cp.Minimize(total), [e == left])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the accuracy, which the gap tells
        solved.solve(
            solver=cp.CLARABEL, accept_unknown=True,
            tol_gap_abs=ACCURATE, tol_gap_rel=ACCURATE, tol_feas=ACCURATE,
        )  # fmt: skip
    z = z + unit * np.asarray(dz.value)
    r = problem.y - problem.Q @ z
    # Any λ with Qᵀλ = 0 and |λ_i| ≤ 1 bounds the minimum from below by Σ y_iᵀλ_i.
    bound = abs(float(first @ np.ravel(solved.constraints[0].dual_value))) / unit
    least = float(total.value)
    converged = abs(least - bound) <= OPTIMAL * max(least, OPTIMAL)
    scale = problem.scale_of(lengths(r, problem.size))
    return RobustEstimate(problem, absolute(problem.size), z, r, scale, bool(converged))


# Robust fit of the nonlinear model: linear robust steps on the exact B.

LossName = Literal["huber", "tukey", "l1", "student-t"]

SETTLED = 1e-5  # |B δx| in units of the scale at which the steps have converged
MOST_MOVES = 40


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
    (95 % efficient, σ by the median), "tukey", "l1", or "student-t" (ML, ν estimated); it is
    halved until Σ ρ at the step's σ falls.  The rows of an observation share a weight; `seed` is
    that of the trimmed squares with which tukey begins.

    Whitening by a covariance that couples observations (deflections that share an unloaded
    reading) mixes them: a bad reading then also shows in those whitened after it.

    Raises InputError for dependent columns; ElastocalError where the start has poses without
    equilibrium.
    """
    observed, columns, whiten = problem.observations, problem.columns, problem.weights.apply
    x, steps = problem.x.copy(), 0
    while True:
        at = problem.model.regressor(observed.table, x, columns, observed)
        B, e = whiten(at.B), whiten(at.residual)
        linear = design(B, e, observed.size)
        found = _linear_fit(linear, loss_name, None if steps == 0 else np.zeros(linear.p), seed)
        moved = float(np.linalg.norm(found.z))
        converged = moved <= SETTLED * found.scale * np.sqrt(len(columns))
        share = 0.0 if converged or steps == MOST_MOVES else _damping(problem, x, found)
        if share == 0.0:
            return RobustFit(x, at.residual, e, found, converged, steps)
        x[columns] += share * found.x
        steps += 1


def _linear_fit(
    problem: Design, loss_name: LossName, start: Array | None, seed: int
) -> RobustEstimate:
    if loss_name == "tukey":
        return tukey(problem, start, seed)
    if loss_name == "huber":
        return m_estimate(problem, huber(problem.size))
    return student_t(problem) if loss_name == "student-t" else least_absolute(problem)


def _damping(problem: FitProblem, x: Array, found: RobustEstimate) -> float:
    """Largest of 1, ½, ¼, … of the step that lowers Σ ρ at its scale; 0 where none does."""
    size, observed, columns = found.design.size, problem.observations, problem.columns
    before = float(found.loss.rho(lengths(found.design.y, size) / found.scale).sum())
    for share in 0.5 ** np.arange(20):
        trial = x.copy()
        trial[columns] += share * found.x
        try:
            residual = observed.value - problem.model.predict(observed.table, trial, observed)
        except ElastocalError:
            continue
        d = lengths(problem.weights.apply(residual), size) / found.scale
        if np.isfinite(d).all() and found.loss.rho(d).sum() <= before * (1 + 1e-12):
            return float(share)
    return 0.0


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
# The weights ψ/d as inverse variances would be wrong: a weight is small because that residual came
# out large, not because its variance was known to be.

UNDETERMINED = (
    "the loss rejects so many observations that the rest do not determine the parameters' "
    "covariance; use a monotone loss such as huber, or look for the cause of the outliers"
)
EXACT = 1e-8  # scaled length below which an L1 fit passes through an observation


def asymptotic_covariance(found: RobustEstimate) -> Covariance:
    """Covariance (p, p) of x̂; t intervals with the rows that keep a weight less p as dof.

    Huber's H2, k σ² (b̂/â) W⁻¹, with â the mean eigenvalue of J_i, b̂ = Σψ²/(n·size − p), and his
    small-sample factor k = 1 + (p/(n·size)) Var(eigenvalues)/â² (k = 1 for L1).  Unlike his H1 and
    H3 it leaves wrong observations at leverage points out of b̂/â and of W alike.  Under dependence
    or unequal spread use `clustered_covariance`.

    Raises InsufficientDataError where W is not positive definite.
    """
    problem, (along, across) = found.design, _curvature(found)
    rows, p, size = len(problem.y), problem.p, problem.size
    a = float(np.mean(along + (size - 1) * across)) / size
    if not a > 0:
        raise InsufficientDataError(UNDETERMINED)
    b = float((found.loss.psi(found.distance) ** 2).sum()) / (rows - p)
    k = 1.0
    if found.loss.name != "l1":
        square = float((along**2).sum() + (size - 1) * (across**2).sum()) / rows
        k = 1 + p / rows * (square - a**2) / a**2
    W = _information(found, np.zeros(problem.n, dtype=np.int64))[0]
    matrix = problem.V @ (k * found.scale**2 * b / a * _inverse_of(W)) @ problem.V.T
    dof = float(size * np.count_nonzero(found.weights) - p)
    text = f"asymptotic covariance H2 of the {found.loss.name} estimate, from ψ and ψ′"
    return Covariance("H2", matrix, np.full(p, dof), text)


def clustered_covariance(found: RobustEstimate, cluster: IntArray) -> Covariance:
    """Covariance (p, p) of x̂ under any dependence within clusters, with t dofs (p,).

    `cluster` (n,) integer label of each observation, such as its configuration.  Leaving cluster
    g out moves x̂ by δ_g = σ (W − W_g)⁻¹ s_g to first order, with the scores s_g = Σ_{i∈g} B_iᵀΨ_i
    and W_g = Σ_{i∈g} B_iᵀ J_i B_i; the jackknife of these (CR3 of Bell and McCaffrey 2002 for the
    M-estimate's score),

        cov x̂ = (G − 1)/G Σ_g δ_g δ_gᵀ,

    needs no model of the dependence, and dividing by W − W_g undoes that a fit follows its own
    clusters.  dof are Satterthwaite's under independence, (tr T)²/tr T² with the quadratic form
    T of each parameter: few clusters, or few that see a parameter, have few.

    Raises InputError for a single cluster, InsufficientDataError where without one cluster the
    others do not determine every parameter.
    """
    problem, (names, code) = found.design, np.unique(cluster, return_inverse=True)
    require(len(names) > 1, "a clustered covariance needs at least two clusters; found one")
    W_g = _information(found, code)
    W = W_g.sum(axis=0)
    inverse, rest = _inverse_of(W), W - W_g
    alone = np.linalg.eigvalsh(rest)[:, 0] <= 1e-9 * np.linalg.eigvalsh(W)[-1]
    if alone.any():
        raise InsufficientDataError(
            f"without cluster {names[alone][0]} the others do not determine every parameter, so "
            "its scatter cannot be judged; measure more such configurations or fit fewer parameters"
        )
    scores = np.zeros((len(names), problem.p))
    psi = (problem.rows(found.weights) * found.residual / found.scale)[:, None] * problem.Q
    np.add.at(scores, problem.rows(code), psi)
    shift = found.scale * np.linalg.solve(rest, scores[..., None])[..., 0] @ problem.V.T
    matrix = (len(names) - 1) / len(names) * shift.T @ shift
    # T = diag(own) − K with K_gh = m_gᵀ W⁻¹ m_h, never formed: there may be thousands of clusters.
    reach = np.linalg.solve(rest, np.broadcast_to(problem.V.T, rest.shape))  # by parameter
    m, sums = W_g @ reach, SatterthwaiteSums(problem.p)
    sums.add(np.einsum("gij,gij->gj", reach, m), linalg.cholesky(inverse) @ m)
    text = f"jackknife of the {found.loss.name} scores over {len(names)} clusters"
    return Covariance("clustered", matrix, sums.dof(), text)


def _curvature(found: RobustEstimate) -> tuple[Array, Array]:
    """Eigenvalues of every J_i: ψ′ along the error (n,) and ψ/d across it (n,).

    ψ of L1 jumps at zero: for size 1 ψ′ = 2 f(0) is estimated from the density of the residuals
    there, by the Siddiqui quotient with Hall and Sheather's bandwidth, without the p residuals that
    the fit makes zero (Koenker 2005, section 3.4); for vectors ψ′ = 0 and ψ/d = 1/d suffice,
    without observations that are met exactly.
    """
    d, loss = found.distance, found.loss
    if loss.name != "l1":
        return loss.slope(d), loss.weight(d)
    if loss.size > 1:
        return np.zeros_like(d), np.divide(1, d, out=np.zeros_like(d), where=d >= EXACT)
    kept = np.sort((found.residual / found.scale)[np.argsort(d)[found.design.p :]])
    h = len(kept) ** (-1 / 3) * special.ndtri(0.975) ** (2 / 3)
    h = min(h * (1.5 / (2 * np.pi)) ** (1 / 3), 0.49)
    low, high = np.quantile(kept, [0.5 - h, 0.5 + h])
    level = np.full_like(d, 4 * h / max(high - low, np.finfo(float).tiny))
    return level, level


def _information(found: RobustEstimate, code: IntArray) -> Array:
    """Σ Q_iᵀ J_i Q_i (groups, p, p) per group `code` (n,) of the observations."""
    problem, (along, across) = found.design, _curvature(found)
    Q = problem.Q.reshape(problem.n, problem.size, problem.p)
    r = found.residual.reshape(problem.n, problem.size)
    u = r / np.maximum(np.linalg.norm(r, axis=1), np.finfo(float).tiny)[:, None]
    toward = np.einsum("nij,ni->nj", Q, u)

    def of(chosen: BoolArray) -> Array:
        rows, own = Q[chosen].reshape(-1, problem.p), toward[chosen]
        within = (rows.T * problem.rows(across[chosen])) @ rows
        return np.asarray(within + (own.T * (along - across)[chosen]) @ own)

    return np.array([of(code == g) for g in range(code.max() + 1)])


def _inverse_of(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix; raises where the data left after rejection
    make it none."""
    try:
        return np.asarray(linalg.cho_solve(linalg.cho_factor(matrix), np.eye(len(matrix))))
    except linalg.LinAlgError:
        raise InsufficientDataError(UNDETERMINED) from None
