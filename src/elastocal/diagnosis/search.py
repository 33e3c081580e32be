"""Forward selection of what is missing, each step re-examined, under noise fitted beside it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.evidence import exceedance
from elastocal.diagnosis.found import Found, Slot
from elastocal.diagnosis.generic import Generic
from elastocal.diagnosis.model_set import Item, ModelSet, fit_set, refine
from elastocal.diagnosis.noise import NoiseValues, log_prior
from elastocal.diagnosis.prior import ANOTHER, SOMETHING, Prior
from elastocal.diagnosis.relinearise import is_far, relinearised
from elastocal.diagnosis.scan import Scan, scan
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]

FLIPS = 199
CLOSE = 6  # candidates whose noise is fitted for themselves
HOPELESS = -6.0  # score below which none is
# How far behind the best one is not worth a noise of its own: under noise that an effect still
# missing has swollen, and under the noise of a set that is complete but for the item in question.
FAR_BEHIND, BEHIND_COMPLETE = 60.0, 20.0
# Probability that nothing (more) is there above which nothing is claimed.  For a first effect the
# flips keep the false alarms at their level; many weak candidates together may make it probable
# that there is something, though none of them is probable by itself.
DOUBT, DOUBT_MORE = 0.7, 0.05
CLOSE_BLOCKS = 3
CLEARLY = 10.0  # nats by which several named effects must beat fewer without a name
PART = 0.3
MOST_EFFECTS, MOST_BESIDE_UNKNOWN = 4, 2
KEPT = 4  # scans that are kept, the last ones


def base_score(scene: Scene, current: ModelSet, seen: Scan) -> float:
    """Log posterior of the set as it is under the scan's noise."""
    items = sum(item.log_prior for item in current.items)
    return seen.at.marginal + items - 0.5 * log_prior(scene.data.stated, seen.noise)[0]


def _rivalled(slot: Slot) -> bool:
    """Whether some named effect alone does a good part of what a block without a name does."""
    named = [s for item, s in zip(slot.items, slot.scores, strict=True) if item.known]
    return max(named, default=-np.inf) > PART * slot.scores.max()


