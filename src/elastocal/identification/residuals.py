"""Residuals: held out in closed form, by group, and whether they look as the noise model says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, special

from elastocal.identification.weighted_problem import Part, Problem, Weights, same_size
from elastocal.measurements import numbered
from elastocal.messages import load_text
from elastocal.model.observations import COMPONENTS, Observations
from elastocal.units import Array, BoolArray, IntArray

# Held-out residuals: cross-validation over configurations in closed form.

ALONE = 1e-9  # share of a direction that the other configurations must see


def held_out_residual(
    B: Array, residual: Array, weights: Weights, configuration: IntArray, size: int
) -> Array:
    """Residual (rows,) of every configuration under the fit to all the others.

    With whitened B = QR and whitened residual e, leaving configuration c out moves the estimate
    by x̂ − x̂₍₋c₎ = R⁻¹ Q_cᵀ (I − Q_c Q_cᵀ)⁻¹ e_c, exactly for a linear model (Allen 1974, PRESS,
    by groups); the residual of c then grows by B_c times that.  A configuration that alone
    determines a parameter has no held-out residual: its rows are infinite.

    B (rows, columns) and residual (rows,) raw; `configuration` (observations,), `size` rows each.
    Where all readings are correlated, as by a drift, those of `weights.together` are left out at a
    time.
    """
    rows, e = weights.beside_common(B, residual)
    Q, R = linalg.qr(rows, mode="economic")
    n, k = len(B), len(rows) - len(B)
    code = np.repeat(configuration if weights.together is None else weights.together, size)
    if k:
        # What all have in common are columns beside B, held by rows of their own that never go out;
        # what is predicted is without them.
        e = e - Q @ (Q.T @ e)
        B = np.pad(B, ((0, k), (0, k)))
        code = np.concatenate([code, code.max() + 1 + np.arange(k)])
    seen = np.asarray(linalg.solve_triangular(R, B.T, trans="T").T)
    return residual + growth(seen, Q, e, code)[:n]


def held_out_by_parts(
    problem: Problem, x: Array, columns: IntArray, half: Array, step: Array | None = None
) -> tuple[Array, Array]:
    """The same with the model linearised at x, a part at a time, and the leverage (rows,) of each.

    `half` (columns, q) with half · halfᵀ the cofactor of the estimates: R⁻¹ of the whitened B, or
    the directions in which constraints let them move.  `step` (parameters,) is the Gauss–Newton
    step to the linear model's minimum, where x is not it.
    """
    held, leverage = np.empty((2, len(problem.observations.value)))
    together, size = problem.weights.together, problem.observations.size

    def leave_out(part: Part) -> None:
        at = problem.regressor(part, x, columns)
        residual = at.residual
        if step is not None:
            moved = np.flatnonzero(step)
            residual = residual - problem.regressor(part, x, moved).B @ step[moved]
        B = at.B @ half
        Q, e = part.weights.apply(B), part.weights.apply(residual)
        labels = part.observations.configuration if together is None else together
        held[part.rows] = residual + growth(B, Q, e, np.repeat(labels, size))
        leverage[part.rows] = np.minimum((Q**2).sum(axis=1), 1.0)

    list(problem.each(leave_out))
    return held, leverage


def growth(B: Array, Q: Array, e: Array, configuration: IntArray) -> Array:
    """By how much (rows,) the residual grows where its configuration is left out; B are columns
    that are orthonormal as whitened ones, Q."""
    grown = np.empty(len(e))
    for rows, moved, alone in left_out(Q, e, configuration):
        grown[rows] = (B[rows] @ moved[..., None])[..., 0]
        grown[rows[alone]] = np.inf
    return grown


def left_out(
    Q: Array, e: Array, configuration: IntArray
) -> Iterator[tuple[IntArray, Array, BoolArray]]:
    """Rows (g, m) of configurations of one size, Q_cᵀ (I − Q_c Q_cᵀ)⁻¹ e_c (g, columns), and which
    are alone in some direction: there the latter is meaningless."""
    for rows in same_size(configuration):
        Qc, Qt = Q[rows], Q[rows].transpose(0, 2, 1)
        # (I − Q_cᵀQ_c)⁻¹ Q_cᵀ is the same map, by a matrix of the parameters' size.
        many = rows.shape[1] > Q.shape[1]
        share = Qt @ Qc if many else Qc @ Qt
        gap, alone = np.eye(share.shape[1]) - share, np.zeros(len(share), dtype=bool)
        # The largest eigenvalue is at most the trace: only configurations of weight need theirs.
        heavy = np.flatnonzero(np.trace(share, axis1=1, axis2=2) >= 0.5)
        alone[heavy] = np.linalg.eigvalsh(gap[heavy])[:, 0] < ALONE
        gap[alone] = np.eye(share.shape[1])
        own = e[rows][..., None]
        moved = np.linalg.solve(gap, Qt @ own) if many else Qt @ np.linalg.solve(gap, own)
        yield rows, np.asarray(moved[..., 0], dtype=np.float64), alone


def told_by_one(B: Array, configuration: IntArray) -> Array:
    """P (columns, columns): the part P·δ of a deviation δ of the estimates that the readings of one
    of these configurations alone hold, so that nothing checks it.

    With whitened B = QR, a direction u of Q_c with Q_cᵀQ_c u = u is shown by configuration c only
    (all other Q are at right angles to it); with these as columns of U, P = R⁻¹ U Uᵀ R.
    `configuration` (rows,), −1 where the others can do without it.
    """
    Q, R = linalg.qr(B, mode="economic")
    found = [np.zeros((len(R), 0))]
    for c in np.unique(configuration[configuration >= 0]):
        share, direction = np.linalg.eigh(Q[configuration == c].T @ Q[configuration == c])
        found.append(direction[:, share > 1 - ALONE])
    U = np.hstack(found)
    return np.asarray(linalg.solve_triangular(R, U) @ (U.T @ R))


def as_of_another_campaign(B: Array, weights: Weights, size: int) -> Array:
    """Factors (rows,) that make what blocks in time are off by what a campaign of another day is.

    Blocks of one campaign share part of the drift FFᵀ, and the fit follows it.  With x̂ and û the
    estimates of parameters and drift from the other blocks, C = cov(x̂ − x, û − u) and Σ₀ the other
    noise, a reading of the block that was left out and one with a drift of its own vary by

        Σ₀ + FFᵀ + B C_xx Bᵀ + F C_ux Bᵀ + (F C_ux Bᵀ)ᵀ     and     Σ₀ + FFᵀ + B C_xx Bᵀ

    (cov(x̂, û) = 0: Henderson 1975, Biometrics 31, 423).
    """
    F, together = weights.common, weights.together
    assert F is not None and together is not None and weights.whiten is not None
    p, k = B.shape[1], F.shape[1]
    Q, R = linalg.qr(weights.beside_common(B, np.zeros(len(B)))[0], mode="economic")
    T = linalg.solve_triangular(R, np.eye(p + k))
    factor = np.ones(len(B))
    block, whiten = np.repeat(together, size), weights.whiten.tocsr()
    for b in np.unique(block):
        rows = np.flatnonzero(block == b)
        gap = np.eye(p + k) - Q[rows].T @ Q[rows]
        if np.linalg.eigvalsh(gap)[0] < ALONE:
            continue
        C = T @ np.linalg.solve(gap, T.T)
        own = np.linalg.inv(whiten[rows][:, rows].toarray())
        new = (own**2).sum(axis=1) + (F[rows] ** 2).sum(axis=1)
        new += ((B[rows] @ C[:p, :p]) * B[rows]).sum(axis=1)
        shared = ((F[rows] @ C[p:, :p]) * B[rows]).sum(axis=1)
        factor[rows] = np.sqrt(new / (new + 2 * shared))
    return factor


def rms_3d(residual: Array, size: int) -> float:
    """Root mean square length in m of the position part of the residual (rows,)."""
    parts = residual.reshape(-1, size)[:, :3]
    return float(np.sqrt((parts**2).sum(axis=1).mean()))


# Does a wider set of parameters predict better?  A test, since any gain is taken too often.

CHANCE = 0.01  # of the wider set being taken though the parameters it adds are none


def f_test(
    gain: float | Array, columns: int, rest: float | Array, dof: float | Array
) -> tuple[Any, Any]:
    """F and its p-value where `columns` took `gain` off a sum of squares of whitened residuals, of
    which `rest` is left with `dof` degrees of freedom: p is the chance of that if they are none."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # nothing is left
        F = np.divide(gain, columns) * dof / rest
    return F, special.fdtrc(columns, dof, F)


