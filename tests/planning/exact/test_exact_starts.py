"""Starts: the same plan for the same seed, whatever the order, the processes, the interruption."""

from dataclasses import replace

import numpy as np
import pytest
from small_pools import random_problem

from elastocal.errors import InputError, InsufficientDataError
from elastocal.planning.criteria import make_criterion
from elastocal.planning.exact_plan import exact_plan
from elastocal.planning.selection import DesignProblem, regular_plan


def rough(seed: int = 0) -> DesignProblem:
    """A pool in whose local optima starts end that differ."""
    rng = np.random.default_rng(seed)
    criterion = make_criterion("E", parameters=7, interest=np.arange(7))
    blocks = rng.normal(size=(1, 30, 2, 7))
    group = np.arange(30) % 3
    return DesignProblem(blocks, np.zeros((1, 7, 7)), group, np.array([3, 3, 3]), criterion)


def test_fewer_equations_than_parameters_says_how_many():
    problem = random_problem("D", 0)
    p = 20
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(1, problem.n_candidates, 3, p))
    criterion = make_criterion("D", parameters=p, interest=np.arange(p))
    problem = replace(
        problem, blocks=blocks, prior=np.zeros((1, p, p)), criterion=criterion,
        group=np.zeros(problem.n_candidates, dtype=int), shares=np.array([5]),
    )  # fmt: skip
    with pytest.raises(InsufficientDataError, match=r"5 poses of 3 readings give 15, for 20 .* 7"):
        exact_plan(problem)
    rest = rng.normal(size=(5, p))
    known = replace(problem, prior=(rest.T @ rest)[None])
    assert np.isfinite(exact_plan(known, starts=2).value)


@pytest.mark.parametrize("large", [1.0, 1e3])
def test_a_regular_plan_is_found_where_no_exchange_leads_to_it(large):
    """Ten candidates span e1 and a direction of (e3, e4) each; only the last two make rank 4
    together.  Neither adds rank to any of the ten, nor as much volume as one of the ten."""
    blocks = np.zeros((1, 12, 2, 4))
    for k in range(10):
        blocks[0, k, 0, 0] = large
        angle = np.pi * (k + 0.5) / 10
        blocks[0, k, 1, 2:] = large * np.cos(angle), large * np.sin(angle)
    blocks[0, 10] = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.1, 0.8, 0.6]]
    blocks[0, 11] = [[0.0, 0.0, 1.0, 0.0], [0.3, 0.0, 0.0, 1.0]]
    criterion = make_criterion("D", parameters=4, interest=np.arange(4))
    problem = DesignProblem(
        blocks, np.zeros((1, 4, 4)), np.zeros(12, dtype=int), np.array([2]), criterion
    )
    for seed in range(3):
        rng = np.random.default_rng(seed)
        np.testing.assert_array_equal(regular_plan(problem, np.array([2, 7]), rng), [10, 11])
        np.testing.assert_array_equal(exact_plan(problem, starts=2, seed=seed).chosen, [10, 11])


def test_too_few_poses_for_any_regular_plan_say_so():
    """Enough equations in number, but two poses of a kind see only two of four parameters each."""
    blocks = np.zeros((1, 12, 3, 6))
    for i in range(12):
        blocks[0, i, :2, 2 * (i % 3) : 2 * (i % 3) + 2] = np.eye(2)
    criterion = make_criterion("D", parameters=6, interest=np.arange(6))
    problem = DesignProblem(
        blocks, np.zeros((1, 6, 6)), np.zeros(12, dtype=int), np.array([2]), criterion
    )
    with pytest.raises(InsufficientDataError, match="no plan of 2 poses that determines all 6"):
        exact_plan(problem)


@pytest.mark.parametrize(
    ("options", "named"),
    [({"starts": 0}, "start"), ({"jobs": 0}, "jobs"), ({"relaxed_weights": np.ones(3)}, r"\(3,\)")],
)
def test_wrong_options_are_named(options, named):
    with pytest.raises(InputError, match=named):
        exact_plan(rough(), **options)
