"""Who the rivals are: the named sets of an ambiguous verdict, or what an unknown effect may be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from elastocal.diagnosis.alike import item_key
from elastocal.diagnosis.generic import Generic, generic_blocks
from elastocal.diagnosis.hypotheses import Hypothesis, possible
from elastocal.diagnosis.model_set import Item, packed_columns
from elastocal.diagnosis.noise import NoiseValues
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.result import Diagnosis
from elastocal.diagnosis.scene import Scene
from elastocal.diagnosis.sums import direct
from elastocal.diagnosis.verdict import UNKNOWN_EFFECT
from elastocal.errors import InputError, require
from elastocal.manipulator.effects.compliances import JointCompliance
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

# An unknown effect is told from the known ones that keep a chance, so many at least and at most,
# as so many blocks at so many places.
CHANCE = 0.01
FEWEST_KNOWN, MOST_KNOWN, BLOCKS, PLACES = 2, 6, 2, 2
# Probability that a rival keeps, however unlikely it looks so far.  Blocks only approximate what
# is unknown, so that the evidence for them against each other says less.
SMALLEST, SMALLEST_UNKNOWN = 0.01, 0.05


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
        smallest: float = SMALLEST,
    ) -> RivalSet:  # fmt: skip
        p = np.maximum(probability, smallest)
        return cls(tuple(rivals), p / p.sum(), tuple(beside))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name_of(item) for item in self.rivals)

    def depends_on(self, column: str) -> bool:
        """Whether a rival needs the table's column: "time" or "approach"."""
        return any(_depends(item.what, column) for item in self.rivals)


def name_of(item: Item) -> str:
    """ "gear_eccentricity:joint2", or a block's label."""
    what = item.what
    return f"{what.name}:{what.where}" if isinstance(what, Hypothesis) else what.label


def _depends(what: Hypothesis | Generic, column: str) -> bool:
    return column in (what.effect.needs if isinstance(what, Hypothesis) else what.kind)


class Suspects:
    """The items that a diagnosis speaks of, with the settings it found for them.

    Raises InputError where they do not belong to this model and table.
    """

    def __init__(self, model: Model, table: Measurements, diagnosis: Diagnosis) -> None:
        self.diagnosis = diagnosis
        known = {(h.name, h.where): h for h in possible(model, table)[0]}
        self._items: dict[tuple[str, str], Item] = {}
        self._probability: dict[tuple[str, str], float] = {}
        for c in diagnosis.candidates:
            key = c.effect, c.where
            if key in known:
                h = known[key]
                settings = np.array([c.settings[s.key] for s in h.settings])
                self._items[key] = Item(h, settings, 0.0)
                self._probability[key] = c.probability
        self._found = [(f.effect, f.where) for f in diagnosis.effects]
        named = [(e.effect, e.where) for group in diagnosis.indistinguishable for e in group]
        named = [key for key in named if key[0] != UNKNOWN_EFFECT]
        for effect, where in [*self._found, *named]:
            require(
                (effect, where) in self._items,
                f"{table.source}: the diagnosis names {effect} at {where}, which this model and "
                "table cannot test; plan with those that were diagnosed",
            )
        self.sets = tuple(self._named_sets())

    @property
    def known(self) -> dict[tuple[str, str], tuple[Item, float]]:
        """Every effect that was tried, with its probability."""
        return {key: (item, self._probability[key]) for key, item in self._items.items()}

    @property
    def covered(self) -> float:
        """Probability that the right answer is among the rivals: that there is something, and that
        it is none of the effects that are no rivals."""
        d, ours = self.diagnosis, set(self._rivals())
        others = sum(p for key, p in self._probability.items() if key not in ours)
        missed = d.probability_nothing + others + (0.0 if self.unknown else d.probability_unknown)
        return min(max(1 - missed, 0.0), 1.0)

    def with_sets(self, sets: tuple[RivalSet, ...]) -> Suspects:
        """The same with other sets of rivals."""
        other = copy(self)
        other.sets = sets
        return other

    def _named_sets(self) -> Iterator[RivalSet]:
        """The sets that the diagnosis calls indistinguishable."""
        for group in self.diagnosis.indistinguishable:
            keys = [(e.effect, e.where) for e in group if e.effect != UNKNOWN_EFFECT]
            if len(keys) < 2:
                continue
            yield RivalSet.of(
                [self._items[k] for k in keys],
                [self._probability[k] for k in keys],
                [self._items[k] for k in self._found if k not in keys],
            )

    def _rivals(self) -> list[tuple[str, str]]:
        """The known rivals, and what is at work beside them."""
        items = [item for s in self.sets for item in (*s.rivals, *s.beside)]
        keys = [item_key(item) for item in items] + self._found
        return keys + self._likeliest() if self.unknown else keys

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """Everything that may take part."""
        keys = self._rivals()
        if self.unknown:
            # Torques, which may drive what is unknown, come from the compliances' columns.
            keys += [k for k in self._items if k[0] == JointCompliance.name]
        whats = [self._items[k].what for k in dict.fromkeys(keys)]
        return [h for h in whats if isinstance(h, Hypothesis)]

    @property
    def unknown(self) -> bool:
        """Whether something without a name is at work."""
        return self.diagnosis.verdict == "unknown_effect"

    @property
    def sides_matter(self) -> bool:
        """Whether the side of approach may tell the rivals apart."""
        return self.unknown or any(s.depends_on("approach") for s in self.sets)

    @property
    def waiting_matters(self) -> bool:
        """Whether some rival relaxes with time, so that later poses may tell more."""
        constants = [s.kind for h in self.hypotheses for s in h.settings]
        return self.unknown or "time_constant" in constants

    def unknown_set(self, scene: Scene, noise: NoiseValues) -> RivalSet:
        """The blocks that explain the data best where the diagnosis locates the effect, and the
        likeliest effects of the catalogue; `scene` with only the data so far counting."""
        location = self.diagnosis.location
        assert location is not None  # an unknown effect was found somewhere
        places = dict.fromkeys([location.where, *location.places])
        near = list(places)[:PLACES]
        at = project(scene.data, noise)
        items, evidence = [], []
        for block in generic_blocks(scene):
            if block.where in near:
                item = Item(block, np.zeros(0), 0.0)
                columns = scene.data.masked(packed_columns(scene, item))
                items.append(item)
                evidence.append(float(direct(columns, at).evidence()[0]))
        best = np.argsort(-np.array(evidence), kind="stable")[:BLOCKS]
        share = self.diagnosis.probability_unknown * softmax(np.array(evidence)[best])
        keys = self._likeliest()
        return RivalSet.of(
            [*(items[k] for k in best), *(self._items[k] for k in keys)],
            [*share, *(self._probability[k] for k in keys)],
            [self._items[k] for k in self._found],
            SMALLEST_UNKNOWN,
        )

    def _likeliest(self) -> list[tuple[str, str]]:
        free = [k for k in self._items if k not in self._found]
        free = sorted(free, key=lambda k: -self._probability[k])[:MOST_KNOWN]
        return [k for n, k in enumerate(free) if n < FEWEST_KNOWN or self._probability[k] >= CHANCE]


def check_open(diagnosis: Diagnosis) -> None:
    """InputError where the verdict leaves no rivals to tell apart."""
    if diagnosis.verdict not in ("ambiguous", "unknown_effect"):
        raise InputError(
            f"the verdict is {diagnosis.verdict}: there are no rivals to tell apart; extra poses "
            "are planned for an ambiguous or unknown_effect verdict"
        )
