"""What has to be visited: poses under load states, from which points they are entered and left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Visits:
    """V visits, each of one pose in one load state, as indices into the roadmap's points.

    A visit is entered at one of `entry` (V, O), takes `inside` (V, O) s from there on, inf where
    that entry is blocked, and is left from `leave` (V,), where the pose is.  Entry o is the side
    from which the pose is approached first; without approaches the pose itself is the one entry.
    """

    pose: IntArray
    load: IntArray
    leave: IntArray
    entry: IntArray
    inside: Array

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True)
class Costs:
    """`cost` (V + 1, V + 1) of going from one visit through the next one, node 0 being the
    beginning and the end, and `side` (V + 1, V): the entry taken.

    Contained in `cost`: `apart` for going to another load state, `changed` where that changes
    what hangs on the arm.
    """

    cost: Array
    apart: Array
    changed: Array
    side: IntArray


def loaded_between(visits: Visits, loaded: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(V + 1, V + 1): is the load on the arm during the move?  Only if it is before and after.

    So loads are hung and taken off where the arm stands for a loaded reading, and moves to and
    from the beginning, node 0, are without.
    """
    carries = np.concatenate([[False], loaded[visits.load]])
    return np.asarray(carries[:, None] & carries[None, :])


def visit_costs(
    visits: Visits,
    loaded: NDArray[np.bool_],
    times: tuple[Array, Array],
    home: int | None,
) -> Costs:
    """Costs of all moves, from the times (m, m) between points without and with load.

    Load states are kept together and changed as rarely as can be: going to another one costs
    more than all travelling, and twice that if what hangs on the arm changes.  The arm begins
    and ends without load, at point `home` or, where that is None, anywhere.  What cannot be
    reached costs more than everything else together.
    """
    n = len(visits)
    with_load = loaded_between(visits, loaded)
    travel = np.zeros((n + 1, n + 1))
    side = np.zeros((n + 1, n), dtype=np.int64)
    for layer, between in enumerate(times):
        leave = visits.leave if home is None else np.append(home, visits.leave)
        ways = between[leave[:, None, None], visits.entry[None]]
        back = np.zeros(n) if home is None else between[visits.leave, home]
        if home is None:
            ways = np.concatenate([np.zeros((1, *ways.shape[1:])), ways])
        ways = ways + visits.inside
        here = with_load == bool(layer)
        side = np.where(here[:, 1:], ways.argmin(axis=2), side)
        travel[:, 1:] = np.where(here[:, 1:], ways.min(axis=2), travel[:, 1:])
        travel[1:, 0] = np.where(here[1:, 0], back, travel[1:, 0])
    np.fill_diagonal(travel, 0.0)
    finite = np.isfinite(travel)
    # Any tour travels less than this in all, if it needs no unreachable move.
    change = max(float(travel[finite].max()) * (n + 1), 1.0)
    states = np.append(-1, visits.load)
    # The beginning is its own block; the unloaded states carry the same as it: nothing.
    carried = np.append(-1, np.where(loaded[visits.load], visits.load, -1))
    apart = change * (states[:, None] != states[None])
    changed = change * (carried[:, None] != carried[None])
    travel[~finite] = 4 * change * (n + 1)
    return Costs(travel + apart + changed, apart, changed, side)
