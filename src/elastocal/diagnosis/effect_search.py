"""Few causes: a set of additions to the model, and the forward selection of what is missing, each
step re-examined, under noise fitted beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.special import expit, log_ndtr, logsumexp, ndtr

from elastocal.diagnosis.baseline import (
    SHARED,
    Baseline,
    NoiseValues,
    NoisyData,
    Projection,
    Weighted,
    fit_baseline,
    fit_noise,
    log_prior,
    made_once,
    project,
)
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic, diagnosis_data_of
from elastocal.diagnosis.evidence import ANOTHER, SOMETHING, Grams, Item, Scan
from elastocal.diagnosis.hypotheses import NO_SETTINGS, Hypothesis, compute_columns
from elastocal.diagnosis.noise_floor import left_out_square
from elastocal.model.effects.geometry import Backlash
from elastocal.model.evaluate import ahead
from elastocal.model.manipulator import Model
from elastocal.units import Array, IntArray

REFINED_ROUNDS = 3  # of settings that depend on each other


class ModelSet:
    """Additions `items` to the fitted model, noise fitted beside them, and the log posterior.
    `score` = log evidence at the fitted noise, sizes mixed, + log prior of noise and items.  `data`
    holds the items' columns at the best of their scales, `scales` (items,).  The noise is fitted
    from `start`, twice where the best scale is not the typical one; the items' columns, of typical
    size, stand last in `joined`."""

    def __init__(
        self, dataset: DiagnosisData, items: tuple[Item, ...], start: NoiseValues | None = None,
        joined: NoisyData | None = None,
    ) -> None:  # fmt: skip
        noise, scales, weighted = start, (1.0,) * len(items), None
        data = joined = joined or with_items(dataset, items, scales)
        for _ in range(2):
            before, noise = noise, fit_noise(data, noise)
            if weighted is None or noise is not before:
                weighted = Weighted.of(joined, noise)
            best, score = _mixed_scales(dataset.data, weighted, items, scales)
            if best == scales:
                break
            scales, data = best, replace(joined, precision=_precision(dataset.data, items, best))
        assert noise is not None and weighted is not None
        self.items, self.noise, self.data, self.scales = items, noise, data, scales
        at, _ = weighted.factored(data.precision)
        self.beta = at.root * at.b
        z = at.b / np.linalg.norm(at.inverse, axis=0)  # in deviations
        for item, span in zip(items, self.spans, strict=True):
            score += item.log_prior
            if isinstance(item.what, Hypothesis):
                score += within_bounds(z[span][item.what.bounded])
        self.score = score - 0.5 * log_prior(dataset.data.stated, noise)

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
            and np.abs(self.beta[span]).max(initial=0.0) > item.what.effect.most
            for item, span in zip(self.items, self.spans, strict=True)
        )

    @property
    def spans(self) -> tuple[slice, ...]:
        return spans_of([item.what.width for item in self.items], self.data.X.shape[2])

    def without(self, k: int) -> tuple[Item, ...]:
        return self.items[:k] + self.items[k + 1 :]

    def beside(self, k: int) -> NoisyData:
        """The data with the columns of all items but k."""
        kept = np.ones(len(self.data.precision), dtype=bool)
        kept[self.spans[k]] = False
        return replace(self.data, X=self.data.X[:, :, kept], precision=self.data.precision[kept])

    def signal(self, k: int) -> Array:
        """What item k does to the readings (C, m) at its estimate."""
        span = self.spans[k]
        return self.data.masked(self.data.X[:, :, span] @ self.beta[span])


def spans_of(widths: Sequence[int], total: int) -> tuple[slice, ...]:
    """Where groups of so many coefficients each stand, the last of `total`."""
    ends = np.cumsum([total - sum(widths), *widths]).tolist()
    return tuple(slice(*pair) for pair in pairwise(ends))


def _precision(data: NoisyData, items: tuple[Item, ...], scales: tuple[float, ...]) -> Array:
    own = [np.full(item.what.width, 1 / s**2) for item, s in zip(items, scales, strict=True)]
    return np.concatenate([data.precision, *own])


def within_bounds(z: Array) -> float:
    """Σ log 2Φ(z) over parameters that cannot be below their nominal value, z = mean/deviation of
    each above it.  A compliance's size prior is one half of the Gaussian; the evidence gains or
    loses by the posterior's share of that half, each parameter taken by itself."""
    return float((np.log(2) + log_ndtr(z)).sum())


