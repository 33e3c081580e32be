"""Polish: poses of a plan moved off the pool, and what poses beyond the pool could still gain."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, product
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell.work_cell import Cell
from elastocal.cell.workspace_rules import HalfSpace, Solid
from elastocal.errors import require
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.model.symbolic import SymbolicArm, configuration_rows
from elastocal.planning.bodies import HANGING, WORLD, Body, Pair, data_base, few_points, mesh_hull
from elastocal.planning.candidates import CHUNK, JointSpace, feasible, sobol
from elastocal.planning.collision import arm_frames
from elastocal.planning.criterion import Criterion, Gradient
from elastocal.planning.feasibility import POSE_SLACK, Feasibility
from elastocal.planning.information import PoseInformation
from elastocal.planning.selection import DesignProblem
from elastocal.units import Array, IntArray, Progress

# Polish: poses of a plan moved off the pool within joint limits and clearances.

# How far a pose is from breaking the cell's rules, as smooth expressions of its joints.
#
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
        *_torques(cell, chain, arm, q, forces),
    ]
    if not found:
        return None
    return ca.Function("margins", [q], [ca.vertcat(*found)], {"cse": True})


@dataclass(frozen=True)
class _Frames:
    """Frames (4, 4) of everything that carries bodies, in the data's frame."""

    carriers: dict[int, ca.SX]
    flange: ca.SX
    load_point: ca.SX

    @classmethod
    def of(cls, cell: Cell, chain: Chain, q: ca.SX) -> _Frames:
        frames, flange = arm_frames(chain, data_base(cell), q)
        carriers = {WORLD: ca.SX.eye(4), **dict(enumerate(frames))}
        load_point = rigid.point(flange, rigid.constant(cell.tool.load_point))
        carriers[HANGING] = rigid.transform(translation=load_point)
        return cls(carriers, flange, load_point)

    def point(self, body: Body, p: Array) -> ca.SX:
        """A point (3,) of the carrier's frame in the data's frame."""
        return rigid.point(self.carriers[body.carrier], rigid.constant(p))

    def seen_from(self, body: Body, p: ca.SX) -> ca.SX:
        """A point (3,) of the data's frame in the carrier's."""
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


def _torques(cell: Cell, chain: Chain, arm: _Frames, q: ca.SX, forces: Array) -> Iterator[ca.SX]:
    """1 − (τ/limit)² with τ = −∂V/∂q, V the potential of the load and, where known, the links."""
    limits = np.array(cell.workspace.torque_limits)
    if not len(limits):
        return
    weights = ca.SX(0)
    for i, body in enumerate(chain.masses if cell.model.link_gravity else ()):
        height = rigid.point(arm.carriers[i], rigid.constant(body.com))[2]
        weights += body.mass * STANDARD_GRAVITY * height
    for force in forces:
        potential = weights - ca.dot(rigid.constant(force), arm.load_point)
        yield 1 - (ca.gradient(potential, q) / limits) ** 2


def sphere_cover(solid: Solid) -> tuple[Array, float]:
    """Centres (k, 3) in the carrier's frame and the radius of equal spheres that cover a solid.

    A solid is cut into about cubic cells and a sphere put around each; a capsule's spheres
    stand on its axis, ends included.
    """
    solid = _boxed(solid)
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
    radius = sphere_cover(solid)[1]
    boxed = _boxed(solid)
    return radius - float(boxed.size.min() / 2 if boxed.shape == "box" else boxed.size[0])


def signed_distance(solid: Solid, point: ca.SX) -> ca.SX:
    """Distance in m of a point (3,) in the carrier's frame from a solid, negative inside.

    Never larger than the true one, smaller by 2 `ROUNDING` at most; a mesh is the box around it.
    Outside |max(p − h, 0)|, inside max(p − h), with h the half extents of a box, or the radius
    and half length of a cylinder; differentiable outside.
    """
    solid = _boxed(solid)
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


def _boxed(solid: Solid) -> Solid:
    """A mesh as the box around it in its own axes; any other solid unchanged."""
    if solid.shape != "mesh":
        return solid
    points = mesh_hull(solid)[0]
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.eye(4)
    middle[:3, 3] = (low + high) / 2
    return Solid(solid.name, "box", high - low, solid.placement @ middle)


# The local searches, and the polish that makes one for each pose of a plan.

