"""Collision of whole batches of poses in pinocchio and coal, without a Python loop over poses.

The pinocchio model is the chain on T_data_base, its universe the data's frame, with one
spherical joint more at the load point: its configuration undoes the rotation of the last link,
so that what it carries stays upright.  coal tests every pair with its security margin
(Pan, Chitta & Manocha 2012; GJK stops as soon as the margin is seen to be kept).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from elastocal.cell import HalfSpace
from elastocal.design.feasibility.bodies import Body
from elastocal.design.feasibility.carriers import HANGING, WORLD
from elastocal.design.feasibility.frames import Kinematics, Poses
from elastocal.design.feasibility.pairs import Pair
from elastocal.design.feasibility.shapes import coal_shape

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class Collisions:
    """Tests a fixed list of pairs.

    `free` bodies more, carried by n + 1, n + 2, …, may be placed at will in every pose.
    """

    def __init__(self, kinematics: Kinematics, pairs: Sequence[Pair], free: int = 0) -> None:
        self.pairs = tuple(pairs)
        model = arm_model(kinematics, free)
        geometry = geometry_of(kinematics, [item for p in pairs for item in (p.body, p.other)])
        self._hangs = np.array([pair.hangs for pair in pairs], dtype=bool)
        self._always = Batch(model, geometry, [p for p in pairs if not p.hangs])
        self._loaded = Batch(model, geometry, [p for p in pairs if p.hangs])

    def hits(
        self, poses: Poses, extra: float | Array = 0.0, placed: Array | None = None
    ) -> BoolArray:
        """(N,): some pair is nearer than its margin plus `extra` m, for all pairs or for each.

        `placed` (N, 7 free): position and quaternion (x, y, z, w) of every free body.
        """
        configuration = arm_configuration(poses)
        if placed is not None:
            configuration = np.hstack([configuration, placed])
        extra = np.broadcast_to(extra, len(self.pairs))
        found = self._always.hits(configuration, extra[~self._hangs])
        left = np.flatnonzero(poses.loaded & ~found)
        found[left] = self._loaded.hits(configuration[left], extra[self._hangs])
        return found


class Batch:
    """Pairs of a geometry model, tested for many configurations at once in C++."""

    def __init__(self, model: Any, geometry: Any, pairs: Sequence[Pair]) -> None:
        import pinocchio as pin

        self._margins = np.array([pair.margin for pair in pairs])
        if not pairs:
            return
        geometry = geometry.copy()
        for pair in pairs:
            a, b = (geometry.getGeometryId(name) for name in pair.names)
            geometry.addCollisionPair(pin.CollisionPair(a, b))
        self._pool = pin.GeometryPool(model, geometry, 1)

    def hits(self, configuration: Array, extra: Array) -> BoolArray:
        """(N,) for configurations (N, nq); `extra` m is added to each pair's margin."""
        import pinocchio as pin

        if not len(self._margins) or not len(configuration):
            return np.zeros(len(configuration), dtype=bool)
        requests = self._pool.getGeometryData(0).collisionRequests
        for request, margin in zip(requests, self._margins + extra, strict=True):
            request.security_margin = margin
        return np.array(pin.computeCollisionsInParallel(1, self._pool, configuration.T, True))


def arm_model(kinematics: Kinematics, free: int = 0) -> Any:
    """The chain, its hanging frame and `free` bodies without a carrier as a pinocchio model."""
    import pinocchio as pin

    model, parent = pin.Model(), 0
    for i, joint in enumerate(kinematics.chain.joints):
        placement = kinematics.T_data_base @ joint.placement if i == 0 else joint.placement
        unaligned = (
            pin.JointModelRevoluteUnaligned
            if joint.kind == "revolute"
            else pin.JointModelPrismaticUnaligned
        )
        parent = model.addJoint(
            parent, unaligned(np.array(joint.axis)), _se3(placement), f"joint{i + 1}"
        )
    hook = np.eye(4)
    hook[:3, 3] = (kinematics.chain.flange_placement @ [*kinematics.load_point, 1.0])[:3]
    model.addJoint(parent, pin.JointModelSpherical(), _se3(hook), "hanging")
    for i in range(free):
        model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"free{i + 1}")
    return model


def arm_configuration(poses: Poses) -> Array:
    """Configurations (N, n + 4): q, and the hanging joint's quaternion (x, y, z, w)."""
    last = poses.frames[:, poses.q.shape[1] - 1, :3, :3]
    upright = Rotation.from_matrix(last.transpose(0, 2, 1)).as_quat()
    return np.hstack([poses.q, upright])


def geometry_of(kinematics: Kinematics, items: Sequence[Body | HalfSpace]) -> Any:
    """A pinocchio geometry model with each of the bodies and half-spaces once, without pairs."""
    import coal
    import pinocchio as pin

    geometry = pin.GeometryModel()
    for item in items:
        if geometry.existGeometryName(item.name):
            continue
        if isinstance(item, HalfSpace):
            shape = coal.Halfspace(np.array(item.normal), float(item.normal @ item.point))
            joint, placement = 0, np.eye(4)
        else:
            shape, placement = coal_shape(item.solid), item.solid.placement
            joint = {WORLD: 0, HANGING: kinematics.chain.n_joints + 1}.get(
                item.carrier, item.carrier + 1
            )
        geometry.addGeometryObject(pin.GeometryObject(item.name, joint, _se3(placement), shape))
    return geometry


def _se3(T: Array) -> Any:
    import pinocchio as pin

    return pin.SE3(np.array(T[:3, :3]), np.array(T[:3, 3]))
