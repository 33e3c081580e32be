"""Which constraints contradict each other, and how far the constraints let a parameter go."""

from __future__ import annotations

from typing import NoReturn

import numpy as np
from scipy.optimize import linprog

from elastocal.errors import InputError
from elastocal.identification.constrained.conic import extremes, least_excess
from elastocal.identification.constrained.system import System
from elastocal.text import listed

MATTERS = 1e-6  # of the largest multiplier


def raise_conflict(system: System) -> NoReturn:
    """Raise InputError that names the constraints which no x satisfies together.

    Every constraint is relaxed by one t, in the units of `system`, and t made as small as can be.
    The constraints with a multiplier are a proof of the contradiction (Farkas); the others could
    be dropped and it would remain.
    """
    found = least_excess(system) if system.matrices else _linear_excess(system)
    largest = max(found.values(), default=0.0)
    guilty = [f"'{k}'" for k, v in found.items() if v > MATTERS * largest] or [
        f"'{label}'" for label in found
    ]
    raise InputError(
        f"the constraints contradict each other: no values satisfy {listed(guilty)} together; "
        "relax or drop one of them"
    )


def _linear_excess(system: System) -> dict[str, float]:
    """Multipliers by label of min t for bounds and equalities, by linear programming."""
    p = len(system.names)
    norms = np.linalg.norm(system.A, axis=1)
    norms = np.where(norms > 0, norms, 1.0)
    A, b = system.A / norms[:, None], system.b / norms
    below, above = np.isfinite(system.lower), np.isfinite(system.upper)
    rows = np.vstack([A, -A, -np.eye(p)[below], np.eye(p)[above]])
    rhs = np.concatenate([b, -b, -system.lower[below], system.upper[above]])
    cost = np.append(np.zeros(p), 1.0)
    relaxed = np.column_stack([rows, -np.ones(len(rows))])
    solved = linprog(cost, relaxed, rhs, bounds=[(None, None)] * p + [(0, None)], method="highs")
    price = np.abs(solved.ineqlin.marginals)
    k = len(b)
    named = dict(zip(system.equality_labels, price[:k] + price[k : 2 * k], strict=True))
    names = np.array(system.names)
    lower, upper = price[2 * k : 2 * k + below.sum()], price[2 * k + below.sum() :]
    named |= {f"the lower bound of {n}": v for n, v in zip(names[below], lower, strict=True)}
    named |= {f"the upper bound of {n}": v for n, v in zip(names[above], upper, strict=True)}
    return {label: float(value) for label, value in named.items()}


def extent(system: System, index: int) -> tuple[float, float]:
    """Smallest and largest value of x[index] among all x that satisfy the constraints."""
    if system.matrices:
        return extremes(system, index)
    cost = np.eye(len(system.names))[index]
    bounds = np.column_stack([system.lower, system.upper])
    ends = []
    for sign in (1.0, -1.0):
        solved = linprog(
            sign * cost,
            A_eq=system.A if len(system.b) else None,
            b_eq=system.b if len(system.b) else None,
            bounds=bounds,
            method="highs",
        )
        ends.append(sign * float(solved.fun) if solved.status == 0 else -sign * np.inf)
    return ends[0], ends[1]