def predicts_better(
    narrow: Array, wide: Array, weights: Weights, configuration: IntArray, size: int
) -> bool:
    """Do the held-out residuals `wide` (rows,) of more parameters show that `narrow` (rows,) lacks
    some?

    Both models see the same noise, and the wider one errs more from estimating more: under the
    narrow one's truth f_c = |n_c|² − (|w_c|² − |n_c − w_c|²) = 2 n_cᵀ(n_c − w_c), whitened, has
    the mean zero over configurations c, since n_c − w_c comes from the others (Clark and West
    2007, J. Econometrics 138, 291).  True where its t exceeds the quantile of a one-sided test and
    the squares themselves became smaller.
    """
    before, after = rms_3d(narrow, size), rms_3d(wide, size)
    if not after < before < np.inf:
        return bool(after < before)
    n, w = weights.apply(narrow), weights.apply(wide)
    own = np.repeat(numbered(configuration), size)
    f = np.bincount(own, 2 * n * (n - w))
    if len(f) < 2:
        return False
    deviation = float(f.std(ddof=1)) / np.sqrt(len(f))
    return bool(f.mean() > deviation * special.stdtrit(len(f) - 1, 1 - CHANCE))


# Ordered residuals against normal order statistics, with a band that holds for all of them.
#
# The i-th smallest of n standard normal values stands beside its expectation, by Blom's formula
#
#     m_i = Φ⁻¹((i − 3/8) / (n + 1/4))                    (Blom 1958, Statistical Estimates, p. 71)
#
# Its probability U_(i) ~ Beta(i, n + 1 − i).  The band takes the same local level η at every i, so
# that it looks as sharply into the tails as into the middle, and η such that all n points together
# stay inside with 95 % (Aldor-Noiman et al. 2013, Am. Stat. 67, 249).  A pointwise band would be
# left by one point in twenty, neighbours together, and seem to accuse where nothing is wrong.

