"""Who the rivals are: sets that a verdict cannot tell apart, and what may imitate them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.diagnosis import Diagnosis
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Hypothesis, StartSearch, possible
from elastocal.diagnosis.model_set import (
    Item,
    distances,
    fit_set,
    packed_columns,
    settings_to_try,
    with_items,
)
from elastocal.diagnosis.noise_floor import SMALLEST_NOISE, NoiseValues, project
from elastocal.diagnosis.unknown import UNKNOWN_EFFECT, generic_blocks
from elastocal.diagnosis.verdict import TOO_NEAR
from elastocal.errors import InputError, require
from elastocal.measurements import Measurements
from elastocal.model.effects.compliances import JointCompliance
from elastocal.model.manipulator import Model
from elastocal.units import Array

# The noise that a diagnosis found, and the readings that it left out, in the campaign's terms.


def as_diagnosed(dataset: DiagnosisData, diagnosis: Diagnosis) -> tuple[DiagnosisData, NoiseValues]:
    """The data, planned ones included, less the faulty readings, and the noise."""
    found = diagnosis.noise
    faulty = np.isin(dataset.table.row[dataset.lead], [f.line for f in found.faulty])
    joint = np.maximum(found.repeatability, SMALLEST_NOISE)
    shared = np.array(found.shared_by_joint or [found.shared] * len(joint))
    return dataset.without(faulty), NoiseValues(found.stated_factor, joint, shared)


# Who the rivals are: the named sets of an ambiguous verdict, or what an unknown effect may be.

# An unknown effect is told from the known ones that keep a chance, so many at least and at most,
# as so many blocks at so many places.
CHANCE = 0.01
FEWEST_KNOWN, MOST_KNOWN, BLOCKS, PLACES = 2, 6, 2, 2
# Probability that a rival keeps, however unlikely it looks so far.  Blocks only approximate what
# is unknown, so that the evidence for them against each other says less.
LEAST_PROBABILITY, LEAST_PROBABILITY_UNKNOWN = 0.01, 0.05


@dataclass(frozen=True)
class RivalSet:
    """Items of which one is at work, `beside` other items that are.

    `probability` (rivals,) of each given that it is one of them.
    """

    rivals: tuple[Item, ...]
    probability: NDArray[np.float64]
    beside: tuple[Item, ...]

    @classmethod
    def of(
        cls, rivals: Sequence[Item], probability: Sequence[float], beside: Sequence[Item],
        smallest: float = LEAST_PROBABILITY,
    ) -> RivalSet:  # fmt: skip
        p = np.maximum(probability, smallest)
        return cls(tuple(rivals), p / p.sum(), tuple(beside))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(item.what.label for item in self.rivals)

    def depends_on(self, column: str) -> bool:
        """Whether a rival needs the table's column: "time" or "approach"."""
        whats = (item.what for item in self.rivals)
        return any(
            column in (w.effect.needs if isinstance(w, Hypothesis) else w.kind) for w in whats
        )


