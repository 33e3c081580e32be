"""Lines of a joint's error: families that stand out beside a sum, and which order they have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np
from scipy.special import logit, logsumexp, ndtri

from elastocal.diagnosis.component_families import MOVED, beside, moved
from elastocal.diagnosis.components import ALONE, Component, FittedSum, presence_cost
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Hypothesis, RegressorDirection, cell_with
from elastocal.diagnosis.noise_floor import NoiseValues, log_prior, project
from elastocal.model.effects.base import JointMotion, index, turning_joints
from elastocal.model.effects.gears import MOST_LINES, GearRipple, GearSpectrum
from elastocal.model.effects.smooth import JointCurve
from elastocal.units import Array, BoolArray, IntArray

# Families of lines of a joint's error, which are looked for beside all else.
#
# A wheel that turns N times per turn of the joint makes lines at N and its multiples: sought
# together they show where none of them would by itself.  The evidence of 2m columns at N, 2N, …,
# mN is that of any group; N runs over a grid as fine as the highest of them needs, and each point
# costs its share of the prior.

MULTIPLES = (1, 2, 3)  # lines of a family, up to so many times the lowest order
LOWEST, HIGHEST = 2.5, 250.0  # orders
STEP = 1.5  # of the highest order of a family, in units of 1/range(q)
# Up to so many poses lines are sought by families, and before curves; in more, single lines show.
FEW_POSES = 300
LINE = 5e-5  # rad, a typical line
LINE_SCALES = np.array([0.3, 1.0, 3.0, 10.0])


@dataclass(frozen=True)
class LineFamily:
    """Lines of a joint as a `component` that earns `gain` nats less the search, the joint's
    `scatter` beside them, of a visit and as a multiple of it that of a configuration, and the
    components that they are `instead_of`."""

    component: Component
    gain: float
    scatter: tuple[float, float]
    instead_of: tuple[Component, ...]


def line_families(dataset: DiagnosisData, found: FittedSum) -> list[LineFamily]:
    """The most conspicuous family of lines of every joint beside the sum, the best first.

    What is not found yet counts as scatter of its joint, or as its curve: so a family is tried
    beside these, and in their place.
    """
    sums = beside(dataset, found, found.noise)
    out, now = list[LineFamily](), sums.at.marginal
    multiples = MULTIPLES[:1] if len(dataset.blocks.member) > FEW_POSES else MULTIPLES
    for h in ripples(dataset):
        i = index(h.where)
        own = [c for c in found.components if c.where == h.where]
        lines = sum(len(c.settings) // 2 for c in own if isinstance(c.effect, GearSpectrum))
        if lines > MOST_FOUND:
            continue
        curves = tuple(c for c in own if isinstance(c.effect, JointCurve))
        scatter = scatter_of(found.noise, i)
        beneath = less_scatter(found.noise, i) or ([scatter] if curves else [])
        quieter = (
            (beside(dataset, found, with_scatter(found.noise, i, less), curves), less, curves)
            for less in beneath
        )
        tried = (
            (*_best_family(grams, h, m, now), less, instead_of)
            for grams, less, instead_of in chain([(sums, scatter, ())], quieter)
            for m in multiples
        )
        gain, of, less, instead_of = max(tried, key=lambda family: family[0])
        if gain > HOPELESS:
            component = family_component(dataset, h.where, *of)
            out.append(LineFamily(component, gain, less, instead_of))
    return sorted(out, key=lambda family: -family.gain)


# A family that is this far (nats) from paying for its search beside the sum as it is may still pay
# once noise, sizes and the other orders have followed.
HOPELESS = -3.0


def with_scatter(noise: NoiseValues, i: int, scatter: tuple[float, float]) -> NoiseValues:
    joint, shared = noise.joint.copy(), noise.shared.copy()
    joint[i], shared[i] = scatter
    return replace(noise, joint=joint, shared=shared)


def scatter_of(noise: NoiseValues, i: int) -> tuple[float, float]:
    return float(noise.joint[i]), float(noise.shared[i])


def less_scatter(noise: NoiseValues, i: int) -> list[tuple[float, float]]:
    """Scatter that joint i (0-based) may have once its lines are known: half of it, as usual from
    pose to pose, and as usual from visit to visit as well."""
    s, c = scatter_of(noise, i)
    s_usual, c_usual = scatter_of(NoiseValues.usual(len(noise.joint)), i)
    s_least, c_least = min(s, s_usual), min(c, c_usual)
    half = (s, c / 2) if c > 1 else (s / 2, c)
    tried = {(max(half[0], s_least), max(half[1], c_least)), (s, c_least), (s_least, c_least)}
    return sorted(tried - {(s, c)}, reverse=True)


MOST_FOUND = MOST_LINES - 3


def _best_family(
    grams: Grams, h: Hypothesis, m: int, now: float
) -> tuple[float, tuple[float, int, float, float]]:
    """What the best family of m lines of a joint gains, and its order, m, how well these data know
    the order, and what finding it cost; `now` is the log marginal likelihood of the sum as it is.
    """
    step = STEP * _apart(grams.dataset, h.where) / m
    orders = np.arange(LOWEST, HIGHEST / m, step)
    # An order of 10 to 20 is as probable as one of 100 to 200 beforehand.
    log_prior = -np.log(orders) - np.log((1 / orders).sum() * len(MULTIPLES))
    k = int(np.argmax(family_evidence(grams, h, orders, m) + log_prior))
    search = -float(log_prior[k])
    order, sd, evidence = refined_order(grams, h, float(orders[k]), m, step)
    return evidence - search + (grams.at.marginal - now), (order, m, sd, search)


def _apart(dataset: DiagnosisData, where: str) -> float:
    """1/range(q) of a joint, by which the orders of its lines are told apart."""
    return 1 / float(np.ptp(dataset.table.q[:, index(where)]))


def sharpened(dataset: DiagnosisData, found: FittedSum) -> list[Component] | None:
    """The components of a sum with the orders of all lines where they fit best together; None
    where they are there already.

    Gauss–Newton in the orders N of all families at once, sizes and noise as they are: with
    amplitudes a_k, b_k at their posterior mean, a family's column is
    Σ_k k (q − q₀)(a_k cos kNq − b_k sin kNq), which is that of the amplitudes' shifts.  The
    posterior says how well each order is known.
    """
    families = [k for k, c in enumerate(found.components) if isinstance(c.effect, GearSpectrum)]
    if not families:
        return None
    now, moved = found, False
    # Of each pair of amplitudes, sine and cosine, the columns and then those of their shifts.
    quads = [np.r_[found.spans[k]].reshape(-1, 4) for k in families]
    lines, shifts = ([quad[:, some].ravel() for quad in quads] for some in ([0, 1], [2, 3]))
    kept = np.ones(found.data.X.shape[2], dtype=bool)
    kept[np.concatenate(shifts)] = False
    places = [found.components[k].where for k in families]
    most = STEP * np.array([_apart(dataset, where) for where in places])
    best = -np.inf
    for _ in range(SHARPENINGS):
        X = now.data.X
        alone = replace(now.data, X=X[:, :, kept], precision=now.data.precision[kept])
        at = project(alone, now.noise)
        if at.marginal < best + SHARP:
            break
        best, moved, found = at.marginal, now is not found or moved, now
        amplitude = np.zeros(len(kept))
        amplitude[kept] = at.beta
        sd = [dict(now.components[k].settings)["order_sd_1"] for k in families]
        turned = [
            X[:, :, shift] @ amplitude[line] / d
            for line, shift, d in zip(lines, shifts, sd, strict=True)
        ]
        at = project(alone.with_columns(np.stack(turned, axis=2), 1 / most**2), now.noise)
        steps = np.clip(at.beta[-len(families) :], -most, most)
        spread = np.linalg.norm(at.beta_deviation[:, -len(families) :], axis=0)
        components = list(now.components)
        for k, step, known in zip(families, steps, spread, strict=True):
            c = components[k]
            m = c.width // 4
            order = min(max(dict(c.settings)["order_1"] + float(step), LOWEST), HIGHEST / m)
            family = family_component(dataset, c.where, order, m, float(known), c.search)
            components[k] = replace(family, given=c.given)
        now = replace(now, sums=replace(now.sums, components=tuple(components)))
    return list(found.components) if moved else None


SHARPENINGS, SHARP = 6, 0.05  # nats that another step must gain


def refined_order(
    grams: Grams, h: Hypothesis, order: float, m: int, width: float, scales: Array = LINE_SCALES
) -> tuple[float, float, float]:
    """Lowest order of a family, its standard deviation and log evidence, sought within `width` of
    `order`: the curvature of the evidence says how well it is known."""
    for narrowed in width / 4.0 ** np.arange(3):
        trial = np.clip(order + np.linspace(-narrowed, narrowed, 17), LOWEST, HIGHEST / m)
        order = float(trial[int(np.argmax(family_evidence(grams, h, trial, m, scales)))])
    trial = np.linspace(-width, width, 33)
    each = family_evidence(grams, h, order + trial, m, scales)
    evidence = float(each[16])
    # The parabola through the highest five points, or all that are nearly as high.
    near = np.abs(trial) <= max(np.abs(trial[each > evidence - 2.0]).min(initial=0.0), trial[18])
    near |= (each > evidence - 2.0) & (np.abs(trial) < width / 2)
    curvature = -2 * np.polyfit(trial[near], each[near], 2)[0]
    sd = float(1 / np.sqrt(max(curvature, 1.0 / width**2)))
    return order, sd, evidence


def family_evidence(
    grams: Grams, h: Hypothesis, orders: Array, m: int, scales: Array = LINE_SCALES
) -> Array:
    """Log evidence (G,) of the families of m lines at `orders` (G,)."""
    dataset = grams.dataset
    sums = grams.entry(h.entry_key(dataset.base.model))

    def directions(some: slice) -> Array:
        # The amplitudes of multiples fall with their number, in the mean.
        D = [dataset.direction(h, orders[some, None] * k) / k for k in range(1, m + 1)]
        return np.concatenate(D, axis=4)

    return sums.each(len(orders), 2 * m, directions).evidence(scales)


def family_component(
    dataset: DiagnosisData, where: str, order: float, m: int, sd: float, search: float
) -> Component:
    effect = GearSpectrum()
    q = dataset.table.q[:, index(where)]
    settings = {"spectrum_size_rad": 1.0, "spectrum_centre_rad": float((q.max() + q.min()) / 2)}
    for k in range(1, m + 1):
        settings |= {f"order_{k}": k * order, f"order_sd_{k}": k * sd}
    chain, cell = dataset.base.model.chain, cell_with(dataset.base.model.cell, where, settings)
    lines = Hypothesis(effect, where, effect.parameters(where, chain, cell), ())
    D = RegressorDirection(lines, chain, cell)(dataset.table, np.zeros((1, 0)))[:, 0]
    D = D * [LINE * (p.typical or 0.0) for p in lines.parameters]
    columns = moved(dataset, (JointMotion.name, (where,)), D)
    kept = tuple((key, v) for key, v in settings.items() if key.startswith("order"))
    return Component(
        "angle", effect, where, columns, LINE, settings=kept, search=search,
        fellows=len(turning_joints(chain)),
    )  # fmt: skip


# Which order the lines of a joint have, or whether there are any: all orders judged at once.
#
# Beside a sum of components, with the joint's own family left out, a family of lines at N and its
# multiples has the log evidence E(N) over none, its size integrated out under what those of the
# other joints let expect.  That k of n joints have a family says of the next one that it has: where
# any number of joints is equally probable beforehand, the share of joints with one Beta(1, 1), the
# odds are
#
#     (k + 1) : (n − k)
#
# (Laplace's rule of succession; Scott and Berger 2010, Annals of Statistics 38, 2587; see `Pool`).
# So the odds of N against no family are w(N) exp E(N) (k + 1)/(n − k), w its prior, and what the
# joint scatters by from pose to pose where its family is not found is summed over on both sides.
# Gears of one arm are alike: sizes, log N and the number of multiples have a prior about what the
# other joints have, as wide as these differ, and one more that is like any.  The rule is for joints
# beside others: where no family has been found by what it earns, none comes in by it.

# Of the grid, in units of 1/range(q) for the highest multiple.  Lowest orders that differ by less
# than π such units are one: over the joint's angles they part by half a period at most.
FINE, SAME = 0.5, math.pi
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


class OrderPosterior:
    """Of the lines of the joint of the ripple `h` beside the sum without the family `own`: what the
    odds are against no family of `orders` (G,), the lowest one of `multiples` (G,) lines.

    `log_odds` (G,) has prior and width of the grid in it, of which `presence` is that of any
    family; `evidence` (G,) is over none.  `grams` score lines of these `scales` under the `scatter`
    of the joint that is the likeliest with them.
    """

    def __init__(
        self, dataset: DiagnosisData, found: FittedSum, h: Hypothesis,
        own: Sequence[Component] = (),
    ) -> None:  # fmt: skip
        i, unit = index(h.where), _apart(dataset, h.where)
        grid = [np.arange(LOWEST, HIGHEST / m, FINE * unit / m) for m in MULTIPLES]
        self.h, self.resolution, self.orders = h, SAME * unit, np.concatenate(grid)
        self.multiples = np.repeat(MULTIPLES, [len(part) for part in grid])
        fellows = [f for f in families_of(found) if f.where != h.where]
        mean, variance = alike(np.array([f.size for f in fellows]), 0.0, ALONE)
        spread = np.sqrt(variance) * ndtri((np.arange(SIZES) + 0.5) / SIZES)
        self.scales = np.exp(mean + spread)
        n, k = len(turning_joints(dataset.base.model.chain)), len(fellows)
        self.presence = presence_cost(n, k) - presence_cost(n, k + 1)
        # What is not known of its lines counts as scatter of the joint.
        none, each, grams_of = [], [], []
        tried = [scatter_of(found.noise, i), *less_scatter(found.noise, i)]
        for scatter in tried:
            noise = with_scatter(found.noise, i, scatter)
            grams = beside(dataset, found, noise, own)
            none.append(grams.at.marginal - 0.5 * log_prior(grams.data.stated, noise))
            gains = [family_evidence(grams, h, part, m, self.scales)
                     for m, part in zip(MULTIPLES, grid, strict=True)]  # fmt: skip
            each.append(none[-1] + np.concatenate(gains))
            grams_of.append(grams)
        self.evidence = logsumexp(each, axis=0) - float(logsumexp(none))
        prior = log_prior_of(self.orders, self.multiples, unit, fellows)
        self.log_odds = self.evidence + self.presence + prior
        likeliest = int(np.argmax([e[np.argmax(self.log_odds)] for e in each]))
        self.grams, self.scatter = grams_of[likeliest], tried[likeliest]

    def odds_near(self, order: float, m: int | None = None) -> float:
        """Log odds of a family at this order, as far as these data resolve it, against none; of m
        lines, or of any number."""
        return self._odds(self._near(order, m))

    def _near(self, order: float, m: int | None = None) -> BoolArray:
        near = np.abs(self.orders - order) <= self.resolution
        return near if m is None else near & (self.multiples == m)

    def _odds(self, these: BoolArray) -> float:
        return float(logsumexp(self.log_odds[these])) if these.any() else -math.inf

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
        return int(np.argmax(np.where(self._near(order, m), self.log_odds, -np.inf)))

    def probability(self, order: float) -> float:
        """Of a line at this order, the lowest of its family or a multiple, beside all others and
        none: half an order with twice as many lines has it as well."""
        its = np.zeros(len(self.orders), dtype=bool)
        for k in MULTIPLES:
            its |= (np.abs(k * self.orders - order) <= self.resolution) & (self.multiples >= k)
        return math.exp(self._odds(its) - np.logaddexp(0.0, logsumexp(self.log_odds)))

    def family(self, order: float, m: int) -> Component:
        """The family of m lines near this order, where it fits best.

        The nats that its search costs are those that make of its evidence, and of the odds that
        there is any family, its odds against none and all other orders; what is decided here is
        not asked again.
        """
        k = self._peak(order, m)
        width = FINE / SAME * self.resolution / m
        at = float(self.orders[k])
        lowest, sd, _ = refined_order(self.grams, self.h, at, m, width, self.scales)
        own = float(logit(min(self.probability(order), CERTAIN)))
        search = max(float(self.evidence[k]) + self.presence - own, 0.0)
        return replace(
            family_component(self.grams.dataset, self.h.where, lowest, m, sd, search), given=True
        )


def log_prior_of(
    orders: Array, multiples: IntArray, unit: float, fellows: Sequence[KnownFamily]
) -> Array:
    """Log prior (G,) of a family's lowest order and number of lines, from those of other joints.

    Orders: normal in log N.  A next multiple is there with odds k + 1 to n − k + 1 where k of n
    families that may have it have it.
    """
    mean, variance = alike(np.log([f.order for f in fellows]), USUAL_ORDER, ORDERS)
    each = np.log(FINE * unit / multiples / orders) - 0.5 * (np.log(orders) - mean) ** 2 / variance
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
