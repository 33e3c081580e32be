"""What the identification knows of where the tool will be, and what it does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.manipulator.calibrated import Calibrated
from elastocal.manipulator.chain import Array

OUTSIDE = 1e-6  # share of the tool's motion that may lie outside what is known: rounding


@dataclass(frozen=True)
class Uncertainty:
    """`covariance` (n, 3, 3) m² of the position in the data's frame.

    `unknown` (n,) m: what typical deviations of the parameters that the data do not determine
    would move the tool by, which the covariance does not hold; `blamed` names those parameters,
    the most harmful first.
    """

    covariance: Array
    unknown: Array
    blamed: tuple[str, ...]

    @property
    def std(self) -> Array:
        """(n,) m: root of the sum of the variances along the three axes."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2))


def position_uncertainty(arm: Calibrated, A: Array) -> Uncertainty:
    """Σ_p = A_D Σ A_Dᵀ for A (n, 3, parameters) in m per unit, Σ of the determined parameters D.

    A parameter that is known only as part of sums X_k + Σ f_kd X_d moves the tool in an unknown
    way by A_d − Σ_k f_kd A_k, which vanishes where the tool's point moves as the measured ones.
    """
    names = {name: i for i, name in enumerate(arm.model.names)}
    kept = [names[name] for name in arm.determined]
    known = A[..., kept]
    # Once for each half: a sum over pairs at once would hold (n, 3, D, D) numbers.
    covariance = (known @ arm.covariance) @ known.transpose(0, 2, 1)
    off, sizes = A.copy(), np.zeros(len(names))
    off[..., kept] = 0.0
    for terms in arm.combinations:
        first, *rest = terms.items()
        for name, factor in rest:
            off[..., names[name]] -= factor / first[1] * A[..., names[first[0]]]
    for i, p in enumerate(arm.model.parameters):
        sizes[i] = abs(p.nominal) if p.typical is None else p.typical
    off = (
        np.where(np.abs(off) > OUTSIDE * np.abs(A).max(axis=(0, 1), initial=0.0), off, 0.0) * sizes
    )
    harm = np.sqrt((off**2).sum(axis=1).mean(axis=0)) if len(A) else np.zeros(len(names))
    order = [int(i) for i in np.argsort(-harm) if harm[i] > 0]
    return Uncertainty(
        (covariance + covariance.transpose(0, 2, 1)) / 2,
        np.sqrt((off**2).sum(axis=(1, 2))),
        tuple(arm.model.names[i] for i in order),
    )
