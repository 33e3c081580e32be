"""Commanded joints near nominal ones that reach the targets, with uncertainty and notices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from elastocal.errors import InputError, option, require
from elastocal.measurements import Measurements, read_measurements
from elastocal.model.calibrated import CalibratedTool, numbers
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

Frame = Literal["base", "tracker"]
FRAMES: tuple[Frame, ...] = ("base", "tracker")


@dataclass(frozen=True)
class Targets:
    """n targets; `table` holds their force (n, 3) N and circumstances, one row each.

    `position` (n, 3) m and `rotation` (n, 3, 3) of the tool, and the forces, stand in `frame`;
    rotation None: any.  `q` (n, joints) is the nominal command, None where it is to be found;
    without a position the tool is to be where the nominal arm has it at q.
    """

    table: Measurements
    frame: Frame
    position: Array | None
    rotation: Array | None
    q: Array | None

    def __len__(self) -> int:
        return len(self.table)

    def place(self, i: int) -> str:
        return f"{self.table.source}, line {self.table.row[i]}"


def read_targets(
    path: str | Path, joint_kinds: tuple[str, ...], frame: Frame, force: Array | None = None
) -> Targets:
    """Targets of a CSV or Parquet file whose columns are those of the measurement table.

    x_mm, y_mm, z_mm with rx_deg … or qw … where the rotation is prescribed, or q1_deg … alone,
    or both: joints are then the nominal command to start from.  force_x_N … and circumstances
    (time_s, approach_1, temperature_C, torque_1_Nm) as far as the model needs them; `force`
    (3,) N acts where the table states none.
    """
    table = read_measurements(path, joint_kinds=joint_kinds, observe="targets")
    q = table.q if table.q.shape[1] else None
    if table.position is None:
        extra = (
            "; a rotation alone is no target" if table.rotation is not None and q is None else ""
        )
        require(
            q is not None and table.rotation is None,
            f"{path}: the columns x_mm,y_mm,z_mm are missing; a target needs its position, or the "
            f"nominal command q1_deg … alone{extra}",
        )
        require(
            frame == "base",
            f"{path}: targets by q1_deg … alone are where the nominal arm has the tool, which "
            f"stands in the base frame; leave {option('frame', 'tracker')} away, or give "
            "x_mm,y_mm,z_mm",
        )
    require(
        len(table.marker_names) == 1,
        f"{path}: targets of the markers {', '.join(table.marker_names[:4])} … in one table; the "
        f"point of the tool is chosen by {option('point')}: split the table by marker",
    )
    if force is not None:
        require(
            not table.force.any(),
            f"{path}: the table has forces of its own; leave {option('load')} away or drop them",
        )
        table = replace(table, force=np.tile(force, (len(table), 1)))
    rotation = table.rotation
    matrices = None if rotation is None else Rotation.from_rotvec(rotation).as_matrix()
    return Targets(table, frame, table.position, matrices, q)


def one_target(text: str, frame: Frame, force: Array | None = None) -> Targets:
    """The target "x,y,z" in mm, or "x,y,z,rx,ry,rz" with a rotation vector in degrees."""
    what = "x,y,z in mm, or x,y,z,rx,ry,rz in mm and degrees (rotation vector)"
    values = numbers(option("target"), text, (3, 6), what)
    position = values[None, :3] / 1e3
    rotation = None
    if len(values) == 6:
        rotation = Rotation.from_rotvec(np.radians(values[None, 3:])).as_matrix()
    return targets_at(option("target"), position, rotation, frame, force)


def targets_at(
    source: str, position: Array | None, rotation: Array | None, frame: Frame,
    force: Array | None = None, q: Array | None = None,
) -> Targets:  # fmt: skip
    """Targets that no table states, all under one `force` (3,) N; errors name `source`."""
    known = position if position is not None else q
    if known is None:
        raise InputError(f"{source}: neither positions nor joints")
    pull = np.zeros(3) if force is None else force
    table = Measurements.of_poses(source, np.zeros((len(known), 0)), pull)
    return Targets(table, frame, position, rotation, q)


# Targets: where the tool is to be, and in which frame that is stated.

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


@dataclass(frozen=True)
class Goals:
    """`position` (n, 3) m and `rotation` (n, 3, 3), or None for any, in the data's frame."""

    position: Array
    rotation: Array | None

    def in_base(self, T: Array) -> Goals:
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
        new = Solved(self.q.copy(), self.miss.copy(), self.turn.copy())
        new.q[rows], new.miss[rows], new.turn[rows] = other.q, other.miss, other.turn
        return new

    @property
    def reached(self) -> NDArray[np.bool_]:
        return (self.miss <= TOLERANCE) & (self.turn <= TOLERANCE)


class Commanding(BoundedSearch):
    """r(q) of the calibrated tool against its goals, searched within the joint limits.

    Levenberg–Marquardt of `BoundedSearch` with the derivative through the equilibrium.  Its steps
    have the least norm, so that from nominal commands, from which those wanted are a few
    milliradians away, an arm with more joints than the task has equations stays next to them.
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
        return self.judged(self.solve(nominal, target)[0], target)

    def judged(self, q: Array, target: IntArray) -> Solved:
        return Solved(q, *self.misses(q, target))
