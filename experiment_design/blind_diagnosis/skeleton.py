"""The rigid arm as its URDF states it, read here and nowhere else: frames, axes, masses."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Skeleton:
    """A serial arm of J hinges between the frames of its URDF.

    rotation (J+1, 3, 3), position (J+1, 3) in m: joint j's frame at zero angle in the frame of
    the body before it; the last entry is the flange in the last joint's frame.
    axis (J, 3); lower, upper (J,) rad; mass (J,) kg and com (J, 3) m of the body joint j moves.
    """

    rotation: Array
    position: Array
    axis: Array
    lower: Array
    upper: Array
    mass: Array
    com: Array

    @property
    def n_joints(self) -> int:
        return len(self.axis)

    def link_vector(self, j: int) -> Array:
        """From joint j's frame (0-based) to the next one, (3,) m, in joint j's frame."""
        return self.position[j + 1]

    def bent(self, shift: Array, turn: Array) -> Skeleton:
        """Every link's distal frame moved and turned along its own axes, by (J, 3) m and rad."""
        position, rotation = self.position.copy(), self.rotation.copy()
        position[1:] += np.einsum("jab,jb->ja", rotation[1:], shift)
        rotation[1:] = rotation[1:] @ Rotation.from_rotvec(turn).as_matrix()
        return replace(self, position=position, rotation=rotation)

    def forward(self, q: Array) -> tuple[Array, Array]:
        """Rotations (n, J+1, 3, 3) and origins (n, J+1, 3) of all frames at q (n, J), base frame.

        Entry j is joint j's frame after its motion; the last one is the flange.
        """
        n, J = q.shape
        R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        rotations, origins = [], []
        for j in range(J + 1):
            p = p + R @ self.position[j]
            R = R @ self.rotation[j]
            if j < J:
                R = R @ Rotation.from_rotvec(q[:, j, None] * self.axis[j]).as_matrix()
            rotations.append(R)
            origins.append(p)
        return np.stack(rotations, axis=1), np.stack(origins, axis=1)


def read_skeleton(path: Path) -> Skeleton:
    """The chain base_link → flange of a URDF whose joints stand in order; base_link is fixed."""
    root = ET.parse(path).getroot()
    bodies = {link.attrib["name"]: link.find("inertial") for link in root.iter("link")}
    rotation, position, axis, limits, mass, com = [], [], [], [], [], []
    for joint in root.iter("joint"):
        rotation.append(Rotation.from_euler("xyz", _numbers(joint, "origin", "rpy")).as_matrix())
        position.append(_numbers(joint, "origin", "xyz"))
        if joint.attrib["type"] == "fixed":
            continue
        axis.append(_numbers(joint, "axis", "xyz"))
        limit = _found(joint, "limit").attrib
        limits.append((float(limit["lower"]), float(limit["upper"])))
        inertial = bodies[_found(joint, "child").attrib["link"]]
        if inertial is None:
            raise ValueError(f"{path}: link moved by {joint.attrib['name']} has no <inertial>")
        mass.append(float(_found(inertial, "mass").attrib["value"]))
        com.append(_numbers(inertial, "origin", "xyz"))
    lower, upper = np.array(limits).T
    return Skeleton(
        np.array(rotation), np.array(position), np.array(axis), lower, upper,
        np.array(mass), np.array(com),
    )  # fmt: skip


def transverse(direction: Array) -> tuple[Array, Array]:
    """Unit axes u, v across a direction (3,): u × v along it, u next to the coordinate axis that
    the direction leans on least; which one it is, assembly errors of some mrad do not change."""
    n = direction / np.linalg.norm(direction)
    start = np.eye(3)[int(np.argmin(np.abs(n).round(2)))]
    u = start - n * (n @ start)
    u /= np.linalg.norm(u)
    return u, np.cross(n, u)


def _found(element: ET.Element, tag: str) -> ET.Element:
    child = element.find(tag)
    if child is None:
        raise ValueError(f"<{element.tag} {element.attrib}> has no <{tag}>")
    return child


def _numbers(element: ET.Element, tag: str, key: str) -> Array:
    return np.array([float(v) for v in _found(element, tag).attrib[key].split()])
