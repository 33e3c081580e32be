"""Random small pools whose best plan is known, because every plan is evaluated."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np

from elastocal.planning.criteria import CriterionInputs, criterion_named
from elastocal.planning.relaxation import DesignProblem
from elastocal.units import Array, IntArray

CRITERIA = ("test_pose", "D", "E")
ROWS = 3


def random_problem(name: str, seed: int, *, prior: float = 0.0) -> DesignProblem:
    """4 to 6 poses out of 10 to 16 candidates in 1 to 3 groups, for 4 to 9 parameters.

    Three readings per pose, normal B; shares
    are drawn and may be 0.  `prior` > 0: what poses already measured tell, of that weight.
    """
    rng = np.random.default_rng([seed, CRITERIA.index(name)])
    N, n = int(rng.integers(10, 17)), int(rng.integers(4, 7))
    L, p = int(rng.integers(1, 4)), int(rng.integers(4, 10))
    group, shares = np.zeros(N, dtype=np.int64), np.full(1, N + 1)
    while (np.bincount(group, minlength=L) < shares).any():
        group, shares = rng.integers(0, L, N), rng.multinomial(n, np.ones(L) / L)
    blocks = rng.normal(size=(N, ROWS, p))
    targets = rng.normal(size=(8, ROWS, p))
    done = np.sqrt(prior) * rng.normal(size=(2 * ROWS, p))
    criterion = criterion_named(name).of(CriterionInputs(name, p, np.arange(p), targets))
    return DesignProblem(blocks, done.T @ done, group, shares, criterion)


def all_plans(problem: DesignProblem) -> IntArray:
    """Every plan (k, n_poses) of these shares."""
    parts = [
        list(combinations(np.flatnonzero(problem.group == g), share))
        for g, share in enumerate(problem.shares)
    ]
    return np.array([sum(plan, ()) for plan in product(*parts)], dtype=np.int64)


def all_values(problem: DesignProblem, plans: IntArray) -> Array:
    """Φ (k,) of the plans (k, n_poses), straight from the definition of M."""
    each = np.einsum("nri,nrj->nij", problem.blocks, problem.blocks)
    return problem.criterion.of_information(problem.prior + each[plans].sum(axis=1))
