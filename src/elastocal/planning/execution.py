"""The order of execution: the shortest tour through all poses and loads, and its stops."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from elastocal.cell.plan_wishes import Motion
from elastocal.errors import require
from elastocal.planning.drift import Alias, Drifting, against_drift, with_references
from elastocal.planning.moves import BlockersOf, Costs, Moves, PathChecker, Reach
from elastocal.units import Array, IntArray, Progress

# The order of execution as it is handed on: stops, how to get to them, what it takes.


@dataclass(frozen=True)
class Stop:
    """One reading: pose `pose` at joints `q` (n,) in load state `load` (0-based both).

    The arm moves straight through `via` (k, n), where nothing is measured, and then to `q`, in
    `travel` s.  `change_after`: the load is changed once that many of these k + 1 moves are done;
    None: it stays.  `approach` (n,): +1 or −1, the direction of each joint's last motion, and
    `side` 0 or 1 where the pose is approached from both sides.  `again`: how often it has been
    visited for reference, this time included; 0 for the plan's own reading.  `part`: how often it
    was visited for it before, with an equal part of the readings each time.  `time` s from the
    beginning to its readings, where that is asked for.
    """

    pose: int
    load: int
    q: Array
    via: Array
    travel: float
    change_after: int | None = None
    approach: IntArray | None = None
    side: int = 0
    again: int = 0
    part: int = 0
    time: float | None = None

    def name(self, configurations: Sequence[str]) -> str:
        """That of its pose, of `configurations` (N,); "7r2" for the second time that pose 7 is
        visited for reference only."""
        return configurations[self.pose] + (f"r{self.again}" if self.again else "")


@dataclass(frozen=True)
class Execution:
    """The stops in order, and the way home, through `home_via` (k, n), where there is a home.

    `travel` s in all.  `checked` moves were tried, `blocked` of them in the way of something.
     `take_off`: the load hangs on the arm after the last stop.  `drift`: what a
    steady drift would do to the plan's result in this order; None where that was not asked.
    """

    stops: tuple[Stop, ...]
    home_via: Array
    home_travel: float
    take_off: bool
    motion: Motion
    checked: int
    blocked: int
    drift: Drifting | None = None

    @property
    def travel(self) -> float:
        return sum(stop.travel for stop in self.stops) + self.home_travel

    @property
    def one_sided(self) -> tuple[int, ...]:
        """Poses that were to be approached from both sides but can be from one only."""
        sides = Counter((stop.pose, stop.load) for stop in self.stops if not stop.again)
        few = {pose for (pose, _), n in sides.items() if self.motion.both_directions and n < 2}
        return tuple(sorted(few))

    @property
    def load_changes(self) -> int:
        """Loads hung, exchanged or taken off; the arm begins and ends without."""
        return sum(stop.change_after is not None for stop in self.stops) + self.take_off

    def times(self, poses: int, states: int) -> Array:
        """When (poses, states) in s each pose is read in each load state; the mean of several."""
        step = [
            stop.travel + self.motion.dwell
            + self.motion.load_change * (stop.change_after is not None)
            for stop in self.stops
        ]  # fmt: skip
        at = np.array([stop.pose * states + stop.load for stop in self.stops])
        total = np.bincount(at, np.cumsum(step), poses * states)
        count = np.maximum(np.bincount(at, minlength=poses * states), 1)
        return np.asarray(total / count).reshape(poses, states)

    @property
    def total(self) -> float:
        """s of travelling, measuring and changing loads."""
        motion = self.motion
        waiting = motion.dwell * len(self.stops) + motion.load_change * self.load_changes
        return self.travel + waiting


# From a tour over visits to the stops of an execution.


def _stops(moves: Moves, u: int, v: int, costs: Costs) -> list[Stop]:
    """The reading of node v after node u, or two where it is approached from both sides."""
    _, way = moves.way(u, v, costs)
    node = v - 1
    pose, load, leave = int(moves.pose[node]), int(moves.load[node]), int(moves.leave[node])
    q, side = moves.points[leave], int(costs.side[u, node])
    before, after = moves.carries(u), moves.carries(v)
    if moves.signs is None:
        passed = way[1:-1] if len(way) > 1 else []
        change = None if before == after else 0 if after < 0 else len(passed) + 1
        time = _time(moves, way)
        return [Stop(pose, load, q, moves.points[passed], time, change)]
    # The load is exchanged before the last stretch, which is the approach.
    passed = way[1:] if len(way) > 1 else way
    change = None if before == after else 0 if after < 0 else len(passed)
    signs, opposite = moves.signs[pose], 1 - side
    time = _time(moves, [*way, leave])
    first = Stop(pose, load, q, moves.points[passed], time, change, signs[side], side)
    if not np.isfinite(moves.inside[node, opposite]):
        return [first]
    other = int(moves.entry[node, opposite])
    time = _time(moves, [leave, other, leave])
    via = moves.points[[other]]
    return [first, Stop(pose, load, q, via, time, None, signs[opposite], opposite)]


def _time(moves: Moves, way: list[int]) -> float:
    return float(sum(moves.times[i, j] for i, j in pairwise(way)))


# The shortest tour through given costs, by iterated local search.

PART = 3  # visits that are put elsewhere together, at most
WINDOW = 30  # visits among which a kick mixes segments
GAINED = 1e-9  # of the tour, that a step must gain


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


def shortest_tour(cost: Array, start: list[int], seed: int, kicks: int) -> list[int]:
    """A short tour 0 → every node → 0, never worse than `start`.

    `cost` (V + 1, V + 1), finite and not negative, need not be symmetric.  Segments are turned
    round (2-opt) or put elsewhere (Or-opt) until that gains nothing; then segments are exchanged
    at random (double bridge), and again, `kicks` times from the best tour (Martin, Otto & Felten
    1991).  The same seed gives the same tour on any machine.
    """
    rng = np.random.default_rng(seed)
    best = _locally_best(cost, np.array(start, dtype=np.int64))
    least = tour_cost(cost, best.tolist())
    for _ in range(kicks if len(best) > PART else 0):
        width = min(WINDOW, len(best))
        first = int(rng.integers(len(best) - width + 1))
        a, b, c = (first + np.sort(rng.choice(width + 1, 3, replace=False))).tolist()
        new = np.concatenate([best[:a], best[b:c], best[a:b], best[c:]])
        new = _locally_best(cost, new)
        found = tour_cost(cost, new.tolist())
        if found < least * (1 - GAINED):
            best, least = new, found
    tour = [int(node) for node in best]
    return tour if least < tour_cost(cost, start) else start


def _locally_best(cost: Array, tour: IntArray) -> IntArray:
    """The tour once neither turning a segment round nor putting one elsewhere shortens it."""
    enough = GAINED * tour_cost(cost, tour.tolist())
    while True:
        gain, move = _best_turn(cost, tour)
        for size in range(1, min(PART, len(tour) - 1) + 1):
            other = _best_shift(cost, tour, size)
            if other[0] > gain:
                gain, move = other
        if gain <= enough:
            return tour
        tour = move


def _best_turn(cost: Array, tour: IntArray) -> tuple[float, IntArray]:
    """What turning the best segment i … j round gains, and the tour then."""
    ring = np.concatenate([[0], tour, [0]])
    here, before, after = ring[1:-1], ring[:-2], ring[2:]
    forth = np.concatenate([[0.0], cost[here[:-1], here[1:]].cumsum()])
    back = np.concatenate([[0.0], cost[here[1:], here[:-1]].cumsum()])
    inside = (forth - back)[None, :] - (forth - back)[:, None]
    gain = cost[before, here][:, None] + cost[here, after][None, :] + inside
    gain = gain - cost[before[:, None], here[None, :]] - cost[here[:, None], after[None, :]]
    gain = np.triu(gain, 1)
    i, j = np.unravel_index(int(gain.argmax()), gain.shape)
    return float(gain[i, j]), np.concatenate([tour[:i], tour[i : j + 1][::-1], tour[j + 1 :]])


def _best_shift(cost: Array, tour: IntArray, size: int) -> tuple[float, IntArray]:
    """What putting the best segment of `size` visits elsewhere gains, and the tour then."""
    ring, n = np.concatenate([[0], tour, [0]]), len(tour)
    first = np.arange(1, n - size + 2)  # its place in the ring
    a, b = ring[first], ring[first + size - 1]
    p, q = ring[first - 1], ring[first + size]
    left = cost[p, a] + cost[b, q] - cost[p, q]
    u, v = ring[:-1], ring[1:]  # between which it goes
    added = cost[u[None, :], a[:, None]] + cost[b[:, None], v[None, :]] - cost[u, v][None, :]
    gain = left[:, None] - added
    place = np.arange(n + 1)[None, :]
    gain[(place >= first[:, None] - 1) & (place <= first[:, None] + size - 1)] = -np.inf
    i, k = np.unravel_index(int(gain.argmax()), gain.shape)
    start, rest = int(first[i]) - 1, np.delete(tour, np.arange(first[i] - 1, first[i] - 1 + size))
    at = int(k) if k < start else int(k) - size
    part = tour[start : start + size]
    return float(gain[i, k]), np.concatenate([rest[:at], part, rest[at:]])


# The shortest execution of a plan: every pose in its load states, by collision-free moves.

KICKS = 400
FEW_KICKS = 30  # while moves of the tour still turn out to be blocked
PATIENT = 5  # times, before all ways are checked


def schedule(
    q: Array,
    motion: Motion,
    checker: PathChecker,
    *,
    loads: Array | None = None,
    limits: tuple[Array, Array] | None = None,
    via: Array | None = None,
    blockers: BlockersOf | None = None,
    alias: Alias | None = None,
    paired: bool = False,
    seed: int = 0,
    kicks: int = KICKS,
    progress: Progress = lambda message: None,
) -> Execution:
    """The order of `q` (N, n) with the least travel time found, from and to `motion.home`.

    Every pose is visited under each of `loads` (L, 3) N (None: once, without load).  Load states
    are done one after the other with as few changes as possible, unloaded first where that costs
    nothing.  A move is straight in joint space; where that is blocked, it goes through other poses,
    home, or points `via` (k, n), which are not measured.  With `motion.both_directions` each pose
    is measured twice, the joints coming from below and from above, inside `limits` (lower, upper);
    once where one side is blocked (`Execution.one_sided`).

    Solve, check the moves of the solution, forbid the blocked ones, and again: at the end all
    moves are checked, and the tour is one that the search holds best at costs that are
    nowhere above the true ones.  The same seed gives the same order.

    With an `alias` the order found is one in which a drift does little to what the plan is for, as
    far as `motion.extra_time` and `motion.load_changes` allow.  After `motion.reference_every`
    visits one pose is visited again; where readings are `paired`, loaded with unloaded, no more
    often loaded.

    Raises InsufficientDataError that names a pose which no free move reaches, or which cannot
    be approached as asked, and what is in the way if `blockers` can tell; InputError for
    arguments that do not fit together.
    """
    q = np.asarray(q, dtype=float)
    require(q.ndim == 2 and len(q) > 0, "there is no pose to put in order")
    forces = np.zeros((1, 3)) if loads is None else np.asarray(loads, dtype=float)
    moves = Moves.of(q, motion, checker, forces, limits, via)
    Reach(moves, blockers).check()
    costs = moves.costs()
    tour = greedy_tour(costs.cost)
    thorough, done, rounds = False, False, 0
    while not done:
        effort = kicks if thorough else min(kicks, FEW_KICKS)
        tour = shortest_tour(costs.cost, tour, seed, effort)
        tour = _unloaded_first(tour, costs.cost, moves)
        blocked = moves.check(tour, costs)
        progress(f"order of execution: {moves.checked} moves checked, {moves.blocked} blocked")
        if blocked:
            if moves.crowded or (rounds := rounds + 1) > PATIENT:
                moves.settle()
            costs = moves.costs()
        done, thorough = thorough and not blocked, not blocked
    Reach(moves, blockers).check_tour(tour, costs)
    drift = None
    if (alias is not None or motion.load_changes) and motion.longer > 0:
        tour, moves, costs, drift = against_drift(moves, motion, tour, costs, alias, seed, progress)
    order = [(node, 0) for node in tour]
    if motion.reference_every:
        order = with_references(tour, moves, costs, motion.reference_every, paired)
        while moves.check([node for node, _ in order], costs):
            costs = moves.costs()
    nodes = [node for node, _ in order]
    Reach(moves, blockers).check_tour(nodes, costs)
    stops = [
        replace(stop, again=again)
        for (u, (v, again)) in zip([0, *nodes], order, strict=False)
        for stop in _stops(moves, u, v, costs)
    ]
    visited: Counter[tuple[int, ...]] = Counter()
    for k, stop in enumerate(stops):
        key = (stop.pose, stop.load, stop.side, stop.again)
        stops[k] = replace(stop, part=visited[key])
        visited[key] += 1
    _, home = moves.way(nodes[-1], 0, costs)  # empty without a home
    home_travel = _time(moves, home)
    return Execution(
        stops=tuple(stops),
        home_via=moves.points[home[1:-1]],
        home_travel=home_travel,
        take_off=bool(moves.loaded[stops[-1].load]),
        motion=motion,
        checked=moves.checked,
        blocked=moves.blocked,
        drift=drift,
    )


def _unloaded_first(tour: list[int], cost: Array, moves: Moves) -> list[int]:
    """The tour or its reverse: the cheaper one, else the one that begins without load, else
    with the lower pose, so that the answer does not hang on the solver's whim."""
    there, back = tour_cost(cost, tour), tour_cost(cost, tour[::-1])
    if not np.isclose(there, back, rtol=1e-12):
        return tour if there < back else tour[::-1]

    def key(order: list[int]) -> tuple[bool, int]:
        first = order[0] - 1
        return bool(moves.loaded[moves.load[first]]), int(moves.pose[first])

    return min(tour, tour[::-1], key=key)