ORDER = 20.0  # of the power means that stand for a criterion's kinks while IPOPT searches
SHORTLIST = 200  # candidates by sensitivity among which a pose's further starts are sought
LEAST_GAIN = 1e-8  # relative improvement of Φ that counts as one
# Shares of the way from a start to where its search ended that are tried: IPOPT sees B at
# simplified deflections and the rules in part, so that its end need not be the best, or feasible.
STEPS = (1.0, 0.9, 0.7, 0.4, 0.15)
APART = 0.2  # rad or m between starts in at least one joint
IPOPT_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "show_eval_warnings": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.max_iter": 80,
    "ipopt.tol": 1e-7,
    # Six variables: second derivatives cost more than the steps they save.
    "ipopt.hessian_approximation": "limited-memory",
    "ipopt.bound_relax_factor": 0.0,
}


@dataclass(frozen=True)
class Polished:
    """The plan's poses q (k, n) in the order given, and Φ before and after.

    `moved` (k,) marks the poses that are no longer the candidates they were.
    """

    q: Array
    before: float
    after: float
    moved: NDArray[np.bool_]


def polish(
    problem: DesignProblem,
    searches: Searches,
    q: Array,
    load: IntArray,
    chosen: IntArray,
    *,
    starts: int = 3,
    sweeps: int = 5,
    tolerance: float = 1e-4,
    jobs: int = 1,
    progress: Progress = lambda message: None,
) -> Polished:
    """The plan `chosen` (k,) of a pool q (N, n), load (N,), improved continuously.

    Block coordinate descent: pose after pose is moved to

        min Φ(M − B_jᵀB_j + B(q)ᵀB(q))   over its level, joint limits and the cell's margins

    by IPOPT, from where it is and from the `starts` best candidates for its place.  Every end,
    and points on the way to it, are evaluated exactly and checked by the cell's own rules; the
    best that passes is taken, so Φ never rises and no rule is broken.  Sweeps end when one gains
    less than `tolerance`.  The result does not depend on `jobs`, the number of processes.

    Raises InputError where starts < 0 or sweeps < 1.
    """
    require(starts >= 0, f"polish needs a number of starts, got {starts}")
    require(sweeps >= 1, f"polish needs at least one sweep, got {sweeps}")
    plan = _Plan(problem, searches, q, load, np.asarray(chosen), starts, jobs)
    before = plan.value
    for sweep in range(sweeps):
        progress(f"polishing poses, sweep {sweep + 1}: {problem.criterion.name} {plan.value:.6g}")
        at_start, shortlist = plan.value, plan.shortlist()
        for j in range(len(plan.q)):
            plan.improve(j, shortlist)
        if plan.value > at_start * (1 - tolerance):
            break
    moved = (plan.q != q[plan.chosen]).any(axis=1)
    return Polished(plan.q, before, plan.value, moved)


class _Plan:
    """The plan as it stands: poses `q` (k, n), their blocks, Φ `value`."""

    def __init__(
        self,
        problem: DesignProblem,
        searches: Searches,
        pool: Array,
        load: IntArray,
        chosen: IntArray,
        starts: int,
        jobs: int,
    ) -> None:
        self.problem, self.searches, self.pool, self.load = problem, searches, pool, load
        self.chosen, self.starts, self.jobs = chosen, starts, jobs
        self.smooth = problem.criterion.softened(ORDER)
        self.q = pool[chosen].copy()
        self.blocks = problem.blocks[:, chosen].copy()
        self.value = float(problem.criterion.value(self.information()))

    def information(self, without: int | None = None) -> Array:
        """M (S, p, p) of the plan, or of all its poses but one."""
        kept = [i for i in range(len(self.q)) if i != without]
        B = self.blocks[:, kept]
        return self.problem.prior + np.einsum("snri,snrj->sij", B, B, optimize=True)

    def shortlist(self) -> dict[tuple[int, int], IntArray]:
        """The candidates of largest sensitivity, per group and load state of the plan."""
        G = self.problem.criterion.gradient(self.information()).G
        d = self.problem.sensitivity(G)
        best = {}
        for group, load in {self._kind(j) for j in range(len(self.q))}:
            own = np.flatnonzero((self.problem.group == group) & (self.load == load))
            best[group, load] = own[np.argsort(-d[own], kind="stable")[:SHORTLIST]]
        return best

    def improve(self, j: int, shortlist: dict[tuple[int, int], IntArray]) -> None:
        """Move pose j if that lowers Φ."""
        group, load = self._kind(j)
        M = self.information(without=j)
        starts = np.vstack([self.q[j], self._others(M, shortlist[group, load])])
        unit = float(self.smooth.value(self.information()))
        search = self.searches.at(self.q[j], load, group)
        goal = PlanValue(self.smooth, M, unit)
        ends = search_all([(search, goal, starts)], self.jobs)
        poses = trials(starts, ends)
        blocks = self.searches.blocks(poses, load)
        values = self.problem.criterion.after_adding(M, blocks)
        better = np.flatnonzero(values < self.value * (1 - LEAST_GAIN))
        better = better[self.searches.feasible(poses[better], load)] if len(better) else better
        if len(better):
            best = better[values[better].argmin()]
            self.q[j], self.blocks[:, j] = poses[best], blocks[:, best]
            self.value = float(values[best])

    def _others(self, M: Array, shortlist: IntArray) -> Array:
        """The best candidates for a place in a plan whose rest has information M."""
        values = self.problem.criterion.after_adding(M, self.problem.blocks[:, shortlist])
        ranked = self.pool[shortlist[np.argsort(values, kind="stable")]]
        return ranked[distinct(ranked, self.starts)]

    def _kind(self, j: int) -> tuple[int, int]:
        candidate = self.chosen[j]
        return int(self.problem.group[candidate]), int(self.load[candidate])


