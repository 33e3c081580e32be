"""MM-estimates: the breakdown point of an S-estimate with the efficiency of an M-estimate."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import require
from elastocal.identification.robust.design import Design, design
from elastocal.identification.robust.estimate import RobustEstimate
from elastocal.identification.robust.m_estimate import reweighted
from elastocal.identification.robust.s_estimate import SUBSETS, s_estimate
from elastocal.identification.robust.tuning import EFFICIENCY, bisquare, breakdown_bisquare

Array = NDArray[np.float64]


def mm_estimate(
    B: ArrayLike,
    y: ArrayLike,
    *,
    size: int = 1,
    seed: int = 0,
    subsets: int = SUBSETS,
    start: ArrayLike | None = None,
    efficient: float = EFFICIENCY,
) -> RobustEstimate:
    """MM-estimate (Yohai 1987): S-estimate with 50 % breakdown, then Tukey's bisquare.

    B (n·size, p) and y (n·size,) whitened, `size` rows per observation.  The S-estimate fixes
    start and scale; the bisquare with efficiency `efficient` at the normal then descends from
    there at that scale, so almost half of the observations, leverage points among them, may be
    arbitrarily wrong.  `subsets` random subsets are tried (deterministic in `seed`), and `start`
    (p,) or (k, p) beside them, such as `trimmed.least_trimmed_squares`; 0 subsets refine the
    start alone.

    Raises InputError for wrong shapes or dependent columns.
    """
    require(
        subsets >= 0 and (subsets > 0 or start is not None),
        "an S-estimate needs random subsets or a start",
    )
    return mm_of(design(B, y, size), seed, subsets, start, efficient)


def mm_of(
    problem: Design,
    seed: int = 0,
    subsets: int = SUBSETS,
    start: ArrayLike | None = None,
    efficient: float = EFFICIENCY,
) -> RobustEstimate:
    """`mm_estimate` of a checked design."""
    starts = None
    if start is not None:
        given = np.atleast_2d(np.asarray(start, dtype=float))
        require(
            given.ndim == 2 and given.shape[1] == problem.p and bool(np.isfinite(given).all()),
            f"start must be {problem.p} finite numbers, or rows of them; found {given.shape}",
        )
        starts = np.stack([problem.coordinates(x) for x in given])
    z, scale = s_estimate(problem, breakdown_bisquare(problem.size), seed, subsets, starts)
    return reweighted(problem, bisquare(problem.size, efficient), z, scale)