class Suspects:
    """The items that a diagnosis speaks of, with the settings it found for them.

    Raises InputError where they do not belong to this model and table.
    """

    def __init__(self, model: Model, table: Measurements, diagnosis: Diagnosis) -> None:
        self.diagnosis = diagnosis
        hypotheses = {h.key: h for h in possible(model, table)[0]}
        # Every effect that was tried, and its probability.
        self.items: dict[tuple[str, str], Item] = {}
        self.p: dict[tuple[str, str], float] = {}
        for c in diagnosis.candidates:
            if h := hypotheses.get((c.effect, c.where)):
                settings = np.array([c.settings[s.key] for s in h.settings])
                self.items[h.key], self.p[h.key] = Item(h, settings, 0.0), c.probability
        self._found = [(f.effect, f.where) for f in diagnosis.effects]
        # Whether something without a name is at work.
        self.unknown = diagnosis.verdict == "unknown_effect"
        named = [(e.effect, e.where) for group in diagnosis.indistinguishable for e in group]
        for effect, where in [*self._found, *named]:
            require(
                effect == UNKNOWN_EFFECT or (effect, where) in self.items,
                f"{table.source}: the diagnosis names {effect} at {where}, which this model and "
                "table cannot test; plan with those that were diagnosed",
            )
        self.sets = tuple(self._named_sets())

    @property
    def covered(self) -> float:
        """Probability that the right answer is among the rivals: that there is something, and that
        it is none of the effects that are no rivals."""
        d, ours = self.diagnosis, set(self._rivals())
        others = sum(p for key, p in self.p.items() if key not in ours)
        missed = d.probability_nothing + others + (0.0 if self.unknown else d.probability_unknown)
        return min(max(1 - missed, 0.0), 1.0)

    def _named_sets(self) -> Iterator[RivalSet]:
        for group in self.diagnosis.indistinguishable:
            keys = [(e.effect, e.where) for e in group if e.effect != UNKNOWN_EFFECT]
            if len(keys) > 1:
                beside = [self.items[key] for key in self._found if key not in keys]
                p = [self.p[key] for key in keys]
                yield RivalSet.of([self.items[key] for key in keys], p, beside)

    def _rivals(self) -> list[tuple[str, str]]:
        items = [item for s in self.sets for item in (*s.rivals, *s.beside)]
        keys = [item.key for item in items] + self._found
        return keys + self._likeliest() if self.unknown else keys

    @property
    def hypotheses(self) -> list[Hypothesis]:
        keys = self._rivals()
        if self.unknown:
            # Torques, which may drive what is unknown, come from the compliances' columns.
            keys += [key for key in self.items if key[0] == JointCompliance.name]
        whats = [self.items[key].what for key in dict.fromkeys(keys)]
        return [h for h in whats if isinstance(h, Hypothesis)]

    @property
    def matters(self) -> dict[str, bool]:
        """Whether the side of approach may tell the rivals apart, and waiting, since some rival
        relaxes with time."""
        constants = [s.kind for h in self.hypotheses for s in h.settings]
        sides = any(s.depends_on("approach") for s in self.sets)
        return {
            "sides": self.unknown or sides,
            "waits": self.unknown or "time_constant" in constants,
        }

    def unknown_set(self, dataset: DiagnosisData, noise: NoiseValues) -> RivalSet:
        """The blocks that explain the data best where the diagnosis locates the effect (anywhere,
        where it only says that a gap is left), and the likeliest effects of the catalogue; in
        `dataset` only the data so far count."""
        blocks = generic_blocks(dataset)
        if location := self.diagnosis.location:
            near = list(dict.fromkeys([location.where, *location.places]))[:PLACES]
            blocks = [block for block in blocks if block.where in near]
        items = [Item(block, np.zeros(0), 0.0) for block in blocks]
        grams = Grams(dataset, dataset.data, project(dataset.data, noise))
        evidence = np.array([float(grams.of(block).evidence()[0]) for block in blocks])
        best = np.argsort(-evidence, kind="stable")[:BLOCKS]
        share = self.diagnosis.probability_unknown * softmax(evidence[best])
        keys = self._likeliest()
        return RivalSet.of(
            [*(items[k] for k in best), *(self.items[key] for key in keys)],
            [*share, *(self.p[key] for key in keys)],
            [self.items[key] for key in self._found],
            LEAST_PROBABILITY_UNKNOWN,
        )

    def _likeliest(self) -> list[tuple[str, str]]:
        free = [key for key in self.p if key not in self._found]
        free = sorted(free, key=lambda key: -self.p[key])[:MOST_KNOWN]
        return [key for n, key in enumerate(free) if n < FEWEST_KNOWN or self.p[key] >= CHANCE]


def check_open(diagnosis: Diagnosis) -> None:
    if diagnosis.verdict not in ("ambiguous", "unknown_effect"):
        raise InputError(
            f"the verdict is {diagnosis.verdict}: there are no rivals to tell apart; extra poses "
            "are planned for an ambiguous or unknown_effect verdict"
        )
    if diagnosis.groups:
        raise InputError(
            "many causes act at once: extra poses are planned for rivals of single causes; spread "
            "more poses over the whole range of every joint instead"
        )


# Rivals that the verdict has no room to name: what one of those named may also be.
#
# A set names three effects at most.  Whichever of them is at work, further poses leave open what
# imitates it, whether it was listed or not; a plan that did not know of it would promise too much.

# Alike, or so near (twice the deviate of 0.97, what a plan is to reach) that their evidence
# leaves them a chance; so many at most, those named among them.
NEAR, MOST = 3.76, 10


