"""What is ruled out is in no better plan; what a plan loses without a pose."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_pools import CRITERIA, all_plans, all_values, random_problem

from elastocal.planning import (
    Prices,
    best_addition,
    fitted,
    greedy_plan,
    information_without,
    relax,
    values_without,
)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    name=st.sampled_from(CRITERIA),
    most=st.integers(1, 2),
    prior=st.sampled_from([0.0, 0.3]),
    at=st.sampled_from(["relaxed", "anywhere", "soft"]),
)
def test_bounds_hold_for_every_plan_and_every_candidate_in_it(seed, name, most, prior, at):
    problem = random_problem(name, seed, most=most, prior=prior)
    if at == "relaxed":
        tangent = relax(problem).tangent
    else:
        w = np.random.default_rng(seed).exponential(size=problem.n_candidates)
        criterion = problem.criterion.softened(20.0) if at == "soft" else problem.criterion
        tangent = criterion.gradient(problem.information(w))
    plans = all_plans(problem)
    values = all_values(problem, plans)
    prices = Prices.of(problem, tangent)
    for i in range(problem.n_candidates):
        with_i = (plans == i).any(axis=1)
        if with_i.any():
            assert 1 / values[with_i].min() <= prices.upper[i] * (1 + 1e-9)
    limit = float(np.quantile(values, 0.05))
    better = np.unique(plans[values < limit])
    assert np.isin(better, prices.may_better(limit)).all()


def test_something_is_ruled_out():
    problem = random_problem("test_pose", 0)
    best = all_values(problem, all_plans(problem)).min()
    assert len(Prices.of(problem, relax(problem).tangent).may_better(best)) < problem.n_candidates


@pytest.mark.parametrize("prior", [1.0, 1000.0])
@pytest.mark.parametrize("name", CRITERIA)
def test_the_best_addition_is_that_of_trying_all(name, prior, monkeypatch):
    """With one candidate evaluated at first, so that the bound decides when to stop; with much
    known before Φ is nearly linear and the bound is close."""
    monkeypatch.setattr("elastocal.planning.selection.FIRST", 1)
    for seed in range(20):
        problem = random_problem(name, seed)
        problem = replace(problem, prior=prior * np.eye(problem.blocks.shape[-1])[None])
        candidates = np.arange(problem.n_candidates)
        M = problem.prior + problem.sum_of(candidates[:6])
        values = [
            float(problem.criterion.value(M + problem.sum_of(np.array([i])))) for i in candidates
        ]
        assert best_addition(problem, M, candidates) == int(np.argmin(values))
        assert best_addition(problem, M, candidates, min(values) * (1 - 1e-7)) is None


@pytest.mark.parametrize("name", CRITERIA)
def test_values_without_each_pose_are_those_of_the_smaller_plans(name):
    problem = random_problem(name, 1, most=2, prior=0.5)
    plan = all_plans(problem)[-1]
    smaller = np.array([np.delete(plan, k) for k in range(len(plan))])
    expected = all_values(problem, smaller)
    np.testing.assert_allclose(values_without(problem, plan), expected, rtol=1e-9)


def test_a_pose_that_nothing_replaces_is_worth_everything():
    problem = random_problem("D", 0)
    p = problem.blocks.shape[-1]
    blocks = problem.blocks.copy()
    blocks[..., -1] = 0.0
    blocks[:, 0, 0, -1] = 1e-3
    plan = np.arange(6)
    problem = replace(problem, blocks=blocks, group=0 * problem.group, shares=np.array([6]))
    values = values_without(problem, plan)
    assert values[0] == np.inf and np.isfinite(values[1:]).all()
    assert (information_without(problem, plan)[0, 0, p - 1] == 0).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), more=st.integers(0, 3))
def test_an_extended_plan_is_not_worse_and_has_the_shares(seed, more):
    problem = random_problem("test_pose", seed, most=2, prior=1.0)
    plan = greedy_plan(problem)
    size = np.bincount(problem.group, minlength=len(problem.shares)) * 2
    larger = replace(problem, shares=np.minimum(problem.shares + more, size))
    extended = fitted(larger, plan)
    cut = fitted(problem, extended)
    for stated, found in ((larger, extended), (problem, cut)):
        taken = np.bincount(stated.group[found], minlength=len(stated.shares))
        np.testing.assert_array_equal(taken, stated.shares)
        assert np.bincount(found).max() <= 2
    before, after = (all_values(problem, c[None])[0] for c in (plan, extended))
    assert after <= before * (1 + 1e-12)


def test_a_plan_is_cut_where_it_is_missed_least():
    problem = random_problem("D", 4, prior=1.0)
    plan = greedy_plan(problem)
    for label in np.flatnonzero(problem.shares):
        shares = problem.shares.copy()
        shares[label] -= 1
        cut = fitted(replace(problem, shares=shares), plan)
        of_group = problem.group[plan] == label
        least = values_without(problem, plan)[of_group].min()
        assert all_values(problem, cut[None])[0] == pytest.approx(least, rel=1e-9)
