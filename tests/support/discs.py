"""A stand-in for the cell: round obstacles in a plane of two joints, and brute force over it."""

from itertools import pairwise, permutations
from types import SimpleNamespace

import numpy as np


class Discs:
    """Moves are free where they stay out of discs (k, 3) of x, y, radius; the load adds `grow`
    to the radii.  Counts what it is asked."""

    chain = SimpleNamespace(kinds=("revolute", "revolute"))

    def __init__(self, discs=(), grow=0.0, named=()):  # what it says is in the way
        self.discs, self.grow, self.named, self.asked = np.reshape(discs, (-1, 3)), grow, named, []

    def paths_free(self, q_from, q_to, loaded):
        self.asked += [(tuple(a), tuple(b), loaded) for a, b in zip(q_from, q_to, strict=True)]
        return np.array([self.free(a, b, loaded) for a, b in zip(q_from, q_to, strict=True)])

    def blockers(self, q_from, q_to, loaded):
        return self.named

    def free(self, a, b, loaded):
        step = b - a
        for x, y, r in self.discs:
            c = np.array([x, y])
            t = np.clip((c - a) @ step / max(step @ step, 1e-300), 0, 1)
            if np.linalg.norm(a + t * step - c) < r + self.grow * loaded:
                return False
        return True


def ways(points, checker, loaded):
    """All-pairs shortest times through free straight moves (Floyd–Warshall), inf for none."""
    n = len(points)
    time = np.abs(points[:, None] - points[None]).max(axis=2)
    for i in range(n):
        for j in range(n):
            if i != j and not checker.free(points[i], points[j], loaded):
                time[i, j] = np.inf
    for k in range(n):
        time = np.minimum(time, time[:, k : k + 1] + time[k])
    return time


def best_time(q, checker, home=None, loads=(False,), via=None):
    """Least travel time over all orders of the blocks and of the poses in each block."""
    extra = np.zeros((0, 2)) if via is None else via
    points = np.vstack([q, extra] if home is None else [q, extra, home[None]])
    time = {loaded: ways(points, checker, loaded) for loaded in (False, True)}
    least = np.inf
    for blocks in permutations(loads):
        orders = [[]]
        for loaded in blocks:
            orders = [o + [(i, loaded) for i in p] for o in orders
                      for p in permutations(range(len(q)))]  # fmt: skip
        for order in orders:
            total = sum(time[a[1] and b[1]][a[0], b[0]] for a, b in pairwise(order))
            if home is not None:
                total += time[False][-1, order[0][0]] + time[False][order[-1][0], -1]
            least = min(least, total)
    return least