def _mixed_scales(
    data: NoisyData, weighted: Weighted, items: tuple[Item, ...], scales: tuple[float, ...]
) -> tuple[tuple[float, ...], float]:
    """The best scale of each item, the others' at theirs, and the evidence with scales mixed.
    Scales of different items hardly depend on each other: the log of each one's mean over its
    scales, less its best, adds up.  Only the prior differs from scale to scale: `weighted`, the
    data with the items' columns, stays."""
    if not items:
        return scales, weighted.factored(data.precision)[1]
    spent = 0.0
    for k, item in enumerate(items):
        trials = [(*scales[:k], float(s), *scales[k + 1 :]) for s in item.what.scales]
        each = np.array([weighted.factored(_precision(data, items, t))[1] for t in trials])
        scales, top = trials[int(np.argmax(each))], float(each.max())
        spent += float(logsumexp(each)) - np.log(len(each)) - top
    return scales, top + spent


def refine(dataset: DiagnosisData, chosen: ModelSet, k: int) -> ModelSet:
    """Item k's settings refined between the grid's points, at the set's noise; and, where wrong
    settings may have made joints scatter from pose to pose, at one with no more than usual."""
    noise = chosen.noise
    quiet = replace(noise, shared=np.minimum(noise.shared, SHARED))
    tried = [noise, quiet] if (noise.shared > 2 * SHARED).any() else [noise]
    found = [refined for n in tried if (refined := _refined(dataset, chosen, k, n)) is not None]
    return max(found, key=lambda refined: refined.score, default=chosen)


def _refined(
    dataset: DiagnosisData, chosen: ModelSet, k: int, noise: NoiseValues
) -> ModelSet | None:
    """The same at one noise; None where nothing was searched.  One setting after the other; where
    there are several, they go round REFINED_ROUNDS times."""
    item = chosen.items[k]
    what = item.what
    if not what.settings:
        return None
    data = chosen.beside(k)
    grams = Grams(dataset, data, project(data, noise))
    grid = dataset.grids[what.key]
    settings, searched = item.settings, False
    widths = grid.step[grid.nearest(settings)]
    for _ in range(1 if len(settings) == 1 else REFINED_ROUNDS):
        for s, setting in enumerate(what.settings):
            if setting.kind == "change_time":
                moments = dataset.moments[0]
                steps = [moments[np.abs(moments - settings[s]) <= widths[s]] - settings[s]]
                if len(steps[0]) <= 1 or len(moments) == len(np.unique(grid.values[:, s])):
                    continue
            else:
                steps = [np.linspace(-w, w, 21) for w in widths[s] / 8.0 ** np.arange(3)]
            for step in steps:
                tried = np.repeat(settings[None], len(step), axis=0)
                tried[:, s] = np.clip(settings[s] + step, setting.lower, setting.upper)
                settings = tried[int(np.argmax(grams.of(what, tried).evidence(what.scales)))]
            searched = True
    if not searched:
        return None
    refined = replace(item, settings=settings)
    return ModelSet(dataset, (*chosen.items[:k], refined, *chosen.items[k + 1 :]), noise)


def with_items(
    dataset: DiagnosisData, items: tuple[Item, ...], scales: tuple[float, ...]
) -> NoisyData:
    data = dataset.data
    X = np.concatenate([data.X, *(dataset.packed(i.what, i.settings) for i in items)], axis=2)
    return replace(data, X=X, precision=_precision(data, items, scales))


PLAUSIBLE = 5.0


def distances(dataset: DiagnosisData, chosen: ModelSet, k: int) -> dict[tuple[str, str], float]:
    """d of item k from each other hypothesis that the data could mean instead.  d² = min over β, γ
    of |v − Xβ − Cγ|²_V⁻¹ + |γ|²/s² with the item's signal v, the rival's columns C at its best
    settings and s = PLAUSIBLE times the widest of the size prior: in standard deviations.  A rival
    larger than usual is less probable, but it is no less alike; not of what the item is a special
    case of, which could look otherwise and does not."""
    v, data = chosen.signal(k), chosen.beside(k)
    at = project(replace(data, r=v), chosen.noise)
    grams = Grams(dataset, data, at)
    signal = float((v * at.u).sum())
    out, what = dict[tuple[str, str], float](), chosen.items[k].what
    for h in dataset.hypotheses:
        if h is not what and what.key[0] not in h.effect.special_cases:
            found = grams.of(h, settings_to_try(dataset, h, chosen.items[k]))
            explained = float(found.explained(PLAUSIBLE * float(h.scales.max())).max())
            out[h.key] = float(np.sqrt(max(signal - explained, 0.0)))
    return out


