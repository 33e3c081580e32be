"""Local searches at any pose of a plan: the expressions are built once per level and load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.design.candidates import Checker, feasible
from elastocal.design.feasibility.pairs import Pair
from elastocal.design.information import PoseInformation
from elastocal.design.joint_space import JointSpace
from elastocal.design.polish.local_search import LocalSearch
from elastocal.design.polish.margins import margins
from elastocal.design.polish.objective import SymbolicBlocks, symbolic_blocks, whitened_at

Array = NDArray[np.float64]

# Shares of the way from a start to where its search ended that are tried: IPOPT sees B at
# simplified deflections and the rules in part, so that its end need not be the best, or feasible.
STEPS = (1.0, 0.9, 0.7, 0.4, 0.15)
APART = 0.2  # rad or m between starts in at least one joint


@dataclass
class Searches:
    """What local searches need to know of the cell; `pairs` as of `cell_pairs`."""

    information: PoseInformation
    space: JointSpace
    checker: Checker
    pairs: Sequence[Pair]
    _built: dict[tuple[int, int], SymbolicBlocks] = field(default_factory=dict)
    _margins: dict[int, ca.Function | None] = field(default_factory=dict)

    def at(self, q: Array, load: int, group: int) -> LocalSearch:
        """The search among poses of a group in a load state, with the noise of readings at q."""
        if (load, group) not in self._built:
            self._built[load, group] = symbolic_blocks(self.information, q, load)
        if load not in self._margins:
            model = self.information.model
            self._margins[load] = margins(model.cell, model.chain, self.pairs, self.forces(load))
        blocks = whitened_at(self._built[load, group], self.information, q, load)
        return LocalSearch(blocks, self._margins[load], *self.space.bounds(group))

    def forces(self, load: int) -> Array:
        """The forces (k, 3) N under which a pose in load state `load` is measured."""
        states = self.information.states
        return np.asarray(states.forces[states.of(load)])

    def feasible(self, q: Array, load: int) -> NDArray[np.bool_]:
        """The full check of poses q (N, n) in one load state."""
        return feasible(self.checker, q, self.forces(load))

    def blocks(self, q: Array, load: int) -> Array:
        """Exact blocks (S, N, r, p) of poses q (N, n) in one load state."""
        return self.information.blocks(q, np.full(len(q), load))


def trials(starts: Array, ends: Array) -> Array:
    """Poses (K·steps, n) on the way from each start (K, n) to its end, the ends first."""
    way = ends - starts
    return np.concatenate([starts + step * way for step in STEPS])


def distinct(q: Array, count: int) -> NDArray[np.int64]:
    """Indices of the first `count` poses of q (N, n) that lie `APART` from those before."""
    chosen: list[int] = []
    for i, pose in enumerate(q):
        if len(chosen) == count:
            break
        if all(np.abs(pose - q[k]).max() > APART for k in chosen):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)
