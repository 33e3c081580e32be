"""Parts of a pool: what may enter a plan, what can still be in a better one, what is near."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from elastocal.design.problem import Array, DesignProblem, IntArray
from elastocal.planning.criterion import Gradient

# Candidates of a group that the search looks at per pose of its share, before all of them.
NEAR_PER_POSE = 50
# A better plan must be better by more than rounding: relative slack of what is ruled out.
SLACK = 1e-9


def admissible(problem: DesignProblem, rest: IntArray, label: int) -> IntArray:
    """Candidates (k,) of the group that the plan `rest` does not yet use `most` times."""
    free = problem.group == label
    used, times = np.unique(rest, return_counts=True)
    free[used[times >= problem.most]] = False
    return np.flatnonzero(free)


def without(chosen: IntArray, candidate: int) -> IntArray:
    """The sorted plan `chosen` with one pose at `candidate` less."""
    return np.delete(chosen, np.searchsorted(chosen, candidate))


def random_plan(problem: DesignProblem, rng: np.random.Generator) -> IntArray:
    """A plan (n_poses,), sorted, drawn uniformly from the places that shares and cap leave."""
    plan = [np.empty(0, dtype=np.int64)]
    for label, share in enumerate(problem.shares):
        places = np.repeat(np.flatnonzero(problem.group == label), problem.most)
        plan.append(rng.choice(places, int(share), replace=False))
    return np.sort(np.concatenate(plan))


def restrict(problem: DesignProblem, kept: IntArray) -> DesignProblem:
    """The same problem with the candidates `kept` (k,), sorted, alone."""
    if len(kept) == problem.n_candidates:
        return problem
    return replace(problem, blocks=problem.blocks[:, kept], group=problem.group[kept])


@dataclass(frozen=True)
class Prices:
    """First-order prices d (N,) of the candidates, −∂Φ/∂w_i at a tangent, and what they exclude.

    1/Φ is concave and of degree 1, so that its tangent (Φ, G) lies above it: every plan has
    1/Φ(plan) ≤ (⟨G, prior⟩ + Σ_i plan_i d_i)/Φ².  `upper` (N,) is the largest right side over the
    plans that contain i; inf where Φ is not certifiable.
    """

    d: Array
    upper: Array

    @classmethod
    def of(cls, problem: DesignProblem, tangent: Gradient) -> Prices:
        """Prices by the tangent (Φ, G) of Φ, or of any information function below it."""
        d = problem.sensitivity(tangent.G)
        if not problem.criterion.certifiable:
            return cls(d, np.full(len(d), np.inf))
        best, lost = float((tangent.G * problem.prior).sum()), np.full(len(d), np.inf)
        for label in np.flatnonzero(problem.shares):
            members = np.flatnonzero(problem.group == label)
            dearest = np.sort(np.repeat(d[members], problem.most))[-problem.shares[label] :]
            best += dearest.sum()
            lost[members] = np.maximum(dearest[0] - d[members], 0.0)
        return cls(d, (best - lost) / tangent.value**2)

    def may_better(self, value: float) -> IntArray:
        """Candidates that a plan with Φ < `value` can contain; the others are ruled out.

        Harman & Pronzato (2007, Statistics & Probability Letters 77, 90–94) drop what no relaxed
        optimum contains; against a known plan such an inequality drops what no better plan does.
        """
        return np.flatnonzero(self.upper > (1 - SLACK) / value)

    def near(self, problem: DesignProblem) -> IntArray:
        """The dearest candidates of every group, NEAR_PER_POSE for each pose of its share.

        The K of the KL exchange (Atkinson & Donev 1989, Applied Statistics 38, 515–526).
        """
        kept = [np.empty(0, dtype=np.int64)]
        for label, share in enumerate(problem.shares):
            members = np.flatnonzero(problem.group == label)
            order = np.argsort(-self.d[members], kind="stable")
            kept.append(members[order[: NEAR_PER_POSE * share]])
        return np.sort(np.concatenate(kept))
