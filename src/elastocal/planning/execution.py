"""The order of execution: the shortest tour through all poses and loads, or one in which a drift is
not taken for a parameter, and its stops."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import linalg

from elastocal.cell import Cell
from elastocal.cell_tables import Motion, Unsteadiness
from elastocal.identification.noise_structure import course_waves
from elastocal.messages import require, wish
from elastocal.planning.feasibility import Feasibility, Moves
from elastocal.planning.information import PoseInformation
from elastocal.units import Array, BoolArray, IntArray, Progress


def at_stops(cell: Cell) -> Motion:
    """The motion, with what the readings of a stop take in its dwell."""
    motion, readings = cell.design.motion, cell.design.repeats * max(len(cell.tool.markers), 1)
    return replace(motion, dwell=motion.dwell + motion.reading * readings)


DRIFT = 50e-6  # m, from the first reading to the last: a tracker or a base over an hour
HARMLESS = 0.1  # of what noise leaves: adds half a per cent to the error


@dataclass(frozen=True)
class Alias:
    """How a shift of single readings comes back as an error of what the plan is for.  `share` (N,
    L, m, 3): the error (m,) that a shift (3,) m of the readings of pose i in load state l leaves: R
    M⁻¹ B_iᵀ Σ_i⁻¹ D_il, D_il how readings enter the observations, |R x| the rms error at the test
    poses in m where `at_test_poses`, else x in its own standard deviations, as `noise` is.
    `whitened` (N, L, r, 3): Σ_i^(-1/2) D_il; `blocks` (N, r, p) of the plan."""

    share: Array
    noise: float
    at_test_poses: bool
    whitened: Array
    blocks: Array

    @classmethod
    def of(
        cls, information: PoseInformation, q: Array, blocks: Array, M: Array, R: Array | None,
        readings: IntArray | None = None,
    ) -> Alias | None:  # fmt: skip
        """Of a plan of poses q (N, n), read as `readings` (N, L), and all that is known M (p, p);
        None where readings are distances, which a shift hardly changes."""
        observed, factor = information.noise(q, readings)
        if observed.kind == "distance":
            return None
        V = linalg.cho_solve(linalg.cho_factor(M), np.eye(len(M)))
        root = np.linalg.cholesky(M).T if R is None else R
        n, n_states = len(q), len(information.forces)
        rows = len(observed.table) // n
        T = observed.combine[: len(observed.lead) // n, :rows].toarray()
        force = observed.table.force.reshape(n, rows, 3)
        shift = np.zeros((observed.size, 3))
        shift[:3, :3] = np.eye(3)
        share = np.zeros((n, n_states, len(root), 3))
        whitened = np.zeros((n, n_states, blocks.shape[1], 3))
        for state, own in enumerate(information.forces):
            here = (np.abs(force - own) < 1e-9).all(axis=2)
            D = np.einsum("ak,nk,cx->nacx", T, here.astype(float), shift)
            whitened[:, state] = np.linalg.solve(factor, D.reshape(n, -1, 3))
            share[:, state] = root @ V @ np.einsum("nrp,nrx->npx", blocks, whitened[:, state])
        noise = float(np.sqrt(np.trace(root @ V @ root.T)))
        return cls(share, noise, R is not None, whitened, blocks)

    def information(self, M: Array, time: Array, noise: Unsteadiness) -> Array:
        """What is left of the information M (p, p) where all drifts as the cell's `noise` says,
        poses being read at `time` (N, L) in s: the drift's course is a sum of waves F u, u ~ N(0,
        I), estimated beside the parameters: M − BᵀF (I + FᵀF)⁻¹ FᵀB."""
        span = max(float(np.ptp(time)), 1e-9)
        waves = course_waves((time.ravel() - time.min()) / span, noise.lasting / span)
        F = np.einsum("nlrx,nlk->nrxk", self.whitened, waves.reshape(*time.shape, -1))
        F = noise.drift * F.reshape(self.blocks.shape[0] * self.blocks.shape[1], -1)
        across = F.T @ self.blocks.reshape(len(F), -1)
        return np.asarray(M - across.T @ np.linalg.solve(np.eye(F.shape[1]) + F.T @ F, across))


@dataclass(frozen=True)
class Drifting:
    """What a steady drift of DRIFT over the measurements puts on what the plan is for, at worst:
    `bias` in this order, `shortest` in the shortest order, `noise` beside it, in m at the test
    poses, or in standard deviations of the parameters where not `at_test_poses`."""

    bias: float
    shortest: float
    noise: float
    at_test_poses: bool


def turns(loaded: Sequence[bool], used: Sequence[int], changes: int | None) -> list[int]:
    """The `used` load states in the order in which they come, each entry one block of visits.  At
    most `changes` loads are hung, exchanged or taken off, the arm beginning and ending without;
    None: as few as the states allow.  Without load the arm is measured in every gap, first and last
    of all, so that neither the loads nor their absence fall to one part of the time."""
    free = [state for state in used if not loaded[state]]
    heavy = [state for state in used if loaded[state]]
    if not heavy:
        return free[:1]
    least, key = len(heavy) + 1, wish("load_changes", "[design.motion] load_changes")
    require(
        changes is None or changes >= least,
        f"{key} is {changes}, but the loads are hung, exchanged and taken off {least} times at "
        f"least; allow {least}, or plan fewer loads",
    )
    changes = changes or least
    if len(heavy) == 1:
        blocks = changes // 2 if free else 1
        return [*free, *(heavy + free) * blocks]
    there_and_back = heavy + heavy[-2:0:-1]
    return [*free, *(there_and_back[k % len(there_and_back)] for k in range(changes - 1)), *free]


def in_turns(tour: list[int], load: IntArray, sequence: list[int]) -> list[int]:
    """The visits of a tour, of load states (V,), in blocks of `sequence`, as many in each block of
    a state, in the order of the tour."""
    of_state = {s: [v for v in tour if load[v - 1] == s] for s in set(sequence)}
    parts = {s: np.array_split(visits, sequence.count(s)) for s, visits in of_state.items()}
    return [int(v) for s in sequence for v in parts[s].pop(0)]


# The order, by simulated annealing (Kirkpatrick, Gelatt & Vecchi 1983): the shortest first, then
# one of little bias and little travel.

# Temperatures, where a drift counts in units of a bias that is as good as none, else of a move's
# part of the way: the searches begin at those of HOT, the first three from anywhere, the others
# near the best found; the shortest order from SHORT; an order that is nearly good, by its making or
# but for moves that turn out to be blocked, is bettered from WARM.
HOT, SHORT, WARM, COLD = (4.0, 4.0, 4.0, 1.0, 0.25), 0.15, 0.06, 1e-3
# Steps from HOT, from WARM, of blocked moves, and of the shortest order per visit.
STEPS, FEW, MENDING, PER_VISIT = 40_000, 10_000, 2_500, 4000
# Rounds of blocked moves found and the order mended, before all ways are looked at, and before the
# ways around are taken.
PATIENT, ROUNDS = 4, 12
HOPED = 0.5  # of its bias is left by a whole search, at best, to an order that is nearly good


class VisitTimes:
    """When each visit of an order is read, and what a drift then does: `change` (V + 1, V + 1) s of
    a change of load, `visit` s of reading at a node, `share` (V, m·3) of each visit, None where no
    drift counts.  Of travel `longest` s are allowed, and `usual` s usual, as of the order `begun`;
    a bias of `enough` per m of drift is as good as none."""

    share: Array | None = None
    longest = np.inf
    enough = 1.0

    def __init__(self, moves: Moves, motion: Motion, begun: list[int]) -> None:
        carried = np.array([moves.carries(node) for node in range(len(moves.pose) + 1)])
        self.moves = moves
        self.change = np.where(carried[:, None] != carried[None], motion.load_change, 0.0)
        self.visit = motion.dwell * (1 if moves.signs is None else 2)
        self.know()
        self.usual = max(self.driving(begun), np.finfo(float).tiny)

    def know(self) -> None:
        """Take over what the moves have learnt of their ways."""
        self.travel = self.moves.travel()
        self._lists, self._step = self.travel.tolist(), self.travel + self.change + self.visit

    def judge(self, alias: Alias | None, longest: float) -> None:
        """A drift does what `alias` says, and so much travel is allowed."""
        self.longest = longest
        if alias is not None:
            pose, load = self.moves.pose, self.moves.load
            times = np.zeros(alias.share.shape[:2])  # that each is read, with a part of it
            np.add.at(times, (pose, load), 1.0)
            share = alias.share[pose, load] / times[pose, load][:, None, None]
            self.share, self.enough = share.reshape(len(pose), -1), HARMLESS * alias.noise / DRIFT

    def possible(self, tour: list[int]) -> bool:
        return self.driving(tour) <= self.longest

    def driving(self, tour: list[int]) -> float:
        travel = self._lists
        return sum(travel[u][v] for u, v in pairwise([0, *tour, 0]))

    def time(self, tour: list[int]) -> float:
        ring = np.array([0, *tour, 0])
        changing = float(self.change[ring[:-1], ring[1:]].sum())
        return self.driving(tour) + self.visit * len(tour) + changing

    def _errors(self, tour: list[int]) -> Array:
        """(m, 3) error per m of drift in x, y, z, counted from the readings' mean time."""
        there = np.array([0, *tour])
        time = self._step[there[:-1], there[1:]].cumsum()
        at = np.zeros(len(self._step))
        at[there[1:]] = time - np.add.reduce(time) / len(time)
        assert self.share is not None
        errors = at[1:] @ self.share / max(float(time[-1] - time[0]), 1e-300)
        return np.asarray(errors.reshape(-1, 3))

    def bias(self, tour: list[int]) -> float:
        """Error per m of drift in its worst direction."""
        return 0.0 if self.share is None else float(np.linalg.norm(self._errors(tour), ord=2))

    def price(self, tour: list[int]) -> float:
        """What annealing makes small: bias beyond `enough`, travel beyond `longest`, travel."""
        driving, bias = self.driving(tour), 0.0
        if self.share is not None:
            errors = self._errors(tour)
            across = errors.T @ errors
            # Between rms and worst direction, which is what counts: Schatten's norm of order 4.
            bias = math.sqrt(math.sqrt(np.vdot(across, across))) / self.enough
        over = max(driving - self.longest, 0.0)
        return max(bias - 1, 0.0) + (100 * over + 0.1 * driving) / self.usual

    def annealed(self, tour: list[int], seed: int, steps: int, hot: float) -> list[int]:
        """The tour with its visits exchanged and moved between blocks of the same load state,
        never more changes of load, by annealing the price from `hot` down to COLD."""
        if len(tour) < 3:
            return tour
        rng = np.random.default_rng(seed)
        here, price = list(tour), self.price(tour)
        best, least = here, price
        loads = [-1, *self.moves.load.tolist()]  # by node
        unit = 1.0 if self.share is not None else 0.1 / len(tour)
        cooling, temperature = (COLD / hot) ** (1 / steps), hot * unit
        for kind, a, b, luck in rng.random((steps, 4)).tolist():
            temperature *= cooling
            new = _moved(here, loads, kind, int(a * len(here)), int(b * len(here)))
            if new is None:
                continue
            found = self.price(new)
            if found <= price or luck < math.exp((price - found) / temperature):
                here, price = new, found
                if price < least - 1e-9 * unit:
                    best, least = here, price
        return best

    def cleared(self, tour: list[int], seed: int, progress: Progress) -> list[int]:
        moves, rounds = self.moves, 0
        while moves.check(tour):  # blocked moves are gone round
            progress(f"order of execution: {moves.checked} moves checked, {moves.blocked} blocked")
            rounds += 1
            if rounds == PATIENT:
                moves.settle()
            self.know()
            if rounds <= ROUNDS:
                tour = self.annealed(tour, seed + rounds, MENDING, WARM)
        return tour

    def searched(
        self, near: list[int], seed: int, progress: Progress, hot: Sequence[float], steps: int
    ) -> list[int]:
        best = self.cleared(near, seed, progress)
        for k, temperature in enumerate(hot, start=1):
            # Enough where a drift does no harm any more; without one the way alone counts.
            drifts = self.share is not None
            if drifts and self.possible(best) and self.bias(best) <= self.enough:
                break
            new = self.annealed(best, seed + k, steps, temperature)
            best = min(best, self.cleared(new, seed, progress), key=self.price)
        return best


