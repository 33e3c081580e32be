"""A link between two joint axes as Denavit–Hartenberg parameters.

Every rigid transform between two frames whose z are joint axes is

    T = Rz(θ) Tz(d) Tx(a) Rx(α) · Rz(γ) Tz(h)                 axes not parallel
    T = Rz(θ) Tz(d) Tx(a) Rx(α) Ry(β) · Rz(γ) Tz(h)     nearly parallel, d chosen (Hayati)

Rz(γ) Tz(h) commutes with the motion of the next joint and goes into its θ and d.  So n links are
n rows and one remainder at the flange, exactly.  (Denavit and Hartenberg, J. Appl. Mech. 1955;
Hayati, IEEE Conference on Decision and Control 1983.)
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import casadi as ca
import numpy as np

from elastocal.manipulator import rigid
from elastocal.manipulator.chain import Array

# Below this angle between two axes (rad) the foot of their common normal runs away with the
# smallest error, a/α away; Hayati's parameter keeps it in place.
NEARLY_PARALLEL = 0.02
ANGLES = (0, 3, 4)


@dataclass(frozen=True)
class Row:
    """θ, d, a, α and Hayati's β of one row, in rad and m."""

    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    beta: float = 0.0

    def leading(self) -> Array:
        """Rz(θ) Tz(d) (4, 4): what belongs to the joint's own axis."""
        return _product(_turn("z", self.theta), _shift("z", self.d))

    def trailing(self) -> Array:
        """Tx(a) Rx(α) Ry(β) (4, 4)."""
        return _product(_shift("x", self.a), _turn("x", self.alpha), _turn("y", self.beta))

    def transform(self) -> Array:
        """T (4, 4) of the row with its joint at zero."""
        return self.leading() @ self.trailing()

    def near(self, other: Row, tolerance: float = 1e-12) -> Row:
        """This row with the other's number wherever the two agree to rounding."""
        mine, theirs = astuple(self), astuple(other)
        return Row(*(t if abs(m - t) < tolerance else m for m, t in zip(mine, theirs, strict=True)))


def split(T: Array, near: Row | None = None, height: float = 0.0) -> tuple[Row, Array]:
    """The row of T (4, 4) and the remainder Rz(γ) Tz(h), so that T = row · remainder.

    (θ, a, α) and (θ ± π, −a, −α) say the same: taken is the one closer to `near`, else the one
    with the smaller θ.  Turns of `near` beyond π are kept.  Of nearly parallel axes d is that of
    `near`, else `height`.
    """
    z = T[:3, 2]
    if math.hypot(z[0], z[1]) > NEARLY_PARALLEL:
        ways = [_skew(T, sign) for sign in (1.0, -1.0)]
    else:
        ways = [_parallel(T, sign, near, height) for sign in (1.0, -1.0)]
    row = min(ways, key=lambda way: _distance(way, near))
    if near is not None:
        row = _same_turns(row, near)
    return row, np.asarray(np.linalg.solve(row.transform(), T), dtype=np.float64)


def _skew(T: Array, sign: float) -> Row:
    z, p = T[:3, 2], T[:3, 3]
    theta = math.atan2(sign * z[0], -sign * z[1])
    x = np.array([math.cos(theta), math.sin(theta), 0.0])
    alpha = math.atan2(sign * math.hypot(z[0], z[1]), z[2])
    # p = d·z₀ + a·x + h·z: the common normal meets both axes.
    d, a, _ = np.linalg.solve(np.column_stack([[0.0, 0.0, 1.0], x, z]), p)
    return Row(theta, float(d), float(a), alpha)


def _parallel(T: Array, sign: float, near: Row | None, height: float) -> Row:
    z, p = T[:3, 2], T[:3, 3]
    d = height if near is None else near.d
    foot = p - (p[2] - d) / z[2] * z  # where the second axis passes through the height d
    a = sign * math.hypot(foot[0], foot[1])
    theta = math.atan2(sign * foot[1], sign * foot[0])
    if abs(a) < 1e-12:  # one axis in the other's line: any direction will do
        theta, a = (0.0 if near is None else near.theta), 0.0
    # z = Rz(θ) Rx(α) Ry(β) e_z = Rz(θ) (sin β, −sin α cos β, cos α cos β)
    c, s = math.cos(theta), math.sin(theta)
    u = (c * z[0] + s * z[1], -s * z[0] + c * z[1], z[2])
    alpha = math.atan2(-u[1], u[2])
    beta = math.atan2(u[0], math.hypot(u[1], u[2]))
    return Row(theta, d, a, alpha, beta)


def _distance(row: Row, near: Row | None) -> float:
    if near is None:
        return abs(row.theta) - 1e-9 * row.a
    turn = [1 - math.cos(x - y) for x, y in ((row.theta, near.theta), (row.alpha, near.alpha))]
    return sum(turn) + abs(row.a - near.a)


def _same_turns(row: Row, near: Row) -> Row:
    mine, theirs = astuple(row), astuple(near)
    return Row(
        *(
            m + 2 * math.pi * round((t - m) / (2 * math.pi)) if k in ANGLES else m
            for k, (m, t) in enumerate(zip(mine, theirs, strict=True))
        )
    )


def _turn(axis: str, angle: float) -> ca.SX:
    return rigid.joint_motion("revolute", _unit(axis), angle)


def _shift(axis: str, length: float) -> ca.SX:
    return rigid.joint_motion("prismatic", _unit(axis), length)


def _unit(axis: str) -> tuple[float, float, float]:
    return {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}[axis]


def _product(*factors: ca.SX) -> Array:
    T = ca.SX.eye(4)
    for factor in factors:
        T = T @ factor
    return np.array(ca.DM(T).full())
