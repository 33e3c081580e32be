"""The method's fit again under constraints and with a prior: its minimum, intervals and shares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse, special

from elastocal.errors import ElastocalError, InputError, option, require
from elastocal.identification.constrained import (
    ActiveConstraint,
    ConstrainedFit,
    constrained_fit,
    fit_system,
    fitted_columns,
    minimise,
    own_bounds,
)
from elastocal.identification.constrained_solver import (
    ConstrainedObjective,
    ResidualLoss,
    active_at,
    equality_space,
    extent,
    loss_of,
    tangent_rows,
)
from elastocal.identification.covariance import Covariance, t_quantile
from elastocal.identification.intervals import (
    LEVEL,
    Intervals,
    ProfileInterval,
    profile_interval,
)
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    GaussianPrior,
    System,
    share_of_prior,
)
from elastocal.identification.least_squares import Fit, FitProblem
from elastocal.identification.linear_solver import least_norm
from elastocal.identification.options import Options
from elastocal.identification.residuals import held_out_residual
from elastocal.identification.solve import Reduction, Solution, residual_sigma
from elastocal.identification.trimmed import median_scale
from elastocal.identification.weighted_problem import RFactor
from elastocal.text import listed
from elastocal.units import Array, Progress

# Profile intervals under constraints.
#
# At a bound the estimate is not normal and the likelihood ratio not χ²: where the truth lies on one
# bound, it is the mixture ½χ²₀ + ½χ²₁ (Chernoff 1954; Self and Liang 1987), whose 95 % point is
# 2.71.  The intervals here keep the quantile of an interior truth, 3.84.  Away from bounds they are
# exact for a linear model with normal noise of known size; at and near one bound they are
# conservative (97.5 % for 95 %).  With the truth on two bounds at once the mixture depends on the
# angle α > 90° between the two whitened columns of B: they then hold 97.5 % − 14.65 % (α −
# 90°)/360°, which is 95 % at 150° and 93.8 % in the limit of 180°, two columns that nearly cancel.

INWARD = 1e-6  # of a standard deviation, from an end that only a linear program knows


def profile_linear_interval(
    objective: ConstrainedObjective, system: System, name: str, sigma: float, level: float = 0.95
) -> ProfileInterval:
    """{v: (S(v) − Ŝ)/σ² ≤ χ²₁(level)} for the parameter `name`.

    S(v) is the least objective (squares and prior, whose rows have the standard deviation `sigma`)
    with the parameter at v and all constraints kept.  The interval ends ("bound") where no x
    satisfies the constraints any more, so an active parameter has a one-sided interval that starts
    at its bound.

    Raises InputError as `minimise` does, and for a name that is no parameter.
    """
    require(name in system.names, f"{name!r} is not a parameter; choose from {list(system.names)}")
    i = system.names.index(name)
    best = minimise(objective, system)
    free = minimise(objective, _only_equalities(system))

    def least(value: float) -> float:
        if value == best.x[i]:
            return best.objective
        return minimise(objective, system.with_value(i, value)).objective

    std, ends = float(np.sqrt(free.cofactor[i, i])), _extent(objective, system, best.x, i)
    return _interval(least, float(best.x[i]), std, ends, sigma, level)


def profile_fit_interval(
    problem: FitProblem,
    found: ConstrainedFit,
    name: str,
    constraints: Constraints,
    sigma: float,
    *,
    prior: GaussianPrior | None = None,
    level: float = 0.95,
) -> ProfileInterval:
    """The profile interval of one fitted parameter of the nonlinear model.

    As `profile_linear_interval`, with S(v) the objective of `constrained_fit` (squares), which gave
    `found` for the same problem, constraints, prior and sigma.
    """
    require(name in found.names, f"{name!r} was not fitted; choose from {list(found.names)}")
    k = found.names.index(name)
    c = int(found.columns[k])
    system = fit_system(problem, constraints)
    weighted = problem.weights.apply(found.B)
    rows, p = weighted.shape
    linear = ConstrainedObjective(
        weighted, np.zeros(rows), np.zeros((0, p)), np.zeros(0), ResidualLoss()
    )
    free = minimise(linear, _only_equalities(system.moved(found.x[found.columns], np.ones(p))))
    known = [found.x]

    def least(value: float) -> float:
        if value == found.x[c]:
            return found.objective
        start = min(known, key=lambda x: abs(x[c] - value)).copy()
        start[c] = value
        stated = constraints + Constraints(bounds=(Bounds(name, value, value),))
        again = constrained_fit(replace(problem, x=start), stated, prior=prior, sigma=sigma)
        if not again.converged:
            raise ElastocalError(f"no fit with {name} at {value:g}: {again.reason}")
        known.append(again.x)
        return again.objective

    ends = _extent(linear, system, found.x[found.columns], k)
    return _interval(
        least, float(found.x[c]), float(np.sqrt(free.cofactor[k, k])), ends, sigma, level
    )


def _interval(
    least: Callable[[float], float],
    estimate: float,
    std: float,
    ends: tuple[float, float],
    sigma: float,
    level: float,
) -> ProfileInterval:
    if std == 0 or ends[0] == ends[1]:  # equalities leave a single value
        return ProfileInterval(estimate, estimate, ("bound", "bound"))
    return profile_interval(
        lambda v: least(v) / sigma**2, estimate, std * sigma, np.inf, level, ends[0], ends[1]
    )


def _extent(
    objective: ConstrainedObjective, system: System, x: Array, index: int
) -> tuple[float, float]:
    """How far the constraints let x[index] go from the solution x, kept inside by a hair."""
    if not (len(system.b) or system.matrices):
        return float(system.lower[index]), float(system.upper[index])
    # In standard deviations from the solution; a linear program's tolerances are absolute.
    unit = 1 / objective.norms
    low, high = extent(system.moved(x, unit), index)
    low, high = min(low + INWARD, 0.0), max(high - INWARD, 0.0)
    return float(x[index] + unit[index] * low), float(x[index] + unit[index] * high)


def _only_equalities(system: System) -> System:
    free = np.full(len(system.names), np.inf)
    return replace(system, lower=-free, upper=free, matrices=())


# A constrained fit linearised at its minimum: covariance, shares of the prior, leverage.

PINNED = 1e-12  # of unit columns: what equalities leave of a parameter that they fix


@dataclass(frozen=True)
class LinearisedFit:
    """The constrained fit about its minimum x̂ (columns,): Σ ρ + |lack − P δ|² in δ = x − x̂.

    `B` (rows, columns) and `e` (rows,) are the whitened regressor and residual there, `P` (k,
    columns) and `lack` (k,) the prior in units of the noise `sigma` of a whitened row.
    """

    names: tuple[str, ...]
    x: Array
    B: Array
    e: Array
    P: Array
    lack: Array
    loss: ResidualLoss
    sigma: float
    system: System

    @classmethod
    def at(
        cls,
        problem: FitProblem,
        found: ConstrainedFit,
        constraints: Constraints,
        prior: GaussianPrior | None,
        loss: ResidualLoss,
        sigma: float,
    ) -> LinearisedFit:
        """About the minimum that `constrained_fit` found."""
        x, p = found.x[found.columns], len(found.columns)
        P, target = (np.zeros((0, p)), np.zeros(0)) if prior is None else prior.rows(found.names)
        return cls(
            found.names, x, problem.weights.apply(found.B), found.whitened, sigma * P,
            sigma * (target - P @ x), loss, sigma, fit_system(problem, constraints),
        )  # fmt: skip

    @cached_property
    def K(self) -> Array:
        """(rows, columns) with KᵀK = half the Hessian of the readings' loss."""
        return self.loss.root(self.B, self.e)

    @cached_property
    def unit(self) -> Array:
        """What makes the columns of K and P together unit length."""
        norms = np.linalg.norm(np.vstack([self.K, self.P]), axis=0)
        return 1 / np.where(norms > 0, norms, 1.0)

    @cached_property
    def variance(self) -> float:
        """κ with cov x̂ = κ (KᵀK)⁻¹ for readings alone.

        σ² for squares; for Huber's loss [Σ|ψ|²/(rows − p)] / mean ψ' (Huber and Ronchetti 2009,
        section 7.6, H2), which the root of the Hessian turns into a covariance.
        """
        if self.loss.quadratic:
            return self.sigma**2
        w = self.loss.weights(self.e)
        psi, near = w * self.e, self.loss.lengths(self.e) <= self.loss.threshold
        slope = np.where(near, 1.0, w[:: self.loss.size] * (1 - 1 / self.loss.size)).mean()
        return float(psi @ psi / max(len(psi) - len(self.x), 1) / slope)

    @cached_property
    def equalities(self) -> Array:
        """Directions (columns, q) in which the equalities let x move."""
        space = equality_space(self.system.A * self.unit, np.zeros(len(self.system.b)))
        return self.unit[:, None] * space.basis

    @cached_property
    def face(self) -> Array:
        """Directions (columns, q) in which all active constraints let x move."""
        inside = self.system.moved(self.x, self.unit)
        zero = np.zeros(len(self.x))
        rows, values = tangent_rows(inside, active_at(inside, zero), zero)
        return self.unit[:, None] * equality_space(rows, values).basis

    @cached_property
    def cofactor(self) -> Array:
        """(NᵀKᵀK N + NᵀPᵀP N)⁻¹ in the directions N that the equalities leave."""
        half = self._half(self.equalities)
        return half.T @ half

    @cached_property
    def on_face(self) -> Array:
        """The same with every active constraint taken for an equality."""
        return self._half_on_face.T @ self._half_on_face

    def objective(self, B: Array, y: Array, loss: ResidualLoss) -> ConstrainedObjective:
        """Of x with these rows for the readings, and the prior."""
        return ConstrainedObjective(B, y, self.P, self.lack + self.P @ self.x, loss)

    @property
    def covariance(self) -> Array:
        """Posterior covariance (columns, columns), equalities exact, inequalities left out."""
        by_prior = (self.P @ self.cofactor).T @ (self.P @ self.cofactor)
        return self.variance * (self.cofactor - by_prior) + self.sigma**2 * by_prior

    @property
    def prior_share(self) -> Array:
        """Share (columns,) of each estimate's information that is the prior's; NaN where fixed."""
        return share_of_prior(self.cofactor, self.P)

    @property
    def effective(self) -> float:
        """How many parameters' worth the readings determine: tr(cofactor KᵀK) on the face."""
        return self.face.shape[1] - float(((self._half_on_face @ self.P.T) ** 2).sum())

    @property
    def leverage(self) -> Array:
        """Diagonal (rows,) of K cofactor Kᵀ on the face, at most 1."""
        return np.minimum(((self.K @ self._half_on_face.T) ** 2).sum(axis=1), 1.0)

    @cached_property
    def r_factor(self) -> tuple[Array, Array]:
        """R (columns, columns), z (columns,): |z − R x|² is the readings' part, but a constant."""
        p = len(self.x)
        R = linalg.qr(self.K * self.unit, mode="r")[0][:p]
        R = np.vstack([R, np.zeros((p - len(R), p))])
        gradient = self.unit * (self.B.T @ (self.loss.weights(self.e) * self.e))
        z = least_norm(R.T, gradient)
        return R / self.unit, z + R @ (self.x / self.unit)

    @cached_property
    def _half_on_face(self) -> Array:
        return self._half(self.face)

    def _half(self, basis: Array) -> Array:
        """H (q, columns) with HᵀH the cofactor within the basis (columns, q)."""
        rows = np.vstack([self.K, self.P]) @ basis
        R = linalg.qr(rows, mode="r")[0][: basis.shape[1]]
        half = linalg.solve_triangular(R, basis.T, trans="T") if R.size else basis.T
        half[:, np.linalg.norm(half / self.unit, axis=0) <= PINNED] = 0.0
        return np.asarray(half)


