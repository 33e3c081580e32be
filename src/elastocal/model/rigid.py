"""Rigid motions as CasADi expressions: the only place where kinematics is written down.

Every function takes and returns CasADi `SX` (or numbers, which CasADi promotes), but the
last three, which are of arrays and numbers.  Homogeneous transforms are (4, 4), rotations (3, 3),
vectors (3, 1).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from elastocal.model.chain import Chain, finite_ranges
from elastocal.model.evaluate import BatchFunction
from elastocal.units import Array

# Added under square roots so that rotation-vector formulas are smooth at zero;
# far below the rounding of any angle met in practice (1e-15 rad).
TINY = 1e-30


def rotation_about(axis: Any, angle: Any) -> ca.SX:
    """Rotation by `angle` about the constant unit `axis` (Rodrigues)."""
    along, across, about = _rodrigues(tuple(map(float, axis)))
    return along + ca.cos(angle) * across + ca.sin(angle) * about


@lru_cache(maxsize=64)
def _rodrigues(axis: tuple[float, float, float]) -> tuple[ca.SX, ca.SX, ca.SX]:
    """a aᵀ, 1 − a aᵀ and skew(a): an arm turns about the same few axes in every model of it."""
    a = np.array(axis)
    along = np.outer(a, a)
    return constant(along), constant(np.eye(3) - along), constant(ca.skew(ca.DM(a)))


def rotation_from_vector(r: Any) -> ca.SX:
    """exp([r]×) for a rotation vector r (3,) in rad, smooth at r = 0."""
    r = ca.SX(r)
    angle = ca.sqrt(ca.sumsqr(r) + TINY)
    half = ca.sin(angle / 2) / angle
    k = ca.skew(r)
    return ca.SX.eye(3) + ca.sin(angle) / angle * k + 2 * half**2 * (k @ k)


def vector_from_rotation(R: Any) -> ca.SX:
    """Rotation vector of R, smooth at R = I, for angles up to and including π."""
    R = ca.SX(R)
    trace = ca.trace(R)
    # Quaternion (w, x, y, z) times 4 times its largest member (Shepperd 1978): no case divides
    # by a small number.
    skewed = ca.vertcat(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    best, largest = ca.vertcat(1 + trace, skewed), trace
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        members = [skewed[i], 0, 0, 0]
        members[1 + i] = 1 + 2 * R[i, i] - trace
        members[1 + j] = R[i, j] + R[j, i]
        members[1 + k] = R[i, k] + R[k, i]
        larger = R[i, i] > largest
        best = ca.if_else(larger, ca.vertcat(*members), best)
        largest = ca.fmax(largest, R[i, i])
    unit = best / ca.sqrt(ca.sumsqr(best))
    unit = ca.if_else(unit[0] < 0, -unit, unit)
    s = ca.sqrt(ca.sumsqr(unit[1:]) + TINY)
    return 2 * ca.atan2(s, unit[0]) / s * unit[1:]


def transform(rotation: Any = None, translation: Any = None) -> ca.SX:
    T = ca.SX.eye(4)
    if rotation is not None:
        T[:3, :3] = rotation
    if translation is not None:
        T[:3, 3] = translation
    return T


def constant(T: Any) -> ca.SX:
    """A numeric matrix as SX with exact zeros dropped, so that products stay small."""
    return ca.SX(ca.sparsify(ca.DM(np.asarray(T, dtype=float))))


def joint_motion(kind: str, axis: Any, value: Any) -> ca.SX:
    """Motion of a revolute or prismatic joint by `value` (rad or m) along its unit axis."""
    if kind == "revolute":
        return transform(rotation=rotation_about(axis, value))
    return transform(translation=ca.SX(ca.DM(np.asarray(axis, dtype=float))) * value)


def moved(kind: str, axis: Any, value: float) -> Array:
    """`joint_motion` of a number (4, 4)."""
    return np.asarray(ca.DM(joint_motion(kind, axis, value)).full())


def point(T: ca.SX, p: Any) -> ca.SX:
    return T[:3, :3] @ ca.SX(p) + T[:3, 3]


def nominal_frames(chain: Chain, q: ca.SX, base: ca.SX) -> list[ca.SX]:
    """(4, 4) of each joint of the nominal chain after its motion, at joint values q (n,), and of
    the flange, where `base` (4, 4) is that of the chain's base."""
    frames = [base]
    for i, joint in enumerate(chain.joints):
        motion = joint_motion(joint.kind, joint.axis, q[i])
        frames.append(frames[-1] @ constant(joint.placement) @ motion)
    return [*frames[1:], frames[-1] @ constant(chain.flange_placement)]


def nominal_flanges(chain: Chain, q: Array) -> Array:
    """T_base_flange (n, 4, 4) of the nominal chain at q (n, joints)."""
    symbol = ca.SX.sym("q", chain.n_joints)
    flange = nominal_frames(chain, symbol, ca.SX.eye(4))[-1]
    return np.asarray(BatchFunction([symbol], [flange])(q)[0])


def reach_of(chain: Chain) -> float:
    """How far the flange gets from the first joint that turns, in m: the largest of 500 drawn
    poses.  Slides before it, as a rail, stand still."""
    limits = [np.array([getattr(j, end) for j in chain.joints]) for end in ("lower", "upper")]
    low, high = finite_ranges(chain, *limits)
    q = np.random.default_rng(0).uniform(low, high, (500, chain.n_joints))
    turning = [i for i, kind in enumerate(chain.kinds) if kind == "revolute"]
    first = turning[0] if turning else 0
    q[:, :first] = (low + high)[:first] / 2
    symbol, base = ca.SX.sym("q", chain.n_joints), ca.SX.eye(4)
    frames = [base, *nominal_frames(chain, symbol, base)]
    # A slide, where none turns, starts from where it stands at zero.
    start = point(frames[first], chain.joints[first].placement[:3, 3])
    reach = ca.norm_2(frames[-1][:3, 3] - start)
    return float(BatchFunction([symbol], [reach])(q)[0].max())


# Of the KR 270 of the demo, in m and N, from which loads are guessed by the fourth power of the
# reach: small arms carry less for their size, and longer ones are no stronger.
REACH, LOAD = 2.9, 2600.0


def suitable_load(reach: float) -> float:
    """A load in N for an arm of this `reach` in m, with one digit, as guesses have."""
    return max(float(f"{LOAD * min(reach / REACH, 1.0) ** 4:.1g}"), 5.0)
