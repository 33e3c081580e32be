"""May the arm stand there, and may it go there?  All rules of the cell in one place."""

from __future__ import annotations

from functools import cached_property
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.design.feasibility.advice import advice
from elastocal.design.feasibility.bodies import Body, cell_bodies
from elastocal.design.feasibility.collision import Collisions
from elastocal.design.feasibility.frames import Kinematics, Poses
from elastocal.design.feasibility.pairs import Pair, cell_pairs
from elastocal.design.feasibility.paths import Paths
from elastocal.design.feasibility.rule_book import rule_book
from elastocal.design.feasibility.rules import Rule
from elastocal.design.feasibility.verdict import Verdict
from elastocal.errors import InputError
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.limits import finite_ranges, joint_limits

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LOADED = np.array([0.0, 0.0, -1.0])  # any force: the load hangs
SAMPLE = 300  # random poses in which a pair must once keep apart to be believed


_last_restored: dict[str, Feasibility] = {}


def _restored(token: str, cell: Cell, chain: Chain) -> Feasibility:
    """The rules anew, once per process: with every task the same ones are sent again."""
    if token not in _last_restored:
        _last_restored.clear()
        _last_restored[token] = Feasibility(cell, chain)
    return _last_restored[token]


class Feasibility:
    """The rules of a cell for the nominal, rigid arm.

    `bodies` and `pairs`: what there is and what must keep apart; `rules` in the order of
    checking, cheap ones first.  Pickles by its cell and chain, so that processes can share it.
    Raises InputError for a workspace that does not fit the robot.
    """

    def __init__(self, cell: Cell, chain: Chain) -> None:
        self.cell, self.chain, self._token = cell, chain, uuid4().hex
        self.kinematics = Kinematics(cell, chain)
        self.bodies: tuple[Body, ...] = cell_bodies(cell, chain)
        self.pairs: tuple[Pair, ...] = cell_pairs(cell, chain, self.bodies)
        self.rules: tuple[Rule, ...] = rule_book(
            cell, chain, self.kinematics, self.bodies, self.pairs
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._token, self.cell, self.chain)

    def check(self, q: Array, force: Array) -> Verdict:
        """Every rule on every pose q (N, n) rad or m under a force (3,) or (N, 3) N.

        The load hangs wherever the force is not zero.  Raises InputError for joint values that
        are not finite or of another robot.
        """
        poses = self._poses(q, force)
        broken = np.stack([rule.broken(poses) for rule in self.rules], axis=1)
        return Verdict(tuple(rule.name for rule in self.rules), broken, poses.q, poses.force)

    def feasible(self, q: Array, force: Array) -> BoolArray:
        """(N,) as check(q, force).ok, without looking at a pose again that broke a rule."""
        poses = self._poses(q, force)
        left = np.arange(len(poses))
        for rule in self.rules:
            left = left[~rule.broken(poses.take(left))]
        ok = np.zeros(len(poses), dtype=bool)
        ok[left] = True
        return ok

    def advice(self, verdict: Verdict) -> str:
        """Which rule to relax, how many candidates that frees, and how."""
        text = advice(verdict, self.rules, self.kinematics)
        for a, b in self.always_in_contact:
            text += (
                f"; {a} and {b} are too close in every pose, which is probably a wrong size or "
                f'place: correct it, or add ["{a}", "{b}"] to [workspace] ignored_pairs'
            )
        return text

    @cached_property
    def always_in_contact(self) -> tuple[tuple[str, str], ...]:
        """Pairs too close in each of 300 random poses: likely modelling errors."""
        lower, upper = finite_ranges(self.chain, *joint_limits(self.cell, self.chain))
        q = np.random.default_rng(0).uniform(lower, upper, (SAMPLE, len(lower)))
        poses = self._poses(q, LOADED)
        return tuple(
            pair.names
            for pair in self.pairs
            if Collisions(self.kinematics, [pair]).hits(poses).all()
        )

    def path_free(self, q_from: Array, q_to: Array, loaded: bool) -> bool:
        """The joint interpolation q_from → q_to (n,) breaks no margin at any point of it."""
        return bool(self.paths_free(np.atleast_2d(q_from), np.atleast_2d(q_to), loaded)[0])

    def paths_free(self, q_from: Array, q_to: Array, loaded: bool | BoolArray) -> BoolArray:
        """(M,) for moves q_from → q_to (M, n); `loaded` for all or per move (M,).

        Keep-out, obstacles, self-collision, height and rope angle of the load hold all the way;
        visibility and torque concern poses at rest.  See `Paths` for what "free" guarantees.
        """
        start, end = self._poses(q_from, LOADED).q, self._poses(q_to, LOADED).q
        start, end = np.broadcast_arrays(start, end)
        return self._paths.free(start, end, np.broadcast_to(loaded, len(start)))

    @cached_property
    def _paths(self) -> Paths:
        return Paths(self.kinematics, self.bodies, self.pairs, self.cell.workspace.load)

    def _poses(self, q: Array, force: Array) -> Poses:
        q = np.atleast_2d(np.asarray(q, dtype=float))
        if q.shape[1] != self.chain.n_joints:
            raise InputError(
                f"poses have {q.shape[1]} joint values, but robot '{self.chain.name}' has "
                f"{self.chain.n_joints} joints"
            )
        if not np.isfinite(q).all():
            raise InputError(f"pose {int(np.argwhere(~np.isfinite(q))[0][0])} is not finite")
        return self.kinematics.poses(q, force)
