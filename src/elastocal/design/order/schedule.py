"""The shortest execution of a plan: every pose in its load states, by collision-free moves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Motion
from elastocal.design.order.bound import tour_bound
from elastocal.design.order.execution import Execution
from elastocal.design.order.moves import Moves
from elastocal.design.order.reach import Blockers, check_reachable, refuse_impossible
from elastocal.design.order.roadmap import PathChecker
from elastocal.design.order.routing import greedy_tour, shortest_tour, tour_cost
from elastocal.design.order.stops import stops_of, way_home
from elastocal.errors import require

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

ITERATIONS = 5000
FEW_ITERATIONS = 300  # while moves of the tour still turn out to be blocked


def schedule(
    q: Array,
    motion: Motion,
    checker: PathChecker,
    *,
    loads: Array | None = None,
    load: IntArray | None = None,
    limits: tuple[Array, Array] | None = None,
    via: Array | None = None,
    blockers: Blockers | None = None,
    seed: int = 0,
    iterations: int = ITERATIONS,
    progress: Callable[[str], None] = lambda message: None,
) -> Execution:
    """The order of `q` (N, n) with the least travel time found, from and to `motion.home`.

    Every pose is visited under each of `loads` (L, 3) N (None: once, without load), or under
    loads[load[i]] where `load` (N,) says so.  Load states are done one after the other with as
    few changes as possible, unloaded first where that costs nothing.  A move is straight in
    joint space; where that is blocked, it goes through other poses, home, or points `via`
    (k, n), which are not measured.  With `motion.both_directions` each pose is measured twice,
    the joints coming from below and from above, inside `limits` (lower, upper); once where one
    side is blocked (`Execution.one_sided`).

    Solve, check the moves of the solution, forbid the blocked ones, and again: at the end all
    moves are checked, and the tour is one that the routing solver holds best at costs that are
    nowhere above the true ones.  The same seed gives the same order.

    Raises InsufficientDataError that names a pose which no free move reaches, or which cannot
    be approached as asked, and what is in the way if `blockers` can tell; InputError for
    arguments that do not fit together.
    """
    q = np.asarray(q, dtype=float)
    require(q.ndim == 2 and len(q) > 0, "there is no pose to put in order")
    forces = np.zeros((1, 3)) if loads is None else np.asarray(loads, dtype=float)
    moves = Moves.of(q, motion, checker, forces, load, limits, via)
    check_reachable(moves, blockers)
    costs = moves.costs()
    tour = greedy_tour(costs.cost)
    thorough, done = False, False
    while not done:
        effort = iterations if thorough else min(iterations, FEW_ITERATIONS)
        tour = shortest_tour(costs.cost, tour, seed, effort)
        tour = _unloaded_first(tour, costs.cost, moves)
        blocked = moves.check(tour, costs)
        progress(f"order of execution: {moves.checked} moves checked, {moves.blocked} blocked")
        if blocked:
            costs = moves.costs()
        done, thorough = thorough and not blocked, not blocked
    refuse_impossible(moves, tour, costs, blockers)
    stops = stops_of(moves, tour, costs)
    home_via, home_travel = way_home(moves, tour[-1], costs)
    travel = sum(stop.travel for stop in stops) + home_travel
    # The bound leaves open in which order the load states come: their number alone is fixed.
    open_cost = costs.cost - costs.changed
    bound = tour_bound(open_cost, tour_cost(open_cost, tour)) - tour_cost(costs.apart, tour)
    return Execution(
        stops=stops,
        home_via=home_via,
        home_travel=home_travel,
        take_off=bool(moves.loaded[stops[-1].load]),
        motion=motion,
        bound=float(np.clip(bound, 0.0, travel)),
        checked=moves.checked,
        blocked=moves.blocked,
    )


def _unloaded_first(tour: list[int], cost: Array, moves: Moves) -> list[int]:
    """The tour or its reverse: the cheaper one, else the one that begins without load, else
    with the lower pose, so that the answer does not hang on the solver's whim."""
    there, back = tour_cost(cost, tour), tour_cost(cost, tour[::-1])
    if not np.isclose(there, back, rtol=1e-12):
        return tour if there < back else tour[::-1]

    def key(order: list[int]) -> tuple[bool, int]:
        first = order[0] - 1
        return bool(moves.loaded[moves.visits.load[first]]), int(moves.visits.pose[first])

    return min(tour, tour[::-1], key=key)