@dataclass
class Searches:
    """What local searches need to know of the cell; `pairs` as of `cell_pairs`."""

    information: PoseInformation
    space: JointSpace
    checker: Feasibility
    pairs: Sequence[Pair]
    _built: dict[tuple[int, int], SymbolicBlocks] = field(default_factory=dict)
    _margins: dict[int, ca.Function | None] = field(default_factory=dict)

    def at(self, q: Array, load: int, group: int) -> LocalSearch:
        """The search among poses of a group in a load state, with the noise of readings at q."""
        if (load, group) not in self._built:
            self._built[load, group] = symbolic_blocks(self.information, q, load)
        if load not in self._margins:
            model = self.information.model
            self._margins[load] = margins(model.cell, model.chain, self.pairs, self.forces(load))
        whitener = self.information.whitener(q, load)
        blocks = replace(self._built[load, group], whitener=whitener)
        return LocalSearch(blocks, self._margins[load], *self.space.bounds(group))

    def forces(self, load: int) -> Array:
        """The forces (k, 3) N under which a pose in load state `load` is measured."""
        states = self.information.states
        return np.asarray(states.forces[states.of(load)])

    def feasible(self, q: Array, load: int) -> NDArray[np.bool_]:
        """The full check of poses q (N, n) in one load state."""
        return feasible(self.checker, q, self.forces(load))

    def blocks(self, q: Array, load: int) -> Array:
        """Exact blocks (S, N, r, p) of poses q (N, n) in one load state."""
        return self.information.blocks(q, np.full(len(q), load))


def trials(starts: Array, ends: Array) -> Array:
    """Poses (K·steps, n) on the way from each start (K, n) to its end, the ends first."""
    way = ends - starts
    return np.concatenate([starts + step * way for step in STEPS])


def distinct(q: Array, count: int) -> NDArray[np.int64]:
    """Indices of the first `count` poses of q (N, n) that lie `APART` from those before."""
    chosen: list[int] = []
    for i, pose in enumerate(q):
        if len(chosen) == count:
            break
        if all(np.abs(pose - q[k]).max() > APART for k in chosen):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)


@dataclass(frozen=True)
class SymbolicBlocks:
    """Whitened, scaled B (S, r, p) of one pose as a smooth function of its joints q (n,).

    `B` and `adjoint` are CasADi functions as in `ConfigurationRows`; `scenarios` (S, parameters),
    `sizes` (p,), `whitener` (S, r, r), held while q moves.  It pickles.
    """

    B: ca.Function
    adjoint: ca.Function
    scenarios: Array
    sizes: Array
    whitener: Array

    def at(self, q: Array) -> Array:
        """Blocks (S, r, p) at q."""
        raw = np.stack([self.B(q, x).full() for x in self.scenarios])
        return np.asarray(self.whitener @ raw * self.sizes)

    def slope(self, q: Array, W: Array) -> Array:
        """∂/∂q (n,) of Σ_s ⟨W_s, blocks_s(q)⟩ for W (S, r, p)."""
        raw = self.whitener.transpose(0, 2, 1) @ W * self.sizes
        return np.asarray(
            sum(
                self.adjoint(q, x, w).full()[:, 0] for x, w in zip(self.scenarios, raw, strict=True)
            )
        )


