"""Geometric errors of a link: six per link, before any reduction."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols, index, links
from elastocal.manipulator.parameter import ParameterSpec


class LinkGeometry(Effect):
    """T_link = T_nominal · Trans(dx, dy, dz) · exp([rx, ry, rz]×) at the link's distal end.

    T_nominal takes the next joint's frame (the flange's for the last link) to this link's
    joint frame; the error moves and tilts that next frame, in m and rad, along its own axes.
    Six per link are complete but redundant; identification reduces them to a minimal set
    (Stone 1987; Hollerbach, Khalil and Gautier 2008).
    """

    name = "link_geometry"
    stage = "geometry"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return links(chain)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        lengths = [ParameterSpec(k, "m", 0.0, 1e-3) for k in ("dx", "dy", "dz")]
        angles = [ParameterSpec(k, "rad", 0.0, 1e-3) for k in ("rx", "ry", "rz")]
        return (*lengths, *angles)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        shift = ca.vertcat(p["dx"], p["dy"], p["dz"])
        turn = rigid.rotation_from_vector(ca.vertcat(p["rx"], p["ry"], p["rz"]))
        arm.links[i] = arm.links[i] @ rigid.transform(turn, shift)
