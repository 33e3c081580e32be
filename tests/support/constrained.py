"""Constrained linear fits and their intervals, stated by names and constraints."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from elastocal.identification.constrained import Minimum, Reduced, minimise
from elastocal.identification.knowledge import Bounds, Constraints, LinearEquality, System

NONE = Constraints()
CHI2 = float(stats.chi2.ppf(0.95, 1))


def non_negative(*names: str) -> Constraints:
    return Constraints(tuple(Bounds(name, lower=0.0) for name in names))


def equal(first: str, other: str) -> Constraints:
    return Constraints(equalities=(LinearEquality({first: 1.0, other: -1.0}),))


def solve(
    B: np.ndarray, y: np.ndarray, names: Sequence[str], stated: Constraints = NONE
) -> Minimum:
    """The least |y − B x|² under the constraints."""
    return minimise(B, y, stated.resolve(names))


def ends(
    B: np.ndarray, y: np.ndarray, names: Sequence[str], stated: Constraints, name: str,
    rise: float = CHI2,
) -> tuple[float, float]:  # fmt: skip
    """The profile interval of one parameter for rows of unit noise, by default of 95 %."""
    reduced, index = Reduced.of(B, y, stated.resolve(names)), names.index(name)
    best = reduced.minimum()
    low, high = (float(reduced.farthest(index, best, rise, side)[index]) for side in (-1, 1))
    return low, high


def breach(B: np.ndarray, y: np.ndarray, system: System, found: Minimum) -> float:
    """What of the conditions of Karush, Kuhn and Tucker a fit of bounds and equalities breaks.

    The largest of: a violated constraint, a price of the wrong sign, and a slope of the sum of
    squares that no price explains, each in units of the parameters' own standard deviations.
    """
    unit = 1 / np.linalg.norm(B, axis=0)
    x = found.x / unit
    missed = np.abs(system.A @ found.x - system.b) / np.maximum(
        np.linalg.norm(system.A * unit, axis=1), 1e-300
    )
    parts = [system.lower / unit - x, x - system.upper / unit, missed]
    slope = 2 * unit * (B.T @ (B @ found.x - y))
    for a in found.active:
        if a.kind == "equality":
            row = system.A[system.equality_labels.index(a.label)]
        else:
            row = np.eye(len(x))[system.names.index(a.names[0])]
            parts.append(np.array([-a.multiplier if a.kind == "lower" else a.multiplier]) * unit)
        slope = slope - a.multiplier * row * unit
    parts.append(np.abs(slope))
    return float(max(np.max(part, initial=0.0) for part in parts))
