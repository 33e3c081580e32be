"""The calibrated arm as a Denavit–Hartenberg table, standard or modified.

Calibration leaves neighbouring axes skew, so a table of four parameters per joint holds them;
where they are nearly parallel there is a column beta_rad.  Rows of type fixed carry what no joint
row can: where the first axis stands in the base frame, and the flange.  Numbers that calibration
did not change are those of the nominal arm.

The chain is written as  L₀ X₀ · L₁(q₁) X₁ · … · L_n(q_n) X_n · F  with L = Rz(θ) Tz(d) and
X = Tx(a) Rx(α) Ry(β).  A standard row is an L with the X after it, a modified row an L with the
X before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import Literal

import numpy as np

from elastocal.cell import Robot
from elastocal.export.dh_rows import Row, split
from elastocal.export.pieces import Pieces
from elastocal.manipulator.chain import Array, Chain, Joint
from elastocal.manipulator.dh import FIXED, dh_number, read_dh_table
from elastocal.manipulator.effects.compliances import transverse_axes
from elastocal.tables import csv_text

Convention = Literal["standard", "modified"]
CONVENTIONS: dict[str, Convention] = {"dh": "standard", "mdh": "modified"}
HEADER = ("joint", "type", "theta0_rad", "d_m", "a_m", "alpha_rad", "beta_rad")
LIMITS = {"revolute": ("lower_rad", "upper_rad"), "prismatic": ("lower_m", "upper_m")}
ZERO = 1e-14  # m or rad; rounding of a product of rotations


@dataclass(frozen=True)
class Line:
    """One row of the table: `joint` None for a fixed one."""

    name: str
    joint: Joint | None
    row: Row


def dh_lines(robot: Robot, pieces: Pieces, convention: Convention) -> list[Line]:
    """The rows of the calibrated table; `robot` says which nominal table, if any, to keep to."""
    nominal = pieces.chain
    like = _nominal_rows(robot, nominal, convention)
    ideal = [
        row if own is None else row.near(own)
        for row, own in zip(_decompose(nominal, like)[0], like, strict=True)
    ]
    rows, F = _decompose(pieces.calibrated_chain(), ideal, keep_last=True)
    first, *joints = [row.near(old) for row, old in zip(rows, ideal, strict=True)]
    end, last = split(F)
    flange = [end, Row(theta=math.atan2(last[1, 0], last[0, 0]), d=float(last[2, 3]))]
    # (what moves, L and X) in the order of the chain
    whole: list[tuple[str, Joint | None, Row]] = [("base", None, first)]
    whole += [(j.name, j, row) for j, row in zip(nominal.joints, joints, strict=True)]
    whole += [(f"flange{k}", None, row) for k, row in enumerate(flange, start=1)]
    if convention == "modified":
        before = [Row(), *(row for _, _, row in whole[:-1])]
        whole = [
            (name, joint, replace(b, theta=row.theta, d=row.d))
            for (name, joint, row), b in zip(whole, before, strict=True)
        ]
    cleaned = [Line(name, joint, row.near(Row(), ZERO)) for name, joint, row in whole]
    return [line for line in cleaned if line.joint is not None or line.row != Row()]


FORMULA = {
    "standard": "T = Rz(theta0 + q) Tz(d) Tx(a) Rx(alpha) Ry(beta) per row",
    "modified": "T = Rx(alpha) Tx(a) Ry(beta) Rz(theta0 + q) Tz(d) per row",
}


def dh_csv(lines: Sequence[Line], comments: Sequence[str] = ()) -> str:
    """CSV text of a table, which `[robot] dh` reads: angles in rad, lengths in m.

    beta_rad stands there only where a row needs it; limits are those of commanded values; comments
    begin with #.
    """
    with_beta = any(line.row.beta for line in lines)
    kinds = {line.joint.kind for line in lines if line.joint is not None and _limits(line.joint)}
    limits = [name for kind, names in LIMITS.items() if kind in kinds for name in names]
    header = [*(HEADER if with_beta else HEADER[:-1]), *limits]
    rows = []
    for line in lines:
        numbers = dict(zip(HEADER[2:], astuple(line.row), strict=True))
        if line.joint is not None:
            numbers |= _limits(line.joint)
        kind = FIXED if line.joint is None else line.joint.kind
        cells = [repr(numbers[name] + 0.0) if name in numbers else "" for name in header[2:]]
        rows.append([line.name, kind, *cells])
    return csv_text(header, rows, comments)


def without_beta(lines: Sequence[Line]) -> list[Line]:
    """The same table with β left out, as programs of four columns read it."""
    return [replace(line, row=replace(line.row, beta=0.0)) for line in lines]


def _decompose(
    chain: Chain, like: Sequence[Row | None], keep_last: bool = False
) -> tuple[list[Row], Array]:
    """Rows 0 … n of a chain and its flange in the last row's frame, near the rows `like`.

    `keep_last`: the last row changes in θ and d alone, the rest is the flange's.  Its z is often
    in line with the last axis, where a row of its own would turn any way.
    """
    turned = [_z_to(joint.axis) for joint in chain.joints]
    ends = [*(joint.placement for joint in chain.joints), chain.flange_placement]
    starts = [np.eye(4), *turned]
    rows: list[Row] = []
    carried: Array = np.eye(4)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        last = i == chain.n_joints
        T = carried @ np.linalg.inv(start) @ end @ (np.eye(4) if last else turned[i])
        near = like[i]
        if last and keep_last and near is not None:
            row = _along_axis(T, near)
            carried = np.asarray(np.linalg.solve(row.transform(), T), dtype=np.float64)
        else:
            row, carried = split(T, near, height=float(T[2, 3]) if last else 0.0)
        rows.append(row)
    return rows, carried


def _along_axis(T: Array, near: Row) -> Row:
    """`near` with the turn about and the shift along its axis that bring it closest to T."""
    R = T[:3, :3] @ near.trailing()[:3, :3].T
    theta = math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
    theta += 2 * math.pi * round((near.theta - theta) / (2 * math.pi))
    return replace(near, theta=theta, d=float(T[2, 3]))


def _z_to(axis: Array) -> Array:
    """A rotation (4, 4) whose z column is the axis; the identity where that is z already."""
    T = np.eye(4)
    x, y = transverse_axes(axis)
    T[:3, :3] = np.column_stack([x, y, axis])
    return T


def _nominal_rows(robot: Robot, chain: Chain, convention: Convention) -> list[Row | None]:
    """What the user's own table says of links 0 … n; None where it is in another convention."""
    nothing: list[Row | None] = [None] * (chain.n_joints + 1)
    if robot.dh is None or robot.dh_convention != convention:
        return nothing
    table = read_dh_table(robot.dh)
    n = len(table.row)
    if any(table.text(i, "type") == FIXED for i in range(n)):
        return nothing
    keys = (
        ("angle", "theta0"),
        ("length", "d"),
        ("length", "a"),
        ("angle", "alpha"),
        ("angle", "beta"),
    )
    numbers = np.nan_to_num([[dh_number(table, i, *key) for key in keys] for i in range(n)])
    own = [Row(*row) for row in numbers.tolist()]
    if convention == "standard":
        return [Row(), *own]
    after = [*own[1:], Row()]
    first = replace(own[0], theta=0.0, d=0.0)
    pairs = zip(own, after, strict=True)
    return [first, *(replace(a, theta=row.theta, d=row.d) for row, a in pairs)]


def _limits(joint: Joint) -> dict[str, float]:
    ends = zip(LIMITS[joint.kind], (joint.lower, joint.upper), strict=True)
    return {name: value for name, value in ends if math.isfinite(value)}