# Local levels of a simultaneous 5 % in small samples, from 1e5 simulated ones each; between them
# log η is interpolated in log n.
SMALL_N = (8.0, 12.0, 20.0, 32.0, 50.0, 100.0, 200.0)
SMALL_ETA = (0.00880, 0.00661, 0.00471, 0.00371, 0.00295, 0.00219, 0.00173)


@dataclass(frozen=True)
class NormalScores:
    """Points (k,) in ascending order: expected and observed value, and the band at each.

    `n` values were ordered; k ≤ n of them are given, evenly spaced over the expected values.
    `inside` says whether every given point lies in the simultaneous 95 % band.
    """

    n: int
    expected: Array
    observed: Array
    low: Array
    high: Array
    inside: bool


def normal_scores(z: Array, most: int) -> NormalScores:
    """Normal scores of z (n,), at least 8 that should be standard normal, at most `most` of them.

    Points are chosen evenly over the expected values, so both tails keep their single values.
    """
    n = z.size
    rank = np.arange(1, n + 1)
    if n > most:
        end = special.ndtri((n - 0.375) / (n + 0.25))
        share = special.ndtr(np.linspace(-end, end, most))
        rank = np.unique(np.clip(np.rint(share * (n + 0.25) + 0.375), 1, n).astype(np.int64))
    half = simultaneous_level(n) / 2
    observed = np.partition(z, rank - 1)[rank - 1] if n > most else np.sort(z)
    low = special.ndtri(special.betaincinv(rank, n + 1 - rank, half))
    # The complement of the mirrored point: 1 − u near one has no digits to spare.
    high = -special.ndtri(special.betaincinv(n + 1 - rank, rank, half))
    inside = bool(((low <= observed) & (observed <= high)).all())
    expected = special.ndtri((rank - 0.375) / (n + 0.25))
    return NormalScores(n, expected, observed, low, high, inside)