@dataclass
class Search:
    """The search's means: scene, blocks, flips of signs, and the level of a claim."""

    scene: Scene
    generic: list[Generic]
    noise: NoiseValues
    level: float
    seed: int
    signs: Array = field(init=False)
    _start: Scene = field(init=False)
    _visited: set[frozenset[int]] = field(init=False, default_factory=set)
    _fitted: dict[tuple, ModelSet] = field(init=False, default_factory=dict)
    _scanned: dict[tuple, Scan] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        C = len(self.scene.blocks.member)
        self.signs = rng.choice([-1.0, 1.0], (FLIPS, C))

    def run(self) -> Found:
        self._start = scene = self.scene
        nothing = current = fit_set(scene, (), self.noise)
        seen = first = alone = self._scan(current, flips=True)
        slots: list[Slot] = []
        p_values: list[float] = []
        while True:
            best, slot = self._best_addition(current, seen)
            most = MOST_BESIDE_UNKNOWN if current.unknown else MOST_EFFECTS
            if best is None or len(current.items) >= most:
                break
            # Score all again under the noise beside the winner: an effect that is still missing
            # looks like noise, and hides others with it.
            observed = self._scan(current, best.noise)
            if not current.items:
                alone = observed
            better, again = self._best_addition(current, observed)
            best, slot = better, slot.best_of(again)
            doubt = DOUBT_MORE if current.items else DOUBT
            if best is None or slot.probabilities()[1] > doubt:
                break
            after = self._scan(best, flips=True)
            p = exceedance(after.flipped, observed.odds)
            if p > self.level:
                break
            if self._been_at(best):
                break
            current, seen = best, after
            slots.append(slot)
            p_values.append(p)
            if is_far(self.scene, current):
                self.scene = relinearised(self.scene, current)
                self._forget()
                current = fit_set(self.scene, current.items, current.noise)
                seen = self._scan(current)
            if len(current.items) > 1:
                current, slots, seen = self._reexamined(current, slots, seen)
        if not slots:
            slots = [slot]
        if len(current.items) > 1:
            alone = self._scan(nothing, current.noise)
        return Found(self.scene, current, tuple(slots), tuple(p_values), nothing, first, alone)

    def settled(self, found: Found) -> Found:
        """What effects of the catalogue alone would make of it, where that is clearly better.

        A block without a name fits a little of everything, and may come first where several
        effects act at once.
        """
        if not found.chosen.unknown or not _rivalled(found.slots[0]):
            return found
        named = Search(self._start, [], self.noise, self.level, self.seed).run()
        if not named.chosen.items or named.chosen.score < found.chosen.score + CLEARLY:
            return found
        self.scene = named.scene
        self._forget()
        chosen, slots, _ = self._reexamined(named.chosen, list(named.slots), found.alone)
        return replace(
            found, scene=self.scene, chosen=chosen, slots=tuple(slots), p_values=named.p_values
        )

    def _forget(self) -> None:
        """What was fitted and scanned about another scene is void."""
        self._fitted.clear()
        self._scanned.clear()

    def _been_at(self, chosen: ModelSet) -> bool:
        """Whether the search has come round to a set that it had; noted either way."""
        key = frozenset(id(item.what) for item in chosen.items)
        known = key in self._visited
        self._visited.add(key)
        return known

    def _scan(
        self, current: ModelSet, noise: NoiseValues | None = None, flips: bool = False
    ) -> Scan:
        noise = noise or current.noise
        items = tuple((id(item.what), item.settings.tobytes()) for item in current.items)
        # Sets that a step has judged come again when its items are re-examined; a scan with flips
        # holds what one without them does.
        key = items, current.scales, noise.logs().tobytes()
        for known in (True, flips):
            if (*key, known) in self._scanned:
                return self._scanned[*key, known]
        seen = scan(
            self.scene,
            self.generic,
            self._prior(current),
            current.data,
            noise,
            self.signs if flips else self.signs[:0],
        )
        self._scanned[*key, flips] = seen
        while len(self._scanned) > KEPT:
            self._scanned.pop(next(iter(self._scanned)))
        return seen

    def _prior(self, current: ModelSet) -> Prior:
        """Of one item more."""
        something = ANOTHER if current.items else SOMETHING
        return Prior.of(self.scene.hypotheses, self.generic, something)

    def _best_addition(
        self, current: ModelSet, seen: Scan, behind: float = FAR_BEHIND
    ) -> tuple[ModelSet | None, Slot]:
        """The best set with one item more (None: none is worth it), and the slot it fills.

        Beside other items it has to be better than the set without it.
        """
        options = self._options(current, seen)
        slot = Slot(tuple(item for item, _ in options), np.array([s for _, s in options]))
        base = current.score
        close = self._close(slot, behind)
        best: ModelSet | None = None
        scores = slot.scores.copy()
        for k in close:
            item = slot.items[k]
            if any(item.same_as(other) for other in current.items):
                scores[k] = -np.inf
                continue
            fitted = self._with(current, item)
            scores[k] = fitted.score - base
            if best is None or fitted.score > best.score:
                best = fitted
        if best is not None and current.items and best.score <= base:
            best = None
        return best, Slot(slot.items, scores)

    def _options(self, current: ModelSet, seen: Scan) -> list[tuple[Item, float]]:
        prior = self._prior(current)
        # Scores count from the set as it is, under the noise that suits it best.
        offset = base_score(self.scene, current, seen) - current.score
        options = []
        for h, s, w in zip(self.scene.hypotheses, seen.scored, prior.hypotheses, strict=True):
            # What the search over settings costs stays with the item.
            item = Item(h, s.settings, float(w + s.evidence - s.best))
            options.append((item, float(w + s.evidence + offset)))
        for g, s, w in zip(self.generic, seen.blocks, prior.blocks, strict=True):
            options.append((Item(g, s.settings, float(w)), float(w + s.evidence + offset)))
        return options

    def _with(self, current: ModelSet, item: Item) -> ModelSet:
        """The set with one item more, its noise and settings fitted; kept, since it is asked for
        again."""
        items = (*current.items, item)
        key = tuple((id(i.what), i.settings.tobytes(), i.log_prior) for i in items)
        if key not in self._fitted:
            fitted = fit_set(self.scene, items, current.noise)
            self._fitted[key] = refine(self.scene, fitted, len(items) - 1)
        return self._fitted[key]

    def _close(self, slot: Slot, behind: float) -> NDArray[np.int64]:
        known = np.array([item.known for item in slot.items])
        order = np.argsort(-slot.scores, kind="stable")
        order = order[slot.scores[order] > HOPELESS]
        near = slot.scores[order] > slot.scores[order[:1]].max(initial=-np.inf) - behind
        order = order[near]
        hypotheses = order[known[order]][:CLOSE]
        blocks = order[~known[order]][:CLOSE_BLOCKS]
        return np.concatenate([hypotheses, blocks])

    def _reexamined(
        self, current: ModelSet, slots: list[Slot], seen: Scan
    ) -> tuple[ModelSet, list[Slot], Scan]:
        """Every item against all that could stand in its place, the others given."""
        for _ in range(2):
            changed = False
            k = 0
            while k < len(current.items):
                others = fit_set(self.scene, current.without(k), current.noise)
                beside = self._scan(others, current.noise)
                best, slot = self._best_addition(others, beside, BEHIND_COMPLETE)
                slots[k] = slot
                if best is None:  # no longer needed
                    current, changed = others, True
                    del slots[k]
                    continue
                if best.score > current.score + 1e-6 and not best.items[-1].same_as(
                    current.items[k]
                ):
                    items = list(best.items)
                    items.insert(k, items.pop())
                    current = fit_set(self.scene, tuple(items), best.noise)
                    changed = True
                k += 1
            if not changed:
                break
        return current, slots, self._scan(current)
