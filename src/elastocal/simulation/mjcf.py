"""A chain as MJCF: what MuJoCo needs to move, bend and weigh it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from elastocal.manipulator.chain import Chain, LinkMass

Array = NDArray[np.float64]

# A moving body needs some mass and inertia in MuJoCo; these weigh 1e-13 N.
NO_MASS, NO_INERTIA = 1e-14, 1e-12


def write_mjcf(
    chain: Chain,
    compliance: Array,
    sites: Mapping[str, Array],
    masses: Sequence[LinkMass],
    gravity: Array,
) -> str:
    """MJCF text of the chain in the base frame.

    One body per joint, each inside the one before, with a spring of stiffness 1/k (none where
    k = 0); `sites`: name → (3,) m in the flange frame; masses as in Chain; gravity (3,) m/s².
    """
    root = ET.Element("mujoco", model="elastic arm")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity=numbers(gravity))
    parent = ET.SubElement(root, "worldbody")
    for i, (joint, k) in enumerate(zip(chain.joints, compliance, strict=True)):
        parent = ET.SubElement(parent, "body", placed_body(f"link{i + 1}", joint.placement))
        body = masses[i] if masses else LinkMass(0.0, np.zeros(3))
        ET.SubElement(
            parent,
            "inertial",
            pos=numbers(body.com),
            mass=repr(max(float(body.mass), NO_MASS)),
            diaginertia=numbers([NO_INERTIA] * 3),
        )
        ET.SubElement(
            parent,
            "joint",
            name=f"joint{i + 1}",
            type="slide" if joint.kind == "prismatic" else "hinge",
            axis=numbers(joint.axis),
            stiffness=repr(1.0 / float(k)) if k > 0 else "0",
            armature="1",  # keeps the mass matrix regular; without motion it exerts no force
        )
    flange = ET.SubElement(parent, "body", placed_body("flange", chain.flange_placement))
    for name, position in sites.items():
        ET.SubElement(flange, "site", name=name, pos=numbers(position))
    return ET.tostring(root, encoding="unicode")


def placed_body(name: str, T: Array) -> dict[str, str]:
    """Attributes of a body or site called `name` at T (4, 4) in the frame of its parent."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"name": name, "pos": numbers(T[:3, 3]), "quat": numbers((w, x, y, z))}


def numbers(values: ArrayLike) -> str:
    """Numbers separated by blanks, each with the digits that give the same double back."""
    return " ".join(repr(float(value)) for value in np.asarray(values, dtype=float))
