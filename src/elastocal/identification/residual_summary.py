"""Do the residuals look as the noise model says?  For the whole table and by group.

Under the model the whitened residuals e (rows,) have covariance I − H, H the hat matrix of the
whitened B.  With the leverages h = diag H,

    z_i = e_i / √(1 − h_i)

is standard normal, and the mean square Σ e² / Σ (1 − h) of any group of rows has expectation 1.
On f = Σ (1 − h) degrees of freedom it is judged by χ²: exactly for the whole table; for a group
the eigenvalues of its block of I − H are at most 1, which makes χ² with f err on the safe side.
Where only the shape of the noise is known, the common variance is s² = Σ e² / f over the table,
and z is internally studentised: z²/f ~ Beta(1/2, (f − 1)/2) (Cook and Weisberg 1982, section 2.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from elastocal.errors import require
from elastocal.identification.normal_scores import NormalScores, normal_scores
from elastocal.identification.residual_groups import Labels, groupings
from elastocal.manipulator.observation import Observations

Array = NDArray[np.float64]

FEWEST = 8  # values that a group needs to be looked at on its own
MOST_LISTED = 12  # groups of a grouping that are given in full, the most conspicuous ones
MOST_BINS = 81
GROUP_POINTS = 50  # normal scores of a group
ALONE = 1e-9  # 1 − h of a row that alone determines something: it has no residual
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
    counts: NDArray[np.int64]
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

    def to_json(self) -> dict[str, Any]:
        plain = dict(vars(self))
        plain["counts"], plain["expected"] = self.counts.tolist(), self.expected.tolist()
        return plain | {"scores": self.scores.to_json()}


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

    def to_json(self) -> dict[str, Any]:
        groups = [g.to_json() for g in self.groups]
        return vars(self) | {"edges": self.edges.tolist(), "groups": groups}


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

    def to_json(self) -> dict[str, Any]:
        return {
            "absolute": self.absolute, "n_alone": self.n_alone, "edges": self.edges.tolist(),
            "whole": self.whole.to_json(), "groupings": [g.to_json() for g in self.groupings],
        }  # fmt: skip


def summarise_residuals(
    seen: Observations,
    whitened: ArrayLike,
    leverage: ArrayLike | None = None,
    held_out: ArrayLike | None = None,
    *,
    absolute: bool = True,
) -> ResidualSummary | None:
    """Histograms, normal scores and tests of the whitened residuals (rows,) of `seen`.

    `leverage` (rows,) is diag H of the whitened B, by default zero; `held_out` (rows,) the
    whitened residuals of fits to the other configurations, infinite where there is none.
    `absolute` False: the noise is known up to a common factor only, which the residuals tell.
    None where fewer than 8 rows have a residual, or all residuals are zero.

    Raises InputError where lengths differ, a residual is not finite or a leverage not in [0, 1].
    """
    e = _rows(whitened, len(seen.value), "whitened residuals")
    h = np.zeros(len(e)) if leverage is None else _rows(leverage, len(e), "leverages")
    require(bool(np.isfinite(e).all()), "whitened residuals must be finite")
    require(
        bool(((h >= -1e-9) & (h <= 1 + 1e-9)).all()),
        f"leverages lie between 0 and 1; found {h.min(initial=0):.3g} to {h.max(initial=0):.3g}",
    )
    free = 1 - h > ALONE
    f = float((1 - h[free]).sum())
    if free.sum() < FEWEST or not e[free] @ e[free] > 0:
        return None
    if not absolute:
        e = e / np.sqrt((e[free] @ e[free]) / f)
    held = None if held_out is None else _rows(held_out, len(e), "held-out residuals")
    table = _Table(
        e[free] / np.sqrt(1 - h[free]), e[free] ** 2, 1 - h[free],
        None if held is None else held[free], None if absolute else f,
    )  # fmt: skip

    judged = [(labels, table.judged(labels)) for labels in groupings(seen, free)]
    holm = _holm(np.concatenate([p for _, p in judged] or [np.zeros(0)]))
    found = []
    for labels, p in judged:
        adjusted, holm = holm[: len(p)], holm[len(p) :]
        found.append(table.grouping(labels, adjusted))
    edges = table.edges(len(table.z))
    everything = np.arange(len(table.z))
    whole = table.summary("all", everything, edges, None)
    return ResidualSummary(whole, edges, tuple(found), absolute, int((~free).sum()))


@dataclass(frozen=True)
class _Table:
    """Rows with a residual: z, e², 1 − h, held out, and f where the residuals told the size."""

    z: Array
    squared: Array
    spare: Array
    held: Array | None
    dof: float | None

    def judged(self, labels: Labels) -> Array:
        """Two-sided p (groups,) of each group's mean square; NaN where it has too few values."""
        total = np.bincount(labels.code, self.squared, len(labels.names))
        f = np.bincount(labels.code, self.spare, len(labels.names))
        p = _two_sided(total, f)
        p[np.bincount(labels.code, minlength=len(labels.names)) < FEWEST] = np.nan
        return p

    def grouping(self, labels: Labels, holm: Array) -> Grouping:
        count = np.bincount(labels.code, minlength=len(labels.names))
        large = np.flatnonzero(count >= FEWEST)
        order = large[np.argsort(holm[large], kind="stable")]
        shown = np.sort(order[:MOST_LISTED])
        edges = self.edges(int(np.median(count[large])) if len(large) else FEWEST)
        by_code = np.argsort(labels.code, kind="stable")
        start = np.concatenate([[0], np.cumsum(count)])
        groups = tuple(
            self.summary(labels.names[k], by_code[start[k] : start[k + 1]], edges, float(holm[k]))
            for k in shown
        )
        return Grouping(
            labels.by, edges, groups, len(count), len(count) - len(large),
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
        self, name: str, rows: NDArray[np.int64], edges: Array, holm: float | None
    ) -> GroupSummary:
        z = self.z[rows]
        counts = np.histogram(z, edges)[0]
        total, f = float(self.squared[rows].sum()), float(self.spare[rows].sum())
        p = float(_two_sided(total, f))
        unit = z / (np.abs(z).max() or 1.0)  # no power of it overflows
        same = np.ptp(unit) < 1e-10
        shape = (0.0, 0.0) if same else (float(stats.skew(unit)), float(stats.kurtosis(unit)))
        omnibus = None
        if len(z) >= FEWEST_FOR_SHAPE and not same:
            omnibus = float(stats.normaltest(unit).pvalue)
        out = None
        if self.held is not None and (finite := self.held[rows][np.isfinite(self.held[rows])]).size:
            out = float(np.mean(finite**2))
        points = GROUP_POINTS if holm is not None else 4 * GROUP_POINTS
        return GroupSummary(
            name, len(z), counts, len(z) * np.diff(self._cdf(edges)), int(len(z) - counts.sum()),
            normal_scores(z, points), *shape, omnibus, total / f, f, p,
            p if holm is None else holm, out,
        )  # fmt: skip

    def _cdf(self, z: Array) -> Array:
        """Distribution of z: normal, or of a ratio to s from the same rows (Thompson's τ)."""
        if self.dof is None or self.dof <= 1:
            return np.asarray(stats.norm.cdf(z))
        beta = stats.beta.cdf(np.minimum(z**2 / self.dof, 1.0), 0.5, (self.dof - 1) / 2)
        return np.asarray(0.5 + 0.5 * np.sign(z) * beta)


def _two_sided(total: ArrayLike, f: ArrayLike) -> Array:
    smaller = np.minimum(stats.chi2.cdf(total, f), stats.chi2.sf(total, f))
    return np.asarray(np.minimum(2 * smaller, 1.0))


def _holm(p: Array) -> Array:
    """Holm's adjusted p-values (1979, Scand. J. Stat. 6, 65): valid under any dependence."""
    adjusted = np.full(len(p), np.nan)
    order = np.argsort(p)[: np.isfinite(p).sum()]  # NaN sorts last
    steps = p[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


def _rows(values: ArrayLike, n: int, what: str) -> Array:
    rows = np.asarray(values, dtype=np.float64)
    require(rows.shape == (n,), f"{what} must be {n} values, one per row; found {rows.shape}")
    return rows