def settings_to_try(dataset: DiagnosisData, rival: Hypothesis, item: Item) -> Array:
    """Settings (G, …) at which a rival may imitate an item: those of the search and, where both
    have the same kinds of constants, the item's own, which were refined between them."""
    values = dataset.grids.get(rival.key, NO_SETTINGS).values
    kinds, own = ([s.kind for s in what.settings] for what in (rival, item.what))
    each = zip(rival.settings, item.settings, strict=True)
    within = bool(kinds) and kinds == own and all(s.lower <= v <= s.upper for s, v in each)
    return np.vstack([values, item.settings]) if within else values


def extended(model: Model, items: Sequence[Item]) -> Model:
    spec = model.cell.model
    for item in items:
        if item.known:
            spec = spec.with_effect(*item.what.key, settings_of(item))
    key = "extended", spec.effects, repr(spec.nominal.settings)
    return made_once(model, key, lambda: model.specified(spec))


def settings_of(item: Item) -> dict[str, float]:
    return {s.key: float(v) for s, v in zip(item.what.settings, item.settings, strict=True)}


def fit_extended(dataset: DiagnosisData, chosen: ModelSet, items: Sequence[Item]) -> Baseline:
    """The nonlinear fit of the model with `items` of the set in it, from the posterior means of
    their parameters; where one was looked for from many starts, from its columns' own point: its
    geometry is far from linear."""
    model, columns = dataset.base.model, dataset.columns
    about = dict(zip(columns.full.names, columns.x, strict=True))
    start = dict(zip(model.names, dataset.base.x, strict=True))
    for item, span in zip(chosen.items, chosen.spans, strict=True):
        what = item.what
        if isinstance(what, Hypothesis):
            values = chosen.beta[span] * dataset.sizes[what.key]
            starts = what.starts(model)
            for p, v in zip(what.parameters, values, strict=True):
                name = f"{what.where}.{p.key}"
                start[name] = float(about[name]) if starts else float(v) + p.nominal
    whole = extended(model, items)
    x0 = np.array([start.get(p.name, p.nominal) for p in whole.parameters])
    return fit_baseline(whole, dataset.base.observed.table, x0=x0)


# A gear whose friction is small swings into the middle of its play, or onto the flank that any
# load pushes it to; one that is stiff in its bearings stays where the last motion left it until the
# load exceeds the friction.  Both are met, and the wrong one leaves most of the effect standing.

BY_LOAD, BY_BOTH = "load", "load_and_approach"
ALIKE = 1e-3  # nats: the rounding of two fits must not choose between models that predict the same


def with_likelier_backlash_model(dataset: DiagnosisData) -> DiagnosisData:
    """The data under the backlash model that its readings make likelier.  Where no side of approach
    is recorded, the cell has play already, or no reading tells the two apart, it stays as it is."""
    model = dataset.base.model
    play = [h for h in dataset.hypotheses if h.name == Backlash.name]
    if model.cell.model.play_side != BY_BOTH or not play:
        return dataset
    # From both to the load alone.
    other = replace(dataset.base, model=model.stating(play_side=BY_LOAD))
    columns = replace(dataset.columns, base=other, rows=dataset.columns.rows.copy())
    by_load = compute_columns(other, play, entries=())
    for h in play:
        columns.rows[:, :, columns.places[h.key]] = by_load.of(h)
    # Of the fitted parameters none is of play: their columns are those they were.
    under_other = replace(dataset, base=other, columns=columns)
    here = _likeliest(dataset, dataset.data.noise)
    there = _likeliest(under_other, here.noise)
    if there.score > here.score + ALIKE:
        dataset, here, there = under_other, there, here
    d = gains(here.data, there.data, here.noise)
    return replace(dataset, other_backlash=doubt(float(d.sum()), d))


def _likeliest(dataset: DiagnosisData, noise: NoiseValues) -> ModelSet:
    play = [h for h in dataset.hypotheses if h.name == Backlash.name]
    grams = Grams(dataset, dataset.data, project(dataset.data, noise))
    likeliest = max(play, key=lambda h: float(grams.of(h).evidence(h.scales).max()))
    return ModelSet(dataset, (Item(likeliest, np.zeros(0), 0.0),), noise)