def against_drift(
    clock: VisitTimes, motion: Motion, tour: list[int], alias: Alias | None, seed: int,
    progress: Progress,
) -> tuple[list[int], VisitTimes, Drifting | None]:  # fmt: skip
    """The visits of the shortest `tour` in the order that a drift harms least, the clock that they
    are nodes of, and what the drift does.  Where there is time for it, all poses are read twice
    without load; where no extra time is stated, if (ρ² + b²) t falls, of the error at the test
    poses ρ, the drift's part of it b and the time t: if more readings would give less."""
    moves = clock.moves
    used = [int(s) for s in dict.fromkeys(moves.load[np.array(tour) - 1])]
    sequence = turns(moves.loaded.tolist(), used, motion.load_changes)
    clock.judge(alias, clock.driving(tour) + motion.longer * clock.time(tour))
    before, noise = clock.bias(tour), 0.0 if alias is None else alias.noise
    as_pays = motion.extra_time is None

    def harm(bias: float, time: float) -> float:
        squared = noise**2 + (DRIFT * bias) ** 2
        return squared * time if as_pays else max(bias, clock.enough)

    once = clock.annealed(in_turns(tour, moves.load, sequence), seed, FEW, WARM)
    once_bias, once_time = clock.bias(once), clock.time(once)
    twice, twice_harms = None, np.inf
    spread, again = moves.unloaded_twice(tour)
    longer = len(again) * clock.visit
    left = clock.longest - (0.0 if as_pays else longer)
    # Can it pay, if no drift is left at all?
    pays = harm(0.0, clock.time(tour) + longer) < harm(once_bias, once_time)
    if alias is not None and len(again) and pays and left >= clock.driving(tour):
        own = VisitTimes(spread, motion, tour)
        own.judge(alias, left)
        begun = own.annealed(in_turns([*tour, *again], spread.load, sequence), seed, FEW, WARM)
        found = own.searched(begun, seed, progress, HOT, STEPS)
        if own.possible(found):
            twice, twice_harms = (found, own), harm(own.bias(found), own.time(found))
    if harm(HOPED * once_bias, once_time) <= twice_harms:
        clock.know()
        once = clock.searched(once, seed, progress, HOT, STEPS)
        more = bool(motion.load_changes) and alias is None
        if not clock.possible(once) or not (more or clock.bias(once) < before):
            once = tour
    if twice is not None and twice_harms < harm(clock.bias(once), clock.time(once)):
        once, clock = twice
    while clock.moves.check(once):
        clock.know()
    drift = None
    if alias is not None:
        drift = Drifting(DRIFT * clock.bias(once), DRIFT * before, noise, alias.at_test_poses)
    return once, clock, drift


