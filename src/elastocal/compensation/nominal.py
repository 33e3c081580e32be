"""What the robot would be commanded without calibration: nominal joints along a path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.inverse_kinematics import Postures, inverse_kinematics, unwound
from elastocal.manipulator.reaching import TOLERANCE as NOMINAL_TOLERANCE
from elastocal.manipulator.reaching import Reaching

STEP = 0.1  # rad or m between neighbours that count as one smooth piece
LARGE = np.radians(20.0)  # a step beyond which another posture may be nearer
LONGEST_PIECE = 256  # rows solved at once


@dataclass(frozen=True)
class Nominal:
    """`q` (n, joints) and whether the nominal arm `reached` (n,) each place; where it did not,
    q is the posture that comes nearest."""

    q: Array
    reached: NDArray[np.bool_]


def nominal_path(
    chain: Chain,
    position: Array,
    rotation: Array | None,
    point: Array,
    limits: tuple[Array, Array],
    near: Array | None,
    seed: int = 0,
) -> Nominal:
    """Nominal joints that bring `point` (3,) of the flange to places along a path.

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
    return Nominal(walk.q, walk.reached)


class _Walk:
    def __init__(
        self,
        chain: Chain,
        position: Array,
        rotation: Array | None,
        point: Array,
        limits: tuple[Array, Array],
        seed: int,
    ) -> None:
        self.chain, self.position, self.rotation = chain, position, rotation
        self.point, self.limits, self.seed = point, limits, seed
        self.q = np.zeros((len(position), chain.n_joints))
        self.reached = np.zeros(len(position), dtype=bool)
        self.last: Array | None = None
        self._ahead: Postures | None = None
        self._ahead_from, self._leaps = 0, 1
        self._task = Reaching(chain, position, rotation, point, None, *limits)

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
            self._keep(i, q, np.ones(1, dtype=bool))
            return
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