def symbolic_blocks(information: PoseInformation, q: Array, load: int) -> SymbolicBlocks:
    """`information.blocks` of a pose near q (n,) in load state `load`, as an expression.

    The load state, and the level of a split joint, are those of q; so is the whitener.
    """
    model = information.model
    template = information.rows(q[None], np.array([load]), information.scenarios[0])
    symbolic = SymbolicArm(model.chain, model.cell)
    rows = configuration_rows(symbolic, template, information.columns)
    return SymbolicBlocks(
        rows.function,
        rows.adjoint,
        information.scenarios,
        information.sizes,
        information.whitener(q, load),
    )


class Goal(Protocol):
    """A figure of merit f of one pose's blocks B (S, r, p), to be minimised."""

    def value(self, B: Array) -> float:
        """f(B)."""

    def slope(self, B: Array) -> Array:
        """∂f/∂B (S, r, p)."""


@dataclass(frozen=True)
class PlanValue:
    """f = Φ(M + Σ BᵀB)/`unit`: the plan's value, M (S, p, p) the information of all else."""

    criterion: Criterion
    M: Array
    unit: float

    def value(self, B: Array) -> float:
        return float(self.criterion.value(self.M + B.transpose(0, 2, 1) @ B)) / self.unit

    def slope(self, B: Array) -> Array:
        G = self.criterion.gradient(self.M + B.transpose(0, 2, 1) @ B).G
        return np.asarray(-2 / self.unit * B @ G)


@dataclass(frozen=True)
class Sensitivity:
    """f = −d/`unit` with d = Σ_s tr(B_s G_s B_sᵀ), G (S, p, p): what a pose adds at the margin."""

    G: Array
    unit: float

    def value(self, B: Array) -> float:
        return -float(np.sum(B @ self.G * B)) / self.unit

    def slope(self, B: Array) -> Array:
        return np.asarray(-2 / self.unit * B @ self.G)


@dataclass(frozen=True)
class LocalSearch:
    """min f(B(q)) with lower ≤ q ≤ upper (n,) and margins(q) ≥ 0; it pickles.

    `margins` q → (m,), or None, is how far each rule of the cell is from being broken.  It is
    conservative, so a start that the exact rules allow may fall short of it: there each margin
    need only stay what it is.
    """

    blocks: SymbolicBlocks
    margins: ca.Function | None
    lower: Array
    upper: Array

    def ends(self, goal: Goal, starts: Array) -> Array:
        """Where IPOPT stops from each start (K, n); the start itself where it fails.

        IPOPT: Wächter & Biegler, Math. Program. 106 (2006) 25.
        """
        n = len(self.lower)
        f = _GoalFunction(goal, self.blocks, n)
        q = ca.MX.sym("q", n)
        problem: dict[str, Any] = {"x": q, "f": f(q)}
        if self.margins is not None:
            problem["g"] = self.margins(q)
        solver = ca.nlpsol("polish", "ipopt", problem, IPOPT_OPTIONS)
        return np.stack([self._end(solver, start) for start in starts])

    def _end(self, solver: ca.Function, start: Array) -> Array:
        bounds: dict[str, Any] = {"lbx": self.lower, "ubx": self.upper}
        if self.margins is not None:
            bounds |= {"lbg": np.minimum(self.margins(start).full(), 0.0), "ubg": np.inf}
        # A goal that cannot be evaluated (no equilibrium, singular information) ends a search.
        with contextlib.suppress(RuntimeError):
            end = solver(x0=start, **bounds)["x"].full().ravel()
            if np.isfinite(end).all():
                return np.asarray(np.clip(end, self.lower, self.upper))
        return start


Task = tuple[LocalSearch, Goal, Array]


