"""Few causes: a set of additions to the model, and the forward selection of what is missing, each
step re-examined, under noise fitted beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.special import expit, log_ndtr, logsumexp, ndtr

from elastocal.cell.work_cell import Cell
from elastocal.diagnosis.baseline import Baseline, fit_baseline, made_once
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic, diagnosis_data_of
from elastocal.diagnosis.evidence import ANOTHER, Grams, Scan, exceedance, log_prior_odds, scan
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
from elastocal.diagnosis.stated_floor import left_out_square
from elastocal.model.effects.catalogue import SOMETHING
from elastocal.model.effects.gears import Backlash
from elastocal.model.evaluate import ahead
from elastocal.model.manipulator import Model
from elastocal.units import Array, IntArray

# A set of additions to the model: its noise, its evidence, its estimates, its imitators.

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


# What a search found: the set, what else could stand in each of its places, and the odds.


@dataclass(frozen=True)
class Slot:
    """What could stand in one place of the set, the other items given.

    `options` are candidates with log posterior scores relative to nothing in that place; they
    hold every hypothesis and block.
    """

    items: tuple[Item, ...]
    scores: Array

    def best_of(self, other: Slot) -> Slot:
        """The same options, each with the higher score: both are bounds from below on what it
        would be under the noise that suits it best."""
        higher = other.scores > self.scores
        items = tuple(
            b if up else a for a, b, up in zip(self.items, other.items, higher, strict=True)
        )
        return Slot(items, np.maximum(self.scores, other.scores))

    def probabilities(self) -> tuple[Array, float]:
        """Of each option (K,), and of nothing."""
        total = float(logsumexp(np.append(self.scores, 0.0)))
        return np.exp(self.scores - total), float(np.exp(-total))

    @property
    def claimable(self) -> bool:
        """Whether what can be claimed, one of the LARGEST_SET likeliest effects or something
        without a name, is more probable than nothing."""
        each, nothing = self.probabilities()
        known = np.array([item.known for item in self.items], dtype=bool)
        named = np.sort(each[known])[-LARGEST_SET:].sum()
        return bool(max(named, each[~known].sum()) > nothing)


@dataclass(frozen=True)
class SelectedEffects:
    """The chosen set, a slot for each of its items (or one where nothing was chosen), and the
    p-value of every step against all that could have been found by chance.

    `dataset` is the one that the set was fitted on: columns about a fit with its large effects.
    `first` is the scan beside nothing under its own noise, `alone` under the final noise.
    """

    dataset: DiagnosisData
    chosen: ModelSet
    slots: tuple[Slot, ...]
    p_values: tuple[float, ...]
    nothing: ModelSet
    first: Scan
    alone: Scan


# Columns anew at the nonlinear fit with a large effect in it, before anything else is sought.

# Rms signal in m beyond which the products of an effect with the fitted parameters, which it
# moves by a tenth or so, are no longer small beside the noise.
FAR = 2e-4


def relinearised(dataset: DiagnosisData, chosen: ModelSet) -> DiagnosisData:
    """The data about the nonlinear fit with the set's known effects in the model, where one of them
    is large; else as they are.

    The residual is that of the fitted parameters alone: what the effects explain is put back, so
    that sets with and without them are judged on the same footing.
    """
    used, whats = ~dataset.data.left_out, [item.what for item in chosen.items]
    direct = {k: h for k, h in enumerate(whats) if isinstance(h, Hypothesis) and not h.driven}
    signals = (signal_of(dataset, chosen, k)[used] for k in direct)
    if not any((signal**2).mean() > FAR**2 for signal in signals):
        return dataset
    fitted = fit_extended(dataset, chosen, [chosen.items[k] for k in direct])
    return about(dataset, fitted, list(direct.values()))


def about(
    dataset: DiagnosisData, fitted: Baseline, added: Sequence[Hypothesis], apart: bool = False
) -> DiagnosisData:
    """The data about a fit of the model with some of the hypotheses in it, what these explain put
    back; `apart`: what they are to the model's own parameters is not in the columns of these."""
    base, model = dataset.base, fitted.model
    x = dict(zip(model.names, fitted.x, strict=True))
    moved = replace(
        base, x=np.array([x[name] for name in base.model.names]), residual=fitted.residual
    )
    about_fit = diagnosis_data_of(moved, list(dataset.hypotheses), model, fitted.x, apart)
    # Put back by the data's own columns, which will have to explain it: those of the equilibrium
    # differ from them by a thousandth, and a large effect is a thousand deviations.
    back = np.zeros((*fitted.residual.reshape(-1, base.observed.size).shape, 1))
    for what in added:
        # What an effect tries from several starts has no size about any of them.
        starts = what.effect.starts(what.where, model.chain, model.cell)
        open_keys = {key for start in starts for key in start}
        moved_by = [
            0.0 if p.key in open_keys else x[f"{what.where}.{p.key}"] - p.nominal
            for p in what.parameters
        ]
        back[:, :, 0] += about_fit.columns.observed(about_fit.columns.of(what)) @ np.array(moved_by)
    r = about_fit.data.r + about_fit.blocks.pack(back)[:, :, 0]
    shares = dataset.columns.shares | about_fit.columns.shares
    columns = replace(about_fit.columns, shares=shares)
    return replace(
        about_fit, columns=columns, base=replace(moved, residual=fitted.residual + back.ravel()),
        other_backlash=dataset.other_backlash,
        data=replace(about_fit.data, r=r, left_out=dataset.data.left_out),
    )  # fmt: skip


