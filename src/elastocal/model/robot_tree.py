"""Links and joints of a robot's file, URDF or MJCF alike, and the one way through them to a flange.

Everything off the way from base to flange stands still.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from elastocal.errors import InputError, require
from elastocal.model import rigid
from elastocal.model.chain import (
    FINGERS,
    MAX_JOINTS,
    MIN_JOINTS,
    Chain,
    Joint,
    JointKind,
    LinkMass,
)
from elastocal.text import did_you_mean, listed
from elastocal.units import Array

MOVING = ("revolute", "continuous", "prismatic")
# Names of flanges, the usual first.
FLANGES = ("tool0", "flange", "ee_link", "tcp")
MOST_IN_A_FINGER = 5  # joints
# Links that `elastocal export` hangs on a flange; none of them is a flange itself.
TOOL_FRAMES = ("elastocal_marker_", "elastocal_load_point")


@dataclass(frozen=True, eq=False)
class FileJoint:
    """A joint of the file: `origin` T (4, 4) from its frame at zero, which is its child's, to its
    parent link's; unit `axis`; `limit` None where none is stated, infinite where there is none.

    `follows`: the joint that it mimics; `rest`: where it stands when it is not part of the way;
    `number` is MuJoCo's.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    axis: Array
    limit: tuple[float, float] | None = None
    follows: str | None = None
    rest: float = 0.0
    number: int = -1

    @property
    def moves(self) -> bool:
        return self.kind in MOVING

    @property
    def motion(self) -> JointKind:
        return "prismatic" if self.kind == "prismatic" else "revolute"

    @property
    def held(self) -> Array:
        """T (4, 4) from the child's frame to the parent's where it stands still."""
        if not self.rest:
            return self.origin
        return self.origin @ rigid.moved(self.motion, self.axis, self.rest)


