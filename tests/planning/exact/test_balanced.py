"""Other parameters, the same plans: an exchange where information is badly conditioned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planning.relaxation.pools import random_problem

from elastocal.planning import DesignProblem, relax
from elastocal.planning.criterion import Gradient, factorise, trustworthy
from elastocal.planning.exact_plan import exact_plan, repaired
from elastocal.planning.selection import balanced

# Parameters that nearly do the same, as base and markers do.
MIXED = np.ones((4, 4)) + 2e-4 * np.random.default_rng(0).standard_normal((4, 4))


def skewed(problem: DesignProblem) -> DesignProblem:
    turned = problem.criterion.turned(np.repeat(MIXED[None], len(problem.prior), axis=0))
    assert turned is not None
    prior = MIXED.T @ problem.prior @ MIXED
    return replace(problem, blocks=problem.blocks @ MIXED, prior=prior, criterion=turned)


@pytest.mark.parametrize("name", ["test_pose", "A", "G"])
def test_plans_keep_their_value_and_tangents_their_sensitivities(name: str) -> None:
    plain = random_problem(name, n=60, scenarios=2, robust="worst")
    tangent = relax(plain, tolerance=1e-3).tangent
    back = np.linalg.inv(MIXED)
    problem = skewed(plain)
    even, turned = balanced(problem, Gradient(tangent.value, back @ tangent.G @ back.T))
    assert even is not problem and turned is not None
    every = np.arange(60)
    assert not trustworthy(factorise(problem.prior + problem.sum_of(every)))
    assert trustworthy(factorise(even.prior + even.sum_of(every)))
    for seed in range(5):
        chosen = np.sort(np.random.default_rng(seed).choice(60, 20, replace=False))
        values = [
            float(some.criterion.value(some.prior + some.sum_of(chosen))) for some in (plain, even)
        ]
        assert values[0] == pytest.approx(values[1], rel=1e-5)
    d = plain.sensitivity(tangent.G)
    assert even.sensitivity(turned.G) == pytest.approx(d, abs=1e-4 * d.max())


def test_what_is_well_conditioned_or_belongs_to_its_parameters_stays() -> None:
    plain = random_problem("test_pose", n=60)
    of_parameters = replace(skewed(plain), criterion=random_problem("D", n=60).criterion)
    for problem in (plain, of_parameters):
        assert balanced(problem, None)[0] is problem


def test_a_plan_of_them_is_one_of_the_problem_as_it_was() -> None:
    plain = random_problem("test_pose", n=60)
    found, as_it_was = exact_plan(skewed(plain), starts=3), exact_plan(plain, starts=3)
    assert found.value == pytest.approx(as_it_was.value, rel=1e-4)
    assert found.chosen.tolist() == as_it_was.chosen.tolist()


def test_few_looks_still_end_where_no_exchange_of_all_betters_the_plan() -> None:
    problem = random_problem("test_pose", n=200)
    quick = exact_plan(problem, starts=2, looks=3)
    assert repaired(problem, quick.chosen).tolist() == quick.chosen.tolist()
    again = exact_plan(problem, starts=2, looks=3, found=quick.chosen)
    assert again.value <= quick.value * (1 + 1e-12)
