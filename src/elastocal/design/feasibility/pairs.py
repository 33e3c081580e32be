"""Which bodies must keep apart, and how far: the pairs that collision checks look at."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from elastocal.cell import Cell, HalfSpace, Workspace
from elastocal.design.feasibility.bodies import Body, distal_placements
from elastocal.design.feasibility.carriers import WORLD
from elastocal.design.feasibility.shapes import hull, touches
from elastocal.errors import InputError
from elastocal.manipulator.chain import Chain
from elastocal.text import did_you_mean, listed

Rule = Literal["keep_out", "load_height", "obstacle", "self_collision"]
RULES: tuple[Rule, ...] = get_args(Rule)
FLOOR = "min_height"  # name of the half-space under the hanging load
TOUCH = 1e-6  # m: a body this near to the load point holds the hook


@dataclass(frozen=True)
class Pair:
    """`body` must stay `margin` m away from `other`, or the pose breaks `rule`."""

    body: Body
    other: Body | HalfSpace
    margin: float
    rule: Rule

    @property
    def hangs(self) -> bool:
        """Counts in loaded readings only."""
        return self.body.hangs or (isinstance(self.other, Body) and self.other.hangs)

    @property
    def names(self) -> tuple[str, str]:
        return self.body.name, self.other.name


def cell_pairs(cell: Cell, chain: Chain, bodies: tuple[Body, ...]) -> tuple[Pair, ...]:
    """All pairs that are checked.

    Every moving body against every obstacle (`clearance`) and every half-space (no margin), and
    the arm's bodies, carried bodies, rope and load among themselves (`self_clearance`), except
    bodies of the same carrier, neighbouring links, links that joints hold together whatever the
    pose, the rope with the bodies that hold its hook, and `ignored_pairs`.  Raises InputError
    where `ignored_pairs` names a body that is not there.
    """
    workspace = cell.workspace
    ignored = _ignored(cell, bodies)
    moving = [body for body in bodies if body.carrier != WORLD]
    own = [body for body in bodies if body.kind != "obstacle"]
    obstacles = [body for body in bodies if body.kind == "obstacle"]
    pairs = [Pair(body, space, 0.0, "keep_out") for body in moving for space in workspace.keep_out]
    load = workspace.load
    if load is not None and load.min_height is not None:
        up = np.array([0.0, 0.0, 1.0])
        floor = HalfSpace(FLOOR, load.min_height * up, up)
        hung = [body for body in bodies if body.kind == "load"]
        pairs += [Pair(body, floor, 0.0, "load_height") for body in hung]
    pairs += [Pair(b, o, workspace.clearance, "obstacle") for b in moving for o in obstacles]
    if workspace.self_collision:
        hooks = _hooks(own, chain, cell.tool.load_point)
        pairs += [
            Pair(b, a, workspace.self_clearance, "self_collision")
            for a, b in combinations(own, 2)
            if not _joined(a, b, workspace, chain, hooks)
        ]
    return tuple(pair for pair in pairs if frozenset(pair.names) not in ignored)


def _ignored(cell: Cell, bodies: tuple[Body, ...]) -> set[frozenset[str]]:
    workspace = cell.workspace
    valid = [body.name for body in bodies] + [space.name for space in workspace.keep_out]
    for pair in workspace.ignored_pairs:
        for name in pair:
            if name not in valid:
                raise InputError(
                    f"{cell.path or cell.name}: [workspace] ignored_pairs names '{name}', "
                    f"but the cell has no such body"
                    f"{did_you_mean(name, valid)}; valid: {listed(valid)}"
                )
    return {frozenset(pair) for pair in workspace.ignored_pairs}


def _joined(a: Body, b: Body, workspace: Workspace, chain: Chain, hooks: set[str]) -> bool:
    """True where the two cannot or need not keep apart."""
    if a.carrier == b.carrier:
        return True
    if a.hangs or b.hangs:
        hung, other = (a, b) if a.hangs else (b, a)
        rope = workspace.load.rope if workspace.load is not None else 0.0
        return other.name in hooks and (hung.kind == "rope" or rope == 0)
    if a.kind != "arm" or b.kind != "arm":
        return False
    i, j = sorted((a.carrier, b.carrier))
    return j == i + 1 or _held_together(a, b, workspace, chain)


def _held_together(a: Body, b: Body, workspace: Workspace, chain: Chain) -> bool:
    """Skeleton links i < j whose ends are never further apart than the links between are long.

    Such a pair is in contact at every pose and says nothing (a spherical wrist).  A prismatic
    joint between them can part them.
    """
    if workspace.urdf_geometry:
        return False
    i, j = sorted((a.carrier, b.carrier))
    if any(chain.joints[k].kind == "prismatic" for k in range(i + 1, j + 1)):
        return False
    between = distal_placements(chain)[i + 1 : j]
    length = sum(float(np.linalg.norm(T[:3, 3])) for T in between)
    return length <= hull(a.solid)[1] + hull(b.solid)[1] + workspace.self_clearance


def _hooks(own: list[Body], chain: Chain, load_point: np.ndarray) -> set[str]:
    """Names of the bodies on the last link that contain or touch the load point."""
    last = chain.n_joints - 1
    hook = (chain.flange_placement @ [*load_point, 1.0])[:3]
    return {b.name for b in own if b.carrier == last and touches(b.solid, hook, TOUCH)}
