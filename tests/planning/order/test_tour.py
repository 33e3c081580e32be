"""Tours against brute force over all permutations."""

from itertools import permutations

import numpy as np
import pytest

from elastocal.planning.execution import greedy_tour, shortest_tour, tour_cost


def costs(seed, n, symmetric):
    rng = np.random.default_rng(seed)
    if symmetric:
        q = rng.uniform(-2, 2, (n, 4))
        return np.abs(q[:, None] - q[None]).max(axis=2)
    cost = rng.uniform(0.5, 2.0, (n, n))
    np.fill_diagonal(cost, 0.0)
    return cost


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("n", [2, 3, 4, 6, 8])
def test_the_tour_is_the_best_of_all_permutations(n, symmetric):
    for seed in range(4):
        cost = costs(seed, n, symmetric)
        tour = shortest_tour(cost, greedy_tour(cost), seed=0, kicks=100)
        assert sorted(tour) == list(range(1, n))
        best = min(tour_cost(cost, list(p)) for p in permutations(range(1, n)))
        assert tour_cost(cost, tour) == pytest.approx(best, rel=1e-9)


def test_more_kicks_and_a_better_start_never_make_a_tour_longer():
    cost = costs(11, 40, True)
    greedy = greedy_tour(cost)
    few = shortest_tour(cost, greedy, seed=0, kicks=5)
    many = shortest_tour(cost, few, seed=0, kicks=200)
    assert tour_cost(cost, many) <= tour_cost(cost, few) < tour_cost(cost, greedy)
