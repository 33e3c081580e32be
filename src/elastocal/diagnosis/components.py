"""The gap as a sum of components, the sizes of all of them judged together.

On a real arm something acts at every joint at once, each too small to stand alone.  So the
residual is taken for a sum

    r = X β + Σ_k C_k w_k + noise,   w_k ~ N(0, s_k² D_k(ℓ_k)),

of components k: errors of each joint against its own angle (smooth curves whose length ℓ_k is
estimated, and lines), every effect of the catalogue that is linear in its parameters, and smooth
dependences without a name.  Sizes s_k, lengths ℓ_k and the noise maximise the restricted
likelihood (Patterson and Thompson 1971) times a prior that lets most components be absent: each
one present costs what one more hypothesis costs, and goes where it does not earn it.  At the
maximum most sizes are zero of themselves (automatic relevance determination, MacKay 1992).

What acts at one joint of an arm mostly acts at the others, and is there of a similar size: of the
components of one kind, the share that is present and their common size are unknown themselves
(`Pool`), so that the first costs more than the last.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy import linalg, special

from elastocal.diagnosis.baseline import (
    NoiseValues,
    NoisyData,
    Weighted,
    balanced,
    fit_noise,
    log_prior,
    posterior,
)
from elastocal.diagnosis.effect_search import spans_of, within_bounds
from elastocal.diagnosis.evidence import at_scales
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.engine import Products, Standardised, beside, climb
from elastocal.model.effects.base import Effect
from elastocal.model.effects.smooth import Waves
from elastocal.units import Array, IntArray

Family = Literal[
    "angle", "gravity", "torque", "load", "move", "time", "temperature", "pose", "tool"
]  # fmt: skip

# Prior probability that a kind of component is there.  The logarithms of sizes, of typical ones,
# spread by SPREAD, of which ALONE is each component's own and the rest that of its kind.
# Afterwards a length is known to about a third of itself; how well a size is, the readings say.
PRESENT = 0.2
SPREAD, ALONE, AFTERWARDS = 1.5, 1.0, 0.3
COMMON = float(np.sqrt(SPREAD**2 - ALONE**2))
# Below GONE, the log of a size in typical sizes, a component is as good as absent.
GONE, LARGEST = -5.0, 7.0


@dataclass(frozen=True, eq=False)
class Component:
    """One cause that may be at work: `columns` (C, m, k) per typical size.

    `waves` are those of a smooth function, whose spectrum its length decides, between the
    logarithms `lengths`; they stand in the columns `repeat` times, once for each component of the
    motion.  `settings` are constants of the effect by key, `search` what finding them cost in nats;
    `follows` is what a field depends on; `fellows` at how many places there may be one of its kind.
    One that is `given` stays in the sum: the columns of others are about it, or it has been
    compared with its absence already."""

    family: Family
    effect: Effect
    where: str
    columns: Array
    unit: float = 1.0
    follows: str = ""
    waves: Waves | None = None
    lengths: tuple[float, float] = (0.0, 0.0)
    repeat: int = 1
    settings: tuple[tuple[str, float], ...] = ()
    hypothesis: Hypothesis | None = None
    search: float = 0.0
    fellows: int = 1
    given: bool = False

    @property
    def named(self) -> bool:
        return not self.effect.nameless

    @property
    def width(self) -> int:
        return self.columns.shape[2]

    @cached_property
    def bounded(self) -> IntArray:
        """Columns whose coefficients cannot be negative."""
        return np.flatnonzero(np.zeros(0) if self.hypothesis is None else self.hypothesis.bounded)

    @property
    def sought(self) -> float:
        """Nats that the search for it, and for its length, cost."""
        low, high = self.lengths
        return self.search + (float(np.log((high - low) / AFTERWARDS)) if high > low else 0.0)

    def shares(self, log_length: float) -> tuple[Array, Array]:
        """Prior variances (k,) at size 1, and the slope of their logarithms in log ℓ."""
        if self.waves is None:
            return np.ones(self.width), np.zeros(self.width)
        length = float(np.exp(log_length))
        spectrum, slope = self.waves.variances(1.0, length), self.waves.slopes(length)
        return np.tile(spectrum, self.repeat), np.tile(slope, self.repeat)

    @property
    def scalings(self) -> Array:
        """Scalings (L, k) that give its columns equal prior variances, at L lengths if smooth."""
        lengths = [0.0] if self.waves is None else np.linspace(*self.lengths, 3)
        return np.sqrt([self.shares(v)[0] for v in lengths])


@dataclass(frozen=True)
class Sizes:
    """Logarithms: of a common `factor` on the noise, of each component's size and length."""

    factor: float
    size: Array
    length: Array

    @classmethod
    def of(cls, theta: Array) -> Sizes:
        """From all of these one after the other (1 + 2 K,)."""
        return cls(float(theta[0]), *np.split(theta[1:], 2))

    @classmethod
    def start(cls, components: Sequence[Component]) -> Sizes:
        length = np.array([(2 * c.lengths[0] + c.lengths[1]) / 3 for c in components])
        return cls(0.0, np.zeros(len(components)), length)

    def chosen(self, index: Sequence[int], more: Sequence[Component] = ()) -> Sizes:
        """Those of some of the components, and of `more` at their start."""
        at, new = np.asarray(index, dtype=np.int64), Sizes.start(more)
        size, length = (np.append(a[at], b) for a, b in
                        ((self.size, new.size), (self.length, new.length)))  # fmt: skip
        return Sizes(self.factor, size, length)


