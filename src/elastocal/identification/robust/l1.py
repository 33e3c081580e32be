"""Least absolute values, and the least sum of Euclidean lengths, with a certificate.

    minimise  Σ |e_i|,  e = y − B x         dual:  maximise Σ y_iᵀ λ_i,  Bᵀ λ = 0,  |λ_i| ≤ 1

Any feasible λ bounds the minimum from below, so the gap Σ|e_i| − yᵀλ proves how good x is.
For size 1 the dual is a linear program in n bounded variables with p equations.  For vectors it
is a second-order cone program, solved by smoothing: at the minimum of Σ s_i, s_i = √(|e_i|² + ε²),
λ_i = e_i/s_i is feasible and the gap at most n ε; ε falls to rounding.  Newton's method solves
for x and λ in s_i λ_i = e_i together (Chan, Golub and Mulet 1999), which unlike Newton for x alone
is not slowed down where observations are met exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from elastocal.errors import ElastocalError
from elastocal.identification.robust.design import Design, lengths
from elastocal.identification.robust.estimate import RobustEstimate
from elastocal.identification.robust.loss import Absolute
from elastocal.identification.robust.scale import median_scale

Array = NDArray[np.float64]

OPTIMAL = 5e-6  # relative duality gap that counts as solved
ENOUGH = 1e-9  # gap at which to stop; met exactly by many observations, rounding may forbid it
SMOOTHING = 1e-9  # last ε in units of the scale
MAX_NEWTON = 400


def least_absolute(problem: Design, loss: Absolute, scale: float | None = None) -> RobustEstimate:
    """Minimise the sum of |e_i|; `optimality` is the duality gap over the minimum.

    `scale` (by default the median's) is only reported: x does not depend on it.
    """
    z, dual, count = _linear_program(problem) if problem.size == 1 else _newton(problem)
    r = problem.residual(z)
    length = lengths(r, problem.size)
    optimality = _gap(problem, r, dual)
    sigma = scale or max(median_scale(length, problem.size), problem.floor)
    x = problem.parameters(z)
    return RobustEstimate(problem, loss, x, r, sigma, optimality <= OPTIMAL, count, optimality)


def _gap(problem: Design, r: Array, dual: Array) -> float:
    """Duality gap over the minimum, less what rounding of y may leave of both."""
    minimum = float(lengths(r, problem.size).sum())
    rounding = 30 * len(r) * problem.floor
    gap = minimum - float(problem.y @ _feasible(problem, dual))
    return max(gap - rounding, 0.0) / max(minimum, rounding)


def _feasible(problem: Design, dual: Array) -> Array:
    """The nearest λ with Bᵀλ = 0, shrunk until every |λ_i| ≤ 1."""
    projected = dual - problem.Q @ (problem.Q.T @ dual)
    return projected / max(1.0, float(lengths(projected, problem.size).max()))


def _linear_program(problem: Design) -> tuple[Array, Array, int]:
    """z, the optimal λ and the simplex steps; z are the multipliers of Qᵀλ = 0."""
    Q = problem.Q
    first = problem.residual(Q.T @ problem.y)
    unit = max(float(np.abs(first).mean()), problem.floor)  # HiGHS has absolute tolerances
    found = optimize.linprog(
        -first / unit, A_eq=Q.T, b_eq=np.zeros(problem.p), bounds=(-1, 1), method="highs-ds"
    )
    if not found.success:
        raise ElastocalError(f"the L1 linear program was not solved: {found.message}")
    z = Q.T @ problem.y - unit * np.asarray(found.eqlin.marginals)
    return _vertex(problem, z), np.asarray(found.x), int(found.nit)


def _vertex(problem: Design, z: Array) -> Array:
    """z moved to the exact vertex, where p residuals vanish, unless that costs."""
    r = problem.residual(z)
    through = np.argsort(np.abs(r))[: problem.p]
    try:
        exact = z + linalg.solve(problem.Q[through], r[through])
    except (linalg.LinAlgError, linalg.LinAlgWarning):
        return z
    return exact if np.abs(problem.residual(exact)).sum() <= np.abs(r).sum() else z


def _newton(problem: Design) -> tuple[Array, Array, int]:
    """z with the smallest certified gap, its λ and the number of steps."""
    Q, size = problem.Q, problem.size
    Q3 = Q.reshape(-1, size, problem.p)
    z = Q.T @ problem.y
    r = problem.residual(z)
    scale = max(median_scale(lengths(r, size), size), problem.floor)
    smoothing, count = scale, 0
    s = np.hypot(lengths(r, size), smoothing)
    dual = r / problem.rows(s)
    best = np.inf, z, dual
    while count < MAX_NEWTON:
        weight = 1 / problem.rows(s)
        gradient = -(Q.T @ (r * weight))
        along_r = np.einsum("nij,ni->nj", Q3, r.reshape(-1, size)) / s[:, None] ** 2
        along_dual = np.einsum("nij,ni->nj", Q3, dual.reshape(-1, size))
        mixed = along_r.T @ along_dual
        hessian = (Q.T * weight) @ Q - (mixed + mixed.T) / 2
        step = -linalg.lstsq(hessian, gradient)[0]
        slope = float(gradient @ step)
        share = _line_search(problem, z, step, slope, smoothing, float(s.sum()))
        toward = weight * (r - Q @ step + dual * problem.rows(along_r @ step) * problem.rows(s))
        dual = toward / problem.rows(np.maximum(lengths(toward, size), 1.0))
        z = z + share * step
        r = problem.residual(z)
        count += 1
        s = np.hypot(lengths(r, size), smoothing)
        for proof in (dual, r / problem.rows(s)):
            gap = _gap(problem, r, proof)
            if gap < best[0]:
                best = gap, z, proof
        if best[0] <= ENOUGH:
            break
        if share < 1e-3 or -slope <= 1e-3 * smoothing * len(s):
            if smoothing <= SMOOTHING * scale:
                break
            smoothing = max(smoothing / 5, SMOOTHING * scale)
            s = np.hypot(lengths(r, size), smoothing)
    return best[1], best[2], count


def _line_search(
    problem: Design, z: Array, step: Array, slope: float, smoothing: float, cost: float
) -> float:
    """Largest of 1, ½, ¼, … that lowers Σ s_i enough; 0 where rounding lets none."""
    share = 1.0
    while share > 1e-8:
        r = problem.residual(z + share * step)
        lowered = float(np.hypot(lengths(r, problem.size), smoothing).sum())
        if lowered <= cost + 1e-4 * share * slope:
            return share
        share /= 2
    return 0.0