def _moved(tour: list[int], load: list[int], kind: float, i: int, j: int) -> list[int] | None:
    """Visits i and j exchanged, i put beside j, or what lies between them turned round; None
    where that would change the blocks of equal `load` by node."""
    here = load[tour[i]]
    if i == j or here != load[tour[j]]:
        return None
    new = tour.copy()
    if kind < 0.2:
        new[i], new[j] = new[j], new[i]
        return new
    low, high = min(i, j), max(i, j)
    if kind < 0.6:
        if any(load[node] != here for node in tour[low : high + 1]):
            return None
        new[low : high + 1] = new[low : high + 1][::-1]
        return new
    if all(load[node] != here for node in (*tour[max(i - 1, 0) : i], *tour[i + 1 : i + 2])):
        return None  # its block would be gone
    new.insert(j, new.pop(i))
    return new


def with_references(
    tour: list[int], moves: Moves, travel: Array, every: int, paired: bool
) -> list[tuple[int, int]]:
    """The tour's nodes, 0 behind each, with one pose of each load state visited again before the
    first, after `every` visits, and at the end, under the load that hangs there, its number behind:
    the one with the least way to the others, for all load states where one is visited in all.
    Where readings are `paired`, it is visited loaded no more often than without load."""
    mean = travel[1:, 1:].mean(axis=0)
    states = [int(s) for s in dict.fromkeys(moves.load[np.array(tour) - 1])]
    common = set.intersection(*(set(moves.pose[moves.load == s].tolist()) for s in states))
    candidates = np.ones(len(moves.pose), dtype=bool)
    if common:
        best = min(sorted(common), key=lambda k: float(mean[moves.pose == k].sum()))
        candidates = moves.pose == best
    chosen = {
        s: 1 + min(np.flatnonzero(candidates & (moves.load == s)).tolist(), key=lambda v: mean[v])
        for s in states
    }
    times = dict.fromkeys(states, 0)
    found: list[tuple[int, int]] = []
    for k, node in enumerate([*tour, tour[-1]]):
        state = int(moves.load[node - 1])
        if k % every == 0 or k == len(tour):
            times[state] += 1
            found.append((chosen[state], times[state]))
        if k < len(tour):
            found.append((node, 0))
    most = min((n for s, n in times.items() if not moves.loaded[s]), default=0)
    loaded = moves.loaded[moves.load]
    return [(v, again) for v, again in found if not paired or again <= most or not loaded[v - 1]]


