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
from elastocal.planning import efficiency, largest_sum, lower_bound, relax


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


@settings(deadline=None, max_examples=40)
@given(name=st.sampled_from([n for n in NAMES if n not in "E O3"]), seed=st.integers(0, 10_000))
def test_the_relaxed_optimum_lies_between_bound_and_best_plan(name, seed):
    problem = tiny(name, seed=seed, most=1 + seed % 2)
    relaxed = relax(problem)
    assert relaxed.bound <= best_plan(problem) * (1 + 1e-12)
    assert relaxed.gap <= 1e-5
    assert relaxed.value * (1 - relaxed.gap) == pytest.approx(relaxed.bound, rel=1e-12)


def test_the_bound_is_one_of_plans_of_different_poses():
    """A pose measured twice may be worth more, which the bound does not deny: it is said."""
    problem = tiny("test_pose", seed=2)
    bound = relax(problem).bound
    assert best_plan(replace(problem, most=2)) < bound <= best_plan(problem)
    assert relax(replace(problem, most=2)).bound <= best_plan(replace(problem, most=2))


def test_without_prior_and_box_it_is_the_published_bound():
    problem = random_problem("test_pose", shares=(3, 2), most=3)
    w = even_weights(problem)
    gradient = problem.criterion.gradient(problem.information(w))
    d = problem.sensitivity(gradient.G)
    of_levels = 3 * d[problem.group == 0].max() + 2 * d[problem.group == 1].max()
    assert lower_bound(problem, w) == pytest.approx(gradient.value**2 / of_levels, rel=1e-12)


def test_the_bound_is_that_of_the_gap_formula():
    problem = random_problem("D", shares=(3, 2), prior=0.3)
    w = even_weights(problem)
    gradient = problem.criterion.gradient(problem.information(w))
    d = problem.sensitivity(gradient.G)
    gap = np.sort(d[::2])[-3:].sum() + np.sort(d[1::2])[-2:].sum() - w @ d
    expected = gradient.value / (1 + gap / gradient.value)
    assert lower_bound(problem, w) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", DISTINCT)
def test_the_box_tightens_the_bound(name):
    problem = random_problem(name, n=20, shares=(6, 4))
    free = replace(problem, most=10)
    w = even_weights(problem)
    assert lower_bound(problem, w) > 1.01 * lower_bound(free, w)
    assert relax(problem).bound > 1.01 * relax(free).bound


@given(
    d=st.lists(st.integers(0, 50), min_size=6, max_size=6),
    shares=st.tuples(st.integers(0, 6), st.integers(0, 6)),
    most=st.integers(2, 3),
)
def test_largest_sum_is_the_best_of_all_vertices(d, shares, most):
    d, group = np.array(d, dtype=float), np.array([0, 0, 0, 1, 1, 1])
    counts = np.stack(np.meshgrid(*[np.arange(most + 1)] * 3), -1).reshape(-1, 3)
    expected = sum(
        (counts[counts.sum(1) == share] @ d[group == level]).max()
        for level, share in enumerate(shares)
    )
    assert largest_sum(d, group, np.array(shares), most) == pytest.approx(expected)


def test_singular_weights_bound_nothing():
    problem = random_problem("A", r=1, p=4)
    weights = np.zeros(60)
    weights[0] = 5.0
    assert lower_bound(problem, weights) == 0.0


@pytest.mark.parametrize("name", ["O2", "O4"])
def test_no_bound_where_one_over_phi_is_not_concave(name):
    problem = replace(random_problem(), criterion=criterion_of(name, 4))
    with pytest.raises(InputError, match=name):
        lower_bound(problem, even_weights(problem))
    with pytest.raises(InputError, match=name):
        relax(problem)


def test_efficiency_never_exceeds_one():
    assert efficiency(2.0, 1.5) == 0.75
    assert efficiency(1.0, 1.0 + 1e-12) == 1.0
