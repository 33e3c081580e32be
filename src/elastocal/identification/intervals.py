"""Standard deviations and 95 % intervals of the fitted parameters, by the method asked for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from elastocal.errors import InputError, option
from elastocal.identification.constrained import (
    ActiveConstraint,
    KnowledgeProblem,
    constrained_fit,
    profile_end,
)
from elastocal.identification.covariance import Covariance, cluster_robust, hc, t_quantile
from elastocal.identification.knowledge import Constraints
from elastocal.identification.least_squares import Fit
from elastocal.identification.noise_choice import NoiseFit
from elastocal.identification.smooth_functions import SmoothPart
from elastocal.identification.solve import Solution, residual_sigma
from elastocal.identification.weighted_problem import (
    Partition,
    Span,
    in_order,
    regressor,
    same_size,
)
from elastocal.units import Array, BoolArray

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

    def meat(span: Span) -> Array:
        part = parts.part(span)
        at = regressor(fit.problem.model, part, fit.x, fit.columns)
        B, e = part.weights.apply(at.B), part.weights.apply(at.residual)
        rows_of = np.repeat(part.observations.configuration, part.observations.size)
        scores = [np.einsum("grp,gr->gp", B[rows], e[rows]) for rows in same_size(rows_of)]
        S = np.concatenate(scores)
        return np.asarray(S.T @ S)

    p = len(fit.columns)
    middle = sum(in_order(parts.spans, meat), np.zeros((p, p)))
    n, G = len(parts.observed.value), parts.observed.n_configurations
    factor = G / (G - 1) * (n - 1) / (n - p)
    cofactor = fit.cofactor()
    matrix = factor * cofactor @ middle @ cofactor
    text = f"readings of a configuration may depend on each other ({G} configurations)"
    return Covariance("CR1", matrix, np.full(p, float(G - 1)), text)


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
    B, e = problem.weights.apply(fit.B), fit.whitened
    if kind.startswith("hc"):
        return by_t(hc(B, e, kind.upper()))
    rows_of = np.repeat(observed.configuration, observed.size)
    return by_t(cluster_robust(B, e, rows_of, kind.upper()))


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
