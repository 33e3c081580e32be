"""Poses off the pool: a plan polished all at once, and what the continuum could still gain.

    min log Φ(prior + Σ_i B(q_i)ᵀB(q_i))   over q_1 … q_n, their levels, joint limits and margins

by IPOPT (Wächter & Biegler, Math. Program. 106 (2006) 25) with the exact adjoint of B.  Margins and
B are those of simplified rules and deflections, so every end is evaluated exactly, and checked by
the cell's own rules.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice, product
from typing import Any

import casadi as ca
import numpy as np

from elastocal.cell.work_cell import Cell, HalfSpace, Solid
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.symbolic import SymbolicArm, configuration_rows
from elastocal.planning.bodies import HANGING, WORLD, Body, Pair, boxed, data_base, few_points
from elastocal.planning.candidates import CHUNK, JointSpace, sobol
from elastocal.planning.collision import StaticTorque, arm_frames
from elastocal.planning.criteria import TangentBound, inverse
from elastocal.planning.feasibility import POSE_SLACK, Feasibility
from elastocal.planning.information import PoseInformation
from elastocal.planning.relaxation import DesignProblem, block_prices
from elastocal.units import Array, BoolArray, IntArray, Progress

# Conservative stand-ins for `feasibility`, which has the last word: clearances by sphere
# covers, half-spaces, rope angle, static torque, and of the tracker's sight range and incidence
# (whether something stands in the line of sight is left to the final check).  The arm is nominal.
#
# A clearance between two bodies holds if every sphere of a cover of one keeps it to the other:
# conservative, and differentiable where the exact distance of two convex bodies is not.

SMOOTHING = 1e-3  # m over which several distances blend into one
MOST_SPHERES = 6  # spheres along an edge of a box
MOST_ALONG = 12  # and along the axis of a cylinder or capsule
ROUNDING = 1e-4  # m by which edges and corners are rounded off, on the safe side


def margins(cell: Cell, chain: Chain, pairs: Iterable[Pair], forces: Array) -> ca.Function | None:
    """q (n,) → margins (m,), all ≥ 0 where the rules hold under the `forces` (k, 3) N of a pose.

    `pairs` are those of `cell_pairs`.  Margins are in m, those of angles differences of cosines,
    of torques relative.  None where the cell has no rules.
    """
    q = ca.SX.sym("q", chain.n_joints)
    arm = _Frames.of(cell, chain, q)
    loaded = bool(np.any(forces))
    found = [
        *(_clearance(arm, pair) for pair in pairs if loaded or not pair.hangs),
        *(_rope_angle(cell, arm) if loaded else ()),
        *_sight(cell, arm),
        *_torques(cell, chain, q, forces),
    ]
    if not found:
        return None
    return ca.Function("margins", [q], [ca.vertcat(*found)], {"cse": True})


@dataclass(frozen=True)
class _Frames:
    """Frames (4, 4) of everything that carries bodies, in the data's frame."""

    carriers: dict[int, ca.SX]
    flange: ca.SX

    @classmethod
    def of(cls, cell: Cell, chain: Chain, q: ca.SX) -> _Frames:
        frames, flange = arm_frames(chain, data_base(cell), q)
        carriers = {WORLD: ca.SX.eye(4), **dict(enumerate(frames))}
        load_point = rigid.point(flange, rigid.constant(cell.tool.load_point))
        carriers[HANGING] = rigid.transform(translation=load_point)
        return cls(carriers, flange)

    def point(self, body: Body, p: Array) -> ca.SX:
        return rigid.point(self.carriers[body.carrier], rigid.constant(p))

    def seen_from(self, body: Body, p: ca.SX) -> ca.SX:
        T = self.carriers[body.carrier]
        return T[:3, :3].T @ (p - T[:3, 3])


def _clearance(arm: _Frames, pair: Pair) -> ca.SX:
    """Distance less the clearance; of two bodies the one that spheres fit better is covered."""
    a, b = pair.body, pair.other
    if isinstance(b, HalfSpace):
        points, radius = few_points(a.solid)
        normal = rigid.constant(b.normal)
        distances = [ca.dot(normal, arm.point(a, p) - rigid.constant(b.point)) for p in points]
    else:
        if excess(b.solid) < excess(a.solid):
            a, b = b, a
        points, radius = sphere_cover(a.solid)
        distances = [signed_distance(b.solid, arm.seen_from(b, arm.point(a, p))) for p in points]
    return smooth_min(ca.vertcat(*distances), SMOOTHING) - radius - (pair.margin + POSE_SLACK)


