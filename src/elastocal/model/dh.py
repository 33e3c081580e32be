"""Denavit–Hartenberg table → nominal chain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from operator import matmul
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np

from elastocal.errors import InputError
from elastocal.model import rigid
from elastocal.model.chain import (
    MAX_JOINTS,
    MAX_LENGTH,
    MIN_JOINTS,
    Chain,
    Joint,
    JointKind,
    LinkMass,
)
from elastocal.tables import (
    NO_UNIT,
    Family,
    Layout,
    RawTable,
    layout_of_columns,
    match_columns,
    read_table,
)
from elastocal.text import did_you_mean, listed
from elastocal.units import Array

Convention = Literal["standard", "modified"]
ANGLE, LENGTH = ("rad", "deg"), ("m", "mm")
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
FIXED = "fixed"
# Two turns: beyond them the unit in the header is wrong.
MAX_ANGLE = 4 * math.pi
MOST_BYTES = 1_000_000

# Multiplied, as these tables always were: 115.7 mm / 1000 is not the same float.
SI = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3, "kg": 1.0}
ENDS = ("lower", "upper")

DH_FAMILIES = (
    Family("joint", "joint names", {"joint": NO_UNIT}, is_label=True, optional=("joint",)),
    Family("type", "joint types", {"type": NO_UNIT}, is_label=True, optional=("type",)),
    Family(
        "angle", "angles", dict.fromkeys(("theta0", "alpha", "beta"), ANGLE), optional=("beta",)
    ),
    Family("length", "lengths", dict.fromkeys(("d", "a"), LENGTH)),
    Family("limit", "angular limits", dict.fromkeys(ENDS, ANGLE), optional=ENDS),
    Family("travel", "limits of travel", dict.fromkeys(ENDS, LENGTH), optional=ENDS),
)
MASS_FAMILIES = (
    Family("link", "links", {"link": NO_UNIT}, is_label=True),
    Family("mass", "masses", {"mass": ("kg",)}),
    Family("com", "centres of mass", dict.fromkeys(("com_x", "com_y", "com_z"), LENGTH)),
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
    table = read_dh_table(path)
    moving = [i for i in range(len(table.row)) if table.text(i, "type") != FIXED]
    if not MIN_JOINTS <= len(moving) <= MAX_JOINTS:
        raise InputError(
            f"{path}: {len(moving)} rows below the header, one per joint; "
            f"{MIN_JOINTS} to {MAX_JOINTS} joints are supported"
        )
    waiting = iter(_joint_names(table, moving))
    joints, after, passed = [], [], np.eye(4)
    for i in range(len(table.row)):
        T_before, T_after = _link(table, i, convention)
        if i not in moving:
            passed = passed @ T_before @ T_after
            continue
        kind = _kind(table, i)
        lower, upper = _limits(table, i, kind)
        joints.append(Joint(next(waiting), kind, passed @ T_before, np.array(Z), lower, upper))
        passed = T_after
        after.append(T_after)
    names = [joint.name for joint in joints]
    masses = () if masses_path is None else _masses(Path(masses_path), names, after)
    return Chain(name or path.stem, tuple(joints), passed, masses)


def read_dh_table(path: Path) -> RawTable:
    """The cells of a DH table; lines that begin with # are comments."""
    return _read(path, DH_FAMILIES, ("angle", "length"), "DH table")


def dh_number(table: RawTable, i: int, family: str, stem: str) -> float:
    """A number of row i in rad, m or kg; NaN where its cell is empty or there is no such column."""
    column = table.column(family, stem)
    return math.nan if column is None else float(table.numbers[column.header][i] * SI[column.unit])


def _read(path: Path, known: Sequence[Family], needed: Sequence[str], what: str) -> RawTable:
    named = {family.name: family for family in known}

    def choose(header: Sequence[str]) -> Layout:
        present = match_columns(str(path), header, named)
        return layout_of_columns(
            str(path), present, named, [(n,) for n in needed], f"a {what} needs"
        )

    return read_table(path, choose, what=what, comments=True, most=MOST_BYTES)


def _link(table: RawTable, i: int, convention: str) -> tuple[Array, Array]:
    """T_{i-1,i}(q_i) = before · motion(q_i) · after: the two constant factors."""
    theta0, alpha, beta = (_plausible(table, i, "angle", k) for k in ("theta0", "alpha", "beta"))
    d, a = (_plausible(table, i, "length", k) for k in ("d", "a"))
    Rz_theta, Tz_d = rotation(Z, theta0), translation(Z, d)
    Tx_a, Rx_alpha = translation(X, a), rotation(X, alpha)
    Ry_beta = rotation(Y, 0.0 if math.isnan(beta) else beta)
    if convention == "standard":
        return product(Rz_theta), product(Tz_d, Tx_a, Rx_alpha, Ry_beta)
    return product(Rx_alpha, Tx_a, Ry_beta, Rz_theta, Tz_d), np.eye(4)


