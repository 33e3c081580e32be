"""Newton's method for a few hundred candidates: a primal–dual interior point with exact Hessian.

    minimise max_j f_j(w),  f_j = log Φ_j(M(w)),   subject to  E w = n,  0 ≤ w ≤ u.

f_j is convex since 1/Φ_j is concave; E (L, k) sums the weights of each level.  For σ → 0 the
barrier function

    F_σ(w) = min_τ [τ − σ Σ_j log(τ − f_j)] − σ Σ_i log w_i − σ Σ_i log(u − w_i)

is minimised by Newton steps in which the barrier's own curvatures σ/s_j², σ/w_i², σ/(u − w_i)² are
replaced by μ_j/s_j, z_i/w_i, y_i/(u − w_i) with multipliers that follow their own Newton steps;
s_j = τ − f_j.  F_σ decreases in every step, so that no start can fail, and the multipliers give
the fast last steps and the bound.  Boyd & Vandenberghe, Convex Optimization (2004), ch. 11;
Wächter & Biegler, Math. Program. 106 (2006) 25, for keeping the multipliers near σ/w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from elastocal.planning.criterion import Criterion, Gradient, ScenarioCriterion, Term, Worst
from elastocal.planning.selection_problem import largest_sum
from elastocal.units import Array, IntArray

MOST_STEPS = 100
TO_BOUNDARY = 0.99
# Reduction of σ, once the decrement λ² of Newton's step is below CENTRED · σ · (constraints).
REDUCTION = 0.1
CENTRED = 0.3
# and no multiplier further than this |log| from σ/slack.
SPREAD = 2.0
ARMIJO = 1e-4
# A gap that should be below the accuracy is, for σ below this part of it, hidden by rounding.
FINEST = 1e-2
# Multipliers stay within this factor of σ/slack.
NEAR = 1e4
# Relative to the mean diagonal of the Hessian: keeps it definite to rounding.
RIDGE = 1e-14


@dataclass(frozen=True)
class Restricted:
    """Candidates A (S, k, p, p) in levels (k,) 0 … L−1 with shares (L,), each at most `most`.

    `base` (S, p, p): information that does not depend on their weights.
    """

    A: Array
    base: Array
    level: IntArray
    shares: IntArray
    most: int

    def information(self, w: Array) -> Array:
        return self.base + np.tensordot(self.A, w, (1, 0))

    def relative(self, w: Array) -> Array:
        """w_i as a part of the largest weight of its level."""
        largest = np.zeros(len(self.shares))
        np.maximum.at(largest, self.level, w)
        return np.asarray(w / largest[self.level])

    def inside(self, w: Array, depth: float) -> Array:
        """w ≥ 0 scaled to the shares and moved off its bounds, `depth` of the way to even ones."""
        size = np.bincount(self.level)
        total = np.bincount(self.level, w)
        scale = self.shares / np.where(total > 0.0, total, np.inf)
        clipped = np.minimum(w * scale[self.level], self.most)
        filled = np.bincount(self.level, clipped)
        missing = np.maximum(self.shares - filled, 0.0)
        part = missing / np.maximum(self.most * size - filled, np.finfo(float).tiny)
        full = clipped + part[self.level] * (self.most - clipped)
        return np.asarray((1.0 - depth) * full + depth * (self.shares / size)[self.level])


@dataclass(frozen=True)
class SmoothPieces:
    """Φ(M) = max_j Φ_j, Φ_j = Σ_t mix_jt φ_t(M_s(t)⁻¹).

    `terms`: one Term per scenario s; the columns of `mix` (J, T) ≥ 0 are their functions in order.
    One row is a smooth criterion (a mean over scenarios), the identity the worst case.
    """

    terms: tuple[Term, ...]
    mix: Array

    def at(self, M: Array) -> LocalPieces | None:
        """Φ_j and derivatives at M (S, p, p); None where M is not positive definite."""
        try:
            root = np.linalg.inv(np.linalg.cholesky(M))
        except np.linalg.LinAlgError:
            return None
        V = root.transpose(0, 2, 1) @ root
        slopes = [term.slope(V_s) for term, V_s in zip(self.terms, V, strict=True)]
        values = self.mix @ np.concatenate([value for value, _ in slopes])
        if not np.all(np.isfinite(values)):
            return None
        return LocalPieces(self, V, values, [C for _, C in slopes])


@dataclass(frozen=True)
class LocalPieces:
    """The pieces at one M: V (S, p, p), `values` Φ_j (J,), C = ∂φ/∂V of each scenario's terms."""

    pieces: SmoothPieces
    V: Array
    values: Array
    C: list[Array]

    def shares(self, mu: Array) -> list[Array]:
        """Σ_j μ_j mix_jt/Φ_j (T_s,) per scenario: how much each term counts in Σ μ_j log Φ_j."""
        counts = np.cumsum([term.count for term in self.pieces.terms])[:-1]
        return list(np.split((mu / self.values) @ self.pieces.mix, counts))

    def slopes(self, A: Array) -> Array:
        """−∂ log Φ_j/∂w_i (J, k) for A (S, k, p, p)."""
        of_terms = []
        for V, C, A_s in zip(self.V, self.C, A, strict=True):
            G = V @ C @ V
            of_terms.append(G.reshape(len(G), -1) @ A_s.reshape(len(A_s), -1).T)
        return np.asarray(self.pieces.mix @ np.concatenate(of_terms)) / self.values[:, None]

    def tangent(self, mu: Array) -> Gradient:
        """Φ_μ = Σ c_j Φ_j ≤ Φ with c_j ∝ μ_j/Φ_j, Σ c_j = 1, and its G.

        1/Φ_μ is concave as 1/Φ is, so the tangent bounds Φ too; at the optimum, where μ are the
        multipliers, it is tight, while a single piece would not be.
        """
        scale = 1.0 / np.sum(mu / self.values)
        shares = self.shares(mu)
        C = np.stack([np.tensordot(c, C, 1) for c, C in zip(shares, self.C, strict=True)])
        return Gradient(float(scale * mu.sum()), scale * (self.V @ C @ self.V))

    def hessian(self, A: Array, mu: Array, slopes: Array) -> Array:
        """Σ_j μ_j ∂² log Φ_j/∂w_i∂w_j (k, k); `slopes` (J, k) as from `slopes`."""
        k = A.shape[1]
        H = -(slopes.T * mu) @ slopes
        for term, share, V, C, A_s in zip(
            self.pieces.terms, self.shares(mu), self.V, self.C, A, strict=True
        ):
            AV = A_s @ V
            G = V @ np.tensordot(share, C, 1) @ V
            # tr(A_i V A_j G): A_i V beside the transpose of A_j G.
            H += 2.0 * AV.reshape(k, -1) @ (A_s @ G).transpose(0, 2, 1).reshape(k, -1).T
            curvature = term.curvature(V, V @ AV)
            if curvature is not None:
                H += share[0] * curvature
        return 0.5 * (H + H.T)