class Pool:
    """The prior of which components are there, and of the logarithms of their sizes.  A kind has n
    places, the k-th family of lines of a joint as one of the k-th ones.  It is there with
    probability PRESENT, then at any number of them with equal probability, and at any k of them
    (Scott and Berger 2010, Annals of Statistics 38, 2587): k cost log (1/PRESENT − 1) n (n over k)
    nats.  The logarithms of a kind's sizes spread by SPREAD in all, ALONE of it their own."""

    def __init__(self, components: Sequence[Component]) -> None:
        ranks: Counter[tuple[str, str, str]] = Counter()
        kinds: dict[tuple[str, str, int], list[int]] = {}
        for k, c in enumerate(components):
            place = (c.effect.name, c.follows, c.where)
            kinds.setdefault((*place[:2], ranks[place]), []).append(k)
            ranks[place] += 1
        # Of each kind the number of its places, and its components.
        self.kinds = [
            (max(len(own), *(components[k].fellows for k in own)), np.array(own))
            for own in kinds.values()
        ]
        self.sought = np.array([c.sought for c in components])
        self.precision = np.zeros((len(components), len(components)))
        for _, own in self.kinds:
            apart = ALONE**2 * np.eye(len(own)) + COMMON**2
            self.precision[np.ix_(own, own)] = np.linalg.inv(apart)

    def cost(self, spread: Array) -> float:
        """Nats that all of them have to earn, the logarithms of whose sizes are known to this
        covariance (K, K)."""
        there = sum(presence_cost(n, len(own)) for n, own in self.kinds)
        return float(self.sought.sum()) + there + self._size(spread, np.arange(len(spread)))

    def costs(self, spread: Array) -> Array:
        """Nats (K,) that each has to earn, the others there."""
        out = self.sought - np.log(np.diag(spread) * np.diag(self.precision)) / 2
        for n, own in self.kinds:
            out[own] += presence_cost(n, len(own)) - presence_cost(n, len(own) - 1)
        return out

    def costs_of(self, spread: Array, earned: Array) -> Array:
        """The same; where a kind as a whole does not earn its cost (K,), its mean for each."""
        out = self.costs(spread)
        for n, own in self.kinds:
            whole = presence_cost(n, len(own)) + self._size(spread, own)
            if (earned - self.sought)[own].sum() < whole:
                out[own] = np.maximum(out[own], whole / len(own) + self.sought[own])
        return out

    def _size(self, spread: Array, own: IntArray) -> float:
        """Nats that finding sizes costs: how much narrower the readings make what they may be.
        Where they say nothing of a size, it costs nothing."""
        at = np.ix_(own, own)
        return -0.5 * float(sum(np.linalg.slogdet(m[at])[1] for m in (spread, self.precision)))

    def penalty(self, sizes: Array) -> tuple[float, Array]:
        """−2 log prior of the logarithms (K,) of sizes, and its slope."""
        slope = self.precision @ sizes
        return float(sizes @ slope), 2 * slope