def doubt(odds: float, d: Array) -> float:
    """Probability of the less likely of two models: the larger of 1/(1 + exp L) and Φ(−L / √Σ d²).
    L are the log odds, d (configurations,) what each adds to the log likelihood ratio.  Both models
    idealise, so that a few configurations may speak loudly for the wrong one; by the test of Vuong
    (1989, Econometrica 57) for models none of which is true, it counts against its own scatter."""
    odds, scatter = max(odds, 0.0), max(float(np.linalg.norm(d)), 1e-300)
    return float(max(expit(-odds), ndtr(-odds / scatter)))


def gains(better: NoisyData, other: NoisyData, noise: NoiseValues) -> Array:
    """What each configuration (C,) adds to the log likelihood ratio under one noise, by eᵀV⁻¹e of
    what each fit leaves, e = r − Xβ."""
    squares = []
    for data in (other, better):
        at = project(data, noise)
        squares.append((data.masked(data.r - data.X @ at.beta) * at.u).sum(axis=1))
    return np.asarray((squares[0] - squares[1]) / 2)


@dataclass(frozen=True)
class Slot:
    """What could stand in one place of the set, the other items given: `items`, every hypothesis
    and block, with log posterior `scores` relative to nothing there."""

    items: tuple[Item, ...]
    scores: Array

    def best_of(self, other: Slot) -> Slot:
        """The higher score of each: both bound from below what it would be under the noise that
        suits it best."""
        each = zip(self.items, other.items, other.scores > self.scores, strict=True)
        items = tuple(b if up else a for a, b, up in each)
        return Slot(items, np.maximum(self.scores, other.scores))

    def holding(self, item: Item, score: float) -> Slot:
        """With the item of the set at its own settings, which another round of them may not find
        again, where it scores as much."""
        own = [item if one.what is item.what else one for one in self.items]
        scores = [score if one is item else -np.inf for one in own]
        return self.best_of(Slot(tuple(own), np.array(scores)))

    def probabilities(self) -> tuple[Array, float]:
        """Of each option (K,), and of nothing."""
        total = float(logsumexp(np.append(self.scores, 0.0)))
        return np.exp(self.scores - total), float(np.exp(-total))

    def claimable_beside(self, current: ModelSet) -> bool:
        """Whether what can be claimed, one of the LARGEST_SET likeliest effects or something
        without a name, is more probable than nothing; and beside items, that there is nothing more
        no more probable than DOUBT_MORE."""
        each, nothing = self.probabilities()
        known = np.array([item.known for item in self.items], dtype=bool)
        named = np.sort(each[known])[-LARGEST_SET:].sum()
        most = DOUBT_MORE if current.items else 1.0
        return bool(max(named, each[~known].sum()) > nothing and nothing <= most)


# Rms signal in m beyond which the products of an effect with the fitted parameters, which it
# moves by a tenth or so, are no longer small beside the noise.
FAR = 2e-4
# What moves joints is linear but for the square of their motion, a micrometre where a marker a
# metre away moves by this.
FAR_DRIVEN = 1.5e-3


def relinearised(dataset: DiagnosisData, chosen: ModelSet) -> DiagnosisData:
    """The data about the nonlinear fit with the set's known effects in the model, where one of them
    is large; else as they are.  What the effects explain is put back into the residual, so that
    sets with and without them are judged on the same footing."""
    used, whats = ~dataset.data.left_out, [item.what for item in chosen.items]
    direct = {
        k: h
        for k, h in enumerate(whats)
        if isinstance(h, Hypothesis)
        and (chosen.signal(k)[used] ** 2).mean() > (FAR_DRIVEN if h.driven else FAR) ** 2
    }
    if not direct:
        return dataset
    fitted = fit_extended(dataset, chosen, [chosen.items[k] for k in direct])
    return about(dataset, fitted, [(h, chosen.items[k].settings) for k, h in direct.items()])


