"""The bodies of a cell in MuJoCo: its kinematics, its collision, its rays, none of elastocal's.

Shared with elastocal: the chain's numbers, the solids and the list of pairs with their margins.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell, Solid
from elastocal.model.chain import Chain
from elastocal.planning.collision import HANGING, WORLD, Body, Pair, data_base

AWAY = (0.0, 0.0, 1e4)
SEEN, UNSEEN = 0, 1  # geom groups: what hides a marker, and what does not


class MujocoCell:
    """Contacts of a pose, with every pair's margin changed by `slack` m."""

    def __init__(
        self,
        cell: Cell,
        chain: Chain,
        bodies: Sequence[Body],
        pairs: Sequence[Pair],
        slack: float = 0.0,
    ) -> None:
        self.model = mujoco.MjModel.from_xml_string(_mjcf(cell, chain, bodies, pairs, slack))
        self.data = mujoco.MjData(self.model)
        self._eye = np.array(cell.tracker.position, dtype=float)

    def place(self, q: np.ndarray, loaded: bool) -> None:
        """Kinematics of a pose; the load hangs from its load point, or is out of the way."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        self.data.mocap_pos[0] = self.data.site("load_point").xpos if loaded else AWAY
        mujoco.mj_kinematics(self.model, self.data)

    def contacts(self, q: np.ndarray, loaded: bool) -> list[tuple[str, str, float]]:
        """Pairs nearer than margin + slack, and their distances in m."""
        self.place(q, loaded)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        found = []
        for k in range(self.data.ncon):
            contact = self.data.contact[k]
            a, b = (self.model.geom(int(g)).name for g in contact.geom)
            hangs = {"rope", "load"} & {a, b}
            if (loaded or not hangs) and contact.dist < contact.includemargin:
                found.append((a, b, float(contact.dist)))
        return found

    def hidden(self, q: np.ndarray, end: float, loaded: bool) -> list[str]:
        """Markers that a ray from the tracker does not reach up to `end` m before them."""
        self.place(q, loaded)
        groups, hit = np.zeros(6, dtype=np.uint8), np.zeros(1, dtype=np.int32)
        groups[SEEN] = 1
        found = []
        for k in range(self.model.nsite):
            name = self.model.site(k).name
            if name == "load_point":
                continue
            line = self.data.site_xpos[k] - self._eye
            distance = float(np.linalg.norm(line))
            free = mujoco.mj_ray(
                self.model, self.data, self._eye, line / distance, groups, 1, -1, hit
            )
            if 0 <= free < distance - end:
                found.append(name)
        return found


def _mjcf(
    cell: Cell, chain: Chain, bodies: Sequence[Body], pairs: Sequence[Pair], slack: float
) -> str:
    root = ET.Element("mujoco")
    ET.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    ET.SubElement(root, "option", ccd_tolerance="1e-8")
    asset = ET.SubElement(root, "asset")
    world = ET.SubElement(root, "worldbody")
    eye = np.array(cell.tracker.position, dtype=float)
    for body in bodies:
        if body.carrier == WORLD:
            # What stands where the tracker does is the instrument itself.
            instrument = np.linalg.norm(body.solid.placement[:3, 3] - eye) < 1e-9
            _geom(world, asset, body.solid, UNSEEN if instrument else SEEN)
    spaces = {pair.other.name: pair.other for pair in pairs if not isinstance(pair.other, Body)}
    for space in spaces.values():
        z = Rotation.align_vectors(space.normal[None], [[0.0, 0.0, 1.0]])[0]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = z.as_matrix(), space.point
        ET.SubElement(
            world, "geom", name=space.name, type="plane", size="0 0 1", **_off(UNSEEN), **_pose(T)
        )
    hanging = ET.SubElement(world, "body", name="hanging", mocap="true")
    for body in bodies:
        if body.carrier == HANGING:
            _geom(hanging, asset, body.solid, SEEN)
    T, parent = data_base(cell), world
    for i, joint in enumerate(chain.joints):
        T = T @ joint.placement if i == 0 else joint.placement
        parent = ET.SubElement(parent, "body", name=f"carrier{i + 1}", **_pose(T))
        ET.SubElement(parent, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        kind = "hinge" if joint.kind == "revolute" else "slide"
        ET.SubElement(parent, "joint", type=kind, axis=_text(joint.axis))
        for body in bodies:
            if body.carrier == i:
                _geom(parent, asset, body.solid, SEEN)
    flange = ET.SubElement(parent, "body", name="flange", **_pose(chain.flange_placement))
    ET.SubElement(flange, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
    for name, point in {"load_point": cell.tool.load_point, **cell.tool.markers}.items():
        ET.SubElement(flange, "site", name=name, pos=_text(point))
    contact = ET.SubElement(root, "contact")
    for pair in pairs:
        a, b = pair.names
        ET.SubElement(contact, "pair", geom1=a, geom2=b, margin=repr(pair.margin + slack))
    return ET.tostring(root, encoding="unicode")


def _geom(parent: ET.Element, asset: ET.Element, solid: Solid, group: int) -> None:
    values = {"name": solid.name, **_off(group), **_pose(solid.placement)}
    size = np.array(solid.size, dtype=float)
    if solid.shape == "mesh":
        ET.SubElement(asset, "mesh", name=solid.name, file=str(solid.mesh), scale=_text(size))
        ET.SubElement(parent, "geom", type="mesh", mesh=solid.name, **values)
        return
    if solid.shape == "box":
        size = size / 2
    elif solid.shape != "sphere":
        size[1] /= 2
    ET.SubElement(parent, "geom", type=solid.shape, size=_text(size), **values)


def _off(group: int) -> dict[str, str]:
    return {"contype": "0", "conaffinity": "0", "group": str(group)}


def _pose(T: np.ndarray) -> dict[str, str]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"pos": _text(T[:3, 3]), "quat": _text((w, x, y, z))}


def _text(numbers: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(numbers, dtype=float))