def _rope_angle(cell: Cell, arm: _Frames) -> Iterator[ca.SX]:
    load = cell.workspace.load
    if load is not None and load.max_angle is not None and load.rope_axis is not None:
        axis = load.rope_axis / np.linalg.norm(load.rope_axis)
        down = -(arm.flange[2, :3] @ rigid.constant(axis))
        yield down - np.cos(load.max_angle)


def _sight(cell: Cell, arm: _Frames) -> Iterator[ca.SX]:
    rules = cell.workspace.visibility
    if rules is None or rules.min_markers is not None:  # which of them are seen may change
        return
    tracker = rigid.constant(cell.tracker.position)
    for name, marker in cell.tool.markers.items():
        sight = tracker - rigid.point(arm.flange, rigid.constant(marker))
        distance = ca.sqrt(ca.sumsqr(sight) + rigid.TINY)
        near, far = rules.range
        if near > 0:
            yield distance - near
        if np.isfinite(far):
            yield far - distance
        normal = rules.normals.get(name)
        if normal is not None and rules.max_incidence is not None:
            towards = arm.flange[:3, :3] @ rigid.constant(normal / np.linalg.norm(normal))
            yield ca.dot(towards, sight) / distance - np.cos(rules.max_incidence)


def _torques(cell: Cell, chain: Chain, q: ca.SX, forces: Array) -> Iterator[ca.SX]:
    if cell.workspace.torque_limits:
        torque = StaticTorque(cell, chain).symbolic
        for force in forces:
            yield 1 - (torque(q, force) / np.array(cell.workspace.torque_limits)) ** 2


def sphere_cover(solid: Solid) -> tuple[Array, float]:
    """Centres (k, 3) in the carrier's frame and the radius of equal spheres that cover a solid.

    A solid is cut into about cubic cells and a sphere put around each; a capsule's spheres
    stand on its axis, ends included.
    """
    solid = boxed(solid)
    if solid.shape == "sphere":
        centres, radius = np.zeros((1, 3)), float(solid.size[0])
    elif solid.shape == "box":
        counts = [min(int(np.ceil(e / solid.size.min() - 1e-9)), MOST_SPHERES) for e in solid.size]
        centres = np.array(list(product(*(_midpoints(k) for k in counts)))) * solid.size
        radius = float(np.linalg.norm(solid.size / counts)) / 2
    else:
        r, length = (float(s) for s in solid.size)
        count = int(np.clip(np.ceil(length / r), 1, MOST_ALONG))
        along = (
            _midpoints(count) if solid.shape == "cylinder" else np.linspace(-0.5, 0.5, count + 1)
        )
        centres = np.outer(along * length, [0.0, 0.0, 1.0])
        radius = float(np.hypot(r, length / count / 2))
    T = solid.placement
    return centres @ T[:3, :3].T + T[:3, 3], radius


def excess(solid: Solid) -> float:
    """How much too thick the cover of a solid is, in m."""
    inner = boxed(solid)
    thin = inner.size.min() / 2 if inner.shape == "box" else inner.size[0]
    return sphere_cover(solid)[1] - float(thin)


def signed_distance(solid: Solid, point: ca.SX) -> ca.SX:
    """Distance in m of a point (3,) in the carrier's frame from a solid, negative inside.

    Never larger than the true one, smaller by 2 `ROUNDING` at most; a mesh is the box around it.
    Outside |max(p − h, 0)|, inside max(p − h), with h the half extents of a box, or the radius
    and half length of a cylinder; differentiable outside.
    """
    solid = boxed(solid)
    T = np.linalg.inv(solid.placement)
    p = rigid.constant(T[:3, :3]) @ point + rigid.constant(T[:3, 3])
    if solid.shape == "sphere":
        return ca.sqrt(ca.sumsqr(p) + rigid.TINY) - float(solid.size[0])
    if solid.shape == "capsule":
        beyond = ca.fmax(ca.fabs(p[2]) - float(solid.size[1]) / 2, 0)
        return ca.sqrt(ca.sumsqr(p[:2]) + beyond**2 + rigid.TINY) - float(solid.size[0])
    if solid.shape == "box":
        past = ca.fabs(p) - rigid.constant(solid.size / 2)
    else:
        across = ca.sqrt(ca.sumsqr(p[:2]) + ROUNDING**2) - ROUNDING
        past = ca.vertcat(across - float(solid.size[0]), ca.fabs(p[2]) - float(solid.size[1]) / 2)
    outside = ca.sqrt(ca.sumsqr(ca.fmax(past, 0)) + ROUNDING**2) - ROUNDING
    return outside + ca.fmin(ca.mmax(past), 0)


