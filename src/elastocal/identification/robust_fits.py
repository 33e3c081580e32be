"""Robust linear fits: least absolute values, S, M and MM estimates, Student's t."""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize, special

from elastocal.errors import ElastocalError, InputError, InsufficientDataError, require
from elastocal.identification.robust_core import (
    Absolute,
    Bisquare,
    Design,
    Loss,
    RobustEstimate,
    StudentT,
    bisquare,
    breakdown_bisquare,
    design,
    estimate_at,
    expected_rho,
    lengths,
    m_scale,
    median_length,
    median_scale,
)
from elastocal.units import Array

# Least absolute values, and the least sum of Euclidean lengths, with a certificate.
#
#     minimise  Σ |e_i|,  e = y − B x         dual:  maximise Σ y_iᵀ λ_i,  Bᵀ λ = 0,  |λ_i| ≤ 1
#
# Any feasible λ bounds the minimum from below, so the gap Σ|e_i| − yᵀλ proves how good x is.
# For size 1 the dual is a linear program in n bounded variables with p equations.  For vectors it
# is a second-order cone program, solved by smoothing: at the minimum of Σ s_i, s_i = √(|e_i|² +
# ε²), λ_i = e_i/s_i is feasible and the gap at most n ε; ε falls to rounding.  Newton's method
# solves for x and λ in s_i λ_i = e_i together (Chan, Golub and Mulet 1999), which unlike Newton
# for x alone is not slowed down where observations are met exactly.

OPTIMAL = 5e-6  # relative duality gap that counts as solved
ENOUGH = 1e-9  # gap at which to stop; met exactly by many observations, rounding may forbid it
SMOOTHING = 1e-9  # last ε in units of the scale
MAX_NEWTON = 400


def least_absolute(problem: Design, loss: Absolute) -> RobustEstimate:
    """Minimise the sum of |e_i|; `optimality` is the duality gap over the minimum.

    The median's scale is only reported: x does not depend on it.
    """
    z, dual, count = _linear_program(problem) if problem.size == 1 else _newton(problem)
    r = problem.residual(z)
    length = lengths(r, problem.size)
    optimality = _gap(problem, r, dual)
    sigma = max(median_scale(length, problem.size), problem.floor)
    x = problem.parameters(z)
    return RobustEstimate(problem, loss, x, r, sigma, optimality <= OPTIMAL, count, optimality)


def _gap(problem: Design, r: Array, dual: Array) -> float:
    """Duality gap over the minimum, less what rounding of y may leave of both."""
    minimum = float(lengths(r, problem.size).sum())
    rounding = 30 * len(r) * problem.floor
    gap = minimum - float(problem.y @ _feasible(problem, dual))
    return max(gap - rounding, 0.0) / max(minimum, rounding)


def _feasible(problem: Design, dual: Array) -> Array:
    """The nearest λ with Bᵀλ = 0, shrunk until every |λ_i| ≤ 1."""
    projected = dual - problem.Q @ (problem.Q.T @ dual)
    return projected / max(1.0, float(lengths(projected, problem.size).max()))


def _linear_program(problem: Design) -> tuple[Array, Array, int]:
    """z, the optimal λ and the simplex steps; z are the multipliers of Qᵀλ = 0."""
    Q = problem.Q
    first = problem.residual(Q.T @ problem.y)
    unit = max(float(np.abs(first).mean()), problem.floor)  # HiGHS has absolute tolerances
    found = optimize.linprog(
        -first / unit, A_eq=Q.T, b_eq=np.zeros(problem.p), bounds=(-1, 1), method="highs-ds"
    )
    if not found.success:
        raise ElastocalError(f"the L1 linear program was not solved: {found.message}")
    z = Q.T @ problem.y - unit * np.asarray(found.eqlin.marginals)
    return _vertex(problem, z), np.asarray(found.x), int(found.nit)


def _vertex(problem: Design, z: Array) -> Array:
    """z moved to the exact vertex, where p residuals vanish, unless that costs."""
    r = problem.residual(z)
    through = np.argsort(np.abs(r))[: problem.p]
    try:
        exact = z + linalg.solve(problem.Q[through], r[through])
    except (linalg.LinAlgError, linalg.LinAlgWarning):
        return z
    return exact if np.abs(problem.residual(exact)).sum() <= np.abs(r).sum() else z


