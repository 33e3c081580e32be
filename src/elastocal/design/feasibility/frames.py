"""Where everything stands in a batch of poses, from the chain's one symbolic description."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.design.feasibility.bodies import data_base
from elastocal.manipulator import rigid
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.tape import Tape

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Poses:
    """N poses: `q` (N, n), `force` (N, 3) N at the load point in the data's frame, and
    `frames` (N, n + 2, 4, 4), such that frames[:, body.carrier] places a body: joints 1 … n after
    their motion, the hanging frame, the data's frame."""

    q: Array
    force: Array
    frames: Array
    flange_placement: Array

    def __len__(self) -> int:
        return len(self.q)

    @property
    def loaded(self) -> BoolArray:
        """(N,): the load hangs, that is, the force is not zero."""
        return np.asarray((self.force != 0).any(axis=1))

    @cached_property
    def flange(self) -> Array:
        """T_data_flange (N, 4, 4)."""
        return np.asarray(self.frames[:, self.q.shape[1] - 1] @ self.flange_placement)

    def take(self, index: NDArray) -> Poses:
        """The poses `index` (integers or a mask)."""
        return Poses(self.q[index], self.force[index], self.frames[index], self.flange_placement)


class Kinematics:
    """Frames of the rigid nominal arm:

    T_data_joint_i(q) = T_data_base X_1 J_1(q_1) … X_i J_i(q_i), built by `manipulator.rigid`.
    """

    def __init__(self, cell: Cell, chain: Chain) -> None:
        self.chain = chain
        self.T_data_base = data_base(cell)
        self.load_point = np.asarray(cell.tool.load_point, dtype=float)
        q = ca.SX.sym("q", chain.n_joints)
        T, frames = rigid.constant(self.T_data_base), []
        for i, joint in enumerate(chain.joints):
            T = T @ rigid.constant(joint.placement)
            T = T @ rigid.joint_motion(joint.kind, joint.axis, q[i])
            frames.append(T)
        hanging = rigid.point(T @ rigid.constant(chain.flange_placement), self.load_point)
        self._tape = Tape([q], [*frames, hanging])

    def poses(self, q: Array, force: Array) -> Poses:
        """Poses for joint values q (N, n) and a force (3,) or (N, 3)."""
        q = np.ascontiguousarray(np.atleast_2d(q), dtype=float)
        n = self.chain.n_joints
        frames = np.zeros((len(q), n + 2, 4, 4))
        *joints, hanging = self._tape(q)
        for i, T in enumerate(joints):
            frames[:, i] = T
        frames[:, n:] = np.eye(4)
        frames[:, n, :3, 3] = hanging[..., 0]
        force = np.broadcast_to(np.asarray(force, dtype=float), (len(q), 3))
        return Poses(q, force, frames, self.chain.flange_placement)
