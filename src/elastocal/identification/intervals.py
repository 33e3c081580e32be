"""Standard deviations and 95 % intervals of the fitted parameters, by the method asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy import optimize

from elastocal.errors import ElastocalError, InputError, option, require
from elastocal.identification.covariance import Covariance, cluster_robust, hc, t_quantile
from elastocal.identification.least_squares import Fit, FitProblem, fit
from elastocal.identification.noise_choice import NoiseFit
from elastocal.identification.residuals import whole_groups
from elastocal.identification.solve import Solution, residual_sigma
from elastocal.identification.weighted_problem import (
    Partition,
    Span,
    in_order,
    regressor,
    same_size,
)
from elastocal.units import Array

# Cluster-robust covariance of a fit to a table too large for its B to be formed.

# Configurations per parameter from which the sandwich needs no correction for leverage: its bias
# and the loss of degrees of freedom are then a few per cent.
ENOUGH = 10


def worth_clustering(parts: Partition, n_parameters: int) -> bool:
    """Whether configurations hold several readings, and are enough for their scatter to count."""
    configurations = parts.observed.n_configurations
    return len(parts.observed.lead) > configurations >= ENOUGH * n_parameters


def cluster_by_parts(fit: Fit, parts: Partition) -> Covariance:
    """CR1 over configurations (Liang and Zeger 1986), in passes over the parts of the table.

    C Σ_c (B_cᵀe_c)(B_cᵀe_c)ᵀ C · G/(G − 1) · (n − 1)/(n − p) with C = (BᵀB)⁻¹, whitened, G
    configurations and n rows; t with G − 1 degrees of freedom.
    """
    model, size = fit.problem.model, fit.problem.sizes[fit.columns]

    def meat(span: Span) -> Array:
        part = parts.part(span)
        at = regressor(model, part, fit.x, fit.columns)
        B, e = part.weights.apply(at.B * size), part.weights.apply(at.residual)
        rows_of = np.repeat(part.observations.configuration, part.observations.size)
        scores = [np.einsum("grp,gr->gp", B[rows], e[rows]) for rows in same_size(rows_of)]
        S = np.concatenate(scores)
        return np.asarray(S.T @ S)

    p = len(size)
    middle = sum(in_order(whole_groups(parts), meat), np.zeros((p, p)))
    n, G = len(parts.observed.value), parts.observed.n_configurations
    factor = G / (G - 1) * (n - 1) / (n - p)
    cofactor = fit.cofactor() / np.outer(size, size)
    matrix = factor * cofactor @ middle @ cofactor * np.outer(size, size)
    text = f"readings of a configuration may depend on each other ({G} configurations)"
    return Covariance("CR1", matrix, np.full(p, float(G - 1)), text)


# Profile-likelihood intervals: how far a parameter can move before the fit becomes too bad.
#
# With S(v) the least weighted sum of squares where the parameter is held at v and the others are
# refitted, and Ŝ its minimum, the interval is
#
#     { v : τ²(v) = (S(v) − Ŝ)/s² ≤ F_{1,dof}(level) },   s² = Ŝ/dof
#
# (Bates & Watts 1988, chapter 6).  In a linear model it is the t interval; where the model bends,
# its ends are not equally far from the estimate, and it stays the same interval under any
# transformation of the parameter.

Objective = Callable[[float], float]

DOUBLINGS = 10  # of t·std in search of a crossing; beyond 1000 times the interval is flat
FAR = 10.0  # τ/t beyond which its size no longer matters
PRECISION = 1e-6  # of an end, in units of t·std
LOWER_BY = 1e-3  # (Ŝ − S)/s² above which the fit was not at its minimum


def profile_interval(
    objective: Objective,
    estimate: float,
    std: float,
    dof: float,
    level: float = 0.95,
    lower: float = -np.inf,
    upper: float = np.inf,
) -> tuple[float, float]:
    """Profile-likelihood interval of one parameter about `estimate`, inside its bounds; infinite
    on a side where τ² never reaches the quantile.

    objective(value) -> S: minimum of the whitened rss with the parameter at `value`; it may raise
    ElastocalError where no fit exists, and there the interval ends.  std: standard deviation of the
    linearised fit, which only scales the search.  dof: residual degrees of freedom.

    Raises InputError where there are none, or no residual; ElastocalError where a value is found
    whose S lies below that of the estimate.
    """
    require(dof > 0, f"a profile needs positive degrees of freedom, got {dof}")
    t = float(t_quantile(level, np.asarray(dof)))
    least = objective(estimate)
    s2 = least / dof
    require(s2 > 0, "the fit leaves no residual, so there is no noise to judge its parameters by")

    def excess(value: float) -> float:
        """τ − t, cut off where it no longer matters so that the root finder is not led astray."""
        try:
            rise = (objective(value) - least) / s2
        except ElastocalError:
            return FAR * t
        if rise < -LOWER_BY:
            raise ElastocalError(
                f"held at {value:g} the fit is better than at the estimate {estimate:g}, so that"
                " was not the minimum; fit again from there"
            )
        return min(np.sqrt(max(rise, 0.0)), (1 + FAR) * t) - t if np.isfinite(rise) else FAR * t

    return _end(excess, estimate, -t * std, lower), _end(excess, estimate, t * std, upper)


def _end(excess: Objective, estimate: float, step: float, bound: float) -> float:
    """The end of the interval in the direction of `step`, whose size is that of the t interval."""
    inside = estimate
    for size in 2.0 ** np.arange(DOUBLINGS + 1):
        outside = estimate + step * float(size)
        outside = bound if (outside - bound) * step >= 0 else outside
        value = 0.0 if outside == estimate else excess(outside)
        if abs(value) <= PRECISION:  # rounding alone decides its sign
            return outside
        if value > 0:
            return float(optimize.brentq(excess, inside, outside, xtol=PRECISION * abs(step)))
        if outside == bound:
            return bound
        inside = outside
    return float(np.copysign(np.inf, step))


def profile_of(problem: FitProblem, found: Fit, index: int) -> Objective:
    """S(value) of `profile_interval` for parameter `index` of the model, one of problem.columns.

    Each call holds the parameter and refits the other columns with `fit`, from the nearest fit so
    far.  It raises ElastocalError where that does not converge.
    """
    others = problem.columns[problem.columns != index]
    known = [found.x]

    def objective(value: float) -> float:
        x = min(known, key=lambda near: abs(near[index] - value)).copy()
        x[index] = value
        if others.size == 0:
            observed = problem.observations
            rest = observed.value - problem.model.predict(observed.table, x, observed)
            whitened = problem.weights.apply(rest)
        else:
            again = fit(replace(problem, x=x, columns=others))
            if not again.converged:
                raise ElastocalError(f"no fit with parameter {index} at {value:g}: {again.reason}")
            known.append(again.x)
            whitened = again.whitened
        return float(whitened @ whitened)

    return objective


# Standard deviations and 95 % intervals of the fitted parameters, by the method asked for.

IntervalKind = Literal[
    "auto", "classical", "hc0", "hc1", "hc2", "hc3", "cr0", "cr1", "cr2", "cr3",
    "profile",
]  # fmt: skip
KINDS = get_args(IntervalKind)
LEVEL = 0.95


@dataclass(frozen=True)
class Intervals:
    """Covariance of the fitted parameters and their 95 % intervals (fitted, 2)."""

    covariance: Covariance
    ci95: Array

    @property
    def kind(self) -> str:
        return self.covariance.kind


def intervals_of(solution: Solution, kind: IntervalKind, noise: NoiseFit | None) -> Intervals:
    """Intervals of the solution's fitted parameters.

    auto: those of the estimated noise (Kenward–Roger), where there is one, else classical, or in
    a large table with several readings per configuration cr1;
    classical: s²(BᵀW²B)⁻¹ with t (eq. 7, 13); hc…, cr…: sandwich, clusters being configurations;
    profile: of the nonlinear sum of squares.

    Raises InputError for a kind that the problem does not allow, InsufficientDataError where
    the data cannot give it.
    """
    fit, observed = solution.fit, solution.problem.observations
    x = fit.x[fit.columns]

    def by_t(covariance: Covariance) -> Intervals:
        return Intervals(covariance, covariance.interval(x, LEVEL))

    if kind == "auto" and noise is not None:
        return by_t(noise.covariance)
    problem = solution.problem
    clustered = problem.large and worth_clustering(problem.parts, len(x))
    if (kind == "cr1" and problem.large) or (kind == "auto" and clustered):
        return by_t(cluster_by_parts(fit, problem.parts))
    classical = _classical(solution)
    if kind in ("auto", "classical"):
        return by_t(classical)
    if problem.large:
        raise InputError(
            f"{option('intervals', kind)} needs B as a whole, which a table of this size does not "
            "allow; use cr1 or classical"
        )
    if kind == "profile":
        return _profiled(solution, classical)
    size = solution.sizes[fit.columns]
    B, e = problem.weights.apply(fit.B * size), fit.whitened
    if kind.startswith("hc"):
        found = hc(B, e, kind.upper())
    else:
        found = cluster_robust(B, e, np.repeat(observed.configuration, observed.size), kind.upper())
    return by_t(replace(found, matrix=found.matrix * np.outer(size, size)))


def _classical(solution: Solution) -> Covariance:
    fit = solution.fit
    sigma = residual_sigma(fit, len(fit.columns))
    dof = len(fit.whitened) - len(fit.columns)
    return Covariance(
        "classical", sigma**2 * fit.cofactor(), np.full(len(fit.columns), float(dof)),
        "all readings independent, their noise scaled to the residual",
    )  # fmt: skip


def _profiled(solution: Solution, classical: Covariance) -> Intervals:
    fit = solution.fit
    ends = []
    for k, c in enumerate(fit.columns.tolist()):
        p, bounded = solution.problem.model.parameters[c], solution.problem.bounded
        ends.append(
            profile_interval(
                profile_of(fit.problem, fit, c), float(fit.x[c]), float(classical.std[k]),
                float(classical.dof[k]), LEVEL, *((p.lower, p.upper) if bounded else ()),
            )
        )  # fmt: skip
    text = "profile of the nonlinear sum of squares (all readings independent)"
    return Intervals(replace(classical, kind="profile", description=text), np.array(ends))
