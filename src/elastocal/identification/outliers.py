"""Readings that the noise does not explain: found by the fit of the majority, judged in turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, special

from elastocal.errors import ElastocalError, InsufficientDataError
from elastocal.identification.solve import (
    SAMPLE,
    Solution,
    is_placed,
    settle,
)
from elastocal.identification.trimmed import majority, median_scale
from elastocal.identification.weighted_problem import (
    Part,
    RFactor,
    evaluate,
    merge,
    of_some,
    part_of,
    regressor,
    residual_at,
    sample,
)
from elastocal.units import Array, BoolArray

# A reading beyond the noise, and runs of such readings.

FALSE_ALARM = 0.01  # chance that a clean table yields any faulty reading at all


@dataclass(frozen=True)
class Outlier:
    """A reading whose residual lies beyond what the noise explains."""

    line: int
    configuration: str
    marker: str
    residual: float
    ratio: float


def blocks(lines: list[int], gap: int = 3) -> list[tuple[int, int]]:
    """Runs of faulty lines, (first, last), bridging gaps of up to `gap` lines."""
    runs: list[tuple[int, int]] = []
    for line in sorted(lines):
        if runs and line - runs[-1][1] <= gap:
            runs[-1] = (runs[-1][0], line)
        else:
            runs.append((line, line))
    return runs


# Which observations does a fit of the others contradict?  Judged in turns until it stands.

ROUNDS = 12
TINY = np.finfo(float).tiny
ALONE = 1e-9  # share of an observation's direction that the other observations must see


# A fit that was judged: its trimmed cost (`judge`), the observations (N,) it is of, and itself.
Judged = tuple[float, BoolArray, Solution]


def verdict(
    solution: Solution,
    refit: Callable[[BoolArray], Solution],
    good: BoolArray,
) -> tuple[BoolArray, Solution]:
    """Which observations (N,) are faulty, and the fit to the others, beginning with the `good`.

    Every observation is judged against the fit to the good ones at a Bonferroni limit for the
    whole table, which makes new good ones, and so on until the verdict stands.  Where taking
    readings back in has bent the fit away from the majority, the earlier verdict stands.
    """
    tried: list[Judged] = []
    for _ in range(ROUNDS):
        try:
            current = solution if good.all() else refit(good)
            beyond, cost = judge(solution, current, good)
        except (ElastocalError, np.linalg.LinAlgError):
            break  # that subset does not determine a valid arm: it cannot judge the others
        if beyond.sum() >= len(beyond) // 2:
            break  # no majority agrees with this fit: it cannot judge
        tried.append((cost, good, current))
        if any(np.array_equal(~beyond, mask) for _, mask, _ in tried):
            good = ~beyond
            break
        good = ~beyond
    if not tried:
        return np.zeros(len(good), dtype=bool), solution
    final = next((v for v in reversed(tried) if np.array_equal(v[1], good)), tried[-1])
    best = min(tried, key=lambda v: v[0])
    half = len(good) // 2
    if final[0] > best[0] * special.fdtri(half, half, 1 - FALSE_ALARM):
        final = best
    return ~final[1], final[2]


def judge(whole: Solution, fitted: Solution, good: BoolArray) -> tuple[BoolArray, float]:
    """Observations (N,) beyond the limit under a fit to the `good` ones, and its trimmed cost.

    An observation in the fit is judged by its residual as if left out, any other by its
    prediction error; both have variance s² (1 ± leverage) and follow F(size, dof).  Where the
    good ones determine fewer parameters than the whole table does, the others are held, and err by
    their typical sizes: what such an error does to an observation outside the fit is no fault of
    it, and adds to its variance.  The trimmed cost is the sum of the smaller half of the squared
    lengths.

    Raises LinAlgError where the good ones do not determine the fitted parameters.
    """
    problem = whole.problem
    n, size = len(good), problem.observations.size
    kept = fitted.reduction.kept
    r_factor = _inside(whole, fitted, good)
    s2 = r_factor.rss / max(r_factor.rows - len(kept), 1)
    dof = max(int(good.sum()) * size - len(kept), 1)
    limit = size * s2 * special.fdtri(size, dof, 1 - FALSE_ALARM / n)
    most, squared = _at_most(whole, fitted, good)
    undecided = ~(most <= limit)
    beyond = np.zeros(n, dtype=bool)
    reduction, held, mixing = fitted.reduction, kept[:0], np.zeros((len(kept), 0))
    if len(kept) < len(whole.reduction.kept):
        held, mixing = reduction.dropped, reduction.mixing

    def of_part(part: Part) -> None:
        at = regressor(problem.model, part, fitted.fit.x, np.concatenate([kept, held]))
        B, e = part.weights.apply(at.B), part.weights.apply(at.residual)
        WB, beside = B[:, : len(kept)], B[:, len(kept) :]
        Q = linalg.solve_triangular(r_factor.R, WB.T, trans="T").T
        unknown = (beside - WB @ mixing) * fitted.sizes[held] / np.sqrt(max(s2, TINY))
        e2 = e.reshape(-1, size)
        squared[part.index] = (e2**2).sum(axis=1)
        beyond[part.index] = limit < studentised(
            Q.reshape(-1, size, len(kept)), e2, good[part.index],
            unknown.reshape(len(part.index), size, len(held)),
        )  # fmt: skip

    for _ in of_some(problem.parts, undecided, of_part):
        pass
    return beyond, float(np.partition(squared, n // 2)[: n // 2 + 1].sum())


def _at_most(whole: Solution, fitted: Solution, good: BoolArray) -> tuple[Array, Array]:
    """What the squared length (N,) that an observation is judged by is at most, so that few need
    their B, and the squared length of its whitened residual.

    That of an observation outside the fit is no longer than its prediction error e; eᵀ(I − H)⁻¹e of
    one in the fit no longer than that of its whole configuration, where e and the residual as if
    left out are whitened independently.  Infinite where it is not told without B.
    """
    problem, n = whole.problem, len(good)
    most, squared = np.full(n, np.inf), np.empty(n)
    if not problem.large:
        return most, squared
    if _is_of_all(whole, fitted, good):
        e = whole.fit.whitened.reshape(n, -1)
        squared = (e**2).sum(axis=1)
        if problem.parts.blocks is None:
            own = (e * problem.weights.apply(whole.heldout).reshape(n, -1)).sum(axis=1)
            code = problem.observations.configuration
            most = np.bincount(code, own)[code]
    elif good.mean() < 1 / 2:
        e = problem.weights.apply(residual_at(problem.model, problem.parts, fitted.fit.x))
        squared = (e.reshape(n, -1) ** 2).sum(axis=1)
        most[~good] = squared[~good]
    return most, squared


def _is_of_all(whole: Solution, fitted: Solution, good: BoolArray) -> bool:
    own = len(whole.fit.whitened) == len(good) * whole.problem.observations.size
    return fitted.fit is whole.fit and bool(good.all()) and own


def _inside(whole: Solution, fitted: Solution, good: BoolArray) -> RFactor:
    """The R factor of the good observations at the fit, whitened as the whole table is."""
    problem = whole.problem
    kept, size = fitted.reduction.kept, problem.observations.size
    if _is_of_all(whole, fitted, good):
        return whole.fit.r_factor

    def of_part(part: Part) -> RFactor:
        at = regressor(problem.model, part, fitted.fit.x, kept)
        inside = np.repeat(good[part.index], size)
        e = part.weights.apply(at.residual)
        return RFactor.of(part.weights.apply(at.B)[inside], e[inside])

    return merge(of_some(problem.parts, good, of_part))


def studentised(Q: Array, e: Array, good: BoolArray, unknown: Array) -> Array:
    """eᵀ (I − QQᵀ)⁻¹ e per observation of the fit, eᵀ (I + QQᵀ + UUᵀ)⁻¹ e of any other.

    Q (n, size, p), e (n, size), U `unknown` (n, size, u); zero where an observation of the fit
    alone determines a direction.
    """
    size = e.shape[1]
    H = Q @ Q.transpose(0, 2, 1)
    H[~good] += unknown[~good] @ unknown[~good].transpose(0, 2, 1)
    spread = np.eye(size) + np.where(good, -1.0, 1.0)[:, None, None] * np.minimum(H, 1e12)
    alone = np.zeros(len(e), dtype=bool)
    # The largest eigenvalue is at most the trace: only observations of weight need theirs.
    heavy = np.flatnonzero(good & (np.trace(H, axis1=1, axis2=2) >= 0.5))
    alone[heavy] = np.linalg.eigvalsh(spread[heavy])[:, 0] < ALONE
    spread[alone] = np.eye(size)
    squared = (e * np.linalg.solve(spread, e[..., None])[..., 0]).sum(axis=1)
    return np.where(alone, 0.0, squared)


# Readings that the noise does not explain: found by the fit of the majority.


def find_faulty(
    solution: Solution, refit: Callable[[BoolArray], Solution]
) -> tuple[BoolArray, Solution]:
    """Which observations (N,) are faulty, and the solution without them.

    The majority's fit of base, markers and cable to the nominal arm shows the suspects; then the
    whole model is fitted to the others and every observation judged, in turns (`verdict`).  In a
    large table the majority of a sample judges all observations first.
    """
    if not solution.problem.large:
        return verdict(solution, refit, ~_suspects(solution))

    def fit_others(good: BoolArray) -> Solution:
        return _fit_to(solution, good)

    return verdict(solution, fit_others, _agreeing_with_a_sample(solution))


def _suspects(solution: Solution) -> BoolArray:
    """Observations outside the majority of a trimmed fit of base, markers and cable alone.

    From the nominal geometry: faulty readings have bent everything else in the whole fit.
    """
    problem = solution.problem
    model, observed = problem.model, problem.observations
    placed = problem.free[is_placed(model)[problem.free]]
    x = problem.x0 if len(placed) else solution.fit.x
    at = model.regressor(observed.table, x, placed, observed)
    return ~majority(problem.weights.apply(at.B), problem.weights.apply(at.residual), observed.size)


def _agreeing_with_a_sample(solution: Solution) -> BoolArray:
    """Observations within the limit under the fit to the majority of a sample of them.

    All, where the sample does not show a parameter that the solution has.
    """
    problem = solution.problem
    every = np.ones(len(problem.observations.lead), dtype=bool)
    part = sample(problem.parts, SAMPLE)
    own = replace(problem, observations=part.observations, weights=part.weights)
    rough = replace(solution, problem=own)
    faulty, fitted = verdict(rough, lambda good: _fit_to(rough, good), ~_suspects(rough))
    shown = evaluate(problem.model, own.parts, fitted.fit.x, solution.reduction.kept).r_factor
    if not np.linalg.norm(shown.R, axis=0).all():
        return every
    inside = ~every
    inside[part.index[~faulty]] = True
    try:
        return ~judge(solution, fitted, inside)[0]
    except (ElastocalError, np.linalg.LinAlgError):
        return every


def _fit_to(solution: Solution, good: BoolArray) -> Solution:
    """The parameters chosen anew for the good observations, and fitted to them.

    An observation that is correlated with one that is not good stays out with it.
    """
    problem, blocks = solution.problem, solution.problem.parts.blocks
    if blocks is not None:
        good = good & ~np.isin(blocks, blocks[~good])
    if good.sum() <= len(good) // 2:
        raise InsufficientDataError("fewer than half of the readings agree with each other")
    part = part_of(problem.observations, problem.weights, np.flatnonzero(good))
    own = replace(problem, observations=part.observations, weights=part.weights)
    placed, found, reduction, *_ = settle(own, solution.sizes)
    return replace(solution, problem=placed, fit=found, reduction=reduction)


def describe(solution: Solution, fitted: Solution, faulty: BoolArray) -> tuple[Outlier, ...]:
    """The faulty observations with their error under the fit to the others, in table order."""
    if not faulty.any():
        return ()
    observed, model = solution.problem.observations, solution.problem.model
    error = residual_at(model, solution.problem.parts, fitted.fit.x)
    length = np.linalg.norm(error.reshape(-1, observed.size)[:, :3], axis=1)
    squared = (solution.problem.weights.apply(error).reshape(-1, observed.size) ** 2).sum(axis=1)
    sigma = median_scale(np.sqrt(squared[~faulty]), observed.size)
    table = observed.table
    return tuple(
        Outlier(
            int(table.row[observed.lead[k]]),
            table.configuration_labels[table.configuration[observed.lead[k]]],
            table.marker_names[table.marker[observed.lead[k]]],
            float(length[k]),
            float(np.sqrt(squared[k]) / sigma),
        )
        for k in np.flatnonzero(faulty)
    )