@dataclass(frozen=True)
class Stop:
    """One reading: pose `pose` at joints `q` (n,) in load state `load` (0-based both).  The arm
    moves straight through `via` (k, n), where nothing is measured, and then to `q`, in `travel` s;
    the load is changed once `change_after` of these k + 1 moves are done.  `approach` (n,): ±1, the
    direction of each joint's last motion, `side` 0 or 1 where the pose is approached from both
    sides.  `again`: how often it has been visited for reference, this time included; `part`: how
    often it was read before, with an equal part of the readings each time."""

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
    `take_off`: the load hangs on the arm after the last stop.  `drift`: what a steady drift does in
    this order."""

    stops: tuple[Stop, ...]
    home_via: Array
    home_travel: float
    take_off: bool
    motion: Motion
    drift: Drifting | None = None

    @property
    def travel(self) -> float:
        return sum(stop.travel for stop in self.stops) + self.home_travel

    @property
    def between(self) -> list[tuple[int | None, Array]]:
        """Via points and the stop, from 1, that they lead to; None: home."""
        ways = ((k, q) for k, stop in enumerate(self.stops, start=1) for q in stop.via)
        return [*ways, *((None, q) for q in self.home_via)]

    @property
    def one_sided(self) -> tuple[int, ...]:
        sides = Counter((stop.pose, stop.load) for stop in self.stops if not stop.again)
        few = {pose for (pose, _), n in sides.items() if self.motion.both_directions and n < 2}
        return tuple(sorted(few))

    @property
    def load_changes(self) -> int:
        """Loads hung, exchanged or taken off; the arm begins and ends without."""
        return sum(stop.change_after is not None for stop in self.stops) + self.take_off

    @property
    def arrivals(self) -> Array:
        """When (stops,) in s the readings of each stop begin."""
        travel = np.array([stop.travel for stop in self.stops])
        changed = np.array([stop.change_after is not None for stop in self.stops])
        dwell = self.motion.dwell * np.arange(len(travel))
        return np.cumsum(travel + self.motion.load_change * changed) + dwell

    def times(self, poses: int, states: int) -> Array:
        """When (poses, states) in s each pose is read in each load state; the mean of several, and
        of all where it is not."""
        at = np.array([stop.pose * states + stop.load for stop in self.stops])
        total = np.bincount(at, self.arrivals, poses * states)
        count = np.bincount(at, minlength=poses * states)
        mean = np.where(count > 0, total / np.maximum(count, 1), self.arrivals.mean())
        return np.asarray(mean).reshape(poses, states)

    @property
    def total(self) -> float:
        motion = self.motion
        waiting = motion.dwell * len(self.stops) + motion.load_change * self.load_changes
        return self.travel + waiting


def _stops(moves: Moves, u: int, v: int) -> list[Stop]:
    """The reading of node v after node u, or two where it is approached from both sides."""
    _, way = moves.way(u, v)
    node, both = v - 1, moves.signs is not None
    pose, load, leave = int(moves.pose[node]), int(moves.load[node]), int(moves.leave[node])
    q, side = moves.points[leave], int(moves.side[node])
    before, after = moves.carries(u), moves.carries(v)
    whole = [*way, leave] if both else way
    passed = whole[1:-1] or way[:both]
    # The load is exchanged before the last stretch where that is the approach.
    change = None if before == after else 0 if after < 0 else len(passed) + (not both)
    signs = (None, None) if moves.signs is None else moves.signs[pose]
    time = _time(moves, whole)
    first = Stop(pose, load, q, moves.points[passed], time, change, signs[side], side)
    if not both or not moves.free[node, 1 - side]:
        return [first]
    other = int(moves.sides[node, 1 - side])
    via, time = moves.points[[other]], _time(moves, [leave, other, leave])
    return [first, Stop(pose, load, q, via, time, None, signs[1 - side], 1 - side)]


def _time(moves: Moves, way: list[int]) -> float:
    return float(sum(moves.maps[0].times[i, j] for i, j in pairwise(way)))


def nearest_first(cost: Array) -> list[int]:
    """From node 0 always on to the nearest node not yet visited."""
    left, tour = cost.copy(), [0]
    for _ in range(len(cost) - 1):
        left[:, tour[-1]] = np.inf
        tour.append(int(np.argmin(left[tour[-1]])))
    return tour[1:]


def schedule(
    q: Array, motion: Motion, checker: Feasibility, *, loads: Array | None = None,
    read: BoolArray | None = None, limits: tuple[Array, Array] | None = None,
    via: Array | None = None, alias: Alias | None = None, paired: bool = False, seed: int = 0,
    progress: Progress = lambda message: None,
) -> Execution:  # fmt: skip
    """The order of `q` (N, n) with the least travel time found, from and to `motion.home`.  Every
    pose is visited under each of `loads` (L, 3) N (None: once, without load) in which it is `read`
    (N, L), one load state after the other.  A move is straight in joint space; where that is
    blocked, it goes through other poses, home, or points `via` (k, n).  With
    `motion.both_directions` each pose is measured twice, inside `limits` (lower, upper).  Solve,
    check the moves of the solution, forbid the blocked ones, and again, until all are checked: no
    cost was above the true one.  With an `alias` a drift does little to what the plan is for, as
    far as `motion.extra_time` and `motion.load_changes` allow.  A pose that no free move reaches is
    Unreachable."""
    forces = np.zeros((1, 3)) if loads is None else loads
    moves = Moves.of(q, motion, checker, forces, limits, via, read)
    moves.check_reach()
    # Load states one after the other, without load first.
    used = sorted(set(moves.load.tolist()), key=lambda state: (moves.loaded[state], state))
    begun = in_turns(nearest_first(moves.travel()), moves.load, used)
    clock, drift = VisitTimes(moves, motion, begun), None
    tour = clock.searched(begun, seed, progress, (SHORT,), PER_VISIT * len(begun))
    if (alias is not None or motion.load_changes) and motion.longer > 0:
        tour, clock, drift = against_drift(clock, motion, tour, alias, seed, progress)
    moves, order = clock.moves, [(node, 0) for node in tour]
    if motion.reference_every:
        order = with_references(tour, moves, clock.travel, motion.reference_every, paired)
    nodes = [node for node, _ in order]
    while moves.check(nodes):
        pass
    stops, visited = list[Stop](), Counter[tuple[int, ...]]()
    for u, (v, again) in zip([0, *nodes], order, strict=False):
        for stop in _stops(moves, u, v):
            key = (stop.pose, stop.load, stop.side, again)
            stops.append(replace(stop, again=again, part=visited[key]))
            visited[key] += 1
    _, home = moves.way(nodes[-1], 0)  # empty without a home
    return Execution(
        stops=tuple(stops),
        home_via=moves.points[home[1:-1]],
        home_travel=_time(moves, home),
        take_off=bool(moves.loaded[stops[-1].load]),
        motion=motion,
        drift=drift,
    )
