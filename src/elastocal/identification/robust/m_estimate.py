"""M-estimates: iteratively reweighted least squares with the scale estimated alongside."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import require
from elastocal.identification.robust.design import Design, design, lengths
from elastocal.identification.robust.estimate import RobustEstimate, score_optimality
from elastocal.identification.robust.l1 import least_absolute
from elastocal.identification.robust.loss import Absolute, Loss
from elastocal.identification.robust.scale import m_scale, median_scale, proposal_2
from elastocal.identification.robust.tuning import breakdown_bisquare

Array = NDArray[np.float64]
ScaleRule = Literal["median", "proposal2", "m"]

TOLERANCE = 1e-11  # of the step |B δx| in units of the scale
MAX_ITER = 500


def m_estimate(
    B: ArrayLike,
    y: ArrayLike,
    loss: Loss,
    *,
    size: int = 1,
    scale: ScaleRule | float = "median",
    start: ArrayLike | None = None,
    tolerance: float = TOLERANCE,
    max_iter: int = MAX_ITER,
) -> RobustEstimate:
    """Solve Σ B_iᵀ Ψ(e_i/σ) = 0, e = y − B x, Ψ(r) = ψ(|r|) r/|r| (Huber 1981, chapter 7).

    B (n·size, p) and y (n·size,) whitened, `size` rows per observation.  `scale` is a rule, by
    which σ is estimated anew from every residual ("median": the MAD about zero; "proposal2"
    Huber's; "m": the M-scale of the 50 % bisquare), or the known σ.  `start` (p,), by default
    least squares.

    The breakdown point is that of the start and of the leverage: a monotone ψ (Huber, L1) has
    one solution and resists errors in y but not at leverage points; a redescending one finds the
    solution near the start, so bisquare belongs after an S-estimate (`mm_estimate`).  With
    `Absolute` the scale plays no part in x and the minimum is certified (`l1`).

    Raises InputError for wrong shapes, dependent columns, a loss for another size or a scale
    that is not positive; InsufficientDataError where rejection leaves too little.
    """
    problem = design(B, y, size)
    require(
        loss.size == size, f"the loss is for {loss.size} rows per observation, the data have {size}"
    )
    require(tolerance > 0 and max_iter >= 1, "tolerance must be positive, max_iter at least 1")
    known = _known(scale)
    if isinstance(loss, Absolute):
        return least_absolute(problem, loss, known)
    z = problem.Q.T @ problem.y if start is None else problem.coordinates(_checked(start, problem))
    return reweighted(problem, loss, z, known or scale, tolerance, max_iter)


def reweighted(
    problem: Design,
    loss: Loss,
    z: Array,
    rule: ScaleRule | float | str,
    tolerance: float = TOLERANCE,
    max_iter: int = MAX_ITER,
) -> RobustEstimate:
    """IRLS from coordinates z; each step lowers Σ ρ at its scale (Huber 1981, section 7.8)."""
    r = problem.residual(z)
    sigma = _scale(problem, r, rule)
    converged, count = False, 0
    while not converged and count < max_iter:
        weights = loss.weight(lengths(r, problem.size) / sigma)
        step = problem.weighted_step(weights, r)
        z = z + step
        r = problem.residual(z)
        before, sigma = sigma, _scale(problem, r, rule)
        count += 1
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)  # no more digits in z
        settled = moved <= tolerance * sigma and abs(sigma - before) <= tolerance * sigma
        converged = bool(settled or still)
    optimality = score_optimality(problem, loss, r, sigma)
    return RobustEstimate(
        problem, loss, problem.parameters(z), r, sigma, converged, count, optimality
    )


def _scale(problem: Design, residual: Array, rule: ScaleRule | float | str) -> float:
    if not isinstance(rule, str):
        return rule
    length = lengths(residual, problem.size)
    if rule == "median":
        found = median_scale(length, problem.size)
    elif rule == "proposal2":
        found = proposal_2(length, problem.size, problem.p)
    else:
        found = m_scale(length, breakdown_bisquare(problem.size), problem.p)
    return max(found, problem.floor)


def _known(scale: ScaleRule | float) -> float | None:
    if isinstance(scale, str):
        require(
            scale in ("median", "proposal2", "m"),
            f"scale is 'median', 'proposal2', 'm' or a positive number; found '{scale}'",
        )
        return None
    require(0 < scale < np.inf, f"a known scale must be positive and finite; found {scale}")
    return float(scale)


def _checked(start: ArrayLike, problem: Design) -> Array:
    x = np.asarray(start, dtype=float)
    require(
        x.shape == (problem.p,) and bool(np.isfinite(x).all()),
        f"start must be {problem.p} finite numbers, one per column of B; found shape {x.shape}",
    )
    return x
