"""The method's fit again under constraints and with a prior: its minimum, intervals and shares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from elastocal.errors import InsufficientDataError, option, require
from elastocal.identification.covariance import Covariance, t_quantile
from elastocal.identification.knowledge import Constraints, GaussianPrior
from elastocal.identification.least_squares import Fit, KnownFit, PriorRows, profile_end
from elastocal.identification.least_squares import fit as least_squares
from elastocal.identification.options import LEVEL, Intervals, MethodResult, Options
from elastocal.identification.residuals import held_out_by_parts
from elastocal.identification.solve import (
    WORTH_A_COLUMN,
    Reduction,
    Solution,
    reduce,
    residual_sigma,
)
from elastocal.identification.weighted_problem import (
    RFactor,
    evaluate,
)
from elastocal.text import listed, quoted
from elastocal.units import Array, IntArray, Progress

# Which parameters a fit with constraints and a prior has.


def fitted_columns(
    solution: Solution, constraints: Constraints, prior: GaussianPrior | None, sigma: float
) -> IntArray:
    """Indices of the parameters to fit under the constraints and the prior, ascending.

    These are the kept parameters of the solution; the free ones that the prior or an equality
    names, for that is knowledge of themselves; and what else the choice of the kept parameters
    finds worth a column with the prior and the equalities as further rows: with a prior on k,
    readings of k + d are knowledge of d.  Bounds and matrices make nothing known: they act on the
    fitted parameters, with all others held where the fit held them.

    Raises InputError for a name that is no parameter, or a prior on a parameter that is held fixed;
    InsufficientDataError where an equality names a parameter that stays undetermined.
    """
    problem, kept, model = solution.problem, solution.reduction.kept, solution.problem.model
    names, free, A = model.names, problem.free, constraints.resolve(model.names).A
    P = np.zeros((0, len(names))) if prior is None else sigma * prior.rows(names)[0]
    known, tied = (np.flatnonzero(rows.any(axis=0)) for rows in (P, A))
    fixed = [quoted(names[c]) for c in np.setdiff1d(known, free)]
    require(
        not fixed,
        f"a prior is stated for {listed(fixed)}, which is held fixed; drop the prior or the fixing",
    )
    named = np.intersect1d(np.union1d(known, tied), free)
    R = evaluate(problem.model, problem.parts, solution.fit.x, free).r_factor.R
    # An equality is exact: it counts as much as the most that anything else tells.
    A = A[:, free][A[:, free].any(axis=1)]
    most = np.linalg.norm(np.vstack([R, P[:, free]]) * solution.sizes[free], axis=0).max()
    A = A * most / np.linalg.norm(A * solution.sizes[free], axis=1)[:, None]
    rank = np.where(np.isin(free, kept), 0, np.where(np.isin(free, named), 1, 2))
    rows = np.vstack([R, P[:, free], A])
    told = free[reduce(rows, solution.sizes[free], (), sigma, WORTH_A_COLUMN, rank).kept]
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
    found: KnownFit, of_readings: Array, kind: str, many: set[str]
) -> Intervals:
    """95 % intervals of the constrained fit's columns, and their covariance.

    auto: t intervals of the posterior covariance, cut off at bounds, where no inequality is
    active; else the profile {v: S(v) − Ŝ ≤ t² σ²} of the linearised model under the constraints,
    S(v) the least objective with the parameter at v.  profile: that of the nonlinear one.

    The covariance takes equalities for exact and leaves inequalities out: knowing more than it
    says, no estimate is farther off.  `of_readings` (columns,) are the method's degrees of freedom.
    Parameters that are `many`, those of smooth functions, have t intervals in any case.
    """
    known, x, matrix = found.known, found.fit.x[found.fit.columns], found.covariance
    assert known.system is not None
    # A posterior variance V moves with the noise's variance s² by the readings' share of it,
    # d log V = (1 − share) d log s²: by Satterthwaite it has dof/(1 − share)² where s² has dof.
    left = 1 - np.nan_to_num(found.prior_share, nan=1.0)
    full = np.full(len(left), np.inf)
    dof = np.divide(of_readings, left**2, out=full, where=left > 1e-6)
    inside = not any(a.kind != "equality" for a in found.best.active)
    plain = Covariance("t", matrix, dof, "").interval(x, LEVEL)
    if kind == "auto" and inside:
        name, text = ("t under constraints", "equalities taken for exact, bounds cut off")
        if len(known.P):
            name, text = ("posterior", "readings and prior together, the prior taken at its word")
        lower, upper = known.system.lower[:, None], known.system.upper[:, None]
        covariance = Covariance(name, matrix, dof, f"{text}; assumes normal noise")
        return Intervals(covariance, np.clip(plain, lower, upper))
    ends = np.repeat(x[:, None], 2, axis=1)
    of_functions = np.array([name in many for name in found.names])
    ends[of_functions] = plain[of_functions]
    # Prior and noise are widened alike, by t for the normal quantile, so that their ratio stays.
    rises = (found.sigma * t_quantile(LEVEL, np.maximum(dof, 1.0))) ** 2
    for k, name in enumerate(found.names):
        for end, side in enumerate((-1, 1)) if name not in many else ():
            rise = float(rises[k])
            if kind == "profile":
                ends[k, end] = profile_end(found, k, rise, side)
            else:
                ends[k, end] += found.reduced.farthest(k, found.best, rise, side)[k]
    model = "nonlinear" if kind == "profile" else "linearised"
    text = f"profile of the {model} fit under the constraints, {ONE_SIDED}; assumes normal noise"
    return Intervals(Covariance("constrained profile", matrix, dof, text), ends)


# The fit of a method, its knowledge added: one more step on the weights that the method ends with.

ROUNDING = 1e-9  # factors below this share of a typical size are no combination
CONTRADICTED = 0.001  # false-alarm rate of a sentence that doubts what the user knows


@dataclass(frozen=True)
class FunctionPrior:
    """What smooth functions bring into a fit: the `prior` of their parameters, the noise `sigma`
    of a whitened row beside them and its degrees of freedom `dof`, and where the prior's part of
    the objective `stands` in the fit without further knowledge."""

    prior: GaussianPrior
    sigma: float
    dof: float
    stands: float


def joined(stated: GaussianPrior | None, own: GaussianPrior | None) -> GaussianPrior | None:
    """Both priors; of a parameter that both name, the stated one."""
    if stated is None or own is None:
        return own if stated is None else stated
    rest = [k for k, name in enumerate(own.names) if name not in set(stated.names)]
    n, m = len(stated.names), len(rest)
    covariance = np.zeros((n + m, n + m))
    covariance[:n, :n] = stated.covariance
    covariance[n:, n:] = own.covariance[np.ix_(rest, rest)]
    return GaussianPrior(
        (*stated.names, *(own.names[k] for k in rest)),
        np.concatenate([stated.mean, own.mean[rest]]),
        covariance,
    )


def fit_with_knowledge(
    before: MethodResult, options: Options, progress: Progress, own: FunctionPrior | None = None
) -> MethodResult:
    """Minimise |W (y − h(X))|² + σ² (X − m)ᵀ C⁻¹ (X − m) under `options.constraints`.

    W and the readings are those that the method ended with `before`, σ the noise of a whitened row
    under it.  `fitted_columns` says what is fitted, `intervals_with_knowledge` what the intervals
    are; t intervals have the method's own degrees of freedom.  `own` is the prior of smooth
    functions, which joins the stated one.

    Raises InputError for constraints that contradict each other or held values and names that are
    no parameters; InsufficientDataError where an equality names a parameter that readings, prior
    and equalities do not determine.
    """
    solution = before.solution
    problem, fit = solution.problem, solution.fit
    if own is not None:
        problem = replace(problem, free=np.union1d(problem.free, fit.columns))
        solution = replace(solution, problem=problem)
    constraints = options.constraints or Constraints()
    prior = joined(options.prior, None if own is None else own.prior)
    sigma = residual_sigma(fit, len(fit.columns)) if own is None else own.sigma
    columns = fitted_columns(solution, constraints, prior, sigma)
    stated = PriorRows.stated(problem.model.names, columns, fit.x, constraints, prior, sigma)
    progress("fitting under constraints" if prior is None else "fitting with the prior")
    found = KnownFit(
        least_squares(problem, columns, fit.x, solution.sizes, known=stated), stated, sigma
    )
    progress("intervals under constraints" if prior is None else "intervals with the prior")
    dof = np.full(len(columns), own.dof) if own else _dof(solution, before.intervals, columns)
    many = set() if own is None else set(own.prior.names)
    intervals = intervals_with_knowledge(found, dof, options.intervals, many)
    # Of smooth functions' parameters, which are many, nobody asks.
    shares = {} if prior is None else {
        name: float(share)
        for c, name, share in zip(columns, found.names, found.prior_share, strict=True)
        if np.isfinite(share) and not problem.model.shrunk[c]
    }  # fmt: skip
    fitted, matrix = _as_fit(found), intervals.covariance.matrix
    # Linearised, with the active constraints kept active: directions of the face are orthonormal by
    # the rows of readings and prior together.
    heldout, leverage = held_out_by_parts(
        problem.model, problem.parts, found.fit.x, columns, found.face
    )
    known = replace(solution, fit=fitted, reduction=_reduction(solution, found), held=heldout)
    told = _contradiction(solution, before.intervals, found, own)
    return replace(
        before, method="constrained", solution=known, intervals=intervals,
        active=found.best.active, prior_share=shares, effective=round(found.effective),
        leverage=leverage, warnings=(*before.warnings, *told),
        smooth=tuple(part.refitted(fitted.x, columns, matrix) for part in before.smooth),
    )  # fmt: skip


def _contradiction(
    solution: Solution, before: Intervals, found: KnownFit, own: FunctionPrior | None
) -> tuple[str, ...]:
    """A sentence where the objective grew by more than noise explains (F-test).

    Rows of the prior and active constraints count as degrees of freedom, less the parameters they
    made estimable.  At active bounds the true distribution is smaller (χ̄²): the test is cautious.
    """
    rows = len(found.known.P) - (0 if own is None else len(own.prior.names))
    stated = rows + len(found.best.active) - (len(found.names) - len(solution.fit.columns))
    if stated < 1:
        return ()
    grown = found.objective - float(solution.fit.whitened @ solution.fit.whitened)
    dof = max(float(before.covariance.dof.min()), 1.0)
    if own is not None:
        grown, dof = grown - own.stands, own.dof
    F = max(grown, 0.0) / (stated * found.sigma**2)
    known = np.isinf(dof)
    p = float(special.chdtrc(stated, F * stated) if known else special.fdtrc(stated, dof, F))
    if p > CONTRADICTED:
        return ()
    what = [f"'{a.label}'" for a in found.best.active]
    what += ["the prior"] if rows else []
    return (
        f"The readings contradict {listed(what, 6)}: without, they are fitted better than noise "
        f"explains (F = {F:.1f} on {stated} and {dof:.0f} degrees of freedom, p = {p:.1g}). Check "
        "names, units and signs of what is stated, and whether the model lacks an effect.",
    )


def _dof(solution: Solution, before: Intervals, columns: IntArray) -> Array:
    """The method's degrees of freedom (columns,); its fewest for a parameter that it held."""
    known = dict(zip(solution.fit.columns.tolist(), before.covariance.dof.tolist(), strict=True))
    fewest = min(known.values())
    return np.array([known.get(c, fewest) for c in columns.tolist()])