def simultaneous_level(n: int) -> float:
    """Local level η at which all n order statistics stay in their bands with 95 %.

    From n = 200 on, η = −ln 0.95 / (2 ln n · lln n) · (1 − 1.3 llln n / lln n), with lln = ln ln
    (Weine, McPeek and Abney 2023, J. Stat. Softw. 106(10)); below, a table.
    """
    if n < SMALL_N[-1]:
        return float(np.exp(np.interp(np.log(n), np.log(SMALL_N), np.log(SMALL_ETA))))
    log = np.log(n)
    twice = np.log(log)
    return float(-np.log(0.95) / (2 * log * twice) * (1 - 1.3 * np.log(twice) / twice))


# The rows of a table by component, marker, configuration and load state.


def groupings(
    observed: Observations, chosen: BoolArray
) -> Iterator[tuple[str, IntArray, NDArray[np.object_]]]:
    """By what the `chosen` rows (rows,) fall into more than one group, the number of each row's
    group and the groups' names, in the table's order."""
    table, size = observed.table, observed.size
    force = np.round(table.force[observed.lead], 3)
    load = numbered(*force.T)
    loads = tuple(map(load_text, force[np.unique(load, return_index=True)[1]]))
    coded: list[tuple[str, IntArray, tuple[str, ...]]] = [
        ("component", np.arange(size)[None], COMPONENTS[observed.kind]),
        ("marker", table.marker[observed.lead][:, None], table.marker_names),
        ("configuration", observed.configuration[:, None], table.configuration_labels),
        ("load state", load[:, None], loads),
    ]
    for by, own, names in coded:
        code = np.broadcast_to(own, (len(observed.lead), size)).ravel()[chosen]
        used, first = np.unique(code, return_index=True)
        order = used[np.argsort(first)]
        if len(order) > 1:
            place = np.empty(len(names), dtype=np.int64)
            place[order] = np.arange(len(order))
            yield by, place[code], np.array(names, dtype=object)[order]


# Do the residuals look as the noise model says?  For the whole table and by group.
#
# Under the model the whitened residuals e (rows,) have covariance I − H, H the hat matrix of the
# whitened B.  With the leverages h = diag H,
#
#     z_i = e_i / √(1 − h_i)
#
# is standard normal, and the mean square Σ e² / Σ (1 − h) of any group of rows has expectation 1.
# On f = Σ (1 − h) degrees of freedom it is judged by χ²: exactly for the whole table; for a group
# the eigenvalues of its block of I − H are at most 1, which makes χ² with f err on the safe side.
# Where only the shape of the noise is known, the common variance is s² = Σ e² / f over the table,
# and z is internally studentised: z²/f ~ Beta(1/2, (f − 1)/2) (Cook and Weisberg 1982, section
# 2.2).

FEWEST = 8  # values that a group needs to be looked at on its own
MOST_LISTED = 12  # groups of a grouping that are given in full, the most conspicuous ones
MOST_BINS = 81
GROUP_POINTS = 50  # normal scores of a group
FEWEST_FOR_SHAPE = 20  # values from which the omnibus test keeps its level
SIGNIFICANT = 0.05


@dataclass(frozen=True)
class GroupSummary:
    """The standardised residuals z of some rows.

    `counts` and `expected` (bins,) lie over the edges of the grouping, `beyond` values outside
    them.  `mean_square` has expectation 1 on `dof` degrees of freedom, with the two-sided χ²
    p-value `p`, and `p_holm` adjusted over all groups of all groupings (the whole table stands for
    itself).  `normality_p` is the
    omnibus test K² of D'Agostino and Pearson (1973) on skewness and kurtosis, None below 20
    values.  `held_out_mean_square` is that of the whitened held-out residuals, None without.
    """

    name: str
    n: int
    counts: IntArray
    expected: Array
    beyond: int
    scores: NormalScores
    skewness: float
    excess_kurtosis: float
    normality_p: float | None
    mean_square: float
    dof: float
    p: float
    p_holm: float
    held_out_mean_square: float | None = None

    @property
    def deviates(self) -> bool:
        """Whether the group scatters more or less than the model says, at 5 % over all groups."""
        return self.p_holm < SIGNIFICANT