FLIPS = 199
CLOSE = 6  # candidates whose noise is fitted for themselves
HOPELESS = -6.0  # score below which none is
# How far behind the best one is not worth a noise of its own: under noise that an effect still
# missing has swollen, and under the noise of a set that is complete but for the item in question.
FAR_BEHIND, BEHIND_COMPLETE = 60.0, 20.0
# A first effect has to be more probable than nothing, it and not all weak candidates together; the
# flips keep the false alarms at their level.  Beside it the probability that nothing more is there
# has to be less than this.
DOUBT_MORE = 0.05
LARGEST_SET = 3  # effects that one claim names: more are no answer
CLOSE_BLOCKS = 3
CLEARLY = 10.0  # nats by which several named effects must beat fewer without a name
PART = 0.3
# Causes from which on a sum of all that may act is the better judge: of fewer this search is.
MANY = 3
KEPT = 4  # scans that are kept, the last ones


TENTHS = 10  # blocks of time that are left out in turn


def left_out_together(dataset: DiagnosisData, chosen: ModelSet) -> IntArray | None:
    """Which tenth of the campaign (C,) each configuration was first measured in, where an effect of
    the set goes with time; else None."""
    time, cell = dataset.table.time, dataset.base.model.cell
    known = [item.what for item in chosen.items if isinstance(item.what, Hypothesis)]
    if time is None or not any("time" in what.effect.needed(cell) for what in known):
        return None
    first = np.append(time[dataset.lead], np.inf)[dataset.blocks.member].min(axis=1)
    order = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return np.asarray(order * TENTHS // len(first))


@dataclass
class ForwardSelection:
    """The search's means: data, blocks, flips of signs, and the level of a claim."""

    dataset: DiagnosisData
    generic: list[Generic]
    level: float
    seed: int
    _start: DiagnosisData = field(init=False)
    _visited: set[frozenset[int]] = field(init=False, default_factory=set)
    _fitted: dict[tuple, ModelSet] = field(init=False, default_factory=dict)
    _scanned: dict[tuple, Scan] = field(init=False, default_factory=dict)

    @cached_property
    def signs(self) -> Array:
        """The flips (FLIPS, C)."""
        rng = np.random.default_rng(self.seed)
        return rng.choice([-1.0, 1.0], (FLIPS, len(self.dataset.blocks.member)))

    def run(self) -> SelectedEffects:
        self._start = dataset = self.dataset
        nothing = current = fit_set(dataset, (), dataset.data.noise)
        scanned = first = alone = self._scan(current, beside=current)
        slots: list[Slot] = []
        start: list[Slot] = []
        p_values: list[float] = []
        while True:
            best, slot = self._best_addition(current, scanned)
            if best is None or len(current.items) + 1 >= MANY:
                break
            # Score all again under the noise beside the winner: an effect that is still missing
            # looks like noise, and hides others with it.
            observed = self._scan(current, best.noise, best)
            if not current.items:
                alone = observed
            better, again = self._best_addition(current, observed)
            best, slot = better, slot.best_of(again)
            if best is None or not slot.claimable:
                break
            if current.items and slot.probabilities()[1] > DOUBT_MORE:
                break
            p = exceedance(observed.flipped, observed.odds)
            # The search may have come round to a set that it had.
            key = frozenset(id(item.what) for item in best.items)
            if p > self.level or key in self._visited:
                break
            self._visited.add(key)
            if not current.items:
                start = [slot]
            current, scanned = best, self._scan(best)
            slots.append(slot)
            p_values.append(p)
            if (anew := relinearised(self.dataset, current)) is not self.dataset:
                self.dataset = anew
                self._forget()
                current = fit_set(self.dataset, current.items, current.noise)
                scanned = self._scan(current)
            if len(current.items) > 1:
                current, slots, scanned = self._reexamined(current, slots, scanned)
        current, slots = self._paying(current, slots)
        if not current.items:
            self.dataset, current = dataset, nothing
        if len(current.items) > 1:
            alone = self._scan(nothing, current.noise)
        self._forget()
        return SelectedEffects(
            self.dataset, current, tuple(slots or start or [slot]), tuple(p_values[: len(slots)]),
            nothing, first, alone,
        )  # fmt: skip

    def settled(self, found: SelectedEffects) -> SelectedEffects:
        """What effects of the catalogue alone would make of it, where that is clearly better.

        A block without a name fits a little of everything, and may come first where several
        effects act at once.
        """
        first = found.slots[0]
        alone = max((s for i, s in zip(first.items, first.scores, strict=True) if i.known),
                    default=-np.inf)  # fmt: skip
        if not found.chosen.unknown or alone <= PART * first.scores.max():
            return found
        named = ForwardSelection(self._start, [], self.level, self.seed).run()
        if not named.chosen.items or named.chosen.score < found.chosen.score + CLEARLY:
            return found
        self.dataset = named.dataset
        self._forget()
        chosen, slots, _ = self._reexamined(named.chosen, list(named.slots), found.alone)
        return replace(
            found, dataset=self.dataset, chosen=chosen, slots=tuple(slots), p_values=named.p_values
        )

    def _paying(self, current: ModelSet, slots: list[Slot]) -> tuple[ModelSet, list[Slot]]:
        """The set without items beside whose others the error of configurations left out of the
        fit does not fall: a name that does not pay there is none.

        Judged once all are found: beside a large effect that is still missing nothing pays.
        """
        while current.items:
            noise = current.noise.of_instrument()
            together = left_out_together(self.dataset, current)
            without = [
                fit_set(self.dataset, current.without(k), current.noise)
                for k in range(len(current.items))
            ]
            now = left_out_square(current.data, noise, together)
            gains = [left_out_square(each.data, noise, together) - now for each in without]
            k = int(np.argmin(gains))
            if gains[k] > 0:
                break
            current, slots = without[k], slots[:k] + slots[k + 1 :]
        return current, slots

    def _forget(self) -> None:
        """What was fitted and scanned about another fit is void, and after a search only fills the
        memory: each set holds its columns."""
        self._fitted.clear()
        self._scanned.clear()

    def _scan(
        self, current: ModelSet, noise: NoiseValues | None = None, beside: ModelSet | None = None
    ) -> Scan:
        """All candidates beside the set; with flips of what is left `beside` another, where one is
        given: they hold nothing of what this one explains."""
        noise = noise or current.noise
        items = tuple((id(item.what), item.settings.tobytes()) for item in current.items)
        # Sets that a step has judged come again when its items are re-examined; the noise beside
        # which a residual is flipped is that of the set that leaves it.
        key = items, current.scales, noise.logs().tobytes(), beside is not None
        if key not in self._scanned:
            flips = None if beside is None else (self.signs, beside.at.scattered)
            self._scanned[key] = scan(
                self.dataset, self.generic, self._prior(current), current.data, noise, flips
            )
            while len(self._scanned) > KEPT:
                self._scanned.pop(next(iter(self._scanned)))
        return self._scanned[key]

    def _prior(self, current: ModelSet) -> Array:
        something = ANOTHER if current.items else SOMETHING
        return log_prior_odds(self.dataset.hypotheses, self.generic, something)

    def _best_addition(
        self, current: ModelSet, scanned: Scan, behind: float = FAR_BEHIND
    ) -> tuple[ModelSet | None, Slot]:
        """The best set with one item more (None: none is worth it), and the slot it fills.

        Beside other items it has to be better than the set without it.
        """
        slot, base = self._options(current, scanned), current.score
        best: ModelSet | None = None
        scores, close = slot.scores.copy(), self._close(slot, behind)
        there = {k for k in close if any(slot.items[k].what is o.what for o in current.items)}
        scores[list(there)] = -np.inf
        added = [k for k in close if k not in there]
        fits = self._with_each(current, [slot.items[k] for k in added])
        for k, fitted in zip(added, fits, strict=True):
            if fitted.excessive:
                scores[k] = -np.inf
                continue
            scores[k] = fitted.score - base
            if best is None or fitted.score > best.score:
                best = fitted
        if best is not None and current.items and best.score <= base:
            best = None
        return best, Slot(slot.items, scores)

    def _options(self, current: ModelSet, scanned: Scan) -> Slot:
        prior = self._prior(current)
        # Scores count from the set as it is, under the noise that suits it best.
        offset = sum(item.log_prior for item in current.items) - current.score
        offset += scanned.marginal - 0.5 * log_prior(self.dataset.data.stated, scanned.noise)
        whats: tuple[Hypothesis | Generic, ...] = (*self.dataset.hypotheses, *self.generic)
        # What the search over settings costs stays with the item.
        items = [
            Item(what, s.settings, float(w + s.evidence - s.best if what.known else w))
            for what, s, w in zip(whats, scanned.scored, prior, strict=True)
        ]
        scores = [w + s.evidence + offset for s, w in zip(scanned.scored, prior, strict=True)]
        return Slot(tuple(items), np.array(scores))

    def _with_each(self, current: ModelSet, added: Sequence[Item]) -> list[ModelSet]:
        """The set with each of the items more, its noise and settings fitted; kept, since they are
        asked for again."""
        sets = [(*current.items, item) for item in added]
        keys = [tuple((id(i.what), i.settings.tobytes(), i.log_prior) for i in s) for s in sets]
        new = {key: items for key, items in zip(keys, sets, strict=True) if key not in self._fitted}
        fits = fit_sets(self.dataset, list(new.values()), current.noise)
        for key, fitted in zip(new, fits, strict=True):
            self._fitted[key] = refine(self.dataset, fitted, len(fitted.items) - 1)
        return [self._fitted[key] for key in keys]

    def _close(self, slot: Slot, behind: float) -> IntArray:
        known = np.array([item.known for item in slot.items])
        order = np.argsort(-slot.scores, kind="stable")
        order = order[slot.scores[order] > HOPELESS]
        order = order[slot.scores[order] > slot.scores[order[:1]].max(initial=-np.inf) - behind]
        return np.concatenate([order[known[order]][:CLOSE], order[~known[order]][:CLOSE_BLOCKS]])

    def _reexamined(
        self, current: ModelSet, slots: list[Slot], scanned: Scan
    ) -> tuple[ModelSet, list[Slot], Scan]:
        """Every item against all that could stand in its place, the others given."""
        for _ in range(2):
            changed, k = False, 0
            while k < len(current.items):
                others = fit_set(self.dataset, current.without(k), current.noise)
                beside = self._scan(others, current.noise)
                best, slot = self._best_addition(others, beside, BEHIND_COMPLETE)
                slots[k] = slot
                if best is None:  # no longer needed
                    current, changed = others, True
                    del slots[k]
                    continue
                other = best.items[-1].what is not current.items[k].what
                if other and best.score > current.score + 1e-6:
                    items = list(best.items)
                    items.insert(k, items.pop())
                    current = fit_set(self.dataset, tuple(items), best.noise)
                    changed = True
                k += 1
            if not changed:
                break
        return current, slots, self._scan(current)