def rotation(axis: tuple[float, float, float], angle: float) -> ca.SX:
    return rigid.joint_motion("revolute", axis, angle)


def translation(axis: tuple[float, float, float], length: float) -> ca.SX:
    return rigid.joint_motion("prismatic", axis, length)


def product(*factors: ca.SX) -> Array:
    """The product (4, 4) of constant transforms."""
    return np.array(ca.DM(reduce(matmul, factors)).full())


def _plausible(table: RawTable, i: int, family: str, stem: str) -> float:
    value, column = dh_number(table, i, family, stem), table.column(family, stem)
    if column is None:
        return value
    lengths = column.unit in LENGTH
    if not abs(value) > (MAX_LENGTH if lengths else MAX_ANGLE):
        return value
    wrong = "m is too long for a link" if lengths else "rad is more than two turns"
    meant = {"rad": ("degrees", "deg"), "m": ("millimetres", "mm")}.get(str(column.unit))
    remedy = (
        f"if these are {meant[0]}, call the column {stem}_{meant[1]}" if meant else "correct it"
    )
    raise InputError(f"{table.where(i, column.header)}: {value:g} {wrong}; {remedy}")


def _kind(table: RawTable, i: int) -> JointKind:
    text = table.text(i, "type") or "revolute"
    if text == "revolute" or text == "prismatic":
        return "prismatic" if text == "prismatic" else "revolute"
    raise InputError(
        f"{table.where(i, 'type')}: unknown joint type '{text}'"
        f"{did_you_mean(text, ('revolute', 'prismatic', FIXED))}; valid: revolute, prismatic, fixed"
    )


def _limits(table: RawTable, i: int, kind: JointKind) -> tuple[float, float]:
    own, other = ("limit", "travel") if kind == "revolute" else ("travel", "limit")
    for side in ENDS:
        wrong = table.column(other, side)
        if wrong is not None and not math.isnan(dh_number(table, i, other, side)):
            raise InputError(
                f"{table.where(i, wrong.header)}: the joint is {kind}; leave this blank and give "
                f"its limits in {'rad or deg' if own == 'limit' else 'm or mm'}"
            )
    lower, upper = (dh_number(table, i, own, side) for side in ENDS)
    if lower >= upper:
        where = table.where(i, *(column.header for column in table.layout.columns[own]))
        raise InputError(f"{where}: lower is not below upper; check the limits")
    return (-np.inf if math.isnan(lower) else lower, np.inf if math.isnan(upper) else upper)


def _joint_names(table: RawTable, rows: Sequence[int]) -> list[str]:
    names = [table.text(i, "joint") or f"joint{k}" for k, i in enumerate(rows, start=1)]
    for i, name in zip(rows, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{table.where(i, 'joint')}: '{name}' appears twice; rename one")
    return names


def _masses(path: Path, names: Sequence[str], after: Sequence[Array]) -> tuple[LinkMass, ...]:
    """Masses by link, centres of mass taken from DH frame i to joint frame i."""
    table = _read(path, MASS_FAMILIES, ("link", "mass", "com"), "table of link masses")
    found: dict[int, LinkMass] = {}
    for k in range(len(table.row)):
        i = _link_index(table, k, names)
        if i in found:
            raise InputError(f"{table.where(k, 'link')}: '{table.text(k, 'link')}' appears twice")
        mass = dh_number(table, k, "mass", "mass")
        com = [dh_number(table, k, "com", f"com_{axis}") for axis in "xyz"]
        if mass < 0:
            raise InputError(f"{table.where(k, 'mass_kg')}: {mass:g} is negative; give 0 or more")
        found[i] = LinkMass(mass, (after[i] @ np.array([*com, 1.0]))[:3])
    missing = [f"link{i + 1}" for i in range(len(names)) if i not in found]
    if missing:
        raise InputError(
            f"{path}: no row for {listed(missing)}; give every link, with mass_kg 0 if it has none"
        )
    return tuple(found[i] for i in range(len(names)))


def _link_index(table: RawTable, row: int, names: Sequence[str]) -> int:
    text = table.text(row, "link")
    if text in names:
        return names.index(text)
    numbered = [f"link{i + 1}" for i in range(len(names))]
    for spelling in (text, f"link{text}", text.replace("joint", "link")):
        if spelling in numbered:
            return numbered.index(spelling)
    valid = (*numbered, *names)
    raise InputError(
        f"{table.where(row, 'link')}: unknown link '{text}'{did_you_mean(text, valid)}; "
        f"valid: {listed(numbered)} or the joints' names"
    )