def about(
    dataset: DiagnosisData, fitted: Baseline, added: Sequence[tuple[Hypothesis, Array]],
    apart: bool = False,
) -> DiagnosisData:  # fmt: skip
    """The data about a fit of the model with some of the hypotheses in it, at settings, what these
    explain put back; `apart`: columns of the model's own parameters are without them."""
    base, model = dataset.base, fitted.model
    x = dict(zip(model.names, fitted.x, strict=True))
    own = np.array([x[name] for name in base.model.names])
    moved = replace(base, x=own, residual=fitted.residual)
    about_fit = diagnosis_data_of(moved, list(dataset.hypotheses), model, fitted.x, apart)
    # Put back by the data's own columns, which will have to explain it: those of the equilibrium
    # differ from them by a thousandth, and a large effect is a thousand deviations.
    back = np.zeros((*about_fit.data.r.shape, 1))
    for what, settings in added:
        # What an effect tries from several starts has no size about any of them.
        open_keys = {key for start in what.starts(model) for key in start}
        moved_by = [
            0.0 if p.key in open_keys else x[f"{what.where}.{p.key}"] - p.nominal
            for p in what.parameters
        ]
        size = about_fit.sizes[what.key]
        times = np.divide(moved_by, size, out=np.zeros(len(size)), where=size > 0)
        back[:, :, 0] += about_fit.packed(what, settings) @ times
    r = about_fit.data.r + back[:, :, 0]
    whole = fitted.residual + about_fit.blocks.unpack(back).ravel()
    shares = dataset.columns.shares | about_fit.columns.shares
    columns = replace(about_fit.columns, shares=shares)
    return replace(
        about_fit, columns=columns, base=replace(moved, residual=whole),
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
# Causes from which on a sum of all that may act is the better judge: of fewer this search is.
MANY = 3


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


class ForwardSelection:
    """The chosen set, a slot for each of its items (or one where nothing was chosen), and the
    p-value of the first of them, or else of the likeliest addition, against all that chance could
    have found, which is to be below `level`.  The set was fitted on `dataset`: columns about a fit
    with its large effects.  `first` is the scan beside nothing under its own noise, `alone` under
    the final noise; `signs` (FLIPS, C) are the flips."""

    def __init__(
        self, dataset: DiagnosisData, generic: list[Generic], level: float, seed: int
    ) -> None:
        self.dataset, self.generic, self._fitted = dataset, generic, dict[tuple, ModelSet]()
        flips = FLIPS, len(dataset.blocks.member)
        self.signs = np.random.default_rng(seed).choice([-1.0, 1.0], flips)
        nothing = current = ModelSet(dataset, (), dataset.data.noise)
        first = alone = scanned = self._scan(nothing, beside=nothing)
        slots, visited, p = list[Slot](), set[frozenset[int]](), None
        while True:
            best, slot = self._best_addition(current, scanned)
            observed = scanned
            if best is not None and slot.claimable_beside(current):
                # Score all again under the noise beside the winner: an effect that is still missing
                # looks like noise, and hides others with it.
                observed = self._scan(current, best.noise, best)
                if not current.items:
                    alone = observed
                best, again = self._best_addition(current, observed)
                slot = slot.best_of(again)
            if not current.items:
                start = slot
            if best is None or not slot.claimable_beside(current):
                break
            # The search may have come round to a set that it had.
            key = frozenset(id(item.what) for item in best.items)
            if observed.chance > level or key in visited:
                break
            visited.add(key)
            p = observed.chance if p is None else p
            current = best
            slots.append(slot)
            if (anew := relinearised(self.dataset, current)) is not self.dataset:
                anew.grids.update(self.dataset.grids)
                self.dataset = anew
                self._fitted.clear()  # what was fitted about another fit is void
                current = ModelSet(anew, current.items, current.noise)
            if len(current.items) > 1:
                current, slots = self._reexamined(current, slots)
            if len(current.items) + 1 >= MANY:
                break
            scanned = self._scan(current)
        current, slots = self._paying(current, slots)
        if len(current.items) > 1:
            alone = self._scan(nothing, current.noise)
        if not current.items or p is None:
            current, p, self.dataset = nothing, first.chance, dataset
        self.chosen, self.slots, self.p_value = current, tuple(slots or [start]), p
        self.nothing, self.first, self.alone = nothing, first, alone
        self._fitted.clear()

    def _paying(self, current: ModelSet, slots: list[Slot]) -> tuple[ModelSet, list[Slot]]:
        """The set without items beside whose others the error of configurations left out of the fit
        does not fall: a name that does not pay there is none.  Judged once all are found: beside a
        large effect that is still missing nothing pays."""
        while current.items:
            noise = current.noise.of_instrument()
            together = left_out_together(self.dataset, current)
            now = left_out_square(current.data, noise, together)
            without = (current.beside(k) for k in range(len(current.items)))
            gains = [left_out_square(each, noise, together) - now for each in without]
            k = int(np.argmin(gains))
            if gains[k] > 0:
                break
            current = ModelSet(self.dataset, current.without(k), current.noise)
            del slots[k]
        return current, slots

    def _scan(
        self, current: ModelSet, noise: NoiseValues | None = None, beside: ModelSet | None = None
    ) -> Scan:
        """All candidates beside the set; with flips of what is left `beside` another, where one is
        given: they hold nothing of what this one explains."""
        flips = None if beside is None else (self.signs, beside.at.scattered)
        something, noise = ANOTHER if current.items else SOMETHING, noise or current.noise
        return Scan(self.dataset, self.generic, something, current.data, noise, flips)

    def _best_addition(
        self, current: ModelSet, scanned: Scan, behind: float = FAR_BEHIND
    ) -> tuple[ModelSet | None, Slot]:
        """The best set with one item more (None: none is worth it), and the slot it fills.  Beside
        other items it has to be better than the set without it."""
        # Scores count from the set as it is, under the noise that suits it best.
        base = current.score
        offset = sum(item.log_prior for item in current.items) - base
        offset += scanned.marginal - 0.5 * log_prior(self.dataset.data.stated, scanned.noise)
        slot, best = Slot(scanned.items, scanned.scores + offset), None
        items = list(slot.items)
        close, there = self._close(slot, behind), {id(item.what) for item in current.items}
        scores = slot.scores.copy()
        added = [k for k in close if id(slot.items[k].what) not in there]
        scores[[k for k in close if id(slot.items[k].what) in there]] = -np.inf
        fits = self._with_each(current, [slot.items[k] for k in added])
        for k, fitted in zip(added, fits, strict=True):
            scores[k] = -np.inf if fitted.excessive else fitted.score - base
            items[k] = fitted.items[-1]
            if not fitted.excessive and (best is None or fitted.score > best.score):
                best = fitted
        if best is not None and current.items and best.score <= base:
            best = None
        return best, Slot(tuple(items), scores)

    def _with_each(self, current: ModelSet, added: Sequence[Item]) -> list[ModelSet]:
        """The set with each of the items more, its noise and settings fitted; kept, since they are
        asked for again."""
        dataset = self.dataset
        sets = [(*current.items, item) for item in added]
        keys = [tuple((id(i.what), i.settings.tobytes(), i.log_prior) for i in s) for s in sets]
        new = {key: items for key, items in zip(keys, sets, strict=True) if key not in self._fitted}

        def fitted(joined: tuple[tuple[Item, ...], NoisyData]) -> ModelSet:
            return ModelSet(dataset, joined[0], current.noise, joined[1])

        columns = ((s, with_items(dataset, s, (1.0,) * len(s))) for s in new.values())
        for key, found in zip(new, ahead(fitted, columns, dataset.data.threads), strict=True):
            self._fitted[key] = refined = refine(dataset, found, len(found.items) - 1)
            of = refined.items[-1]
            # Under less noise an effect is worth nothing a visit beside its moment.
            if any(setting.kind == "change_time" for setting in of.what.settings):
                grid = dataset.grids[of.what.key]
                grid.values[grid.nearest(of.settings)] = of.settings
        return [self._fitted[key] for key in keys]

    def _close(self, slot: Slot, behind: float) -> IntArray:
        known = np.array([item.known for item in slot.items])
        order = np.argsort(-slot.scores, kind="stable")
        order = order[slot.scores[order] > HOPELESS]
        order = order[slot.scores[order] > slot.scores[order[:1]].max(initial=-np.inf) - behind]
        return np.concatenate([order[known[order]][:CLOSE], order[~known[order]][:CLOSE_BLOCKS]])

    def _reexamined(self, current: ModelSet, slots: list[Slot]) -> tuple[ModelSet, list[Slot]]:
        for _ in range(2):
            changed, k = False, 0
            while k < len(current.items):
                others = ModelSet(self.dataset, current.without(k), current.noise)
                scanned = self._scan(others, current.noise)
                best, slot = self._best_addition(others, scanned, BEHIND_COMPLETE)
                slots[k] = slot.holding(current.items[k], current.score - others.score)
                if best is None:  # no longer needed
                    current, changed = others, True
                    del slots[k]
                    continue
                other = best.items[-1].what is not current.items[k].what
                if other and best.score > current.score + 1e-6:
                    items = list(best.items)
                    items.insert(k, items.pop())
                    current = ModelSet(self.dataset, tuple(items), best.noise)
                    changed = True
                k += 1
            if not changed:
                break
        return current, slots
