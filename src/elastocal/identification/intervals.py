"""Standard deviations and 95 % intervals of the fitted parameters, by the method asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from elastocal.errors import InputError, option
from elastocal.identification.cluster_by_parts import cluster_by_parts, worth_clustering
from elastocal.identification.covariance.cluster import cluster_robust
from elastocal.identification.covariance.estimate import Covariance
from elastocal.identification.covariance.heteroscedastic import hc
from elastocal.identification.covariance.parametric_bootstrap import parametric_bootstrap
from elastocal.identification.covariance.profile import profile_interval, profile_of
from elastocal.identification.covariance.wild_bootstrap import wild_cluster_bootstrap
from elastocal.identification.solve import Solution, residual_sigma
from elastocal.identification.variance.choose import NoiseFit, estimate_noise
from elastocal.identification.weighting import linearised

Array = NDArray[np.float64]
IntervalKind = Literal[
    "auto", "classical", "hc0", "hc1", "hc2", "hc3", "hc4", "cr0", "cr1", "cr2", "cr3",
    "wild", "bootstrap", "profile",
]  # fmt: skip
KINDS = get_args(IntervalKind)
LEVEL = 0.95
DRAWS = 999


@dataclass(frozen=True)
class Intervals:
    """Covariance of the fitted parameters and their 95 % intervals (fitted, 2)."""

    covariance: Covariance
    ci95: Array

    @property
    def kind(self) -> str:
        return self.covariance.kind


def intervals_of(
    solution: Solution, kind: IntervalKind, noise: NoiseFit | None, seed: int = 0, jobs: int = 1
) -> Intervals:
    """Intervals of the solution's fitted parameters.

    auto: those of the estimated noise (Kenward–Roger), where there is one, else classical, or in
    a large table with several readings per configuration cr1;
    classical: s²(BᵀW²B)⁻¹ with t (eq. 7, 13); hc…, cr…: sandwich, clusters being configurations;
    wild: bootstrap of those; bootstrap: parametric, with the noise estimated in each draw;
    profile: of the nonlinear sum of squares.

    Raises InputError for a kind that the problem does not allow, InsufficientDataError where
    the data cannot give it.
    """
    fit, seen = solution.fit, solution.problem.observations
    x = fit.x[fit.columns]
    if kind == "auto" and noise is not None:
        return _by_t(noise.covariance, x)
    problem = solution.problem
    clustered = problem.large and worth_clustering(problem.parts, len(x))
    if (kind == "cr1" and problem.large) or (kind == "auto" and clustered):
        return _by_t(cluster_by_parts(fit, problem.parts), x)
    classical = _classical(solution)
    if kind in ("auto", "classical"):
        return _by_t(classical, x)
    if problem.large:
        raise InputError(
            f"{option('intervals', kind)} needs B as a whole, which a table of this size does not "
            "allow; use cr1 or classical"
        )
    size = solution.sizes[fit.columns]
    B, e = solution.problem.weights.apply(fit.B * size), fit.whitened
    cluster = np.repeat(seen.configuration, seen.size)
    if kind.startswith("hc"):
        return _by_t(_scaled(hc(B, e, kind.upper()), size), x)  # type: ignore[arg-type]
    if kind.startswith("cr"):
        found = cluster_robust(B, e, cluster, kind.upper())  # type: ignore[arg-type]
        return _by_t(_scaled(found, size), x)
    if kind == "wild":
        wild = wild_cluster_bootstrap(B, e, cluster, draws=DRAWS, seed=seed)
        spread = _scaled(cluster_robust(B, e, cluster, "CR2"), size)
        ci95 = x[:, None] + size[:, None] * wild.interval(LEVEL)
        return Intervals(Covariance("wild", spread.matrix, spread.dof, wild.description), ci95)
    if kind == "bootstrap":
        return _bootstrapped(solution, noise, classical, seed, jobs)
    return _profiled(solution, classical)


def _by_t(covariance: Covariance, x: Array) -> Intervals:
    return Intervals(covariance, covariance.interval(x, LEVEL))


def _classical(solution: Solution) -> Covariance:
    fit = solution.fit
    sigma = residual_sigma(fit, len(fit.columns))
    dof = len(fit.whitened) - len(fit.columns)
    return Covariance(
        "classical", sigma**2 * fit.cofactor(), np.full(len(fit.columns), float(dof)),
        "all readings independent, their noise scaled to the residual",
    )  # fmt: skip


def _scaled(found: Covariance, size: Array) -> Covariance:
    """From parameters in typical sizes to their own units."""
    return Covariance(found.kind, found.matrix * np.outer(size, size), found.dof, found.description)


def _bootstrapped(
    solution: Solution, noise: NoiseFit | None, classical: Covariance, seed: int, jobs: int
) -> Intervals:
    """Residuals drawn from the noise model, everything estimated anew on the linearised model."""
    fit, problem = solution.fit, solution.problem
    seen, weights = problem.observations, problem.weights
    sigma = residual_sigma(fit, len(fit.columns))
    readings = linearised(problem.model, seen, fit.x, fit.columns)
    whiten = None if weights.whiten is None else weights.whiten.tocsc()

    def draw(rng: np.random.Generator) -> Array:
        z = sigma * rng.normal(size=len(seen.value))
        return z if whiten is None else sparse.linalg.spsolve(whiten, z)

    size = solution.sizes[fit.columns]
    B = weights.apply(fit.B * size)

    def estimate(e: Array) -> Array:
        if noise is None:
            return linalg.lstsq(B, weights.apply(e))[0] * size
        return estimate_noise(readings.moved(e.reshape(readings.e.shape)), noise.kind).x

    found = parametric_bootstrap(draw, estimate, draws=DRAWS, seed=seed, jobs=jobs)
    x = fit.x[fit.columns]
    around = x[:, None] + found.interval(np.zeros(len(x)), LEVEL)
    return Intervals(
        Covariance("bootstrap", found.covariance().matrix, classical.dof, found.description), around
    )


def _profiled(solution: Solution, classical: Covariance) -> Intervals:
    fit = solution.fit
    ends = []
    for k, c in enumerate(fit.columns.tolist()):
        parameter = solution.problem.model.parameters[c]
        lower, upper = (
            (parameter.lower, parameter.upper) if solution.problem.bounded else (-np.inf, np.inf)
        )
        found = profile_interval(
            profile_of(fit.problem, fit, c), float(fit.x[c]), float(classical.std[k]),
            float(classical.dof[k]), LEVEL, lower, upper,
        )  # fmt: skip
        ends.append((found.lower, found.upper))
    text = "profile of the nonlinear sum of squares (all readings independent)"
    return Intervals(Covariance("profile", classical.matrix, classical.dof, text), np.array(ends))
