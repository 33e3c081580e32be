"""No plan beats its bound, whatever weights the bound is taken at."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.relaxation.pools import (
    DISTINCT,
    NAMES,
    ROBUST,
    best_plan,
    criterion_of,
    even_weights,
    random_problem,
)

from elastocal.errors import InputError
from elastocal.planning.relaxation import relax
from elastocal.planning.selection import lower_bound


def tiny(name, **changes):
    defaults = {"n": 8, "r": 2, "p": 3, "shares": (2, 1), "prior": 0.02}
    return random_problem(name, **(defaults | changes))


@settings(deadline=None, max_examples=60)
@given(
    name=st.sampled_from(NAMES),
    seed=st.integers(0, 10_000),
    most=st.integers(1, 2),
    prior=st.sampled_from([1e-3, 0.1, 10.0]),
    support=st.integers(1, 8),
)
def test_the_bound_at_any_weights_is_below_the_best_of_all_plans(name, seed, most, prior, support):
    problem = tiny(name, seed=seed, most=most, prior=prior)
    rng = np.random.default_rng(seed)
    weights = np.zeros(8)
    weights[rng.permutation(8)[:support]] = rng.exponential(size=support)
    assert 0.0 < lower_bound(problem, weights) <= best_plan(problem) * (1 + 1e-12)


@pytest.mark.parametrize("robust", ROBUST)
@pytest.mark.parametrize("name", DISTINCT)
def test_the_relaxation_bounds_robust_plans_too(name, robust):
    problem = tiny(name, scenarios=2, robust=robust, seed=3)
    relaxed = relax(problem)
    best = best_plan(problem)
    assert lower_bound(problem, even_weights(problem)) <= best
    assert relaxed.bound <= relaxed.value <= best * (1 + 1e-5)
    assert relaxed.gap <= 1e-6


@pytest.mark.parametrize("name", ["O2", "O4"])
def test_no_bound_where_one_over_phi_is_not_concave(name):
    problem = replace(random_problem(), criterion=criterion_of(name, 4))
    with pytest.raises(InputError, match=name):
        lower_bound(problem, even_weights(problem))
    with pytest.raises(InputError, match=name):
        relax(problem)
