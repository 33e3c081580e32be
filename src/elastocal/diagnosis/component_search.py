"""The search for all components at once, their shares of the gap, and what they are called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.component_families import (
    FEW_POSES,
    catalogue_components,
    family_of,
    fields,
    joint_curves,
    line_families,
    tuned_family,
)
from elastocal.diagnosis.components import COST, PRESENT, Component, FittedSum, fit_sum
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.effect_search import about
from elastocal.diagnosis.evidence import ANOTHER, Grams, Prior, direct
from elastocal.diagnosis.hypotheses import Hypothesis, judged_together
from elastocal.diagnosis.model_set import Item, ModelSet, extended, packed_columns
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, project
from elastocal.model.effects.base import index
from elastocal.model.effects.gears import GearSpectrum
from elastocal.model.effects.gravity_sag import GravitySag, LinkWeights
from elastocal.units import Progress

# Searches for more beside what has been found.
LINE_SEARCHES, FIELD_SEARCHES = 16, 3
MOST_FIELDS = 4  # that one search adds


def search_components(
    dataset: DiagnosisData, chosen: ModelSet, progress: Progress = lambda message: None
) -> tuple[DiagnosisData, FittedSum]:
    """The most probable sum beside the fitted parameters, and the data with all its columns.

    `chosen` is what the forward search found: its searched constants are tried as they are.
    """
    full = _with_together(dataset)
    for weighed in (False, True):
        data = with_equal_noise(full)
        instrument = chosen.noise.of_instrument() if data.stated else _started(data)
        curves = list(joint_curves(full))
        every = [*catalogue_components(full), *_searched(full, chosen)]
        others = _first(every)
        progress(f"sizes of {len(curves) + len(others)} components at once")
        both = [*curves, *others]
        found = _swapped(full, data, fit_sum(data, both, instrument), both)
        kept = (c.hypothesis for c in found.components)
        weights = [h for h in kept if h is not None and isinstance(h.effect, LinkWeights)]
        if weighed or not weights:
            break
        # A compliance that was fitted without weights is wrong, and so are their columns by it.
        full = about_weights(full, weights)
    lined = False
    if len(full.blocks.member) <= FEW_POSES:
        # A curve takes up the lines of its joint as far as these few poses show them, and then
        # none of them stands out.
        progress("families of lines before curves")
        first = _swapped(full, data, fit_sum(data, others, instrument), others)
        first = _with_lines(full, data, first)
        other = _wider(data, first, curves) or first
        lined = other.score > found.score
        found = other if lined else found
    if not lined:
        progress("families of lines beside the components")
        found = _with_lines(full, data, found)
    progress("what shows now that the noise is smaller")
    again = with_returned(data, found, every)
    if again is not found and len(full.blocks.member) <= FEW_POSES:
        again = with_returned(data, _with_lines(full, data, again), every)
    found = again
    for _ in range(FIELD_SEARCHES):
        progress("fields beside the components")
        more = fields(full, found.data, found.noise, found.components, MOST_FIELDS)
        wider = _wider(data, found, more)
        if wider is None:
            break
        found = wider
    progress("what can be left out")
    return full, _spared(data, found)


def about_weights(dataset: DiagnosisData, weights: Sequence[Hypothesis]) -> DiagnosisData:
    """The data about a fit of the model with these weights in it."""
    base = dataset.base
    model = extended(base.model, [Item(h, np.zeros(0), 0.0) for h in weights])
    start = dict(zip(base.model.names, base.x, strict=True))
    x0 = np.array([start.get(p.name, p.nominal) for p in model.parameters])
    return about(dataset, fit_baseline(model, base.observed.table, x0=x0), weights)


def _first(components: Sequence[Component]) -> list[Component]:
    """Those that are judged from the start: each joint's sag by itself only where the weights of
    all links are not one component, and else if these leave something to it."""
    shared = any(isinstance(c.effect, LinkWeights) for c in components)
    return [c for c in components if not (shared and isinstance(c.effect, GravitySag))]


def _with_lines(dataset: DiagnosisData, data: NoisyData, found: FittedSum) -> FittedSum:
    """The sum and the families of lines that stand out beside it, the best first.

    With many poses all that stand out come in at once: what one hides from another is little.
    """
    for _ in range(LINE_SEARCHES):
        stand_out = line_families(dataset, found)
        wider = None
        many = len(dataset.blocks.member) > FEW_POSES
        for chosen in [stand_out] if many else [[family] for family in stand_out[:TRIED]]:
            joint = found.noise.joint.copy()
            for family in chosen:
                joint[index(family.where)] = family.scatter
            fitted = _exchanged(
                data, replace(found, noise=replace(found.noise, joint=joint)),
                [c for family in chosen for c in family.instead_of],
                [family.component for family in chosen],
            )  # fmt: skip
            if fitted.score > found.score + GAINED:
                wider = fitted
                break
        if wider is None:
            break
        found = wider if many else _tuned(dataset, data, wider)
    return found


def with_returned(data: NoisyData, found: FittedSum, components: Sequence[Component]) -> FittedSum:
    """The sum with components that went under a larger noise and show under this one."""
    for _ in range(RETURNS):
        at = project(found.data, found.noise)
        taken = {id(c) for c in found.components}
        away = [c for c in components if id(c) not in taken]
        evidence = [
            float(direct(found.data.masked(c.columns), at).evidence(WIDE)[0]) - c.cost + COST
            for c in away
        ]
        order = np.argsort(evidence)[::-1][:MOST_RETURNED]
        wider = _wider(data, found, [away[k] for k in order if evidence[k] > WORTH])
        if wider is None:
            break
        found = wider
    return found


RETURNS, MOST_RETURNED = 4, 6
WORTH = float(np.log(1 / PRESENT - 1))  # log evidence, sizes mixed, that outweighs the prior odds


def _tuned(dataset: DiagnosisData, data: NoisyData, found: FittedSum) -> FittedSum:
    """The sum with the orders of its lines sought anew, close by, beside what else is in it now."""
    for c in found.components:
        if not isinstance(c.effect, GearSpectrum):
            continue
        near = tuned_family(dataset, found, c)
        if abs(near.settings[0][1] - c.settings[0][1]) < TUNED * c.settings[1][1]:
            continue
        start = found.sizes
        tuned = [near if other is c else other for other in found.components]
        fitted = fit_sum(data, tuned, found.noise, start, refit_noise=False)
        if fitted.score > found.score:
            found = fitted
    return found


TUNED = 0.2  # standard deviations of an order that are worth another fit


def _spared(data: NoisyData, found: FittedSum) -> FittedSum:
    """The sum without what the others can stand in for, once their sizes have followed."""
    spared = 0
    order = np.argsort(found.earned - [c.cost for c in found.components])
    for c in [found.components[k] for k in order[:SPARED]]:
        if not any(c is other for other in found.components):
            continue
        fitted = _exchanged(data, found, [c], refit_noise=False)
        if fitted.score > found.score:
            found, spared = fitted, spared + 1
    return fit_sum(data, found.components, found.noise, found.sizes) if spared else found


SPARED = 6  # components that are tried to be left out, those first that earn least
TRIED = 3  # families that are tried, the best first, before a search is given up


def _wider(data: NoisyData, found: FittedSum, more: Sequence[Component]) -> FittedSum | None:
    """The sum with these as well, or what is left of them; None where it is no better."""
    if not more:
        return None
    wider = _exchanged(data, found, [], more)
    return wider if wider.score > found.score + GAINED else None


def _exchanged(
    data: NoisyData, found: FittedSum, gone: Sequence[Component],
    more: Sequence[Component] = (), refit_noise: bool = True,
) -> FittedSum:  # fmt: skip
    """The sum with `more` components in the place of those `gone`, fitted from where it is."""
    kept = [k for k, c in enumerate(found.components) if not any(c is other for other in gone)]
    start = found.sizes.chosen(kept)
    for component in more:
        start = start.and_one(component)
    components = [*(found.components[k] for k in kept), *more]
    return fit_sum(data, components, found.noise, start, refit_noise)


GAINED = 0.5  # nats that a search must bring for another one


def compared_score(dataset: DiagnosisData, found: FittedSum, chosen: ModelSet) -> float:
    """Log posterior of a sum under the priors that the forward search's sets have.

    Within a sum many causes are expected, so that each costs little; to be believed instead of a
    few, each has to pay what one more effect of the catalogue pays there, and a line or what has
    no name what its search costs.
    """
    prior = Prior.of(dataset.hypotheses, [], ANOTHER)
    odds = {h.key: float(w) for h, w in zip(dataset.hypotheses, prior.hypotheses, strict=True)}
    usual = min(odds.values(), default=-COST)
    known = {item.key: item.log_prior for item in chosen.items if item.known}
    score = found.score
    for c in found.components:
        price = odds.get(c.hypothesis.key, usual) if c.hypothesis is not None else usual
        if c.hypothesis is not None and c.settings:
            price = known.get(c.hypothesis.key, price)
        score += c.cost - c.search + price
    return score


# What else could stand in a component's place, the others given.

# Sizes that are tried, in typical ones, and nats by which a rival must be better to be tried.
WIDE = np.exp(np.linspace(-3.0, 5.0, 9))
BETTER, SWAPS = 1.0, 6


def rivals_of(
    dataset: DiagnosisData, found: FittedSum, k: int
) -> tuple[float, dict[tuple[str, str], float]]:
    """Log evidence of component k over none in its place, and that of every other hypothesis."""
    at = project(found.without(k), found.noise)
    grams = Grams(dataset, found.data, at)
    own = direct(found.data.masked(found.components[k].columns), at)
    taken = {id(c.hypothesis) for c in found.components}
    others = {
        h.key: float(grams.of_hypothesis(h).evidence(WIDE)[0])
        for h in dataset.hypotheses
        if not h.settings and id(h) not in taken
    }
    return float(own.evidence(WIDE)[0]), others


def _swapped(
    dataset: DiagnosisData, data: NoisyData, found: FittedSum, components: Sequence[Component]
) -> FittedSum:
    """The sum with every named component that another one beats replaced by it.

    Of several causes that these poses hardly tell apart, the sizes that are estimated at once end
    with any.
    """
    known = {(c.effect.name, c.where): c for c in components if c.hypothesis is not None}
    tried: set[tuple[str, str]] = set()
    for _ in range(SWAPS):
        best = None
        for k, c in enumerate(found.components):
            if c.hypothesis is None or c.settings:
                continue
            own, others = rivals_of(dataset, found, k)
            for key, evidence in others.items():
                if key in tried or key not in known or evidence <= own + BETTER:
                    continue
                if best is None or evidence - own > best[0]:
                    best = evidence - own, k, key
        if best is None:
            break
        _, k, key = best
        tried.add(key)
        other = _exchanged(data, found, [found.components[k]], [known[key]])
        if other.score > found.score:
            found = other
    return found


def _with_together(dataset: DiagnosisData) -> DiagnosisData:
    """The data with the effects that are judged in the sum alone, whose columns they have."""
    base = dataset.base
    more = judged_together(base.model, base.observed.table)
    return dataset.changed(hypotheses=(*dataset.hypotheses, *more)) if more else dataset


def _searched(dataset: DiagnosisData, chosen: ModelSet) -> list[Component]:
    """What the forward search found at settings of its own."""
    found = []
    for item in chosen.items:
        h = item.what
        if isinstance(h, Hypothesis) and len(item.settings):
            pairs = zip((s.key for s in h.settings), item.settings.tolist(), strict=True)
            family = family_of(h.effect, dataset.base.model.cell)
            columns = packed_columns(dataset, item)
            component = Component(
                family, h.effect, h.where, columns, settings=tuple(pairs), hypothesis=h
            )
            found.append(component)
    return found


def with_equal_noise(dataset: DiagnosisData) -> NoisyData:
    """The data; where no noise is stated, with the same variance along all axes.

    Its shape else is that of the residual, which the missing effects make and no instrument.
    """
    data = dataset.data
    if data.stated:
        return data
    size = dataset.blocks.size
    variance = np.diagonal(dataset.base.covariance[0]).copy()
    variance[:3] = variance[:3].mean()
    variance[3:] = variance[3:].mean() if size > 3 else 0.0
    equal = np.tile(np.diag(variance[:size]), (dataset.blocks.n, 1, 1))
    return replace(data, covariance=dataset.blocks.pack_square(equal))


def _started(data: NoisyData) -> NoiseValues:
    return replace(NoiseValues.usual(data.G.shape[2]).of_instrument(), factor=0.3)
