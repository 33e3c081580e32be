"""What a plan promises, and why each pose is in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from elastocal.design.parameters import Estimable
from elastocal.manipulator.model import Model

Array = NDArray[np.float64]

TOLD = 3  # parameters named per pose
COMBINED = 0.01  # share of a typical deviation that counts as being part of a combination


@dataclass(frozen=True)
class Predicted:
    """Standard deviation and half width of the 95 % interval of a parameter, in its unit.

    `combined_with`: what the readings cannot tell from it; the interval is that of the sum.
    """

    name: str
    unit: str
    std: float
    half_width: float
    combined_with: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reason:
    """What a plan loses without one pose: `loss` of the criterion, as a factor (inf: everything).

    `serves`: the parameters that lose most and by what factor their standard deviation grows.
    """

    loss: float
    serves: tuple[tuple[str, float], ...]


def predicted(model: Model, found: Estimable, M: Array, n_numbers: int) -> tuple[Predicted, ...]:
    """Intervals of the kept parameters from the information M (p, p), scaled by their sizes.

    cov(X̂) = M⁻¹ (eq. 13 of Klimchik et al. 2013); the half width is that of Student's t with
    `n_numbers` − p degrees of freedom, as identification will estimate the noise.
    """
    r, sizes = found.reduction, found.sizes
    std = np.sqrt(np.diag(_inverse(M))) * sizes[r.kept]
    quantile = float(stats.t.ppf(0.975, max(n_numbers - len(r.kept), 1)))
    return tuple(
        Predicted(
            model.names[c], model.parameters[c].unit, float(std[k]), float(quantile * std[k]),
            tuple(
                model.names[d]
                for j, d in enumerate(r.dropped)
                if abs(r.mixing[k, j]) * sizes[d] > COMBINED * sizes[c]
            ),
        )
        for k, c in enumerate(r.kept)
    )  # fmt: skip


def reasons(
    model: Model, found: Estimable, blocks: Array, prior: Array, values: Array, value: float
) -> tuple[Reason, ...]:
    """Why each pose of a plan is in it: blocks (N, r, p), prior (p, p), both scaled.

    `values` (N,): the criterion of the plan without that pose; `value`: with all.
    """
    M = prior + np.einsum("nri,nrj->ij", blocks, blocks)
    V = _inverse(M)
    names = [model.names[c] for c in found.columns]
    told = []
    for B, without in zip(blocks, values, strict=True):
        # V₋ = V + V Bᵀ (1 − B V Bᵀ)⁻¹ B V; a pose that carries a direction alone leaves 1 − BVBᵀ
        # singular.
        share, turn = linalg.eigh(B @ V @ B.T)
        moved = turn.T @ B @ V
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = np.where(1 - share > 1e-9, 1 - share, 0.0)
            more = (np.where(np.abs(moved) > 1e-12, moved**2, 0.0) / rest[:, None]).sum(axis=0)
            growth = np.sqrt(1 + np.nan_to_num(more, nan=0.0, posinf=np.inf) / np.diag(V))
        first = np.argsort(-growth, kind="stable")[:TOLD]
        serves = tuple((names[k], float(growth[k])) for k in first if growth[k] > 1.005)
        told.append(Reason(float(without / value), serves))
    return tuple(told)


def _inverse(M: Array) -> Array:
    factor = linalg.cho_factor(M)
    return np.asarray(linalg.cho_solve(factor, np.eye(len(M))))