# Intervals of a fit under constraints or with a prior.

ONE_SIDED = "one-sided at a bound, and wide rather than narrow near one"


def degrees_of_freedom(of_readings: Array, share: Array) -> Array:
    """dof (p,) of a posterior variance of which the prior gave the `share` (p,).

    A posterior variance V moves with the noise's variance s² by the readings' share of it,
    d log V = (1 − share) d log s², so that by Satterthwaite it has dof/(1 − share)² where s² has
    `of_readings` (p,); infinite where all is the prior's or fixed by equalities.
    """
    left = 1 - np.nan_to_num(share, nan=1.0)
    full = np.full(len(left), np.inf)
    return np.divide(of_readings, left**2, out=full, where=left > 1e-6)


def intervals_with_knowledge(
    problem: FitProblem,
    found: ConstrainedFit,
    local: LinearisedFit,
    constraints: Constraints,
    prior: GaussianPrior | None,
    of_readings: Array,
    options: Options,
    many: set[str] | None = None,
) -> Intervals:
    """95 % intervals of the constrained fit's columns, and their covariance.

    auto: t intervals of the posterior covariance, cut off at bounds, where no inequality is
    active; else the profile of the linearised model under the constraints.  profile: that of the
    nonlinear one.

    The covariance takes equalities for exact and leaves inequalities out: knowing more than it
    says, no estimate is farther off.  `of_readings` (columns,) are the method's degrees of freedom.
    Parameters that are `many`, those of smooth functions, have t intervals in any case.
    """
    kind, dof = options.intervals, degrees_of_freedom(of_readings, local.prior_share)
    matrix, inside = local.covariance, not any(a.kind != "equality" for a in found.active)
    if kind == "auto" and inside:
        name, text = _posterior(prior, local)
        covariance = Covariance(name, matrix, dof, text)
        ci95 = covariance.interval(local.x, LEVEL)
        lower, upper = local.system.lower[:, None], local.system.upper[:, None]
        return Intervals(covariance, np.clip(ci95, lower, upper))
    ends = []
    plain = Covariance("t", matrix, dof, "").interval(local.x, LEVEL)
    # The prior is as wide as the noise is taken for, so that their ratio stays.
    linear = local.objective(*local.r_factor, ResidualLoss())
    for k, (name, wide) in enumerate(zip(local.names, _inflation(local, dof), strict=True)):
        if name in (many or ()):
            ends.append((float(plain[k, 0]), float(plain[k, 1])))
            continue
        sigma = local.sigma * wide
        if kind == "profile":
            wider = None if prior is None else replace(prior, covariance=prior.covariance * wide**2)
            one = profile_fit_interval(problem, found, name, constraints, sigma, prior=wider)
        else:
            one = profile_linear_interval(linear, local.system, name, sigma)
        ends.append((one.lower, one.upper))
    model = "nonlinear" if kind == "profile" else "linearised"
    text = f"profile of the {model} fit under the constraints, {ONE_SIDED}; assumes normal noise"
    return Intervals(Covariance("constrained profile", matrix, dof, text), np.array(ends))