def presence_cost(n: int, k: int) -> float:
    """Nats of k components of a kind being there at n places, over none."""
    if k == 0:
        return 0.0
    ways = special.gammaln(n + 1) - special.gammaln(k + 1) - special.gammaln(n - k + 1)
    return float(np.log((1 / PRESENT - 1) * n) + ways)


def log_odds(components: Sequence[Component], another: Component) -> float:
    """Prior log odds that another component is there beside these, less what its search cost."""
    kinds = Pool([*components, another]).kinds
    n, k = next((n, len(own)) for n, own in kinds if len(components) in own)
    return presence_cost(n, k - 1) - presence_cost(n, k) - another.sought


# Of columns C (C, m, k) under a noise: XᵀV⁻¹C (p, k) of those that they stand beside, CᵀV⁻¹C (k, k)
# and CᵀV⁻¹r (k,).
Across = tuple[Array, Array, Array]

# Change of −2ℓ at which sizes are settled, and at which they tell what is of no use; steps to it.
SETTLED, ROUGHLY, STEPS = 2e-3, 0.1, 30


@dataclass(frozen=True)
class SumOfComponents:
    """Components beside the data's own columns, under a noise whose factor is free: −2ℓ and its
    slope.  Of the data under that `noise` V: `inverse` V⁻¹ (C, m, m), zero where rows do not count;
    `products` with the components last; and what of −2ℓ no coefficient changes."""

    data: NoisyData
    components: tuple[Component, ...]
    noise: NoiseValues
    inverse: Array
    products: Products
    constant: float

    @cached_property
    def spans(self) -> tuple[slice, ...]:
        return spans_of([c.width for c in self.components], len(self.products.z))

    @cached_property
    def by_size(self) -> Array:
        """How the logarithms of all prior variances (p + Σ k, K) grow with those of sizes."""
        grown = np.zeros((len(self.products.z), len(self.components)))
        for k, span in enumerate(self.spans):
            grown[span, k] = 2.0
        return grown

    def scaled(self, factor: float) -> SumOfComponents:
        """The same under e^factor times the noise."""
        own, a = self.products, float(np.exp(factor))
        products = Products(own.M / a**2, own.z / a**2, own.squares / a**2, own.rows)
        noise = replace(self.noise, factor=self.noise.factor * a, joint=self.noise.joint * a)
        constant = self.constant + 2 * own.rows * factor
        return replace(
            self, noise=noise, inverse=self.inverse / a**2, products=products, constant=constant
        )

    def only(self, kept: Sequence[int]) -> SumOfComponents:
        every, own = self.products, np.arange(len(self.data.precision))
        index = np.concatenate([own, np.r_[(slice(0, 0), *(self.spans[k] for k in kept))]])
        products = replace(every, M=every.M[np.ix_(index, index)], z=every.z[index])
        return replace(self, components=tuple(self.components[k] for k in kept), products=products)

    @cached_property
    def pool(self) -> Pool:
        return Pool(self.components)

    def _beside(self, columns: Array) -> Across:
        white = _rows(self.inverse @ columns)
        others = (self.data.X, *(c.columns for c in self.components))
        across = np.concatenate([_rows(C).T @ white for C in others])
        return across, _rows(columns).T @ white, white.T @ self.data.r.ravel()

    def across(self, columns: Sequence[Array]) -> Iterator[Across]:
        for some in bundles(columns):
            cross, own, z = self._beside(side_by_side(self.data, some))
            for at in spans_of([c.shape[2] for c in some], len(z)):
                yield cross[:, at], own[at, at], z[at]

    def joined(self, more: Sequence[Component]) -> SumOfComponents:
        out = self
        for columns in bundles([c.columns for c in more]):
            some, more = more[: len(columns)], more[len(columns) :]
            cross, own, z = out._beside(side_by_side(self.data, columns))
            M = np.block([[out.products.M, cross], [cross.T, own]])
            products = replace(out.products, M=M, z=np.append(out.products.z, z))
            out = replace(out, components=(*out.components, *some), products=products)
        return out

    def variances(self, at: Sizes) -> Array:
        """Prior variances of all coefficients (p + Σ k,)."""
        shares = [c.shares(length)[0] for c, length in zip(self.components, at.length, strict=True)]
        sized = [np.exp(2 * s) * share for s, share in zip(at.size, shares, strict=True)]
        return np.concatenate([1 / self.data.precision, *sized])

    def factored(self, at: Sizes) -> tuple[Standardised, float]:
        """The coefficients under e^factor times the noise, and −2ℓ."""
        found = self.products.at(self.variances(at), at.factor)
        return found, self.constant + self.products.value(found)

    def objective(self, theta: Array) -> tuple[float, Array, Array]:
        """−2 log posterior of the logarithms, its slope and its average information
        (1 + 2 K, 1 + 2 K): the mean of observed and expected curvature (Gilmour, Thompson and
        Cullis 1995, Biometrics 51, 1440).  With A the coefficients' precision in units of their
        prior deviations and b their mean, two parameters that change the logarithms of prior
        variances by s and t share sᵀb(1 − A⁻¹)bt."""
        K, at = len(self.components), Sizes.of(theta)
        by_length = np.zeros_like(self.by_size)
        for k, (c, span) in enumerate(zip(self.components, self.spans, strict=True)):
            by_length[span, k] = c.shares(at.length[k])[1]
        grown = np.hstack([self.by_size, by_length])
        value, slope, information = self.products.objective(self.variances(at), grown, at.factor)
        prior, of_sizes = self.pool.penalty(at.size)
        value += self.constant + prior
        slope[1 : K + 1] += of_sizes
        information[1 : K + 1, 1 : K + 1] += 2 * self.pool.precision
        if self.data.stated:
            value += (at.factor / 0.5) ** 2
            slope[0] += 2 * at.factor / 0.25
            information[0, 0] += 2 / 0.25
        return value, slope, information

    def spread(self, found: Standardised) -> Array:
        """Covariance (K, K) of the logarithms of the sizes, all else as it is."""
        known = found.information(self.by_size)[0] / 2 + self.pool.precision
        return np.asarray(np.linalg.inv(known))

    def climbed(self, at: Sizes, enough: float = SETTLED, factor_alone: bool = False) -> Sizes:
        """The sizes after steps by the average information until one promises less than `enough` of
        −2ℓ; the noise's factor alone, the others as they are."""
        K = len(self.components)
        theta = np.concatenate([[at.factor], at.size, at.length])
        lower, upper = theta.copy(), theta.copy()
        lower[0], upper[0] = at.factor - 4, at.factor + 4
        if not factor_alone:
            lengths = np.array([c.lengths for c in self.components]).reshape(K, 2)
            lower[1:] = np.concatenate([np.full(K, GONE - 1), lengths[:, 0]])
            most = [min(LARGEST, float(np.log(c.effect.most))) for c in self.components]
            upper[1:] = np.concatenate([most, lengths[:, 1]])
        return Sizes.of(climb(self.objective, theta, lower, upper, enough, STEPS)[0])

    def earned(self, at: Standardised) -> tuple[Array, Array]:
        """By how much ℓ falls (K,) where a component is left out, all else as it is; and what of it
        (K,) is due to coefficients that cannot be negative: the posterior's share of that half."""
        within = np.zeros(len(self.components))
        for k, span in enumerate(self.spans):
            i = np.arange(span.start, span.stop)[self.components[k].bounded]
            within[k] = within_bounds(at.b[i] / np.linalg.norm(at.inverse[:, i], axis=0))
        return at.left_out(list(self.spans)) + within, within


