"""A set of additions to the model: its noise, its evidence, its estimates, its imitators."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.special import expit, log_ndtr, logsumexp, ndtr

from elastocal.cell.work_cell import Cell
from elastocal.diagnosis.baseline import Baseline, fit_baseline, made_once
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Hypothesis, compute_columns, with_keys
from elastocal.diagnosis.noise_floor import (
    SHARED,
    NoiseValues,
    NoisyData,
    Projection,
    Weighted,
    fit_noise,
    log_prior,
    project,
)
from elastocal.model.effects.gears import Backlash
from elastocal.model.evaluate import ahead
from elastocal.model.manipulator import Model
from elastocal.units import Array

REFINED_ROUNDS = 3  # of settings that depend on each other


@dataclass(frozen=True)
class Item:
    """One addition: a hypothesis at its settings, or a block without a name.

    `log_prior` is the log of its prior odds, the search over its settings included.
    """

    what: Hypothesis | Generic
    settings: Array
    log_prior: float

    @property
    def known(self) -> bool:
        return self.what.known

    @property
    def key(self) -> tuple[str, str]:
        """(effect, place); a block without a name is an unknown effect at its place."""
        return self.what.key


@dataclass(frozen=True)
class ModelSet:
    """Additions `items` to the fitted model, noise fitted beside them, and the log posterior.

    `score` = log evidence at the fitted noise, sizes mixed, + log prior of noise and items.
    `data` holds the items' columns at the best of their scales, `scales` (items,).
    """

    items: tuple[Item, ...]
    noise: NoiseValues
    data: NoisyData
    score: float
    scales: tuple[float, ...]

    @cached_property
    def at(self) -> Projection:
        return project(self.data, self.noise)

    @property
    def unknown(self) -> bool:
        return any(not item.known for item in self.items)

    @property
    def excessive(self) -> bool:
        """Whether an effect would have to be larger than any of its kind is."""
        return any(
            isinstance(item.what, Hypothesis)
            and np.abs(self.at.beta[span]).max(initial=0.0) > item.what.effect.most
            for item, span in zip(self.items, self.spans, strict=True)
        )

    @property
    def spans(self) -> tuple[slice, ...]:
        return spans_of([item.what.width for item in self.items], self.data.X.shape[2])

    def without(self, k: int) -> tuple[Item, ...]:
        return self.items[:k] + self.items[k + 1 :]


def spans_of(widths: Sequence[int], total: int) -> tuple[slice, ...]:
    """Where groups of so many coefficients each stand, the last of `total`."""
    ends = np.cumsum([total - sum(widths), *widths]).tolist()
    return tuple(slice(*pair) for pair in pairwise(ends))


def fit_set(
    dataset: DiagnosisData, items: tuple[Item, ...], start: NoiseValues | None = None
) -> ModelSet:
    """Fit the noise beside the items, twice where their best scale is not the typical one."""
    return next(fit_sets(dataset, [items], start))


def fit_sets(
    dataset: DiagnosisData, each: Sequence[tuple[Item, ...]], start: NoiseValues | None = None
) -> Iterator[ModelSet]:
    """The same for several sets, from one noise."""

    def fitted(joined: tuple[tuple[Item, ...], NoisyData]) -> ModelSet:
        return _fitted(dataset, *joined, start)

    with_columns = ((items, with_items(dataset, items, (1.0,) * len(items))) for items in each)
    return ahead(fitted, with_columns, dataset.data.threads)


def _fitted(
    dataset: DiagnosisData, items: tuple[Item, ...], joined: NoisyData, start: NoiseValues | None
) -> ModelSet:
    """The set of the items whose columns, of typical size, stand last in `joined`."""
    scales, noise = (1.0,) * len(items), start

    def at(scales: tuple[float, ...]) -> NoisyData:
        return replace(joined, precision=_precision(dataset.data, items, scales))

    for _ in range(2):
        noise = fit_noise(at(scales), noise)
        weighted = Weighted.of(joined, noise)
        best, mixed = _mixed_scales(dataset.data, weighted, items, scales)
        if best == scales:
            break
        scales = best
    assert noise is not None
    data = at(scales)
    mixed += _within_bounds(items, weighted.projection(data.precision))
    prior = sum(item.log_prior for item in items) - 0.5 * log_prior(dataset.data.stated, noise)
    return ModelSet(items, noise, data, mixed + prior, scales)


def _precision(data: NoisyData, items: tuple[Item, ...], scales: tuple[float, ...]) -> Array:
    """Of the coefficients of the data's columns and of the items'."""
    own = [np.full(item.what.width, 1 / s**2) for item, s in zip(items, scales, strict=True)]
    return np.concatenate([data.precision, *own])


def _within_bounds(items: tuple[Item, ...], at: Projection) -> float:
    spans = spans_of([item.what.width for item in items], len(at.beta))
    z = at.beta / np.linalg.norm(at.beta_deviation, axis=0)
    own = zip((item.what for item in items), spans, strict=True)
    return sum(within_bounds(z[s][h.bounded]) for h, s in own if isinstance(h, Hypothesis))


def within_bounds(z: Array) -> float:
    """Σ log 2Φ(z) over parameters that cannot be below their nominal value, z = mean/deviation of
    each above it.

    A compliance's size prior is one half of the Gaussian; the evidence gains or loses by the
    posterior's share of that half, each parameter taken by itself.
    """
    return float((np.log(2) + log_ndtr(z)).sum())


def _mixed_scales(
    data: NoisyData, weighted: Weighted, items: tuple[Item, ...], scales: tuple[float, ...]
) -> tuple[tuple[float, ...], float]:
    """The best scale of each item, the others' at theirs, and the evidence with scales mixed.

    Scales of different items hardly depend on each other: the log of each one's mean over its
    scales, less its best, adds up.  Only the prior differs from scale to scale: `weighted`, the
    data with the items' columns, stays.
    """
    if not items:
        return scales, weighted.marginal(data.precision)
    spent = 0.0
    for k, item in enumerate(items):
        trials = [(*scales[:k], float(s), *scales[k + 1 :]) for s in item.what.scales]
        each = np.array([weighted.marginal(_precision(data, items, t)) for t in trials])
        scales, top = trials[int(np.argmax(each))], float(each.max())
        spent += float(logsumexp(each)) - np.log(len(each)) - top
    return scales, top + spent


def refine(dataset: DiagnosisData, chosen: ModelSet, k: int) -> ModelSet:
    """Item k's settings refined between the grid's points, at the set's noise; and, where its wrong
    settings may have made joints scatter from pose to pose, at one with no more of that than usual.
    """
    noise = chosen.noise
    quiet = replace(noise, shared=np.minimum(noise.shared, SHARED))
    tried = [noise, quiet] if (noise.shared > 2 * SHARED).any() else [noise]
    found = [refined for n in tried if (refined := _refined(dataset, chosen, k, n)) is not None]
    return max(found, key=lambda refined: refined.score, default=chosen)


def _refined(
    dataset: DiagnosisData, chosen: ModelSet, k: int, noise: NoiseValues
) -> ModelSet | None:
    """The same at one noise; None where nothing was searched.

    One setting after the other; where there are several, they go round REFINED_ROUNDS times.
    """
    item = chosen.items[k]
    what = item.what
    if not what.settings:
        return None
    data = beside(dataset, chosen, k)
    grams = Grams(dataset, data, project(data, noise))
    grid = dataset.grids[what.key]

    def evidence(tried: Array) -> Array:
        return grams.of(what, tried).evidence(what.scales)

    settings, searched = item.settings, False
    widths = grid.step[grid.nearest(settings)]
    for _ in range(1 if len(settings) == 1 else REFINED_ROUNDS):
        for s, setting in enumerate(what.settings):
            if setting.kind == "change_time":
                trial = dataset.moments[np.abs(dataset.moments - settings[s]) <= widths[s]]
                if len(trial) <= 1 or len(dataset.moments) == len(np.unique(grid.values[:, s])):
                    continue
                settings = _best_along(settings, s, trial, evidence)
            else:
                for width in widths[s] / 8.0 ** np.arange(3):
                    trial = settings[s] + np.linspace(-width, width, 21)
                    trial = np.clip(trial, setting.lower, setting.upper)
                    settings = _best_along(settings, s, trial, evidence)
            searched = True
    if not searched:
        return None
    refined = replace(item, settings=settings)
    return fit_set(dataset, (*chosen.items[:k], refined, *chosen.items[k + 1 :]), noise)


def _best_along(settings: Array, s: int, trial: Array, evidence: Callable[[Array], Array]) -> Array:
    """The settings with number s at the best of the values `trial`, the others held."""
    tried = np.repeat(settings[None], len(trial), axis=0)
    tried[:, s] = trial
    return np.asarray(tried[int(np.argmax(evidence(tried)))])


def with_items(
    dataset: DiagnosisData, items: tuple[Item, ...], scales: tuple[float, ...]
) -> NoisyData:
    """The data with the items' columns at the given scales."""
    if not items:
        return dataset.data
    columns = np.concatenate([dataset.packed(item.what, item.settings) for item in items], axis=2)
    p = len(dataset.data.precision)
    return dataset.data.with_columns(columns, _precision(dataset.data, items, scales)[p:])


