"""Other parameters, the same plans: an exchange where information is badly conditioned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planning.relaxation.pools import random_problem

from elastocal.planning import DesignProblem, relax
from elastocal.planning.criterion import factorise, trustworthy
from elastocal.planning.exact_plan import exact_plan, repaired
from elastocal.planning.selection import balanced


def skewed(name: str = "test_pose", scenarios: int = 1) -> DesignProblem:
    """A problem whose parameters nearly do the same, as base and markers do."""
    problem = random_problem(name, n=60, scenarios=scenarios)
    p = problem.blocks.shape[-1]
    rng = np.random.default_rng(0)
    mixed = np.ones((p, p)) + 1e-4 * rng.standard_normal((p, p))
    turned = problem.criterion.turned(np.repeat(mixed[None], scenarios, axis=0))
    assert turned is not None
    prior = mixed.T @ problem.prior @ mixed
    return replace(problem, blocks=problem.blocks @ mixed, prior=prior, criterion=turned)


@pytest.mark.parametrize("name", ["test_pose", "A", "G"])
def test_plans_keep_their_value_and_tangents_their_bound(name: str) -> None:
    problem = skewed(name, scenarios=2)
    relaxed = relax(problem, tolerance=1e-3)
    even, tangent = balanced(problem, relaxed.tangent)
    assert even is not problem and tangent is not None
    whole = np.arange(problem.n_candidates)
    assert not trustworthy(factorise(problem.prior + problem.sum_of(whole)))
    assert trustworthy(factorise(even.prior + even.sum_of(whole)))
    for seed in range(5):
        chosen = np.sort(np.random.default_rng(seed).choice(60, problem.n_poses + 20, False))
        values = [
            float(some.criterion.value(some.prior + some.sum_of(chosen)))
            for some in (problem, even)
        ]
        assert values[0] == pytest.approx(values[1], rel=1e-5)
    assert even.sensitivity(tangent.G) == pytest.approx(
        problem.sensitivity(relaxed.tangent.G), rel=1e-5
    )


def test_what_is_well_conditioned_or_belongs_to_its_parameters_stays() -> None:
    plain = random_problem("test_pose", n=60)
    for problem in (plain, replace(skewed(), criterion=random_problem("D", n=60).criterion)):
        assert balanced(problem, None)[0] is problem


def test_a_plan_of_them_is_one_of_the_problem_as_it_was() -> None:
    problem = skewed()
    plain = random_problem("test_pose", n=60)
    found, as_it_was = exact_plan(problem, starts=3), exact_plan(plain, starts=3)
    assert found.value == pytest.approx(as_it_was.value, rel=1e-4)


def test_few_looks_still_end_where_no_exchange_of_all_betters_the_plan() -> None:
    problem = random_problem("test_pose", n=200)
    quick = exact_plan(problem, starts=2, looks=3)
    assert repaired(problem, quick.chosen).tolist() == quick.chosen.tolist()
    again = exact_plan(problem, starts=2, looks=3, found=quick.chosen)
    assert again.value <= quick.value * (1 + 1e-12)