def _as_fit(found: KnownFit) -> Fit:
    """As the fit of a method; its R factor has prior and equalities as further rows.

    Without them a parameter that no reading shows would leave it singular; equalities weigh as
    much as the readings of a parameter do.
    """
    reduced = found.reduced
    A = reduced.system.A * reduced.unit
    equalities = A / np.linalg.norm(A, axis=1)[:, None] / reduced.unit
    rows = np.vstack([reduced.J, equalities])
    return replace(found.fit, r_factor=RFactor.of(rows, np.append(reduced.t, np.zeros(len(A)))))


def _reduction(solution: Solution, found: KnownFit) -> Reduction:
    """What is fitted, what is held, and how a held parameter's error would move the estimates.

    A parameter that an active constraint holds back does not move: it stands for itself.
    """
    before, problem = solution.reduction, solution.problem
    columns, k = found.fit.columns, len(found.fit.columns)
    dropped = np.setdiff1d(before.dropped, columns)
    both = np.concatenate([columns, dropped])
    R = evaluate(problem.model, problem.parts, found.fit.x, both).r_factor.R
    mixing = found.on_face @ (R[:, :k].T @ R[:, k:])
    share = np.abs(mixing) * solution.sizes[dropped] / solution.sizes[columns][:, None]
    mixing[share < ROUNDING] = 0.0
    return Reduction(columns, dropped, mixing, np.setdiff1d(before.invisible, columns))