def smooth_min(values: ca.SX, width: float) -> ca.SX:
    """−w log Σ exp(−v/w): at most min v, and below it by no more than w log(number)."""
    least = ca.mmin(values)
    return least - width * ca.log(ca.sum1(ca.exp((least - values) / width)))


def _midpoints(count: int) -> Array:
    return (np.arange(count) + 0.5) / count - 0.5


ORDER = 30.0  # of the power means that stand for a criterion's kinks while IPOPT searches
LEAST_GAIN = 1e-8  # relative improvement of Φ that counts as one
# Shares of the way from a start to where its search ended that are tried, the rules permitting.
STEPS = (1.0, 0.9, 0.7, 0.4, 0.15)
ROUNDS = 2  # of polish: the second with the poses held that the rules stopped on their way
IPOPT_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "no_nlp_grad": True,
    "show_eval_warnings": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-5,
    "ipopt.hessian_approximation": "limited-memory",
    "ipopt.limited_memory_max_history": 12,
    "ipopt.bound_relax_factor": 0.0,
    # Steps that gain next to nothing, several in a row, are the last ones.
    "ipopt.acceptable_tol": 1e2,
    "ipopt.acceptable_constr_viol_tol": 1e-5,
    "ipopt.acceptable_obj_change_tol": 1e-5,
    "ipopt.acceptable_iter": 10,
}
FINE = {"ipopt.acceptable_iter": 0}  # for the last polish, which ends where nothing is gained
POLISHING, CLIMBING = 150, 60  # iterations at most

# Blocks (k, r, p) of k poses → f and ∂f/∂B.
Goal = Callable[[Array], tuple[float, Array]]


