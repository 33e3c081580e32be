"""What a plan is compared with: plans of the same shares that chance draws from the same poses."""

from itertools import combinations

import numpy as np
import pytest

from elastocal.planning import DesignProblem, make_criterion
from elastocal.planning.exact_plan import random_information

P, R = 4, 2  # parameters, rows of a pose


def problem(shares=(3, 2), each=5, seed=0, name="D", prior=0.0) -> DesignProblem:
    n = each * len(shares)
    blocks = np.random.default_rng(seed).normal(size=(1, n, R, P))
    criterion = make_criterion(name, parameters=P, interest=np.arange(P))
    group = np.arange(n) // each
    return DesignProblem(blocks, prior * np.eye(P)[None], group, np.array(shares), criterion)


def random_plans(of: DesignProblem, seed: int, n: int = 20) -> np.ndarray:
    """Φ (n,), ascending; inf for a plan that leaves a parameter open."""
    return np.sort(np.asarray(of.criterion.value(random_information(of, seed, n))))


def every_value(of: DesignProblem) -> np.ndarray:
    """Φ of every plan of these shares, by enumeration."""
    first, second = (np.flatnonzero(of.group == k) for k in range(2))
    return np.array([
        float(of.criterion.value(of.prior + of.sum_of(np.array([*a, *b]))))
        for a in combinations(first, int(of.shares[0]))
        for b in combinations(second, int(of.shares[1]))
    ])  # fmt: skip


@pytest.mark.parametrize("name", ["D", "A", "E", "O3"])
def test_each_is_a_plan_of_these_shares_drawn_without_preference(name: str) -> None:
    of = problem(name=name)
    every = np.sort(every_value(of))
    found = random_plans(of, seed=1, n=400)
    gap = np.abs(found[:, None] - every[None]).min(axis=1)
    assert (gap <= 1e-9 * found).all()
    assert (np.diff(found) >= 0).all()
    # The share of draws below the true median is binomial: 400 draws, 5 standard deviations.
    below = int((found <= np.median(every)).sum())
    assert abs(below - 200) < 50
