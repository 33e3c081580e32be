"""A fit with knowledge: constraints and a prior beside the readings, intervals that keep them."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from elastocal.identification.knowledge import Constraints, Reduced, share_of_prior
from elastocal.identification.least_squares import LEVEL, Covariance, held_out_by_parts, t_quantile
from elastocal.identification.solve import (
    WORTH_A_COLUMN,
    MethodResult,
    Reduction,
    Solution,
    reduce,
    residual_sigma,
)
from elastocal.identification.start import Options
from elastocal.identification.weighted_problem import Fit, Objective, PriorRows, RFactor
from elastocal.identification.weighted_problem import fit as least_squares
from elastocal.messages import (
    ElastocalError,
    InsufficientDataError,
    listed,
    option,
    quoted,
    require,
)
from elastocal.units import Array, BoolArray, IntArray, Progress

PINNED = 1e-12  # of unit columns: what equalities leave of a parameter that they fix


class KnownFit:
    """A fit at its minimum with what is known, beside rows of noise `sigma`: the linear problem of
    the step δ (columns,) from there, |e − B δ|² + |lack − P δ|², and its minimum δ = 0.

    `cofactor` is (NᵀBᵀB N + NᵀPᵀP N)⁻¹ in the directions N that the equalities leave, of which
    follows the posterior `covariance` (columns, columns), inequalities left out; `prior_share`
    (columns,) is the share of each estimate's information that is the prior's, NaN where fixed.
    """

    def __init__(self, fit: Fit, known: PriorRows, sigma: float) -> None:
        assert known.system is not None
        self.fit, self.known, self.sigma = fit, known, sigma
        x, rows = fit.x[fit.columns], fit.r_factor.augmented
        J, lack = np.vstack([rows[:, :-1], known.P]), known.target - known.P @ x
        limits = known.system.moved(x, np.ones(len(x)))
        self.reduced = Reduced(J, np.concatenate([rows[:, -1], lack]), limits)
        self.names, self.objective = limits.names, float(self.reduced.t @ self.reduced.t)
        self.best = self.reduced.minimum(known.system)
        self.cofactor = self.pinned(self.reduced.unit[:, None] * self.reduced.T)
        self.covariance = sigma**2 * self.cofactor
        self.prior_share = share_of_prior(self.cofactor, known.P)

    @cached_property
    def face(self) -> Array:
        """Directions (columns, q), orthonormal by J, in which active constraints let x move."""
        return self.reduced.unit[:, None] * self.reduced.T @ self.reduced.face(self.best)

    @property
    def effective(self) -> float:
        """How many parameters' worth the readings determine: tr(cofactor BᵀB) on the face."""
        return self.face.shape[1] - float(((self.known.P @ self.face) ** 2).sum())

    def pinned(self, half: Array) -> Array:
        """half · halfᵀ in directions (columns, q), without what equalities leave of a parameter."""
        fixed = np.linalg.norm(half, axis=1) <= PINNED * self.reduced.unit
        half = np.where(fixed[:, None], 0.0, half)
        return np.asarray(half @ half.T)


# Ends of profile intervals: how far a parameter can move before the fit becomes too bad.
#
# With S(v) the least objective where the parameter is held at v and the others are refitted, and Ŝ
# its minimum, the interval is {v: S(v) − Ŝ ≤ rise} (Bates and Watts 1988, chapter 6): in a linear
# model the t interval, and the same under any transformation of the parameter.

PRECISION = 1e-7  # of an interval: a step that short is the last
MOST_STEPS = 40
ASTRAY = 0.5  # of the rise: how far the nonlinear objective may lie beyond it on the way
ENDLESS = 1000.0  # times as far as in the linear model: there is no end


