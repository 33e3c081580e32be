"""The least of a function of a few logarithms between limits, by steps of its information."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from scipy import linalg

from elastocal.units import Array

# Value, slope (k,) and information (k, k) of −2ℓ at logarithms (k,).
Objective = Callable[[Array], tuple[float, Array, Array]]

STRIDE = 1.5  # longest step of a logarithm
EXCHANGES = 30  # of what is held at a bound, after which another method has to end the search


def climb(
    evaluate: Objective, theta: Array, lower: Array, upper: Array, enough: float, steps: int
) -> tuple[Array, bool]:
    """Where −2ℓ is least, and whether it ended there.

    A step that promises less than `enough` is not taken any more; none is longer than STRIDE in
    any logarithm.  What the curvature exceeds the information by is learned from the steps.
    """
    value, slope, information = evaluate(theta)
    free = np.flatnonzero(lower < upper)
    excess = np.zeros_like(information)  # of the curvature over the information, as steps met it
    for _ in range(steps):
        step, H = np.zeros(len(theta)), information + excess
        try:
            root = linalg.cholesky(H[np.ix_(free, free)])
        except linalg.LinAlgError:
            break
        low, high = np.maximum(lower - theta, -STRIDE), np.minimum(upper - theta, STRIDE)
        step[free] = -linalg.cho_solve((root, False), slope[free])
        if ((step < low) | (step > high)).any():
            step[free] = least_within(H[np.ix_(free, free)], slope[free], low[free], high[free])
        if -float(slope @ step) < enough:
            return theta, True
        for length in (1.0, 0.5, 0.25, 0.0625):
            tried = evaluate(theta + length * step)
            if tried[0] < value:
                break
        else:
            break
        curved, Hs = float((tried[1] - slope) @ step) / length, H @ step
        missing, more = curved - float(step @ Hs), float(step @ excess @ step)
        if missing > 0:
            excess += missing * np.outer(Hs, Hs) / float(step @ Hs) ** 2
        elif more > 0:
            excess *= max(1 + missing / more, 0.0)
        theta, (value, slope, information) = theta + length * step, tried
    return theta, False


def least_within(H: Array, slope: Array, low: Array, high: Array) -> Array:
    """s (k,) in its box where sᵀslope + ½sᵀHs is least, H positive definite.

    What is held at its bounds is exchanged, all at once, for what then passes them or is drawn off
    them, until that stays (Hintermüller, Ito and Kunisch 2002, SIAM J. Optim. 13, 865).  Where it
    goes round in circles, by bounded least squares.
    """
    below = above = np.zeros(len(slope), dtype=bool)
    for _ in range(EXCHANGES):
        step, inside = np.where(below, low, np.where(above, high, 0.0)), ~(below | above)
        root = linalg.cho_factor(H[np.ix_(inside, inside)], check_finite=False)
        step[inside] = linalg.cho_solve(root, -(slope + H @ step)[inside], check_finite=False)
        force = slope + H @ step
        was, below, above = (
            (below, above),
            (step < low) | (below & (force > 0)), (step > high) | (above & (force < 0)),
        )  # fmt: skip
        if np.array_equal(below, was[0]) and np.array_equal(above, was[1]):
            return np.asarray(step)
    root = linalg.cholesky(H)
    target = -linalg.solve_triangular(root, slope, trans="T")
    return np.asarray(scipy.optimize.lsq_linear(root, target, (low, high), method="bvls").x)
