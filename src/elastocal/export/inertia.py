"""Inertia tensors of the bodies that each joint carries, from the robot's URDF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from elastocal.manipulator.chain import Array, Chain


def link_inertias(path: Path, chain: Chain) -> tuple[Array, ...]:
    """(3, 3) kg m² per joint about the centre of mass of all that it carries, in its frame's axes.

    Joints beside the chain are held at zero, as when the chain was read.  Empty where the file
    states no inertia that pinocchio can read.
    """
    import pinocchio as pin

    try:
        whole = pin.buildModelFromXML(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RuntimeError):
        return ()
    moving = {joint.name for joint in chain.joints}
    held = [i for i in range(1, whole.njoints) if whole.names[i] not in moving]
    model = pin.buildReducedModel(whole, held, pin.neutral(whole)) if held else whole
    tensors = [np.array(inertia.inertia) for inertia in model.inertias[1:]]
    return tuple(tensors) if len(tensors) == chain.n_joints else ()