def profile_end(found: KnownFit, index: int, rise: float, side: int) -> float:
    """The least (side −1) or largest (1) value of the fitted parameter no. `index` with the
    nonlinear objective at most `rise` above its minimum; infinite where steps lead to none.  Each
    goes to that end of the model linearised where the last one ended, and is halved until poses
    there have an equilibrium and the objective is near what is allowed."""
    fit, limit, size = found.fit, found.objective + rise, found.fit.problem.sizes[found.fit.columns]
    objective = Objective(fit.problem, fit.columns, fit.x, size, found.known)
    assert objective.limits is not None
    far = ENDLESS * abs(float(found.reduced.farthest(index, found.best, rise, side)[index]))
    u = np.zeros(len(size))
    at = objective.evaluate(u)
    for _ in range(MOST_STEPS):
        reduced, A = Reduced(at.A, at.b, objective.limits.moved(u, np.ones(len(u)))), at.A
        best = reduced.minimum()
        step = reduced.farthest(index, best, max(limit - best.objective, 0.0), side)
        while True:
            try:
                at = objective.evaluate(u + step)
                if at.cost <= limit + ASTRAY * rise:
                    break
            except ElastocalError:
                pass  # no equilibrium so far out
            step = step / 2
        u = u + step
        if np.linalg.norm(A @ step) <= PRECISION * np.sqrt(rise):
            return float(objective.values(u)[fit.columns[index]])
        if abs(size[index] * u[index]) > far:
            break
    return side * np.inf


def fitted_columns(solution: Solution, stated: PriorRows, sigma: float) -> IntArray:
    """Indices of the parameters to fit with what is `stated` of all of them, ascending.

    These are the kept ones; the free ones that the prior or an equality names, for that is
    knowledge of themselves; and what else `reduce` finds worth a column with the prior and the
    equalities as further rows: with a prior on k, readings of k + d are knowledge of d.  Bounds and
    matrices make nothing known: they act on the fitted parameters, with all others held where the
    fit held them.

    Raises InputError for a prior on a parameter that is held fixed; InsufficientDataError where an
    equality names a parameter that stays undetermined.
    """
    assert stated.system is not None
    problem, kept, model = solution.problem, solution.reduction.kept, solution.problem.model
    names, free, P, A = model.names, problem.free, stated.P, stated.system.A
    known, tied = (np.flatnonzero(rows.any(axis=0)) for rows in (P, A))
    fixed = [quoted(names[c]) for c in np.setdiff1d(known, free)]
    require(
        not fixed,
        f"a prior is stated for {listed(fixed)}, which is held fixed; drop the prior or the fixing",
    )
    named = np.intersect1d(np.union1d(known, tied), free)
    R = problem.evaluate(solution.fit.x, free)[1].R
    # An equality is exact: it counts as much as the most that anything else tells.
    A = A[:, free][A[:, free].any(axis=1)]
    most = np.linalg.norm(np.vstack([R, P[:, free]]) * problem.sizes[free], axis=0).max()
    A = A * most / np.linalg.norm(A * problem.sizes[free], axis=1)[:, None]
    rank = np.where(np.isin(free, kept), 0, np.where(np.isin(free, named), 1, 2))
    rows = np.vstack([R, P[:, free], A])
    told = free[reduce(rows, problem.sizes[free], (), sigma, WORTH_A_COLUMN, rank).kept]
    unknown = [quoted(names[c]) for c in np.setdiff1d(np.intersect1d(tied, named), [*told, *known])]
    if unknown:
        raise InsufficientDataError(
            f"readings, prior and equalities do not determine {listed(unknown)}, which an equality "
            f"names; hold it ({option('fixed')}) or state a prior for it, or drop the equality"
        )
    return np.unique(np.concatenate([kept, named, told]))


# Intervals of a fit under constraints or with a prior.
#
# At a bound the estimate is not normal and the likelihood ratio not χ²: where the truth lies on one
# bound, it is the mixture ½χ²₀ + ½χ²₁ (Chernoff 1954; Self and Liang 1987), whose 95 % point is
# 2.71.  The intervals here keep the quantile of an interior truth, 3.84.  Away from bounds they are
# exact for a linear model with normal noise of known size; at and near one bound they are
# conservative (97.5 % for 95 %).  With the truth on two bounds at once the mixture depends on the
# angle α > 90° between the two whitened columns of B: they then hold 97.5 % − 14.65 % (α −
# 90°)/360°, which is 95 % at 150° and 93.8 % in the limit of 180°, two columns that nearly cancel.