def _posterior(prior: GaussianPrior | None, local: LinearisedFit) -> tuple[str, str]:
    noise = "normal noise" if local.loss.quadratic else "independent readings, as Huber's estimate"
    if prior is None:
        return "t under constraints", f"equalities taken for exact, bounds cut off; assumes {noise}"
    return "posterior", f"readings and prior together, the prior taken at its word; assumes {noise}"


def _inflation(local: LinearisedFit, dof: Array) -> Array:
    """Factors (p,) on σ that turn the normal quantile of a known noise into t of `dof`."""
    t = t_quantile(LEVEL, np.maximum(dof, 1.0))
    return t / special.ndtri((1 + LEVEL) / 2) * np.sqrt(local.variance) / local.sigma


# The fit of a method, its knowledge added: one more step on the weights that the method ends with.

ROUNDING = 1e-9  # factors below this share of a typical size are no combination
CONTRADICTED = 0.001  # false-alarm rate of a sentence that doubts what the user knows


@dataclass(frozen=True)
class KnowledgeFit:
    """A solution under constraints and with a prior, its intervals, and what each contributed.

    `prior_share` by parameter, empty without a prior; parameters that equalities fix are left
    out.  `effective` is how many parameters the readings paid for, `leverage` (rows,) how much
    each drew the fit to itself.  `warnings` say where the readings contradict the knowledge.
    """

    solution: Solution
    intervals: Intervals
    active: tuple[ActiveConstraint, ...]
    prior_share: dict[str, float]
    effective: int
    leverage: Array
    warnings: tuple[str, ...]


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
    solution: Solution, before: Intervals, options: Options, progress: Progress,
    own: FunctionPrior | None = None,
) -> KnowledgeFit:  # fmt: skip
    """Minimise Σ ρ(W (y − h(X))) + σ² (X − m)ᵀ C⁻¹ (X − m) under `options.constraints`.

    W and the readings are those of the method's `solution`, σ the noise of a whitened row under
    it, ρ squares or, for the method huber, Huber's loss.  `fitted_columns` says what is fitted,
    `intervals_with_knowledge` what the intervals are; t intervals have the degrees of freedom of
    `before`, the method's own.  `own` is the prior of smooth functions, which joins the stated one.

    Raises InputError for constraints that contradict each other or held values, names that are no
    parameters, and tables too large to hold B; InsufficientDataError where an equality names a
    parameter that readings, prior and equalities do not determine.
    """
    problem = solution.problem
    if problem.large:
        raise InputError(
            "constraints and priors need B as a whole, which a table of this size does not allow: "
            f"fit a part of the table, or {option('bounded', True)} for the physical bounds alone"
        )
    constraints = (options.constraints or Constraints()) + own_bounds(solution)
    prior = joined(options.prior, None if own is None else own.prior)
    name = "huber" if options.resolved == "huber" else "squares"
    size = problem.observations.size if name == "huber" else 1
    sigma = _noise(solution, name, size) if own is None else own.sigma
    columns = fitted_columns(solution, before.covariance.std, constraints, prior)
    posed = replace(problem, bounded=False).fit_of(columns, solution.fit.x, solution.sizes)
    progress("fitting under constraints" if prior is None else "fitting with the prior")
    found = constrained_fit(posed, constraints, prior=prior, loss=name, sigma=sigma)  # type: ignore[arg-type]
    loss: ResidualLoss = loss_of(name, size, sigma)  # type: ignore[arg-type]
    local = LinearisedFit.at(posed, found, constraints, prior, loss, sigma)
    progress("intervals under constraints" if prior is None else "intervals with the prior")
    dof = _dof(solution, before, columns) if own is None else np.full(len(columns), own.dof)
    intervals = intervals_with_knowledge(
        posed, found, local, constraints, prior, dof, options,
        set() if own is None else set(own.prior.names),
    )  # fmt: skip
    # Of smooth functions' parameters, which are many, nobody asks.
    shares = {} if prior is None else {
        name: share for c, name, share in zip(columns, found.names, local.prior_share, strict=True)
        if not problem.model.shrunk[c]
    }  # fmt: skip
    known = replace(
        solution,
        fit=_as_fit(posed, found, local),
        reduction=_reduction(solution, found, local),
        heldout=_held_out(solution, found, local),
    )
    return KnowledgeFit(
        known, intervals, found.active,
        {n: float(s) for n, s in shares.items() if np.isfinite(s)},
        round(local.effective), local.leverage,
        _contradiction(solution, before, found, local, own),
    )  # fmt: skip


