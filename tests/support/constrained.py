"""Constrained linear fits and their intervals, stated by names and constraints."""

from collections.abc import Sequence

import numpy as np

from elastocal.identification.constrained import Minimum, minimise
from elastocal.identification.constrained_solver import ConstrainedObjective, loss_of
from elastocal.identification.intervals import ProfileInterval
from elastocal.identification.knowledge import Constraints, GaussianPrior
from elastocal.identification.knowledge_fit import profile_linear_interval

NONE = Constraints()


def objective_of(B, y, names, prior, loss, size, sigma) -> ConstrainedObjective:
    """Σ ρ(y − B x) + σ² (x − m)ᵀ C⁻¹ (x − m) with rows of standard deviation `sigma`."""
    p = len(names)
    P, target = (np.zeros((0, p)), np.zeros(0)) if prior is None else prior.rows(names)
    return ConstrainedObjective(
        np.asarray(B, dtype=float), np.asarray(y, dtype=float), sigma * P, sigma * target,
        loss_of(loss, size, sigma),
    )  # fmt: skip


def solve(
    B: np.ndarray,
    y: np.ndarray,
    names: Sequence[str],
    stated: Constraints = NONE,
    *,
    prior: GaussianPrior | None = None,
    loss: str = "squares",
    size: int = 1,
    sigma: float = 1.0,
) -> Minimum:
    objective = objective_of(B, y, names, prior, loss, size, sigma)
    return minimise(objective, stated.resolve(names))


def profiles(
    B: np.ndarray,
    y: np.ndarray,
    names: Sequence[str],
    stated: Constraints,
    *,
    prior: GaussianPrior | None = None,
    level: float = 0.95,
) -> list[ProfileInterval]:
    """The interval of every parameter for rows of unit noise."""
    objective, system = objective_of(B, y, names, prior, "squares", 1, 1.0), stated.resolve(names)
    return [profile_linear_interval(objective, system, n, 1.0, level) for n in names]


def profile(
    B: np.ndarray, y: np.ndarray, names: Sequence[str], stated: Constraints, name: str
) -> ProfileInterval:
    """The interval of one parameter for rows of unit noise."""
    objective = objective_of(B, y, names, None, "squares", 1, 1.0)
    return profile_linear_interval(objective, stated.resolve(names), name, 1.0)