def side_by_side(data: NoisyData, columns: Sequence[Array]) -> Array:
    return np.concatenate([np.zeros((*data.r.shape, 0)), *columns], axis=2)


# About so many columns are multiplied together, since a few by themselves wait for memory, and all
# of thousands of poses would take hundreds of megabytes.
BUNDLE = 200


def bundles(columns: Sequence[Array]) -> Iterator[Sequence[Array]]:
    ends = np.cumsum([0, *(c.shape[2] for c in columns)]) // BUNDLE
    at = np.flatnonzero(np.diff(ends)) + 1
    yield from (columns[a:b] for a, b in pairwise([0, *at, len(columns)]) if b > a)


def posed(
    data: NoisyData, components: Sequence[Component], noise: NoiseValues,
    known: SumOfComponents | None = None,
) -> SumOfComponents:  # fmt: skip
    """The sum of these components beside the data's own columns, under one noise.  What a sum that
    is `known` of the same data has summed up under this noise is not summed anew."""
    if known is None or known.noise is not noise:
        own = Weighted.of(data, noise)
        inverse = own.root.transpose(0, 2, 1) @ own.root
        known = SumOfComponents(data, (), noise, inverse, own.products, own.constant)
    wide = known.joined([c for c in components if c not in known.components])
    return wide.only([wide.components.index(c) for c in components])