def beside(dataset: DiagnosisData, chosen: ModelSet, k: int) -> NoisyData:
    return with_items(dataset, chosen.without(k), chosen.scales[:k] + chosen.scales[k + 1 :])


# Which other effects would look the same in these poses: what no size of noise can tell apart.

PLAUSIBLE = 5.0


def signal_of(dataset: DiagnosisData, chosen: ModelSet, k: int) -> Array:
    """What item k does to the readings (C, m) at its estimate."""
    item = chosen.items[k]
    columns = dataset.packed(item.what, item.settings)
    return dataset.data.masked(columns @ chosen.at.beta[chosen.spans[k]])


def distances(dataset: DiagnosisData, chosen: ModelSet, k: int) -> dict[tuple[str, str], float]:
    """d of item k from each other hypothesis that the data could mean instead.

    d² = min over β, γ of |v − Xβ − Cγ|²_V⁻¹ + |γ|²/s² with the item's signal v, the rival's
    columns C at its best settings and s = PLAUSIBLE times the widest of the size prior: in
    standard deviations.  A rival larger than usual is less probable, but it is no less alike.
    """
    v, data = signal_of(dataset, chosen, k), beside(dataset, chosen, k)
    at = project(replace(data, r=v), chosen.noise)
    grams = Grams(dataset, data, at)
    signal = float((v * at.u).sum())
    out: dict[tuple[str, str], float] = {}
    for h in dataset.hypotheses:
        if h is not chosen.items[k].what:
            found = grams.of(h, settings_to_try(dataset, h, chosen.items[k]))
            explained = float(found.explained(PLAUSIBLE * float(h.scales.max())).max())
            out[h.key] = float(np.sqrt(max(signal - explained, 0.0)))
    return out