@dataclass
class Searches:
    """What searches off the pool need to know of the cell."""

    information: PoseInformation
    space: JointSpace
    checker: Feasibility
    _rows: dict[tuple[int, bytes], tuple[ca.Function, ca.Function]] = field(default_factory=dict)
    _joint: dict[bytes, JointSearch] = field(default_factory=dict)

    def feasible(self, q: Array) -> BoolArray:
        return self.checker.feasible(q, self.information.forces)

    def rows(self, q: Array, level: int, read: BoolArray) -> tuple[ca.Function, ca.Function]:
        """B (q, x) and its adjoint (q, x, W) of poses at a level, as q (n,) is, in the load states
        in which they are `read` (L,)."""
        if (key := (level, read.tobytes())) not in self._rows:
            info = self.information
            arm, table = SymbolicArm(info.model.chain, info.model.cell), info.rows(q[None])
            table = table.take(np.flatnonzero(np.repeat(read, len(table) // len(read))))
            self._rows[key] = configuration_rows(arm, table, info.columns)
        return self._rows[key]

    @cached_property
    def margins(self) -> ca.Function | None:
        info = self.information
        return margins(info.model.cell, info.model.chain, self.checker.pairs, info.forces)

    def joint(self, q: Array, group: IntArray, readings: IntArray) -> JointSearch:
        if (key := group.tobytes() + readings.tobytes()) not in self._joint:
            self._joint[key] = JointSearch(self, q, group, readings)
        return self._joint[key]

    def bounds(self, group: IntArray) -> tuple[Array, Array]:
        found = [self.space.bounds(int(g)) for g in group]
        return np.array([low for low, _ in found]), np.array([high for _, high in found])


class JointSearch:
    """min f(B(q_1) … B(q_k)) inside bounds and margins, over all poses at once, which are read as
    `readings` (k, L) say."""

    def __init__(self, searches: Searches, q: Array, group: IntArray, readings: IntArray) -> None:
        self.searches, self.maps, self.readings = searches, [], readings
        model = searches.information.model
        # B differs where a joint's compliance is split by level, and in other load states.
        split = bool(model.cell.model.compliance_levels)
        kinds = np.column_stack([group if split else 0 * group, readings > 0])
        for kind in np.unique(kinds, axis=0):
            own = np.flatnonzero((kinds == kind).all(axis=1))
            B, adjoint = searches.rows(q[own[0]], int(kind[0]), kind[1:] > 0)
            # Deflections are from the first state, which has no rows of its own.
            read = kind[1:] if model.cell.model.observe != "deflection" else kind[2:]
            each = B.size1_out(0) // np.count_nonzero(read)
            rows = np.flatnonzero(np.repeat(read, each))
            self.maps.append((np.ix_(own, rows), B.map(len(own)), adjoint.map(len(own))))
        flat, self.margins = ca.MX.sym("z", q.size), None
        self.f = _Value(self, q.shape)
        self.problem: dict[str, Any] = {"x": flat, "f": self.f(flat, ca.DM(0, 1))[0]}
        if searches.margins is not None:
            g = ca.vec(searches.margins.map(len(q))(ca.reshape(flat, q.shape[1], len(q))))
            self.margins = ca.Function("g", [flat], [g])
            self.problem["g"] = self.margins(flat)
        self.solvers: dict[tuple[int, bool], ca.Function] = {}
        self.whitener: Array = np.empty(0)
        self.T: Array = np.empty(0)
        self.goal: Goal = lambda B: (0.0, B)

    def end(
        self, goal: Goal, T: Array, q: Array, lower: Array, upper: Array, most: int = POLISHING,
        fine: bool = False,
    ) -> Array:  # fmt: skip
        """Where IPOPT stops from q (k, n); q itself where it fails.

        B is that of the parameters z, y = T z, whitened by the noise at q.  The margins are
        conservative, so a start that the exact rules allow may fall short of one: there it need
        only stay what it is.
        """
        self.goal, self.T = goal, T
        self.whitener = inverse(self.searches.information.noise(q, self.readings)[1])
        if (most, fine) not in self.solvers:
            options = IPOPT_OPTIONS | {"ipopt.max_iter": most, "grad_f": self.f}
            options |= FINE if fine else {}
            self.solvers[most, fine] = ca.nlpsol("polish", "ipopt", self.problem, options)
        bounds: dict[str, Any] = {"lbx": lower.ravel(), "ubx": upper.ravel()}
        if self.margins is not None:
            bounds |= {"lbg": np.minimum(self.margins(q.ravel()).full(), 0.0), "ubg": np.inf}
        # A goal that cannot be evaluated (no equilibrium, singular information) ends a search.
        with contextlib.suppress(RuntimeError):
            end = self.solvers[most, fine](x0=q.ravel(), **bounds)["x"].full().reshape(q.shape)
            if np.isfinite(end).all():
                return np.clip(end, lower, upper)
        return q

    def blocks(self, q: Array) -> Array:
        """Blocks (k, r, p) of poses q (k, n), by the symbolic model."""
        info = self.searches.information
        found = np.zeros((*self.whitener.shape[:2], len(info.columns)))
        for at, B, _ in self.maps:
            own = at[0].ravel()
            raw = B(q[own].T, np.tile(info.x[:, None], len(own))).full()
            found[at] = raw.reshape(len(raw), len(own), -1).swapaxes(0, 1)
        return np.asarray(self.whitener @ found * info.sizes @ self.T)

    def slope(self, q: Array, W: Array) -> Array:
        """∂/∂q (k, n) of ⟨W, blocks(q)⟩, W (k, r, p)."""
        info, total = self.searches.information, np.zeros_like(q)
        raw = self.whitener.swapaxes(-1, -2) @ W @ self.T.T * info.sizes
        for at, _, adjoint in self.maps:
            own, weights = at[0].ravel(), raw[at].swapaxes(0, 1).reshape(at[1].size, -1)
            total[own] = adjoint(q[own].T, np.tile(info.x[:, None], len(own)), weights).full().T
        return total


class _Value(ca.Callback):
    """f(B(q)) and ∂f/∂q for CasADi: evaluated by numpy, so that any criterion serves."""

    def __init__(self, search: JointSearch, shape: tuple[int, ...]) -> None:
        ca.Callback.__init__(self)
        self.search, self.shape, self.n = search, shape, int(np.prod(shape))
        self.construct("f", {})

    def get_n_in(self) -> int:
        return 2  # q, and the parameters that a problem of CasADi has

    def get_n_out(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(0 if i else self.n, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.n if i else 1, 1)

    def eval(self, given: Sequence[ca.DM]) -> list:
        q = given[0].full().reshape(self.shape)
        value, W = self.search.goal(self.search.blocks(q))
        return [value, self.search.slope(q, W).ravel()]


# All poses of a plan at once.


def polish(
    problem: DesignProblem,
    searches: Searches,
    T: Array,
    q: Array,
    group: IntArray,
    readings: IntArray,
    fine: bool = False,
) -> Array:
    """The plan's poses (k, n), read as `readings` (k, L), moved to a local optimum of Φ; q itself
    where none is better.

    `problem` is that of the parameters z, y = T z.  No rule is broken that the poses q keep.
    `fine`: until nothing is gained any more.
    """
    criterion = problem.criterion
    smooth = criterion.softened(ORDER)

    def goal(B: Array) -> tuple[float, Array]:
        V = covariance_of(B)
        phi, C = smooth.slope(V)
        return float(np.log(phi)), -2 / phi * B @ (V @ C @ V)

    def covariance_of(B: Array) -> Array:
        B = B.reshape(-1, B.shape[-1])
        return inverse(problem.prior + B.T @ B)

    def value(B: Array) -> float:
        return float(criterion.value(covariance_of(B)))

    lower, upper = searches.bounds(group)
    search, B = searches.joint(q, group, readings), searches.information.blocks(q, readings) @ T
    phi = value(B)
    for _ in range(ROUNDS):
        end = search.end(goal, T, q, lower, upper, fine=fine)
        part = _allowed(searches, q, end)
        z = q + part[:, None] * (end - q)
        moved = searches.information.blocks(z, readings) @ T
        found = value(moved)
        if found >= phi * (1 - LEAST_GAIN):
            return _one_by_one(q, B, z, moved, value)
        q, B, phi = z, moved, found
        held = part < 1
        if not held.any():
            break
        lower, upper = (np.where(held[:, None], q, bound) for bound in (lower, upper))
    return q


def _allowed(searches: Searches, q: Array, end: Array) -> Array:
    left = np.flatnonzero((q != end).any(axis=1))
    part = np.ones(len(q))
    part[left] = 0.0
    for step in STEPS:
        if not len(left):
            break
        ok = searches.feasible(q[left] + step * (end[left] - q[left]))
        part[left[ok]] = step
        left = left[~ok]
    return part


def _one_by_one(
    q: Array, B: Array, z: Array, moved: Array, value: Callable[[Array], float]
) -> Array:
    q, B, phi = q.copy(), B.copy(), value(B)
    for k in range(len(q)):
        was = B[k].copy()
        B[k] = moved[k]
        found = value(B)
        if found < phi * (1 - LEAST_GAIN):
            q[k], phi = z[k], found
        else:
            B[k] = was
    return q


# How much better a plan could be with poses that are not in the pool: an estimate.
#
# On the continuum of feasible poses the tangent at (Φ, G) bounds every plan's value by
#
#     Φ(plan) ≥ Φ² / (⟨G, prior⟩ + Σ_l n_l max_{q∈l} d(q)),   d(q) = tr(B(q) G B(q)ᵀ)
#
# as in `relaxation`, without its box, since one continuous pose may repeat.  d has many local
# maxima and rules cut the space up, so the global one is sought, not proved: new Sobol points,
# then local ascents from the best of them and of the pool.

POINTS = 4096  # new poses per group
STARTS = 6  # ascents per group
LOT, LOTS = 256, 16  # of the best new points that are checked for feasibility at a time, at most
APART = 0.2  # rad or m between starts in at least one joint
EXCESS = 1e-6  # over the pool's largest d, relative, that counts as one


@dataclass(frozen=True)
class Continuum:
    """`bound` on Φ from the largest d found on the continuum: an estimate from above, as a larger d
    may have been missed, and then no plan is held to it.

    `q` (k, n), `group` (k,), `readings` (k, L): feasible poses found, and how they are read, whose
    d exceeds all of the pool's; they belong in the pool.  Effort: `searched` new points and
    `ascents` local searches.
    """

    bound: float
    q: Array
    group: IntArray
    readings: IntArray
    searched: int
    ascents: int


def estimate(
    problem: DesignProblem,
    tangent: TangentBound,
    searches: Searches,
    T: Array,
    q: Array,
    readings: IntArray,
    *,
    ways: IntArray,
    seed: int = 0,
    progress: Progress = lambda message: None,
) -> Continuum:
    """The largest d on the continuum per group, for the tangent (Φ, G) of the pool's optimum.

    `q` (N, n), `readings` (N, L): the problem's candidates, of the parameters z, y = T z; poses may
    be read in `ways` (K, L).  Every maximum is evaluated exactly and passed by the cell's rules.
    """
    d = problem.prices(tangent.G)

    def price(q: Array, read: IntArray) -> Array:
        lots = [slice(k, k + CHUNK) for k in range(0, len(q), CHUNK)]
        found = (searches.information.blocks(q[lot], read[lot]) for lot in lots)
        return np.concatenate([block_prices(B @ T, tangent.G) for B in found])

    def goal(B: Array) -> tuple[float, Array]:
        """Uphill in d(q), of each pose in its own unit."""
        priced = B @ tangent.G / unit[:, None, None]
        return -float((priced * B).sum()), -2 * priced

    streams = np.random.SeedSequence(seed).spawn(len(problem.shares))
    levels, starts, found = np.flatnonzero(problem.shares).tolist(), [], []
    for group in levels:
        progress(f"searching the continuum, level {group + 1} of {len(problem.shares)}")
        new = np.concatenate([*islice(sobol(searches.space, group, streams[group]),
                                      -(-POINTS // CHUNK))])  # fmt: skip
        worth = np.stack([price(new, np.tile(way, (len(new), 1))) for way in ways])
        best = _best_feasible(searches, new, worth.max(axis=0))
        drawn, of, read = new[best], worth.max(axis=0)[best], ways[worth.argmax(axis=0)[best]]
        own = np.flatnonzero(problem.group == group)
        both, first = np.vstack([drawn, q[own]]), np.append(of, d[own])
        order = np.argsort(-first, kind="stable")
        kept = order[distinct(both[order], STARTS)]
        both_read = np.vstack([read, readings[own]])[kept]
        starts.append((both[kept], first[kept], np.full(len(kept), group), both_read))
        found.append((drawn, of, np.full(len(drawn), group), read))
    begun, unit, at_group, begun_read = (np.concatenate(part) for part in zip(*starts, strict=True))
    lower, upper = searches.bounds(at_group)
    search = searches.joint(begun, at_group, begun_read)
    ends = search.end(goal, T, begun, lower, upper, CLIMBING)
    tried = np.concatenate([begun + step * (ends - begun) for step in STEPS])
    of_start = np.tile(np.arange(len(begun)), len(STEPS))
    height = price(tried, begun_read[of_start])
    rose = np.flatnonzero(height > unit[of_start])
    rose = rose[searches.feasible(tried[rose])]
    of_start = of_start[rose]
    found.insert(0, (tried[rose], height[rose], at_group[of_start], begun_read[of_start]))
    poses, values, groups, reads = (np.concatenate(part) for part in zip(*found, strict=True))
    largest, top_poses = np.zeros(len(problem.shares)), []
    for group in levels:
        top = d[problem.group == group].max()
        own = np.flatnonzero((groups == group) & (values > top * (1 + EXCESS)))
        own = own[np.argsort(-values[own], kind="stable")]
        top_poses.append(own[distinct(poses[own], len(own))])
        largest[group] = max(top, values[own].max(initial=0.0))
    reach = float(np.sum(tangent.G * problem.prior)) + float(problem.shares @ largest)
    at = np.concatenate(top_poses)
    searched = len(levels) * CHUNK * -(-POINTS // CHUNK)
    bound = tangent.value**2 / reach
    return Continuum(bound, poses[at], groups[at], reads[at], searched, len(begun))


def _best_feasible(searches: Searches, q: Array, d: Array) -> IntArray:
    order, so_far = np.argsort(-d, kind="stable"), np.zeros(0, dtype=np.int64)
    for lot in range(LOTS):
        part = order[lot * LOT : (lot + 1) * LOT]
        so_far = np.append(so_far, part[searches.feasible(q[part])])
        if len(distinct(q[so_far], STARTS)) == STARTS:
            break
    return so_far


def distinct(q: Array, count: int) -> IntArray:
    """Indices of the first `count` poses of q (N, n) that lie `APART` from those before."""
    chosen: list[int] = []
    for i, pose in enumerate(q):
        if len(chosen) == count:
            break
        if all(np.abs(pose - q[k]).max() > APART for k in chosen):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)
