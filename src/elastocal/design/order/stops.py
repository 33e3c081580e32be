"""From a tour over visits to the stops of an execution."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from elastocal.design.order.execution import Stop
from elastocal.design.order.moves import Moves
from elastocal.design.order.visits import Costs

Array = NDArray[np.float64]


def stops_of(moves: Moves, tour: list[int], costs: Costs) -> tuple[Stop, ...]:
    """The stops of a tour whose moves have all been checked."""
    return tuple(stop for u, v in pairwise([0, *tour]) for stop in _stops(moves, u, v, costs))


def way_home(moves: Moves, last: int, costs: Costs) -> tuple[Array, float]:
    """Via points (k, n) from the node `last` to home, and the time; nothing without a home."""
    _, way = moves.way(last, 0, costs)
    return moves.points[way[1:-1]], _time(moves, way)


def _stops(moves: Moves, u: int, v: int, costs: Costs) -> list[Stop]:
    """The reading of node v after node u, or two where it is approached from both sides."""
    _, way = moves.way(u, v, costs)
    visits, node = moves.visits, v - 1
    pose, load, leave = int(visits.pose[node]), int(visits.load[node]), int(visits.leave[node])
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
    other = int(visits.entry[node, 1 - side])
    signs = moves.signs[pose]
    first = Stop(
        pose=pose,
        load=load,
        q=q,
        via=moves.points[passed],
        travel=_time(moves, [*way, leave]),
        change_after=change,
        approach=signs[side],
        side=side,
    )
    if not np.isfinite(visits.inside[node, 1 - side]):
        return [first]
    second = Stop(
        pose=pose,
        load=load,
        q=q,
        via=moves.points[[other]],
        travel=_time(moves, [leave, other, leave]),
        approach=signs[1 - side],
        side=1 - side,
    )
    return [first, second]


def _time(moves: Moves, way: list[int]) -> float:
    return float(sum(moves.times[i, j] for i, j in pairwise(way)))
