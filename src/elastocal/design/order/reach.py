"""Poses that no collision-free move reaches, told before and after the routing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from elastocal.design.order.moves import Moves
from elastocal.design.order.roadmap import Roadmap
from elastocal.design.order.visits import Costs
from elastocal.errors import InsufficientDataError

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
# The bodies in the way of the straight move between two joint vectors (n,), with or without load.
Blockers = Callable[[Array, Array, bool], Sequence[str]]

MOST_NAMED = 3


class Unreachable(InsufficientDataError):
    """Some poses of a plan cannot be reached: `poses` are their indices."""

    def __init__(self, message: str, poses: IntArray) -> None:
        super().__init__(message)
        self.poses = poses


def check_reachable(moves: Moves, blockers: Blockers | None) -> None:
    """Raise Unreachable for a pose that cannot be approached from either side, where
    it has to be, or that no chain of free moves joins to the others (or home) of its load state."""
    for roadmap in moves.maps:
        here = moves.loaded[moves.visits.load] == roadmap.loaded
        leave = moves.visits.leave[here]
        if moves.signs is not None:
            _check_approaches(moves, roadmap, here, blockers)
        needed = [int(point) for point in dict.fromkeys(leave)]
        if moves.home is not None and len(needed) and not roadmap.loaded:
            needed.insert(0, moves.home)
        if len(needed) < 2:
            continue
        _, *lost = roadmap.parts(needed)
        if lost:
            raise _unreachable(moves, roadmap, lost[0], blockers)


def _check_approaches(
    moves: Moves, roadmap: Roadmap, here: NDArray[np.bool_], blockers: Blockers | None
) -> None:
    for v in np.flatnonzero(here & ~np.isfinite(moves.visits.inside).any(axis=1)):
        pose, (below, above) = int(moves.visits.leave[v]), moves.visits.entry[v].tolist()
        raise Unreachable(
            f"{_name(moves, pose)} cannot be approached{_carrying(roadmap)}, neither from below"
            f"{_in_the_way(roadmap, below, pose, blockers)} nor from above"
            f"{_in_the_way(roadmap, above, pose, blockers)}; lower overshoot_deg in "
            "[design.motion], or raise clearance_mm in [workspace]",
            moves.visits.pose[[v]],
        )


def refuse_impossible(
    moves: Moves, tour: list[int], costs: Costs, blockers: Blockers | None
) -> None:
    """Raise Unreachable where the tour holds a move for which no way is left."""
    for u, v in pairwise([0, *tour, 0]):
        roadmap, way = moves.way(u, v, costs)
        if len(way) > 1 and not np.isfinite(roadmap.direct[way[:-1], way[1:]]).all():
            lost = [int(moves.visits.leave[(v or u) - 1])]
            raise _unreachable(moves, roadmap, lost, blockers)


def _unreachable(
    moves: Moves, roadmap: Roadmap, lost: list[int], blockers: Blockers | None
) -> Unreachable:
    named = ", ".join(_name(moves, point) for point in lost[:MOST_NAMED])
    more = f" and {len(lost) - MOST_NAMED} more" if len(lost) > MOST_NAMED else ""
    others = np.setdiff1d(np.arange(len(moves.points)), lost)
    between = moves.times[lost][:, others]
    i, j = np.unravel_index(int(np.argmin(between)), between.shape)
    by = _in_the_way(roadmap, int(others[j]), lost[int(i)], blockers)
    return Unreachable(
        f"{named}{more} cannot be reached{_carrying(roadmap)} by collision-free joint moves, "
        f"neither directly nor through home and other poses{by}; give "
        "another home in [design.motion], free the way, or narrow [limits] to exclude such poses",
        np.unique(moves.visits.pose[np.isin(moves.visits.leave, lost)]),
    )


def _name(moves: Moves, point: int) -> str:
    joints = ", ".join(f"{value:.3f}" for value in moves.points[point])
    if point == moves.home:
        return f"home (joints {joints})"
    first = 0 if moves.home is None else 1
    return f"pose {point - first + 1} (joints {joints})"


def _carrying(roadmap: Roadmap) -> str:
    return " with the load" if roadmap.loaded else ""


def _in_the_way(roadmap: Roadmap, i: int, j: int, blockers: Blockers | None) -> str:
    """What blocks the straight move between two points, in brackets, where it can be told."""
    if blockers is None:
        return ""
    names = blockers(roadmap.points[i], roadmap.points[j], roadmap.loaded)
    return f" (in the way: {', '.join(names)})" if names else ""
