"""Which observations does a fit of the others contradict?  Judged in turns until it stands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from elastocal.errors import ElastocalError
from elastocal.identification.chunked import each, regressor
from elastocal.identification.outlier import FALSE_ALARM
from elastocal.identification.partition import Part
from elastocal.identification.solve import Solution
from elastocal.identification.triangle import Triangle, merge

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 12
ALONE = 1e-9  # share of an observation's direction that the other observations must see


# The trimmed cost of a fit (`judge`), the observations (N,) it is of, and the fit.
Visit = tuple[float, Mask, Solution]


def verdict(
    solution: Solution,
    refit: Callable[[Mask], Solution],
    good: Mask,
    before: tuple[Visit, ...] = (),
) -> tuple[Mask, Solution]:
    """Which observations (N,) are faulty, and the fit to the others, beginning with the `good`.

    Every observation is judged against the fit to the good ones at a Bonferroni limit for the
    whole table, which makes new good ones, and so on until the verdict stands.  Where taking
    readings back in has bent the fit away from the majority, the earlier verdict stands.
    `before` are fits to others that have been judged already.
    """
    visited = list(before)
    for _ in range(ROUNDS):
        try:
            current = solution if good.all() else refit(good)
            beyond, cost = judge(solution, current, good)
        except (ElastocalError, np.linalg.LinAlgError):
            break  # that subset does not determine a valid arm: it cannot judge the others
        if beyond.sum() >= len(beyond) // 2:
            break  # no majority agrees with this fit: it cannot judge
        visited.append((cost, good, current))
        if any(np.array_equal(~beyond, mask) for _, mask, _ in visited):
            good = ~beyond
            break
        good = ~beyond
    if not visited:
        return np.zeros(len(good), dtype=bool), solution
    final = next((v for v in reversed(visited) if np.array_equal(v[1], good)), visited[-1])
    best = min(visited, key=lambda v: v[0])
    half = len(good) // 2
    if final[0] > best[0] * stats.f.isf(FALSE_ALARM, half, half):
        final = best
    return ~final[1], final[2]


def judge(whole: Solution, fitted: Solution, good: Mask) -> tuple[Mask, float]:
    """Observations (N,) beyond the limit under a fit to the `good` ones, and its trimmed cost.

    An observation in the fit is judged by its residual as if left out, any other by its
    prediction error; both have variance s² (1 ± leverage) and follow F(size, dof).  The trimmed
    cost is the sum of the smaller half of the squared lengths.

    Raises LinAlgError where the good ones do not determine the fitted parameters.
    """
    problem = whole.problem
    n, size = len(good), problem.observations.size
    kept = fitted.reduction.kept
    triangle = _inside(whole, fitted, good)
    s2 = triangle.rss / max(triangle.rows - len(kept), 1)
    alone_squared, squared = np.empty(n), np.empty(n)

    def of_part(part: Part) -> None:
        at = regressor(problem.model, part, fitted.fit.x, kept)
        WB, e = part.weights.apply(at.B), part.weights.apply(at.residual)
        Q = linalg.solve_triangular(triangle.R, WB.T, trans="T").T
        e2 = e.reshape(-1, size)
        squared[part.index] = (e2**2).sum(axis=1)
        alone_squared[part.index] = _studentised(Q.reshape(-1, size, len(kept)), e2,
                                                 good[part.index])  # fmt: skip

    for _ in each(problem.parts, of_part):
        pass
    dof = max(int(good.sum()) * size - len(kept), 1)
    trimmed = float(np.sort(squared)[: n // 2 + 1].sum())
    return alone_squared > size * s2 * stats.f.isf(FALSE_ALARM / n, size, dof), trimmed


def _inside(whole: Solution, fitted: Solution, good: Mask) -> Triangle:
    """The triangle of the good observations at the fit, whitened as the whole table is."""
    problem = whole.problem
    kept, size = fitted.reduction.kept, problem.observations.size
    if fitted.fit is whole.fit and good.all() and len(whole.fit.whitened) == len(good) * size:
        return whole.fit.triangle

    def of_part(part: Part) -> Triangle:
        at = regressor(problem.model, part, fitted.fit.x, kept)
        inside = np.repeat(good[part.index], size)
        e = part.weights.apply(at.residual)
        return Triangle.of(part.weights.apply(at.B)[inside], e[inside])

    return merge(each(problem.parts, of_part))


def _studentised(Q: Array, e: Array, good: Mask) -> Array:
    """eᵀ (I ± QQᵀ)⁻¹ e per observation: minus in the fit, plus out of it.

    Q (n, size, p), e (n, size); zero where an observation of the fit alone determines a direction.
    """
    size = e.shape[1]
    H = Q @ Q.transpose(0, 2, 1)
    spread = np.eye(size) + np.where(good, -1.0, 1.0)[:, None, None] * np.minimum(H, 1e12)
    alone = np.zeros(len(e), dtype=bool)
    # The largest eigenvalue is at most the trace: only observations of weight need theirs.
    heavy = np.flatnonzero(good & (np.trace(H, axis1=1, axis2=2) >= 0.5))
    alone[heavy] = np.linalg.eigvalsh(spread[heavy])[:, 0] < ALONE
    spread[alone] = np.eye(size)
    squared = (e * np.linalg.solve(spread, e[..., None])[..., 0]).sum(axis=1)
    return np.where(alone, 0.0, squared)
