"""May the arm stand there, and may it go there?  All rules of the cell in one place."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csgraph

from elastocal.cell import Cell
from elastocal.cell_tables import Motion
from elastocal.messages import InputError, InsufficientDataError, require, rounded, some
from elastocal.model.chain import Chain, finite_ranges, joint_limits, told
from elastocal.model.effects.catalogue import SymbolicArm
from elastocal.model.effects.statics import GravityCompensator
from elastocal.model.evaluate import BatchFunction
from elastocal.planning.collision import (
    DOWN,
    RULES,
    Body,
    Collisions,
    Kinematics,
    Pair,
    Paths,
    Poses,
    Sight,
    cell_bodies,
    cell_pairs,
    marker_positions,
    rope_angle,
)
from elastocal.units import Array, BoolArray, IntArray

SAME = 1e-9  # rounding of a joint value that was set to its limit
SHOWN = 3  # causes or poses that a remedy names
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
    """Its causes: a joint, a marker, a pair of bodies → (N,)."""

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
    """lower ≤ quantity ≤ upper.  `quantity` gives (N, m), `lower` and `upper` are (m,) or one for
    all, as `units`, which messages show it in: "°" for quantities in rad.  `labels` (m) name the
    columns, `key` is what the user calls the limit."""

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


@dataclass(frozen=True)
class Struck(Rule):
    """Not near one of the poses (m, n) that the user has struck out."""

    struck: Array
    name = "struck"

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        off = [np.abs(poses.q - q).max(axis=1) for q in self.struck]
        return {"a pose struck out": np.asarray(np.min(off, axis=0) < NEARBY)}


# A pose keeps every margin by this much more, so that a move that ends there can be certified.
POSE_SLACK = 1e-4  # m


def hits_by_pair(
    kinematics: Kinematics, pairs: Sequence[Pair], poses: Poses, extra: float = 0.0
) -> dict[str, BoolArray]:
    return {
        " and ".join(pair.names): Collisions(kinematics, [pair]).hits(poses, extra)
        for pair in pairs
    }


class KeepApart(Rule):
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
        """(N, markers); nothing is looked for behind bodies where too few remain without."""
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


def static_torque(cell: Cell, chain: Chain) -> Callable[[Poses], Array]:
    """τ = ∂V/∂q (N, n) in N m (N for a prismatic joint): what the joints bear at rest, V the
    potential of force, link weights and gravity compensator at the rigid pose and nominal
    values."""
    kept = tuple(e for e in cell.model.effects if e.name == GravityCompensator.name)
    model = replace(cell.model, effects=kept, observe="position")
    tool = replace(cell.tool, markers={"tool": np.zeros(3)})
    symbolic = SymbolicArm(chain, replace(cell, tool=tool, model=model))
    arm, nominal = symbolic.arm, ca.DM([p.nominal for p in symbolic.parameters])
    torque = ca.gradient(arm.potential, arm.q_commanded)
    torque = ca.substitute(torque, symbolic.p, nominal)
    compiled = BatchFunction([arm.inputs["q"], arm.inputs["force"]], [torque])
    return lambda poses: compiled(poses.q, poses.force)[0][..., 0]


@dataclass(frozen=True)
class CandidateCounts:
    tried: int
    feasible: int
    removed_by: dict[str, int]


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
    def counts(self) -> CandidateCounts:
        """Each by the first rule that it breaks: tried = feasible + Σ removed_by."""
        first = (self.broken & (self.broken.cumsum(axis=1) == 1)).sum(axis=0)
        removed_by = dict(zip(self.rules, first.tolist(), strict=True))
        return CandidateCounts(len(self.q), int(self.ok.sum()), removed_by)


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
    return (
        Bound("joint_limits", lambda p: p.q, *joint_limits(cell, chain), joints, "a limit", units),
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
    markers = cell.tool.markers
    require(
        bool(markers),
        f"{cell.source}: [workspace.visibility] needs the markers; give [tool.markers_m]",
    )
    near, far = sight.range

    def to_eye(poses: Poses, names: Sequence[str]) -> Array:
        return eye - marker_positions(poses, [markers[name] for name in names])

    def distance(poses: Poses) -> Array:
        return np.asarray(np.linalg.norm(to_eye(poses, tuple(markers)), axis=2))

    if near > 0 or np.isfinite(far):
        yield Bound("range", distance, near, far, tuple(markers), "a range_m", ("m",))
    observed = tuple(name for name in markers if name in sight.normals)

    def incidence(poses: Poses) -> Array:
        line, normals = to_eye(poses, observed), np.array([sight.normals[n] for n in observed])
        axes = np.einsum("nij,mj->nmi", poses.flange[:, :3, :3], normals)
        across = np.linalg.norm(np.cross(axes, line), axis=2)
        return np.asarray(np.arctan2(across, np.einsum("nmi,nmi->nm", axes, line)))

    if (most := sight.max_incidence) is not None and observed:
        yield Bound("incidence", incidence, 0.0, most, observed, "a max_incidence_deg", ("°",))


def _load(cell: Cell, chain: Chain, joints: tuple[str, ...]) -> Iterator[Rule]:
    load = cell.workspace.load
    if load is not None and load.max_angle is not None:
        yield Bound(
            "rope_angle", lambda p: rope_angle(p, load)[:, None], 0.0, load.max_angle,
            ("the rope",), "a max_angle_deg", ("°",),
        )  # fmt: skip
    if bound := cell.workspace.torque_limits:
        require(
            len(bound) == chain.n_joints,
            f"{cell.source}: [workspace] torque_limits_Nm has {len(bound)} values, "
            f"but robot '{chain.name}' has {chain.n_joints} joints",
        )
        torque = static_torque(cell, chain)
        yield Bound(
            "torque", lambda p: np.abs(torque(p)), 0.0, np.array(bound), joints,
            "a torque_limits_Nm", ("N m",),
        )  # fmt: skip


# All rules at once, and which to relax when next to nothing is feasible.

SAMPLE = 2000  # candidates whose causes are looked at
ON_THE_WAY = 200  # samples of a move, in which bodies that come too close are sought
MOST_TRIED = 300  # random poses in which a pair must once keep apart to be believed


class Feasibility:
    """The rules of a cell for the nominal, rigid arm; `struck` (m, n): poses near which none may
    be.  Pickles by what it is made of, so that processes can share it."""

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
        """q (N, n) under a force (3,) or (N, 3) N, the load hanging wherever that is not zero; not
        `every`: a pose that broke a rule is not looked at again."""
        poses = self.kinematics.poses(q, force)
        broken = np.zeros((len(poses), len(self.rules)), dtype=bool)
        left = np.arange(len(poses))
        for k, rule in enumerate(self.rules):
            broken[left, k] = hit = rule.broken(poses.take(left))
            left = left if every else left[~hit]
        return PoseFeasibility(tuple(r.name for r in self.rules), broken, poses.q, poses.force)

    def every(self, q: Array, forces: Array) -> PoseFeasibility:
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
        """Joints (N, n), force (3,) → (N, markers) of poses that are feasible; None where the
        tracker sees all of them."""
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
        """The pairs of bodies that come too close on a way, as they are met."""
        step = np.linspace(0.0, 1.0, ON_THE_WAY)[:, None]
        poses = self.kinematics.poses(q_from + step * (q_to - q_from), DOWN * loaded)
        hits = hits_by_pair(self.kinematics, self.pairs, poses)
        return sorted((name for name in hits if hits[name].any()), key=lambda n: hits[n].argmax())

    @cached_property
    def _paths(self) -> Paths:
        return Paths(self.kinematics, self.pairs, self.cell.workspace.load)


# Which joint moves are free: a graph over joint vectors whose edges are checked when needed.

# Added to every edge, relative to the longest one: of equally long ways the one with fewer stops.
PER_EDGE = 1e-9
AT_ONCE = 64  # moves take hardly longer than one


def travel_times(points: Array, speed: Array | None) -> Array:
    """Times (m, m) in s of synchronised joint moves between `points` (m, n):
    t_ij = max_k |q_ik − q_jk| / v_k with `speed` v (n,) in rad/s or m/s, 1 where it is None."""
    q = points if speed is None else points / speed
    return np.asarray(np.abs(q[:, None] - q[None]).max(axis=2))


class Roadmap:
    """Joint vectors `points` (m, n) and the straight moves between them, with or without load.  A
    move counts as free until it is checked; a blocked one is replaced by the fastest way through
    other points.  So costs never exceed the true ones (Bohlin and Kavraki 2000)."""

    def __init__(
        self, points: Array, speed: Array | None, loaded: bool, checker: Feasibility
    ) -> None:
        self.points, self.loaded, self.checker = points, loaded, checker
        self.carrying = " with the load" if loaded else ""
        self.times = travel_times(points, speed)
        self.direct = self.times.copy()  # inf where blocked
        self.checked = np.eye(len(points), dtype=bool)

    def check(self, moves: Iterable[Sequence[int]]) -> bool:
        """All free?  Each move is checked once, those not checked before together."""
        pairs = sorted({(min(move), max(move)) for move in moves})
        new = [pair for pair in pairs if not self.checked[pair]]
        if new:
            i, j = np.array(new).T
            free = self.checker.paths_free(self.points[i], self.points[j], self.loaded)
            self.checked[i, j] = self.checked[j, i] = True
            i, j = i[~free], j[~free]
            self.direct[i, j] = self.direct[j, i] = np.inf
            vars(self).pop("_shortest", None)
        return all(np.isfinite(self.direct[pair]) for pair in pairs)

    def costs(self) -> Array:
        """Times (m, m) between points: straight, or by the fastest way around; inf for none."""
        return np.where(np.isfinite(self.direct), self.direct, self._shortest[0])

    def way(self, i: int, j: int) -> list[int]:
        """Points passed on the fastest way from i to j, j included, i not."""
        if i == j:
            return []
        if np.isfinite(self.direct[i, j]):
            return [j]
        before, way = self._shortest[1][i], [j]
        while before[way[-1]] != i:
            way.append(int(before[way[-1]]))
        return way[::-1]

    def settle(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Check the fastest ways between these pairs of points until what is fastest is free."""
        left = list(pairs)
        while left:
            times = self.costs()
            ways = [[i, *self.way(i, j)] for i, j in left if np.isfinite(times[i, j])]
            self.check(move for way in ways for move in pairwise(way))
            left = [(w[0], w[-1]) for w in ways if np.isinf(self.direct[w[:-1], w[1:]]).any()]

    @property
    def _graph(self) -> Array:
        finite = self.direct[np.isfinite(self.direct)]
        return self.direct + max(PER_EDGE * float(finite.max()), np.finfo(float).tiny)

    @cached_property
    def _shortest(self) -> tuple[Array, NDArray[np.integer]]:
        return csgraph.shortest_path(self._graph, method="FW", return_predecessors=True)

    def parts(self, needed: list[int]) -> list[list[int]]:
        """`needed` points by what free moves connect, the largest part first.  Few more moves are
        checked than it takes: those of the shortest trees among `needed`, then through all points,
        and while some are blocked the shortest from all parts but the largest, ever more at a time:
        where nothing joins it to the others all of them are blocked."""
        n, others = len(needed), np.setdiff1d(range(len(self.points)), needed)
        for among in (np.array(needed), np.append(needed, others)):
            own, at_once = np.ix_(among, among), AT_ONCE
            while True:
                tree = csgraph.minimum_spanning_tree(self._graph[own])
                free = self.check(among[np.transpose(tree.nonzero())].tolist())
                known = self.checked[own] & np.isfinite(self.direct[own])
                part = csgraph.connected_components(known, False)[1]
                small = np.setdiff1d(part[:n], np.bincount(part[:n]).argmax())
                new = np.isin(part, small)[:, None] & (part[:, None] != part) & ~self.checked[own]
                if free or not new.any():
                    break
                nearest = np.argsort(self.times[own][new], kind="stable")[:at_once]
                self.check(among[np.transpose(new.nonzero())[nearest]].tolist())
                at_once *= 2
            found = [np.array(needed)[part[:n] == k].tolist() for k in dict.fromkeys(part[:n])]
            if len(found) == 1:
                break
        return sorted(found, key=len, reverse=True)

    def name(self, point: int, home: int | None) -> str:
        chain = self.checker.chain
        joints = ", ".join(told(chain, j, value) for j, value in enumerate(self.points[point]))
        return f"{'home' if point == home else f'pose {point + (home is None)}'} (joints {joints})"

    def in_the_way(self, i: int, j: int) -> str:
        names = self.checker.blockers(self.points[i], self.points[j], self.loaded)
        return f" (in the way: {', '.join(names)})" if names else ""


