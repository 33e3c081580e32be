"""Tours and bounds against brute force over all permutations."""

from itertools import permutations

import numpy as np
import pytest

from elastocal.planning import greedy_tour, held_karp_bound, shortest_tour, tour_bound, tour_cost


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


def test_a_poor_tour_to_start_from_and_a_loose_upper_value_do_not_spoil_the_bound():
    cost = costs(3, 8, True)
    assert held_karp_bound(cost, 3 * best(cost)) <= best(cost) * (1 + 1e-9)


def test_the_bound_is_within_two_per_cent_of_the_tour_through_forty_points():
    cost = costs(11, 40, True)
    tour = shortest_tour(cost, greedy_tour(cost), seed=0, iterations=2000)
    bound = tour_bound(cost, tour_cost(cost, tour))
    assert 0.98 < bound / tour_cost(cost, tour) <= 1.0


def test_the_tour_is_never_worse_than_the_one_to_start_from():
    cost = costs(5, 30, True)
    start = shortest_tour(cost, greedy_tour(cost), seed=1, iterations=2000)
    again = shortest_tour(cost, start, seed=2, iterations=1)
    assert tour_cost(cost, again) <= tour_cost(cost, start)


def test_the_same_seed_gives_the_same_tour():
    cost = costs(6, 25, False)
    tours = [shortest_tour(cost, greedy_tour(cost), seed=9, iterations=200) for _ in range(2)]
    assert tours[0] == tours[1]
