"""Profile intervals under constraints.

At a bound the estimate is not normal and the likelihood ratio not χ²: where the truth lies on one
bound, it is the mixture ½χ²₀ + ½χ²₁ (Chernoff 1954; Self and Liang 1987), whose 95 % point is
2.71.  The intervals here keep the F quantile of an interior truth (3.84 for many readings).  Away
from bounds they are exact for a linear model with normal noise; at and near one bound they are
conservative (97.5 % for 95 %).  With the truth on two bounds at once the mixture depends on the
angle α > 90° between the two whitened columns of B: they then hold 97.5 % − 14.65 % (α − 90°)/360°,
which is 95 % at 150° and 93.8 % in the limit of 180°, two columns that nearly cancel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import ElastocalError, require
from elastocal.identification.constrained.conflict import extent
from elastocal.identification.constrained.constraints import Bounds, Constraints
from elastocal.identification.constrained.minimise import minimise
from elastocal.identification.constrained.nonlinear import (
    ConstrainedFit,
    constrained_fit,
    fit_system,
)
from elastocal.identification.constrained.objective import Loss, Objective
from elastocal.identification.constrained.prior import GaussianPrior
from elastocal.identification.constrained.solve import objective_of
from elastocal.identification.constrained.system import System
from elastocal.identification.covariance.profile import ProfileInterval, profile_interval
from elastocal.identification.fit import FitProblem

Array = NDArray[np.float64]

INWARD = 1e-6  # of a standard deviation, from an end that only a linear program knows


def profile_intervals(
    B: ArrayLike,
    y: ArrayLike,
    names: Sequence[str],
    constraints: Constraints,
    which: Sequence[str] | None = None,
    *,
    prior: GaussianPrior | None = None,
    sigma: float | None = None,
    level: float = 0.95,
) -> dict[str, ProfileInterval]:
    """{v: (S(v) − Ŝ)/s² ≤ F_{1,dof}(level)} for each parameter of `which` (default all).

    S(v) is the least objective of `solve_constrained` (squares, with the prior) with the parameter
    at v and all constraints kept.  B (rows, p), y (rows,) whitened.  `sigma`, the standard
    deviation of a row, is known (then F is χ²₁) or None: s² = Ŝ/(rows − p).  The interval ends
    ("bound") where no x satisfies the constraints any more, so an active parameter has a
    one-sided interval that starts at its bound.

    Raises InputError as `solve_constrained` does, and for a prior without `sigma`, which alone
    says how data and prior weigh.
    """
    _check_noise(prior, sigma)
    objective = objective_of(B, y, names, prior, "squares", 1, sigma or 1.0)
    system = constraints.resolve(names)
    best = minimise(objective, system)
    free = minimise(objective, _only_equalities(system))
    rows, p = objective.B.shape
    found = {}
    for name in names if which is None else which:
        require(name in system.names, f"{name!r} is not a parameter; choose from {list(names)}")
        i = system.names.index(name)

        def least(value: float, i: int = i) -> float:
            if value == best.x[i]:
                return best.objective
            return minimise(objective, system.with_value(i, value)).objective

        std = float(np.sqrt(free.cofactor[i, i]))
        found[name] = _interval(
            least, float(best.x[i]), std, best.objective, _extent(objective, system, best.x, i),
            rows - p, sigma, level,
        )  # fmt: skip
    return found


def profile_fit_interval(
    problem: FitProblem,
    found: ConstrainedFit,
    name: str,
    constraints: Constraints,
    *,
    prior: GaussianPrior | None = None,
    sigma: float | None = None,
    level: float = 0.95,
) -> ProfileInterval:
    """The profile interval of one fitted parameter of the nonlinear model.

    As `profile_intervals`, with S(v) the objective of `constrained_fit` (squares), which gave
    `found` for the same problem, constraints, prior and sigma.
    """
    _check_noise(prior, sigma)
    require(name in found.names, f"{name!r} was not fitted; choose from {list(found.names)}")
    k = found.names.index(name)
    c = int(found.columns[k])
    system = fit_system(problem, constraints)
    weighted = problem.weights.apply(found.B)
    rows, p = weighted.shape
    linear = Objective(weighted, np.zeros(rows), np.zeros((0, p)), np.zeros(0), Loss())
    free = minimise(linear, _only_equalities(system.moved(found.x[found.columns], np.ones(p))))
    known = [found.x]

    def least(value: float) -> float:
        if value == found.x[c]:
            return found.objective
        start = min(known, key=lambda x: abs(x[c] - value)).copy()
        start[c] = value
        again = constrained_fit(
            replace(problem, x=start),
            constraints + Constraints(bounds=(Bounds(name, value, value),)),
            prior=prior,
            sigma=sigma or 1.0,
        )
        if not again.converged:
            raise ElastocalError(f"no fit with {name} at {value:g}: {again.reason}")
        known.append(again.x)
        return again.objective

    ends = _extent(linear, system, found.x[found.columns], k)
    std = float(np.sqrt(free.cofactor[k, k]))
    return _interval(least, float(found.x[c]), std, found.objective, ends, rows - p, sigma, level)


def _interval(
    least: Callable[[float], float],
    estimate: float,
    std: float,
    best: float,
    ends: tuple[float, float],
    dof: int,
    sigma: float | None,
    level: float,
) -> ProfileInterval:
    if std == 0 or ends[0] == ends[1]:  # equalities leave a single value
        return ProfileInterval(estimate, estimate, ("bound", "bound"))
    require(dof > 0 or sigma is not None, "no degree of freedom is left; state the noise as sigma")
    if sigma is None:
        return profile_interval(
            least, estimate, std * np.sqrt(best / dof), dof, level, ends[0], ends[1]
        )
    return profile_interval(
        lambda v: least(v) / sigma**2, estimate, std * sigma, np.inf, level, ends[0], ends[1]
    )


def _extent(objective: Objective, system: System, x: Array, index: int) -> tuple[float, float]:
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


def _check_noise(prior: GaussianPrior | None, sigma: float | None) -> None:
    require(
        prior is None or sigma is not None,
        "with a prior the noise must be known: state sigma, the standard deviation of a whitened "
        "row, or the weights of data and prior are arbitrary",
    )
