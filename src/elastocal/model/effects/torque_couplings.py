"""What yields by the recorded torques besides each joint about its own axis.

A joint's sensor, or its motor's current, records the torque about its own axis; the moments about
the others show in the neighbours' torques.  So a joint's angle, and the frame at a link's end, are
taken to move in proportion to several recorded torques, with coefficients that are `shrunk`.  The
torques are the table's `torque_i`, whatever `[model] torque` says of the springs.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.model import rigid
from elastocal.model.arm import Arm, ParameterSpec, Setting
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Symbols, index, links, motion_unit, turning_joints
from elastocal.model.effects.compliances import transverse_axes
from elastocal.model.effects.driven import DrivenEffect, JointMotion, LinkFrame
from elastocal.model.effects.placements import link_ends
from elastocal.units import Array


class TorqueCoupling(DrivenEffect):
    """δq_j = Σ_{i≠j} k_i τ_i with the recorded torques τ_i of the other joints; k_i in rad/(N m).

    Housings and bearings that two drives share, wrists with concentric shafts.  Setting: the
    prior size `coupling_rad_per_Nm` of each k_i.
    """

    name = "torque_coupling"
    stage = "transmission"
    at = "joints"
    constants = (Setting("coupling_rad_per_Nm", "range", 3e-7, 1e-15, 1.0),)
    together = True
    family = "torque"
    sized_by = "coupling_rad_per_Nm"
    needs = ("torque",)
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = self.stated(place, chain, cell)[self.sized_by]
        unit = motion_unit(place, chain)
        return tuple(
            ParameterSpec(f"coupling_{other}", f"{unit}/(N*m)", 0.0, size, shrunk=True)
            for other in turning_joints(chain)
            if other != place
        )

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        torque = arm.input("torque", arm.chain.n_joints)
        others = (other for other in turning_joints(arm.chain) if other != place)
        return sum((p[f"coupling_{i}"] * torque[index(i)] for i in others), ca.SX(0))


def tilt_axes(chain: Chain, i: int) -> dict[str, tuple[int, Array]]:
    """Axes (3,) across that of a revolute joint at either end of link i (0-based), in the frame
    at its distal end, with the joint's index."""
    axes: dict[str, tuple[int, Array]] = {}
    ends = {"own": (i, link_ends(chain)[i][:3, :3].T), "next": (i + 1, np.eye(3))}
    for end, (joint, R) in ends.items():
        if joint < chain.n_joints and chain.kinds[joint] == "revolute":
            across = transverse_axes(chain.joints[joint].axis)
            axes |= {f"{end}_{k}": (joint, R @ a) for k, a in zip("xy", across, strict=True)}
    return axes


class TorqueTilt(DrivenEffect):
    """The link's end turns by k τ about axes across the joints at its ends; k in rad/(N m).

    τ is the recorded torque of the link's own joint (`own`) and of the next one (`next`), the
    axes are the two across that joint's, fixed to the link.  A drive's torque bends its bearing and
    housing, and the link behind it.  Setting: the prior size `tilt_rad_per_Nm` of each k.
    """

    name = "torque_tilt"
    stage = "geometry"
    constants = (Setting("tilt_rad_per_Nm", "range", 3e-7, 1e-15, 1.0),)
    together = True
    family = "torque"
    sized_by = "tilt_rad_per_Nm"
    needs = ("torque",)
    entry = LinkFrame()

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return tuple(link for link in links(chain) if tilt_axes(chain, index(link)))

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = self.stated(place, chain, cell)[self.sized_by]
        return tuple(
            ParameterSpec(f"tilt_{key}", "rad/(N*m)", 0.0, size, shrunk=True)
            for key in tilt_axes(chain, index(place))
        )

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        torque, turn = arm.input("torque", arm.chain.n_joints), ca.SX.zeros(3)
        for key, (joint, axis) in tilt_axes(arm.chain, index(place)).items():
            turn += p[f"tilt_{key}"] * torque[joint] * rigid.constant(axis)
        return ca.vertcat(ca.SX.zeros(3), turn)
