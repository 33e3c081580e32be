"""Spectra of hypotheses and blocks beside a model, each entry's sums computed once."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.columns import EntryKey, entry_key, is_driven
from elastocal.diagnosis.evidence import SCALES, UNSIZED_SCALES, Spectrum
from elastocal.diagnosis.generic import Generic
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.noise import NoisyData
from elastocal.diagnosis.projection import Projection
from elastocal.diagnosis.scene import Scene
from elastocal.diagnosis.sums import EntrySums, direct

Array = NDArray[np.float64]

HELD = 4_000_000  # numbers of drives that are held at a time


@dataclass
class Grams:
    """Spectra against `data` under the noise of its projection `at`, and against its residual
    with flipped `signs` (F, C), where these are given."""

    scene: Scene
    data: NoisyData
    at: Projection
    signs: Array | None = None
    _entries: dict[EntryKey, EntrySums] = field(init=False, default_factory=dict)

    def entry(self, key: EntryKey) -> EntrySums:
        if key not in self._entries:
            E = self.data.masked(self.scene.entry(key))
            self._entries[key] = EntrySums.of(E, self.scene.places, self.at, self.signs)
        return self._entries[key]

    def of_hypothesis(self, h: Hypothesis, settings: Array | None = None) -> Spectrum:
        """At every one of the `settings` (G, …), by default those of the search."""
        if not is_driven(h):
            return direct(self.data.masked(self.scene.packed(h, np.zeros(0))), self.at, self.signs)
        if settings is None:
            settings = self.scene.grids[h.name, h.where].values
        sums = self.entry(entry_key(h, self.scene.base.model))
        # A large table's drives at thousands of settings do not fit into memory at once.
        each = max(1, HELD // (sums.b.size * len(h.parameters)))
        pieces = [settings[i : i + each] for i in range(0, len(settings), each)]
        return Spectrum.joined([sums.driven(self.scene.drive(h, piece)) for piece in pieces])

    def of_block(self, g: Generic) -> Spectrum:
        if g.columns is not None:
            return direct(self.data.masked(g.columns), self.at, self.signs)
        assert g.entry is not None and g.drive is not None
        return self.entry(g.entry).driven(g.drive[:, :, :, None, :])


def scales_of(h: Hypothesis) -> Array:
    """Scales of the size prior: wider where no typical size is known."""
    return UNSIZED_SCALES if any(p.typical is None for p in h.parameters) else SCALES