ONE_SIDED = "one-sided at a bound, and wide rather than narrow near one"


def intervals_with_knowledge(
    found: KnownFit, of_readings: Array, kind: str, many: BoolArray
) -> Covariance:
    """95 % intervals of the constrained fit's columns, and their covariance.

    auto: t intervals of the posterior covariance where no inequality is active, cut off by bounds
    (`MethodResult.told`); else the profile {v: S(v) − Ŝ ≤ t² σ²} of the model linearised under the
    constraints, S(v) the least objective with the parameter at v.  profile: of the nonlinear.  The
    covariance takes equalities for exact and leaves inequalities out: knowing more than it says, no
    estimate is farther off.  `of_readings` (columns,) are the method's degrees of freedom;
    parameters that are `many` (columns,), those of smooth functions, have t intervals in any case.
    """
    known, x, matrix = found.known, found.fit.x[found.fit.columns], found.covariance
    # A posterior variance V moves with the noise's variance s² by the readings' share of it,
    # d log V = (1 − share) d log s²: by Satterthwaite it has dof/(1 − share)² where s² has dof.
    left = 1 - np.nan_to_num(found.prior_share, nan=1.0)
    dof = np.where(left > 1e-6, of_readings / np.maximum(left, 1e-6) ** 2, np.inf)
    if kind == "auto" and all(a.kind == "equality" for a in found.best.active):
        name, text = ("t under constraints", "equalities taken for exact, bounds cut off")
        if len(known.P):
            name, text = ("posterior", "readings and prior together, the prior taken at its word")
        return Covariance(name, matrix, dof, f"{text}; assumes normal noise")
    ends = np.where(many[:, None], Covariance("t", matrix, dof, "").interval(x), x[:, None])
    # Prior and noise are widened alike, by t for the normal quantile, so that their ratio stays.
    rises = (found.sigma * t_quantile(LEVEL, np.maximum(dof, 1.0))) ** 2
    for k in np.flatnonzero(~many).tolist():
        for end, side in enumerate((-1, 1)):
            rise = float(rises[k])
            if kind == "profile":
                ends[k, end] = profile_end(found, k, rise, side)
            else:
                ends[k, end] += found.reduced.farthest(k, found.best, rise, side)[k]
    model = "nonlinear" if kind == "profile" else "linearised"
    text = f"profile of the {model} fit under the constraints, {ONE_SIDED}; assumes normal noise"
    return Covariance("constrained profile", matrix, dof, text, ends=ends)


NO_PART = 1e-9  # factors below this share of a typical size are no combination
CONTRADICTED = 0.001  # false-alarm rate of a sentence that doubts what the user knows


