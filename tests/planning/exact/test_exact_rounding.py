"""Rounding: shares and cap exactly, and no rounding loses less."""

from itertools import product

import numpy as np
import pytest
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
@given(w=WEIGHTS, most=st.integers(1, 4), part=st.floats(0, 1))
def test_the_cap_holds_and_a_heavier_candidate_never_gets_less(w, most, part):
    n = len(w) + round(part * len(w) * (most - 1))
    counts = efficient_rounding(w, n, most)
    assert counts.sum() == n and counts.min() >= 1 and counts.max() <= most
    by_weight = counts[np.argsort(w, kind="stable")]
    different = np.diff(np.sort(w)) > 1e-9
    assert (np.diff(by_weight)[different] >= 0).all()


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


def test_weights_of_a_plan_give_that_plan():
    problem = random_problem("D", 3, most=2)
    plan = round_weights(problem, np.random.default_rng(0).random(problem.n_candidates))
    weights = np.bincount(plan, minlength=problem.n_candidates).astype(float)
    np.testing.assert_array_equal(round_weights(problem, weights), plan)


def test_drawn_starts_follow_the_weights():
    """One pose out of the group of share 1: the frequency is w_i, within five deviations."""
    problem = next(
        p
        for p in (random_problem("D", seed) for seed in range(100))
        if len(p.shares) > 1 and 1 in p.shares
    )
    label = int(np.flatnonzero(problem.shares == 1)[0])
    members = np.flatnonzero(problem.group == label)
    rng = np.random.default_rng(1)
    weights = rng.exponential(size=problem.n_candidates) + 0.1
    n = 3000
    drawn = [round_weights(problem, weights, rng) for _ in range(n)]
    counts = np.bincount(np.concatenate(drawn), minlength=problem.n_candidates)[members]
    p = weights[members] / weights[members].sum()
    assert (np.abs(counts - n * p) < 5 * np.sqrt(n * p * (1 - p)) + 1e-9).all()


@pytest.mark.parametrize("drawn", [False, True])
def test_the_heaviest_are_kept_where_the_share_is_smaller_than_the_support(drawn):
    problem = random_problem("D", 0)
    weights = np.full(problem.n_candidates, 1e-12)
    heavy = round_weights(problem, np.random.default_rng(2).random(problem.n_candidates))
    weights[heavy] = 1.0
    rng = np.random.default_rng(3) if drawn else None
    np.testing.assert_array_equal(round_weights(problem, weights, rng), heavy)
