"""From scores to an answer: explained, ambiguous, unknown, or nothing significant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.alike import distances, item_key
from elastocal.diagnosis.found import Found
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item
from elastocal.diagnosis.result import EffectAt, Verdict

Array = NDArray[np.float64]

NAMED = 0.9  # probability from which an effect is named
UNKNOWN_EFFECT = "unknown_effect"
SET, LARGEST_SET = 0.95, 3  # probability that the named set holds, as far as so many can
# Two known alternatives at distance d are told apart with probability Φ(d/2) at best: closer than
# this, no evidence can be trusted to name one of them.
ALIKE = 2.0
ALIKE_PROBABILITY = 0.89


@dataclass(frozen=True)
class Answer:
    """`probability` of each item of the chosen set, and `rivals`: per item the other effects that
    it may be instead, likeliest first, with their probabilities."""

    verdict: Verdict
    probability: tuple[float, ...]
    rivals: tuple[tuple[tuple[Item, float], ...], ...]

    @property
    def indistinguishable(self) -> tuple[tuple[EffectAt, ...], ...]:
        return tuple(
            tuple(EffectAt(*_named(item)) for item, _ in rivals)
            for rivals in self.rivals
            if len(rivals) > 1
        )


def _named(item: Item) -> tuple[str, str]:
    """(effect, place); a block without a name is an unknown effect at its place."""
    return item_key(item) if item.known else (UNKNOWN_EFFECT, item.what.where)


def judge(found: Found) -> Answer:
    """The verdict on what the search found."""
    if not found.chosen.items:
        return Answer("nothing_significant", (), ())
    probability, rivals = [], []
    for k, item in enumerate(found.chosen.items):
        p, others = _of_item(found, k, item)
        probability.append(p)
        rivals.append(others)
    if found.chosen.unknown:
        verdict: Verdict = "unknown_effect"
        # What is named beside something without a name may be part of its imitation.
        probability = [min(p, ALIKE_PROBABILITY) for p in probability]
    elif all(len(r) == 1 for r in rivals):
        verdict = "explained"
    else:
        verdict = "ambiguous"
    return Answer(verdict, tuple(probability), tuple(rivals))


def _of_item(found: Found, k: int, item: Item) -> tuple[float, tuple[tuple[Item, float], ...]]:
    """Probability of item k, and it with those that it may be instead."""
    slot = found.slots[k]
    each, nothing = slot.probabilities()
    # That there is something has been decided; now it is only what.
    each = each / (1 - nothing)
    own = next(i for i, other in enumerate(slot.items) if other.same_as(item))
    if not item.known:
        return float(each[own]), ((item, float(each[own])),)
    near = distances(found.scene, found.chosen, k)[1]
    taken = {id(other.what) for other in found.chosen.items}
    alike = [
        i
        for i, other in enumerate(slot.items)
        if isinstance(other.what, Hypothesis)
        and id(other.what) not in taken
        and near[item_key(other)] < ALIKE
    ]
    # More than so many are no answer; the others stand among the candidates.
    alike = sorted(alike, key=lambda i: -each[i])[: LARGEST_SET - 1]
    p = each.copy()
    if alike and p[own] > ALIKE_PROBABILITY:
        # Their columns are the same in these poses; what separates the scores is only how many
        # parameters each would need.
        spare = p[own] - ALIKE_PROBABILITY
        p[own] = ALIKE_PROBABILITY
        p[alike] += spare / len(alike)
    chosen = [own, *alike]
    if p[own] < NAMED:
        # Of the blocks only the likeliest: they all say "something else, about there".
        blocks = [i for i in range(len(p)) if not slot.items[i].known]
        rest = {*range(len(p))} - {*chosen, *blocks}
        if blocks:
            likeliest = max(blocks, key=lambda i: p[i])
            p[likeliest] = p[blocks].sum()
            rest.add(likeliest)
        for i in sorted(rest, key=lambda i: -p[i]):
            if len(chosen) >= LARGEST_SET or p[chosen].sum() >= SET or p[i] < 0.01:
                break
            chosen.append(int(i))
    chosen = [own, *sorted(chosen[1:], key=lambda i: -p[i])]
    return float(p[own]), tuple((slot.items[i], float(p[i])) for i in chosen)
