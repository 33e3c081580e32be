"""The search for all components at once, their shares of the gap, and what they are called."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.special import expit

from elastocal.diagnosis.baseline import (
    FARTHEST,
    NoiseValues,
    NoisyData,
    from_centre,
    prior_deviations,
    project,
)
from elastocal.diagnosis.component_families import (
    FEW_POSES,
    OrderPosterior,
    catalogue_components,
    component_of,
    drifts,
    families_of,
    joint_curves,
    line_families,
    ripples,
    sharpened,
    shorter,
    with_scatter,
    without_a_name,
)
from elastocal.diagnosis.components import (
    SETTLED,
    SOME,
    STEPS,
    Component,
    FittedSum,
    Sizes,
    at_maximum,
    fit_sum,
    log_odds,
    posed,
    presence_cost,
)
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.effect_search import ModelSet, about, extended, spans_of
from elastocal.diagnosis.evidence import ANOTHER, Item, evidence_of_groups, log_prior_odds
from elastocal.diagnosis.hypotheses import NO_SETTINGS, possible
from elastocal.diagnosis.noise_floor import scatter_beyond
from elastocal.engine import ROUNDING, LogPrior, Standardised, beside, climb
from elastocal.model.effects.base import index
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.geometry import GearRipple, GearSpectrum
from elastocal.model.effects.smooth import JointCurve, ResidualField
from elastocal.model.effects.statics import GravitySag, LinkWeights
from elastocal.units import Array, Progress

# Nats by which a sum must be more probable than what the forward search found; and those that its
# components must promise before one is looked for, since beside each other, their sizes and the
# noise fitted, they bring up to twice as many.
CLEARLY = 10.0
PROMISING = CLEARLY / 2
# Searches for more beside what has been found.
LINE_SEARCHES, FIELD_SEARCHES, TWICE = 16, 3, 2
MOST_FIELDS = 4  # that one search adds


@dataclass(frozen=True, eq=False)
class Growth:
    """What a sum beside the fitted parameters grows by: `every` component may return, and `curves`
    are tried from the start as well; it does without the effects `without`."""

    dataset: DiagnosisData
    every: Sequence[Component]
    curves: Sequence[Component]
    without: set[str]
    progress: Progress

    @cached_property
    def others(self) -> list[Component]:
        """What may stand in the place of another one: no joint's sag by itself where link weights
        are one component, which hold it."""
        shared = any(isinstance(c.effect, LinkWeights) for c in self.every)
        return [c for c in self.every if not (shared and isinstance(c.effect, GravitySag))]

    @cached_property
    def tried(self) -> list[Component]:
        """What completes a kind; one object, by which a sum knows what completed it."""
        return [*self.curves, *self.others]

    def grown(self, found: FittedSum) -> FittedSum:
        """The sum with what shows beside it, and without what this makes needless."""
        dataset, few = self.dataset, len(self.dataset.blocks.member) <= FEW_POSES
        self.progress("what shows now that the noise is smaller")
        found = with_shorter_drifts(dataset, found)
        again = with_returned(found, self.every)
        if again is not found and few:
            again = with_returned(_with_lines(dataset, again), self.every)
        found = again
        for _ in range(FIELD_SEARCHES):
            self.progress("what has no name beside the components")
            wider = _with_corrections(dataset, found, few, self.without)
            if wider is found:
                break
            found = wider
        self.progress("what can be left out")
        found = completed(with_shorter_drifts(dataset, with_own_axes(found)), self.tried)
        for _ in range(TWICE if few else 0):
            before = with_likelier_orders(dataset, with_expected_families(dataset, found))
            # Which of two laws the last move follows shows where the lines are right.
            found = completed(before, self.tried)
            if found.score <= before.score + GAINED:
                break
            found = _with_lines(dataset, found)
        return with_likelier_names(dataset, found, self.others)

    def instead_of(self, kind: str, found: FittedSum) -> FittedSum:
        """What grows from the sum where this kind of cause does not exist."""
        self.progress(f"what else may be at work than {kind}")
        gone = [c for c in found.components if c.effect.name == kind]
        every, curves = ([c for c in some if c.effect.name != kind]
                         for some in (self.every, self.curves))  # fmt: skip
        bare = replace(self, every=every, curves=curves, without=self.without | {kind})
        return bare.grown(_with_lines(self.dataset, exchanged(found, gone)))


def search_components(
    dataset: DiagnosisData, chosen: ModelSet, open_: bool, without: set[str], progress: Progress
) -> tuple[Growth, FittedSum] | None:
    """The most probable sum beside the fitted parameters, and what it has grown by; None where the
    forward search leaves nothing `open_` and no sum promises to be CLEARLY better.  `chosen` is
    what that search found: its searched constants are tried as they are."""
    full = _with_together(dataset, without)
    for weighed in (False, True):
        data = with_equal_noise(full)
        begun = replace(NoiseValues.usual(data.G.shape[2]), factor=0.3)
        instrument = (chosen.noise if data.stated else begun).of_instrument()
        known = (replace(c, given=weighed and isinstance(c.effect, LinkWeights))
                 for c in catalogue_components(full))  # fmt: skip
        moving = () if ResidualField.name in without else drifts(full)
        searched = (i for i in chosen.items if i.known and len(i.settings))
        every = [*moving, *known, *(component_of(full, item) for item in searched)]
        curves = [] if JointCurve.name in without else list(joint_curves(full))
        growth = Growth(full, every, curves, without, progress)
        if not (weighed or open_ or promised(chosen, growth.tried) > PROMISING):
            return None
        progress(f"sizes of {len(growth.tried)} components at once")
        found = fit_sum(data, growth.tried, instrument)
        if weighed or not any(isinstance(c.effect, LinkWeights) for c in found.components):
            break
        # A compliance that was fitted without weights is wrong, and so are their columns by it.
        full = about_sum(full, found)
    found, few = with_own_axes(found), len(full.blocks.member) <= FEW_POSES
    progress(f"families of lines {'before curves' if few else 'beside the components'}")
    found = _with_lines_first(growth, found, instrument) if few else _with_lines(full, found)
    return growth, growth.grown(found)


def _with_lines_first(growth: Growth, found: FittedSum, instrument: NoiseValues) -> FittedSum:
    """The sum with families of lines, sought beside the others before curves join.  A curve takes
    up the lines of its joint as far as few poses show them, and then none of them stands out.  A
    sum without curves is one of the others already."""
    dataset, first, pool = growth.dataset, found, growth.tried
    if curved := any(c in growth.curves for c in found.components):
        first, pool = fit_sum(found.sums.data, growth.others, instrument), growth.others
    first = begun = completed(first, pool)
    for _ in range(TWICE):
        before = first
        first = completed(_with_lines(dataset, first), growth.tried)
        if first.score <= before.score + GAINED:
            break
    if curved or first is not begun:
        first = _wider(first, growth.curves)
    return first if not curved or first.score > found.score else _with_lines(dataset, found)


def about_sum(dataset: DiagnosisData, found: FittedSum) -> DiagnosisData:
    """The data about where the sum has the arm's own parameters and the weights of its links.  Not
    about a fit of these alone: a compliance that little else holds, and the moment that deflects
    its joint, would take up what the other components explain, and the product of both stand in the
    columns.  Nor do weights stand in the columns of the compliances: twice as soft an arm under
    half the load would look like one that bends by its weight.  Of one kind all are of one size
    here: the eccentricity of a joint, which looks like its sag, must not take the weights."""
    sizes = found.sizes.size.copy()
    for _, kind in found.sums.pool.kinds:
        sizes[kind] = np.median(sizes[kind])
    every = found.sums.variances(replace(found.sizes, size=sizes))
    alike = replace(found, variances=every[len(found.sums.data.precision) :])
    base, beta = dataset.base, project(alike.data, found.noise).beta
    x = dict(zip(base.model.names, base.x - from_centre(base), strict=True))
    width = dict(zip(base.model.names, prior_deviations(base), strict=True))
    own = zip(dataset.fitted, beta[: len(dataset.fitted)], strict=True)
    x |= {name: x[name] + width[name] * b for name, b in own if name in x}
    weights = []
    for c, span in zip(found.components, found.spans, strict=True):
        if (h := c.hypothesis) is not None and isinstance(c.effect, LinkWeights):
            weights.append(h)
            keyed = zip(h.parameters, beta[span] * dataset.sizes[h.key], strict=True)
            x |= {f"{h.where}.{p.key}": p.nominal + m for p, m in keyed}
    model = extended(base.model, [Item(h, np.zeros(0), 0.0) for h in weights])
    at_sum = np.array([x[name] for name in model.names])
    readings = base.observed
    residual = readings.value - model.predict(readings.table, at_sum, readings)
    at = replace(base, model=model, x=at_sum, residual=residual)
    return about(dataset, at, [(h, NO_SETTINGS.values[0]) for h in weights], apart=True)


def _with_lines(dataset: DiagnosisData, found: FittedSum) -> FittedSum:
    """The sum and the families of lines that stand out beside it, the best first.  With many poses
    all that stand out come in at once: what one hides from another is little."""
    for _ in range(LINE_SEARCHES):
        stand_out, wider = line_families(dataset, found), found
        many = len(dataset.blocks.member) > FEW_POSES
        # Where none pays by itself, some do together: what one joint's lines do hides another's.
        some = [[family] for family in stand_out[:TRIED]]
        some += [stand_out[:n] for n in range(2, min(TRIED, len(stand_out)) + 1)]
        for chosen in [stand_out] if many else some:
            noise = found.noise
            for _, component, scatter, _ in chosen:
                noise = with_scatter(noise, index(component.where), scatter)
            fitted = exchanged(
                replace(found, noise=noise),
                [c for *_, instead_of in chosen for c in instead_of],
                [component for _, component, *_ in chosen],
            )  # fmt: skip
            if fitted.score > found.score + GAINED:
                wider = fitted
                break
        if wider is found:
            break
        found = wider if many else _tuned(dataset, wider)
    return found


def with_shorter_drifts(dataset: DiagnosisData, found: FittedSum) -> FittedSum:
    """The sum with drifts that vary over as short a time as the readings show."""
    before = found
    while True:
        lengths = zip(found.components, found.sizes.length.tolist(), strict=True)
        short = {c: new for c, at in lengths if (new := shorter(dataset, c, at)) is not None}
        fitted = exchanged(found, [*short], [*short.values()], False) if short else found
        if fitted.score <= found.score + GAINED:
            return found if found is before else _refitted(found)
        found = fitted


def with_returned(found: FittedSum, components: Sequence[Component]) -> FittedSum:
    """The sum with components that went under a larger noise and show under this one."""
    for _ in range(RETURNS):
        away = found.away(components)
        each = evidence_beside(found, away)
        evidence = [e + log_odds(found.components, c) for e, c in zip(each, away, strict=True)]
        order = np.argsort(evidence)[::-1][:MOST_RETURNED]
        wider = _wider(found, [away[k] for k in order if evidence[k] > 0])
        if wider is found:
            break
        found = wider
    return found


RETURNS, MOST_RETURNED = 4, 6


def _tuned(dataset: DiagnosisData, found: FittedSum) -> FittedSum:
    components = sharpened(dataset, found)
    if components is None:
        return found
    return fit_sum(found.sums.data, components, found.noise, found.sizes, refit_noise=False)


PROBABLE = 0.5
SWEEPS = 2


def with_expected_families(dataset: DiagnosisData, found: FittedSum) -> FittedSum:
    """The sum with a family of lines at each joint where the others let expect one and a line at
    one order is more probable than all others and none together; the most probable first."""
    while lined := families_of(found):
        others = (h for h in ripples(dataset) if h.where not in lined)
        each = [OrderPosterior(dataset, found, h) for h in others]
        chances = [p.probability(p.likeliest_line[0]) for p in each]
        if max(chances, default=0.0) <= PROBABLE:
            break
        likeliest = each[int(np.argmax(chances))]
        family = likeliest.family(*likeliest.likeliest_line)
        noise = with_scatter(found.noise, index(family.where), likeliest.scatter)
        found = _tuned(dataset, exchanged(replace(found, noise=noise), [], [family]))
    return found


def with_likelier_orders(dataset: DiagnosisData, found: FittedSum) -> FittedSum:
    """The sum with the lines of each joint at another order, a half of it or any, or with more of
    its multiples or fewer, where this is more probable beside all others.  A single line may be the
    first of a family, or the second of one at half its order; which it is shows in the others.  A
    multiple that is not there costs as much as one that is missed."""
    begun = found
    for _ in range(SWEEPS):
        before = found
        for h in ripples(dataset):
            here = (c for c in found.components if c.where == h.where)
            own = [c for c in here if isinstance(c.effect, GearSpectrum)]
            if len(own) != 1:
                continue
            now, lines = dict(own[0].settings)["order_1"], len(own[0].settings) // 2
            orders = OrderPosterior(dataset, found, h, own)
            best, m = orders.best
            if abs(best - now) > orders.resolution or m != lines:
                other = replace(orders.family(best, m), search=own[0].search)
                found = _tuned(dataset, exchanged(found, own, [other], refit_noise=False))
        if found is before:
            break
    return found if found is begun else _tuned(dataset, _refitted(found))


def hidden_fellows(found: FittedSum, components: Sequence[Component]) -> tuple[Component, ...]:
    """Causes of kinds that are in the sum, at places where they are not, which may be there all the
    same, or in the place of those that are.  What looks like something else that is in the sum, as
    an eccentricity of joint 2 looks like its sag, has no evidence of its own, and what it may take
    from the other is uncertain."""
    here = {c.effect.name for c in found.components}
    hidden = [c for c in found.away(components) if c.effect.name in here and c.fellows > 1]
    sizes = [np.full((1, c.width), np.exp(size_of_fellows(found, c))) for c in hidden]
    each = evidence_beside(found, hidden, np.ones(1), sizes)
    pairs = zip(each, hidden, strict=True)
    return tuple(c for e, c in pairs if expit(e + log_odds(found.components, c)) > CHANCE)


def size_of_fellows(found: FittedSum, c: Component) -> float:
    """Logarithm of the size that the fellows of a component have in the sum on average; 0, a
    typical one, where it has none."""
    own = [k for k, o in enumerate(found.components) if o.effect.name == c.effect.name]
    return 0.5 * float(np.log(np.mean(np.exp(2 * found.sizes.size[own])))) if own else 0.0


CHANCE = 0.05  # probability from which what is not shown is reckoned with


TRIED = 3  # families that are tried, the best first, before a search is given up


def _wider(found: FittedSum, more: Sequence[Component]) -> FittedSum:
    wider = exchanged(found, [], more) if more else found
    return wider if wider.score > found.score + GAINED else found


def _with_corrections(
    dataset: DiagnosisData, found: FittedSum, few: bool, without: Container[str]
) -> FittedSum:
    """The sum with what has no name, all that stands out or, where it does not pay together, one of
    the likeliest; where none does, with what stands out if joints scatter no more than usual."""
    noise, usual = found.noise, NoiseValues.usual(len(found.noise.joint))
    # What is missing at a joint that scatters far more than the others let expect has been taken
    # for its scatter.
    loud = scatter_beyond(noise) > 0
    joint = np.where(loud, np.minimum(noise.joint, usual.joint), noise.joint)
    shared = np.where(loud, np.minimum(noise.shared, usual.shared), noise.shared)
    quieter = replace(found, noise=replace(noise, joint=joint, shared=shared))
    for begun in [found, quieter] if loud.any() else [found]:
        more = without_a_name(dataset, begun, MOST_FIELDS, without)
        some = [more, *([c] for c in more[:TRIED] if few and len(more) > 1)]
        for chosen in filter(None, some):
            fitted = exchanged(begun, [], chosen)
            if fitted.score > found.score + GAINED:
                return fitted
    return found


def _refitted(found: FittedSum) -> FittedSum:
    return fit_sum(found.sums.data, found.components, found.noise, found.sizes)


def exchanged(
    found: FittedSum, gone: Sequence[Component], more: Sequence[Component] = (),
    refit_noise: bool = True,
) -> FittedSum:  # fmt: skip
    """The sum with `more` components in the place of those `gone`, fitted from where it is."""
    kept = [k for k, c in enumerate(found.components) if c not in gone]
    components = [*(found.components[k] for k in kept), *more]
    start = found.sizes.chosen(kept, more)
    return fit_sum(found.sums.data, components, found.noise, start, refit_noise, found.sums)


GAINED = 0.5  # nats that a search must bring for another one


def compared_score(dataset: DiagnosisData, found: FittedSum) -> float:
    """Log posterior of a sum under the priors that the forward search's sets have.  Within a sum
    many causes are expected, so that each costs little; to be believed instead of a few, the first
    of each kind has to pay what one more effect of the catalogue pays there, and a line or what has
    no name what its search costs."""
    prior = log_prior_odds(dataset.hypotheses, [], ANOTHER)
    odds = {h.key: float(w) for h, w in zip(dataset.hypotheses, prior, strict=True)}
    usual = min(odds.values(), default=0.0)

    def price(c: Component) -> float:
        return usual if c.hypothesis is None else odds.get(c.hypothesis.key, usual)

    pool = found.sums.pool
    score = found.score + pool.cost(found.spread) - sum(c.search for c in found.components)
    for n, own in pool.kinds:
        for before, k in enumerate(own):
            fellow = presence_cost(n, before + 1) - presence_cost(n, before)
            paid = -price(found.components[k])
            score -= max(min(paid, fellow), 0.0) if before else paid
    return score


WIDE = np.exp(np.linspace(-3.0, 5.0, 9))  # sizes that are tried, in typical ones


class Beside:
    """Log evidence of other columns beside a sum, by sums over the rows.  Columns t are left
    A_t = M_tt − UᵀA U and b_t = z_t − Uᵀb of their normal matrix and right side, with A and b of
    the sum's coefficients in units of their prior and U = A⁻¹ M_xt.  Where those of a component c
    are gone, UᵀA U is less by U_cᵀ W U_c and Uᵀb by U_cᵀ W b_c, W the inverse of (A⁻¹)_cc; and c
    itself is left W − 1 and W b_c."""

    def __init__(self, found: FittedSum, columns: Sequence[Array]) -> None:
        M, z = found.sums.products.M, found.sums.products.z
        prior = np.concatenate([found.sums.data.precision, 1 / found.variances])
        self.sum = Standardised.of(M, z, (prior + ROUNDING * np.diag(M)) ** -0.5)
        self.left, self.moved = list[tuple[Array, Array]](), list[Array]()
        for across, own, z in found.sums.across(columns):
            scaled = self.sum.root[:, None] * across
            moved = linalg.cho_solve((self.sum.L, True), scaled, check_finite=False)
            self.moved.append(moved)
            self.left.append((own - scaled.T @ moved, z - scaled.T @ self.sum.b))

    def evidence_instead(self, gone: slice) -> list[float]:
        """Over none, of what is `gone` beside all others of the sum and of each of the columns."""
        W = np.linalg.inv(self.sum.block(gone))
        b, per = W @ self.sum.b[gone], 1 / self.sum.root[gone]
        groups = [((W - np.eye(len(W))) * per[:, None] * per, b * per)]
        for (A, z), moved in zip(self.left, self.moved, strict=True):
            own = moved[gone]
            groups.append((A + own.T @ W @ own, z + own.T @ b))
        return evidence_of_groups(groups, WIDE)


def promised(chosen: ModelSet, components: Sequence[Component]) -> float:
    """Nats that components bring beside a set, whatever their being there costs: the best of them,
    the best other one beside the set and this at its typical size, and so on.  About what a sum of
    all can be more probable by than the set."""
    taken, data = {id(item.what) for item in chosen.items}, chosen.data
    others = [c for c in components if id(c.hypothesis) not in taken]
    sums, p = posed(data, others, chosen.noise), len(data.precision)
    M, z = sums.products.M, sums.products.z
    prior = data.precision + ROUNDING * np.diag(M)[:p]
    A, b = beside(M, z, prior, np.arange(p), slice(p, len(M)))
    total, left = 0.0, list(zip(spans_of([c.width for c in others], len(b)), others, strict=True))
    while left:
        blocks = [(A[span, span], b[span]) for span, _ in left]
        each = evidence_of_groups(blocks, WIDE, [c.scalings for _, c in left])
        if (best := max(each)) <= 0:
            break
        total += best
        own, _ = left.pop(int(np.argmax(each)))
        across = np.linalg.solve(A[own, own] + np.eye(own.stop - own.start), A[own])
        A, b = A - A[:, own] @ across, b - across.T @ b[own]
    return total


def evidence_beside(
    found: FittedSum, components: Sequence[Component], scales: Array = WIDE,
    scalings: Sequence[Array] | None = None,
) -> list[float]:  # fmt: skip
    """Log evidence of each component beside the sum, of a smooth one at its best length; or times
    its `scalings`."""
    scalings = scalings or [c.scalings for c in components]
    return evidence_of_groups(Beside(found, [c.columns for c in components]).left, scales, scalings)


def imitators(
    dataset: DiagnosisData, found: FittedSum, some: Sequence[int]
) -> Iterator[tuple[int, float, dict[tuple[str, str], float]]]:
    """Of some of the components the number, the log evidence over none in its place, and that of
    every other hypothesis there."""
    taken = {id(c.hypothesis) for c in found.components}
    others = [h for h in dataset.hypotheses if not h.settings and id(h) not in taken]
    beside = Beside(found, [dataset.packed(h) for h in others])
    for k in some:
        own, *each = beside.evidence_instead(found.spans[k])
        yield k, own, {h.key: evidence for h, evidence in zip(others, each, strict=True)}


SWAPS = 4


def with_likelier_names(
    dataset: DiagnosisData, found: FittedSum, components: Sequence[Component]
) -> FittedSum:
    """The sum with another effect in the place of a single one, where that is more probable."""
    by_key = {c.hypothesis.key: c for c in components if c.hypothesis is not None}
    for _ in range(SWAPS):
        better = found
        single = [
            k for k, c in enumerate(found.components)
            if c.hypothesis is not None and not (c.settings or c.given)
        ]  # fmt: skip
        for k, own, others in imitators(dataset, found, single):
            c, rest = found.components[k], [*found.components[:k], *found.components[k + 1 :]]
            odds = {
                key: evidence + log_odds(rest, by_key[key])
                for key, evidence in others.items() if key in by_key
            }  # fmt: skip
            likeliest = max(odds, key=lambda key: odds[key], default=None)
            if likeliest and odds[likeliest] > own + log_odds(rest, c) + GAINED:
                swapped = exchanged(found, [c], [by_key[likeliest]], refit_noise=False)
                better = swapped if swapped.score > better.score + GAINED else better
        if better is found:
            break
        found = _refitted(better)
    return found


def completed(found: FittedSum, components: Sequence[Component]) -> FittedSum:
    """The sum with a kind of cause at all its places, or in the place of another kind, where that
    is more probable.  What acts at every joint, a little at each, comes in together or not at all;
    and a single one of another kind that stands in its place goes with it."""
    if found.complete is components:
        return found
    kinds: dict[str, list[Component]] = {}
    for c in components:
        if c.fellows > 1 and (not c.settings or isinstance(c.effect, JointCurve)):
            kinds.setdefault(c.effect.name, []).append(c)
    # Each fit to many poses takes its time: what is tried there shows, or is there at other places.
    many = len(found.sums.data.r) > FEW_POSES
    for _ in range(COMPLETED):
        present = Counter(c.effect.name for c in found.components)
        away = {n: found.away(own) for n, own in kinds.items()}
        shown = _kinds_that_show(found, away, present) | (set() if many else present.keys())
        better = found
        for name, more in away.items():
            for instead in (None, *(n for n in kinds if n != name and present[n])):
                gone = [c for c in found.components if c.effect.name == instead]
                alike = not gone or {c.family for c in gone} & {c.family for c in more}
                hopeless = (many or instead is None) and name not in shown
                if more and alike and not hopeless and not any(c.given for c in gone):
                    fitted = exchanged(found, gone, more, refit_noise=False)
                    better = fitted if fitted.score > better.score + GAINED else better
        if better is found:
            break
        found = _refitted(better)
    return replace(found, complete=components)


COMPLETED = 3


def _kinds_that_show(
    found: FittedSum, away: Mapping[str, list[Component]], present: Mapping[str, int]
) -> set[str]:
    """Kinds whose evidence at all of these places together is more than what their being there
    costs, beside those that are `present`."""
    every = [c for own in away.values() for c in own]
    each = dict(zip(every, evidence_beside(found, every), strict=True))
    shown = set()
    for name, own in away.items():
        gains = [each[c] for c in own if each[c] > 0]
        n, more = own[0].fellows if own else 0, len(gains)
        k = max(min(present[name], n - more), 0)
        if more and sum(gains) > presence_cost(n, k + more) - presence_cost(n, k):
            shown.add(name)
    return shown


def _with_together(dataset: DiagnosisData, without: Container[str]) -> DiagnosisData:
    base, kept = dataset.base, list(dataset.hypotheses)
    # Lines are sought as ripples are, whether or not one may be named.
    if GearSpectrum.name in without:
        kept = [h for h in kept if not isinstance(h.effect, GearRipple)]
    elif GearRipple.name in without:
        kept += possible(base.model, base.observed.table, CATALOGUE.keys() - {GearRipple.name})[0]
    more = possible(base.model, base.observed.table, without, together=True)[0]
    return replace(dataset, hypotheses=(*kept, *more))


def sum_of(dataset: DiagnosisData, chosen: ModelSet) -> FittedSum:
    """The set as a sum under its noise: its items at the sizes that it has, or at typical ones,
    where these are larger: a tie to less would make what is true smaller than what was found."""
    sums = posed(dataset.data, [component_of(dataset, i) for i in chosen.items], chosen.noise)
    sizes = np.log(np.maximum(chosen.scales, 1.0))
    return at_maximum(sums, Sizes(0.0, sizes, np.zeros(len(chosen.items))))


def with_own_axes(found: FittedSum) -> FittedSum:
    """The sum under an instrument that reads each axis as well as it does, where none is stated and
    the readings show that it is another one along each.

    A camera is worse along its line of sight, a tracker across it.  Beside the sum the residual is
    the instrument's, as it was not before.  The logarithms of the axes' noise spread by AXES about
    their mean, whatever that is; they are believed where their evidence, by Laplace's method, is
    larger than that of equal ones."""
    data, size = found.sums.data, min(found.data.blocks.size, 3)
    if data.stated or size < 2:
        return found
    wide = found.without_these()
    some = wide.every(max(1, len(wide.r) // SOME))  # that show the ratios
    part = np.minimum(np.arange(data.r.shape[1]) % data.blocks.size, size)
    ratios, spread = linalg.null_space(np.ones((1, size))), 2 * AXES  # of variances
    model = some.in_parts(part, LogPrior(np.zeros(size), ratios @ ratios.T / spread**2))
    logs, n = found.noise.logs(), int(part.max()) + 1
    begun = np.append(np.full(n, logs[0]), logs[1:])
    room = np.where(np.arange(len(begun)) < size, FARTHEST, 0.0)
    at = climb(model.objective, begun, begun - room, begun + room, SETTLED, STEPS)[0]
    value, _, information = model.objective(at)
    known = spread**2 * ratios.T @ information[:size, :size] @ ratios / 2
    gained = model.objective(begun)[0] - value - float(np.linalg.slogdet(known)[1])
    if gained < 2 * GAINED:
        return found
    each = np.exp((at - begun)[part] / 2)
    V = data.covariance * each[:, None] * each
    return fit_sum(replace(data, covariance=V), found.components, found.noise, found.sizes)


AXES = 0.5  # spread of the logarithms of an instrument's noise along its axes


def with_equal_noise(dataset: DiagnosisData) -> NoisyData:
    """The data; where no noise is stated, with the same variance along all axes.  Its shape else is
    that of the residual, which the missing effects make and no instrument."""
    data = dataset.data
    if data.stated:
        return data
    variance = np.diagonal(dataset.base.covariance[0]).copy()
    for part in (variance[:3], variance[3:]):
        part[:] = part.mean() if len(part) else 0.0
    equal = np.tile(np.diag(variance), (dataset.blocks.n, 1, 1))
    return replace(data, covariance=dataset.blocks.pack_square(equal))
