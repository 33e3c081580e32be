"""Robust linear fits: least absolute values, trimmed squares, S, M, MM, Student's t."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize, sparse, special

from elastocal.errors import InputError, InsufficientDataError, require
from elastocal.identification.linear_solver import least_norm
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
    lengths,
    m_scale,
    median_scale,
)
from elastocal.units import Array

# Least absolute values, and the least sum of Euclidean lengths, with a certificate.
#
#     minimise  Σ |e_i|,  e = y − B x         dual:  maximise Σ y_iᵀ λ_i,  Bᵀ λ = 0,  |λ_i| ≤ 1
#
# Any feasible λ bounds the minimum from below, so the gap Σ|e_i| − yᵀλ proves how good x is.

OPTIMAL = 5e-6  # relative duality gap that counts as solved
ACCURATE = 1e-12  # asked of the cone solver, which ends where rounding allows no more
MOST_STEPS = 30


def least_absolute(problem: Design, loss: Absolute) -> RobustEstimate:
    """Minimise the sum of |e_i|; `optimality` is the duality gap over the minimum.

    The median's scale is only reported: x does not depend on it.
    """
    z, dual, count = _cone_program(problem)
    r = problem.residual(z)
    length = lengths(r, problem.size)
    optimality = _gap(problem, r, dual)
    sigma = max(median_scale(length, problem.size), problem.floor)
    x = problem.parameters(z)
    return RobustEstimate(problem, loss, x, r, sigma, optimality <= OPTIMAL, count, optimality)


def _gap(problem: Design, r: Array, dual: Array) -> float:
    """Duality gap over the minimum, less what rounding of y may leave of both.

    The bound is that of the nearest λ with Bᵀλ = 0, shrunk until every |λ_i| ≤ 1.
    """
    minimum = float(lengths(r, problem.size).sum())
    rounding = 30 * len(r) * problem.floor
    feasible = dual - problem.Q @ (problem.Q.T @ dual)
    feasible /= max(1.0, float(lengths(feasible, problem.size).max()))
    return max(minimum - float(problem.y @ feasible) - rounding, 0.0) / max(minimum, rounding)


def _cone_program(problem: Design) -> tuple[Array, Array, int]:
    """z, the optimal λ and the solver's steps: min Σ t_i with every (t_i, e_i) in its cone, from
    least squares on and in units of its residual."""
    import clarabel

    n, p, size = problem.n, problem.p, problem.size
    start = problem.Q.T @ problem.y
    first = problem.residual(start)
    unit = max(float(np.abs(first).mean()), problem.floor)
    # Rows of a cone: t_i, then the components of e_i, as A (δz, t) + s = b.
    of_e = (np.arange(n)[:, None] * (size + 1) + 1 + np.arange(size)).ravel()
    A, b = np.zeros((n * (size + 1), p)), np.zeros(n * (size + 1))
    A[of_e], b[of_e] = problem.Q, first / unit
    lengths_of = sparse.kron(sparse.eye_array(n), -np.eye(size + 1, 1))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = ACCURATE
    found = clarabel.DefaultSolver(
        sparse.csc_matrix((n + p, n + p)), np.repeat([0.0, 1.0], [p, n]),
        sparse.hstack([sparse.csc_matrix(A), lengths_of], format="csc"), b,
        [clarabel.SecondOrderConeT(size + 1)] * n, settings,
    ).solve()  # fmt: skip
    z = start + unit * np.array(found.x[:p])
    z = _vertex(problem, z) if size == 1 else _stationary(problem, z)
    return z, -np.array(found.z)[of_e], found.iterations


def _vertex(problem: Design, z: Array) -> Array:
    """z moved to the exact vertex, where p residuals vanish, unless that costs."""
    r = problem.residual(z)
    through = np.argsort(np.abs(r))[: problem.p]
    try:
        exact = z + linalg.solve(problem.Q[through], r[through])
    except (linalg.LinAlgError, linalg.LinAlgWarning):
        return z
    return exact if np.abs(problem.residual(exact)).sum() <= np.abs(r).sum() else z


def _stationary(problem: Design, z: Array) -> Array:
    """z with the digits that the cone program leaves open, while Σ |e_i| falls.

    By Newton's step, or where that gains nothing by the one of weights 1/|e_i|: it goes through
    observations that are met exactly, where Σ |e_i| has a kink and no second derivative.
    """
    r = problem.residual(z)
    for _ in range(MOST_STEPS):
        length = np.maximum(lengths(r, problem.size), problem.floor)
        along = (problem.Q * (r / problem.rows(length))[:, None]).reshape(problem.n, -1, problem.p)
        along = along.sum(axis=1)
        gram = (problem.Q.T / problem.rows(length)) @ problem.Q
        for hessian in (gram - (along.T / length) @ along, gram):
            trial = z + least_norm(hessian, along.sum(axis=0))
            residual = problem.residual(trial)
            if lengths(residual, problem.size).sum() < lengths(r, problem.size).sum():
                z, r = trial, residual
                break
        else:
            break
    return z


# Least trimmed squares: the fit of the majority, whatever the rest says.

STARTS = 500
FINALISTS, FEW = 10, 3
SEARCH_ROWS = 2000
STEPS = 2  # of every start before the best are chosen
TOGETHER = 100  # starts whose residuals are held at a time
SAME = 1e-9  # relative: costs that differ by less are those of one fit
RIDGE = 1e-12
INSIDE = 0.99


def least_trimmed_squares(
    B: Array, e: Array, size: int, seed: int = 0, starts: int = STARTS
) -> Array:
    """Shift Δ (columns,) minimising the sum of the smaller half of |e_i − B_i Δ|².

    B (n·size, columns) and e (n·size,) whitened, `size` rows per observation; up to half of the
    observations may be arbitrarily wrong.  FAST-LTS (Rousseeuw and Van Driessen 2006): many
    smallest possible random subsets, concentration steps, the best few run to the end.
    """
    n, p = len(e) // size, B.shape[1]
    if p == 0:
        return np.zeros(0)
    B3, e2 = B.reshape(n, size, p), e.reshape(n, size)
    rng = np.random.default_rng(seed)
    search = np.arange(n) if n <= SEARCH_ROWS else rng.choice(n, SEARCH_ROWS, replace=False)
    need = min(-(-p // size) + 1, n)
    subsets = np.array([rng.choice(len(search), need, replace=False) for _ in range(starts)])
    shifts, costs = _searched(B3[search], e2[search], subsets)
    finalists = [*shifts[np.argsort(costs, kind="stable")[:FINALISTS]], np.zeros(p)]
    if len(search) < n:  # many end at the same fit: all readings decide among the best few
        ended = sorted((_ended(B3[search], e2[search], one) for one in finalists), key=_cost)
        apart = [True, *(b > a * (1 + SAME) for (_, a), (_, b) in pairwise(ended))]
        finalists = [shift for (shift, _), new in zip(ended[:FEW], apart, strict=False) if new]
    return min((_ended(B3, e2, one) for one in finalists), key=_cost)[0]


def _cost(ended: tuple[Array, float]) -> float:
    return ended[1]


def _ended(B: Array, e: Array, shift: Array) -> tuple[Array, float]:
    """Where concentration steps from `shift` end, and the trimmed cost there."""
    cost = np.inf
    for _ in range(100):
        previous = cost
        shift, cost = _concentrate(B, e, shift)
        if cost >= previous * (1 - 1e-10):
            break
    return shift, cost


def _searched(B: Array, e: Array, subsets: NDArray[np.int64]) -> tuple[Array, Array]:
    """Shifts (starts, p) and trimmed costs (starts,) two steps from `subsets` (starts, need).

    The normal equations of any choice of observations are a sum of those of single ones, so one
    product sets them up for all starts.  They cost half the digits, which a search can spare: the
    finalists go on with B itself.
    """
    n, size, p = B.shape
    scale = np.linalg.norm(B.reshape(-1, p), axis=0)
    scale[scale == 0] = 1.0
    unit = B / scale
    back = unit.transpose(0, 2, 1)
    products = np.concatenate([back @ unit, back @ e[:, :, None]], axis=2).reshape(n, -1)
    half = (n + p // size + 1) // 2
    shifts, costs = np.empty((len(subsets), p)), np.empty(len(subsets))
    for first in range(0, len(subsets), TOGETHER):
        which = slice(first, first + TOGETHER)
        nearest = subsets[which]
        for step in range(STEPS + 1):
            shift = _solve_normal(products, nearest)
            left = e.ravel()[:, None] - unit.reshape(-1, p) @ shift.T
            squared = (left.reshape(n, size, -1) ** 2).sum(axis=1).T  # (starts, n)
            if step < STEPS:
                nearest = np.argpartition(squared, half - 1, axis=1)[:, :half]
        shifts[which] = shift / scale
        costs[which] = np.partition(squared, half - 1, axis=1)[:, :half].sum(axis=1)
    return shifts, costs


def _solve_normal(products: Array, chosen: NDArray[np.int64]) -> Array:
    """Least squares (starts, p) of the `chosen` (starts, k) observations, from their products.

    A ridge keeps a direction that they do not show where it is.
    """
    inside = np.zeros((len(chosen), len(products)))
    np.put_along_axis(inside, chosen, 1.0, axis=1)
    p = int(np.sqrt(products.shape[1]))
    summed = (inside @ products).reshape(len(chosen), p, p + 1)
    normal, right = summed[:, :, :p].copy(), summed[:, :, p:]
    own = np.arange(p)
    normal[:, own, own] += RIDGE * np.maximum(
        np.trace(normal, axis1=1, axis2=2)[:, None], np.finfo(float).tiny / RIDGE
    )
    return np.asarray(np.linalg.solve(normal, right)[..., 0], dtype=np.float64)


def _concentrate(B: Array, e: Array, shift: Array) -> tuple[Array, float]:
    """Refit to the half with the smallest residuals; the trimmed cost never rises."""
    squared = ((e - B @ shift) ** 2).sum(axis=1)
    half = (len(e) + len(shift) // e.shape[1] + 1) // 2
    chosen = np.argpartition(squared, half - 1)[:half]
    shift = _solve(B[chosen], e[chosen])
    squared = np.sort(((e - B @ shift) ** 2).sum(axis=1))
    return shift, float(squared[:half].sum())


def _solve(B: Array, e: Array) -> Array:
    if B.shape[2] == 0:
        return np.zeros(0)
    return least_norm(B.reshape(-1, B.shape[2]), e.ravel(), cond=1e-10, check_finite=False)


def majority(B: Array, e: Array, size: int, seed: int = 0) -> NDArray[np.bool_]:
    """Observations (n,) that agree with the least trimmed squares fit of the majority.

    Reweighted LTS, repeated: fit to the observations inside the 99 % limit of χ²(size), scale
    from those corrected for the cut, new limit.  Up to one in a hundred clean observations is
    left outside, so this is a suspicion, not a verdict.
    """
    n = len(e) // size
    B3, e2 = B.reshape(n, size, B.shape[1]), e.reshape(n, size)
    limit = special.chdtri(size, 1 - INSIDE)
    # Mean of a χ² variable cut at its 99 % point, per degree of freedom.
    cut = special.chdtr(size + 2, limit) / INSIDE
    squared = ((e2 - B3 @ least_trimmed_squares(B, e, size, seed)) ** 2).sum(axis=1)
    good = squared <= limit * median_scale(np.sqrt(squared), size) ** 2
    for _ in range(50):
        shift = _solve(B3[good], e2[good])
        squared = ((e2 - B3 @ shift) ** 2).sum(axis=1)
        scale2 = squared[good].mean() / (size * cut)
        updated = squared <= limit * scale2
        if np.array_equal(updated, good) or updated.sum() <= n // 2:
            break
        good = updated
    return good


# S-estimates: the fit with the smallest M-scale of its residuals, from the fit of the majority.
#
# Least trimmed squares has the same breakdown point, and its search is the one that is also made
# for faulty readings; an S-estimate's own (FAST-S, Salibian-Barrera and Yohai 2006) ends at the
# same fit.  Each step from there lowers the M-scale, so that the breakdown point stays.

SUBSETS = 300
SETTLED = 1e-9
MAX_REFINE = 100


def s_estimate(
    problem: Design, loss: Bisquare, seed: int, subsets: int = SUBSETS, starts: Array | None = None
) -> tuple[Array, float]:
    """Coordinates z (p,) and scale of the S-estimate, from the trimmed fit of random `subsets`,
    from `starts` (k, p) and from least squares."""
    candidates = [problem.Q.T @ problem.y, *([] if starts is None else starts)]
    if subsets:
        candidates += [least_trimmed_squares(problem.Q, problem.y, problem.size, seed, subsets)]
    return min((_refine(problem, z, loss) for z in candidates), key=itemgetter(1))


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
    z = problem.Q.T @ problem.y
    sigma = max(median_scale(lengths(problem.residual(z), size), size), problem.floor)
    return reweighted(problem, loss, z, sigma, lambda length, _: median_scale(length, size))


def reweighted(
    problem: Design, loss: Loss, z: Array, scale: float,
    rescaled: Callable[[Array, Array], float] | None = None, most: int = MAX_ITER,
) -> RobustEstimate:  # fmt: skip
    """IRLS from coordinates z; each step lowers Σ ρ at its scale (Huber 1981, section 7.8).

    The `scale` is known, or `rescaled` says it anew after each step, of lengths and weights (n,).
    """
    r = problem.residual(z)
    converged, count = False, 0
    while not converged and count < most:
        weights = loss.weight(lengths(r, problem.size) / scale)
        step = problem.weighted_step(weights, r)
        z = z + step
        r = problem.residual(z)
        before = scale
        if rescaled is not None:
            scale = max(rescaled(lengths(r, problem.size), weights), problem.floor)
        count += 1
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)  # no more digits in z
        same = abs(scale - before) <= TOLERANCE * scale
        converged = bool((moved <= TOLERANCE * scale or still) and same)
    return estimate_at(problem, loss, z, scale, converged, count)


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
    def rescaled(length: Array, w: Array) -> float:
        return float(np.sqrt(w @ length**2 / (problem.size * w.sum())))

    return reweighted(problem, loss, z, scale, rescaled, MOST_EM_STEPS)
