"""Rounding: shares and cap exactly, and no rounding loses less."""

from itertools import product

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from small_pools import random_problem

from elastocal.planning import efficient_rounding, round_weights

WEIGHTS = st.lists(st.floats(1e-3, 1.0), min_size=1, max_size=5).map(np.array)


@settings(max_examples=60, deadline=None)
@given(w=WEIGHTS, more=st.integers(0, 5))
def test_no_rounding_has_a_larger_least_ratio(w, more):
    """min ν_i/w_i against all counts that add up to n (Pukelsheim & Rieder 1992, theorem 1)."""
    k, n = len(w), len(w) + more
    counts = efficient_rounding(w, n)
    everything = np.array([c for c in product(range(n + 1), repeat=k) if sum(c) == n])
    assert counts.sum() == n
    assert (counts / w).min() >= (everything / w).min(axis=1).max() * (1 - 1e-12)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), most=st.integers(1, 3), drawn=st.booleans(), zeros=st.floats(0, 1)
)
def test_plans_have_the_shares_whatever_the_weights(seed, most, drawn, zeros):
    """Also where fewer candidates have weight than the share needs, or none has."""
    problem = random_problem("D", seed, most=most)
    rng = np.random.default_rng(seed)
    weights = rng.exponential(size=problem.n_candidates)
    weights[rng.random(len(weights)) < zeros] = 0.0
    plan = round_weights(problem, weights, rng if drawn else None)
    taken = np.bincount(problem.group[plan], minlength=len(problem.shares))
    np.testing.assert_array_equal(taken, problem.shares)
    assert np.bincount(plan).max() <= most
    np.testing.assert_array_equal(plan, np.sort(plan))
