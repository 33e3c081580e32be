"""What a search found: the set, what else could stand in each of its places, and the odds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from elastocal.diagnosis.model_set import Item, ModelSet
from elastocal.diagnosis.scan import Scan
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]


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


@dataclass(frozen=True)
class Found:
    """The chosen set, a slot for each of its items (or one where nothing was chosen), and the
    p-value of every step against all that could have been found by chance.

    `scene` is the one that the set was fitted on: columns about a fit with its large effects.
    `first` is the scan beside nothing under its own noise, `alone` under the final noise.
    """

    scene: Scene
    chosen: ModelSet
    slots: tuple[Slot, ...]
    p_values: tuple[float, ...]
    nothing: ModelSet
    first: Scan
    alone: Scan
