"""Prior probabilities, fixed before any data: nothing, something unknown, or a known effect."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from elastocal.diagnosis.generic import Generic
from elastocal.diagnosis.hypotheses import Hypothesis

Array = NDArray[np.float64]

# Half that nothing more is there; of the rest a twentieth that the catalogue lacks it.
# A second effect beside a first is rarer.
SOMETHING, UNKNOWN = 0.5, 0.05
ANOTHER = 0.2


@dataclass(frozen=True)
class Prior:
    """Log prior odds against nothing: of each hypothesis (H,) and each block (G,).

    Effects are equally probable, and so are the places of one effect; kinds of blocks are equally
    probable, and so are the blocks of one kind.
    """

    hypotheses: Array
    blocks: Array

    @property
    def total(self) -> float:
        """Log prior odds of anything against nothing."""
        return float(logsumexp(np.concatenate([self.hypotheses, self.blocks])))

    @classmethod
    def of(
        cls, hypotheses: tuple[Hypothesis, ...], blocks: list[Generic], something: float = SOMETHING
    ) -> Prior:
        odds = something / (1 - something)
        known = _shares([h.name for h in hypotheses]) * (1 - UNKNOWN)
        unknown = _shares([g.kind for g in blocks]) * UNKNOWN
        return cls(np.log(odds * known), np.log(odds * unknown))


def _shares(names: list[str]) -> Array:
    count = Counter(names)
    return np.array([1 / (len(count) * count[name]) for name in names])
