"""Commanded joints near nominal ones that reach the targets, with uncertainty and notices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.model.calibrated_tool import CalibratedTool
from elastocal.model.chain import Chain
from elastocal.model.inverse_kinematics import (
    ARM_LENGTH,
    BoundedSearch,
    Postures,
    Reaching,
    inverse_kinematics,
    unwound,
)
from elastocal.model.inverse_kinematics import TOLERANCE as NOMINAL_TOLERANCE
from elastocal.units import Array, IntArray

# What the robot would be commanded without calibration: nominal joints along a path.

STEP = 0.1  # rad or m between neighbours that count as one smooth piece
LARGE = np.radians(20.0)  # a step beyond which another posture may be nearer
LONGEST_PIECE = 256  # rows solved at once


def nominal_path(
    chain: Chain,
    position: Array,
    rotation: Array | None,
    point: Array,
    limits: tuple[Array, Array],
    near: Array | None,
    seed: int = 0,
) -> tuple[Array, NDArray[np.bool_]]:
    """Nominal joints (n, joints) that bring `point` (3,) of the flange to places along a path, and
    whether the nominal arm reaches each place (n,); where not, the nearest posture stands there.

    `position` (n, 3) m and `rotation` (n, 3, 3) of the flange, or None for any, in the base
    frame.  The first place is reached in the posture nearest to `near` (default: the middle of
    the joint ranges), every other from the one before it, so that neighbouring places have
    neighbouring joints.  Where that fails, or takes a large step, the nearest of many postures
    is taken.
    """
    walk = _Walk(chain, position, rotation, point, limits, seed)
    walk.leap(0, near)
    first, length = 1, 1
    while first < len(position):
        taken = walk.piece(first, min(length, len(position) - first))
        length = min(2 * length, LONGEST_PIECE) if taken == length else max(taken, 1)
        if not taken:
            walk.leap(first, walk.last)
        first += max(taken, 1)
    return walk.q, walk.reached


@dataclass(eq=False)
class _Walk:
    chain: Chain
    position: Array
    rotation: Array | None
    point: Array
    limits: tuple[Array, Array]
    seed: int

    def __post_init__(self) -> None:
        self.q = np.zeros((len(self.position), self.chain.n_joints))
        self.reached = np.zeros(len(self.position), dtype=bool)
        self.last: Array | None = None
        self._ahead: Postures | None = None
        self._ahead_from, self._leaps = 0, 1
        place = self.position, self.rotation, self.point
        self._task = Reaching(self.chain, *place, None, *self.limits)

    def piece(self, first: int, length: int) -> int:
        """How many of the next places are reached smoothly from the last posture; kept if so."""
        if self.last is None:
            return 0
        target = np.arange(first, first + length)
        q, _ = self._task.solve(np.tile(self.last, (length, 1)), target)
        miss, turn = self._task.errors(q, target)
        good = (miss <= NOMINAL_TOLERANCE) & (turn <= NOMINAL_TOLERANCE)
        steps = np.abs(np.diff(np.vstack([self.last, q]), axis=0)).max(axis=1)
        good &= np.append(steps[:1] <= LARGE, steps[1:] <= STEP)
        taken = int(np.argmin(good)) if not good.all() else length
        self._keep(first, q[:taken], np.ones(taken, dtype=bool))
        return taken

    def leap(self, i: int, near: Array | None) -> None:
        """Place i from anywhere: the posture nearest to `near`, or what comes nearest to it."""
        found = self._many(i, near)
        k = i - self._ahead_from
        q, good = found.q[k], found.reached[k]
        if near is not None and good.any():
            q = unwound(self.chain, q[good], near, *self.limits)
            q = q[np.argmin(np.linalg.norm(q - near, axis=1))][None]
            if self.chain.n_joints > self._task.equations:
                q = self._task.nearest(q, np.array([i]), near)
            good = np.ones(1, dtype=bool)
        self._keep(i, q[:1], good[:1])

    def _many(self, i: int, near: Array | None) -> Postures:
        """Postures of place i and of some that follow: who leaps once will leap again."""
        if self._ahead is None or not 0 <= i - self._ahead_from < len(self._ahead.q):
            self._leaps = min(2 * self._leaps, LONGEST_PIECE) if self._ahead is not None else 1
            rows = slice(i, i + self._leaps)
            rotation = None if self.rotation is None else self.rotation[rows]
            self._ahead_from = i
            self._ahead = inverse_kinematics(
                self.chain, self.position[rows], self.limits, rotation=rotation,
                point=self.point, near=near, seed=self.seed,
            )  # fmt: skip
        return self._ahead

    def _keep(self, first: int, q: Array, reached: NDArray[np.bool_]) -> None:
        rows = slice(first, first + len(q))
        self.q[rows], self.reached[rows] = q, reached
        if len(q) and reached[-1]:
            self.last = q[-1]


def jumps(task: Reaching, q: Array, usable: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows i whose joints leave those of row i − 1 by much more than the tool's motion asks for.

    q (n, joints); rows that are not `usable` are passed over.  The measure is the step of least
    norm that the tool's motion asks for, J⁺r, at either end; steps below 20° never count.
    """
    rows = np.flatnonzero(usable)
    if len(rows) < 2:
        return np.zeros(0, dtype=np.int64)
    before, after = rows[:-1], rows[1:]
    step = q[after] - q[before]
    asked = np.zeros(len(step))
    for ends, target in ((before, after), (after, before)):
        r, J = task.residual(q[ends], target)
        least = (np.linalg.pinv(J, rcond=1e-6) @ r[..., None])[..., 0]
        asked = np.maximum(asked, np.linalg.norm(least, axis=1))
    large = np.abs(step).max(axis=1) > LARGE
    return np.asarray(after[large & (np.linalg.norm(step, axis=1) > 3 * asked)])


# Commanded joints that put the calibrated tool at its targets, near nominal commands.

TOLERANCE = 1e-8  # m and rad within which a target counts as reached
POLISHES = 20
SETTLED = 1e-13  # rad or m


@dataclass(frozen=True)
class Goals:
    """`position` (n, 3) m and `rotation` (n, 3, 3), or None for any, in the data's frame."""

    position: Array
    rotation: Array | None

    def in_base(self, T: Array) -> Goals:
        """The same in the base frame, which stands at T (n, 4, 4) in the data's frame."""
        back = T[:, :3, :3].transpose(0, 2, 1)
        position = np.einsum("nij,nj->ni", back, self.position - T[:, :3, 3])
        return Goals(position, None if self.rotation is None else back @ self.rotation)


@dataclass(frozen=True)
class Solved:
    """`q` (n, joints); `miss` (n,) m and `turn` (n,) rad that are left (NaN: no equilibrium)."""

    q: Array
    miss: Array
    turn: Array

    def replaced(self, rows: IntArray, other: Solved) -> Solved:
        """The same with `other` in the rows named."""
        new = Solved(self.q.copy(), self.miss.copy(), self.turn.copy())
        new.q[rows], new.miss[rows], new.turn[rows] = other.q, other.miss, other.turn
        return new

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
        return self.judged(q, target)

    def judged(self, q: Array, target: IntArray) -> Solved:
        """Commands q with what they miss."""
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
        # Row by row what reaches with the smaller correction.
        now, before = (self.judged(v, target) for v in (q, started))
        shorter = np.linalg.norm(q - nominal, axis=1) <= np.linalg.norm(started - nominal, axis=1)
        take = now.reached & (shorter | ~before.reached)
        return np.where(take[:, None], q, started)
