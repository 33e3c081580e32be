"""Poses off the pool: a plan polished all at once, and what the continuum could still gain.

    min log Φ(prior + Σ_i B(q_i)ᵀB(q_i))   over q_1 … q_n, their levels, joint limits and margins

by IPOPT (Wächter & Biegler, Math. Program. 106 (2006) 25) with the exact adjoint of B.  Margins and
B are those of simplified rules and deflections, so every end is evaluated exactly, and checked by
the cell's own rules.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import casadi as ca
import numpy as np

from elastocal.model.symbolic import SymbolicArm, configuration_rows
from elastocal.planning.bodies import Pair
from elastocal.planning.candidates import CHUNK, JointSpace, feasible, sobol
from elastocal.planning.criterion import TangentBound, inverse
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import PoseInformation
from elastocal.planning.margins import margins
from elastocal.planning.relaxation import DesignProblem, block_prices
from elastocal.units import Array, BoolArray, IntArray, Progress

ORDER = 30.0  # of the power means that stand for a criterion's kinks while IPOPT searches
LEAST_GAIN = 1e-8  # relative improvement of Φ that counts as one
# Shares of the way from a start to where its search ended that are tried, the rules permitting.
STEPS = (1.0, 0.9, 0.7, 0.4, 0.15)
ROUNDS = 2  # of polish: the second with the poses held that the rules stopped on their way
IPOPT_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
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

# Blocks (S, k, r, p) of k poses → f and ∂f/∂B.
Goal = Callable[[Array], tuple[float, Array]]


@dataclass
class Searches:
    """What searches off the pool need to know of the cell; `pairs` as of `cell_pairs`."""

    information: PoseInformation
    space: JointSpace
    checker: Feasibility
    pairs: Sequence[Pair]
    _rows: dict[tuple[int, int], tuple[ca.Function, ca.Function]] = field(default_factory=dict)
    _margins: dict[int, ca.Function | None] = field(default_factory=dict)
    _joint: dict[bytes, JointSearch] = field(default_factory=dict)

    def forces(self, load: int) -> Array:
        """The forces (k, 3) N under which a pose in load state `load` is measured."""
        states = self.information.states
        return np.asarray(states.forces[states.of(load)])

    def feasible(self, q: Array, load: IntArray) -> BoolArray:
        """The full check of poses q (N, n) in load states `load` (N,)."""
        ok = np.zeros(len(q), dtype=bool)
        for state in np.unique(load).tolist():
            own = load == state
            ok[own] = feasible(self.checker, q[own], self.forces(state))
        return ok

    def rows(self, q: Array, load: int, group: int) -> tuple[ca.Function, ca.Function]:
        """B (q, x) and its adjoint (q, x, W) of poses like q (n,), in its load state and, where a
        joint's compliance is split by level, at its level."""
        level = group if self.information.model.cell.model.compliance_levels else 0
        if (load, level) not in self._rows:
            info = self.information
            template = info.rows(q[None], np.array([load]), info.scenarios[0])
            arm = SymbolicArm(info.model.chain, info.model.cell)
            rows = configuration_rows(arm, template, info.columns)
            self._rows[load, level] = rows.function, rows.adjoint
        return self._rows[load, level]

    def margins(self, load: int) -> ca.Function | None:
        """q (n,) → margins (m,) of the rules in a load state."""
        if load not in self._margins:
            model = self.information.model
            self._margins[load] = margins(model.cell, model.chain, self.pairs, self.forces(load))
        return self._margins[load]

    def joint(self, q: Array, load: IntArray, group: IntArray) -> JointSearch:
        """The search over poses of these load states (k,) and groups (k,), near q (k, n)."""
        key = np.concatenate([load, group]).tobytes()
        if key not in self._joint:
            self._joint[key] = JointSearch(self, q, load, group)
        return self._joint[key]

    def bounds(self, group: IntArray) -> tuple[Array, Array]:
        """Joint limits (k, n) each of poses of these groups."""
        found = [self.space.bounds(int(g)) for g in group]
        return np.array([low for low, _ in found]), np.array([high for _, high in found])