def settings_to_try(dataset: DiagnosisData, rival: Hypothesis, item: Item) -> Array | None:
    """Settings (G, …) at which a rival may imitate an item: those of the search and, where both
    have the same kind of constant, the item's own, which was refined between them.  None where
    the rival has none."""
    if not rival.settings:
        return None
    values = dataset.grids[rival.key].values
    same_kinds = [s.kind for s in rival.settings] == [s.kind for s in item.what.settings]
    within = same_kinds and all(
        s.lower <= v <= s.upper for s, v in zip(rival.settings, item.settings, strict=True)
    )
    return np.vstack([values, item.settings]) if within else values


def extended(model: Model, items: Sequence[Item]) -> Model:
    spec = model.cell.model
    for item in items:
        if item.known:
            spec = spec.with_effect(*item.key, settings_of(item))
    key = "extended", spec.effects, repr(spec.nominal.settings)
    cell: Cell = replace(model.cell, model=spec)
    return made_once(model, key, lambda: Model.assembled(model.chain, cell))


def settings_of(item: Item) -> dict[str, float]:
    return {s.key: float(v) for s, v in zip(item.what.settings, item.settings, strict=True)}


# Estimates of a set: what its columns stand for, and the fit of the model with them in it.


def fit_extended(dataset: DiagnosisData, chosen: ModelSet, items: Sequence[Item]) -> Baseline:
    """The nonlinear fit of the model with `items` of the set in it, from the posterior means of
    its known items' parameters; where one was looked for from many starts, from its columns' own
    point: its geometry is far from linear."""
    model, columns = dataset.base.model, dataset.columns
    about = dict(zip(columns.full.names, columns.x, strict=True))
    start = dict(zip(model.names, dataset.base.x, strict=True))
    for item, span in zip(chosen.items, chosen.spans, strict=True):
        what = item.what
        if isinstance(what, Hypothesis):
            values = chosen.at.beta[span] * dataset.sizes[what.key]
            starts = what.effect.starts(what.where, model.chain, model.cell)
            for p, v in zip(what.parameters, values, strict=True):
                name = f"{what.where}.{p.key}"
                start[name] = float(about[name]) if starts else float(v) + p.nominal
    whole = extended(model, items)
    x0 = np.array([start.get(p.name, p.nominal) for p in whole.parameters])
    return fit_baseline(whole, dataset.base.observed.table, x0=x0)


