"""The tree of links and joints in a URDF, and the one path through it from base to flange."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from elastocal.errors import InputError
from elastocal.manipulator.chain import MAX_JOINTS, MIN_JOINTS
from elastocal.text import did_you_mean, listed

Vector = tuple[float, float, float]
MOVING = ("revolute", "continuous", "prismatic")
# Links that `elastocal export` hangs on a flange; none of them is a flange itself.
TOOL_FRAMES = ("elastocal_marker_", "elastocal_load_point")


@dataclass(frozen=True)
class Link:
    """Mass in kg (0 where the URDF has none) and centre of mass in m in the link's frame."""

    name: str
    mass: float = 0.0
    com: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class UrdfJoint:
    """One <joint>: origin in m and rad, unit axis, limit (lower, upper) or None."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector
    rpy: Vector
    axis: Vector
    limit: tuple[float, float] | None = None
    mimic: str | None = None


@dataclass(frozen=True)
class Tree:
    """Links and joints by name, in file order.

    Raises InputError at construction unless they form one tree: every link has at most one
    parent joint, exactly one has none, and all hang on that root.
    """

    path: Path
    name: str
    links: dict[str, Link]
    joints: dict[str, UrdfJoint]

    def __post_init__(self) -> None:
        parents: dict[str, UrdfJoint] = {}
        for joint in self.joints.values():
            other = parents.setdefault(joint.child, joint)
            if other is not joint:
                raise InputError(
                    f"{self.path}: link '{joint.child}' has two parents, joints '{other.name}' and "
                    f"'{joint.name}'; kinematic loops are not supported, remove one of them"
                )
        roots = [name for name in self.links if name not in parents]
        reached = {link for root in roots for link in self._below(root)}
        if len(reached) < len(self.links):
            cycle = self._cycle(next(name for name in self.links if name not in reached))
            raise InputError(
                f"{self.path}: joints {listed(cycle)} form a closed loop "
                "that hangs on no root link; loops are not supported, open it at one joint"
            )
        if len(roots) > 1:
            raise InputError(
                f"{self.path}: {len(roots)} links have no parent joint: {listed(roots)}; a robot "
                "is one tree with one root, connect or remove the others"
            )

    @cached_property
    def parent_joint(self) -> dict[str, UrdfJoint]:
        return {joint.child: joint for joint in self.joints.values()}

    @cached_property
    def _child_joints(self) -> dict[str, list[UrdfJoint]]:
        children: dict[str, list[UrdfJoint]] = {name: [] for name in self.links}
        for joint in self.joints.values():
            children[joint.parent].append(joint)
        return children

    @property
    def root(self) -> str:
        return next(name for name in self.links if name not in self.parent_joint)

    def _below(self, link: str) -> Iterator[str]:
        waiting = [link]
        while waiting:
            link = waiting.pop()
            yield link
            waiting += [joint.child for joint in self._child_joints[link]]

    def _cycle(self, link: str) -> list[str]:
        seen: list[str] = []
        while link not in seen:
            seen.append(link)
            link = self.parent_joint[link].parent
        return [self.parent_joint[name].name for name in reversed(seen[seen.index(link) :])]

    def joints_between(self, base: str, flange: str) -> tuple[UrdfJoint, ...] | None:
        """All joints from base to flange in order, None unless flange is below base."""
        joints: list[UrdfJoint] = []
        link = flange
        while link != base:
            if link not in self.parent_joint:
                return None
            joints.append(self.parent_joint[link])
            link = joints[-1].parent
        return tuple(reversed(joints))

    def find_link(self, role: str, name: str) -> str:
        """`name`, or an InputError with the nearest name and all links if there is no such link."""
        if name not in self.links:
            raise InputError(
                f"{self.path}: {role} link '{name}' is not there{did_you_mean(name, self.links)}; "
                f"links: {listed(self.links)}"
            )
        return name

    def last_link(self, base: str) -> str:
        """The only leaf below `base` that enough moving joints carry to be a flange."""
        leaves = [link for link in self._below(base) if self._is_leaf(link)]
        able = [leaf for leaf in leaves if len(self._moving(base, leaf)) >= MIN_JOINTS]
        choice = able or leaves
        if len(choice) > 1:
            raise InputError(
                f"{self.path}: several links could be the flange: {listed(sorted(choice))}; "
                "name the right one as `flange`"
            )
        return choice[0]

    def _is_leaf(self, link: str) -> bool:
        """Does nothing hang on the link but tool frames that `export` has added?"""
        below = (joint.child for joint in self._child_joints[link])
        return not link.startswith(TOOL_FRAMES) and all(c.startswith(TOOL_FRAMES) for c in below)

    def _moving(self, base: str, flange: str) -> list[UrdfJoint]:
        joints = self.joints_between(base, flange) or ()
        return [joint for joint in joints if joint.kind in MOVING]

    def serial_chain(self, base: str, flange: str) -> tuple[UrdfJoint, ...]:
        """The moving joints between base and flange, in order.

        Raises InputError if flange is not below base, if a joint on the path is floating, planar
        or a mimic or has no usable limits, or if the count is outside 4…9.
        """
        joints = self.joints_between(base, flange)
        if joints is None:
            raise InputError(
                f"{self.path}: flange '{flange}' is not below base '{base}'; links below "
                f"'{base}': {listed(link for link in self._below(base) if link != base)}"
            )
        for joint in joints:
            self._check_on_path(joint, f"{self.path}: joint '{joint.name}'")
        moving = self._moving(base, flange)
        if not MIN_JOINTS <= len(moving) <= MAX_JOINTS:
            names = listed(joint.name for joint in moving) or "none"
            raise InputError(
                f"{self.path}: {len(moving)} moving joints between '{base}' and '{flange}' "
                f"({names}); {MIN_JOINTS} to {MAX_JOINTS} are supported, choose base and flange "
                "accordingly"
            )
        return tuple(moving)

    def _check_on_path(self, joint: UrdfJoint, where: str) -> None:
        if joint.kind in ("floating", "planar"):
            raise InputError(
                f"{where} is {joint.kind} and lies between base and flange; only revolute, "
                "continuous, prismatic and fixed joints can, choose a base below it"
            )
        if joint.kind not in MOVING:
            return
        if joint.mimic is not None:
            raise InputError(
                f"{where} mimics '{joint.mimic}' and lies between base and flange; coupled joints "
                "are not supported there, remove <mimic> or choose another flange"
            )
        if joint.kind == "continuous":
            return
        if joint.limit is None:
            raise InputError(
                f'{where} is {joint.kind} without <limit>; add <limit lower="…" upper="…" '
                'effort="0" velocity="0"/> or make it continuous'
            )
        lower, upper = joint.limit
        if lower >= upper:
            raise InputError(
                f"{where}: limits lower={lower:g}, upper={upper:g} leave no room to move; "
                "lower must be below upper (URDF takes 0 for one left out)"
            )