def _newton(problem: Design) -> tuple[Array, Array, int]:
    """z with the smallest certified gap, its λ and the number of steps."""
    Q, size = problem.Q, problem.size
    Q3 = Q.reshape(-1, size, problem.p)
    z = Q.T @ problem.y
    r = problem.residual(z)
    scale = max(median_scale(lengths(r, size), size), problem.floor)
    smoothing, count = scale, 0
    s = np.hypot(lengths(r, size), smoothing)
    dual = r / problem.rows(s)
    best = np.inf, z, dual
    while count < MAX_NEWTON:
        weight = 1 / problem.rows(s)
        gradient = -(Q.T @ (r * weight))
        along_r = np.einsum("nij,ni->nj", Q3, r.reshape(-1, size)) / s[:, None] ** 2
        along_dual = np.einsum("nij,ni->nj", Q3, dual.reshape(-1, size))
        mixed = along_r.T @ along_dual
        hessian = (Q.T * weight) @ Q - (mixed + mixed.T) / 2
        step = -linalg.lstsq(hessian, gradient)[0]
        slope = float(gradient @ step)
        share = _line_search(problem, z, step, slope, smoothing, float(s.sum()))
        toward = weight * (r - Q @ step + dual * problem.rows(along_r @ step) * problem.rows(s))
        dual = toward / problem.rows(np.maximum(lengths(toward, size), 1.0))
        z = z + share * step
        r = problem.residual(z)
        count += 1
        s = np.hypot(lengths(r, size), smoothing)
        for proof in (dual, r / problem.rows(s)):
            gap = _gap(problem, r, proof)
            if gap < best[0]:
                best = gap, z, proof
        if best[0] <= ENOUGH:
            break
        if share < 1e-3 or -slope <= 1e-3 * smoothing * len(s):
            if smoothing <= SMOOTHING * scale:
                break
            smoothing = max(smoothing / 5, SMOOTHING * scale)
            s = np.hypot(lengths(r, size), smoothing)
    return best[1], best[2], count


def _line_search(
    problem: Design, z: Array, step: Array, slope: float, smoothing: float, cost: float
) -> float:
    """Largest of 1, ½, ¼, … that lowers Σ s_i enough; 0 where rounding lets none."""
    share = 1.0
    while share > 1e-8:
        r = problem.residual(z + share * step)
        lowered = float(np.hypot(lengths(r, problem.size), smoothing).sum())
        if lowered <= cost + 1e-4 * share * slope:
            return share
        share /= 2
    return 0.0


# S-estimates by random subsets: the fit with the smallest M-scale of its residuals.
#
# FAST-S (Salibian-Barrera and Yohai 2006) for observations of `size` rows.  Subsets grow one
# random observation at a time until they determine every parameter (nonsingular subsampling,
# Koller and Stahel 2017): a compliance that only a fifth of the configurations see would make
# nearly all subsets of the smallest size singular.  All subsets are refined at once by stacked
# normal equations in the orthonormal coordinates of the design.

SUBSETS = 300
FINALISTS, WINNERS = 6, 2  # candidates refined further, and to the end
FIRST_STEPS, MORE_STEPS = 2, 12
SEARCH = 1500  # observations searched; the winners are refined on all
DETERMINED = 1e-4  # share of a subset's mean information that its worst direction must have
SETTLED = 1e-9
MAX_REFINE = 100


def s_estimate(
    problem: Design, loss: Bisquare, seed: int, subsets: int = SUBSETS, starts: Array | None = None
) -> tuple[Array, float]:
    """Coordinates z (p,) and scale of the S-estimate, over random subsets and `starts` (k, p)."""
    search = _searched(problem, np.random.default_rng(seed))
    candidates = (problem.Q.T @ problem.y)[None]
    if starts is not None:
        candidates = np.concatenate([candidates, starts])
    if subsets:
        drawn = _subset_fits(search, np.random.default_rng(seed + 1), subsets)
        drawn = _improve(search, drawn, loss, FIRST_STEPS)
        best = np.argsort(_scales(search, drawn, loss), kind="stable")[:FINALISTS]
        candidates = np.concatenate([candidates, drawn[best]])
    candidates = _improve(search, candidates, loss, MORE_STEPS)
    order = np.argsort(_scales(search, candidates, loss), kind="stable")[:WINNERS]
    return min((_refine(problem, candidates[k], loss) for k in order), key=itemgetter(1))


