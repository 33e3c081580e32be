"""Readings that the noise does not explain: found by the fit of the majority."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from elastocal.errors import ElastocalError
from elastocal.identification.result import Outlier
from elastocal.identification.solve import Solution, is_placed
from elastocal.identification.trimmed import majority, median_scale

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FALSE_ALARM = 0.01  # chance that a clean table yields any outlier at all
ROUNDS = 12


def find_faulty(solution: Solution, refit: Callable[[Mask], Solution]) -> tuple[Mask, Solution]:
    """Which observations (N,) are faulty, and the solution without them.

    A trimmed fit of base, markers and cable to the nominal arm shows the suspects; then the whole
    model is fitted to the others, every observation is judged against that fit at a Bonferroni
    limit for the whole table, and so on until the verdict stands.  Where taking readings back in
    has bent the fit away from the majority, the earlier verdict stands.
    """
    good = ~_suspects(solution)
    visited: list[tuple[float, Mask, Solution]] = []
    for _ in range(ROUNDS):
        try:
            current = solution if good.all() else refit(good)
            beyond, cost = _judge(solution, current, good)
        except ElastocalError:
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


def _suspects(solution: Solution) -> Mask:
    """Observations outside the majority of a trimmed fit of base, markers and cable alone.

    From the nominal geometry: faulty readings have bent everything else in the whole fit.
    """
    problem = solution.problem
    model, seen = problem.model, problem.observations
    placed = problem.free[is_placed(model)[problem.free]]
    if not len(placed):
        return ~majority(np.zeros((len(seen.value), 0)), solution.fit.whitened, seen.size)
    at = model.regressor(seen.table, problem.x0, placed, seen)
    B = problem.weights.apply(at.B)
    scale = np.linalg.norm(B, axis=0)
    residual = problem.weights.apply(at.residual)
    return ~majority(B / np.where(scale > 0, scale, 1.0), residual, seen.size)


def _judge(whole: Solution, fitted: Solution, good: Mask) -> tuple[Mask, float]:
    """Observations beyond the limit under a fit to the `good` ones, and the trimmed cost of it.

    An observation in the fit is judged by its residual as if left out, any other by its
    prediction error; both have variance s² (1 ± leverage) and follow F(size, dof).  The trimmed
    cost is the sum of the smaller half of the squared lengths.
    """
    seen, model = whole.problem.observations, whole.problem.model
    n, size = len(good), seen.size
    kept = fitted.reduction.kept
    at = model.regressor(seen.table, fitted.fit.x, kept, seen)
    weights = whole.problem.weights
    B, e = weights.apply(at.B), weights.apply(at.residual)
    inside = np.repeat(good, size)
    R = linalg.qr(B[inside] * fitted.sizes[kept], mode="r")[0][: len(kept)]
    Q = linalg.solve_triangular(R, (B * fitted.sizes[kept]).T, trans="T").T
    Q3 = Q.reshape(n, size, -1)
    H = Q3 @ Q3.transpose(0, 2, 1)
    sign = np.where(good, -1.0, 1.0)[:, None, None]
    spread = np.eye(size) + sign * np.minimum(H, 1e12)
    alone = np.linalg.eigvalsh(spread)[:, 0] < 1e-9
    spread[alone] = np.eye(size)
    e2 = e.reshape(n, size)
    squared = (e2 * np.linalg.solve(spread, e2[..., None])[..., 0]).sum(axis=1)
    dof = max(int(inside.sum()) - len(kept), 1)
    s2 = float(e[inside] @ e[inside]) / dof
    squared[alone] = 0.0
    trimmed = float(np.sort((e2**2).sum(axis=1))[: n // 2 + 1].sum())
    return squared > size * s2 * stats.f.isf(FALSE_ALARM / n, size, dof), trimmed


def describe(solution: Solution, fitted: Solution, faulty: Mask) -> tuple[Outlier, ...]:
    """The faulty observations with their error under the fit to the others, in table order."""
    seen, model = solution.problem.observations, solution.problem.model
    error = seen.value - model.predict(seen.table, fitted.fit.x, seen)
    length = np.linalg.norm(error.reshape(-1, seen.size)[:, :3], axis=1)
    squared = (solution.problem.weights.apply(error).reshape(-1, seen.size) ** 2).sum(axis=1)
    sigma = median_scale(squared[~faulty], seen.size)
    table = seen.table
    return tuple(
        Outlier(
            int(table.row[seen.lead[k]]),
            table.configuration_labels[table.configuration[seen.lead[k]]],
            table.marker_names[table.marker[seen.lead[k]]],
            float(length[k]),
            float(np.sqrt(squared[k]) / sigma),
        )
        for k in np.flatnonzero(faulty)
    )


def blocks(lines: list[int], gap: int = 3) -> list[tuple[int, int]]:
    """Runs of faulty lines, (first, last), bridging gaps of up to `gap` lines."""
    runs: list[tuple[int, int]] = []
    for line in sorted(lines):
        if runs and line - runs[-1][1] <= gap:
            runs[-1] = (runs[-1][0], line)
        else:
            runs.append((line, line))
    return runs
