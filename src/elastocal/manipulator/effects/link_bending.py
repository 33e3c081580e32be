"""A link that bends and twists."""

from __future__ import annotations

import numpy as np

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm, Spring
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.effects.base import Symbols, index, links
from elastocal.manipulator.effects.joint_compliance import nominal_compliance
from elastocal.manipulator.effects.link_ends import SHORTEST, link_ends
from elastocal.manipulator.effects.off_axis_compliance import transverse_axes
from elastocal.manipulator.effects.torque import LoadedEffect
from elastocal.manipulator.parameter import ParameterSpec


def link_axes(chain: Chain, i: int) -> dict[str, Array]:
    """Unit axes (3,) of link i's (0-based) torsion and bending, in the frame at its distal end.

    Torsion is about the line from the link's joint frame to its distal frame, or about the
    joint's axis where the link has no length.
    """
    T = link_ends(chain)[i]
    length = np.linalg.norm(T[:3, 3])
    along = T[:3, 3] / length if length > SHORTEST else chain.joints[i].axis
    along = T[:3, :3].T @ along
    y, z = transverse_axes(along)
    return {"torsion": along, "bending_y": y, "bending_z": z}


class LinkBending(LoadedEffect):
    """θ = k M at the link's distal end: bending about two transverse axes, torsion about its own.

    M are the load's moments there, about axes fixed to the link; k in rad/(N m).  For a uniform
    beam of length L, k = L/(E I) in bending and L/(G J) in torsion (the rotation of its end under
    an end moment; Timoshenko); the deflection by a transverse force at the end itself is of
    higher order in L over the lever arm and left out.  Typical: 15 % of the compliance of the
    joint that moves the link.
    """

    name = "link_bending"
    stage = "compliance"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return links(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        given = nominal_compliance(chain, cell)
        turning = given is not None and chain.kinds[index(place)] == "revolute"
        typical = 0.15 * given[index(place)] or None if given and turning else None
        return tuple(
            ParameterSpec(key, "rad/(N*m)", 0.0, typical, lower=0.0)
            for key in ("bending_y", "bending_z", "torsion")
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        for key, axis in link_axes(arm.chain, index(place)).items():
            arm.add_spring(Spring.linear(f"{place}.{key}", place, "revolute", axis, p[key]))