def _noise(solution: Solution, loss: str, size: int) -> float:
    """σ of a whitened row: of the residual, or for Huber's loss of its median length."""
    fit = solution.fit
    if loss == "squares":
        return residual_sigma(fit, len(fit.columns))
    lengths = np.linalg.norm(fit.whitened.reshape(-1, size), axis=1)
    return max(median_scale(lengths, size), 1e-12)


def _contradiction(
    solution: Solution, before: Intervals, found: ConstrainedFit, local: LinearisedFit,
    own: FunctionPrior | None,
) -> tuple[str, ...]:  # fmt: skip
    """A sentence where the objective grew by more than noise explains (F-test), for squares.

    Rows of the prior and active constraints count as degrees of freedom, less the parameters they
    made estimable.  At active bounds the true distribution is smaller (χ̄²): the test is cautious.
    """
    rows = len(local.P) - (0 if own is None else len(own.prior.names))
    stated = rows + len(found.active) - (len(found.columns) - len(solution.fit.columns))
    if stated < 1 or not local.loss.quadratic:
        return ()
    grown = found.objective - float(solution.fit.whitened @ solution.fit.whitened)
    dof = max(float(before.covariance.dof.min()), 1.0)
    if own is not None:
        grown, dof = grown - own.stands, own.dof
    F = max(grown, 0.0) / (stated * local.sigma**2)
    known = np.isinf(dof)
    p = float(special.chdtrc(stated, F * stated) if known else special.fdtrc(stated, dof, F))
    if p > CONTRADICTED:
        return ()
    what = [f"'{a.label}'" for a in found.active]
    what += ["the prior"] if rows else []
    return (
        f"The readings contradict {listed(what, 6)}: without, they are fitted better than noise "
        f"explains (F = {F:.1f} on {stated} and {dof:.0f} degrees of freedom, p = {p:.1g}). Check "
        "names, units and signs of what is stated, and whether the model lacks an effect.",
    )


