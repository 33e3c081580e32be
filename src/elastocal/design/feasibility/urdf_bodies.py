"""The URDF's own collision geometry as solids carried by the chain's joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from elastocal.cell import Cell, Solid
from elastocal.design.feasibility.carriers import WORLD
from elastocal.errors import InputError
from elastocal.manipulator.chain import Chain

PARENTS = 6  # directories above the URDF in which a ROS package may lie


def urdf_bodies(cell: Cell, chain: Chain) -> list[tuple[Solid, int]]:
    """(solid, carrier) of every <collision> element; those on the base in the base's frame.

    Joints off the chain stand still at their neutral position, as in the kinematics.  Mesh files
    are looked for beside the URDF, and `package://` in the directories above it.  Raises
    InputError for a robot without URDF, a mesh that is not there, or no geometry at all.
    """
    import pinocchio as pin

    path = cell.robot.urdf
    where = f'{cell.path or cell.name}: [workspace] geometry = "urdf"'
    if path is None:
        raise InputError(f"{where}, but the robot has no URDF; give link_radius_mm instead")
    folders = [str(folder) for folder in path.resolve().parents[:PARENTS]]
    try:
        model = pin.buildModelFromUrdf(str(path))
        geometry = pin.buildGeomFromUrdf(
            model, str(path), pin.GeometryType.COLLISION, package_dirs=folders
        )
    except Exception as error:  # missing files and unreadable ones alike
        raise InputError(
            f"{where}: {path}: {' '.join(str(error).split())}; put the mesh files where the URDF "
            "looks for them (beside it, or in a package directory above it), or give "
            "link_radius_mm instead"
        ) from None
    if not geometry.ngeoms:
        raise InputError(
            f"{where}: {path} has no <collision> elements; give link_radius_mm instead"
        )
    moving = [joint.name for joint in chain.joints]
    locked = pin.StdVec_Index()
    for name in list(model.names)[1:]:
        if name not in moving:
            locked.append(model.getJointId(name))
    model, geometry = pin.buildReducedModel(model, geometry, locked, pin.neutral(model))
    base = cell.robot.base
    T_root_base = pin.SE3.Identity() if base is None else _placement(model, base)
    found = []
    for item in geometry.geometryObjects:
        on_base = item.parentJoint == 0
        T = T_root_base.inverse() * item.placement if on_base else item.placement
        carrier = WORLD if on_base else moving.index(model.names[item.parentJoint])
        found.append((_solid(item, T.homogeneous, path), carrier))
    return found


def _placement(model: Any, link: str) -> Any:
    import pinocchio as pin

    return model.frames[model.getFrameId(link, pin.FrameType.BODY)].placement


def _solid(item: Any, placement: np.ndarray, path: Path) -> Solid:
    import coal

    shape = item.geometry
    if isinstance(shape, coal.Box):
        return Solid(item.name, "box", 2 * np.array(shape.halfSide), placement)
    if isinstance(shape, coal.Sphere):
        return Solid(item.name, "sphere", np.array([shape.radius]), placement)
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        kind = "cylinder" if isinstance(shape, coal.Cylinder) else "capsule"
        size = np.array([shape.radius, 2 * shape.halfLength])
        return Solid(item.name, kind, size, placement)  # type: ignore[arg-type]
    if not item.meshPath:
        raise InputError(f"{path}: collision element '{item.name}' is of an unknown shape")
    scale = np.array(item.meshScale, dtype=float).reshape(3)
    return Solid(item.name, "mesh", scale, placement, Path(item.meshPath))