def with_neighbours(base: Baseline, suspects: Suspects) -> tuple[RivalSet, ...]:
    """The suspects' sets with what each of their rivals may also be."""
    if not suspects.sets:
        return ()
    items, chance, diagnosis = suspects.items, suspects.p, suspects.diagnosis
    hypotheses = [i.what for i in items.values() if isinstance(i.what, Hypothesis)]
    dataset, noise = as_diagnosed(diagnosis_data_of(base, hypotheses), diagnosis)
    out = []
    for s in suspects.sets:
        near = dict.fromkeys(items, np.inf)
        for rival in s.rivals:
            of_rival = fit_set(dataset, (rival, *s.beside), noise)
            found = distances(dataset, of_rival, 0, NEAR)[1]
            near |= {key: min(near[key], d) for key, d in found.items()}
        taken = {item.key for item in (*s.rivals, *s.beside)}
        free = [
            key
            for key, p in chance.items()
            if key not in taken and (near[key] < TOO_NEAR or (near[key] < NEAR and p >= CHANCE))
        ]
        free = sorted(free, key=lambda key: near[key])[: max(MOST - len(s.rivals), 0)]
        rivals = [*s.rivals, *(items[key] for key in free)]
        # Those named have their probability given that there is something, as these need, too.
        something = max(1 - diagnosis.probability_nothing, 1e-9)
        probable = [chance[item.key] for item in s.rivals]
        probable += [chance[key] / something for key in free]
        out.append(RivalSet.of(rivals, probable, s.beside))
    return tuple(out)


# The starts from which one rival may imitate another: where a spring would be anchored.
#
# A spring's geometry is sought by the diagnosis from several starts, and only the best so far has
# given its columns to the dataset.  Once further poses are measured it is sought anew, and what
# another start explains of them is no longer told from a rival.


def columns_of_starts(dataset: DiagnosisData, item: Item) -> list[Array]:
    """Columns (C, m, k) of an item about each of its starts, per typical size; none without."""
    what, model = item.what, dataset.base.model
    if not isinstance(what, Hypothesis):
        return []
    if not what.effect.starts(what.where, model.chain, model.cell):
        return []
    of = dataset.columns
    starts = StartSearch.of(of.full, what, of.base, of.x, of.rows).tangents()
    return [dataset.pack(t.columns) * dataset.sizes_in(what, t.columns) for t in starts]


# The settings with which one rival may imitate the others: its order, its time.
#
# The best in the data so far need not be the best once further poses are measured, when the
# diagnosis seeks them anew: what is nearly as good stays possible.

NEARLY = 4.0  # in d²: two standard deviations
SETTINGS = 6  # of a rival that are tried, at most


def alternatives(
    dataset: DiagnosisData, noise: NoiseValues, rivals: RivalSet
) -> tuple[tuple[Item, ...], ...]:
    """Of each rival that has settings the item at those which explain most of another's signal,
    the bests first, then what explains NEARLY as much; of other rivals nothing.

    A signal is a rival's at its estimate; in `dataset` only the data so far count.
    """
    widest = tuple(float(item.scales.max()) for item in rivals.beside)
    data = with_items(dataset, rivals.beside, widest)
    grams = []
    for item in rivals.rivals:
        C = data.masked(packed_columns(dataset, item))
        at = project(data.with_columns(C, np.ones(C.shape[2])), noise)
        signal = C @ at.beta[data.X.shape[2] :]
        grams.append(Grams(dataset, data, project(replace(data, r=signal), noise)))
    return tuple(_of_rival(dataset, rivals.rivals, b, grams) for b in range(len(grams)))


def _of_rival(
    dataset: DiagnosisData, rivals: tuple[Item, ...], b: int, grams: list[Grams]
) -> tuple[Item, ...]:
    what, size = rivals[b].what, float(rivals[b].scales.max())
    others = [a for a in range(len(rivals)) if a != b]
    if not isinstance(what, Hypothesis) or not what.settings or not others:
        return ()
    lists = [settings_to_try(dataset, what, rivals[a]) for a in others]
    tried = np.unique(np.vstack([each for each in lists if each is not None]), axis=0)
    explained = np.array([grams[a].of(what, tried).explained(size) for a in others])
    short = explained.max(axis=1, keepdims=True) - explained
    near = np.flatnonzero((short <= NEARLY).any(axis=0))
    evenly = near[np.linspace(0, len(near) - 1, min(SETTINGS, len(near))).round().astype(int)]
    chosen = list(dict.fromkeys([*short.argmin(axis=1), *evenly]))[:SETTINGS]
    return tuple(replace(rivals[b], settings=tried[k]) for k in chosen)