def search_all(tasks: Sequence[Task], jobs: int) -> Array:
    """Where every start of every task (search, goal, starts) ended, stacked, on `jobs` processes.

    Every start is searched by itself, so the result does not depend on `jobs`.
    """
    if jobs == 1:
        return np.vstack([search.ends(goal, starts) for search, goal, starts in tasks])
    from joblib import Parallel, delayed

    single = [(search, goal, start[None]) for search, goal, starts in tasks for start in starts]
    return np.vstack(Parallel(n_jobs=jobs)(delayed(s.ends)(goal, q) for s, goal, q in single))


class _GoalFunction(ca.Callback):
    """f(B(q)) for CasADi: evaluated by numpy, so that any criterion serves, with exact slopes."""

    def __init__(self, goal: Goal, blocks: SymbolicBlocks, n: int) -> None:
        ca.Callback.__init__(self)
        self.goal, self.blocks, self.n = goal, blocks, n
        self.at: tuple[bytes, Array] = (b"", np.empty(0))
        self.construct("f", {})

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.n, 1)

    def B(self, q: Array) -> Array:
        # IPOPT asks for the value and the slope at the same point.
        if self.at[0] != q.tobytes():
            self.at = (q.tobytes(), self.blocks.at(q))
        return self.at[1]

    def eval(self, arguments: Sequence[ca.DM]) -> list:
        return [self.goal.value(self.B(arguments[0].full().ravel()))]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inputs: Any, outputs: Any, options: Any) -> ca.Function:
        self.jacobian_function = _GoalSlope(self, name)
        return self.jacobian_function


