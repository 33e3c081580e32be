"""Everything that was tried, best first; what could not be tested; what to beware of."""

from __future__ import annotations

import numpy as np

from elastocal.diagnosis.found import Found
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.play_law import EFFECT
from elastocal.diagnosis.result import Candidate, Untested
from elastocal.diagnosis.scene import Scene
from elastocal.diagnosis.screen import Screened
from elastocal.diagnosis.verdict import Answer

DETECTABLE = 1.0  # standard deviations: below, a typical size does not move the data
STATED_LOW, STATED_HIGH = 0.67, 1.5
FAULTY_SHARE = 0.02
SUSPECT_SHARE = 0.05
OPEN_LAW = 0.2  # probability of the other law of play from which the reader is told


def candidates(scene: Scene, found: Found, answer: Answer) -> tuple[Candidate, ...]:
    """Every hypothesis with its probability: in the slot where it is likeliest."""
    best: dict[tuple[str, str], Candidate] = {}
    distance = {
        (h.name, h.where): s.distance
        for h, s in zip(scene.hypotheses, found.alone.scored, strict=True)
    }
    for k, slot in enumerate(found.slots):
        rivals = answer.rivals[k] if k < len(answer.rivals) else ()
        named = {id(item.what): p for item, p in rivals if item.known}
        each, _ = slot.probabilities()
        for item, p, score in zip(slot.items, each, slot.scores, strict=True):
            what = item.what
            if not isinstance(what, Hypothesis):
                continue
            settings = {s.key: float(v) for s, v in zip(what.settings, item.settings, strict=True)}
            probability = named.get(id(what), float(p))
            key = what.name, what.where
            row = Candidate(
                what.name, what.where, what.stage, probability, float(score),
                distance[key], settings,
            )  # fmt: skip
            if key not in best or row.probability > best[key].probability:
                best[key] = row
    return tuple(sorted(best.values(), key=lambda c: (-c.probability, -c.score)))


def too_small(scene: Scene, found: Found) -> tuple[Untested, ...]:
    """Hypotheses whose typical size these poses would not show."""
    chosen = {id(item.what) for item in found.chosen.items}
    rows = []
    for h, s in zip(scene.hypotheses, found.alone.scored, strict=True):
        if s.distance < DETECTABLE and id(h) not in chosen:
            rows.append(
                Untested(
                    h.name,
                    h.where,
                    "at its typical size it does not show in these poses: the fitted parameters "
                    "follow it, or it is smaller than the noise",
                    "spread the poses over more of the work space, or raise the load",
                )
            )
    return tuple(rows)


def warnings(scene: Scene, found: Found, screened: Screened) -> tuple[str, ...]:
    """What a reader should know before trusting the verdict."""
    out = []
    noise, data = found.chosen.noise, found.chosen.data
    if data.stated and not STATED_LOW < noise.factor < STATED_HIGH:
        out.append(
            f"the readings scatter {noise.factor:.2g} times as much as cell or table state; "
            "correct the stated noise"
        )
    faulty = (data.left_out & ~scene.blocks.absent).sum() / max((~scene.blocks.absent).sum(), 1)
    if faulty > FAULTY_SHARE:
        out.append(
            f"{faulty:.0%} of the readings disagree with all others and were left out; look for "
            "the cause before trusting the rest"
        )
    kept = np.flatnonzero(screened.suspects)
    if len(kept) > SUSPECT_SHARE * len(screened.suspects):
        lines = scene.base.seen.table.row[scene.base.seen.lead[kept]]
        out.append(
            f"{len(kept)} of {len(screened.suspects)} readings (lines {lines.min()} to "
            f"{lines.max()}) lie far beyond the scatter of the others, too many or too near each "
            "other to be accidents; they were kept: look at them with `elastocal identify` first"
        )
    if text := _undecided_play(found):
        out.append(text)
    if scene.base.seen.table.time is None:
        out.append("without times neither drifts nor jumps can be seen: record time_s")
    return tuple(out)


def _undecided_play(found: Found) -> str:
    """That the law of the play that was found is not known, where it is not."""
    named = [i.what.where for i in found.chosen.items if isinstance(i.what, Hypothesis)
             and i.what.name == EFFECT]  # fmt: skip
    if not named or found.scene.other_play <= OPEN_LAW:
        return ""
    places = " and ".join(named)
    return (
        f"hardly a reading tells whether the play of {places} follows the load alone or also the "
        "last motion, so the error left at fresh poses is uncertain: measure poses in which the "
        f"load hardly turns {places}, approached from both sides"
    )
