"""Commanded joints that put the calibrated tool at its targets, near nominal commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.compensation.tool import CalibratedTool
from elastocal.manipulator.chain import Array
from elastocal.manipulator.reaching import ARM_LENGTH, BoundedSearch, IntArray

TOLERANCE = 1e-8  # m and rad within which a target counts as reached
POLISHES = 20
SETTLED = 1e-13  # rad or m


@dataclass(frozen=True)
class Goals:
    """`position` (n, 3) m and `rotation` (n, 3, 3), or None for any, in the data's frame."""

    position: Array
    rotation: Array | None


@dataclass(frozen=True)
class Solved:
    """`q` (n, joints); `miss` (n,) m and `turn` (n,) rad that are left (NaN: no equilibrium)."""

    q: Array
    miss: Array
    turn: Array

    def replaced(self, rows: IntArray, other: Solved) -> Solved:
        """The same with `other` in the rows named."""
        q, miss, turn = self.q.copy(), self.miss.copy(), self.turn.copy()
        q[rows], miss[rows], turn[rows] = other.q, other.miss, other.turn
        return Solved(q, miss, turn)

    @property
    def reached(self) -> NDArray[np.bool_]:
        return (self.miss <= TOLERANCE) & (self.turn <= TOLERANCE)


class Commanding(BoundedSearch):
    """r(q) of the calibrated tool against its goals, searched within the joint limits.

    Levenberg–Marquardt of `BoundedSearch` with the derivative through the equilibrium; where the
    arm has more joints than the task has equations, followed by `least_correction`.
    """

    def __init__(
        self, tool: CalibratedTool, rows: list[NDArray], goals: Goals, lower: Array, upper: Array
    ) -> None:
        super().__init__(lower, upper)
        self.tool, self.rows, self.goals = tool, rows, goals

    def residual(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        rotation = None if self.goals.rotation is None else self.goals.rotation[target]
        rows = [values[target] for values in self.rows]
        return self.tool.errors(rows, q, self.goals.position[target], rotation)

    def misses(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        """Distance in m and angle in rad (R,) from the goals; NaN without an equilibrium."""
        r = self.residual(q, target)[0]
        return np.linalg.norm(r[:, :3], axis=1), np.linalg.norm(r[:, 3:], axis=1) / ARM_LENGTH

    def commands(self, nominal: Array, target: IntArray) -> Solved:
        """Commands for the targets (R,) near nominal ones (R, joints) within the limits."""
        q, _ = self.solve(nominal, target)
        equations = 3 if self.goals.rotation is None else 6
        if self.tool.chain.n_joints > equations:
            q = self.least_correction(q, nominal, target)
        return Solved(q, *self.misses(q, target))

    def least_correction(self, q: Array, nominal: Array, target: IntArray) -> Array:
        """The least ‖q − q₀‖ with r(q) = 0 and limits kept, from commands q that reach.

        Newton's method on the conditions of Karush, Kuhn and Tucker with the curvature of r left
        out (corrections are of the size of the errors, so that it converges in few steps):
        δ = Jᵀλ on free joints with J δ = J (q − q₀) − r; a joint is held at its limit while Jᵀλ
        would take it beyond.  Commands that do not reach, and those that no step improves, stay.
        """
        started = q.copy()
        q = q.copy()
        free = np.ones_like(q, dtype=bool)
        active = np.flatnonzero(np.isfinite(self.misses(q, target)[0]))
        for _ in range(POLISHES):
            r, J = self.residual(q[active], target[active])
            reachable = np.isfinite(r).all(axis=1)
            active, r, J = active[reachable], r[reachable], J[reachable]
            if not len(active):
                break
            delta = q[active] - nominal[active]
            J_free = J * free[active][:, None, :]
            # J δ over the free joints alone: the held ones stay where they are.
            wanted = (J_free @ delta[..., None])[..., 0] - r
            multiplier = np.linalg.pinv(J_free @ J_free.transpose(0, 2, 1), rcond=1e-12)
            wish = (J.transpose(0, 2, 1) @ (multiplier @ wanted[..., None]))[..., 0]
            goal = nominal[active] + wish
            free[active] = (goal >= self.lower) & (goal <= self.upper)
            trial = np.clip(goal, self.lower, self.upper)
            moved = np.abs(trial - q[active]).max(axis=1)
            q[active] = trial
            active = active[moved > SETTLED]
            if not len(active):
                break
        return self._better(q, started, nominal, target)

    def _better(self, q: Array, started: Array, nominal: Array, target: IntArray) -> Array:
        """Of two sets of commands, row by row those that reach with the smaller correction."""
        now, before = (Solved(v, *self.misses(v, target)) for v in (q, started))
        shorter = np.linalg.norm(q - nominal, axis=1) <= np.linalg.norm(started - nominal, axis=1)
        take = now.reached & (shorter | ~before.reached)
        return np.where(take[:, None], q, started)
