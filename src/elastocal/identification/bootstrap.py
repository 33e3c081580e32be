"""Bootstrap intervals: wild by clusters of residuals, or parametric from the fitted model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from elastocal.errors import ElastocalError, InsufficientDataError, require
from elastocal.identification.covariance import (
    Clusters,
    Covariance,
    Orthogonal,
    cluster_robust,
    clusters_of,
    orthogonal,
)
from elastocal.units import Array

# Parametric bootstrap: simulate from the fitted model, fit again, look at the spread.
#
# It makes no linearisation: bias and skewness of the estimator show in the draws.  It is as good as
# the noise model that `draw` simulates.

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
        bias = special.ndtri(np.clip(below, 0.5 / n, 1 - 0.5 / n))
        z = special.ndtri((1 + level) / 2)
        ends = special.ndtr(2 * bias[:, None] + [-z, z])
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


# Wild cluster bootstrap of the t statistic: intervals that hold with few clusters.
#
# Cameron, Gelbach & Miller 2008; Webb 2023 for the six-point weights; MacKinnon & Webb 2018 for few
# clusters.  A draw multiplies the residual of every cluster by a random v_g, refits, and compares
# the cluster-robust t statistic with that of the data.  To test x_j = value, the residual is that
# of the fit with x_j held there, which is linear in δ = x̂_j − value:
#
#     ẽ = ê + δ Q ℓ/|ℓ|²,   B = QR,  x̂ = V Qᵀy,  ℓ = row j of V
#
# With the cluster scores g̃_c = Q_cᵀẽ_c, M_c = Q_cᵀQ_c and s = Σ_c v_c g̃_c, a draw gives
#
#     t* = ℓᵀs / √Σ_c (v_c ℓᵀg̃_c − ℓᵀM_c s)²
#
# Numerator and radicand are polynomials in δ of degree 1 and 2.  Their five coefficients per draw
# and parameter are all that is kept, so no draw is ever refitted, and testing any value costs only
# the number of draws.

WildWeights = Literal["auto", "rademacher", "webb"]

ENTRIES = 2**22  # of a temporary array (draws, clusters), 32 MB
FEW = 12  # clusters below which Rademacher weights have too few distinct draws (Webb 2023)
POINTS = {
    "rademacher": np.array([-1.0, 1.0]),
    "webb": np.sqrt([1.5, 1.0, 0.5])[[0, 1, 2, 2, 1, 0]] * [-1, -1, -1, 1, 1, 1],
}
TIE = 1e-9  # relative difference below which |t*| equals |t|
# |δ|/std at which the test is evaluated before bisection: a fine range about any usual quantile,
# and on to where only an unbounded interval goes.
PROBES = np.concatenate([np.arange(0.05, 12, 0.05), 12 * 2.0 ** np.arange(0, 20, 0.25)])


@dataclass(frozen=True)
class WildBootstrap:
    """Bootstrap draws of the t statistic of every parameter.

    `x` (p,) and its CR0 `std` (p,), by which t is studentised (a constant correction would
    cancel), infinite where a parameter hangs on a single cluster.  `top` (p, 2, draws) and
    `radicand` (p, 3, draws): t* = (top₀ + top₁δ) / √(radicand₀ + radicand₁δ + radicand₂δ²).
    `exact`: the draws are all there are, one of each pair ±v.
    """

    x: Array
    std: Array
    top: Array
    radicand: Array
    weights: str
    exact: bool

    @property
    def description(self) -> str:
        """What was drawn, in words."""
        draws = self.top.shape[2]
        what = f"all {draws} distinct" if self.exact else f"{draws} random"
        return f"wild cluster bootstrap, {what} draws of {self.weights} weights"

    def p_value(self, index: int, value: float, restricted: bool = True) -> float:
        """Two-sided p of x_index = value: how often |t*| ≥ |t|.

        `restricted` imposes the value in the bootstrap residuals (WCR), else x̂ (WCU).  Random
        draws count the data as one more draw (Davison & Hinkley 1997, section 4.2).  1 where the
        parameter hangs on a single cluster.
        """
        delta = np.array([self.x[index] - value])
        return float(self._p_values(index, delta, restricted)[0])

    def interval(self, level: float = 0.95, restricted: bool = True) -> Array:
        """Intervals (p, 2): the values whose `p_value` exceeds 1 − level.

        `restricted` (default) inverts the test with the null imposed, so the interval need not
        be symmetric; its ends are the outermost values not rejected.  Otherwise the symmetric
        percentile-t interval.  An end is infinite where no value is rejected, as happens when the
        clusters allow fewer than 1/(1 − level) distinct draws.

        Raises InputError where `level` asks for more than the random draws can tell.
        """
        alpha = 1 - level
        draws = self.top.shape[2]
        require(0 < level < 1, f"level must lie between 0 and 1, for example 0.95; got {level}")
        require(
            self.exact or (draws + 1) * alpha >= 1 - TIE,
            f"a level of {level} needs at least {np.ceil(1 / alpha - 1):.0f} draws; got {draws}",
        )
        below, above = (
            [self._reach(j, sign, alpha, restricted) for j in range(self.x.size)]
            for sign in (1.0, -1.0)
        )
        return np.column_stack([self.x - below, self.x + above])

    def _reach(self, j: int, sign: float, alpha: float, restricted: bool) -> float:
        """Largest |δ| not rejected on one side (`sign` of δ = x̂_j − value)."""
        if np.isinf(self.std[j]):
            return np.inf

        def accepted(size: Array) -> Array:
            return self._p_values(j, sign * size, restricted) - alpha

        sizes = self.std[j] * PROBES
        inside = np.flatnonzero(accepted(sizes) > 0)
        if inside.size == 0:
            return float(sizes[0])
        last = int(inside[-1])
        if last == sizes.size - 1:
            return np.inf
        found = optimize.bisect(
            lambda size: 1.0 if accepted(np.array([size]))[0] > 0 else -1.0,
            sizes[last], sizes[last + 1], xtol=1e-9 * sizes[last],
        )  # fmt: skip
        return float(found)

    def _p_values(self, j: int, delta: Array, restricted: bool) -> Array:
        """p (k,) for several δ (k,)."""
        d = delta[:, None] if restricted else np.zeros((delta.size, 1))
        top = self.top[j, 0] + d * self.top[j, 1]
        radicand = self.radicand[j, 0] + d * (self.radicand[j, 1] + d * self.radicand[j, 2])
        t2 = (delta[:, None] / self.std[j]) ** 2
        count = np.count_nonzero(top**2 >= (1 - TIE) * t2 * radicand, axis=1)
        draws = self.top.shape[2]
        return count / draws if self.exact else (count + 1) / (draws + 1)


def wild_cluster_bootstrap(
    B: ArrayLike,
    y: ArrayLike,
    cluster: ArrayLike,
    draws: int = 999,
    seed: int = 0,
    weights: WildWeights = "auto",
) -> WildBootstrap:
    """Wild cluster bootstrap-t of the least-squares fit y ≈ B x for every parameter.

    B (n, p), y (n,) whitened, `cluster` (n,) integer labels.  `weights`: "rademacher" (±1),
    "webb" (six points), or "auto": Webb below 12 clusters.  Where no more than `draws` distinct
    draws exist they are enumerated and the test is exact in them.  Choose `draws` so that
    (draws + 1)(1 − level) is whole.  A nonlinear fit passes B and y = B x̂ + e at its solution.

    Cost: draws × clusters × p per parameter, in 32 MB blocks.  Raises InputError and
    InsufficientDataError as `cluster_robust`.
    """
    require(draws >= 1, f"draws must be at least 1, got {draws}")
    known = get_args(WildWeights)
    require(weights in known, f"weights must be one of {known}; got {weights!r}")
    factors, y = orthogonal(B, y)
    groups = clusters_of(cluster, y.size)
    e = y - factors.Q @ (factors.Q.T @ y)
    spread = cluster_robust(B, e, cluster, "CR0")
    require(
        bool((spread.std > 0).all()),
        "the fit leaves no residual in some parameter, so there is nothing to resample",
    )
    chosen = weights
    if weights == "auto":
        chosen = "webb" if len(groups) < FEW else "rademacher"
    points = POINTS[chosen]
    distinct = len(points) ** len(groups) // 2  # v and −v give the same |t*|
    exact = distinct <= draws
    draws = distinct if exact else draws
    top, radicand = _draw(factors, e, groups, _weights(points, len(groups), draws, exact, seed))
    x = factors.V @ (factors.Q.T @ y)
    return WildBootstrap(x, spread.std, top, radicand, chosen, exact)


def _weights(points: Array, clusters: int, draws: int, exact: bool, seed: int) -> Iterator[Array]:
    """Weights v (block, clusters), block by block."""
    rng = np.random.default_rng(seed)
    base = len(points)
    block = max(1, ENTRIES // clusters)
    for first in range(0, draws, block):
        number = np.arange(first, min(first + block, draws))
        if exact:  # digits of the number, the leading one below base/2: one of each pair ±v
            digits = number[:, None] // base ** np.arange(clusters - 1, -1, -1) % base
        else:
            digits = rng.integers(0, base, (number.size, clusters))
        yield points[digits]


def _draw(
    factors: Orthogonal, e: Array, groups: Clusters, weights: Iterator[Array]
) -> tuple[Array, Array]:
    """Coefficients of numerator (p, 2, draws) and radicand (p, 3, draws)."""
    Q, V = factors.Q, factors.V
    score = groups.sums(Q * e[:, None])
    parts = []
    for v in weights:
        s0 = v @ score
        block = np.empty((len(V), 5, len(v)))
        for j, row in enumerate(V):
            by_cluster = groups.sums(Q * (Q @ row)[:, None])  # M_c ℓ
            tilted = by_cluster / (row @ row)
            s1 = v @ tilted
            c0 = v * (score @ row) - s0 @ by_cluster.T
            c1 = v * (tilted @ row) - s1 @ by_cluster.T
            block[j] = [
                s0 @ row, s1 @ row,
                np.sum(c0 * c0, axis=1), 2 * np.sum(c0 * c1, axis=1), np.sum(c1 * c1, axis=1),
            ]  # fmt: skip
        parts.append(block)
    found = np.concatenate(parts, axis=2)
    return found[:, :2], found[:, 2:]
