"""What the rules say of a batch of candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Verdict:
    """`broken` (N, R): candidate i breaks rule r, whatever the others; `rules` (R) their names
    in the order of checking; `q` (N, n) and `force` (N, 3) the candidates themselves."""

    rules: tuple[str, ...]
    broken: BoolArray
    q: Array
    force: Array

    @property
    def ok(self) -> BoolArray:
        """(N,): breaks no rule."""
        return np.asarray(~self.broken.any(axis=1))

    @property
    def removed_by(self) -> dict[str, int]:
        """Candidates by the first rule they break: tried = feasible + Σ removed_by."""
        first = self.broken & (self.broken.cumsum(axis=1) == 1)
        return self._counts(first)

    @property
    def alone(self) -> dict[str, int]:
        """Candidates that break each rule, whatever the others: its toll if it stood alone."""
        return self._counts(self.broken)

    @property
    def freed(self) -> dict[str, int]:
        """Candidates that break this rule and no other: what dropping it would free."""
        return self._counts(self.broken & (self.broken.sum(axis=1) == 1)[:, None])

    def _counts(self, mask: BoolArray) -> dict[str, int]:
        return {rule: int(n) for rule, n in zip(self.rules, mask.sum(axis=0), strict=True)}

    @classmethod
    def join(cls, verdicts: Sequence[Verdict]) -> Verdict:
        """Several batches under the same rules as one."""
        return cls(
            verdicts[0].rules,
            np.concatenate([v.broken for v in verdicts]),
            np.concatenate([v.q for v in verdicts]),
            np.concatenate([v.force for v in verdicts]),
        )
