"""What a file lacks of the arm as a correction of its joints: q_effective = f(q_commanded)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import InputError, require
from elastocal.files import read_text
from elastocal.tables import csv_text
from elastocal.units import Array

HEADER = ("joint", "follows", "position", "delta")
JOINT, SIDE = "joint", "approach"
MOST_BYTES = 50_000_000
SEEN = 1e-7  # rad or m: a curve that stays below moves a tool by 0.1 µm in a metre


@dataclass(frozen=True)
class CorrectionCurve:
    """`delta` (k,) rad or m that joint `joint` (0-based) stands beyond its command, against
    `position` (k,) of what it `follows`: "joint2" in rad or m, or "approach2", -1 or 1."""

    joint: int
    follows: str
    position: Array
    delta: Array


@dataclass(frozen=True)
class JointCorrection:
    """q_effective,j = q_j + Σ_i g_ji(q_i) + Σ_i s_ji a_i, a_i = ±1 the direction of joint i's last
    motion: where an exported arm is to be commanded so that it stands where the real one does when
    commanded to q.  Curves are linear between their rows and constant beyond.

    Examples:
        >>> from elastocal.export.joint_correction import read_joint_correction
        >>> effective = read_joint_correction("joints.csv")
        >>> effective([0.4, -1.0, 1.0, 0.0, 0.5, 0.0]).round(3)
        array([ 0.4, -1. ,  1. ,  0. ,  0.5,  0. ])
    """

    curves: tuple[CorrectionCurve, ...]

    def __call__(self, q: ArrayLike, approach: ArrayLike | None = None) -> NDArray:
        """Joints to command (joints,) or (n, joints); without `approach`, like q, no curve that
        follows it counts."""
        given = np.asarray(q, dtype=float)
        sides = np.zeros_like(given) if approach is None else np.asarray(approach, dtype=float)
        found = given.copy()
        for curve in self.curves:
            kind = SIDE if curve.follows.startswith(SIDE) else JOINT
            at = (sides if kind == SIDE else given)[..., int(curve.follows[len(kind) :]) - 1]
            found[..., curve.joint] += np.interp(at, curve.position, curve.delta)
        return found

    def merged(self) -> JointCorrection:
        """The same with one curve for each joint and what it follows, without those too small to
        be seen."""
        alike: dict[tuple[int, str], list[CorrectionCurve]] = {}
        for curve in self.curves:
            alike.setdefault((curve.joint, curve.follows), []).append(curve)
        found = []
        for (joint, follows), parts in sorted(alike.items()):
            x = np.unique(np.concatenate([part.position for part in parts]))
            total = sum((np.interp(x, p.position, p.delta) for p in parts), np.zeros(len(x)))
            if np.abs(total).max() > SEEN:
                found.append(CorrectionCurve(joint, follows, x, total))
        return JointCorrection(tuple(found))

    def csv(self, comments: Sequence[str] = ()) -> str:
        """The table as text; positions and deltas in rad, of prismatic joints in m."""
        return csv_text(HEADER, self._rows(), comments)

    def _rows(self) -> Iterator[tuple[str, ...]]:
        for curve in self.curves:
            for position, delta in zip(curve.position, curve.delta, strict=True):
                name = f"{JOINT}{curve.joint + 1}"
                yield name, curve.follows, f"{position:.6g}", f"{delta + 0.0:.4e}"


def read_joint_correction(path: str | Path) -> JointCorrection:
    """The correction that `export --joint-correction` wrote.  Raises InputError for other files."""
    lines = [
        line
        for line in read_text(path, "joint correction", MOST_BYTES).splitlines()
        if line[:1] != "#"
    ]
    require(
        bool(lines) and lines[0] == ",".join(HEADER),
        f"{path}: its columns are not {', '.join(HEADER)}; give the file that export wrote",
    )
    rows: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for number, line in enumerate(lines[1:], start=2):
        try:
            name, follows, position, delta = line.split(",")
            int(name.removeprefix(JOINT)), int(follows.removeprefix(JOINT).removeprefix(SIDE))
            rows.setdefault((name, follows), []).append((float(position), float(delta)))
        except ValueError:
            raise InputError(
                f"{path}, row {number}: '{line}' is no joint, what it follows and two numbers; "
                "export it anew"
            ) from None
    return JointCorrection(
        tuple(
            CorrectionCurve(int(name.removeprefix(JOINT)) - 1, follows, *np.array(pairs).T)
            for (name, follows), pairs in rows.items()
        )
    )
