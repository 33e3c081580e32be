"""Pools of random candidates and every certifiable criterion over them."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement, product

import numpy as np

from elastocal.planning.criteria import make_criterion
from elastocal.planning.criterion import Criterion
from elastocal.planning.selection import DesignProblem

NAMES = ("test_pose", "D", "A", "E", "G", "I", "c", "O1", "O3", "O5")
# O1 and O3 are D and E, I is test_pose with equal weights.
DISTINCT = ("test_pose", "D", "A", "E", "G", "c", "O5")
ROBUST = ("average", "worst")


def criterion_of(
    name: str, p: int, scenarios: int = 1, robust: str = "none", seed: int = 0, nuisance: int = 0
) -> Criterion:
    """With the first `nuisance` of p parameters not counted by A, D, E and O5."""
    rng = np.random.default_rng(seed)
    return make_criterion(
        name,
        parameters=p,
        interest=np.arange(nuisance, p),
        scenarios=scenarios,
        A=rng.normal(size=(scenarios, 6, 2, p)),
        combination=rng.normal(size=p),
        n_poses=6,
        robust=robust,
    )


def random_problem(
    name: str = "test_pose",
    n: int = 60,
    r: int = 2,
    p: int = 4,
    shares: tuple[int, ...] = (3, 2),
    scenarios: int = 1,
    robust: str = "none",
    prior: float = 0.0,
    most: int = 1,
    seed: int = 0,
    nuisance: int = 0,
) -> DesignProblem:
    """Blocks with normal rows of varying size, some candidates much better than others."""
    rng = np.random.default_rng(seed)
    nominal = rng.normal(size=(n, r, p)) * np.exp(0.5 * rng.normal(size=(n, 1, 1)))
    blocks = nominal + 0.1 * rng.normal(size=(scenarios, n, r, p))
    return DesignProblem(
        blocks=blocks,
        prior=prior * np.broadcast_to(np.eye(p), (scenarios, p, p)),
        group=np.arange(n) % len(shares),
        shares=np.array(shares),
        criterion=criterion_of(name, p, scenarios, robust, seed, nuisance),
        most=most,
    )


def repeated(problem: DesignProblem) -> DesignProblem:
    """The same problem with every candidate listed twice."""
    return replace(
        problem,
        blocks=np.concatenate([problem.blocks, problem.blocks], axis=1),
        group=np.concatenate([problem.group, problem.group]),
    )


def even_weights(problem: DesignProblem) -> np.ndarray:
    size = np.bincount(problem.group, minlength=len(problem.shares))
    return (problem.shares / size)[problem.group]


def best_plan(problem: DesignProblem) -> float:
    """Φ of the best exact plan, by trying all."""
    of_levels = []
    for level, share in enumerate(problem.shares):
        members = np.flatnonzero(problem.group == level)
        plans = combinations_with_replacement(members, int(share))
        of_levels.append(
            [plan for plan in plans if max(map(plan.count, plan), default=0) <= problem.most]
        )
    plans = [np.concatenate(plan).astype(int) for plan in product(*of_levels)]
    weights = np.array([np.bincount(plan, minlength=problem.n_candidates) for plan in plans])
    M = np.stack([problem.information(w) for w in weights.astype(float)])
    return float(problem.criterion.value(M).min())
