"""Forward selection of what is missing, each step re-examined, under noise fitted beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic, diagnosis_data_of
from elastocal.diagnosis.evidence import (
    ANOTHER,
    Scan,
    exceedance,
    log_prior_odds,
    scan,
)
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import (
    Item,
    ModelSet,
    fit_extended,
    fit_set,
    fit_sets,
    refine,
    signal_of,
)
from elastocal.diagnosis.noise_floor import NoiseValues, log_prior
from elastocal.diagnosis.stated_floor import left_out_square, left_out_together
from elastocal.model.effects.catalogue import SOMETHING
from elastocal.units import Array

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


def is_far(dataset: DiagnosisData, chosen: ModelSet) -> bool:
    used = ~dataset.data.left_out
    signals = (signal_of(dataset, chosen, k)[used] for k in _direct(chosen))
    return any((signal**2).mean() > FAR**2 for signal in signals)


def relinearised(dataset: DiagnosisData, chosen: ModelSet) -> DiagnosisData:
    """The data about the nonlinear fit with the set's known effects in the model.

    The residual is that of the fitted parameters alone: what the effects explain is put back, so
    that sets with and without them are judged on the same footing.
    """
    items = [chosen.items[k] for k in _direct(chosen)]
    fitted = fit_extended(dataset, chosen, items)
    return about(dataset, fitted, [i.what for i in items if isinstance(i.what, Hypothesis)])


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


def _direct(chosen: ModelSet) -> list[int]:
    return [
        k
        for k, item in enumerate(chosen.items)
        if isinstance(item.what, Hypothesis) and not item.what.driven
    ]


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
            if is_far(self.dataset, current):
                self.dataset = relinearised(self.dataset, current)
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

    def _close(self, slot: Slot, behind: float) -> NDArray[np.int64]:
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
