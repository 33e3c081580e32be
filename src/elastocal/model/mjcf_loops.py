"""Closed loops of a MuJoCo model: <equality> that ties joints of the arm to each other.

A chain of independent joints is read from the file, so none of them may depend on another.  Bodies
are the vertices of a graph, their places in the tree and the constraints its edges; a body that
floats (<freejoint>, mocap) has no edge to its parent.  The arm is open where every edge that a
joint of it moves is a bridge.  Constraints on joint values (joint, fixed tendon) take one degree
of freedom each: they bind the arm where a group of joints has more of them than joints beside the
arm.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from elastocal.errors import require
from elastocal.text import listed

WORLD = 0


@dataclass(frozen=True)
class Tie:
    """A constraint: pairs of `ends`, each (body or site, name), or the `joints` that it ties."""

    kind: str
    name: str
    ends: tuple[tuple[tuple[str, str], tuple[str, str]], ...] = ()
    joints: tuple[str, ...] = ()

    def __str__(self) -> str:
        tied = listed(f"'{name}'" for name in self.joints) or " and ".join(
            dict.fromkeys(f"{k} '{name or 'world'}'" for pair in self.ends for k, name in pair)
        )
        name = f" '{self.name}'" if self.name else ""
        return f"<equality><{self.kind}>{name} of {tied}"


def ties_of(spec: Any) -> list[Tie]:
    """The active constraints of a file, from MuJoCo's MjSpec of it."""
    import mujoco

    eq, found = mujoco.mjtEq, []
    tendons = {tendon.name: tendon for tendon in spec.tendons}
    for one in spec.equalities:
        names = [name for name in (one.name1, one.name2) if name]
        if not one.active:
            continue
        if one.type in (eq.mjEQ_CONNECT, eq.mjEQ_WELD):
            kind = "connect" if one.type == eq.mjEQ_CONNECT else "weld"
            what = "site" if one.objtype == mujoco.mjtObj.mjOBJ_SITE else "body"
            found.append(Tie(kind, one.name, (((what, one.name1), (what, one.name2)),)))
        elif one.type == eq.mjEQ_JOINT:
            found.append(Tie("joint", one.name, joints=tuple(names)))
        elif one.type == eq.mjEQ_TENDON:
            found += _of_tendons(one.name, [tendons[name] for name in names])
    return found


def _of_tendons(name: str, tendons: list[Any]) -> list[Tie]:
    """A tendon over joints ties these, one between sites their bodies."""
    import mujoco

    joints, ends = [], []
    for tendon in tendons:
        before = ""
        for wrap in getattr(tendon, "path", ()):
            if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT:
                joints.append(wrap.target.name)
            elif wrap.type == mujoco.mjtWrap.mjWRAP_SITE:
                if before:
                    ends.append((("site", before), ("site", wrap.target.name)))
                before = wrap.target.name
    ties = [Tie("tendon", name, joints=tuple(joints))] if joints else []
    return ties + ([Tie("tendon", name, ends=tuple(ends))] if ends else [])


def check_open(arm: Any, ties: list[Tie]) -> None:
    """Raise InputError, naming constraint and joints, where an `MjcfArm` is no open chain.

    A weld of what the last joint carries to the world or to a mocap body is no loop of the arm's:
    people drag the flange by it.
    """
    _check_values(arm, [tie for tie in ties if tie.joints])
    edges = [(a, b, tie) for tie in ties for a, b in _bodies(arm, tie)]
    model = arm.model
    free = _floating(arm)
    beside: list[list[tuple[int, Tie | None]]] = [[] for _ in range(model.nbody)]
    pairs: list[tuple[int, int, Tie | None]] = [*edges]
    pairs += [
        (b, int(model.body_parentid[b]), None) for b in range(1, model.nbody) if b not in free
    ]
    for a, b, tie in pairs:
        beside[a].append((b, tie))
        beside[b].append((a, tie))
    for j in arm.joints:
        body = int(model.jnt_bodyid[j])
        way = _way_around(beside, body, int(model.body_parentid[body]))
        require(
            not way,
            f"{arm.path}: joint '{arm.joint_name(j)}' is part of a closed loop, by "
            f"{listed(map(str, way))}; loops are not supported between base and flange, remove the "
            "constraint or choose another flange",
        )


def _check_values(arm: Any, ties: list[Tie]) -> None:
    own = {arm.model.joint(j).name for j in arm.joints} - {""}
    groups: list[tuple[set[str], list[Tie]]] = []
    for tie in ties:
        names, members = set(tie.joints), [tie]
        for other in [g for g in groups if g[0] & names]:
            groups.remove(other)
            names, members = names | other[0], other[1] + members
        groups.append((names, members))
    for names, members in groups:
        # joint1 of <joint> follows joint2, as a mimic does in a URDF.
        follows = [tie for tie in members if tie.kind == "joint" and tie.joints[0] in own]
        bound = names & own and len(members) > len(names - own)
        require(
            not follows and not bound,
            f"{arm.path}: joint {listed(repr(n) for n in sorted(names & own))} is coupled by "
            f"{listed(map(str, follows or members))}; coupled joints are not supported between "
            "base and flange, remove the constraint or choose another flange",
        )


def _bodies(arm: Any, tie: Tie) -> list[tuple[int, int]]:
    """The pairs of bodies that a constraint ties, without those that leave the arm open."""
    model, found = arm.model, []
    for ends in tie.ends:
        a, b = (
            WORLD if not name
            else int(model.site_bodyid[model.site(name).id]) if kind == "site"
            else int(model.body(name).id)
            for kind, name in ends
        )  # fmt: skip
        at_end = [arm.carrier(body) == arm.joints[-1] for body in (a, b)]
        still = [model.body_weldid[body] == WORLD for body in (a, b)]
        dragged = (at_end[0] and still[1]) or (at_end[1] and still[0])
        if not (tie.kind == "weld" and dragged):
            found.append((a, b))
    return found


def _floating(arm: Any) -> set[int]:
    """Bodies that are free of their parent."""
    import mujoco

    model, free = arm.model, mujoco.mjtJoint.mjJNT_FREE
    loose = {int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == free}
    return loose | {b for b in range(model.nbody) if model.body_mocapid[b] >= 0}


def _way_around(beside: list[list[tuple[int, Tie | None]]], start: int, end: int) -> list[Tie]:
    """The constraints on a way from a body to its parent that is not the edge between them."""
    came: dict[int, tuple[int, Tie | None]] = {start: (start, None)}
    waiting = deque([start])
    while waiting and end not in came:
        body = waiting.popleft()
        for other, tie in beside[body]:
            if other not in came and not (body == start and other == end and tie is None):
                came[other] = (body, tie)
                waiting.append(other)
    way, body = [], end
    while body in came and body != start:
        body, tie = came[body]
        if tie is not None and tie not in way:
            way.append(tie)
    return way
