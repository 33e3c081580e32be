"""Posterior draws of a sum's coefficients, the sizes of its components drawn with them.

Two causes that look alike share what they do by their sizes; which of these are the most probable
decides little.  So the sizes of effects that need no search are drawn as well, one after the other
given the others (Gibbs), their coefficients integrated out: with A and b what the others leave of
its normal matrix and right side, a component of size s, or none, has the log evidence

    −½ log|1 + s²A| + ½ bᵀ(s⁻² + A)⁻¹b,

beside the prior of `Pool`.  What is hidden is not there at first, and pays for being there as all
others do.  How alike the sizes of one kind are is unknown too, and drawn: where the eccentricities
of six joints are alike, that of the seventh, which looks like its sag, hardly is ten times as
large.  The weights of all links, which are given where they stand, have a size for every moment:
those along the links are large, all alike, those across them next to nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from elastocal.diagnosis.components import (
    GONE,
    LARGEST,
    SPREAD,
    Component,
    FittedSum,
    Pool,
    presence_cost,
)
from elastocal.diagnosis.effect_search import spans_of
from elastocal.diagnosis.evidence import at_scales
from elastocal.diagnosis.noise_floor import Weighted
from elastocal.engine.mixed import beside
from elastocal.units import Array

GRID = np.linspace(GONE, LARGEST, 41)  # logarithms of sizes
SIZES = np.exp(GRID)
SPREADS = np.linspace(0.1, 0.9, 9) * SPREAD  # what sizes of a kind may spread by
SETTLING = 30  # sweeps

# A component's number, and that of its column where each has a size, else 0.
Key = tuple[int, int]


def drawn(
    found: FittedSum, hidden: Sequence[Component], at: Weighted, precision: Array, n: int,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """n draws (p, n) of the coefficients of a sum and of components that are `hidden` by it, whose
    columns stand behind its own."""
    components, prior = (*found.components, *hidden), at.prior(precision)
    every = spans_of([c.width for c in components], len(prior))
    own = [k for k, c in enumerate(components) if c.hypothesis is not None and not c.settings]
    c = np.r_[(slice(0, 0), *(every[k] for k in own))]
    x = np.setdiff1d(np.arange(len(prior)), c)
    M, right = at.products.M, at.products.z
    L = linalg.cholesky(M[np.ix_(x, x)] + np.diag(prior[x]), lower=True)
    across = linalg.solve_triangular(L, M[np.ix_(x, c)], lower=True)
    S = M[np.ix_(c, c)] - across.T @ across
    kinds = _kinds(components, own)
    spans = {key: span for kind in kinds for key, span in kind.spans.items()}
    sizes = {(k, i): float(found.sizes.size[k]) for k, i in spans if k < len(found.components)}
    sized = np.full(len(c), np.inf)  # prior precisions; infinite where there is nothing
    for key, size in sizes.items():
        sized[spans[key]] = np.exp(-2 * size)
    out, z = np.zeros((len(prior), n)), linalg.solve_triangular(L, right[x], lower=True)
    t = right[c] - across.T @ z
    for sweep in range(-SETTLING, n):
        for kind in kinds:
            spread = kind.spread(sizes, rng)
            for key in kind.spans:
                sizes.pop(key, None)
                evidence = np.append(_at_sizes(S, t, sized, spans[key]), 0.0)
                sized[spans[key]] = np.exp(-2 * kind.choose(key, evidence, sizes, spread, rng))
        if sweep < 0:
            continue
        beta = out[:, sweep]
        i = np.flatnonzero(sized < np.inf)
        A = S[np.ix_(i, i)] + np.diag(sized[i])
        apart = np.linalg.solve(np.linalg.cholesky(A).T, rng.normal(size=len(i)))
        beta[c[i]] = np.linalg.solve(A, t[i]) + apart
        rest = z - across @ beta[c] + rng.normal(size=len(x))
        beta[x] = linalg.solve_triangular(L, rest, lower=True, trans="T")
    return out


@dataclass(frozen=True)
class _Kind:
    """What has sizes that are alike: a kind's components, or an effect's parameters.

    Its members' `spans` of the columns; what finding them `sought`; at how many `places` there may
    be one, none where it is there in any case.
    """

    spans: Mapping[Key, slice]
    sought: Mapping[Key, float]
    places: int | None

    def choose(
        self, key: Key, evidence: Array, sizes: dict[Key, float], spread: float,
        rng: np.random.Generator,
    ) -> float:  # fmt: skip
        """A size of `key` beside `sizes`, to which it is added, by its log evidence at those on the
        GRID and at none; the logarithm, −∞ of none."""
        chosen = _one_of(evidence + self.log_prior(key, sizes, spread), rng)
        if chosen == len(GRID):
            return -np.inf
        sizes[key] = float(GRID[chosen])
        return sizes[key]

    def _logs(self, sizes: Mapping[Key, float]) -> Array:
        return np.array([sizes[key] for key in self.spans if key in sizes])

    def spread(self, sizes: Mapping[Key, float], rng: np.random.Generator) -> float:
        """One of SPREADS, any of them as probable beforehand."""
        return float(SPREADS[_one_of(_log_density(self._logs(sizes), SPREADS), rng)])

    def log_prior(self, key: Key, sizes: Mapping[Key, float], spread: float) -> Array:
        """Of another size on the GRID beside `sizes`, and of none."""
        others = self._logs(sizes)
        # Of m that have spread² their own and the rest of SPREAD² in common, the next one.
        m, common = len(others), SPREAD**2 - spread**2
        known = common / (spread**2 + m * common)
        mean, variance = known * others.sum(), spread**2 * (1 + known)
        out = np.log((GRID[1] - GRID[0]) / np.sqrt(2 * np.pi * variance))
        out = out - 0.5 * (GRID - mean) ** 2 / variance
        if self.places is None:
            return np.append(out, -np.inf)
        cost = presence_cost(self.places, m + 1) - presence_cost(self.places, m)
        return np.append(out - cost - self.sought[key], 0.0)


def _kinds(components: Sequence[Component], own: Sequence[int]) -> list[_Kind]:
    """The kinds of these of all components; their spans are those among the columns of `own`."""
    widths = [components[k].width for k in own]
    spans = dict(zip(own, spans_of(widths, sum(widths)), strict=True))
    pool, out = Pool(components), []
    for members, places in zip(pool.kinds, pool.places, strict=True):
        mine = [k for k in members.tolist() if k in spans]
        for k in (k for k in mine if components[k].given):
            h = components[k].hypothesis
            assert h is not None
            # Of its parameters those that are of similar sizes together.
            words = np.array([p.alike for p in h.parameters])
            for word in np.unique(words):
                columns = (spans[k].start + np.flatnonzero(words == word)).tolist()
                out.append(_Kind({(k, i): slice(i, i + 1) for i in columns}, {}, None))
        free = [k for k in mine if not components[k].given]
        sought = {(k, 0): float(pool.sought[k]) for k in free}
        out.append(_Kind({(k, 0): spans[k] for k in free}, sought, places))
    return out


def _one_of(log_p: Array, rng: np.random.Generator) -> int:
    """One of so many, each as probable as exp log_p: the largest with Gumbel noise on it."""
    return int(np.argmax(log_p + rng.gumbel(size=len(log_p))))


def _log_density(logs: Array, spread: Array) -> Array:
    """Of the logarithms (k,) of sizes at each spread of their own, but for a constant: k − 1 times
    they vary by it, their mean by what it leaves of SPREAD."""
    k, own = len(logs), spread**2
    if k == 0:
        return np.zeros_like(spread)
    mean = own + k * (SPREAD**2 - own)
    squares = (logs**2).sum() - logs.sum() ** 2 / k
    return np.asarray(
        -0.5 * ((k - 1) * np.log(own) + np.log(mean) + squares / own + logs.sum() ** 2 / k / mean)
    )


def _at_sizes(S: Array, t: Array, sized: Array, span: slice) -> Array:
    """Log evidence of the columns `span` at every size of the GRID, over none, beside all others
    that have one."""
    others = np.flatnonzero(sized < np.inf)
    others = others[(others < span.start) | (others >= span.stop)]
    ((A, b),) = beside(S, t, sized, others, [span])
    values, vectors = np.linalg.eigh(A)
    a, b = np.maximum(values, 0.0), vectors.T @ b
    return at_scales(a[None], b[None, :, None], SIZES)[0, :, 0]
