"""What a plan is worth without each of its poses."""

from __future__ import annotations

import numpy as np

from elastocal.design.problem import Array, DesignProblem, IntArray


def information_without(problem: DesignProblem, chosen: IntArray) -> Array:
    """M (n, S, p, p) of the plan `chosen` (n,) without its k-th pose, for every k.

    Sums of what comes before and after k: no subtraction, so that a pose that alone determines a
    parameter leaves an exactly singular M.
    """
    B = problem.blocks[:, chosen]
    each = np.einsum("snri,snrj->nsij", B, B, optimize=True)
    before, after = np.zeros_like(each), np.zeros_like(each)
    before[1:] = np.cumsum(each[:-1], axis=0)
    after[:-1] = np.cumsum(each[:0:-1], axis=0)[::-1]
    return np.asarray(problem.prior + before + after)


def values_without(problem: DesignProblem, chosen: IntArray) -> Array:
    """Φ (n,) of the plan `chosen` (n,) without its k-th pose; inf where nothing replaces it."""
    return problem.criterion.value(information_without(problem, chosen))
