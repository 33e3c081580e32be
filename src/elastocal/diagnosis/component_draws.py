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
from scipy import linalg, special

from elastocal.diagnosis.components import (
    GONE,
    LARGEST,
    SPREAD,
    Component,
    FittedSum,
    Pool,
    given_fellows,
    indices,
    precision_of_sizes,
    presence_cost,
)
from elastocal.diagnosis.evidence import at_scales
from elastocal.diagnosis.model_set import spans_of
from elastocal.diagnosis.noise_floor import Weighted
from elastocal.engine.sizes import beside
from elastocal.units import Array, IntArray

GRID = np.linspace(GONE, LARGEST, 41)  # logarithms of sizes
SIZES = np.exp(GRID)
SPREADS = np.linspace(0.1, 0.9, 9) * SPREAD  # what sizes of a kind may spread by
SETTLING = 30  # sweeps

# A component's number, with that of its column where each has a size; or "unseen" and a number.
Key = int | tuple[int | str, int]


@dataclass(frozen=True)
class Unseen:
    """Lines of joints that these poses do not show: as those of an order that nobody knows, they
    are another error at every configuration.

    `columns` (U, C, m) are the joints', per typical line and zero where nothing counts; `fellows`
    the logarithms of the sizes of lines found at other joints, `places` at how many joints there
    may be any.
    """

    columns: Array
    fellows: tuple[float, ...]
    places: int

    def kind(self) -> _Kind:
        keys: dict[Key, int] = {("unseen", u): u for u in range(len(self.columns))}
        return _Kind({}, keys, dict.fromkeys(keys, 0.0), self.places, self.fellows)


@dataclass(frozen=True)
class Draws:
    """Of a sum: coefficients (p, n), and what the joints of `Unseen` err by in every configuration
    (U, C, n), in typical lines."""

    coefficients: Array
    unseen: Array


def drawn(
    found: FittedSum, hidden: Sequence[Component], at: Weighted, precision: Array, n: int,
    rng: np.random.Generator, unseen: Unseen | None = None,
) -> Draws:  # fmt: skip
    """n draws of a sum and of components that are `hidden` by it, whose columns stand behind its
    own, and of what is `unseen`, for which the noise of `at` has no place."""
    components, prior = (*found.components, *hidden), at.prior(precision)
    every = spans_of([c.width for c in components], len(prior))
    own = [k for k, c in enumerate(components) if c.hypothesis is not None and not c.settings]
    c = indices([every[k] for k in own])
    x = np.setdiff1d(np.arange(len(prior)), c)
    L = linalg.cholesky(at.M[np.ix_(x, x)] + np.diag(prior[x]), lower=True)
    across = linalg.solve_triangular(L, at.M[np.ix_(x, c)], lower=True)
    S = at.M[np.ix_(c, c)] - across.T @ across
    kinds = _kinds(components, own)
    spans = {key: span for kind in kinds for key, span in kind.spans.items()}
    sizes = {key: float(found.sizes.size[k]) for kind in kinds
             for key, k in kind.component.items() if k < len(found.components)}  # fmt: skip
    sized = np.full(len(c), np.inf)  # prior precisions; infinite where there is nothing
    for key, size in sizes.items():
        sized[spans[key]] = np.exp(-2 * size)
    scatter = _Scatter(unseen, at) if unseen is not None and len(unseen.columns) else None
    out, errors = np.zeros((len(prior), n)), np.zeros((scatter.n if scatter else 0, len(at.r), n))
    for sweep in range(-SETTLING, n):
        right = at.z if scatter is None else scatter.without(at.z)
        z = linalg.solve_triangular(L, right[x], lower=True)
        t = right[c] - across.T @ z
        for kind in kinds:
            spread = kind.spread(sizes, rng)
            for key in kind.spans:
                sizes.pop(key, None)
                evidence = np.append(_at_sizes(S, t, sized, spans[key]), 0.0)
                sized[spans[key]] = np.exp(-2 * kind.choose(key, evidence, sizes, spread, rng))
        if sweep < 0 and scatter is None:
            continue
        beta = np.zeros(len(prior))
        i = np.flatnonzero(sized < np.inf)
        A = S[np.ix_(i, i)] + np.diag(sized[i])
        apart = np.linalg.solve(np.linalg.cholesky(A).T, rng.normal(size=len(i)))
        beta[c[i]] = np.linalg.solve(A, t[i]) + apart
        rest = z - across @ beta[c] + rng.normal(size=len(x))
        beta[x] = linalg.solve_triangular(L, rest, lower=True, trans="T")
        if scatter is not None:
            scatter.draw(beta, rng)
        if sweep >= 0:
            out[:, sweep] = beta
            if scatter is not None:
                errors[:, :, sweep] = scatter.errors
    return Draws(out, errors)


