"""A link whose mass or centre of mass is not what the model says."""

from __future__ import annotations

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols, index, links
from elastocal.manipulator.effects.link_gravity import STANDARD_GRAVITY
from elastocal.manipulator.parameter import ParameterSpec

DISPLACED = 0.02  # m; typical error of a centre of mass


class LinkMassError(Effect):
    """V = g (m z + (R s)_z): mass m (kg) and first moment s (3,) (kg m) missing from a link.

    z is the height of the link's joint frame and R its rotation; s is taken in that frame.  A
    mass error δm with its centre at c is m = δm, s = δm c; a centre of mass displaced by δc is
    s = m₀ δc.  Cables, hoses and gear oil are in no CAD file.  Where `link_gravity` is off, all
    of the link's weight is missing, and the typical sizes are the URDF's own.  Places: links
    whose mass the robot's file gives.
    """

    name = "link_mass_error"
    stage = "load"

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        pairs = zip(links(chain), chain.masses, strict=False)
        return tuple(link for link, body in pairs if body.mass > 0)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        body = chain.masses[index(place)]
        share = 0.1 if cell.model.link_gravity else 1.0
        moment = body.mass * (share * float(np.linalg.norm(body.com)) + DISPLACED)
        return (
            ParameterSpec("mass_error", "kg", 0.0, share * body.mass),
            *(ParameterSpec(f"moment_{k}", "kg*m", 0.0, moment) for k in "xyz"),
        )

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        T = arm.T_tracker_link[index(place)]
        moment = ca.vertcat(*[p[f"moment_{k}"] for k in "xyz"])
        height = p["mass_error"] * T[2, 3] + T[2, :3] @ moment
        arm.add_potential(STANDARD_GRAVITY * height)
