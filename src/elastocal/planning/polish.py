"""Poses off the pool: a plan polished all at once, and what the continuum could still gain.

    min log Φ(prior + Σ_i B(q_i)ᵀB(q_i))   over q_1 … q_n, their levels and joint limits

by L-BFGS-B (Byrd, Lu, Nocedal & Zhu 1995) with the exact adjoint of B.  Poses go as
far towards the end of a search as the cell's own rules allow; those that a rule stopped are then
searched for in smaller boxes around where they stand.  B is that of simplified deflections, so
every end is evaluated exactly.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from elastocal.model.symbolic import SymbolicArm, configuration_rows
from elastocal.planning.candidates import CHUNK, JointSpace, sobol
from elastocal.planning.criteria import TangentBound, inverse
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import PoseInformation
from elastocal.planning.relaxation import DesignProblem, block_prices
from elastocal.units import Array, BoolArray, IntArray, Progress

ORDER = 30.0  # of the power means that stand for a criterion's kinks while poses move
LEAST_GAIN = 1e-8  # relative improvement of Φ that counts as one
# Shares of the way from a start to where its search ended that are tried, the rules permitting.
STEPS = (1.0, 0.9, 0.7, 0.4, 0.15)
# Half widths in rad or m of the boxes in which a round's poses are sought that a rule stopped.
REACHES = (np.inf, 0.3, 0.1)
# Of log Φ: a step that gains less is the last one; and of the last polish.
GAINS, FINE = 3e-6, 1e-8
POLISHING, CLIMBING = 150, 60  # iterations at most
MEMORY = 20  # steps that L-BFGS-B remembers

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

    def joint(self, q: Array, group: IntArray, readings: IntArray) -> JointSearch:
        if (key := group.tobytes() + readings.tobytes()) not in self._joint:
            self._joint[key] = JointSearch(self, q, group, readings)
        return self._joint[key]

    def bounds(self, group: IntArray, q: Array, reach: Array) -> tuple[Array, Array]:
        """Bounds (k, n) of poses of their levels, no further than `reach` (k,) from q (k, n)."""
        found = [self.space.bounds(int(g)) for g in group]
        lower, upper = np.array([low for low, _ in found]), np.array([high for _, high in found])
        away = reach[:, None]
        return np.clip(q - away, lower, upper), np.clip(q + away, lower, upper)

    def towards(self, q: Array, end: Array) -> tuple[Array, BoolArray]:
        """Poses as far on the way from q to `end` (k, n) as rules allow, and which they stopped."""
        part = np.where((q != end).any(axis=1), 0.0, 1.0)
        left = np.flatnonzero(part == 0)
        for step in STEPS:
            ok = self.feasible(q[left] + step * (end[left] - q[left]))
            part[left[ok]] = step
            left = left[~ok]
        return q + part[:, None] * (end - q), part < 1


class JointSearch:
    """min f(B(q_1) … B(q_k)) inside bounds, over all poses at once, which are read as `readings`
    (k, L) say."""

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
        self.whitener: Array = np.empty(0)
        self.T: Array = np.empty(0)

    def end(
        self, goal: Goal, T: Array, q: Array, lower: Array, upper: Array, most: int = POLISHING,
        gains: float = GAINS,
    ) -> Array:  # fmt: skip
        """Where the search from q (k, n) ends, or stood when f could not be evaluated any more (no
        equilibrium, singular information).

        B is that of the parameters z, y = T z, whitened by the noise at q.
        """
        self.T = T
        self.whitener = inverse(self.searches.information.noise(q, self.readings)[1])
        best, least = q, np.inf

        def f(flat: Array) -> tuple[float, Array]:
            nonlocal best, least
            at = flat.reshape(q.shape)
            value, W = goal(self.blocks(at))
            if value < least:
                best, least = at.copy(), value
            return value, self.slope(at, W).ravel()

        bounds = np.column_stack([lower.ravel(), upper.ravel()])
        how = {"maxiter": most, "ftol": gains, "gtol": 0.0, "maxcor": MEMORY}
        with contextlib.suppress(RuntimeError, np.linalg.LinAlgError):
            minimize(f, q.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options=how)
        return best

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
        now, C = smooth.slope(V)
        return float(np.log(now / phi)), -2 / now * B @ (V @ C @ V)

    def covariance_of(B: Array) -> Array:
        B = B.reshape(-1, B.shape[-1])
        return inverse(problem.prior + B.T @ B)

    def value(B: Array) -> float:
        return float(criterion.value(covariance_of(B)))

    search, B = searches.joint(q, group, readings), searches.information.blocks(q, readings) @ T
    phi, held = value(B), np.zeros(len(q), dtype=bool)
    for reach in REACHES:
        lower, upper = searches.bounds(group, q, np.where(held, reach, np.inf))
        z, held = searches.towards(
            q, search.end(goal, T, q, lower, upper, POLISHING, FINE if fine else GAINS)
        )
        moved = searches.information.blocks(z, readings) @ T
        found = value(moved)
        if found < phi * (1 - LEAST_GAIN):
            q, B, phi = z, moved, found
        else:
            q, B, phi = _one_by_one(q, B, z, moved, value)
        if not held.any():
            break
    return q


def _one_by_one(
    q: Array, B: Array, z: Array, moved: Array, value: Callable[[Array], float]
) -> tuple[Array, Array, float]:
    q, B, phi = q.copy(), B.copy(), value(B)
    for k in range(len(q)):
        was = B[k].copy()
        B[k] = moved[k]
        found = value(B)
        if found < phi * (1 - LEAST_GAIN):
            q[k], phi = z[k], found
        else:
            B[k] = was
    return q, B, phi


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
    search, here, held = (
        searches.joint(begun, at_group, begun_read),
        begun,
        np.zeros(len(begun), bool),
    )
    for reach in REACHES:
        lower, upper = searches.bounds(at_group, here, np.where(held, reach, np.inf))
        here, held = searches.towards(here, search.end(goal, T, here, lower, upper, CLIMBING))
        found.insert(0, (here, price(here, begun_read), at_group, begun_read))
        if not held.any():
            break
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