class Unreachable(InsufficientDataError):
    """No move reaches some poses of a plan, `poses`, from home or from most others."""

    def __init__(self, message: str, *poses: int) -> None:
        super().__init__(message)
        self.poses = np.array(poses, dtype=int)


@dataclass(frozen=True)
class Moves:
    """Home, poses, points of approach and via points in one list, `points` (m, n), the roadmaps
    `maps` between them without and with load, and V visits among them: of `pose` (V,) in the load
    state `load` (V,), left from `leave` (V,), where the pose is.  `sides` (V, 2) are the points
    from which it is approached, with `signs` (N, 2, n), and which of them are `free` (V, 2);
    without approaches the pose itself."""

    points: Array
    maps: tuple[Roadmap, ...]
    loaded: BoolArray
    home: int | None
    signs: IntArray | None
    pose: IntArray
    load: IntArray
    leave: IntArray
    sides: IntArray
    free: BoolArray

    @classmethod
    def of(
        cls, q: Array, motion: Motion, checker: Feasibility, forces: Array,
        limits: tuple[Array, Array] | None, via: Array | None, read: BoolArray | None = None,
    ) -> Moves:  # fmt: skip
        n_poses, n = q.shape
        read = np.ones((n_poses, len(forces)), dtype=bool) if read is None else read
        pose, load = np.nonzero(read)
        home = None if motion.home is None else 0
        start = np.zeros((0, n)) if motion.home is None else motion.home[None]
        leave = len(start) + pose
        between, signs, sides = np.zeros((0, n)), None, leave[:, None]
        if motion.both_directions:
            assert limits is not None
            signs = approach_signs(checker.chain, q, *limits, motion.overshoot)
            between = (q[:, None] - signs * motion.overshoot).reshape(-1, n)
            sides = len(start) + n_poses + 2 * pose[:, None] + np.arange(2)
        points = np.vstack([start, q, between, np.zeros((0, n)) if via is None else via])
        maps = tuple(Roadmap(points, motion.speed, loaded, checker) for loaded in (False, True))
        loaded, free = (forces != 0).any(axis=1), np.ones(sides.shape, dtype=bool)
        for roadmap in maps if signs is not None else ():
            own = loaded[load] == roadmap.loaded
            ends = np.broadcast_to(leave[own, None], sides[own].shape)
            roadmap.check(zip(sides[own].ravel().tolist(), ends.ravel().tolist(), strict=True))
            free[own] = np.isfinite(roadmap.direct[sides[own], ends])
        return cls(points, maps, loaded, home, signs, pose, load, leave, sides, free)

    @cached_property
    def side(self) -> IntArray:
        """(V,): the side from which a visit begins; then comes the other, where that is free."""
        return np.asarray(self.free.argmax(axis=1))

    @cached_property
    def entry(self) -> IntArray:
        return np.asarray(self.sides[np.arange(len(self.pose)), self.side])

    @cached_property
    def inside(self) -> Array:
        """(V,) s from there on: the approach, and to the other side and back; inf where blocked."""
        to = self.maps[0].times[self.leave[:, None], self.sides]
        first = to[np.arange(len(to)), self.side]
        both = np.where(self.free.all(axis=1), 2 * to[:, -1], 0.0) if self.signs is not None else 0
        return np.where(self.free.any(axis=1), first + both, np.inf)

    @property
    def checked(self) -> int:
        return sum(int(np.triu(roadmap.checked, 1).sum()) for roadmap in self.maps)

    @property
    def blocked(self) -> int:
        return sum(int(np.isinf(np.triu(roadmap.direct)).sum()) for roadmap in self.maps)

    def carries(self, node: int) -> int:
        """The load state on the arm at a node of a tour, −1 for none; node 0 is without."""
        state = -1 if node == 0 else int(self.load[node - 1])
        return state if state >= 0 and self.loaded[state] else -1

    def unloaded_twice(self, tour: list[int]) -> tuple[Moves, list[int]]:
        """With another visit of each pose that is read without load, and these nodes, in the
        reverse order of the tour; none where nothing is read under load."""
        if not self.loaded[self.load].any():
            return self, []
        again = np.array([v - 1 for v in tour[::-1] if not self.loaded[self.load[v - 1]]], int)
        own = {n: getattr(self, n) for n in ("pose", "load", "leave", "sides", "free")}
        more: dict[str, Any] = {n: np.concatenate([of, of[again]]) for n, of in own.items()}
        return replace(self, **more), (len(self.pose) + 1 + np.arange(len(again))).tolist()

    def travel(self) -> Array:
        """Times (V + 1, V + 1) from one visit through the next one as known so far, node 0 being
        the beginning and the end; what cannot be reached takes more than everything else together.
        The arm begins and ends without load, at home or, without one, anywhere."""
        n, home = len(self.pose), self.home
        # The load is on the arm during a move only if it is before and after: it is hung and taken
        # off where the arm stands for a loaded reading.
        carries = np.append(False, self.loaded[self.load])
        with_load = carries[:, None] & carries[None, :]
        plain, loaded = (roadmap.costs() for roadmap in self.maps)
        found = np.zeros((n + 1, n + 1))
        ways = np.ix_(self.leave, self.entry)
        found[1:, 1:] = np.where(with_load[1:, 1:], loaded[ways], plain[ways])
        if home is not None:
            found[0, 1:], found[1:, 0] = plain[home, self.entry], plain[self.leave, home]
        found[:, 1:] += self.inside
        np.fill_diagonal(found, 0.0)
        finite = np.isfinite(found)
        # Any tour travels less than this in all, if it needs no unreachable move.
        found[~finite] = max(float(found[finite].max()) * (n + 1), 1.0)
        return found

    def way(self, u: int, v: int) -> tuple[Roadmap, list[int]]:
        """From node u to the entry of node v, both included, as far as beginning and end are
        anywhere; the ends alone where no way is known."""
        roadmap = self.maps[int(self.carries(u) >= 0 and self.carries(v) >= 0)]
        goal = self.home if v == 0 else int(self.entry[v - 1])
        start = self.home if u == 0 else int(self.leave[u - 1])
        if goal is None:
            return roadmap, []
        return roadmap, [goal] if start is None else [start, *roadmap.way(start, goal)]

    def check(self, tour: list[int]) -> bool:
        """Check every straight move of the tour not yet checked; is one of them news, blocked?"""
        wanted: list[list[tuple[int, int]]] = [[], []]
        for u, v in pairwise([0, *tour, 0]):
            roadmap, way = self.way(u, v)
            # Where no way is left, every move has been checked: nothing to be learnt.
            wanted[roadmap.loaded] += [m for m in pairwise(way) if np.isfinite(roadmap.direct[m])]
        return not all([roadmap.check(wanted[roadmap.loaded]) for roadmap in self.maps])

    def settle(self) -> None:
        """Check the ways between all visits: many at once take a quarter of the CPU of a few again
        and again (experiment_design/kr270_plan/crowded.toml)."""
        for roadmap in self.maps:
            here = self.loaded[self.load] | (not roadmap.loaded)
            home = [] if self.home is None or roadmap.loaded else [self.home]
            ends = home + self.entry[here & np.isfinite(self.inside)].tolist()
            starts = home + self.leave[here].tolist()
            pairs = {(min(m), max(m)) for m in product(starts, ends) if m[0] != m[1]}
            roadmap.settle(sorted(pairs))

    # What no move reaches is Unreachable, with what is in the way where the checker can tell.

    def check_reach(self) -> None:
        """Can each pose be approached from one side at least, where it has to be, and does a chain
        of free moves join it to the others under load, and without, where it is hung and taken off,
        to all (and home)?"""
        for roadmap in self.maps:
            here = self.loaded[self.load] == roadmap.loaded
            for v in np.flatnonzero(here & ~self.free.any(axis=1)):
                pose, (below, above) = int(self.leave[v]), self.sides[v].tolist()
                raise Unreachable(
                    f"{roadmap.name(pose, self.home)} cannot be approached{roadmap.carrying}, "
                    f"neither from below{roadmap.in_the_way(below, pose)} nor from above"
                    f"{roadmap.in_the_way(above, pose)}; lower overshoot_deg in "
                    "[design.motion], or raise clearance_mm in [workspace]",
                    self.pose[v],
                )
            here |= not roadmap.loaded
            needed = [int(point) for point in dict.fromkeys(self.leave[here])]
            if self.home is not None and not roadmap.loaded:
                needed.insert(0, self.home)
            if len(needed) < 2:
                continue
            parts = roadmap.parts(needed)
            stay = next((part for part in parts if self.home in part), parts[0])
            if len(parts) > 1:
                raise self._unreachable(roadmap, stay, np.setdiff1d(needed, stay).tolist())

    def _unreachable(self, roadmap: Roadmap, stay: list[int], away: list[int]) -> Unreachable:
        lost = stay if stay == [self.home] else away
        named = some((roadmap.name(point, self.home) for point in lost), SHOWN)
        others = np.setdiff1d(np.arange(len(self.points)), lost)
        between = roadmap.times[lost][:, others]
        i, j = np.unravel_index(int(np.argmin(between)), between.shape)
        by = roadmap.in_the_way(int(others[j]), lost[int(i)])
        return Unreachable(
            f"{named} cannot be reached{roadmap.carrying} by collision-free joint moves, "
            f"neither directly nor through home and other poses{by}; give another home in "
            "[design.motion], free the way, or narrow [limits] to exclude such poses",
            *np.unique(self.pose[np.isin(self.leave, away)]),
        )


def approach_signs(chain: Chain, q: Array, lower: Array, upper: Array, by: float) -> IntArray:
    """Directions (N, 2, n) of the last motion of each joint, from q − sign · `by`: first upwards
    (+1), then down (−1), so that backlash and hysteresis show; both from the same side where the
    other is beyond the limits."""
    below, above = q - by >= lower, q + by <= upper
    for i, j in np.argwhere(~(below | above)).tolist():
        raise InputError(
            f"pose {i + 1}: joint {j + 1} has no room on either side of {told(chain, j, q[i, j])} "
            f"for an overshoot of {told(chain, j, by)}; lower overshoot_deg in "
            "[design.motion], or widen its limits"
        )
    return np.stack([np.where(below, 1, -1), np.where(above, -1, 1)], axis=1)
