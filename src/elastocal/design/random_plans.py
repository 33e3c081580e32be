"""What chance would have given: the criterion of plans drawn from the same feasible poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.design.problem import DesignProblem
from elastocal.planning.exchange import random_plan

Array = NDArray[np.float64]

DRAWN = 20
STREAM = 10_000  # of the seed's children, beyond those that draw candidates and begin searches


@dataclass(frozen=True)
class RandomPlans:
    """`values` Φ (n,) of random plans, ascending; inf for one that leaves a parameter open."""

    values: Array

    @property
    def determined(self) -> int:
        """How many of the plans determine every parameter that the criterion needs."""
        return int(np.isfinite(self.values).sum())

    @property
    def median(self) -> float:
        """Φ of the median plan; inf where half of them leave a parameter open."""
        return float(np.median(self.values))

    def efficiency(self, value: float) -> float | None:
        """Φ = `value` of a plan over that of the median random plan, None where that is infinite.

        Φ is homogeneous of degree −1 in the number of readings: without prior knowledge the random
        plan needs 1/efficiency times as many to be worth as much.
        """
        return value / self.median if np.isfinite(self.median) else None


def random_plans(problem: DesignProblem, seed: int, n: int = DRAWN) -> RandomPlans:
    """Φ of `n` plans drawn uniformly from the candidates of `problem`, with its shares."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))
    M = np.stack([problem.prior + problem.sum_of(random_plan(problem, rng)) for _ in range(n)])
    return RandomPlans(np.sort(np.asarray(problem.criterion.value(M), dtype=np.float64)))