def _rows(columns: Array) -> Array:
    return columns.reshape(-1, columns.shape[2])


@dataclass(frozen=True)
class FittedSum:
    """The components that are left, their sizes, the noise beside them and the log posterior.
    `earned` (K,) nats of each, `spread` (K, K) the covariance of the logarithms of their sizes;
    `sums` are those over the rows of the data, which are without their columns, `variances` (Σ k,)
    their coefficients' prior.  `complete` are the components whose kinds have been tried at all
    their places beside it."""

    sizes: Sizes
    noise: NoiseValues
    earned: Array
    spread: Array
    score: float
    sums: SumOfComponents
    variances: Array
    complete: Sequence[Component] = ()

    @property
    def components(self) -> tuple[Component, ...]:
        return self.sums.components

    @cached_property
    def data(self) -> NoisyData:
        plain = self.sums.data
        columns = side_by_side(plain, [plain.masked(c.columns) for c in self.components])
        return plain.with_columns(columns, 1 / self.variances)

    @cached_property
    def _shown(self) -> tuple[Array, ...]:
        plain, inverse = self.sums.data, self.sums.inverse
        priors = np.append(1 / plain.precision, self.variances)
        return tuple(
            _compressed(plain.masked(c.columns), priors[span], inverse, HARDLY)
            for c, span in zip(self.components, self.spans, strict=True)
        )

    @property
    def spans(self) -> tuple[slice, ...]:
        return self.sums.spans

    def away(self, components: Sequence[Component]) -> list[Component]:
        return [c for c in components if c not in self.components]

    def without_these(self, some: Sequence[Component] = ()) -> NoisyData:
        """The data beside all but some of the components, these by the directions that show: half
        as many columns, for searches."""
        every = zip(self.components, self._shown, strict=True)
        joined = side_by_side(self.sums.data, [shown for c, shown in every if c not in some])
        return self.sums.data.with_columns(joined, np.ones(joined.shape[2]))