@dataclass(frozen=True)
class Tree:
    """Links, each with its own mass (0 where the file has none), and joints, in file order.

    `parts`: what links are called; `frames`: other names of places, fixed to a link.  Raises
    InputError at construction unless they form one tree: every link has at most one parent joint,
    exactly one has none, and all hang on that root.
    """

    path: Path
    name: str
    links: dict[str, LinkMass]
    joints: tuple[FileJoint, ...]
    parts: str = "links"
    frames: dict[str, tuple[str, Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for joint in self.joints:
            other = self.parent_joint[joint.child]
            require(
                other is joint,
                f"{self.path}: link '{joint.child}' has two parents, joints '{joint.name}' and "
                f"'{other.name}'; kinematic loops are not supported, remove one of them",
            )
        roots = [name for name in self.links if name not in self.parent_joint]
        reached = {link for root in roots for link in self._below(root)}
        if lost := [name for name in self.links if name not in reached]:
            way = [lost[0]]
            while way.count(way[-1]) < 2:
                way.append(self.parent_joint[way[-1]].parent)
            cycle = [self.parent_joint[name].name for name in way[way.index(way[-1]) : -1]]
            raise InputError(
                f"{self.path}: joints {listed(cycle[::-1])} form a closed loop "
                "that hangs on no root link; loops are not supported, open it at one joint"
            )
        require(
            len(roots) == 1,
            f"{self.path}: {len(roots)} links have no parent joint: {listed(roots)}; a robot "
            "is one tree with one root, connect or remove the others",
        )

    @cached_property
    def parent_joint(self) -> dict[str, FileJoint]:
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def _children(self) -> dict[str, list[str]]:
        children: dict[str, list[str]] = {name: [] for name in self.links}
        for joint in self.joints:
            children[joint.parent].append(joint.child)
        return children

    @property
    def root(self) -> str:
        return next(name for name in self.links if name not in self.parent_joint)

    def _below(self, link: str) -> Iterator[str]:
        waiting = [link]
        while waiting:
            link = waiting.pop()
            yield link
            waiting += self._children[link]

    def link_of(self, name: str) -> tuple[str, Array]:
        """The link that a name stands for, and its place (4, 4) in that link's frame."""
        return (name, np.eye(4)) if name in self.links else self.frames[name]

    def joints_between(self, base: str, flange: str) -> tuple[FileJoint, ...] | None:
        """All joints from base to flange in order, None unless flange is below base."""
        joints: list[FileJoint] = []
        link = self.link_of(flange)[0]
        while link != base:
            if link not in self.parent_joint:
                return None
            joints.append(self.parent_joint[link])
            link = joints[-1].parent
        return tuple(reversed(joints))

    def find(self, role: str, name: str, usual: str = "") -> str:
        """`name`, or an InputError with the nearest name, the `usual` one and all others."""
        there = [*self.links, *(self.frames if role == "flange" else ())]
        hint = did_you_mean(name, there)
        hint += f" (usual here: '{usual}')" if usual and f"'{usual}'" not in hint else ""
        require(
            name in there,
            f"{self.path}: {role} '{name}' is not there{hint}; {self.parts}: {listed(there)}",
        )
        return name

    def ends(self, base: str | None, flange: str | None, choose: bool = True) -> tuple[str, str]:
        """The first and the last link, None for those that are found.

        `choose`: whether a flange is found among several links that it could be.  A cell that
        leaves the choice open may have meant another frame.
        """
        base = self.root if base is None else self.find("base", base, self.root)
        if flange is not None:
            usual = ""
            if flange not in self.links and flange not in self.frames:
                with suppress(InputError):  # of several arms, each with an end of its own
                    usual = self.last_link(base)
            return base, self.find("flange", flange, usual)
        found = self.last_link(base)
        able = [k for k in self._leaves(base) if len(self._moving(base, k)) >= MIN_JOINTS]
        require(
            choose or len(able) < 2,
            f"{self.path}: several links could be the flange: {listed(sorted({*able, found}))}; "
            f"name the right one as `flange` (init takes '{found}')",
        )
        return base, found

    def last_link(self, base: str) -> str:
        """The link below `base` from which on fingers, or frames that none moves, branch off.

        Of the links that no other hangs on, those with the most moving joints on their way have it
        in common; among frames at its end one with a usual name is taken.
        """
        arms: dict[tuple[FileJoint, ...], list[str]] = {}
        for leaf in self._leaves(base):
            way = self._moving(base, leaf)
            if len(way) >= MIN_JOINTS:
                arms.setdefault(tuple(way[:MIN_JOINTS]), []).append(leaf)
        ends = [self._end_of_arm(base, leaves) for leaves in arms.values()]
        require(
            len(ends) < 2,
            f"{self.path}: several {self.parts} could be the flange, one of each arm: "
            f"{listed(sorted(ends))}; name the right one as `flange`, and its base",
        )
        leaves = self._leaves(base)
        return ends[0] if ends else max(leaves, key=lambda leaf: len(self._moving(base, leaf)))

    def _leaves(self, base: str) -> list[str]:
        """Links on which nothing hangs but tool frames that `export` has added."""
        return [
            link for link in self._below(base)
            if not link.startswith(TOOL_FRAMES)
            and all(child.startswith(TOOL_FRAMES) for child in self._children[link])
        ]  # fmt: skip

    def _end_of_arm(self, base: str, leaves: Sequence[str]) -> str:
        most = max(len(self._moving(base, leaf)) for leaf in leaves)
        ways = [
            [joint.child for joint in self.joints_between(base, leaf) or ()]
            for leaf in leaves
            if len(self._moving(base, leaf)) == most
        ]
        common = [link for link in ways[0] if all(link in way for way in ways)]
        if len(self._moving(base, common[-1])) == most and len(ways) > 1:
            named = [way[-1] for name in FLANGES for way in ways if way[-1] == name]
            return named[0] if named else common[-1]
        # Fingers of unequal length, as a thumb has: no link is common to those with most joints.
        for link in common:
            before, after = (
                len(self._moving(*pair)) for pair in ((base, link), (link, common[-1]))
            )
            if before < MIN_JOINTS or not 0 < after <= MOST_IN_A_FINGER:
                continue
            beside = [c for c in self._children[link] if c not in common and self._moves(c)]
            if len(beside) > 1 or any(self._is_finger(c) for c in beside):
                return link
        return common[-1]

    def _moves(self, link: str) -> bool:
        return any(self.parent_joint[below].moves for below in self._below(link))

    def _is_finger(self, link: str) -> bool:
        joints = [self.parent_joint[below] for below in self._below(link)]
        return any(j.follows is not None or FINGERS.search(j.name + j.child) for j in joints)

    def _moving(self, base: str, flange: str) -> list[FileJoint]:
        return [j for j in self.joints_between(base, flange) or () if j.moves]

    def placed(self, link: str) -> Array:
        """T_root_link (4, 4) with every joint between them at rest."""
        T = np.eye(4)
        for joint in self.joints_between(self.root, link) or ():
            T = T @ joint.held
        return T

    def serial_chain(self, base: str, flange: str) -> tuple[FileJoint, ...]:
        """The moving joints between base and flange, in order."""
        joints = self.joints_between(base, flange)
        if joints is None:
            raise InputError(
                f"{self.path}: flange '{flange}' is not below base '{base}'; {self.parts} below "
                f"'{base}': {listed(link for link in self._below(base) if link != base)}"
            )
        for joint in joints:
            _check_on_path(joint, f"{self.path}: joint '{joint.name}'")
        moving = self._moving(base, flange)
        names = listed(j.name or f"joint{k}" for k, j in enumerate(moving, start=1)) or "none"
        require(
            MIN_JOINTS <= len(moving) <= MAX_JOINTS,
            f"{self.path}: {len(moving)} moving joints between '{base}' and '{flange}' "
            f"({names}); {MIN_JOINTS} to {MAX_JOINTS} are supported, choose base and flange "
            "accordingly",
        )
        return tuple(moving)

    def carriers(self, moving: Sequence[FileJoint]) -> dict[str, tuple[int, Array]]:
        """Every link that one of the joints moves: number of the last of them, and the place
        (4, 4) in its frame."""
        own = {joint.child: k for k, joint in enumerate(moving)}
        at: dict[str, tuple[int, Array]] = {}
        for link in self._below(self.root):
            before = self.parent_joint.get(link)
            if link in own:
                at[link] = own[link], np.eye(4)
            elif before is not None and before.parent in at:
                k, T = at[before.parent]
                at[link] = k, T @ before.held
        return at

    def chain(self, base: str, flange: str) -> Chain:
        """Placements in m, unit axes, limits in rad or m, and one mass per joint in kg of all that
        it carries up to the next one, with its centre in m in the joint's frame; none where all
        are zero.  Bodies beyond the flange and on side branches count, those on the base do not."""
        moving = self.serial_chain(base, flange)
        joints: list[Joint] = []
        T = np.eye(4)
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of 1e308 are judged later
            for source in self.joints_between(base, flange) or ():
                T = T @ source.origin
                if source.moves:
                    name = source.name or f"joint{len(joints) + 1}"
                    limits = source.limit or (-np.inf, np.inf)
                    joints.append(Joint(name, source.motion, T, source.axis, *limits))
                    T = np.eye(4)
            masses = self._carried(moving)
        end = T @ self.link_of(flange)[1]
        return Chain(self.name, tuple(joints), end, masses)

    def _carried(self, moving: Sequence[FileJoint]) -> tuple[LinkMass, ...]:
        mass, moment = np.zeros(len(moving)), np.zeros((len(moving), 3))
        for link, (k, T) in self.carriers(moving).items():
            body = self.links[link]
            mass[k] += body.mass
            moment[k] += body.mass * (T @ [*body.com, 1.0])[:3]
        both = zip(mass, moment, strict=True)
        whole = tuple(LinkMass(float(m), s / m if m > 0 else np.zeros(3)) for m, s in both)
        return whole if mass.any() else ()


def _check_on_path(joint: FileJoint, where: str) -> None:
    require(
        joint.moves or joint.kind == "fixed",
        f"{where} is {joint.kind} and lies between base and flange; only {', '.join(MOVING)} and "
        "fixed joints can, choose a base below it",
    )
    if not joint.moves:
        return
    require(
        joint.follows is None,
        f"{where} mimics '{joint.follows}' and lies between base and flange; coupled joints "
        "are not supported there, remove <mimic> or choose another flange",
    )
    if joint.kind == "continuous":
        return
    if joint.limit is None:
        raise InputError(
            f'{where} is {joint.kind} without <limit>; add <limit lower="…" upper="…" '
            'effort="0" velocity="0"/> or make it continuous'
        )
    lower, upper = joint.limit
    require(
        lower < upper,
        f"{where}: limits lower={lower:g}, upper={upper:g} leave no room to move; "
        "lower must be below upper (a URDF takes 0 for one left out)",
    )
