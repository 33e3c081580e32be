"""Poses off the pool: a plan polished all at once, and what the continuum could still gain.

    min log Φ(prior + Σ_i B(q_i)ᵀB(q_i))   over q_1 … q_n, their levels and joint limits

by L-BFGS-B (Byrd, Lu, Nocedal & Zhu 1995) with the exact adjoint of B.  Poses go as far towards the
end of a search as the cell's own rules allow; those that a rule stopped are then sought in smaller
boxes around where they stand.  B is that of simplified deflections, so every end is evaluated
exactly.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from elastocal.model.symbolic import SymbolicArm, configuration_rows
from elastocal.planning.candidates import CHUNK, JointSpace, points
from elastocal.planning.criteria import TangentBound, inverse
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.relaxation import DesignProblem
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.units import Array, BoolArray, IntArray, Progress

ORDER = 30.0  # of the power means that stand for a criterion's kinks while poses move
LEAST_GAIN = 1e-8  # relative improvement of Φ that counts as one
# Shares of the way from a start to where its search ended that are tried, the rules permitting.
STEPS = (1.0, 0.9, 0.7, 0.4, 0.15)
# Half widths in rad or m of the boxes in which a round's poses are sought that a rule stopped.
REACHES = (np.inf, 0.5, 0.25, 0.1)
# Of log Φ: a step that gains less is the last one; and of the last polish.
GAINS, FINE = 3e-6, 1e-8
POLISHING, CLIMBING = 150, 60  # iterations at most
MEMORY = 20  # steps that L-BFGS-B remembers

# Blocks (k, r, p) of k poses → f and ∂f/∂B.
Goal = Callable[[Array], tuple[float, Array]]


@dataclass
class Searches:
    """What searches off the pool need to know of the cell."""

    setup: Setup
    space: JointSpace
    checker: Feasibility
    _rows: dict[int, tuple[ca.Function, ca.Function]] = field(default_factory=dict)

    def feasible(self, q: Array) -> BoolArray:
        return self.checker.under(q, self.setup.information.forces).ok

    def rows(self, q: Array, level: int) -> tuple[ca.Function, ca.Function]:
        """B (q, x) and its adjoint (q, x, W) of poses at a level, as q (n,) is."""
        if level not in self._rows:
            info = self.setup.information
            arm = SymbolicArm(info.model.chain, info.model.cell)
            self._rows[level] = configuration_rows(arm, info.rows(q[None]), info.columns)
        return self._rows[level]

    def moved(
        self, goal: Goal, T: Array, lot: FeasiblePool, most: int, gains: float,
        kept: Callable[[Array], Array],
    ) -> None:  # fmt: skip
        """Poses moved, round after round, from those of the lot to the end of a search, or as far
        towards it as rules allow, as long as there are some that these stop.  Of where a round
        brought them (k, n), `kept` tells those that the next one begins with."""
        search, q, held = JointSearch(self, T, lot), lot.q, np.zeros(len(lot), dtype=bool)
        found = [self.space.bounds(int(g)) for g in lot.group]
        lower, upper = np.array([low for low, _ in found]), np.array([high for _, high in found])
        for reach in REACHES:
            away = np.where(held, reach, np.inf)[:, None]
            bounds = np.clip(q - away, lower, upper), np.clip(q + away, lower, upper)
            end = search.end(goal, q, *bounds, most, gains)
            part = np.where((q != end).any(axis=1), 0.0, 1.0)
            left = np.flatnonzero(part == 0)
            for step in STEPS:
                ok = self.feasible(q[left] + step * (end[left] - q[left]))
                part[left[ok]] = step
                left = left[~ok]
            q, held = kept(q + part[:, None] * (end - q)), part < 1
            if not held.any():
                return


class JointSearch:
    """min f(B(q_1) … B(q_k)) inside bounds, over all poses of a `lot` at once.

    B is that of the parameters z, y = T z, whitened by the noise of the lot; what is not read of a
    pose has next to no weight by that.
    """

    def __init__(self, searches: Searches, T: Array, lot: FeasiblePool) -> None:
        self.info, self.T, self.maps = searches.setup.information, T, []
        self.whitener = inverse(self.info.noise(lot.q, lot.readings)[1])
        # B differs where a joint's compliance is split by level.
        kinds = lot.group if self.info.model.cell.model.compliance_levels else 0 * lot.group
        for kind in np.unique(kinds):
            own = np.flatnonzero(kinds == kind)
            B, adjoint = searches.rows(lot.q[own[0]], int(kind))
            self.maps.append((own, B.map(len(own)), adjoint.map(len(own))))

    def end(
        self, goal: Goal, q: Array, lower: Array, upper: Array, most: int, gains: float
    ) -> Array:
        """Where the search from q (k, n) ends, or stood when f could not be evaluated any more (no
        equilibrium, singular information)."""
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
        found = np.empty((*self.whitener.shape[:2], len(self.T)))
        for own, B, _ in self.maps:
            raw = B(q[own].T, np.tile(self.info.x[:, None], len(own))).full()
            found[own] = raw.reshape(len(raw), len(own), -1).swapaxes(0, 1)
        return np.asarray(self.whitener @ found * self.info.sizes @ self.T)

    def slope(self, q: Array, W: Array) -> Array:
        """∂/∂q (k, n) of ⟨W, blocks(q)⟩, W (k, r, p)."""
        total = np.empty_like(q)
        raw = self.whitener.swapaxes(-1, -2) @ W @ self.T.T * self.info.sizes
        for own, _, adjoint in self.maps:
            weights = raw[own].swapaxes(0, 1).reshape(raw.shape[1], -1)
            x = np.tile(self.info.x[:, None], len(own))
            total[own] = adjoint(q[own].T, x, weights).full().T
        return total


def polish(
    problem: DesignProblem, searches: Searches, T: Array, plan: FeasiblePool, fine: bool = False
) -> Array:
    """The plan's poses (k, n) moved to a local optimum of Φ, `problem` being that of the parameters
    z, y = T z; `fine`: until nothing is gained any more."""
    criterion = problem.criterion
    smooth = criterion.softened(ORDER)

    def covariance_of(B: Array) -> Array:
        B = B.reshape(-1, B.shape[-1])
        return inverse(problem.prior + B.T @ B)

    def value(B: Array) -> float:
        return float(criterion.value(covariance_of(B)))

    def goal(B: Array) -> tuple[float, Array]:
        V = covariance_of(B)
        now, C = smooth.slope(V)
        return float(np.log(now / phi)), -2 / now * B @ (V @ C @ V)

    q, B = plan.q.copy(), plan.blocks @ T
    phi = value(B)

    def kept(z: Array) -> Array:
        """The poses z all together, or else one by one, where they gain."""
        nonlocal phi
        moved = searches.setup.information.blocks(z, plan.readings) @ T
        for own in (slice(None), *range(len(q))):
            was = B[own].copy()
            B[own] = moved[own]
            if (found := value(B)) < phi * (1 - LEAST_GAIN):
                q[own], phi = z[own], found
            else:
                B[own] = was
        return q

    searches.moved(goal, T, plan, POLISHING, FINE if fine else GAINS, kept)
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


def estimate(
    problem: DesignProblem, tangent: TangentBound, searches: Searches, T: Array,
    pool: FeasiblePool, seed: int = 0, progress: Progress = lambda message: None,
) -> dict[str, Any]:  # fmt: skip
    """The largest d on the continuum per group, for the tangent (Φ, G) of the optimum of the `pool`
    with its `problem`; every maximum is evaluated exactly and passed by the cell's rules.

    `bound` on Φ from it: an estimate, as a larger d may have been missed.  `q`, `group` and
    `readings` of feasible poses whose d exceeds all of the pool's, by `searched` new points and
    `ascents` local searches.
    """

    def price(lot: FeasiblePool) -> Array:
        B = lot.blocks @ T
        return np.asarray(((B @ tangent.G) * B).sum(axis=(1, 2)))

    def goal(B: Array) -> tuple[float, Array]:
        """Uphill in d(q), of each pose in its own unit."""
        priced = B @ tangent.G / unit[:, None, None]
        return -float((priced * B).sum()), -2 * priced

    setup, d = searches.setup, problem.prices(tangent.G)
    streams = np.random.SeedSequence(seed).spawn(len(problem.shares))
    levels, starts, lots = np.flatnonzero(problem.shares).tolist(), [], []
    chunks = -(-POINTS // CHUNK)
    for group in levels:
        progress(f"searching the continuum, level {group + 1} of {len(problem.shares)}")
        q = np.concatenate([*islice(points(searches.space, group, streams[group]), chunks)])
        new = setup.pool(q, np.full(len(q), group))
        order, good = np.argsort(-price(new), kind="stable"), np.zeros(0, dtype=np.int64)
        for part in np.split(order[: LOT * LOTS], LOTS):
            good = np.append(good, part[searches.feasible(new.q[part])])
            if len(distinct(new.q[good], STARTS)) == STARTS:
                break
        lots.append(new.take(good))
        both = FeasiblePool.join([lots[-1], pool.take(problem.group == group)])
        order = np.argsort(-price(both), kind="stable")
        starts.append(both.take(order[distinct(both.q[order], STARTS)]))
    begun = FeasiblePool.join(starts)
    unit = price(begun)

    def kept(here: Array) -> Array:
        lots.append(setup.pool(here, begun.group, begun.readings))
        return here

    searches.moved(goal, T, begun, CLIMBING, EXCESS, kept)
    every, largest, better = FeasiblePool.join(lots), np.zeros(len(problem.shares)), []
    values = price(every)
    for group in levels:
        top = d[problem.group == group].max()
        own = np.flatnonzero((every.group == group) & (values > top * (1 + EXCESS)))
        own = own[np.argsort(-values[own], kind="stable")]
        better.append(own[distinct(every.q[own], len(own))])
        largest[group] = max(top, values[own].max(initial=0.0))
    bound = tangent.bound(problem.prior, float(problem.shares @ largest))
    found, searched = every.take(np.concatenate(better)), len(levels) * CHUNK * chunks
    poses = {"q": found.q, "group": found.group, "readings": found.readings}
    return poses | {"bound": bound, "searched": searched, "ascents": len(begun)}


def distinct(q: Array, count: int) -> IntArray:
    """Indices of the first `count` poses of q (N, n) that lie `APART` from those before."""
    chosen: list[int] = []
    for i, pose in enumerate(q):
        if len(chosen) == count:
            break
        if all(np.abs(pose - q[k]).max() > APART for k in chosen):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)
