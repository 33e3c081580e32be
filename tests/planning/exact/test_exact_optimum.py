"""Exact plans against every plan there is, and against every single exchange."""

from dataclasses import replace

import numpy as np
import pytest
from small_pools import CRITERIA, all_plans, all_values, random_problem

from elastocal.planning.criteria import make_criterion
from elastocal.planning.exact_plan import exact_plan
from elastocal.planning.relaxation import relax
from elastocal.planning.selection import DesignProblem


def is_optimal(problem: DesignProblem, seed: int, **options) -> bool:
    found = exact_plan(problem, seed=seed, **options)
    best = all_values(problem, all_plans(problem)).min()
    assert found.value >= best * (1 - 1e-9), "a value below the optimum is no plan's"
    return found.value <= best * (1 + 1e-9)


@pytest.mark.parametrize("name", CRITERIA)
def test_the_optimum_is_found(name):
    assert all(is_optimal(random_problem(name, seed), seed, starts=2) for seed in range(12))


@pytest.mark.long
@pytest.mark.parametrize("name", CRITERIA)
def test_the_optimum_is_found_in_100_of_100(name):
    assert sum(is_optimal(random_problem(name, seed), seed) for seed in range(100)) == 100


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize(("most", "prior"), [(2, 0.0), (1, 1.0)])
def test_the_optimum_is_found_with_repeats_and_with_measurements_done(name, most, prior):
    for seed in range(100, 103):
        problem = random_problem(name, seed, most=most, prior=prior)
        assert is_optimal(problem, seed, starts=3)


@pytest.mark.parametrize("robust", ["average", "worst"])
def test_scenarios_of_the_arm_count_as_the_criterion_says(robust):
    for seed in range(3):
        one = random_problem("test_pose", seed)
        rng = np.random.default_rng(seed)
        blocks = one.blocks + 0.3 * rng.normal(size=(3, *one.blocks.shape[1:]))
        p = blocks.shape[-1]
        targets = rng.normal(size=(3, 4, 3, p))
        criterion = make_criterion(
            "test_pose", parameters=p, interest=np.arange(p), A=targets, scenarios=3, robust=robust
        )
        prior = np.zeros((3, p, p))
        assert is_optimal(
            replace(one, blocks=blocks, prior=prior, criterion=criterion), seed, starts=3
        )


def medium(name: str, seed: int, most: int = 1, prior: float = 0.0) -> DesignProblem:
    """8 of 150 candidates in two groups, 6 parameters, each known with information `prior`."""
    rng = np.random.default_rng(seed)
    criterion = make_criterion(
        name, parameters=6, interest=np.arange(6), A=rng.normal(size=(1, 5, 3, 6))
    )
    blocks = rng.normal(size=(1, 150, 3, 6))
    group = np.arange(150) % 2
    known = prior * np.eye(6)[None]
    return DesignProblem(blocks, known, group, np.array([5, 3]), criterion, most)


def neighbours(problem: DesignProblem, chosen) -> np.ndarray:
    """All plans that differ from `chosen` by one exchange within its group."""
    found = []
    for k, out in enumerate(chosen):
        for into in np.flatnonzero(problem.group == problem.group[out]):
            plan = np.sort(np.append(np.delete(chosen, k), into))
            if into != out and (plan == into).sum() <= problem.most:
                found.append(plan)
    assert len(found) > 500
    return np.array(found)


@pytest.mark.parametrize("most", [1, 2])
@pytest.mark.parametrize(
    ("name", "weights"),
    [*((name, r) for name in CRITERIA for r in ("none", "relaxed", "misleading")), ("O2", "none")],
)
def test_no_single_exchange_on_the_whole_pool_betters_the_plan(name, most, weights, monkeypatch):
    """With few near candidates, so that most of the pool is seen by the last passes alone."""
    monkeypatch.setattr("elastocal.planning.exact_plan.NEAR_PER_POSE", 2)
    problem = medium(name, 1, most)
    given = {
        "none": lambda: None,
        "relaxed": lambda: relax(problem).weights,
        "misleading": lambda: np.random.default_rng(0).random(problem.n_candidates) ** 9,
    }[weights]()
    found = exact_plan(problem, relaxed_weights=given, starts=1, seed=1)
    taken = np.bincount(problem.group[found.chosen], minlength=2)
    np.testing.assert_array_equal(taken, problem.shares)
    assert np.bincount(found.chosen).max() <= most
    assert all_values(problem, found.chosen[None])[0] == pytest.approx(found.value, rel=1e-12)
    values = all_values(problem, neighbours(problem, found.chosen))
    assert values.min() >= found.value * (1 - 2e-9)
    assert found.values[0] == pytest.approx(found.value, rel=1e-9), "a start ends at an optimum"


@pytest.mark.parametrize("name", CRITERIA)
def test_the_value_lies_above_the_certified_bound(name):
    problem = medium(name, 2)
    relaxed = relax(problem)
    found = exact_plan(
        problem, relaxed_weights=relaxed.weights, tangent=relaxed.tangent, starts=2, seed=0
    )
    assert relaxed.bound <= found.value <= 1.3 * relaxed.bound
