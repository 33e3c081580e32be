"""Standard deviations and 95 % intervals of the fitted parameters, by the method asked for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from elastocal.identification.constrained import (
    ActiveConstraint,
    KnowledgeProblem,
    constrained_fit,
    profile_end,
)
from elastocal.identification.covariance import Covariance, Rows, clustered, of_rows, t_quantile
from elastocal.identification.knowledge import Constraints
from elastocal.identification.least_squares import Fit
from elastocal.identification.noise_choice import NoiseFit
from elastocal.identification.smooth_functions import SmoothPart
from elastocal.identification.solve import Solution, residual_sigma
from elastocal.identification.weighted_problem import (
    Part,
    each,
    regressor,
)
from elastocal.units import Array, BoolArray

# Configurations per parameter from which the scatter of those of a large table counts.
ENOUGH = 10

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

    Raises InsufficientDataError where the data cannot give it.
    """
    fit, observed = solution.fit, solution.problem.observations
    x = fit.x[fit.columns]

    def by_t(covariance: Covariance) -> Intervals:
        return Intervals(covariance, covariance.interval(x, LEVEL))

    if kind == "auto" and noise is not None:
        return by_t(noise.covariance)
    problem = solution.problem
    if kind == "auto" and problem.large:
        configurations = observed.n_configurations
        several = len(observed.lead) > configurations >= ENOUGH * len(x)
        kind = "cr1" if several else kind
    if kind in ("auto", "classical"):
        return by_t(_classical(solution))
    if kind == "profile":
        return _profiled(solution, _classical(solution))
    found = _clustered(fit, kind)
    return by_t(of_rows(found, len(fit.whitened), kind.upper()) if kind[0] == "h" else found)


def _clustered(fit: Fit, kind: str) -> Covariance:
    """Over configurations, or rows by themselves, in passes over the parts of the table."""
    problem, V = fit.problem, fit.r_factor.half

    def rows(part: Part) -> Rows:
        at, own = regressor(problem.model, part, fit.x, fit.columns), part.observations
        labels = part.rows if kind[0] == "h" else np.repeat(own.configuration, own.size)
        return part.weights.apply(at.B @ V), part.weights.apply(at.residual), labels

    return clustered(each(problem.parts, rows), V, f"CR{kind[2]}")


def _classical(solution: Solution) -> Covariance:
    fit = solution.fit
    sigma = residual_sigma(fit, len(fit.columns))
    dof = len(fit.whitened) - len(fit.columns)
    return Covariance(
        "classical", sigma**2 * fit.cofactor(), np.full(len(fit.columns), float(dof)),
        "all readings independent, their noise scaled to the residual",
    )  # fmt: skip


def _profiled(solution: Solution, classical: Covariance) -> Intervals:
    """{v: S(v) − Ŝ ≤ t² s²}, the fit being at its minimum."""
    fit = solution.fit
    sigma = residual_sigma(fit, len(fit.columns))
    posed = solution.problem, fit.columns, fit.x, solution.sizes
    found = constrained_fit(KnowledgeProblem.of(*posed, Constraints(), None, sigma))
    rises = (sigma * t_quantile(LEVEL, classical.dof)) ** 2
    ends = [
        [profile_end(found, k, float(rise), side) for side in (-1, 1)]
        for k, rise in enumerate(rises)
    ]
    text = "profile of the nonlinear sum of squares (all readings independent)"
    return Intervals(replace(classical, kind="profile", description=text), np.array(ends))


# What a method ends with.


@dataclass(frozen=True)
class MethodResult:
    """The final fit, its intervals, and the noise where it was estimated.

    Readings that are not `good` (N,) lie beyond the noise, whether or not they had a part in the
    fit.  What constraints and a prior add: `active` constraints, `prior_share` by parameter, how
    many parameters the readings paid for (`effective`), `leverage` (rows,), and `warnings` where
    the readings contradict them; in a fit to readings alone effective and leverage follow from
    the solution.  `smooth` are the smooth functions, with which `standard` (N, size) are the
    residuals of all readings free of the fit's part in them.  `limits` are the 95 % intervals of
    the parameters that the readings `hardly_shown`, by their index.
    """

    method: str
    solution: Solution
    intervals: Intervals
    noise: NoiseFit | None
    good: BoolArray
    active: tuple[ActiveConstraint, ...] = ()
    prior_share: dict[str, float] = field(default_factory=dict)
    effective: int | None = None
    leverage: Array | None = None
    warnings: tuple[str, ...] = ()
    smooth: tuple[SmoothPart, ...] = ()
    standard: Array | None = None
    limits: dict[int, tuple[float, float]] = field(default_factory=dict)
