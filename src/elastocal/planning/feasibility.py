"""May the arm stand there, and may it go there?  All rules of the cell in one place."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from elastocal.cell import Cell
from elastocal.messages import InputError, rounded
from elastocal.model.chain import Chain, finite_ranges, joint_limits
from elastocal.planning.bodies import RULES, Body, Pair, cell_bodies, cell_pairs
from elastocal.planning.collision import (
    DOWN,
    Collisions,
    Kinematics,
    Paths,
    Poses,
    Sight,
    StaticTorque,
    hits_by_pair,
    incidence,
    marker_positions,
    rope_angle,
)
from elastocal.units import Array, BoolArray

# What a rule of the cell is, and those that bound a quantity of the pose.

SAME = 1e-9  # rounding of a joint value that was set to its limit
SHOWN = 3  # causes that a remedy names
ADVICE = {
    "struck": "; strike fewer poses",
    "mounting_plane": (
        "; where the arm may reach below z = 0 of its base, set [workspace] mounting_plane = false"
    ),
    "keep_out": "; move the boundary in [[workspace.keep_out]]",
    "load_height": "; lower [workspace.load] min_height_m or shorten its rope",
    "obstacle": "; move or shrink the obstacle",
    "self_collision": "; shrink the bodies if they are modelled too large",
    "line_of_sight": "; move the tracker or the markers",
    "markers_seen": " not seen; move the tracker or the markers, or lower min_markers",
}


class Rule(ABC):
    """One thing a pose must respect; its causes: a joint, a marker, a pair of bodies → (N,)."""

    name: str

    @abstractmethod
    def causes(self, poses: Poses) -> dict[str, BoolArray]: ...

    def broken(self, poses: Poses) -> BoolArray:
        return np.any(list(self.causes(poses).values()), axis=0)

    def remedy(self, poses: Poses) -> str:
        """What to relax for poses that break this rule and no other."""
        counts = [(int(hit.sum()), name) for name, hit in self.causes(poses).items()]
        counts.sort(key=lambda count: -count[0])
        told = ", ".join(f"{name} ({n})" for n, name in counts[:SHOWN] if n)
        return f"most often {told}{ADVICE[self.name]}"


@dataclass(frozen=True)
class Bound(Rule):
    """lower ≤ quantity ≤ upper: joint values, range, incidence, rope angle, torque.

    `quantity` gives (N, m), `lower` and `upper` are (m,) or one for all, as `units`, which messages
    show it in: "°" for quantities in rad.  `labels` (m) name the columns, `key` is what the user
    calls the limit.
    """

    name: str
    quantity: Callable[[Poses], Array]
    lower: Array | float
    upper: Array | float
    labels: tuple[str, ...]
    key: str
    units: tuple[str, ...]

    def _outside(self, poses: Poses) -> tuple[Array, BoolArray, BoolArray]:
        value = self.quantity(poses)
        return value, value < self.lower - SAME, value > self.upper + SAME

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        _, below, above = self._outside(poses)
        return {label: below[:, i] | above[:, i] for i, label in enumerate(self.labels)}

    def remedy(self, poses: Poses) -> str:
        value, below, above = self._outside(poses)
        i = int((below | above).sum(axis=0).argmax())
        low = below[:, i].sum() > above[:, i].sum()
        limit = np.broadcast_to(self.lower if low else self.upper, len(self.labels))[i]
        half = np.median(value[below[:, i] if low else above[:, i], i])
        unit = self.units[i % len(self.units)]
        scale = 180 / np.pi if unit == "°" else 1.0
        return (
            f"{self.key} of {rounded(half * scale, 4)} {unit} instead of "
            f"{rounded(limit * scale, 4)} {unit} for "
            f"{self.labels[i]} would let half of those pass"
        )


NEARBY = 0.2  # rad or m in every joint: what stands in one pose's way will stand in the other's


class Struck(Rule):
    """Not near one of the poses (m, n) that the user has struck out."""

    name = "struck"

    def __init__(self, struck: Array) -> None:
        self._struck = struck

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        off = [np.abs(poses.q - q).max(axis=1) for q in self._struck]
        return {"a pose struck out": np.asarray(np.min(off, axis=0) < NEARBY)}


# Rules about bodies: keep-out, obstacles, self-collision, height of the load, line of sight.

# A pose keeps every margin by this much more, so that a move that ends there can be certified.
POSE_SLACK = 1e-4  # m


class KeepApart(Rule):
    """No pair of bodies nearer than its margin."""

    def __init__(self, name: str, kinematics: Kinematics, pairs: Sequence[Pair]) -> None:
        self.name, self._kinematics, self._pairs = name, kinematics, tuple(pairs)
        self._collisions = Collisions(kinematics, pairs)

    def broken(self, poses: Poses) -> BoolArray:
        return self._collisions.hits(poses, POSE_SLACK)

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        return hits_by_pair(self._kinematics, self._pairs, poses, POSE_SLACK)

    def remedy(self, poses: Poses) -> str:
        text = super().remedy(poses)
        margin = max(pair.margin for pair in self._pairs)
        freed = int((~self._collisions.hits(poses, POSE_SLACK - margin)).sum()) if margin else 0
        key = {"obstacle": "clearance_mm", "self_collision": "self_clearance_mm"}.get(self.name)
        if freed:
            text += f", or {key} of 0 instead of {rounded(margin * 1e3, 4)} would free {freed}"
        return text


@dataclass(frozen=True)
class LineOfSight(Rule):
    """Every marker is seen from the tracker."""

    sight: Sight
    markers: Mapping[str, Array]
    name = "line_of_sight"

    def broken(self, poses: Poses) -> BoolArray:
        hidden = np.zeros(len(poses), dtype=bool)
        for marker in self.markers.values():
            observed = np.flatnonzero(~hidden)
            hidden[observed] = self.sight.blocked(poses.take(observed), marker)
        return hidden

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        return {
            f"{name} behind {body.name}": self.sight.past(body).blocked(poses, marker)
            for body in self.sight.bodies
            for name, marker in self.markers.items()
        }


@dataclass(frozen=True)
class EnoughMarkers(Rule):
    """At least so many markers are in range, turned towards the tracker, and in its sight."""

    bounds: Sequence[Rule]
    sight: Sight | None
    markers: Mapping[str, Array]
    least: int
    name = "markers_seen"

    def seen(self, poses: Poses) -> BoolArray:
        """(N, markers): which are seen; nothing is looked for behind bodies where too few remain
        without."""
        seen, names = np.ones((len(poses), len(self.markers)), dtype=bool), list(self.markers)
        for rule in self.bounds:
            for name, outside in rule.causes(poses).items():
                seen[:, names.index(name)] &= ~outside
        hopeful = seen.sum(axis=1) >= self.least
        if self.sight is not None:
            for k, marker in enumerate(self.markers.values()):
                rows = np.flatnonzero(hopeful & seen[:, k])
                seen[rows, k] = ~self.sight.blocked(poses.take(rows), marker)
        return seen

    def broken(self, poses: Poses) -> BoolArray:
        return np.asarray(self.seen(poses).sum(axis=1) < self.least)

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        return dict(zip(self.markers, ~self.seen(poses).T, strict=True))


@dataclass(frozen=True)
class PoseFeasibility:
    """What the `rules` (R) say of candidates `q` (N, n) under `force` (N, 3): `broken` (N, R)."""

    rules: tuple[str, ...]
    broken: BoolArray
    q: Array
    force: Array

    @property
    def ok(self) -> BoolArray:
        return np.asarray(~self.broken.any(axis=1))

    @property
    def removed_by(self) -> dict[str, int]:
        """Candidates by the first rule they break: tried = feasible + Σ removed_by."""
        first = (self.broken & (self.broken.cumsum(axis=1) == 1)).sum(axis=0)
        return dict(zip(self.rules, first.tolist(), strict=True))


# The rules that a cell states, in the order of checking: cheap ones first.


def rule_book(
    cell: Cell, chain: Chain, kinematics: Kinematics, bodies: Sequence[Body], pairs: Sequence[Pair]
) -> tuple[Rule, ...]:
    bounds, stated, markers = tuple(_visibility(cell)), cell.workspace.visibility, cell.tool.markers
    sight, seen = None, tuple[Rule, ...]()
    if stated is not None and stated.line_of_sight:
        sight = Sight(kinematics, bodies, cell.tracker.position, stated.beam_radius)
        seen = (LineOfSight(sight, markers),)
    least = None if stated is None else stated.min_markers
    if least is not None and least < len(markers):
        bounds, seen = (), (EnoughMarkers(bounds, sight, markers, least),)
    units = tuple("°" if kind == "revolute" else "m" for kind in chain.kinds)
    joints = tuple(f"joint{i + 1}" for i in range(chain.n_joints))
    limits = joint_limits(cell, chain)
    return (
        Bound("joint_limits", lambda p: p.q, *limits, joints, "a limit", units),
        *bounds,
        *_load(cell, chain, joints),
        *(
            KeepApart(rule, kinematics, own)
            for rule in RULES
            if (own := [pair for pair in pairs if pair.rule == rule])
        ),
        *seen,
    )


def _visibility(cell: Cell) -> Iterator[Rule]:
    sight, eye = cell.workspace.visibility, cell.tracker.position
    if sight is None:
        return
    if not cell.tool.markers:
        raise InputError(
            f"{cell.source}: [workspace.visibility] needs the markers; give [tool.markers_m]"
        )
    names, markers = tuple(cell.tool.markers), list(cell.tool.markers.values())
    near, far = sight.range

    def distance(poses: Poses) -> Array:
        return np.asarray(np.linalg.norm(marker_positions(poses, markers) - eye, axis=2))

    if near > 0 or np.isfinite(far):
        yield Bound("range", distance, near, far, names, "a range_m", ("m",))
    observed = tuple(name for name in names if name in sight.normals)
    if sight.max_incidence is not None and observed:
        at = [cell.tool.markers[name] for name in observed]
        axes = [sight.normals[name] for name in observed]
        yield Bound(
            "incidence", lambda p: incidence(p, at, axes, eye), 0.0, sight.max_incidence, observed,
            "a max_incidence_deg", ("°",),
        )  # fmt: skip


def _load(cell: Cell, chain: Chain, joints: tuple[str, ...]) -> Iterator[Rule]:
    load = cell.workspace.load
    if load is not None and load.max_angle is not None and load.rope_axis is not None:
        axis = load.rope_axis

        def angle(poses: Poses) -> Array:
            return np.where(poses.loaded, rope_angle(poses, axis), 0.0)[:, None]

        label, key = ("the rope",), "a max_angle_deg"
        yield Bound("rope_angle", angle, 0.0, load.max_angle, label, key, ("°",))
    if cell.workspace.torque_limits:
        bound = np.array(cell.workspace.torque_limits)
        if len(bound) != chain.n_joints:
            raise InputError(
                f"{cell.source}: [workspace] torque_limits_Nm has {len(bound)} values, "
                f"but robot '{chain.name}' has {chain.n_joints} joints"
            )
        torque = StaticTorque(cell, chain)
        yield Bound(
            "torque", lambda p: np.abs(torque(p)), 0.0, bound, joints,
            "a torque_limits_Nm", ("N m",),
        )  # fmt: skip


# All rules at once, and which to relax when next to nothing is feasible.

SAMPLE = 2000  # candidates whose causes are looked at
ON_THE_WAY = 200  # samples of a move, in which bodies that come too close are sought
MOST_TRIED = 300  # random poses in which a pair must once keep apart to be believed


class Feasibility:
    """The rules of a cell for the nominal, rigid arm, in the order of checking; `struck` (m, n):
    poses near which none may be.  Pickles by what it is made of, so that processes can share it."""

    def __init__(self, cell: Cell, chain: Chain, struck: Array | None = None) -> None:
        self.cell, self.chain, self._struck = cell, chain, struck
        self.kinematics = Kinematics(cell, chain)
        self._known: dict[tuple[Any, ...], bool] = {}  # moves, either way
        self.bodies: tuple[Body, ...] = cell_bodies(cell, chain)
        self.pairs: tuple[Pair, ...] = cell_pairs(cell, chain, self.bodies)
        self.rules = rule_book(cell, chain, self.kinematics, self.bodies, self.pairs)
        if struck is not None and len(struck):
            self.rules = (self.rules[0], Struck(struck), *self.rules[1:])

    def __reduce__(self) -> tuple[Any, ...]:
        return Feasibility, (self.cell, self.chain, self._struck)

    def check(self, q: Array, force: Array, every: bool = True) -> PoseFeasibility:
        """Every rule on every pose q (N, n) under a force (3,) or (N, 3) N; not `every`: a pose
        that broke a rule is not looked at again.  The load hangs wherever the force is not zero."""
        poses = self.kinematics.poses(q, force)
        broken = np.zeros((len(poses), len(self.rules)), dtype=bool)
        left = np.arange(len(poses))
        for k, rule in enumerate(self.rules):
            broken[left, k] = hit = rule.broken(poses.take(left))
            left = left if every else left[~hit]
        return PoseFeasibility(tuple(r.name for r in self.rules), broken, poses.q, poses.force)

    def every(self, q: Array, forces: Array) -> PoseFeasibility:
        """Every rule that each pose q (N, n) breaks under any of the `forces` (k, 3)."""
        ranked = forces[np.argsort(np.linalg.norm(forces, axis=1), kind="stable")]
        verdicts = [self.check(q, force) for force in ranked]
        return replace(verdicts[-1], broken=np.any([each.broken for each in verdicts], axis=0))

    def under(self, q: Array, forces: Array) -> PoseFeasibility:
        """The first rule that each pose q (N, n) breaks under the first of `forces` (k, 3) that
        forbids it, the heaviest first; alone where no rule asks how heavy the load is: where it
        hangs everything counts that counts at all."""
        ranked = forces[np.argsort(-np.linalg.norm(forces, axis=1), kind="stable")]
        verdict = self.check(q, ranked[0], every=False)
        for force in ranked[1:] if self.cell.workspace.torque_limits else ():
            left = np.flatnonzero(verdict.ok)
            verdict.broken[left] = self.check(q[left], force, every=False).broken
        return verdict

    @property
    def seen(self) -> Callable[[Array, Array], BoolArray] | None:
        """Joints (N, n), force (3,) → (N, markers): which markers the tracker sees of poses that
        are feasible; None where it sees all of them."""
        rule = next((rule for rule in self.rules if isinstance(rule, EnoughMarkers)), None)
        return None if rule is None else lambda q, force: rule.seen(self.kinematics.poses(q, force))

    def advice(self, verdict: PoseFeasibility) -> str:
        """The smallest set of rules that stops candidates by itself, and of these the one that
        stops most: dropping it frees as many, and no smaller set frees any."""
        tried, feasible = len(verdict.broken), int(verdict.ok.sum())
        text, stopped = f"{feasible} of {tried} candidates are feasible", ~verdict.ok
        if not stopped.any():
            return f"{text}; no rule removes any"
        sets, which, counts = np.unique(
            verdict.broken[stopped], axis=0, return_inverse=True, return_counts=True
        )
        best = np.lexsort((-counts, sets.sum(axis=1)))[0]
        chosen = [rule for rule, used in zip(self.rules, sets[best], strict=True) if used]
        rows = np.flatnonzero(stopped)[which.ravel() == best][:SAMPLE]
        poses = self.kinematics.poses(verdict.q[rows], verdict.force[rows])
        names = " and ".join(f"'{rule.name}'" for rule in chosen)
        text += f"; relax {names}, which {'alone stops' if len(chosen) == 1 else 'stop'} "
        text += f"{counts[best]} of them: " + "; ".join(rule.remedy(poses) for rule in chosen)
        lower, upper = finite_ranges(self.chain, *joint_limits(self.cell, self.chain))
        q = np.random.default_rng(0).uniform(lower, upper, (MOST_TRIED, len(lower)))
        poses = self.kinematics.poses(q, DOWN)
        for pair in self.pairs:
            if Collisions(self.kinematics, [pair]).hits(poses).all():
                a, b = pair.names
                text += (
                    f"; {a} and {b} are too close in every pose, which is probably a wrong size or "
                    f'place: correct it, or add ["{a}", "{b}"] to [workspace] ignored_pairs'
                )
        return text

    def paths_free(self, q_from: Array, q_to: Array, loaded: bool | BoolArray) -> BoolArray:
        """(M,) for moves q_from → q_to (M, n), as `Paths` guarantees it, each checked once however
        often it is asked for; visibility and torque concern poses at rest."""
        start, end = np.broadcast_arrays(*np.atleast_2d(q_from, q_to))
        hangs = np.broadcast_to(loaded, len(start))
        ends = zip(start, end, hangs.tolist(), strict=True)
        moves = [(*sorted((a.tobytes(), b.tobytes())), hung) for a, b, hung in ends]
        new = list({move: k for k, move in enumerate(moves) if move not in self._known}.values())
        if new:
            free = self._paths.free(start[new], end[new], hangs[new])
            self._known.update(zip((moves[k] for k in new), free.tolist(), strict=True))
        return np.array([self._known[move] for move in moves], dtype=bool)

    def blockers(self, q_from: Array, q_to: Array, loaded: bool) -> list[str]:
        """The pairs of bodies that come too close on a way, "link3 and pillar", …, as they are
        met."""
        step = np.linspace(0.0, 1.0, ON_THE_WAY)[:, None]
        poses = self.kinematics.poses(q_from + step * (q_to - q_from), DOWN * loaded)
        hits = hits_by_pair(self.kinematics, self.pairs, poses)
        return sorted((name for name in hits if hits[name].any()), key=lambda n: hits[n].argmax())

    @cached_property
    def _paths(self) -> Paths:
        return Paths(self.kinematics, self.pairs, self.cell.workspace.load)
