"""Tours and bounds against brute force over all permutations."""

from itertools import permutations

import numpy as np
import pytest

from elastocal.planning.execution import greedy_tour, shortest_tour, tour_bound, tour_cost


def costs(seed, n, symmetric):
    rng = np.random.default_rng(seed)
    if symmetric:
        q = rng.uniform(-2, 2, (n, 4))
        return np.abs(q[:, None] - q[None]).max(axis=2)
    cost = rng.uniform(0.5, 2.0, (n, n))
    np.fill_diagonal(cost, 0.0)
    return cost


def best(cost):
    return min(tour_cost(cost, list(p)) for p in permutations(range(1, len(cost))))


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("n", [2, 3, 4, 6, 8])
def test_the_tour_is_the_best_of_all_permutations_and_the_bound_is_below_it(n, symmetric):
    for seed in range(4):
        cost = costs(seed, n, symmetric)
        tour = shortest_tour(cost, greedy_tour(cost), seed=0, iterations=500)
        assert sorted(tour) == list(range(1, n))
        assert tour_cost(cost, tour) == pytest.approx(best(cost), rel=1e-9)
        bound = tour_bound(cost, tour_cost(cost, tour))
        assert 0 < bound <= best(cost) * (1 + 1e-9)


def test_the_bound_is_within_two_per_cent_of_the_tour_through_forty_points():
    cost = costs(11, 40, True)
    tour = shortest_tour(cost, greedy_tour(cost), seed=0, iterations=2000)
    bound = tour_bound(cost, tour_cost(cost, tour))
    assert 0.98 < bound / tour_cost(cost, tour) <= 1.0
