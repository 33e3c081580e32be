"""Intervals of a fit under constraints or with a prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.identification.constrained.bootstrap import constrained_bootstrap
from elastocal.identification.constrained.constraints import Constraints
from elastocal.identification.constrained.intervals import profile_fit_interval, profile_intervals
from elastocal.identification.constrained.nonlinear import ConstrainedFit
from elastocal.identification.constrained.prior import GaussianPrior
from elastocal.identification.covariance.estimate import Covariance, t_quantile
from elastocal.identification.fit import FitProblem
from elastocal.identification.intervals import DRAWS, LEVEL, Intervals
from elastocal.identification.knowledge_columns import on_columns
from elastocal.identification.knowledge_local import Local

Array = NDArray[np.float64]

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
    local: Local,
    constraints: Constraints,
    prior: GaussianPrior | None,
    of_readings: Array,
    kind: str,
    seed: int,
    jobs: int,
) -> Intervals:
    """95 % intervals of the constrained fit's columns, and their covariance.

    auto: t intervals of the posterior covariance, cut off at bounds, where no inequality is
    active; else the profile of the linearised model under the constraints.  profile: that of the
    nonlinear one.  bootstrap: parametric, on the linearised model under the constraints.

    The covariance takes equalities for exact and leaves inequalities out: knowing more than it
    says, no estimate is farther off.  `of_readings` (columns,) are the method's degrees of freedom.
    """
    dof = degrees_of_freedom(of_readings, local.prior_share)
    matrix, inside = local.covariance, not any(a.kind != "equality" for a in found.active)
    if kind == "auto" and inside:
        name, text = _posterior(prior, local)
        covariance = Covariance(name, matrix, dof, text)
        ci95 = covariance.interval(local.x, LEVEL)
        lower, upper = local.system.lower[:, None], local.system.upper[:, None]
        return Intervals(covariance, np.clip(ci95, lower, upper))
    names = problem.model.names
    held = {n: float(v) for n, v in zip(names, found.x, strict=True) if n not in local.names}
    if kind == "bootstrap":
        drawn = constrained_bootstrap(
            local.B, local.e + local.B @ local.x, local.names, on_columns(constraints, held),
            prior=prior, loss="squares" if local.loss.quadratic else "huber",
            size=local.loss.size, sigma=local.sigma, draws=DRAWS, seed=seed, jobs=jobs,
        )  # fmt: skip
        text = f"{drawn.description}, on the linearised model under the constraints, its noise kept"
        return Intervals(
            Covariance("constrained bootstrap", matrix, dof, text), drawn.interval(local.x, LEVEL)
        )
    ends = []
    for name, wide in zip(local.names, _inflation(local, dof), strict=True):
        wider = None if prior is None else replace(prior, covariance=prior.covariance * wide**2)
        sigma = local.sigma * wide
        if kind == "profile":
            one = profile_fit_interval(problem, found, name, constraints, prior=wider, sigma=sigma)
        else:
            one = profile_intervals(
                *local.triangle, local.names, on_columns(constraints, held), [name],
                prior=wider, sigma=sigma,
            )[name]  # fmt: skip
        ends.append((one.lower, one.upper))
    model = "nonlinear" if kind == "profile" else "linearised"
    text = f"profile of the {model} fit under the constraints, {ONE_SIDED}; assumes normal noise"
    return Intervals(Covariance("constrained profile", matrix, dof, text), np.array(ends))


def _posterior(prior: GaussianPrior | None, local: Local) -> tuple[str, str]:
    noise = "normal noise" if local.loss.quadratic else "independent readings, as Huber's estimate"
    if prior is None:
        return "t under constraints", f"equalities taken for exact, bounds cut off; assumes {noise}"
    return "posterior", f"readings and prior together, the prior taken at its word; assumes {noise}"


def _inflation(local: Local, dof: Array) -> Array:
    """Factors (p,) on σ that turn the normal quantile of a known noise into t of `dof`."""
    t = t_quantile(LEVEL, np.maximum(dof, 1.0))
    return t / stats.norm.ppf((1 + LEVEL) / 2) * np.sqrt(local.variance) / local.sigma
