"""Denavit–Hartenberg table → nominal chain.

    standard:  T_{i-1,i} = Rz(θ_i + q_i) Tz(d_i) Tx(a_i) Rx(α_i) Ry(β_i)
    modified:  T_{i-1,i} = Rx(α_{i-1}) Tx(a_{i-1}) Ry(β_{i-1}) Rz(θ_i + q_i) Tz(d_i)      (Craig)

β is Hayati's fifth parameter for nearly parallel axes (Hayati 1983), zero where the table has no
such column.  Rows of type fixed have no q: they place the first axis in the base, or the flange.
In the modified convention row i holds α_{i-1} and a_{i-1}.  A prismatic joint adds its q to d
instead of θ.  Each joint of the chain moves about or along z of its own frame.  That frame is
DH frame i (modified), or DH frame i−1 turned by θ_i about z (standard, where DH frame i sits at
the far end of the link): what follows the motion, Tz(d) Tx(a) Rx(α), then belongs to the next
placement.  The flange is DH frame n.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np

from elastocal.errors import InputError
from elastocal.manipulator import rigid
from elastocal.manipulator.chain import (
    MAX_JOINTS,
    MIN_JOINTS,
    Array,
    Chain,
    Joint,
    JointKind,
    LinkMass,
)
from elastocal.manipulator.number_table import Quantity, Row, Table, read_table
from elastocal.nearest import did_you_mean, listed

Convention = Literal["standard", "modified"]
ANGLE, LENGTH = ("rad", "deg"), ("m", "mm")
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
FIXED = "fixed"
# Beyond these a unit in the header is wrong: two turns, and longer than any arm's link.
MAX_ANGLE, MAX_LENGTH = 4 * math.pi, 50.0

DH_COLUMNS = (
    Quantity("theta0", ANGLE, "angle"),
    Quantity("d", LENGTH, "length"),
    Quantity("a", LENGTH, "length"),
    Quantity("alpha", ANGLE, "angle"),
    Quantity("beta", ANGLE, "angle", required=False),
    Quantity("lower", ANGLE, "angular limit", required=False),
    Quantity("upper", ANGLE, "angular limit", required=False),
    Quantity("lower travel", LENGTH, "limit of travel", required=False, shared_header="lower"),
    Quantity("upper travel", LENGTH, "limit of travel", required=False, shared_header="upper"),
)
MASS_COLUMNS = (
    Quantity("mass", ("kg",), "mass"),
    Quantity("com_x", LENGTH, "centre of mass"),
    Quantity("com_y", LENGTH, "centre of mass"),
    Quantity("com_z", LENGTH, "centre of mass"),
)


def read_dh(
    path: str | Path,
    convention: Convention = "standard",
    masses_path: str | Path | None = None,
    name: str | None = None,
) -> Chain:
    """The chain of a DH table in CSV, one row per joint.

    Columns theta0_rad|deg, d_m|mm, a_m|mm, alpha_rad|deg; optional: beta_rad|deg, joint (name),
    type (revolute|prismatic|fixed), limits lower_/upper_rad|deg for revolute and
    lower_/upper_m|mm for prismatic joints (blank: none).  masses_path: CSV with link (1…n, linkN or
    the joint's name), mass_kg, com_x_m, com_y_m, com_z_m, the centre of mass in DH frame i; every
    link once.

    Raises InputError, naming file, row and column.
    """
    path = Path(path)
    if convention not in ("standard", "modified"):
        raise InputError(
            f"dh_convention '{convention}'{did_you_mean(str(convention), ('standard', 'modified'))}"
            " is unknown; valid: standard, modified"
        )
    table = read_table(path, DH_COLUMNS, ("joint", "type"))
    moving = [row for row in table.rows if row.texts["type"] != FIXED]
    if not MIN_JOINTS <= len(moving) <= MAX_JOINTS:
        raise InputError(
            f"{path}: {len(moving)} rows below the header, one per joint; "
            f"{MIN_JOINTS} to {MAX_JOINTS} joints are supported"
        )
    waiting = iter(_joint_names(path, moving))
    joints, after, passed = [], [], np.eye(4)
    for row in table.rows:
        T_before, T_after = _link(row, table, convention)
        if row.texts["type"] == FIXED:
            passed = passed @ T_before @ T_after
            continue
        kind = _kind(row)
        lower, upper = _limits(row, kind, table)
        joints.append(Joint(next(waiting), kind, passed @ T_before, np.array(Z), lower, upper))
        passed = T_after
        after.append(T_after)
    names = [joint.name for joint in joints]
    masses = () if masses_path is None else _masses(Path(masses_path), names, after)
    return Chain(name or path.stem, tuple(joints), passed, masses)


def _link(row: Row, table: Table, convention: str) -> tuple[Array, Array]:
    """T_{i-1,i}(q_i) = before · motion(q_i) · after: the two constant factors."""
    theta0, d, a, alpha = (
        _plausible(row, name, table.column_of[name]) for name in ("theta0", "d", "a", "alpha")
    )
    Rz_theta, Tz_d = _rotation(Z, theta0), _translation(Z, d)
    Tx_a, Rx_alpha = _translation(X, a), _rotation(X, alpha)
    Ry_beta = _rotation(Y, 0.0)
    if row.numbers.get("beta") is not None:
        Ry_beta = _rotation(Y, _plausible(row, "beta", table.column_of["beta"]))
    if convention == "standard":
        return _numbers(Rz_theta), _numbers(Tz_d @ Tx_a @ Rx_alpha @ Ry_beta)
    return _numbers(Rx_alpha @ Tx_a @ Ry_beta @ Rz_theta @ Tz_d), np.eye(4)


def _rotation(axis: tuple[float, float, float], angle: float) -> ca.SX:
    return rigid.joint_motion("revolute", axis, angle)


def _translation(axis: tuple[float, float, float], length: float) -> ca.SX:
    return rigid.joint_motion("prismatic", axis, length)


def _numbers(T: ca.SX) -> Array:
    return np.array(ca.DM(T).full())


def _plausible(row: Row, name: str, column: str) -> float:
    value = row.require(name, column)
    if column.endswith("_rad") and abs(value) > MAX_ANGLE:
        raise InputError(
            f"{row.where}, column {column}: {value:g} rad is more than two turns; "
            f"if these are degrees, call the column {name}_deg"
        )
    if column.endswith("_m") and abs(value) > MAX_LENGTH:
        raise InputError(
            f"{row.where}, column {column}: {value:g} m is too long for a link; "
            f"if these are millimetres, call the column {name}_mm"
        )
    return value


def _kind(row: Row) -> JointKind:
    text = row.texts["type"] or "revolute"
    if text == "revolute" or text == "prismatic":
        return "prismatic" if text == "prismatic" else "revolute"
    raise InputError(
        f"{row.where}, column type: unknown joint type '{text}'"
        f"{did_you_mean(text, ('revolute', 'prismatic', FIXED))}; valid: revolute, prismatic, fixed"
    )


def _limits(row: Row, kind: JointKind, table: Table) -> tuple[float, float]:
    own, other = ("", " travel") if kind == "revolute" else (" travel", "")
    for side in ("lower", "upper"):
        if row.numbers.get(side + other) is not None:
            raise InputError(
                f"{row.where}, column {table.column_of[side + other]}: the joint is {kind}; leave "
                f"this blank and give its limits in {'rad or deg' if own == '' else 'm or mm'}"
            )
    lower, upper = row.numbers.get("lower" + own), row.numbers.get("upper" + own)
    lower = -np.inf if lower is None else lower
    upper = np.inf if upper is None else upper
    if lower >= upper:
        raise InputError(
            f"{row.where}, columns {table.column_of['lower' + own]} and "
            f"{table.column_of['upper' + own]}: lower is not below upper; check the limits"
        )
    return lower, upper


def _joint_names(path: Path, rows: Sequence[Row]) -> list[str]:
    names = [row.texts["joint"] or f"joint{i}" for i, row in enumerate(rows, start=1)]
    for row, name in zip(rows, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{row.where}, column joint: '{name}' appears twice; rename one")
    return names


def _masses(path: Path, names: Sequence[str], after: Sequence[Array]) -> tuple[LinkMass, ...]:
    """Masses by link, centres of mass taken from DH frame i to joint frame i."""
    table = read_table(path, MASS_COLUMNS, ("link",))
    found: dict[int, LinkMass] = {}
    for row in table.rows:
        i = _link_index(row, names)
        if i in found:
            raise InputError(f"{row.where}, column link: '{row.texts['link']}' appears twice")
        mass, x, y, z = (row.require(q.name, table.column_of[q.name]) for q in MASS_COLUMNS)
        if mass < 0:
            raise InputError(f"{row.where}, column mass_kg: {mass:g} is negative; give 0 or more")
        found[i] = LinkMass(mass, (after[i] @ np.array([x, y, z, 1.0]))[:3])
    missing = [f"link{i + 1}" for i in range(len(names)) if i not in found]
    if missing:
        raise InputError(
            f"{path}: no row for {listed(missing)}; give every link, with mass_kg 0 if it has none"
        )
    return tuple(found[i] for i in range(len(names)))


def _link_index(row: Row, names: Sequence[str]) -> int:
    text = row.texts["link"]
    if text in names:
        return names.index(text)
    numbered = [f"link{i + 1}" for i in range(len(names))]
    for spelling in (text, f"link{text}", text.replace("joint", "link")):
        if spelling in numbered:
            return numbered.index(spelling)
    valid = (*numbered, *names)
    raise InputError(
        f"{row.where}, column link: unknown link '{text}'{did_you_mean(text, valid)}; "
        f"valid: {listed(numbered)} or the joints' names"
    )