def _dof(solution: Solution, before: Intervals, columns: NDArray[np.int64]) -> Array:
    """The method's degrees of freedom (columns,); its fewest for a parameter that it held."""
    known = dict(zip(solution.fit.columns.tolist(), before.covariance.dof.tolist(), strict=True))
    fewest = min(known.values())
    return np.array([known.get(c, fewest) for c in columns.tolist()])


def _as_fit(problem: FitProblem, found: ConstrainedFit, local: LinearisedFit) -> Fit:
    """As the fit of a method; its R factor has prior and equalities as further rows.

    Without them a parameter that no reading shows would leave it singular; equalities weigh as
    much as the readings of a parameter do.
    """
    A = local.system.A * local.unit
    rows = np.vstack([local.B, local.P, A / np.linalg.norm(A, axis=1)[:, None] / local.unit])
    rest = np.concatenate([local.e, local.lack, np.zeros(len(A))])
    return Fit(
        found.x, found.residual, found.whitened, RFactor.of(rows, rest), found.converged,
        found.reason, found.steps, replace(problem, x=found.x),
    )  # fmt: skip


def _reduction(solution: Solution, found: ConstrainedFit, local: LinearisedFit) -> Reduction:
    """What is fitted, what is held, and how a held parameter's error would move the estimates.

    A parameter that an active constraint holds back does not move: it stands for itself.
    """
    before, problem = solution.reduction, solution.problem
    observed, columns = problem.observations, found.columns
    dropped = np.setdiff1d(before.dropped, columns)
    at = problem.model.regressor(observed.table, found.x, dropped, observed)
    K = local.loss.root(problem.weights.apply(at.B), local.e)
    mixing = local.on_face @ (local.K.T @ K)
    share = np.abs(mixing) * solution.sizes[dropped] / solution.sizes[columns][:, None]
    mixing[share < ROUNDING] = 0.0
    return Reduction(columns, dropped, mixing, np.setdiff1d(before.invisible, columns))


def _held_out(solution: Solution, found: ConstrainedFit, local: LinearisedFit) -> Array:
    """Residual (rows,) of each configuration under a fit to the others and the prior.

    Linearised, with the active constraints kept active and Huber's weights as they are.
    """
    if not local.face.shape[1]:
        return found.residual
    observed, weights = solution.problem.observations, solution.problem.weights
    # The prior's rows go with no configuration, so that they are never left out.
    more = -len(local.P) % observed.size
    P = np.vstack([local.P, np.zeros((more, len(local.x)))])
    left_out = observed.configuration if weights.together is None else weights.together
    own = left_out.max() + 1 + np.arange(len(P) // observed.size)
    whiten = sparse.diags_array(np.sqrt(local.loss.weights(local.e)))
    if weights.whole is not None:
        whiten = whiten @ weights.whole
    both = sparse.block_diag([whiten, sparse.eye_array(len(P))], format="csr")
    held = held_out_residual(
        np.vstack([found.B, P]) @ local.face,
        np.concatenate([found.residual, local.lack, np.zeros(more)]),
        replace(weights, whiten=sparse.csr_array(both), low=None, common=None, together=None),
        np.concatenate([left_out, own]),
        observed.size,
    )
    return held[: len(found.residual)]
