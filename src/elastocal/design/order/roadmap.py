"""Which joint moves are free: a graph over joint vectors whose edges are checked when needed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csgraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Added to every edge, relative to the longest one: of equally long ways the one with fewer stops.
PER_EDGE = 1e-9


class PathChecker(Protocol):
    """Says whether the arm may move straight in joint space from one joint vector to another."""

    def paths_free(self, q_from: Array, q_to: Array, loaded: bool) -> NDArray[np.bool_]:
        """(M,): are all configurations from q_from to q_to (M, n), ends included, allowed?

        `loaded`: with the hanging load.  The answer for the way back is the same.
        """
        ...


def travel_times(points: Array, speed: Array | None) -> Array:
    """Times (m, m) in s of synchronised joint moves between `points` (m, n).

    t_ij = max_k |q_ik − q_jk| / v_k with `speed` v (n,) in rad/s or m/s, 1 where it is None.
    Being a metric, no way through other points is faster than the straight one.
    """
    q = points if speed is None else points / speed
    return np.asarray(np.abs(q[:, None] - q[None]).max(axis=2))


class Roadmap:
    """Joint vectors `points` (m, n) and the straight moves between them, in one load state.

    A move counts as free until it is checked; a blocked one is replaced by the fastest way
    through other points.  So costs never exceed the true ones, and a tour that is optimal at
    these costs and whose moves have all been checked is optimal (lazy shortest paths: Bohlin
    and Kavraki 2000).
    """

    def __init__(self, points: Array, times: Array, loaded: bool, checker: PathChecker) -> None:
        self.points, self.loaded, self.checker = points, loaded, checker
        self.direct = times.copy()  # inf where blocked
        self.verdict: dict[tuple[int, int], bool] = {}
        self._ways: tuple[Array, NDArray[np.integer]] | None = None

    def check(self, moves: Iterable[tuple[int, int]]) -> bool:
        """Are the straight moves between these pairs of points all free?  Each is checked once,
        those not checked before together."""
        pairs = {(min(move), max(move)) for move in moves if move[0] != move[1]}
        new = sorted(pairs - self.verdict.keys())
        if new:
            i, j = np.array(new).T
            free = self.checker.paths_free(self.points[i], self.points[j], self.loaded)
            self.verdict.update(zip(new, (bool(f) for f in free), strict=True))
            blocked = ~np.asarray(free)
            self.direct[i[blocked], j[blocked]] = self.direct[j[blocked], i[blocked]] = np.inf
            self._ways = None
        return all(self.verdict[pair] for pair in pairs)

    @property
    def blocked(self) -> int:
        """How many straight moves were found blocked."""
        return sum(not verdict for verdict in self.verdict.values())

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

        Only as many moves are checked as it takes, first among `needed`, then through all points.
        """
        part = np.arange(len(self.points))
        for among in (needed, list(range(len(self.points)))):
            if len(set(part[needed])) > 1:
                self._join(part, np.array(among), needed)
        labels = part[needed]
        found = [[p for p in needed if part[p] == label] for label in dict.fromkeys(labels)]
        return sorted(found, key=len, reverse=True)

    def _join(self, part: IntArray, among: IntArray, needed: list[int]) -> None:
        """Relabel `part` (m,) by free moves between points of `among`, until all of `needed` are
        of one part or no move is left (Borůvka: every part tries its shortest ways out, twice as
        many each time)."""
        tries = 1
        while len(set(part[needed])) > 1:
            new: list[tuple[int, int]] = []
            for label in set(part[among]):
                own, others = among[part[among] == label], among[part[among] != label]
                out = self.direct[np.ix_(own, others)]
                for k in np.argsort(out, axis=None, kind="stable")[:tries]:
                    i, j = np.unravel_index(k, out.shape)
                    if np.isfinite(out[i, j]):
                        new.append((int(own[i]), int(others[j])))
            if not new:
                return
            self.check(new)
            for i, j in new:
                if np.isfinite(self.direct[i, j]):
                    part[part == part[j]] = part[i]
            tries *= 2
