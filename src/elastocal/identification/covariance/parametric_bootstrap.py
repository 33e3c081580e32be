"""Parametric bootstrap: simulate from the fitted model, fit again, look at the spread.

It makes no linearisation: bias and skewness of the estimator show in the draws.  It is as good as
the noise model that `draw` simulates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.errors import ElastocalError, InsufficientDataError, require
from elastocal.identification.covariance.estimate import Covariance

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Array]
FitAgain = Callable[[Array], Array]

TOLERATED = 0.05  # share of failed draws above which the rest may not be representative


@dataclass(frozen=True)
class ParametricBootstrap:
    """Refitted parameters `draws` (n, p) in the order of their seeds, and how many fits failed."""

    draws: Array
    failures: int

    @property
    def description(self) -> str:
        """What was done, and a caution where more than 5 % of the fits failed."""
        n = len(self.draws)
        text = f"parametric bootstrap, {n} draws"
        if self.failures:
            text += f", {self.failures} more failed to fit"
        if self.failures > TOLERATED * (n + self.failures):
            text += "; so many failures bias what is left: find their cause before use"
        return text

    def covariance(self) -> Covariance:
        """Sample covariance of the draws, with infinite dof (normal intervals)."""
        matrix = np.atleast_2d(np.cov(self.draws, rowvar=False))
        dof = np.full(self.draws.shape[1], np.inf)
        return Covariance("parametric_bootstrap", matrix, dof, self.description)

    def interval(self, x: Array, level: float = 0.95) -> Array:
        """Bias-corrected percentile intervals (p, 2) about the estimate x (p,) simulated from.

        With b = Φ⁻¹(share of draws below x_j), ties counted half, the ends are the draws'
        quantiles at Φ(2b ± z), z = Φ⁻¹((1 + level)/2) (Efron & Tibshirani 1993, section 14.3,
        a = 0).  Like the estimator it transforms with the parameter, so an interval of a
        compliance is that of the stiffness inverted, and a median bias of b is undone.

        Raises InputError where x does not match or the draws are too few for `level`: at least
        one must lie beyond each end.
        """
        n, p = self.draws.shape
        require(0 < level < 1, f"level must lie between 0 and 1, for example 0.95; got {level}")
        require(np.shape(x) == (p,), f"x must have shape ({p},), got {np.shape(x)}")
        require(
            n * (1 - level) >= 2,
            f"a level of {level} needs at least {np.ceil(2 / (1 - level)):.0f} draws; got {n}",
        )
        below = np.mean(self.draws < x, axis=0) + np.mean(self.draws == x, axis=0) / 2
        bias = stats.norm.ppf(np.clip(below, 0.5 / n, 1 - 0.5 / n))
        z = stats.norm.ppf((1 + level) / 2)
        ends = stats.norm.cdf(2 * bias[:, None] + [-z, z])
        columns = [np.quantile(self.draws[:, j], ends[j]) for j in range(p)]
        return np.array(columns)


def parametric_bootstrap(
    draw: Draw, fit: FitAgain, draws: int = 999, seed: int = 0, jobs: int = 1
) -> ParametricBootstrap:
    """Refit `draws` simulated data sets: draw(rng) -> y (rows,), fit(y) -> x (p,).

    Every draw has its own generator, spawned from `seed`, so the result does not depend on
    `jobs`, the number of processes (−1: all cores); with more than one, `draw` and `fit` must
    pickle.  A fit that raises ElastocalError or returns what is not
    finite is a failed draw.

    Raises InputError where draws < 2, InsufficientDataError where fewer than two fits succeed.
    """
    require(draws >= 2, f"a bootstrap needs at least 2 draws, got {draws}")
    require(jobs != 0, "jobs is the number of processes, or -1 for all cores; got 0")
    seeds = np.random.SeedSequence(seed).spawn(draws)
    found = _chunk(draw, fit, seeds) if jobs == 1 else _parallel(draw, fit, seeds, jobs)
    fitted = [x for x in found if x is not None]
    if len(fitted) < 2:
        raise InsufficientDataError(
            f"{draws - len(fitted)} of {draws} bootstrap fits failed; the model cannot be fitted"
            " to data like these"
        )
    return ParametricBootstrap(np.array(fitted), draws - len(fitted))


def _parallel(
    draw: Draw, fit: FitAgain, seeds: Sequence[np.random.SeedSequence], jobs: int
) -> list[Array | None]:
    from joblib import Parallel, delayed, effective_n_jobs

    chunks = min(len(seeds), 8 * effective_n_jobs(jobs))  # a slow chunk must not hold up the rest
    tasks = (delayed(_chunk)(draw, fit, seeds[k::chunks]) for k in range(chunks))
    parts = Parallel(n_jobs=jobs)(tasks)
    found: list[Array | None] = [None] * len(seeds)
    for k, part in enumerate(parts):
        found[k::chunks] = part
    return found


def _chunk(
    draw: Draw, fit: FitAgain, seeds: Sequence[np.random.SeedSequence]
) -> list[Array | None]:
    found: list[Array | None] = []
    for seed in seeds:
        try:
            x = np.asarray(fit(draw(np.random.default_rng(seed))), dtype=np.float64)
        except ElastocalError:
            found.append(None)
            continue
        found.append(x if np.isfinite(x).all() else None)
    return found
