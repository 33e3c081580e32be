"""The shortest tour through given costs, by PyVRP's iterated local search."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LARGEST = 2**40  # of a cost as an integer: PyVRP warns beyond 2⁴⁴


def tour_cost(cost: Array, tour: list[int]) -> float:
    """Cost of depot 0 → tour → depot 0 under `cost` (V + 1, V + 1)."""
    ring = [0, *tour, 0]
    return float(cost[ring[:-1], ring[1:]].sum())


def greedy_tour(cost: Array) -> list[int]:
    """From the depot 0 always on to the nearest node not yet visited."""
    left = cost.copy()
    left[:, 0] = np.inf
    tour, here = [], 0
    for _ in range(len(cost) - 1):
        nearest = int(np.argmin(left[here]))
        left[:, nearest] = np.inf
        tour.append(nearest)
        here = nearest
    return tour


def shortest_tour(cost: Array, start: list[int], seed: int, iterations: int) -> list[int]:
    """A short tour 0 → every node → 0, never worse than `start` (Wouda, Lan and Kool 2024).

    `cost` (V + 1, V + 1), finite and not negative, need not be symmetric.  The search ends after
    `iterations`, or a third of them without gain, not after a time, so the same seed gives the
    same tour on any machine.
    """
    if len(cost) <= 2:
        return start
    import pyvrp
    from pyvrp import search

    whole: Any = np.round(cost * (LARGEST / max(float(cost.max()), 1e-300))).astype(np.int64)
    np.fill_diagonal(whole, 0)
    n = len(whole)
    data = pyvrp.ProblemData(
        locations=[pyvrp.Location(0, 0) for _ in range(n)],
        clients=[pyvrp.Client(location=i) for i in range(1, n)],
        depots=[pyvrp.Depot(location=0)],
        vehicle_types=[pyvrp.VehicleType(num_available=1)],
        distance_matrices=[whole],
        duration_matrices=[0 * whole],
    )
    # One vehicle: the moves that exchange between routes are left out, longer segments added.
    # Lower history than the default, which is made for thousands of nodes.
    params = pyvrp.SolveParams(
        operators=[
            search.Relocate1, search.Relocate2, search.Relocate3, search.Swap11, search.Swap21,
            search.Swap22, search.Swap31, search.Swap32, search.Swap33,
        ],
        ils=pyvrp.IteratedLocalSearchParams(history_length=100),
    )  # fmt: skip
    stop = pyvrp.stop.MultipleCriteria(
        [pyvrp.stop.MaxIterations(iterations), pyvrp.stop.NoImprovement(iterations // 3)]
    )
    result = pyvrp.solve(
        data,
        stop,
        seed=seed,
        collect_stats=False,
        display=False,
        params=params,
        initial_solution=pyvrp.Solution(data, [[node - 1 for node in start]]),
    )
    (route,) = result.best.routes()
    tour = [stop.idx + 1 for stop in route if stop.is_client()]
    return tour if tour_cost(cost, tour) < tour_cost(cost, start) else start