class JointSearch:
    """min f(B(q_1) … B(q_k)) inside bounds and margins, over all poses at once."""

    def __init__(self, searches: Searches, q: Array, load: IntArray, group: IntArray) -> None:
        self.searches, self.load = searches, load
        levels = group if searches.information.model.cell.model.compliance_levels else 0 * group
        kinds: dict[tuple[int, int], list[int]] = {}
        for i, kind in enumerate(zip(load.tolist(), levels.tolist(), strict=True)):
            kinds.setdefault(kind, []).append(i)
        self.maps = []
        flat = ca.MX.sym("z", q.size)
        z, limits = ca.reshape(flat, q.shape[1], len(q)), []
        for (state, _), own in kinds.items():
            B, adjoint = searches.rows(q[own[0]], state, int(group[own[0]]))
            self.maps.append((np.array(own), B.map(len(own)), adjoint.map(len(own))))
            rules = searches.margins(state)
            if rules is not None:
                limits.append(ca.vec(rules.map(len(own))(z[:, own])))
        self.margins = ca.Function("g", [flat], [ca.vertcat(*limits)]) if limits else None
        self.f = _Value(self, q.shape)
        self.problem: dict[str, Any] = {"x": flat, "f": self.f(flat)}
        if self.margins is not None:
            self.problem["g"] = self.margins(flat)
        self.solvers: dict[tuple[int, bool], ca.Function] = {}
        self.whitener, self.T = np.empty(0), np.empty(0)
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
        info = self.searches.information
        self.goal, self.T, self.f.last = goal, T, None
        self.whitener = info.whiteners(q, self.load)
        if (most, fine) not in self.solvers:
            options = IPOPT_OPTIONS | {"ipopt.max_iter": most} | (FINE if fine else {})
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
        """Blocks (S, k, r, p) of poses q (k, n), by the symbolic model."""
        info, found = self.searches.information, None
        for own, B, _ in self.maps:
            for s, x in enumerate(info.scenarios):
                raw = B(q[own].T, np.tile(x[:, None], len(own))).full()
                if found is None:
                    shape = len(info.scenarios), len(q), raw.shape[0], len(info.columns)
                    found = np.empty(shape)
                found[s, own] = raw.reshape(len(raw), len(own), -1).swapaxes(0, 1)
        assert found is not None
        return np.asarray(self.whitener @ found * info.sizes @ self.T[:, None])

    def slope(self, q: Array, W: Array) -> Array:
        """∂/∂q (k, n) of ⟨W, blocks(q)⟩, W (S, k, r, p)."""
        info, total = self.searches.information, np.zeros_like(q)
        raw = self.whitener.swapaxes(-1, -2) @ W @ self.T[:, None].swapaxes(-1, -2) * info.sizes
        for own, _, adjoint in self.maps:
            for s, x in enumerate(info.scenarios):
                weights = raw[s, own].swapaxes(0, 1).reshape(raw.shape[2], -1)
                total[own] += adjoint(q[own].T, np.tile(x[:, None], len(own)), weights).full().T
        return total


class _Value(ca.Callback):
    """f(B(q)) for CasADi: evaluated by numpy, so that any criterion serves, with exact slopes."""

    def __init__(self, search: JointSearch, shape: tuple[int, ...]) -> None:
        ca.Callback.__init__(self)
        self.search, self.shape = search, shape
        self.last: tuple[Array, float, Array] | None = None
        self.construct("f", {})

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(int(np.prod(self.shape)), 1)

    def at(self, z: Any) -> tuple[float, Array]:
        """f and ∂f/∂q (1, k n); IPOPT asks for both at the same point."""
        q = z.full().reshape(self.shape)
        if self.last is None or not np.array_equal(self.last[0], q):
            value, W = self.search.goal(self.search.blocks(q))
            self.last = q, value, self.search.slope(q, W).reshape(1, -1)
        return self.last[1], self.last[2]

    def eval(self, given: Sequence[ca.DM]) -> list:
        return [self.at(given[0])[0]]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inputs: Any, outputs: Any, options: Any) -> ca.Function:
        self.jacobian_function = _Slope(self, name)
        return self.jacobian_function


