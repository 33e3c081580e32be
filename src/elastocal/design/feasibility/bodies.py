"""All bodies of a cell in one list: arm, tool, hanging load, obstacles, each with its carrier.

A body stands at frames[:, carrier] @ solid.placement in the data's frame (`frames.py`).  The
arm is rigid here, at its nominal geometry: clearances must cover deflections of a few mm.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import CarriedBody, Cell, HangingLoad, Solid
from elastocal.design.feasibility.carriers import HANGING, WORLD
from elastocal.design.feasibility.shapes import capsule_between, support
from elastocal.errors import InputError
from elastocal.manipulator.chain import Chain
from elastocal.text import did_you_mean, listed

Array = NDArray[np.float64]
Kind = Literal["arm", "carried", "load", "rope", "obstacle"]

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Body:
    """A solid and what moves it.

    `carrier`: i ≥ 0 the frame of joint i (0-based, after its motion), WORLD or HANGING;
    `solid.placement` is in that frame.  What sits on the flange is carried by the last joint.
    """

    solid: Solid
    carrier: int
    kind: Kind

    @property
    def name(self) -> str:
        return self.solid.name

    @property
    def hangs(self) -> bool:
        """There in loaded readings only."""
        return self.carrier == HANGING


def data_base(cell: Cell) -> Array:
    """T_data_base (4, 4) of the nominal cell."""
    nominal, T = cell.model.nominal, np.eye(4)
    if nominal.base_rotation is not None:
        T[:3, :3] = nominal.base_rotation
    if nominal.base_position is not None:
        T[:3, 3] = nominal.base_position
    return T


def cell_bodies(cell: Cell, chain: Chain) -> tuple[Body, ...]:
    """Every body of the cell: arm, carried bodies, hanging load and rope, obstacles.

    Raises InputError where two bodies share a name, a body is carried by an unknown link, or
    the URDF's own geometry is asked for and cannot be had.
    """
    workspace = cell.workspace
    bodies = (
        *_arm(cell, chain),
        *(_carried(body, cell, chain) for body in workspace.bodies),
        *(() if workspace.load is None else hanging(workspace.load)),
        *(Body(solid, WORLD, "obstacle") for solid in workspace.obstacles),
    )
    seen: set[str] = set()
    for body in bodies:
        if body.name in seen:
            raise InputError(
                f"{cell.path or cell.name}: [workspace] has two bodies named '{body.name}'; "
                "rename one (base, link1 … and rope are taken)"
            )
        seen.add(body.name)
    return bodies


def _arm(cell: Cell, chain: Chain) -> Iterator[Body]:
    workspace = cell.workspace
    where = f"{cell.path or cell.name}: [workspace]"
    if workspace.urdf_geometry and workspace.link_radius:
        raise InputError(
            f'{where} gives link_radius and geometry = "urdf"; the arm can have only one'
        )
    if workspace.urdf_geometry:
        from elastocal.design.feasibility.urdf_bodies import urdf_bodies

        for solid, carrier in urdf_bodies(cell, chain):
            on_base = carrier == WORLD
            placed = replace(solid, placement=data_base(cell) @ solid.placement)
            yield Body(placed if on_base else solid, carrier, "arm")
    elif workspace.link_radius:
        yield from skeleton(chain, workspace.link_radius, data_base(cell), where)


def skeleton(
    chain: Chain, radius: tuple[float, ...], T_data_base: Array, where: str
) -> Iterator[Body]:
    """Capsules along the chain: link i from joint i's origin to joint i+1's at zero offset.

    "base" reaches from the base's origin to joint 1 with the radius of link 1, the last link to
    the flange.  `radius` is one per link, or one for all.  A link whose joints coincide is a
    sphere; one of radius 0 has no body.
    """
    radius = radius * chain.n_joints if len(radius) == 1 else radius
    if len(radius) != chain.n_joints:
        raise InputError(
            f"{where} link_radius has {len(radius)} values, but robot '{chain.name}' has "
            f"{chain.n_joints} links"
        )
    ends = [T[:3, 3] for T in distal_placements(chain)]
    foot, first = T_data_base[:3, 3], (T_data_base @ chain.joints[0].placement)[:3, 3]
    if radius[0] > 0 and np.linalg.norm(first - foot) > 0:
        yield Body(capsule_between("base", foot, first, radius[0]), WORLD, "arm")
    for i, (end, r) in enumerate(zip(ends, radius, strict=True)):
        if r > 0:
            yield Body(capsule_between(f"link{i + 1}", np.zeros(3), end, r), i, "arm")


def distal_placements(chain: Chain) -> list[Array]:
    """What follows each joint (4, 4) in its frame: the next joint at zero, at last the flange."""
    return [*(joint.placement for joint in chain.joints[1:]), chain.flange_placement]


def _carried(body: CarriedBody, cell: Cell, chain: Chain) -> Body:
    solid = body.solid
    if body.on == "base":
        return Body(_moved(data_base(cell), solid), WORLD, "carried")
    if body.on == "flange":
        return Body(_moved(chain.flange_placement, solid), chain.n_joints - 1, "carried")
    links = [f"link{i + 1}" for i in range(chain.n_joints)]
    if body.on not in links:
        valid = ["base", *links, "flange"]
        raise InputError(
            f"{cell.path or cell.name}: [workspace] body '{solid.name}' is on '{body.on}'"
            f"{did_you_mean(body.on, valid)}; valid: {listed(valid)}"
        )
    return Body(solid, links.index(body.on), "carried")


def hanging(load: HangingLoad) -> Iterator[Body]:
    """The rope, straight down from the load point, and the load, its top at the rope's end.

    The load does not turn with the flange: its axes keep their direction in the data's frame.
    """
    if load.rope > 0:
        foot = np.array([0.0, 0.0, -load.rope])
        yield Body(capsule_between("rope", np.zeros(3), foot, load.rope_radius), HANGING, "rope")
    lowered = np.eye(4)
    lowered[2, 3] = -load.rope - support(load.solid, UP)
    yield Body(_moved(lowered, load.solid), HANGING, "load")


def _moved(T: Array, solid: Solid) -> Solid:
    return replace(solid, placement=T @ solid.placement)