def fit_with_knowledge(before: MethodResult, options: Options, progress: Progress) -> MethodResult:
    """Minimise |W (y − h(X))|² + σ² (X − m)ᵀ C⁻¹ (X − m) under `options.constraints`.

    W, readings and degrees of freedom are those that the method ended with `before`, σ the noise of
    a whitened row under it.  The prior of smooth functions joins the stated one, which counts where
    both name a parameter.  Raises InputError for constraints that contradict each other or held
    values and names that are no parameters; InsufficientDataError as `fitted_columns`.
    """
    solution, names = before.solution, before.solution.problem.model.names
    fit, own, prior = solution.fit, solution.fit.known, options.prior
    told = dict(zip(fit.columns.tolist(), before.spread.dof.tolist(), strict=True))
    sigma, spare = before.beside or (residual_sigma(fit, len(told)), min(told.values()))
    P, target = np.zeros((0, len(names))), np.zeros(0)
    if prior is not None:
        P, target = (sigma * rows for rows in prior.rows(names))
    stated = len(P)
    problem = replace(solution.problem, free=np.union1d(solution.problem.free, fit.columns))
    solution = replace(solution, fit=replace(fit, problem=problem))
    rows = np.zeros((len(own.P), len(names)))
    rows[:, fit.columns] = own.P
    left = ~rows[:, P.any(axis=0)].any(axis=1)
    P, target = np.vstack([P, rows[left]]), np.append(target, own.target[left])
    whole = PriorRows(P, target, (options.constraints or Constraints()).resolve(names))
    columns = fitted_columns(solution, whole, sigma)
    known = whole.restricted(columns, fit.x)
    progress("fitting with the prior" if len(P) else "fitting under constraints")
    found = KnownFit(least_squares(problem, columns, fit.x, known=known), known, sigma)
    progress("intervals with the prior" if len(P) else "intervals under constraints")
    dof = np.array([spare if before.beside else told.get(c, spare) for c in columns.tolist()])
    many = np.isin(columns, fit.columns[own.P.any(axis=0)])
    spread = intervals_with_knowledge(found, dof, options.intervals, many)
    # Of smooth functions' parameters, which are many, nobody asks.
    shares = {
        name: float(share)
        for c, name, share in zip(columns, found.names, found.prior_share, strict=True)
        if np.isfinite(share) and not problem.model.shrunk[c]
    } if len(P) else {}  # fmt: skip
    # Linearised, with the active constraints kept active: directions of the face are orthonormal by
    # the rows of readings and prior together.
    # The fit's R factor has prior and equalities as further rows: without them a parameter that no
    # reading shows would leave it singular.  Equalities weigh as much as a parameter's readings do.
    reduced, A = found.reduced, found.reduced.system.A
    rows = np.vstack([reduced.J, A / np.linalg.norm(A * reduced.unit, axis=1)[:, None]])
    r_factor = RFactor.of(rows, np.append(reduced.t, np.zeros(len(A))))
    crossed = held_out_by_parts(problem, found.fit.x, columns, found.face)
    final = replace(
        solution, fit=replace(found.fit, r_factor=r_factor),
        reduction=_reduction(solution, found), held=crossed,
    )  # fmt: skip
    doubts = _contradiction(before, found, stated)
    return replace(
        before, method="constrained", solution=final, spread=spread,
        active=found.best.active, prior_share=shares, effective=round(found.effective),
        contradicted=doubts,
        smooth=tuple(part.refitted(final.fit.x, columns, spread.matrix) for part in before.smooth),
    )  # fmt: skip


def _contradiction(before: MethodResult, found: KnownFit, rows: int) -> dict[str, Any]:
    """What the readings contradict, where the objective grew by more than noise explains (F-test).
    The stated prior's `rows` and active constraints count as degrees of freedom, less the
    parameters they made estimable.  At active bounds the true distribution is smaller (χ̄²): the
    test is cautious."""
    fit, own = before.solution.fit, before.solution.fit.known
    stated = rows + len(found.best.active) - (len(found.names) - len(fit.columns))
    if stated < 1:
        return {}
    away = own.P @ fit.x[fit.columns] - own.target
    grown = found.objective - float(fit.whitened @ fit.whitened + away @ away)
    _, dof = before.beside or (0.0, max(float(before.spread.dof.min()), 1.0))
    F = max(grown, 0.0) / (stated * found.sigma**2)
    known = np.isinf(dof)
    p = float(special.chdtrc(stated, F * stated) if known else special.fdtrc(stated, dof, F))
    what = (*["the prior"] * bool(rows), *(f"'{a.label}'" for a in found.best.active))
    found_so = {"stated": what, "F": F, "dof_stated": stated, "dof_readings": dof, "p": p}
    return found_so if p <= CONTRADICTED else {}


def _reduction(solution: Solution, found: KnownFit) -> Reduction:
    """What is fitted, what is held, and how a held parameter's error would move the estimates.  A
    parameter that an active constraint holds back does not move: it stands for itself."""
    before, problem = solution.reduction, solution.problem
    columns, k = found.fit.columns, len(found.fit.columns)
    dropped = np.setdiff1d(before.dropped, columns)
    R = problem.evaluate(found.fit.x, np.concatenate([columns, dropped]))[1].R
    mixing = found.pinned(found.face) @ (R[:, :k].T @ R[:, k:])
    share = np.abs(mixing) * problem.sizes[dropped] / problem.sizes[columns][:, None]
    mixing[share < NO_PART] = 0.0
    invisible = np.setdiff1d(before.invisible, columns)
    return Reduction(columns, dropped, mixing, invisible, before.with_prior)
