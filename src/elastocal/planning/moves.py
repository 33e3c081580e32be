"""Moves between poses: visits under loads, approaches, free joint moves, and what blocks them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csgraph

from elastocal.cell_tables import Motion
from elastocal.messages import InputError, InsufficientDataError, some
from elastocal.model.chain import Chain, told
from elastocal.planning.feasibility import Feasibility
from elastocal.units import Array, BoolArray, IntArray

# Which joint moves are free: a graph over joint vectors whose edges are checked when needed.

# Added to every edge, relative to the longest one: of equally long ways the one with fewer stops.
PER_EDGE = 1e-9


def travel_times(points: Array, speed: Array | None) -> Array:
    """Times (m, m) in s of synchronised joint moves between `points` (m, n):
    t_ij = max_k |q_ik − q_jk| / v_k with `speed` v (n,) in rad/s or m/s, 1 where it is None."""
    q = points if speed is None else points / speed
    return np.asarray(np.abs(q[:, None] - q[None]).max(axis=2))


class Roadmap:
    """Joint vectors `points` (m, n) and the straight moves between them, with or without load.  A
    move counts as free until it is checked; a blocked one is replaced by the fastest way through
    other points.  So costs never exceed the true ones (Bohlin and Kavraki 2000)."""

    def __init__(self, points: Array, times: Array, loaded: bool, checker: Feasibility) -> None:
        self.points, self.loaded, self.checker = points, loaded, checker
        self.carrying = " with the load" if loaded else ""
        self.direct = times.copy()  # inf where blocked
        self.checked = np.eye(len(times), dtype=bool)
        self._ways: tuple[Array, NDArray[np.integer]] | None = None

    def check(self, moves: Iterable[tuple[int, int]]) -> bool:
        """Are the straight moves between these pairs of points all free?  Each is checked once,
        those not checked before together."""
        pairs = sorted({(min(move), max(move)) for move in moves})
        new = [pair for pair in pairs if not self.checked[pair]]
        if new:
            i, j = np.array(new).T
            free = self.checker.paths_free(self.points[i], self.points[j], self.loaded)
            self.checked[i, j] = self.checked[j, i] = True
            i, j = i[~free], j[~free]
            self.direct[i, j] = self.direct[j, i] = np.inf
            self._ways = None
        return all(np.isfinite(self.direct[pair]) for pair in pairs)

    def costs(self) -> Array:
        """Times (m, m) between points: straight, or by the fastest way around; inf for none."""
        return np.where(np.isfinite(self.direct), self.direct, self._shortest()[0])

    def way(self, i: int, j: int) -> list[int]:
        """Points passed on the fastest way from i to j, j included, i not; [] from i to itself."""
        if i == j:
            return []
        if np.isfinite(self.direct[i, j]):
            return [j]
        before, way = self._shortest()[1][i], [j]
        while before[way[-1]] != i:
            way.append(int(before[way[-1]]))
        return way[::-1]

    def settle(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Check the fastest ways between these pairs of points until what is fastest is free."""
        left = list(pairs)
        while left:
            times = self.costs()
            ways = [[i, *self.way(i, j)] for i, j in left if np.isfinite(times[i, j])]
            self.check(move for way in ways for move in pairwise(way))
            left = [(w[0], w[-1]) for w in ways if np.isinf(self.direct[w[:-1], w[1:]]).any()]

    def _shortest(self) -> tuple[Array, NDArray[np.integer]]:
        if self._ways is None:
            finite = self.direct[np.isfinite(self.direct)]
            extra = max(PER_EDGE * float(finite.max()), np.finfo(float).tiny)
            self._ways = csgraph.shortest_path(
                self.direct + extra, method="FW", return_predecessors=True
            )
        return self._ways

    def parts(self, needed: list[int]) -> list[list[int]]:
        """`needed` points by what is connected through free moves, the largest part first.

        Only as many moves are checked as it takes, first among `needed`, then through all points:
        every part tries its shortest ways out, twice as many each time (Borůvka).
        """
        every = np.arange(len(self.points))
        for among, tries in ((np.array(needed), 1), (every, 1)):
            while len(set((label := self._joined())[needed])) > 1:
                new: list[tuple[int, int]] = []
                for part in set(label[among]):
                    own, others = among[label[among] == part], among[label[among] != part]
                    out = self.direct[np.ix_(own, others)]
                    first = np.argsort(out, axis=None, kind="stable")[:tries]
                    i, j = np.unravel_index(first[np.isfinite(out.ravel()[first])], out.shape)
                    new += zip(own[i].tolist(), others[j].tolist(), strict=True)
                if not new:
                    break
                self.check(new)
                tries *= 2
        found = [[p for p in needed if label[p] == part] for part in dict.fromkeys(label[needed])]
        return sorted(found, key=len, reverse=True)

    def _joined(self) -> IntArray:
        """A label (m,) for each part that is known to hang together."""
        free = self.checked & np.isfinite(self.direct)
        return np.asarray(csgraph.connected_components(free, directed=False)[1])