ROUNDS = 48
MOST_AT_ONCE = 0.5  # nats: components that earn less go together
SOME = 400  # configurations, or up to twice as many, from which the noise is estimated


def fit_sum(
    data: NoisyData, components: Sequence[Component], noise: NoiseValues,
    start: Sizes | None = None, refit_noise: bool = True, known: SumOfComponents | None = None,
) -> FittedSum:  # fmt: skip
    """Maximise over all sizes; leave out, one after the other, what does not earn its cost.
    `known` are the sums of a fit to the same data, which are not summed anew."""
    at, rounds = start or Sizes.start(components), 2 if refit_noise and start is None else 1
    problem = posed(data, components, noise, known)
    for last in range(rounds):
        enough = ROUGHLY
        for _ in range(ROUNDS):
            at = problem.climbed(at, enough)
            kept = _kept(problem, at, strict=last == rounds - 1)
            if len(kept) < len(problem.components):
                problem, at, enough = problem.only(kept), at.chosen(kept), ROUGHLY
            elif enough == SETTLED:
                break
            else:
                enough = SETTLED
        problem, at = problem.scaled(at.factor), replace(at, factor=0.0)
        if refit_noise:
            problem = posed(data, problem.components, _noise_beside(problem, at))
            # Some of the configurations do not tell its size as all do: a sum under it would be
            # worth less than the next one, whose factor is free.
            if len(data.r) >= 2 * SOME:
                problem = problem.scaled(problem.climbed(at, factor_alone=True).factor)
        if not problem.components:
            break
    return at_maximum(problem, at)


def at_maximum(problem: SumOfComponents, at: Sizes) -> FittedSum:
    found, value = problem.factored(at)
    spread = problem.spread(found)
    score = -value / 2 - problem.pool.penalty(at.size)[0] / 2 - problem.pool.cost(spread)
    score -= 0.5 * log_prior(problem.data.stated, problem.noise)
    earned, within = problem.earned(found)
    own = problem.variances(at)[len(problem.data.precision) :]
    return FittedSum(at, problem.noise, earned, spread, score + float(within.sum()), problem, own)


def _kept(problem: SumOfComponents, at: Sizes, strict: bool) -> list[int]:
    """Components that stay: not the worst of those that do not earn their cost, nor those that are
    next to nothing; only these go where not `strict`, since under a noise that does not suit them
    the others may earn too little."""
    prior = problem.pool.precision  # −log prior falls where a component is left out
    found, _ = problem.factored(at)
    earned = problem.earned(found)[0] - (prior @ at.size) ** 2 / np.diag(prior) / 2
    costs = problem.pool.costs_of(problem.spread(found), earned) if strict else MOST_AT_ONCE
    spare = earned - costs
    stays = np.array([c.given for c in problem.components], dtype=bool)
    poor = (spare < 0) & ~stays
    if not poor.any():
        return list(range(len(spare)))
    gone = (at.size < GONE) | ((earned < MOST_AT_ONCE) & poor)
    gone[np.argmin(np.where(stays, np.inf, spare))] = True
    gone &= ~stays
    return [k for k in range(len(spare)) if not gone[k]]


