"""Inverse kinematics: joints that bring a point of the flange where it shall be.

From many starts over the joint ranges (scrambled Sobol points) to the minima of the error; all
targets and starts are one batch, with derivatives from CasADi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.limits import finite_ranges
from elastocal.manipulator.reaching import REACHED, TOLERANCE, IntArray, Reaching

ROUNDS = (1, 1, 2, 4)  # starts per posture told; the later ones for targets missed by the first
PULLED = 4  # of them, how many are moved within their null space
BLOCK = 10_000  # starts at a time, which bounds the memory


@dataclass(frozen=True)
class Postures:
    """For T targets K postures each, reached ones first, the nearest to `near` of all first.

    `q` (T, K, n) rad or m; `miss` (T, K) m and `turn` (T, K) rad: what is left of the errors in
    position and rotation (zero where none is prescribed).
    """

    q: Array
    miss: Array
    turn: Array

    @property
    def reached(self) -> NDArray[np.bool_]:
        """(T, K)"""
        return (self.miss <= TOLERANCE) & (self.turn <= TOLERANCE)

    @property
    def out_of_reach(self) -> IntArray:
        """Indices of the targets that no posture reaches; miss[t, 0] says how near it got."""
        return np.flatnonzero(~self.reached.any(axis=1))


def inverse_kinematics(
    chain: Chain,
    position: Array,
    limits: tuple[Array, Array],
    *,
    rotation: Array | None = None,
    point: Array | None = None,
    T_data_base: Array | None = None,
    near: Array | None = None,
    postures: int = 16,
    seed: int = 0,
) -> Postures:
    """Postures of the nominal chain that bring `point` to `position` (T, 3) m in the data frame.

    `limits`: lower and upper (n,) rad or m, infinite where there is none; `rotation` (3, 3) or
    (T, 3, 3) of the flange in the data frame, None for any; `point` (3,) m in the flange frame;
    `near` (n,): the posture to stay near, by default the middle of the ranges; `postures`: K, a
    power of two.  Where joints or
    the free rotation leave a choice, the first posture is moved to the nearest one; the others
    stand where the solver met them, so that there is a choice.
    """
    lower, upper = limits
    task = Reaching(chain, position, rotation, point, T_data_base, lower, upper)
    low, high = finite_ranges(chain, lower, upper, near)
    near = (low + high) / 2 if near is None else np.clip(near, lower, upper)
    sobol = qmc.Sobol(chain.n_joints, scramble=True, seed=seed)
    starts = [low + (high - low) * sobol.random_base2(int(np.log2(postures * n))) for n in ROUNDS]
    starts[0] = np.vstack([near, starts[0]])
    size = max(BLOCK // postures, 1)
    blocks = [
        _postures(chain, task, np.arange(first, min(first + size, len(position))), starts, near)
        for first in range(0, len(position), size)
    ]
    q = np.concatenate(blocks)
    target = np.repeat(np.arange(len(position)), postures)
    miss, turn = task.errors(q.reshape(len(target), -1), target)
    return Postures(q, miss.reshape(-1, postures), turn.reshape(-1, postures))


def _postures(
    chain: Chain, task: Reaching, targets: IntArray, starts: list[Array], near: Array
) -> Array:
    """The best postures (targets, K, n) of some targets, from the `starts` in turn."""
    T, K, n = len(targets), len(starts[-1]) // ROUNDS[-1], len(near)
    q, cost = np.zeros((T, K, n)), np.full((T, K), np.inf)
    left = np.arange(T)
    for some in starts:
        found, value = task.solve(
            np.tile(some, (len(left), 1)), np.repeat(targets[left], len(some))
        )
        found = unwound(chain, found, near, task.lower, task.upper)
        found = np.concatenate([q[left], found.reshape(len(left), -1, n)], axis=1)
        value = np.concatenate([cost[left], value.reshape(len(left), -1)], axis=1)
        order = _best_first(value, found, near)[:, :K]
        q[left] = np.take_along_axis(found, order[:, :, None], axis=1)
        cost[left] = np.take_along_axis(value, order, axis=1)
        left = left[cost[left, 0] > REACHED]
        if not len(left):
            break
    pulled = cost[:, :PULLED] <= REACHED
    target = targets[np.nonzero(pulled)[0]]
    q[:, :PULLED][pulled] = task.nearest(q[:, :PULLED][pulled], target, near)
    return np.take_along_axis(q, _best_first(cost, q, near)[:, :, None], axis=1)


def _best_first(cost: Array, q: Array, near: Array) -> IntArray:
    """Order of postures (T, K): reached before missed, then by distance from `near` or cost."""
    reached = cost <= REACHED
    distance = np.linalg.norm(q - near, axis=2)
    return np.lexsort((np.where(reached, distance, cost), ~reached), axis=1)


def unwound(chain: Chain, q: Array, near: Array, lower: Array, upper: Array) -> Array:
    """The same postures with revolute joints turned back by whole turns, as near as allowed."""
    turn = 2 * np.pi
    turns = np.round((near - q) / turn)
    # Rounded inwards a little less, so that a joint at its limit stays where it is.
    fewest, most = np.ceil((lower - q) / turn - 1e-12), np.floor((upper - q) / turn + 1e-12)
    turns = np.where([kind == "revolute" for kind in chain.kinds], turns, 0.0)
    return np.asarray(np.clip(q + turn * np.clip(turns, fewest, most), lower, upper))
