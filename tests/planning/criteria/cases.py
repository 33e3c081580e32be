"""Every criterion on small random problems with nuisance parameters."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from elastocal.planning.criteria import CRITERIA, make_criterion
from elastocal.planning.criterion import Criterion

P = 6
INTEREST = np.array([4, 1, 2, 5])
CERTIFIABLE = tuple(name for name in CRITERIA if name not in ("O2", "O4"))
# (scenarios, robust) under which each criterion is checked.
ROBUST = ((1, "none"), (3, "average"), (3, "worst"))
# Every criterion under one of them, in turn; two that are put together differently under all.
MIXED = [(name, *ROBUST[k % 3]) for k, name in enumerate(CRITERIA)]
MIXED += [(name, *robust) for name in ("D", "G") for robust in ROBUST]
MIXED = sorted({*MIXED})


def criterion(name: str, scenarios: int = 1, robust: str = "none", seed: int = 7) -> Criterion:
    rng = np.random.default_rng(seed)
    return make_criterion(
        name,
        parameters=P,
        interest=INTEREST,
        scenarios=scenarios,
        A=rng.normal(size=(scenarios, 5, 3, P)),
        weights=np.array([1.0, 2.0, 0.5, 3.0, 1.0]),
        combination=rng.normal(size=P),
        unit="mrad",
        n_poses=4,
        robust=robust,
    )


def blocks(rng: np.random.Generator, scenarios: int, n: int, r: int = 3, p: int = P) -> np.ndarray:
    """(S, N, r, p) with columns of unlike size."""
    return rng.normal(size=(scenarios, n, r, p)) * np.logspace(-0.5, 0.5, p)


def information(B: np.ndarray) -> np.ndarray:
    """Σ_i B_siᵀ B_si (S, p, p)."""
    return np.einsum("snri,snrj->sij", B, B)


def random_information(rng: np.random.Generator, scenarios: int, n: int = 5) -> np.ndarray:
    return information(blocks(rng, scenarios, n))


def subsets(n: int, size: int) -> Iterator[np.ndarray]:
    for chosen in itertools.combinations(range(n), size):
        yield np.array(chosen)