def pieces_of(criterion: Criterion, scenarios: int) -> SmoothPieces | None:
    """The criterion as a maximum of smooth pieces, from its terms; None where it is none.

    These are E and its O3, whose pieces would be all directions, and the mean over several
    scenarios of a maximum.
    """
    worst = isinstance(criterion, Worst) or scenarios == 1
    if isinstance(criterion, Worst) and criterion.order != np.inf:
        return None
    base = criterion.base if isinstance(criterion, Worst) else criterion
    assert isinstance(base, ScenarioCriterion)
    terms = []
    for s in range(scenarios):
        term = base.term(s)
        if term is None or not (worst or term.count == 1):
            return None
        terms.append(term)
    count = sum(term.count for term in terms)
    return SmoothPieces(tuple(terms), np.eye(count) if worst else np.full((1, count), 1.0 / count))


@dataclass(frozen=True)
class BarrierPoint:
    """w (k,) inside its bounds, the pieces there, their slacks s (J,) and F_σ as `merit`."""

    w: Array
    local: LocalPieces
    s: Array
    merit: float


@dataclass
class Multipliers:
    """μ (J,) of the pieces, z (k,) of w ≥ 0 and y (k,) of w ≤ u."""

    mu: Array
    z: Array
    y: Array

    @classmethod
    def central(cls, point: BarrierPoint, room: Array, sigma: float) -> Multipliers:
        return cls(sigma / point.s, sigma / point.w, sigma / room)

    def move(self, change: Multipliers, central: Multipliers) -> None:
        """A step that keeps all positive, then back to within NEAR of the central values."""
        pairs = [(self.mu, change.mu), (self.z, change.z), (self.y, change.y)]
        length = min(_step_to_boundary(value, step) for value, step in pairs)
        for (value, step), centre in zip(pairs, (central.mu, central.z, central.y), strict=True):
            np.clip(value + length * step, centre / NEAR, centre * NEAR, out=value)

    def spread(self, central: Multipliers) -> float:
        """The largest |log| of the ratio to the central values."""
        pairs = [(self.mu, central.mu), (self.z, central.z), (self.y, central.y)]
        return max(float(np.abs(np.log(value / centre)).max()) for value, centre in pairs)