MOST_NAMED = 3


class Unreachable(InsufficientDataError):
    """Some poses of a plan cannot be reached: `poses` are their indices."""

    def __init__(self, message: str, *poses: int) -> None:
        super().__init__(message)
        self.poses = np.array(poses, dtype=int)


@dataclass(frozen=True)
class Moves:
    """Home, poses, points of approach and via points in one list, `points` (m, n), with `times` (m,
    m) between them, the roadmaps `maps` without and with load, and V visits among them.

    Each visit is of `pose` (V,) in the load state `load` (V,), left from `leave` (V,), where the
    pose is.  `sides` (V, 2) are the points from which it is approached, with `signs` (N, 2, n), and
    which of them are `free` (V, 2); without approaches the pose itself.
    """

    points: Array
    times: Array
    maps: tuple[Roadmap, Roadmap]
    loaded: BoolArray
    home: int | None
    signs: IntArray | None
    pose: IntArray
    load: IntArray
    leave: IntArray
    sides: IntArray
    free: BoolArray

    @classmethod
    def of(
        cls, q: Array, motion: Motion, checker: Feasibility, forces: Array,
        limits: tuple[Array, Array] | None, via: Array | None, read: BoolArray | None = None,
    ) -> Moves:  # fmt: skip
        n_poses, n = q.shape
        read = np.ones((n_poses, len(forces)), dtype=bool) if read is None else read
        pose, load = np.nonzero(read)
        home = None if motion.home is None else 0
        start = np.zeros((0, n)) if motion.home is None else motion.home[None]
        leave = len(start) + pose
        between, signs, sides = np.zeros((0, n)), None, leave[:, None]
        if motion.both_directions:
            assert limits is not None
            signs = approach_signs(checker.chain, q, *limits, motion.overshoot)
            between = (q[:, None] - signs * motion.overshoot).reshape(-1, n)
            sides = len(start) + n_poses + 2 * pose[:, None] + np.arange(2)
        points = np.vstack([start, q, between, np.zeros((0, n)) if via is None else via])
        times = travel_times(points, motion.speed)
        maps = (Roadmap(points, times, False, checker), Roadmap(points, times, True, checker))
        loaded, free = (forces != 0).any(axis=1), np.ones(sides.shape, dtype=bool)
        for roadmap in maps if signs is not None else ():
            own = loaded[load] == roadmap.loaded
            ends = np.broadcast_to(leave[own, None], sides[own].shape)
            roadmap.check(zip(sides[own].ravel().tolist(), ends.ravel().tolist(), strict=True))
            free[own] = np.isfinite(roadmap.direct[sides[own], ends])
        return cls(points, times, maps, loaded, home, signs, pose, load, leave, sides, free)

    @cached_property
    def side(self) -> IntArray:
        """(V,): the side from which a visit begins; then comes the other, where that is free."""
        return np.asarray(self.free.argmax(axis=1))

    @cached_property
    def entry(self) -> IntArray:
        """(V,): the point by which a visit is entered."""
        return np.asarray(self.sides[np.arange(len(self.pose)), self.side])

    @cached_property
    def inside(self) -> Array:
        """(V,) s from there on: the approach, and to the other side and back; inf where blocked."""
        to = self.times[self.leave[:, None], self.sides]
        first = to[np.arange(len(to)), self.side]
        both = np.where(self.free.all(axis=1), 2 * to[:, -1], 0.0) if self.signs is not None else 0
        return np.where(self.free.any(axis=1), first + both, np.inf)

    @property
    def checked(self) -> int:
        return sum(int(np.triu(roadmap.checked, 1).sum()) for roadmap in self.maps)

    @property
    def blocked(self) -> int:
        return sum(int(np.isinf(np.triu(roadmap.direct)).sum()) for roadmap in self.maps)

    def carries(self, node: int) -> int:
        """The load state on the arm at a node of a tour, −1 for none; node 0 is without."""
        state = -1 if node == 0 else int(self.load[node - 1])
        return state if state >= 0 and self.loaded[state] else -1

    def unloaded_twice(self, tour: list[int]) -> tuple[Moves, list[int]]:
        """With another visit of each pose that is read without load, and these nodes, in the
        reverse order of the tour; none where nothing is read under load."""
        if not self.loaded[self.load].any():
            return self, []
        again = np.array([v - 1 for v in tour[::-1] if not self.loaded[self.load[v - 1]]], int)
        own = {n: getattr(self, n) for n in ("pose", "load", "leave", "sides", "free")}
        more: dict[str, Any] = {n: np.concatenate([of, of[again]]) for n, of in own.items()}
        return replace(self, **more), (len(self.pose) + 1 + np.arange(len(again))).tolist()

    def travel(self) -> Array:
        """Times (V + 1, V + 1) from one visit through the next one as known so far, node 0 being
        the beginning and the end; what cannot be reached takes more than everything else together.
        The arm begins and ends without load, at home or, without one, anywhere."""
        n, home = len(self.pose), self.home
        # The load is on the arm during a move only if it is before and after: it is hung and taken
        # off where the arm stands for a loaded reading.
        carries = np.append(False, self.loaded[self.load])
        with_load = carries[:, None] & carries[None, :]
        plain, loaded = (roadmap.costs() for roadmap in self.maps)
        found = np.zeros((n + 1, n + 1))
        ways = np.ix_(self.leave, self.entry)
        found[1:, 1:] = np.where(with_load[1:, 1:], loaded[ways], plain[ways])
        if home is not None:
            found[0, 1:], found[1:, 0] = plain[home, self.entry], plain[self.leave, home]
        found[:, 1:] += self.inside
        np.fill_diagonal(found, 0.0)
        finite = np.isfinite(found)
        # Any tour travels less than this in all, if it needs no unreachable move.
        found[~finite] = max(float(found[finite].max()) * (n + 1), 1.0)
        return found

    def way(self, u: int, v: int) -> tuple[Roadmap, list[int]]:
        """The roadmap and the points from node u to the entry of node v, both included, as far as
        beginning and end are anywhere; the ends alone where no way is known."""
        roadmap = self.maps[int(self.carries(u) >= 0 and self.carries(v) >= 0)]
        goal = self.home if v == 0 else int(self.entry[v - 1])
        start = self.home if u == 0 else int(self.leave[u - 1])
        if goal is None:
            return roadmap, []
        return roadmap, [goal] if start is None else [start, *roadmap.way(start, goal)]

    def check(self, tour: list[int]) -> bool:
        """Check every straight move of the tour not yet checked; is one of them news, blocked?"""
        wanted: list[list[tuple[int, int]]] = [[], []]
        for u, v in pairwise([0, *tour, 0]):
            roadmap, way = self.way(u, v)
            # Where no way is left, every move has been checked: nothing to be learnt.
            wanted[roadmap.loaded] += [m for m in pairwise(way) if np.isfinite(roadmap.direct[m])]
        return not all([self.maps[k].check(wanted[k]) for k in (0, 1)])

    def settle(self) -> None:
        """Check the ways between all visits: many at once take less time than a few again and
        again, 75 s of CPU instead of 270 for 30 poses where nine of ten moves are blocked under the
        load (experiment_design/kr270_plan/crowded.toml)."""
        for roadmap in self.maps:
            here = self.loaded[self.load] | (not roadmap.loaded)
            home = [] if self.home is None or roadmap.loaded else [self.home]
            ends = home + self.entry[here & np.isfinite(self.inside)].tolist()
            starts = home + self.leave[here].tolist()
            pairs = {(min(m), max(m)) for m in product(starts, ends) if m[0] != m[1]}
            roadmap.settle(sorted(pairs))

    # What no move reaches is Unreachable, with what is in the way where the checker can tell.

    def check_reach(self) -> None:
        """Can each pose be approached from one side at least, where it has to be, and does a chain
        of free moves join it to the others under load, and without, where it is hung and taken off,
        to all (and home)?"""
        for roadmap in self.maps:
            here = self.loaded[self.load] == roadmap.loaded
            for v in np.flatnonzero(here & ~self.free.any(axis=1)):
                pose, (below, above) = int(self.leave[v]), self.sides[v].tolist()
                raise Unreachable(
                    f"{self._name(pose)} cannot be approached{roadmap.carrying}, neither from below"
                    f"{self._in_the_way(roadmap, below, pose)} nor from above"
                    f"{self._in_the_way(roadmap, above, pose)}; lower overshoot_deg in "
                    "[design.motion], or raise clearance_mm in [workspace]",
                    self.pose[v],
                )
            here |= not roadmap.loaded
            needed = [int(point) for point in dict.fromkeys(self.leave[here])]
            if self.home is not None and not roadmap.loaded:
                needed.insert(0, self.home)
            if len(needed) < 2:
                continue
            most, *lost = roadmap.parts(needed)
            if lost:
                every = [point for part in lost for point in part]
                # Where most hang together, all others are told at once.
                clear = len(most) > len(every) and self.home not in every
                raise self._unreachable(roadmap, every if clear else lost[0])

    def _unreachable(self, roadmap: Roadmap, lost: list[int]) -> Unreachable:
        named = some(map(self._name, lost), MOST_NAMED)
        others = np.setdiff1d(np.arange(len(self.points)), lost)
        between = self.times[lost][:, others]
        i, j = np.unravel_index(int(np.argmin(between)), between.shape)
        by = self._in_the_way(roadmap, int(others[j]), lost[int(i)])
        return Unreachable(
            f"{named} cannot be reached{roadmap.carrying} by collision-free joint moves, "
            f"neither directly nor through home and other poses{by}; give another home in "
            "[design.motion], free the way, or narrow [limits] to exclude such poses",
            *np.unique(self.pose[np.isin(self.leave, lost)]),
        )

    def _name(self, point: int) -> str:
        chain = self.maps[0].checker.chain
        joints = ", ".join(told(chain, j, value) for j, value in enumerate(self.points[point]))
        if point == self.home:
            return f"home (joints {joints})"
        return f"pose {point + (self.home is None)} (joints {joints})"

    def _in_the_way(self, roadmap: Roadmap, i: int, j: int) -> str:
        points, loaded = roadmap.points, roadmap.loaded
        names = roadmap.checker.blockers(points[i], points[j], loaded)
        return f" (in the way: {', '.join(names)})" if names else ""


def approach_signs(chain: Chain, q: Array, lower: Array, upper: Array, by: float) -> IntArray:
    """Directions (N, 2, n) of the last motion of each joint, from q − sign · `by`: first
    upwards (+1), then down (−1), so that backlash and hysteresis show; both times from the same
    side where the other is beyond the limits [lower, upper] (n,)."""
    below, above = q - by >= lower, q + by <= upper
    if not (below | above).all():
        i, j = (int(v) for v in np.argwhere(~(below | above))[0])
        raise InputError(
            f"pose {i + 1}: joint {j + 1} has no room on either side of {told(chain, j, q[i, j])} "
            f"for an overshoot of {told(chain, j, by)}; lower overshoot_deg in "
            "[design.motion], or widen its limits"
        )
    return np.stack([np.where(below, 1, -1), np.where(above, -1, 1)], axis=1)