def _noise_beside(problem: SumOfComponents, at: Sizes) -> NoiseValues:
    """The most probable noise beside the components at their sizes, from SOME configurations."""
    data, noise, variances = problem.data, problem.noise, problem.variances(at)
    some = data.every(step) if (step := max(1, len(data.r) // SOME)) > 1 else data
    columns = [
        _compressed(some.masked(c.columns[::step]), variances[span], problem.inverse[::step])
        for c, span in zip(problem.components, problem.spans, strict=True)
    ]
    joined = side_by_side(some, columns)
    wide = some.with_columns(joined, np.ones(joined.shape[2]))
    # From next to nothing the likelihood is flat in a joint's logarithm, and no climb leaves.
    usual = NoiseValues.usual(len(noise.joint)).joint
    start = replace(noise, joint=np.maximum(noise.joint, FLAT * usual))
    found = fit_noise(wide, start, ENOUGH)
    if data.stated or (found.joint > STANDS_OUT * usual).any():
        return found
    # Nor from there where nothing is stated and the instrument has taken the joints' scatter.
    return min(found, fit_noise(wide, balanced(wide), ENOUGH), key=lambda end: posterior(wide, end))


# Of its usual scatter: below, a joint's is not seen to grow.  Of −2ℓ: what the noise is fitted to.
FLAT, ENOUGH = 1.0, 0.01
STANDS_OUT = 2.0  # times its usual scatter: a joint that the data show
# Of the noise's variance: what a direction of a component may add and be left out, where the noise
# is fitted, and where more is searched for.
FAINT, HARDLY = 1e-2, 1e-4


def _compressed(columns: Array, variances: Array, inverse: Array, faint: float = FAINT) -> Array:
    """The few directions (C, m, k) of a component that show beside the noise, of unit variance;
    `inverse` is that of its V."""
    scaled = columns * np.sqrt(variances)
    values, vectors = np.linalg.eigh(_rows(scaled).T @ _rows(inverse @ scaled))
    return np.asarray(scaled @ vectors[:, values > faint])


# Two causes that look alike share what they do by their sizes; which of these are the most probable
# decides little.  So the sizes of effects that need no search are drawn as well, one after another
# given the others (Gibbs), their coefficients integrated out: with A and b what the others leave of
# its normal matrix and right side, a component of size s, or none, has the log evidence
#
#     −½ log|1 + s²A| + ½ bᵀ(s⁻² + A)⁻¹b,
#
# beside the prior of `Pool`.  What is hidden is not there at first, and pays for being there as all
# others do.  How alike the sizes of a kind are is unknown too, and drawn: where the eccentricities
# of six joints are alike, that of the seventh, which looks like its sag, hardly is ten times as
# large.  The weights of all links, which are given where they stand, have a size for every moment:
# those along the links are large, all alike, those across them next to nothing.

GRID = np.linspace(GONE, LARGEST, 41)  # logarithms of sizes
SIZES, LOGS = np.exp(GRID), np.append(GRID, -np.inf)  # the logarithm of none as well
SPREADS = np.linspace(0.1, 0.9, 9) * SPREAD  # what sizes of a kind may spread by
SETTLING = 30  # sweeps


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
    logs = np.append(found.sizes.size, np.full(len(hidden), -np.inf))
    kinds = list(_kinds(components, own, logs))
    sized = np.full(len(c), np.inf)  # prior precisions; infinite where there is nothing
    for kind in kinds:
        for log, span in zip(kind.logs, kind.spans, strict=True):
            sized[span] = np.exp(-2 * log)
    out, z = np.zeros((len(prior), n)), linalg.solve_triangular(L, right[x], lower=True)
    t = right[c] - across.T @ z
    for sweep in range(-SETTLING, n):
        for kind in kinds:
            # Any spread is as probable as another beforehand.
            spread = float(SPREADS[_one_of(_log_density(kind.present, SPREADS), rng)])
            for k, span in enumerate(kind.spans):
                kind.logs[k] = -np.inf
                evidence = np.append(_at_sizes(S, t, sized, span), 0.0)
                kind.logs[k] = LOGS[_one_of(evidence + kind.log_prior(k, spread), rng)]
                sized[span] = np.exp(-2 * kind.logs[k])
        if sweep < 0:
            continue
        beta = out[:, sweep]
        i = np.flatnonzero(sized < np.inf)
        A = S[np.ix_(i, i)] + np.diag(sized[i])
        apart = np.linalg.solve(np.linalg.cholesky(A).T, rng.normal(size=len(i)))
        beta[c[i]] = np.linalg.solve(A, t[i]) + apart
        beta[x] = z - across @ beta[c] + rng.normal(size=len(x))
    out[x] = linalg.solve_triangular(L, out[x], lower=True, trans="T", check_finite=False)
    return out


@dataclass(frozen=True)
class _Kind:
    """What has sizes that are alike: a kind's components, or an effect's parameters.  Its members'
    `spans` of the columns and `logs` (k,) of their sizes, −∞ of none; what finding them `sought`
    (k,); at how many `places` there may be one, None where it is there in any case."""

    spans: Sequence[slice]
    logs: Array
    sought: Array
    places: int | None

    @property
    def present(self) -> Array:
        return self.logs[self.logs > -np.inf]

    def log_prior(self, k: int, spread: float) -> Array:
        """Of every size on the GRID for member k beside those present, and of none."""
        # Of m that have spread² their own and the rest of SPREAD² in common, the next one.
        m, common = len(self.present), SPREAD**2 - spread**2
        known = common / (spread**2 + m * common)
        mean, variance = known * self.present.sum(), spread**2 * (1 + known)
        out = np.log((GRID[1] - GRID[0]) / np.sqrt(2 * np.pi * variance))
        out = out - 0.5 * (GRID - mean) ** 2 / variance
        if self.places is None:
            return np.append(out, -np.inf)
        cost = presence_cost(self.places, m + 1) - presence_cost(self.places, m)
        return np.append(out - cost - self.sought[k], 0.0)


def _kinds(components: Sequence[Component], own: Sequence[int], logs: Array) -> Iterator[_Kind]:
    """The kinds of these of all components, whose sizes have these `logs`; their spans are those
    among the columns of `own`."""
    widths = [components[k].width for k in own]
    spans = dict(zip(own, spans_of(widths, sum(widths)), strict=True))
    pool = Pool(components)
    for places, members in pool.kinds:
        mine = [k for k in members.tolist() if k in spans]
        free = [k for k in mine if not components[k].given]
        for k in (k for k in mine if components[k].given):
            h = components[k].hypothesis
            assert h is not None
            # Of its parameters those that are of similar sizes together.
            words = np.array([p.alike for p in h.parameters])
            for word in np.unique(words):
                columns = spans[k].start + np.flatnonzero(words == word)
                same = [slice(i, i + 1) for i in columns.tolist()]
                yield _Kind(same, np.full(len(same), logs[k]), np.zeros(len(same)), None)
        yield _Kind([spans[k] for k in free], logs[free], pool.sought[free], places)


def _one_of(log_p: Array, rng: np.random.Generator) -> int:
    """One of so many, each as probable as exp log_p: the largest with Gumbel noise on it."""
    return int(np.argmax(log_p + rng.gumbel(size=len(log_p))))


def _log_density(logs: Array, spread: Array) -> Array:
    """Of the logarithms (k,) of sizes at each spread of their own, but for a constant: k − 1 times
    they vary by it, their mean by what it leaves of SPREAD."""
    k, own = len(logs), spread**2
    mean, of_mean = own + k * (SPREAD**2 - own), logs.sum() ** 2 / max(k, 1)
    squares = (k - 1) * np.log(own) + ((logs**2).sum() - of_mean) / own
    return np.asarray(-0.5 * (squares + np.log(mean) + of_mean / mean))


def _at_sizes(S: Array, t: Array, sized: Array, span: slice) -> Array:
    """Log evidence of the columns `span` at every size of the GRID, over none, beside all others
    that have one."""
    others = np.flatnonzero(sized < np.inf)
    others = others[(others < span.start) | (others >= span.stop)]
    A, b = beside(S, t, sized, others, span)
    values, vectors = np.linalg.eigh(A)
    a, b = np.maximum(values, 0.0), vectors.T @ b
    return at_scales(a[None], b[None, :, None], SIZES)[0, :, 0]