class _GoalSlope(ca.Callback):
    """∂f/∂q (1, n) of a `_GoalFunction`, as CasADi calls it: with q and f."""

    def __init__(self, f: _GoalFunction, name: str) -> None:
        ca.Callback.__init__(self)
        self.f = f
        self.construct(name, {})

    def get_n_in(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.f.n if i == 0 else 1, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(1, self.f.n)

    def eval(self, arguments: Sequence[ca.DM]) -> list:
        q = arguments[0].full().ravel()
        slope = self.f.goal.slope(self.f.B(q))
        return [ca.DM(self.f.blocks.slope(q, slope)).T]


# How much better a plan could be with poses that are not in the pool: an estimate.
#
# On the continuum of feasible poses the tangent at (Φ, G) bounds every plan's value by
#
#     Φ(plan) ≥ Φ² / (⟨G, prior⟩ + Σ_l n_l max_{q∈l} d(q)),   d(q) = Σ_s tr(B_s(q) G_s B_s(q)ᵀ)
#
# as in `selection`, without its box, since one continuous pose may repeat.  d has many local
# maxima and rules cut the space up, so the global one is sought, not proved: new Sobol points,
# then local ascents from the best of them and of the pool.

LOT = 256  # of the best new points that are checked for feasibility at a time
LOTS = 16  # at most
LEAST_CONTINUUM_GAIN = 1e-6  # relative excess over the pool's largest d that counts as one


@dataclass(frozen=True)
class Continuum:
    """`largest` (L,): the largest d found per group, and `bound`, the bound on Φ it amounts to.

    An estimate from above: a larger d may have been missed, and then no plan is held to `bound`.
    `q` (k, n), `load` (k,), `group` (k,): feasible poses found whose d exceeds all of the pool's;
    adding them to the pool and choosing anew closes the gap.  Effort: `searched` new points
    evaluated, `checked` of them for feasibility, `ascents` local searches.
    """

    largest: Array
    bound: float
    q: Array
    load: IntArray
    group: IntArray
    searched: int
    checked: int
    ascents: int


def estimate(
    problem: DesignProblem,
    tangent: Gradient,
    searches: Searches,
    q: Array,
    load: IntArray,
    *,
    points: int = 8 * CHUNK,
    starts: int = 6,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress = lambda message: None,
) -> Continuum:
    """The largest d on the continuum per group, for the tangent (Φ, G) of the pool's optimum.

    `q` (N, n), `load` (N,): the problem's candidates.  Per group and load state `points` new
    poses (rounded up to chunks) are evaluated at once, feasibility only of the best; IPOPT climbs
    from the `starts` best poses, new or of the pool, that lie apart.  Every maximum is
    evaluated exactly and passed by the cell's own rules.  The result depends on `seed`, not on
    `jobs`, the number of processes.

    Raises InputError where points < 1 or starts < 1.
    """
    require(points >= 1 and starts >= 1, "the search of the continuum needs points and starts")
    pool_d = problem.sensitivity(tangent.G)
    search = _Search(searches, tangent.G, points, starts, jobs)
    streams = np.random.SeedSequence(seed).spawn(len(problem.shares))
    largest = np.zeros(len(problem.shares))
    found: list[_Poses] = []
    for group in np.flatnonzero(problem.shares).tolist():
        progress(f"searching the continuum, level {group + 1} of {len(largest)}")
        own = problem.group == group
        largest[group] = pool_d[own].max()
        for state in np.unique(load[own]).tolist():
            here = own & (load == state)
            pool = _Poses(q[here], pool_d[here], state, group)
            found.append(search.run(pool, streams[group]).above(largest[group]))
        best = [poses.d.max(initial=0.0) for poses in found if poses.group == group]
        largest[group] = max(largest[group], *best)
    reach = float(np.sum(tangent.G * problem.prior)) + float(problem.shares @ largest)
    return Continuum(
        largest,
        tangent.value**2 / reach,
        np.concatenate([poses.q for poses in found]),
        np.concatenate([np.full(len(poses.q), poses.load) for poses in found]),
        np.concatenate([np.full(len(poses.q), poses.group) for poses in found]),
        search.searched,
        search.checked,
        search.ascents,
    )


@dataclass(frozen=True)
class _Poses:
    """Poses of one group and load state with their d."""

    q: Array
    d: Array
    load: int
    group: int

    def with_these(self, q: Array, d: Array) -> _Poses:
        return replace(self, q=np.vstack([self.q, q]), d=np.append(self.d, d))

    def take(self, index: NDArray) -> _Poses:
        return replace(self, q=self.q[index], d=self.d[index])

    def ranked(self) -> _Poses:
        """Best first."""
        return self.take(np.argsort(-self.d, kind="stable"))

    def above(self, value: float) -> _Poses:
        """The poses with d > value, best first, of those that lie close together only one."""
        better = self.take(self.d > value * (1 + LEAST_CONTINUUM_GAIN)).ranked()
        return better.take(distinct(better.q, len(better.q)))


@dataclass
class _Search:
    """New points and ascents for one G; counts its effort."""

    searches: Searches
    G: Array
    points: int
    starts: int
    jobs: int
    searched: int = 0
    checked: int = 0
    ascents: int = 0

    def run(self, pool: _Poses, stream: np.random.SeedSequence) -> _Poses:
        """Feasible poses found, new ones and where ascents ended."""
        drawn = self._drawn(pool, stream)
        first = pool.with_these(drawn.q, drawn.d).ranked()
        first = first.take(distinct(first.q, self.starts))
        tasks = [
            (self.searches.at(q, pool.load, pool.group), Sensitivity(self.G, d), q[None])
            for q, d in zip(first.q, first.d, strict=True)
        ]
        self.ascents += len(tasks)
        q = trials(first.q, search_all(tasks, self.jobs))
        d = self._sensitivity(q, pool.load)
        # An ascent counts if it rose; what it started from is feasible already.
        rose = d > np.tile(first.d, len(q) // len(first.d))
        q, d = q[rose], d[rose]
        ok = self.searches.feasible(q, pool.load)
        return drawn.with_these(q[ok], d[ok])

    def _drawn(self, pool: _Poses, stream: np.random.SeedSequence) -> _Poses:
        """The best feasible of `points` Sobol points."""
        chunks = islice(sobol(self.searches.space, pool.group, stream), -(-self.points // CHUNK))
        q = np.concatenate(list(chunks))
        ranked = replace(pool, q=q, d=self._sensitivity(q, pool.load)).ranked()
        self.searched += len(q)
        found = ranked.take(np.arange(0))
        for lot in range(LOTS):
            part = ranked.take(np.arange(lot * LOT, min((lot + 1) * LOT, len(q))))
            ok = self.searches.feasible(part.q, pool.load)
            self.checked += len(part.q)
            found = found.with_these(part.q[ok], part.d[ok])
            if len(distinct(found.q, self.starts)) == self.starts:
                break
        return found

    def _sensitivity(self, q: Array, load: int) -> Array:
        """d (N,) of poses q (N, n), a chunk's blocks at a time."""
        d = np.empty(len(q))
        for start in range(0, len(q), CHUNK):
            B = self.searches.blocks(q[start : start + CHUNK], load)
            d[start : start + CHUNK] = np.einsum("snri,sij,snrj->n", B, self.G, B, optimize=True)
        return d
