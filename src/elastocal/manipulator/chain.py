"""The nominal serial chain: what a URDF or a DH table says, before any error."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
JointKind = Literal["revolute", "prismatic"]

MIN_JOINTS, MAX_JOINTS = 4, 9


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
    lumped, or is empty where the source has no inertias.
    """

    name: str
    joints: tuple[Joint, ...]
    flange_placement: Array
    masses: tuple[LinkMass, ...] = field(default=())

    @property
    def n_joints(self) -> int:
        return len(self.joints)

    @property
    def kinds(self) -> tuple[JointKind, ...]:
        return tuple(joint.kind for joint in self.joints)
