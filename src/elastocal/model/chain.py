"""The nominal serial chain: what a URDF or a DH table says, and how far its joints may move."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.units import Array

JointKind = Literal["revolute", "prismatic"]

MIN_JOINTS, MAX_JOINTS = 4, 9
MAX_LENGTH, MAX_MASS = 50.0, 1e5  # m, kg: beyond them a unit is wrong, no arm is so long or heavy


@dataclass(frozen=True)
class Joint:
    """One moving joint of the chain.

    `placement` (4, 4) takes coordinates of this joint's frame at zero motion to
    the previous joint's frame (to the base frame for the first joint); `axis`
    (3,) is the unit joint axis in this joint's frame.  `lower` and `upper` are
    in rad (revolute) or m (prismatic), infinite where the source has no limit.
    """

    name: str
    kind: JointKind
    placement: Array
    axis: Array
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True)
class LinkMass:
    """Mass in kg and centre of mass (3,) in m in the frame of the moving joint that carries it."""

    mass: float
    com: Array


@dataclass(frozen=True)
class Chain:
    """A serial chain base → joint 1 → … → joint n → flange.

    `flange_placement` (4, 4) places the flange in the last joint's frame.
    `masses` holds one entry per joint, all bodies rigidly carried by that joint
    lumped, or is empty where the source has no inertias.  `notes`: what to know of how the source
    was read, in sentences.
    """

    name: str
    joints: tuple[Joint, ...]
    flange_placement: Array
    masses: tuple[LinkMass, ...] = field(default=())
    notes: tuple[str, ...] = field(default=(), compare=False)

    @property
    def n_joints(self) -> int:
        return len(self.joints)

    @property
    def kinds(self) -> tuple[JointKind, ...]:
        return tuple(joint.kind for joint in self.joints)


# Joint limits: the robot's own, narrowed by the cell's.

NO_LIMIT = 100.0  # half turns, or m


def joint_limits(cell: Cell, chain: Chain) -> tuple[Array, Array]:
    """Lower and upper joint limits (n,) in rad or m, infinite where there is none.

    Raises InputError where the cell limits a joint that the robot does not have, or leaves a
    joint no range at all.
    """
    lower = np.array([joint.lower for joint in chain.joints])
    upper = np.array([joint.upper for joint in chain.joints])
    for name, (low, high) in cell.limits.items():
        i = joint_index(cell, chain, name, "[limits]")
        lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
        if lower[i] >= upper[i]:
            raise InputError(
                f"{cell.path or cell.name}: [limits] {name} leaves no range inside the robot's "
                "own limits"
            )
    return lower, upper


def finite_ranges(
    chain: Chain, lower: Array, upper: Array, near: Array | None = None
) -> tuple[Array, Array]:
    """Ranges (n,) to draw joint values from: the limits, and where there are none, a turn (2 m
    for a prismatic joint) from the one limit, or about `near` (n,), by default about zero.  A
    limit beyond `NO_LIMIT` such half turns (1 m) from there is none: files write 1e16 for it."""
    half = np.where([kind == "revolute" for kind in chain.kinds], np.pi, 1.0)
    centre = np.zeros(len(lower)) if near is None else near
    lower = np.where(lower < centre - NO_LIMIT * half, -np.inf, lower)
    upper = np.where(upper > centre + NO_LIMIT * half, np.inf, upper)
    low = np.where(np.isfinite(upper), upper - 2 * half, centre - half)
    low = np.where(np.isfinite(lower), lower, low)
    return low, np.where(np.isfinite(upper), upper, low + 2 * half)


def joint_index(cell: Cell, chain: Chain, name: str, where: str) -> int:
    """0-based index of "jointN", which the table `where` of the cell names.

    Raises InputError where the robot has no such joint.
    """
    i = int(name.removeprefix("joint")) - 1
    if i >= chain.n_joints:
        raise InputError(
            f"{cell.path or cell.name}: {where} names {name}, but robot '{chain.name}' has "
            f"{chain.n_joints} joints"
        )
    return i