class _Slope(ca.Callback):
    """∂f/∂q (1, k n) of a `_Value`, as CasADi calls it: with q and f."""

    def __init__(self, f: _Value, name: str) -> None:
        ca.Callback.__init__(self)
        self.f = f
        self.construct(name, {})

    def get_n_in(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(int(np.prod(self.f.shape)) if i == 0 else 1, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(1, int(np.prod(self.f.shape)))

    def eval(self, given: Sequence[ca.DM]) -> list:
        return [ca.DM(self.f.at(given[0])[1])]


# All poses of a plan at once.


def polish(
    problem: DesignProblem,
    searches: Searches,
    T: Array,
    q: Array,
    load: IntArray,
    group: IntArray,
    fine: bool = False,
) -> tuple[Array, float]:
    """The plan's poses (k, n) moved to a local optimum, and Φ; q is returned where none is better.

    `problem` is that of the parameters z, y = T_s z.  No rule is broken that the poses q keep.
    `fine`: until nothing is gained any more.
    """
    info, criterion = searches.information, problem.criterion
    smooth = criterion.softened(ORDER)

    def goal(B: Array) -> tuple[float, Array]:
        V = inverse(problem.prior + np.einsum("snri,snrj->sij", B, B, optimize=True))
        phi, C = smooth.slope(V)
        return float(np.log(phi)), -2 / phi * B @ (V @ C @ V)[:, None]

    def exact(q: Array, some: IntArray) -> Array:
        return np.asarray(info.blocks(q, load[some]) @ T[:, None])

    def value(B: Array) -> float:
        M = problem.prior + np.einsum("snri,snrj->sij", B, B, optimize=True)
        return float(criterion.of(inverse(M)))

    every = np.arange(len(q))
    lower, upper = searches.bounds(group)
    search, B = searches.joint(q, load, group), exact(q, every)
    phi = value(B)
    for _ in range(ROUNDS):
        end = search.end(goal, T, q, lower, upper, fine=fine)
        part = _allowed(searches, q, end, load)
        z = q + part[:, None] * (end - q)
        moved = exact(z, every)
        found = value(moved)
        if found < phi * (1 - LEAST_GAIN):
            q, B, phi = z, moved, found
        else:
            return _one_by_one(q, B, phi, z, moved, value)
        held = part < 1
        if not held.any():
            break
        lower, upper = (np.where(held[:, None], q, bound) for bound in (lower, upper))
    return q, phi


def _allowed(searches: Searches, q: Array, end: Array, load: IntArray) -> Array:
    """(k,) how far the rules let each pose go on its way from q to its end (k, n)."""
    part, left = np.zeros(len(q)), np.flatnonzero((q != end).any(axis=1))
    part[np.setdiff1d(np.arange(len(q)), left)] = 1.0
    for step in STEPS:
        if not len(left):
            break
        ok = searches.feasible(q[left] + step * (end[left] - q[left]), load[left])
        part[left[ok]] = step
        left = left[~ok]
    return part


def _one_by_one(
    q: Array, B: Array, phi: float, z: Array, moved: Array, value: Callable[[Array], float]
) -> tuple[Array, float]:
    """Of the poses z (k, n) with blocks `moved` those that better the plan, one after another."""
    q, B = q.copy(), B.copy()
    for k in range(len(q)):
        was = B[:, k].copy()
        B[:, k] = moved[:, k]
        found = value(B)
        if found < phi * (1 - LEAST_GAIN):
            q[k], phi = z[k], found
        else:
            B[:, k] = was
    return q, phi


# How much better a plan could be with poses that are not in the pool: an estimate.
#
# On the continuum of feasible poses the tangent at (Φ, G) bounds every plan's value by
#
#     Φ(plan) ≥ Φ² / (⟨G, prior⟩ + Σ_l n_l max_{q∈l} d(q)),   d(q) = Σ_s tr(B_s(q) G_s B_s(q)ᵀ)
#
# as in `relaxation`, without its box, since one continuous pose may repeat.  d has many local
# maxima and rules cut the space up, so the global one is sought, not proved: new Sobol points,
# then local ascents from the best of them and of the pool.

POINTS = 4096  # new poses per group and load state
STARTS = 6  # ascents per group and load state
LOT, LOTS = 256, 16  # of the best new points that are checked for feasibility at a time, at most
APART = 0.2  # rad or m between starts in at least one joint
EXCESS = 1e-6  # over the pool's largest d, relative, that counts as one


@dataclass(frozen=True)
class Continuum:
    """`bound` on Φ from the largest d found on the continuum: an estimate from above, as a larger d
    may have been missed, and then no plan is held to it.

    `q` (k, n), `load` (k,), `group` (k,): feasible poses found whose d exceeds all of the pool's;
    they belong in the pool.  Effort: `searched` new points and `ascents` local searches.
    """

    bound: float
    q: Array
    load: IntArray
    group: IntArray
    searched: int
    ascents: int


def estimate(
    problem: DesignProblem,
    tangent: TangentBound,
    searches: Searches,
    T: Array,
    q: Array,
    load: IntArray,
    *,
    seed: int = 0,
    progress: Progress = lambda message: None,
) -> Continuum:
    """The largest d on the continuum per group, for the tangent (Φ, G) of the pool's optimum.

    `q` (N, n), `load` (N,): the problem's candidates, of the parameters z, y = T_s z.  Every
    maximum is evaluated exactly and passed by the cell's own rules.
    """
    d = problem.prices(tangent.G)

    def price(q: Array, load: IntArray) -> Array:
        parts = range(0, len(q), CHUNK)
        found = [searches.information.blocks(q[k : k + CHUNK], load[k : k + CHUNK]) for k in parts]
        return np.concatenate([block_prices(B @ T[:, None], tangent.G) for B in found])

    streams = np.random.SeedSequence(seed).spawn(len(problem.shares))
    lots, searched = [], 0
    for group in np.flatnonzero(problem.shares).tolist():
        progress(f"searching the continuum, level {group + 1} of {len(problem.shares)}")
        chunks = list(islice(sobol(searches.space, group, streams[group]), -(-POINTS // CHUNK)))
        new = np.concatenate(chunks)
        for state in np.unique(load[problem.group == group]).tolist():
            own = np.flatnonzero((problem.group == group) & (load == state))
            at = np.full(len(new), state)
            drawn, of = _best_feasible(searches, new, at, price(new, at))
            searched += len(new)
            first = np.append(of, d[own])
            order = np.argsort(-first, kind="stable")
            both = np.vstack([drawn, q[own]])[order]
            kept = distinct(both, STARTS)
            lots.append((both[kept], first[order][kept], state, group, drawn, of))
    starts = np.vstack([lot[0] for lot in lots])
    unit = np.concatenate([lot[1] for lot in lots])
    at_load, at_group = (
        np.concatenate([np.full(len(lot[0]), lot[k]) for lot in lots]) for k in (2, 3)
    )
    ends = _climbed(searches, tangent.G, T, starts, unit, at_load, at_group)
    tried = np.concatenate([starts + step * (ends - starts) for step in STEPS])
    loads, groups = np.tile(at_load, len(STEPS)), np.tile(at_group, len(STEPS))
    height = price(tried, loads)
    rose = np.flatnonzero(height > np.tile(unit, len(STEPS)))
    rose = rose[searches.feasible(tried[rose], loads[rose])]
    found: list[tuple[Array, ...]] = [(tried[rose], height[rose], loads[rose], groups[rose])]
    found += [(lot[4], lot[5], *(np.full(len(lot[4]), lot[k]) for k in (2, 3))) for lot in lots]
    poses, values, loads, groups = (np.concatenate([one[k] for one in found]) for k in range(4))
    largest, top_poses = np.zeros(len(problem.shares)), []
    for group in np.flatnonzero(problem.shares).tolist():
        top = d[problem.group == group].max()
        own = np.flatnonzero((groups == group) & (values > top * (1 + EXCESS)))
        own = own[np.argsort(-values[own], kind="stable")]
        top_poses.append(own[distinct(poses[own], len(own))])
        largest[group] = max(top, values[own].max(initial=0.0))
    reach = float(np.sum(tangent.G * problem.prior)) + float(problem.shares @ largest)
    at = np.concatenate(top_poses)
    return Continuum(
        tangent.value**2 / reach, poses[at], loads[at], groups[at], searched, len(starts)
    )


def _best_feasible(searches: Searches, q: Array, load: IntArray, d: Array) -> tuple[Array, Array]:
    """The best feasible of new poses q (N, n) with prices d (N,), a few that lie apart at least."""
    order = np.argsort(-d, kind="stable")
    found: list[IntArray] = []
    for lot in range(LOTS):
        part = order[lot * LOT : (lot + 1) * LOT]
        found.append(part[searches.feasible(q[part], load[part])])
        so_far = np.concatenate(found)
        if len(distinct(q[so_far], STARTS)) == STARTS:
            break
    return q[so_far], d[so_far]


def _climbed(
    searches: Searches, G: Array, T: Array, q: Array, d: Array, load: IntArray, group: IntArray
) -> Array:
    """Poses from q (k, n), of prices d (k,), uphill in d(q): each in its own unit."""

    def goal(B: Array) -> tuple[float, Array]:
        priced = B @ G[:, None] / d[:, None, None]
        return -float((priced * B).sum()), -2 * priced

    lower, upper = searches.bounds(group)
    return searches.joint(q, load, group).end(goal, T, q, lower, upper, CLIMBING)


def distinct(q: Array, count: int) -> IntArray:
    """Indices of the first `count` poses of q (N, n) that lie `APART` from those before."""
    chosen: list[int] = []
    for i, pose in enumerate(q):
        if len(chosen) == count:
            break
        if all(np.abs(pose - q[k]).max() > APART for k in chosen):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)