def _searched(problem: Design, rng: np.random.Generator) -> Design:
    """All of the problem, or a random part of it that still determines every parameter."""
    if problem.n <= SEARCH:
        return problem
    chosen = np.sort(rng.choice(problem.n, SEARCH, replace=False))
    rows = (chosen[:, None] * problem.size + np.arange(problem.size)).ravel()
    Q = problem.Q[rows]
    information = np.linalg.eigvalsh(Q.T @ Q) * problem.n / SEARCH
    if information[0] < DETERMINED:
        return problem
    return replace(problem, B=problem.B[rows], y=problem.y[rows], Q=Q)


def _products(problem: Design) -> tuple[Array, Array]:
    """Q_iᵀQ_i (n, p·p) and Q_iᵀy_i (n, p) of every observation."""
    Q3 = problem.Q.reshape(problem.n, problem.size, problem.p)
    gram = (Q3.transpose(0, 2, 1) @ Q3).reshape(problem.n, -1)
    return gram, np.einsum("nij,ni->nj", Q3, problem.y.reshape(problem.n, -1))


def _subset_fits(problem: Design, rng: np.random.Generator, subsets: int) -> Array:
    """Least-squares fits (subsets, p) to random subsets just large enough to determine them."""
    n, p = problem.n, problem.p
    gram, moment = _products(problem)
    order = rng.permuted(np.tile(np.arange(n), (subsets, 1)), axis=1)
    smallest = min(-(-p // problem.size), n)
    first = order[:, :smallest]
    G = gram[first].sum(axis=1).reshape(subsets, p, p)
    g = moment[first].sum(axis=1)
    taken = np.full(subsets, smallest)
    open_ = ~_determined(G)
    while open_.any() and taken.max() < n:
        k = np.flatnonzero(open_)
        added = order[k, taken[k]]
        G[k] += gram[added].reshape(-1, p, p)
        g[k] += moment[added]
        taken[k] += 1
        open_[k] = ~_determined(G[k])
    return np.asarray(np.linalg.solve(_regular(G), g[..., None]))[..., 0]


def _regular(G: Array) -> Array:
    """G (k, p, p) with a ridge at rounding size, so that no factorisation fails."""
    p = G.shape[-1]
    ridge = 1e-13 * np.trace(G, axis1=1, axis2=2) + np.finfo(float).tiny
    return G + ridge[:, None, None] * np.eye(p)


def _determined(G: Array) -> NDArray[np.bool_]:
    p = G.shape[-1]
    pivots = np.diagonal(np.linalg.cholesky(_regular(G)), axis1=1, axis2=2) ** 2
    mean = np.trace(G, axis1=1, axis2=2) / p
    return np.asarray(pivots.min(axis=1) > DETERMINED * mean)


def _improve(problem: Design, z: Array, loss: Bisquare, steps: int) -> Array:
    """`steps` concentration steps of every candidate z (k, p) at once."""
    gram, moment = _products(problem)
    p = problem.p
    d = _lengths(problem, z)
    scale = np.maximum(np.median(d, axis=1) / median_length(problem.size), problem.floor)
    for _ in range(steps):
        scale = _scale_step(problem, d, scale, loss)
        w = loss.weight(d / scale[:, None])
        G = _regular((w @ gram).reshape(-1, p, p))
        z = np.asarray(np.linalg.solve(G, (w @ moment)[..., None]))[..., 0]
        d = _lengths(problem, z)
    return z


def _lengths(problem: Design, z: Array) -> Array:
    """|e_i| (k, n) of the candidates z (k, p)."""
    r = problem.y - z @ problem.Q.T
    return np.sqrt((r.reshape(len(z), problem.n, problem.size) ** 2).sum(axis=2))


def _scale_step(problem: Design, d: Array, scale: Array, loss: Bisquare) -> Array:
    """One fixed-point step of the M-scale for every candidate; d (k, n), scale (k,)."""
    target = expected_rho(loss) * (problem.n - problem.p / problem.size)
    share = loss.rho(d / scale[:, None]).sum(axis=1) / target
    return np.maximum(scale * np.sqrt(share), problem.floor)


def _scales(problem: Design, z: Array, loss: Bisquare) -> Array:
    """M-scale (k,) of every candidate to a few digits, enough to rank them."""
    d = _lengths(problem, z)
    scale = np.median(d, axis=1) / median_length(problem.size)
    scale = np.maximum(scale, problem.floor)
    for _ in range(8):
        scale = _scale_step(problem, d, scale, loss)
    return scale


def _refine(problem: Design, z: Array, loss: Bisquare) -> tuple[Array, float]:
    """Iterate one candidate until its M-scale no longer falls, or rejection leaves too little."""
    size, p = problem.size, problem.p
    r = problem.residual(z)
    scale = max(m_scale(lengths(r, size), loss, p), problem.floor)
    for _ in range(MAX_REFINE):
        w = loss.weight(lengths(r, size) / scale)
        try:
            moved = z + problem.weighted_step(w, r)
        except InsufficientDataError:
            break
        residual = problem.residual(moved)
        lower = max(m_scale(lengths(residual, size), loss, p), problem.floor)
        if lower >= scale:
            break
        settled = scale - lower <= SETTLED * scale
        z, r, scale = moved, residual, lower
        if settled:
            break
    return z, scale


# M-estimates: iteratively reweighted least squares with the scale estimated alongside.

TOLERANCE = 1e-11  # of the step |B δx| in units of the scale
MAX_ITER = 500


def m_estimate(B: ArrayLike, y: ArrayLike, loss: Loss, *, size: int = 1) -> RobustEstimate:
    """Solve Σ B_iᵀ Ψ(e_i/σ) = 0, e = y − B x, Ψ(r) = ψ(|r|) r/|r| (Huber 1981, chapter 7).

    B (n·size, p) and y (n·size,) whitened, `size` rows per observation.  σ is the MAD about zero
    of every residual anew; the start is least squares.

    The breakdown point is that of the start and of the leverage: a monotone ψ (Huber, L1) has
    one solution and resists errors in y but not at leverage points; a redescending one finds the
    solution near the start, so bisquare belongs after an S-estimate (`mm_estimate`).  With
    `Absolute` the scale plays no part in x and the minimum is certified (`least_absolute`).

    Raises InputError for wrong shapes, dependent columns or a loss for another size;
    InsufficientDataError where rejection leaves too little.
    """
    problem = design(B, y, size)
    require(
        loss.size == size, f"the loss is for {loss.size} rows per observation, the data have {size}"
    )
    if isinstance(loss, Absolute):
        return least_absolute(problem, loss)
    return reweighted(problem, loss, problem.Q.T @ problem.y)


def reweighted(problem: Design, loss: Loss, z: Array, known: float | None = None) -> RobustEstimate:
    """IRLS from coordinates z; each step lowers Σ ρ at its scale (Huber 1981, section 7.8).

    The scale is the `known` one, or by the median of every residual anew.
    """

    def scale_of(residual: Array) -> float:
        if known is not None:
            return known
        return max(median_scale(lengths(residual, problem.size), problem.size), problem.floor)

    r = problem.residual(z)
    sigma, converged, count = scale_of(r), False, 0
    while not converged and count < MAX_ITER:
        weights = loss.weight(lengths(r, problem.size) / sigma)
        step = problem.weighted_step(weights, r)
        z = z + step
        r = problem.residual(z)
        before, sigma = sigma, scale_of(r)
        count += 1
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)  # no more digits in z
        settled = moved <= TOLERANCE * sigma and abs(sigma - before) <= TOLERANCE * sigma
        converged = bool(settled or still)
    return estimate_at(problem, loss, z, sigma, converged, count)


# MM-estimates: the breakdown point of an S-estimate with the efficiency of an M-estimate.


def mm_estimate(
    B: ArrayLike,
    y: ArrayLike,
    *,
    size: int = 1,
    seed: int = 0,
    subsets: int = SUBSETS,
    start: ArrayLike | None = None,
) -> RobustEstimate:
    """MM-estimate (Yohai 1987): S-estimate with 50 % breakdown, then Tukey's bisquare.

    B (n·size, p) and y (n·size,) whitened, `size` rows per observation.  The S-estimate fixes
    start and scale; the bisquare with 95 % efficiency at the normal then descends from
    there at that scale, so almost half of the observations, leverage points among them, may be
    arbitrarily wrong.  `subsets` random subsets are tried (deterministic in `seed`), and `start`
    (p,) or (k, p) beside them, such as `least_trimmed_squares`; 0 subsets refine the
    start alone.

    Raises InputError for wrong shapes or dependent columns.
    """
    problem, starts = design(B, y, size), None
    require(
        subsets >= 0 and (subsets > 0 or start is not None),
        "an S-estimate needs random subsets or a start",
    )
    if start is not None:
        given = np.atleast_2d(np.asarray(start, dtype=float))
        require(
            given.ndim == 2 and given.shape[1] == problem.p and bool(np.isfinite(given).all()),
            f"start must be {problem.p} finite numbers, or rows of them; found {given.shape}",
        )
        starts = np.stack([problem.coordinates(x) for x in given])
    z, scale = s_estimate(problem, breakdown_bisquare(problem.size), seed, subsets, starts)
    return reweighted(problem, bisquare(problem.size), z, scale)


# Maximum likelihood under multivariate Student-t errors, ν given or estimated.

NU_RANGE = (1.0, 200.0)  # below 1 the likelihood may be unbounded; at 200 the t is normal
MOST_EM_STEPS = 2000


def student_t(
    B: ArrayLike, y: ArrayLike, *, size: int = 1, nu: float | None = None
) -> RobustEstimate:
    """ML of y_i = B_i x + e_i, e_i ~ t_ν(0, σ² I) of `size` components per observation.

    EM in the parameter-expanded form, which has the same fixed points and is faster (Kent, Tyler
    and Vardi 1994; Meng and van Dyk 1997):

        w_i = (ν + size)/(ν + |e_i|²/σ²),    Σ w_i B_iᵀ(y_i − B_i x) = 0,
        σ² = Σ w_i |e_i|²/(size Σ w_i)

    `nu` None maximises the profile likelihood over 1 ≤ ν ≤ 200.  σ is the scale of the t, not a
    standard deviation (which is σ √(ν/(ν−2))).  The start is least squares with the median's
    scale; for small ν with outliers at leverage points the likelihood has other maxima.

    Raises InputError for wrong shapes, dependent columns or ν outside (0, ∞).
    """
    problem = design(B, y, size)
    z = problem.Q.T @ problem.y
    r = problem.residual(z)
    state = z, max(median_scale(lengths(r, size), size), problem.floor)
    if nu is not None:
        return _estimate(problem, StudentT(size, nu), *state)
    require(problem.n > problem.p, "estimating ν needs more observations than parameters")

    def cost(log_nu: float) -> float:
        nonlocal state
        found = _estimate(problem, StudentT(size, float(np.exp(log_nu))), *state)
        state = problem.coordinates(found.x), found.scale
        return -log_likelihood(found)

    bounds = np.log(NU_RANGE)
    best = optimize.minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    return _estimate(problem, StudentT(size, float(np.exp(best.x))), *state)


def log_likelihood(found: RobustEstimate) -> float:
    """Sum of the logarithms of the multivariate t densities of y at the estimate.

    Raises InputError for an estimate with another loss.
    """
    loss, n = found.loss, found.design.n
    if not isinstance(loss, StudentT):
        raise InputError(f"a Student-t likelihood needs a Student-t estimate, not {loss.name}")
    nu, size = loss.nu, loss.size
    constant = special.gammaln((nu + size) / 2) - special.gammaln(nu / 2)
    constant -= size / 2 * np.log(nu * np.pi) + size * np.log(found.scale)
    return float(n * constant - found.objective)


def _estimate(problem: Design, loss: StudentT, z: Array, scale: float) -> RobustEstimate:
    size = problem.size
    r = problem.residual(z)
    converged, count = False, 0
    while not converged and count < MOST_EM_STEPS:
        w = loss.weight(lengths(r, size) / scale)
        step = problem.weighted_step(w, r)
        z = z + step
        r = problem.residual(z)
        before = scale
        squared = lengths(r, size) ** 2
        scale = max(float(np.sqrt(w @ squared / (size * w.sum()))), problem.floor)
        count += 1
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)
        converged = bool(
            (moved <= TOLERANCE * scale or still) and abs(scale - before) <= TOLERANCE * scale
        )
    return estimate_at(problem, loss, z, scale, converged, count)