def solve(
    pieces: SmoothPieces, task: Restricted, start: Array, accuracy: float
) -> tuple[Array, Array]:
    """Weights w (k,) whose log Φ is within `accuracy` of the least, and multipliers μ (J,).

    `start` (k,) strictly inside its bounds with the right sums per level.
    """
    local = pieces.at(task.information(start))
    assert local is not None  # every support sees what the pool sees
    count = 2 * len(start) + len(local.values)
    mu = np.full(len(local.values), 1.0 / len(local.values))
    gap = _gap(task, start, local, mu, local.slopes(task.A))
    if gap <= accuracy:
        return start, mu
    sigma = gap / count
    point = _barrier(local, task, start, sigma)
    at = Multipliers.central(point, task.most - start, sigma)
    best = (gap, start, mu)
    for _ in range(MOST_STEPS):
        slopes = point.local.slopes(task.A)
        gap = _gap(task, point.w, point.local, at.mu, slopes)
        if gap < best[0]:
            best = (gap, point.w, at.mu.copy())
        if gap <= accuracy or sigma * count < FINEST * accuracy:
            break
        change, direction, decrement = _newton(task, point, at, slopes, sigma)
        # Where rounding hides any decrease of F the multipliers still have to settle.
        point = _search(pieces, task, point, direction, decrement, sigma) or point
        central = Multipliers.central(point, task.most - point.w, sigma)
        at.move(change, central)
        if decrement <= CENTRED * count * sigma and at.spread(central) <= SPREAD:
            sigma *= REDUCTION
            point = _barrier(point.local, task, point.w, sigma)
    return best[1], best[2] / best[2].sum()


def _newton(
    task: Restricted, point: BarrierPoint, at: Multipliers, slopes: Array, sigma: float
) -> tuple[Multipliers, Array, float]:
    """Steps of the multipliers and of w (k,), and the decrement −∇F·Δw."""
    w, room, s = point.w, task.most - point.w, point.s
    K = point.local.hessian(task.A, at.mu, slopes)
    stiff = at.mu / s
    centred = slopes - stiff @ slopes / stiff.sum()
    K += (centred.T * stiff) @ centred
    K[np.diag_indices_from(K)] += at.z / w + at.y / room + RIDGE * np.trace(K) / len(K)
    gradient = -(sigma / s) @ slopes - sigma / w + sigma / room

    factor = cho_factor(K, lower=True, overwrite_a=True, check_finite=False)
    E = (task.level == np.arange(len(task.shares))[:, None]).astype(float)
    solved = cho_solve(factor, np.column_stack([gradient, E.T]), check_finite=False)
    lam = np.linalg.solve(E @ solved[:, 1:], E @ solved[:, 0])
    dw = solved[:, 1:] @ lam - solved[:, 0]
    change = Multipliers(
        sigma / s - at.mu - stiff * (centred @ dw),
        sigma / w - at.z * (1.0 + dw / w),
        sigma / room - at.y * (1.0 - dw / room),
    )
    return change, dw, float(-gradient @ dw)


def _search(
    pieces: SmoothPieces,
    task: Restricted,
    point: BarrierPoint,
    dw: Array,
    decrement: float,
    sigma: float,
) -> BarrierPoint | None:
    """The longest of halved steps that decreases F_σ enough; None where rounding allows none."""
    length = min(_step_to_boundary(point.w, dw), _step_to_boundary(task.most - point.w, -dw))
    while length > 1e-10:
        w = point.w + length * dw
        local = pieces.at(task.information(w))
        if local is not None:
            moved = _barrier(local, task, w, sigma)
            if moved.merit <= point.merit - ARMIJO * length * decrement:
                return moved
        length *= 0.5
    return None


def _barrier(local: LocalPieces, task: Restricted, w: Array, sigma: float) -> BarrierPoint:
    """F_σ at w; τ solves Σ_j σ/(τ − f_j) = 1 by Newton's method from the left."""
    f = np.log(local.values)
    below = f.max() - f
    excess = sigma
    for _ in range(50):
        s = below + excess
        missing = np.sum(sigma / s) - 1.0
        if missing <= 1e-14:
            break
        excess += missing / np.sum(sigma / s**2)
    logs = np.log(s).sum() + np.log(w).sum() + np.log(task.most - w).sum()
    return BarrierPoint(w, local, s, float(f.max() + excess - sigma * logs))


def _gap(task: Restricted, w: Array, local: LocalPieces, mu: Array, slopes: Array) -> float:
    """log Φ(w) minus the bound (see `certificate`) of the restricted problem."""
    d = mu @ slopes / mu.sum()
    gain = largest_sum(d, task.level, task.shares, task.most) - d @ w
    below = mu.sum() / np.sum(mu / local.values)
    return float(np.log(local.values.max() / below) + np.log1p(gain))


def _step_to_boundary(value: Array, step: Array) -> float:
    """The longest step in (0, 1] that leaves 1 % of every positive value."""
    shrink = np.min(step / value)
    return 1.0 if shrink >= -TO_BOUNDARY else float(-TO_BOUNDARY / shrink)


class NewtonMaster:
    """The master problem by this interior point."""

    def __init__(self, pieces: SmoothPieces) -> None:
        self._pieces = pieces

    def __call__(self, task: Restricted, start: Array, accuracy: float) -> tuple[Array, Gradient]:
        w, mu = solve(self._pieces, task, start, accuracy)
        local = self._pieces.at(task.information(w))
        assert local is not None  # `solve` returns only points where it is
        return w, local.tangent(mu)