class _Scatter:
    """What is unseen as it is drawn: sizes and errors ε (U, C), by sums over the rows alone.

    With g the whitened columns of a joint, `own` are gᵀg' of every two joints (U, U, C), `across`
    gᵀX (U, C, p) and `of_rows` gᵀr (U, C).
    """

    def __init__(self, unseen: Unseen, at: Weighted) -> None:
        g = np.einsum("cij,ucj->uci", at.root, unseen.columns)
        self.kind, self.n = unseen.kind(), len(g)
        self.own = np.einsum("ucm,wcm->uwc", g, g)
        self.across = np.stack([np.einsum("cm,cmp->cp", each, at.X) for each in g])
        self.of_rows = np.einsum("ucm,cm->uc", g, at.r)
        self.errors = np.zeros(g.shape[:2])
        self.sizes: dict[Key, float] = {}

    def without(self, z: Array) -> Array:
        """XᵀV⁻¹(r − Gε) (p,) of z = XᵀV⁻¹r."""
        return np.asarray(z - np.tensordot(self.errors, self.across, axes=2))

    def draw(self, beta: Array, rng: np.random.Generator) -> None:
        """Sizes and errors anew beside the coefficients.

        With a = gᵀg and b = gᵀe of a joint in every configuration, e what is left of the readings,
        errors of size s have the mean s²b/(1 + s²a).
        """
        left = self.of_rows - self.across @ beta
        spread = self.kind.spread(self.sizes, rng)
        for u, key in enumerate(self.kind.component):
            a = self.own[u, u]
            b = left[u] - np.einsum("wc,wc->c", self.own[u], self.errors) + a * self.errors[u]
            self.sizes.pop(key, None)
            size = self.kind.choose(key, np.append(_on_grid(a, b), 0.0), self.sizes, spread, rng)
            variance = 1 / (np.exp(-2 * size) + a)
            self.errors[u] = variance * b + np.sqrt(variance) * rng.normal(size=len(b))


@dataclass(frozen=True)
class _Kind:
    """What has sizes that are alike: a kind's components, or an effect's parameters.

    Its members' `spans` of the columns, where these are a sum's, and the `component` that each is,
    or is a parameter of; what finding them `sought`; at how many `places` there may be one, none
    where it is there in any case; the logarithms of sizes of `fellows` that are not drawn.
    """

    spans: Mapping[Key, slice]
    component: Mapping[Key, int]
    sought: Mapping[Key, float]
    places: int | None
    fellows: tuple[float, ...] = ()

    def choose(
        self, key: Key, evidence: Array, sizes: dict[Key, float], spread: float,
        rng: np.random.Generator,
    ) -> float:  # fmt: skip
        """A size of `key` beside `sizes`, to which it is added, by its log evidence at those on the
        GRID and at none; the logarithm, −∞ of none."""
        log_p = evidence + self.log_prior(key, sizes, spread)
        chosen = int(rng.choice(len(log_p), p=special.softmax(log_p)))
        if chosen == len(GRID):
            return -np.inf
        sizes[key] = float(GRID[chosen])
        return sizes[key]

    def _logs(self, sizes: Mapping[Key, float]) -> Array:
        return np.array([*self.fellows, *(sizes[key] for key in self.component if key in sizes)])

    def spread(self, sizes: Mapping[Key, float], rng: np.random.Generator) -> float:
        """One of SPREADS, any of them as probable beforehand."""
        logs = self._logs(sizes)
        log_p = [_log_density(logs, a) for a in SPREADS.tolist()]
        return float(SPREADS[rng.choice(len(SPREADS), p=special.softmax(log_p))])

    def log_prior(self, key: Key, sizes: Mapping[Key, float], spread: float) -> Array:
        """Of another size on the GRID beside `sizes`, and of none."""
        others = self._logs(sizes)
        m, (mean, precision) = len(others), given_fellows(others.tolist(), spread)
        out = 0.5 * np.log(precision / (2 * np.pi)) - 0.5 * precision * (GRID - mean) ** 2
        out += np.log(GRID[1] - GRID[0])
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
            for some in _alike(components[k]):
                parts: dict[Key, slice] = {
                    (k, i): slice(i, i + 1) for i in (spans[k].start + some).tolist()
                }
                out.append(_Kind(parts, dict.fromkeys(parts, k), {}, None))
        free = [k for k in mine if not components[k].given]
        sought = {k: float(pool.sought[k]) for k in free}
        out.append(_Kind({k: spans[k] for k in free}, {k: k for k in free}, sought, places))
    return out


def _alike(c: Component) -> list[IntArray]:
    """The numbers of its parameters, those that are of similar sizes together."""
    assert c.hypothesis is not None
    words = np.array([p.alike for p in c.hypothesis.parameters])
    return [np.flatnonzero(words == word) for word in np.unique(words)]


def _log_density(logs: Array, spread: float) -> float:
    """Of the logarithms (k,) of sizes, but for a constant: k − 1 times they vary on their own."""
    k = len(logs)
    log_det = -2 * (k - 1) * np.log(spread) - np.log(k * SPREAD**2 - (k - 1) * spread**2)
    return 0.5 * float(log_det - logs @ precision_of_sizes(k, spread) @ logs) if k else 0.0


def _at_sizes(S: Array, t: Array, sized: Array, span: slice) -> Array:
    """Log evidence of the columns `span` at every size of the GRID, over none, beside all others
    that have one."""
    others = np.flatnonzero(sized < np.inf)
    others = others[(others < span.start) | (others >= span.stop)]
    ((A, b),) = beside(S, t, sized, others, [span])
    values, vectors = np.linalg.eigh(A)
    return _on_grid(np.maximum(values, 0.0), vectors.T @ b)


def _on_grid(a: Array, b: Array) -> Array:
    """The log evidence, over none, at every size of the GRID of coefficients that do not hang
    together, with a and b (k,) their normal matrix' diagonal and their right side."""
    return at_scales(a[None], b[None, None], SIZES)[0, :, 0]