# The backlash model of an arm's gears: whether play follows load alone, or load and last motion.
#
# A gear whose friction is small swings into the middle of its play, or onto the flank that any
# load pushes it to; one that is stiff in its bearings stays where the last motion left it until the
# load exceeds the friction.  Both are met, and the wrong one leaves most of the effect standing.

BY_LOAD, BY_BOTH = "load", "load_and_approach"
ALIKE = 1e-3  # nats: the rounding of two fits must not choose between models that predict the same


def with_likelier_backlash_model(dataset: DiagnosisData) -> DiagnosisData:
    """The data under the backlash model that its readings make likelier.

    Where no side of approach is recorded, the cell has play already, or no reading tells the two
    apart, it stays as it is.
    """
    model, noise = dataset.base.model, dataset.data.noise
    play = [h for h in dataset.hypotheses if h.name == Backlash.name]
    if model.cell.model.play_side != BY_BOTH or not play:
        return dataset
    # From both to the load alone.
    other = replace(dataset.base, model=with_keys(model, play_side=BY_LOAD))
    columns = replace(dataset.columns, base=other, rows=dataset.columns.rows.copy())
    by_load = compute_columns(other, play)
    for h in play:
        columns.rows[:, :, columns.places[h.key]] = by_load.of(h)
    # Of the fitted parameters none is of play: their columns are those they were.
    under_other = replace(dataset, base=other, columns=columns)
    here, there = (_likeliest(d, noise) for d in (dataset, under_other))
    if there.score <= here.score + ALIKE:
        return replace(dataset, other_backlash=doubt(here, there))
    return replace(under_other, other_backlash=doubt(there, here))


def _likeliest(dataset: DiagnosisData, noise: NoiseValues) -> ModelSet:
    """Play in the joint where it is likeliest, the noise fitted beside it."""
    play = [h for h in dataset.hypotheses if h.name == Backlash.name]
    grams = Grams(dataset, dataset.data, project(dataset.data, noise))
    evidence = [float(grams.of(h).evidence(h.scales).max()) for h in play]
    likeliest = play[int(np.argmax(evidence))]
    return fit_set(dataset, (Item(likeliest, np.zeros(0), 0.0),), noise)


def doubt(better: ModelSet, other: ModelSet) -> float:
    """Probability of the less likely model: the larger of 1/(1 + exp Σ d) and Φ(−Σ d / √Σ d²).

    d (configurations,) is what each adds to the log likelihood ratio under the noise of `better`.
    Both models idealise what happens in the dead zone, so that one or two configurations there may
    speak loudly for the wrong one; by the test of Vuong (1989, Econometrica 57) for models of which
    none is quite true, their ratio counts against its own scatter.
    """
    others = _squares(other.data, project(other.data, better.noise))
    d = (others - _squares(better.data, better.at)) / 2
    odds, scatter = max(float(d.sum()), 0.0), max(float(np.linalg.norm(d)), 1e-300)
    return float(max(expit(-odds), ndtr(-odds / scatter)))


def _squares(data: NoisyData, at: Projection) -> Array:
    """eᵀV⁻¹e of each configuration (C,) with what the fit leaves, e = r − Xβ."""
    left = data.masked(data.r - data.X @ at.beta)
    return np.asarray((left * at.u).sum(axis=1))