@dataclass(frozen=True)
class Grouping:
    """The rows by component, marker, configuration or load state, over common bin `edges`.

    Of `n_groups` groups, `n_small` have fewer than 8 values and `n_deviating` scatter more or less
    than the model says; `groups` are at most 12, those of the smallest p, in the table's order.
    """

    by: str
    edges: Array
    groups: tuple[GroupSummary, ...]
    n_groups: int
    n_small: int
    n_deviating: int


@dataclass(frozen=True)
class ResidualSummary:
    """Standardised residuals of the whole table over `edges`, and by group.

    `absolute` says whether the size of the noise was stated or estimated as part of the model;
    else the residuals told it, and the whole table's mean square is 1.  `n_alone` rows have no
    residual of their own, because they alone determine something.
    """

    whole: GroupSummary
    edges: Array
    groupings: tuple[Grouping, ...]
    absolute: bool
    n_alone: int

    @property
    def deviating(self) -> tuple[tuple[str, GroupSummary], ...]:
        """(grouping, group) of those listed that scatter more or less than the model says.

        Smallest p first: a loud configuration makes its markers and components loud as well.
        """
        found = [(g.by, group) for g in self.groupings for group in g.groups if group.deviates]
        return tuple(sorted(found, key=lambda pair: pair[1].p))


def summarise_residuals(
    observed: Observations,
    whitened: Array,
    leverage: Array | None = None,
    held_out: Array | None = None,
    *,
    absolute: bool = True,
) -> ResidualSummary | None:
    """Histograms, normal scores and tests of the whitened residuals (rows,) of `observed`.

    `leverage` (rows,) is diag H of the whitened B, by default zero; `held_out` (rows,) the
    whitened residuals of fits to the other configurations, infinite where there is none.
    `absolute` False: the noise is known up to a common factor only, which the residuals tell.
    None where fewer than 8 rows have a residual, or all residuals are zero.
    """
    spare = np.ones(len(whitened)) if leverage is None else 1 - leverage
    free = spare > ALONE
    e, spare = whitened[free], spare[free]
    f = float(spare.sum())
    if len(e) < FEWEST or not e @ e > 0:
        return None
    if not absolute:
        e = e / np.sqrt((e @ e) / f)
    held = np.full(len(e), np.inf) if held_out is None else held_out[free]
    table = _Table(e, spare, held, None if absolute else f)
    judged = [(group, table.judged(*group[1:])) for group in groupings(observed, free)]
    of_all = holm(np.concatenate([p for _, p in judged] or [np.zeros(0)]))
    found = []
    for group, p in judged:
        adjusted, of_all = of_all[: len(p)], of_all[len(p) :]
        found.append(table.grouping(*group, adjusted))
    edges = table.edges(len(table.z))
    whole = table.summary("all", slice(None), edges, None)
    return ResidualSummary(whole, edges, tuple(found), absolute, int((~free).sum()))


