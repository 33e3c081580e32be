"""Which order the lines of a joint have, or whether there are any: all orders judged at once.

Beside a sum of components, with the joint's own family left out, a family of lines at N and its
multiples has the log evidence E(N) over none, its size integrated out under what those of the
other joints let expect.  That k of n joints have a family says of the next one that it has: where
any number of joints is equally probable beforehand, the share of joints with one Beta(1, 1), the
odds are

    (k + 1) : (n − k)

(Laplace's rule of succession; Scott and Berger 2010, Annals of Statistics 38, 2587, as in `Pool`).
So the odds of N against no family are w(N) exp E(N) (k + 1)/(n − k), w its prior, and what the
joint scatters by from pose to pose where its family is not found is summed over on both sides.
Gears of one arm are alike: sizes, log N and the number of multiples have a prior about what the
other joints have, as wide as these differ, and one more that is like any.  The rule is for joints
beside others: where no family has been found by what it earns, none comes in by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logit, logsumexp, ndtri

from elastocal.diagnosis.component_families import (
    HIGHEST,
    LOWEST,
    MOVED,
    MULTIPLES,
    LineFamily,
    beside,
    family_component,
    family_evidence,
    less_scatter,
    refined_order,
    scatter_of,
    with_scatter,
)
from elastocal.diagnosis.components import ALONE, Component, FittedSum, presence_cost
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.noise_floor import log_prior
from elastocal.model.effects.base import index, turning_joints
from elastocal.model.effects.gears import GearRipple, GearSpectrum
from elastocal.units import Array, IntArray

# Of the grid, in units of 1/range(q) for the highest multiple.  Lowest orders that differ by less
# than π such units are one: over the joint's angles they part by half a period at most.
STEP, SAME = 0.5, math.pi
SIZES = 7  # of a family, equally probable
PEAKS = 40  # points of the grid that may be the middle of the most probable order
CERTAIN = 1 - 1e-9
# Logarithms: the middle of the orders and their spread, if any is as probable as any.
USUAL_ORDER = math.log(LOWEST * HIGHEST) / 2
ORDERS = math.log(HIGHEST / LOWEST) / math.sqrt(12)


@dataclass(frozen=True)
class KnownFamily:
    """Lines of the joint `where`: lowest order, how many, logarithm of their size."""

    where: str
    order: float
    multiples: int
    size: float

    @property
    def rms(self) -> float:
        """Of the joint's error, where that of a line of the same size is one: the amplitudes of
        multiples fall with their number."""
        return math.sqrt(sum(1 / k**2 for k in range(1, self.multiples + 1)))


@dataclass(frozen=True, eq=False)
class OrderPosterior:
    """Of the joint of `h`: what the odds are against no family of `orders` (G,), the lowest one
    of `multiples` (G,) lines: `log_odds` (G,), prior and width of the grid included, of which
    `presence` is that of any family; `evidence` (G,) over none.  `grams` score lines of these
    `scales` under the `scatter` of the joint that is the likeliest with them.
    """

    h: Hypothesis
    orders: Array
    multiples: IntArray
    log_odds: Array
    presence: float
    evidence: Array
    resolution: float
    grams: Grams
    scales: Array
    scatter: tuple[float, float]

    def odds_near(self, order: float, m: int | None = None) -> float:
        """Log odds of a family at this order, as far as these data resolve it, against none; of m
        lines, or of any number."""
        near = np.abs(self.orders - order) <= self.resolution
        near &= True if m is None else self.multiples == m
        return float(logsumexp(self.log_odds[near])) if near.any() else -math.inf

    @cached_property
    def best(self) -> tuple[float, int]:
        """The most probable order, at its highest peak, and the most probable number of lines."""
        top = np.argsort(self.log_odds)[-PEAKS:]
        return self._at(max(self.orders[top].tolist(), key=self.odds_near))

    @cached_property
    def likeliest_line(self) -> tuple[float, int]:
        """The order that most probably has a line, of whichever family, and how many lines a family
        that begins there most probably has."""
        top = np.argsort(self.log_odds)[-PEAKS:]
        every = {k * order for order in self.orders[top].tolist() for k in MULTIPLES}
        return self._at(max((o for o in every if o <= HIGHEST), key=self.probability))

    def _at(self, middle: float) -> tuple[float, int]:
        m = max(MULTIPLES, key=lambda n: self.odds_near(middle, n))
        return float(self.orders[self._peak(middle, m)]), m

    def _peak(self, order: float, m: int) -> int:
        near = (np.abs(self.orders - order) <= self.resolution) & (self.multiples == m)
        return int(np.argmax(np.where(near, self.log_odds, -np.inf)))

    def probability(self, order: float) -> float:
        """Of a line at this order, the lowest of its family or a multiple, beside all others and
        none: half an order with twice as many lines has it as well."""
        its = np.zeros(len(self.orders), dtype=bool)
        for k in MULTIPLES:
            its |= (np.abs(k * self.orders - order) <= self.resolution) & (self.multiples >= k)
        with_it = float(logsumexp(self.log_odds[its])) if its.any() else -math.inf
        return math.exp(with_it - np.logaddexp(0.0, logsumexp(self.log_odds)))

    def family(self, dataset: DiagnosisData, order: float, m: int) -> Component:
        """The family of m lines near this order, where it fits best.

        The nats that its search costs are those that make of its evidence, and of the odds that
        there is any family, its odds against none and all other orders; what is decided here is
        not asked again.
        """
        k = self._peak(order, m)
        width = STEP / SAME * self.resolution / m
        at = float(self.orders[k])
        lowest, sd, _ = refined_order(self.grams, self.h, at, m, width, self.scales)
        own = float(logit(min(self.probability(order), CERTAIN)))
        search = max(float(self.evidence[k]) + self.presence - own, 0.0)
        family = LineFamily(self.h.where, lowest, m, own, sd, search)
        return replace(family_component(dataset, family), given=True)


def order_posterior(
    dataset: DiagnosisData, found: FittedSum, h: Hypothesis, own: Sequence[Component] = ()
) -> OrderPosterior:
    """Of the lines of the joint of the ripple `h` beside the sum without the family `own`."""
    i = index(h.where)
    unit = 1 / max(float(np.ptp(dataset.table.q[:, i])), MOVED)
    grid = [np.arange(LOWEST, HIGHEST / m, STEP * unit / m) for m in MULTIPLES]
    orders = np.concatenate(grid)
    multiples = np.repeat(MULTIPLES, [len(part) for part in grid])
    fellows = [f for f in families_of(found) if f.where != h.where]
    mean, variance = alike(np.array([f.size for f in fellows]), 0.0, ALONE)
    scales = np.exp(mean + np.sqrt(variance) * ndtri((np.arange(SIZES) + 0.5) / SIZES))
    n, k = len(turning_joints(dataset.base.model.chain)), len(fellows)
    presence = presence_cost(n, k) - presence_cost(n, k + 1)
    # What is not known of its lines counts as scatter of the joint.
    none, each, grams_of = [], [], []
    tried = [scatter_of(found.noise, i), *less_scatter(found.noise, i)]
    for scatter in tried:
        noise = with_scatter(found.noise, i, scatter)
        grams = beside(dataset, found, noise, own)
        none.append(grams.at.marginal - 0.5 * log_prior(grams.data.stated, noise))
        gains = [family_evidence(grams, h, part, m, scales)
                 for m, part in zip(MULTIPLES, grid, strict=True)]  # fmt: skip
        each.append(none[-1] + np.concatenate(gains))
        grams_of.append(grams)
    evidence = logsumexp(each, axis=0) - float(logsumexp(none))
    log_odds = evidence + presence + log_prior_of(orders, multiples, unit, fellows)
    likeliest = int(np.argmax([e[np.argmax(log_odds)] for e in each]))
    return OrderPosterior(
        h, orders, multiples, log_odds, presence, evidence, SAME * unit,
        grams_of[likeliest], scales, tried[likeliest],
    )  # fmt: skip


def log_prior_of(
    orders: Array, multiples: IntArray, unit: float, fellows: Sequence[KnownFamily]
) -> Array:
    """Log prior (G,) of a family's lowest order and number of lines, from those of other joints.

    Orders: normal in log N.  A next multiple is there with odds k + 1 to n − k + 1 where k of n
    families that may have it have it.
    """
    mean, variance = alike(np.log([f.order for f in fellows]), USUAL_ORDER, ORDERS)
    each = np.log(STEP * unit / multiples / orders) - 0.5 * (np.log(orders) - mean) ** 2 / variance
    each -= logsumexp(each[multiples == 1])
    for m in MULTIPLES:
        own = multiples == m
        for last in MULTIPLES[1:]:
            may = [f for f in fellows if f.multiples >= last - 1 and last * f.order <= HIGHEST]
            share = (sum(f.multiples >= last for f in may) + 1) / (len(may) + 2)
            if m >= last:
                each[own] += math.log(share)
            elif m == last - 1:
                each[own] += np.where(last * orders[own] <= HIGHEST, math.log1p(-share), 0.0)
    return np.asarray(each)


def alike(others: Array, usual: float, spread: float) -> tuple[float, float]:
    """Mean and variance of another one beside these (k,), normal about what they have in common.

    Their own spread counts with one like `usual` ± `spread`, as wide as any is beforehand.
    """
    k = len(others)
    mean = (float(others.sum()) + usual) / (k + 1)
    variance = (spread**2 + float(((others - mean) ** 2).sum()) + (usual - mean) ** 2) / (k + 1)
    return mean, variance * (1 + 1 / (k + 1))


def families_of(found: FittedSum) -> list[KnownFamily]:
    """Of every joint with lines the largest family."""
    sized = zip(found.components, found.sizes.size.tolist(), strict=True)
    every = [
        KnownFamily(c.where, dict(c.settings)["order_1"], len(c.settings) // 2, size)
        for c, size in sized if isinstance(c.effect, GearSpectrum)
    ]  # fmt: skip
    return list({f.where: f for f in sorted(every, key=lambda f: f.size)}.values())


def ripples(dataset: DiagnosisData) -> list[Hypothesis]:
    return [
        h for h in dataset.hypotheses
        if isinstance(h.effect, GearRipple) and np.ptp(dataset.table.q[:, index(h.where)]) >= MOVED
    ]  # fmt: skip
