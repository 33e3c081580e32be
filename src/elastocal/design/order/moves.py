"""The points of a schedule, its visits, and the moves between them, checked when needed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Motion
from elastocal.design.order.approach import approach_points, approach_signs
from elastocal.design.order.roadmap import PathChecker, Roadmap, travel_times
from elastocal.design.order.visits import Costs, Visits, visit_costs
from elastocal.errors import InputError, require

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Moves:
    """Home, poses, points of approach and via points in one list, and the visits among them.

    `points` (m, n), and `times` (m, m) between them; `maps`: the roadmaps without and with
    load; `home`: its point or None; `signs` (N, 2, n) where poses are approached from both
    sides; `loaded` (L,): which load states have a load.
    """

    points: Array
    times: Array
    maps: tuple[Roadmap, Roadmap]
    visits: Visits
    loaded: NDArray[np.bool_]
    home: int | None
    signs: IntArray | None

    @classmethod
    def of(
        cls,
        q: Array,
        motion: Motion,
        checker: PathChecker,
        forces: Array,
        load: IntArray | None,
        limits: tuple[Array, Array] | None,
        via: Array | None,
    ) -> Moves:
        """The arguments of `schedule`, checked and laid out."""
        n_poses, n = q.shape
        _check_motion(motion, n)
        pose = np.repeat(np.arange(n_poses), len(forces) if load is None else 1)
        state = np.tile(np.arange(len(forces)), n_poses) if load is None else np.asarray(load)
        require(
            state.shape == pose.shape and bool(np.isin(state, np.arange(len(forces))).all()),
            f"load must be one of {len(forces)} load states for each of {n_poses} poses",
        )
        home = None if motion.home is None else 0
        start = np.zeros((0, n)) if motion.home is None else motion.home[None]
        leave = len(start) + pose
        between, signs = np.zeros((0, n)), None
        entry = leave[:, None]
        if motion.both_directions:
            if limits is None:
                raise InputError("approaches from both sides need the joint limits")
            signs = approach_signs(q, *limits, motion.overshoot)
            between = approach_points(q, signs, motion.overshoot).reshape(-1, n)
            entry = len(start) + n_poses + 2 * pose[:, None] + np.arange(2)
        points = np.vstack([start, q, between, np.zeros((0, n)) if via is None else via])
        times = travel_times(points, motion.speed)
        maps = (Roadmap(points, times, False, checker), Roadmap(points, times, True, checker))
        loaded = (forces != 0).any(axis=1)
        inside = times[leave[:, None], entry]
        if signs is not None:
            inside = _approach_times(inside, _free_sides(maps, loaded[state], leave, entry))
        visits = Visits(pose, state, leave, entry, inside)
        return cls(points, times, maps, visits, loaded, home, signs)

    @property
    def checked(self) -> int:
        return sum(len(roadmap.verdict) for roadmap in self.maps)

    @property
    def blocked(self) -> int:
        return sum(roadmap.blocked for roadmap in self.maps)

    def carries(self, node: int) -> int:
        """The load state on the arm at a node of a tour, −1 for none; node 0 is without."""
        state = -1 if node == 0 else int(self.visits.load[node - 1])
        return state if state >= 0 and self.loaded[state] else -1

    def costs(self) -> Costs:
        """Costs between visits as known so far."""
        times = (self.maps[0].costs(), self.maps[1].costs())
        return visit_costs(self.visits, self.loaded, times, self.home)

    def way(self, u: int, v: int, costs: Costs) -> tuple[Roadmap, list[int]]:
        """The roadmap and the points from node u to the entry of node v, both included.

        Only the last point where u is the beginning and there is no home; none where v is the
        end; the ends alone where no way is known.
        """
        roadmap = self.maps[int(self.carries(u) >= 0 and self.carries(v) >= 0)]
        goal = self.home if v == 0 else int(self.visits.entry[v - 1, costs.side[u, v - 1]])
        start = self.home if u == 0 else int(self.visits.leave[u - 1])
        if goal is None:
            return roadmap, []
        if start is None:
            return roadmap, [goal]
        return roadmap, [start, *roadmap.way(start, goal)]

    def check(self, tour: list[int], costs: Costs) -> bool:
        """Check every straight move of the tour not yet checked; is one of them news, blocked?"""
        wanted: list[list[tuple[int, int]]] = [[], []]
        for u, v in pairwise([0, *tour, 0]):
            roadmap, way = self.way(u, v, costs)
            # Where no way is left, every move has been checked: nothing to be learnt.
            wanted[roadmap.loaded] += [m for m in pairwise(way) if np.isfinite(roadmap.direct[m])]
        return not all([self.maps[k].check(wanted[k]) for k in (0, 1)])


def _free_sides(
    maps: tuple[Roadmap, Roadmap], loaded: NDArray[np.bool_], leave: IntArray, entry: IntArray
) -> NDArray[np.bool_]:
    """(V, 2): is the last stretch to the pose free from that side?"""
    stretch = np.stack([entry, np.broadcast_to(leave[:, None], entry.shape)], axis=2)
    for roadmap in maps:
        roadmap.check(stretch[loaded == roadmap.loaded].reshape(-1, 2).tolist())
    free = np.zeros(entry.shape, dtype=bool)
    for v, side in np.ndindex(*entry.shape):
        free[v, side] = maps[int(loaded[v])].check([(int(entry[v, side]), int(leave[v]))])
    return free


def _approach_times(reach: Array, free: NDArray[np.bool_]) -> Array:
    """Time (V, 2) from the first entry on: the approach, then to the other side and back, where
    that is free; inf where this side is not."""
    back = np.where(free, 2 * reach, 0.0)[:, ::-1]
    return np.asarray(np.where(free, reach + back, np.inf))


def _check_motion(motion: Motion, n: int) -> None:
    speed, home = motion.speed, motion.home
    require(
        speed is None or (speed.shape in ((1,), (n,)) and bool((speed > 0).all())),
        f"[design.motion] needs {n} positive joint speeds, or one for all; found {speed}",
    )
    require(
        home is None or home.shape == (n,),
        f"[design.motion] home needs {n} joint values; found {home}",
    )
