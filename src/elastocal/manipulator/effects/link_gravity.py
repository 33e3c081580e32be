"""The links' own weights as a load."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.errors import require
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols, index, links
from elastocal.manipulator.parameter import ParameterSpec

STANDARD_GRAVITY = 9.80665  # m/s², along −z of the tracker frame, which is vertical


class LinkGravity(Effect):
    """Weight m g of each link at its centre of mass: V = m g z_com(θ).  No parameters.

    Masses and centres of mass are the URDF's (or the DH robot's table of masses).
    """

    name = "link_gravity"
    stage = "load"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return links(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        require(
            bool(chain.masses),
            f"link_gravity is on, but robot '{chain.name}' has no masses: give <inertial> "
            'elements in the URDF, or [robot] masses = "links.csv" for a DH robot, '
            "or set [model] link_gravity = false",
        )
        return ()

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        body = arm.chain.masses[i]
        com = rigid.point(arm.T_tracker_link[i], rigid.constant(body.com))
        arm.add_force(com, ca.vertcat(0, 0, -body.mass * STANDARD_GRAVITY))