class _Table:
    """Rows with a residual e, 1 − h, held out, and f where the residuals told the size."""

    def __init__(self, e: Array, spare: Array, held: Array, dof: float | None) -> None:
        self.z, self.squared, self.spare = e / np.sqrt(spare), e**2, spare
        self.held, self.dof = held, dof

    def judged(self, code: IntArray, names: NDArray[np.object_]) -> Array:
        """Two-sided p (groups,) of each group's mean square; NaN where it has too few values."""
        total, f = (np.bincount(code, v, len(names)) for v in (self.squared, self.spare))
        return np.where(np.bincount(code) >= FEWEST, _two_sided(total, f), np.nan)

    def grouping(
        self, by: str, code: IntArray, names: NDArray[np.object_], holm: Array
    ) -> Grouping:
        count = np.bincount(code)
        large = np.flatnonzero(count >= FEWEST)
        order = large[np.argsort(holm[large], kind="stable")]
        shown = np.sort(order[:MOST_LISTED])
        edges = self.edges(int(np.median(count[large])) if len(large) else FEWEST)
        groups = tuple(
            self.summary(names[k], np.flatnonzero(code == k), edges, float(holm[k])) for k in shown
        )
        return Grouping(
            by, edges, groups, len(count), len(count) - len(large),
            int((holm[large] < SIGNIFICANT).sum()),
        )  # fmt: skip

    def edges(self, n: int) -> Array:
        """Bin edges about 0 by Freedman and Diaconis, width 2 IQR n^(−1/3) for n values each.

        They reach to the largest value, or to 6 robust deviations where some lie far beyond.
        """
        low, high = np.quantile(self.z, [0.25, 0.75])
        largest = float(np.abs(self.z).max())
        spread = float(high - low) or largest
        reach = min(1.0001 * largest, 6 * spread / 1.349)
        bins = int(np.clip(np.ceil(reach / (spread * n ** (-1 / 3))), 3, MOST_BINS))
        return np.linspace(-reach, reach, (bins | 1) + 1)  # 0 in the middle of a bin

    def summary(
        self, name: str, rows: IntArray | slice, edges: Array, holm: float | None
    ) -> GroupSummary:
        z = self.z[rows]
        counts = np.histogram(z, edges)[0]
        total, f = float(self.squared[rows].sum()), float(self.spare[rows].sum())
        p = float(_two_sided(total, f))
        unit = z / (np.abs(z).max() or 1.0)  # no power of it overflows
        same = np.ptp(unit) < 1e-10
        shape = (0.0, 0.0) if same else _shape(unit)
        omnibus = None
        if len(z) >= FEWEST_FOR_SHAPE and not same:
            omnibus = _p_normal(*shape, len(z))
        held = self.held[rows]
        held = held[np.isfinite(held)]
        points = GROUP_POINTS if holm is not None else 4 * GROUP_POINTS
        return GroupSummary(
            name, len(z), counts, len(z) * np.diff(self._cdf(edges)), int(len(z) - counts.sum()),
            normal_scores(z, points), *shape, omnibus, total / f, f, p,
            p if holm is None else holm, float(np.mean(held**2)) if held.size else None,
        )  # fmt: skip

    def _cdf(self, z: Array) -> Array:
        """Distribution of z: normal, or of a ratio to s from the same rows (Thompson's τ)."""
        if self.dof is None or self.dof <= 1:
            return np.asarray(special.ndtr(z))
        beta = special.betainc(0.5, (self.dof - 1) / 2, np.minimum(z**2 / self.dof, 1.0))
        return np.asarray(0.5 + 0.5 * np.sign(z) * beta)


def _two_sided(total: ArrayLike, f: ArrayLike) -> Array:
    smaller = np.minimum(special.chdtr(f, total), special.chdtrc(f, total))
    return np.where(np.asarray(f) > 0, np.minimum(2 * smaller, 1.0), np.nan)


def _shape(z: Array) -> tuple[float, float]:
    away = z - z.mean()
    squared = (away**2).mean()
    return float((away**3).mean() / squared**1.5), float((away**4).mean() / squared**2 - 3)


def _p_normal(skewness: float, kurtosis: float, n: int) -> float:
    """p-value of D'Agostino and Pearson's K² (1973, Biometrika 60, 613), χ² with 2 degrees of
    freedom: skewness as D'Agostino (1970), kurtosis as Anscombe and Glynn (1983) make it normal.
    Written out since scipy.stats takes a third of a second to import."""
    spread = 6 * (n - 2) / ((n + 1) * (n + 3))  # variance of the skewness
    fourth = 3 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3)
    W2 = np.sqrt(2 * (fourth / ((n - 2) * (n + 5) * (n + 7) * (n + 9)) - 1)) - 1
    z1 = np.arcsinh(skewness * np.sqrt((W2 - 1) / 2 / spread)) / np.sqrt(np.log(W2) / 2)
    spread = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (kurtosis + 6 / (n + 1)) / np.sqrt(spread)
    skewed = 6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9))
    skewed *= np.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    A = 6 + 8 / skewed * (2 / skewed + np.sqrt(1 + 4 / skewed**2))
    root = np.cbrt((1 - 2 / A) / (1 + x * np.sqrt(2 / (A - 4))))
    z2 = (1 - 2 / (9 * A) - root) / np.sqrt(2 / (9 * A))
    return float(special.chdtrc(2, z1**2 + z2**2))


def holm(p: Array) -> Array:
    """Holm's adjusted p-values (1979, Scand. J. Stat. 6, 65): valid under any dependence."""
    adjusted = np.full(len(p), np.nan)
    order = np.flatnonzero(np.isfinite(p))
    order = order[np.argsort(p[order])]
    steps = p[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted
